"""Responses at the amplitudes that were found, where they are too strong for a straight line."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.diagnosis.analysis import Analysis, Proposal
from mcsim.diagnosis.candidate import Candidate, columns_of, parts_of
from mcsim.diagnosis.knowledge import CONSTRAINED_SKIES, SCATTER_SKIES, Knowledge
from mcsim.diagnosis.knowledge import skies as skies_of
from mcsim.diagnosis.partial_explanation import PartialExplanation, partial_explanation
from mcsim.diagnosis.selection import LARGEST, Attribution, attribute
from mcsim.errors import InputError
from mcsim.stats.gaussian import Fit, SimulatedGaussian, fit
from mcsim.stats.look_elsewhere import Calibration
from mcsim.systematics import Effect

Vector = NDArray[np.float64]
Respond = Callable[[Sequence[config.Effect], int], NDArray[np.float64]]
"""From effects and a number of skies to the changes of the evidence in each of these, by simulation."""

ROUNDS = 4
"""In which responses are simulated anew, at most."""

STRAIGHT = 0.5
"""Departure from a straight line, in standard deviations of the evidence, that is let pass."""

NOISY = 0.01
"""Share of noise in the square of a template, entries over their scatter, from which on it is cleaned."""

SCATTERED = 0.1
"""Scatter of a response from sky to sky, over its mean, from which on it is simulated for the observed sky."""

CLEAN = 5.0
"""Of a noisy template, what is smaller than this many of its standard errors is none."""

TELLING = 0.05
"""Probability, trials included, from which on an effect that draws is tried where no single one suffices."""

JOINT_ROUNDS = 4
"""The same for effects that act together."""

MOVED = 0.3
"""Standard deviations that amplitudes may move and still be the same."""

SETTLED = 0.05
"""The same as a share of the amplitudes."""

TRIED = 3
"""Single candidates, those that lower chi^2 most, that are brought to their amplitude where no subset suffices."""


@dataclass(frozen=True)
class Refined:
    """A verdict with responses at the amplitudes that it speaks of.

    Attributes
    ----------
    attribution
        Final.
    templates
        As it used them, shape (p, K).
    candidates
        With the scatter of those that draw, at the amplitudes that they were tried at.
    simulated
        Candidates whose response was simulated at its amplitude.
    heard
        What of the library is heard where no set of it suffices.
    """

    attribution: Attribution
    templates: NDArray[np.float64]
    candidates: tuple[Candidate, ...]
    simulated: tuple[int, ...]
    filtered: PartialExplanation | None = None


def significant_templates(known: Knowledge) -> NDArray[np.float64]:
    """Templates, shape (p, K), those that are noisy without the entries that are only noise."""
    scatter = known.simulations.std(axis=0)[:, None]
    noise = np.sum((known.template_error / scatter) ** 2, axis=0)
    noisy = noise > NOISY * np.sum((known.templates / scatter) ** 2, axis=0)
    filtered = np.abs(known.templates) > CLEAN * known.template_error
    return np.where(noisy & ~filtered, 0.0, known.templates)


def scatter_of(known: Knowledge, analysis: Analysis) -> NDArray[np.float64]:
    """How far the response in one sky is from the mean response: rms of the ratio of their lengths, shape (proposals,).

    Lengths of entries over their scatter, all columns of a proposal together.
    """
    spread = known.simulations.std(axis=0)[:, None]
    noise = np.sum((known.template_error / spread) ** 2, axis=0)
    size = np.sum((known.templates / spread) ** 2, axis=0)
    found = []
    for proposal, columns in zip(analysis.proposals, analysis.columns, strict=True):
        rows = list(columns)
        # A column of nothing but noise says nothing of the others.
        filtered = size[rows] > 2.0 * noise[rows]
        ratio = skies_of(proposal, analysis.model.lmax) * noise[rows] / np.maximum(size[rows] - noise[rows], 1e-300)
        found.append(float(np.sqrt(np.mean(ratio[filtered]))) if filtered.any() else np.inf)
    return np.array(found)


def templates_on_sky(
    known: Knowledge, analysis: Analysis, t: NDArray[np.float64], respond: Respond
) -> NDArray[np.float64]:
    """Templates, those of effects whose response depends on the very sky measured on the one that was observed."""
    result = t.copy()
    for proposal, columns, scatter in zip(
        analysis.proposals, analysis.columns, scatter_of(known, analysis), strict=True
    ):
        if scatter < SCATTERED or proposal.drawn or proposal.kind.mean_response:
            continue
        for column, basis in zip(columns, proposal.basis, strict=True):
            try:
                response = respond([proposal.table(basis)], CONSTRAINED_SKIES).mean(axis=0)
            except InputError:
                continue
            step = basis.coordinates()[columns.index(column)]
            result[:, column] = response / step - known.curvature[:, column] * step
    return result


def effect_at(proposal: Proposal, coordinates: Vector, covariance: NDArray[np.float64]) -> Effect:
    """The effect that is nearest to fitted coordinates, as far as data tell them."""
    precision: NDArray[np.float64] = np.asarray(np.linalg.pinv(covariance), dtype=np.float64)
    return proposal.with_parameters(proposal.kind.constrained(coordinates, precision), precision)


def _acting_at(proposal: Proposal, coordinates: Vector, covariance: NDArray[np.float64]) -> Effect:
    """As :func:`effect_at`; InputError where data tell nothing of the effect: its amplitude would be 0."""
    effect = effect_at(proposal, coordinates, covariance)
    if effect.amplitude == 0.0:
        raise InputError(f"the data tell nothing of {proposal.label} by itself; leave it out of what is added.")
    return effect


def effects_at(
    candidates: Sequence[Candidate], proposals: Sequence[Proposal], members: Sequence[int], found: Fit
) -> list[Effect]:
    """The effects that are nearest to a fit of several candidates; InputError where one can have no such amplitude."""
    return [
        _acting_at(proposals[member], amplitudes, covariance)
        for member, amplitudes, covariance in parts_of(candidates, members, found)
    ]


def tables_at(
    candidates: Sequence[Candidate], proposals: Sequence[Proposal], members: Sequence[int], found: Fit
) -> list[config.Effect]:
    """The same as ``[[effect]]`` of a run."""
    effects = effects_at(candidates, proposals, members, found)
    return [proposals[member].table(effect) for member, effect in zip(members, effects, strict=True)]


def refine(
    known: Knowledge,
    null: SimulatedGaussian,
    x: Vector,
    t: NDArray[np.float64],
    candidates: Sequence[Candidate],
    proposals: Sequence[Proposal],
    calibration: Calibration,
    respond: Respond,
    skies: int = 1,
) -> Refined:
    """Attribute, simulate what was found at its amplitude, and attribute again until nothing changes.

    Notes
    -----
    A response that is simulated at its coordinates changes its templates to the secant, exact there. A candidate that
    can have neither the fitted amplitude nor half of it is taken out. Of one that draws the scatter of the response is
    kept, that of the mean of ``skies`` skies.
    """
    t, tried = t.copy(), list(candidates)
    done: dict[int, Vector] = {}
    found = attribute(null, x, t, tried, calibration)
    for _ in range(ROUNDS):
        changed = False
        for index, coordinates, covariance in _to_try(found, tried, proposals, calibration):
            columns, proposal = list(candidates[index].columns), proposals[index]
            bent = _bent(known, null, columns, coordinates)
            draws = proposal.kind.draws and (proposal.kind.sign == 0 or coordinates[0] > 0.0)
            if not (bent or draws) or _close(done.get(index), coordinates, covariance):
                continue
            done[index] = coordinates
            answer = _simulated(
                proposal, coordinates, covariance, respond, SCATTER_SKIES if draws else CONSTRAINED_SKIES
            )
            changed = True
            if answer is None:
                t[:, columns] = 0.0
                continue
            at, changes = answer
            response = changes.mean(axis=0)
            if draws:
                # That of one draw about the mean of as many as there are.
                share = (1.0 / skies + 1.0 / len(changes)) / (len(changes) - 1.0)
                scatter = np.sqrt(share) * (changes - response).T
                tried[index] = replace(tried[index], scatter=scatter, shape_error=None)
            if bent:
                t[:, columns] += _beyond(null, t[:, columns], at, response)
        if not changed:
            break
        found = attribute(null, x, t, tried, calibration)
    filtered = None
    if found.verdict == "unknown":
        filtered = detected_in(null, x, t, tried, proposals, calibration, respond)
        if filtered is not None and len(filtered.members) <= LARGEST:
            together = attribute(null, x, filtered.templates, tried, calibration)
            if together.explanations:
                t, found, filtered = filtered.templates, together, None
    return Refined(found, t, tuple(tried), tuple(done), filtered)


def detected_in(
    null: SimulatedGaussian,
    x: Vector,
    t: NDArray[np.float64],
    candidates: Sequence[Candidate],
    proposals: Sequence[Proposal],
    calibration: Calibration,
    respond: Respond,
) -> PartialExplanation | None:
    """What of the library is heard in evidence, each set simulated together at its amplitudes."""
    return partial_explanation(
        null, x, t, candidates, calibration, partial(_together, null, x, candidates, proposals, respond)
    )


def _together(
    null: SimulatedGaussian,
    x: Vector,
    candidates: Sequence[Candidate],
    proposals: Sequence[Proposal],
    respond: Respond,
    t: NDArray[np.float64],
    members: tuple[int, ...],
    fitted: Fit,
) -> NDArray[np.float64] | None:
    """Templates that are exact for effects that act together, at about fitted amplitudes.

    Strong effects bend their own responses and change each other's. None where one can have no such amplitude, or
    amplitudes run away from each other round by round.
    """
    columns = np.array(columns_of(candidates, members))
    skies = SCATTER_SKIES if any(proposals[member].kind.draws for member in members) else CONSTRAINED_SKIES
    for _ in range(JOINT_ROUNDS):
        try:
            effects = effects_at(candidates, proposals, members, fitted)
            tables = [proposals[member].table(effect) for member, effect in zip(members, effects, strict=True)]
            response = respond(tables, skies).mean(axis=0)
        except InputError:
            return None
        t = t.copy()
        at = np.concatenate([effect.coordinates() for effect in effects])
        t[:, columns] += _beyond(null, t[:, columns], at, response)
        before, fitted = fitted, fit(null, x, t[:, columns])
        if _settled(before.amplitudes, fitted):
            return t
    return None


def _beyond(null: SimulatedGaussian, t: NDArray[np.float64], at: Vector, response: Vector) -> NDArray[np.float64]:
    """What makes templates, shape (p, k), exact at coordinates: what their simulated response has beyond the sum.

    It is shared out by the squares of the white lengths of the parts, so that one that is hardly heard, whatever its
    fitted coordinate, stays what it is.
    """
    parts = t * at
    weights = np.sum(null.whiten_templates(parts) ** 2, axis=0)
    shares = np.divide(weights, at * weights.sum(), out=np.zeros_like(at), where=weights > 0.0)
    return np.outer(response - parts.sum(axis=1), shares)


def _simulated(
    proposal: Proposal, coordinates: Vector, covariance: NDArray[np.float64], respond: Respond, skies: int
) -> tuple[Vector, NDArray[np.float64]] | None:
    """Coordinates and responses, at the fitted amplitude or half of it; None where the effect can have neither.

    What is fitted by a straight line may lie somewhat beyond what the effect can be, and the effect be there; what
    would have to lie far beyond explains nothing.
    """
    for factor in (1.0, 0.5):
        try:
            effect = _acting_at(proposal, factor * coordinates, covariance / factor**2)
            return effect.coordinates(), respond([proposal.table(effect)], skies)
        except InputError:
            continue
    return None


def _to_try(
    found: Attribution, candidates: Sequence[Candidate], proposals: Sequence[Proposal], calibration: Calibration
) -> list[tuple[int, Vector, NDArray[np.float64]]]:
    """Candidates with fitted coordinates: those of the best explanations, or the best single ones."""
    work: dict[int, tuple[int, Vector, NDArray[np.float64]]] = {}
    if found.verdict == "none":
        return []
    for explanation in found.explanations[:2]:
        for part in parts_of(candidates, explanation.members, explanation.fit):
            work.setdefault(part[0], part)
    if found.explanations and len(found.explanations[0].members) == 1:
        return list(work.values())
    # Singles too: a strong effect bends its response, and one that draws scatters it, until only a mixture seems to do.
    ranked = [int(index) for index in np.argsort([-single.delta_chi2 for single in found.singles])]
    drawing: set[tuple[str, str | None]] = {candidates[index].identity for index in work if proposals[index].kind.draws}
    for place, index in enumerate(ranked):
        single, candidate = found.singles[index], candidates[index]
        filtered = proposals[index].kind.draws and float(calibration.global_pvalue(single.nested_pvalue)) <= TELLING
        if place < TRIED or (filtered and candidate.identity not in drawing):
            work.setdefault(index, (index, single.amplitudes, single.covariance))
            if proposals[index].kind.draws:
                drawing.add(candidate.identity)
    return list(work.values())


def _bent(known: Knowledge, null: SimulatedGaussian, columns: list[int], coordinates: Vector) -> bool:
    """Whether the second derivative matters at these coordinates."""
    shift = known.curvature[:, columns] @ coordinates**2
    crossed = float(np.sum(np.abs(coordinates)) ** 2) / max(float(coordinates @ coordinates), 1e-300)
    return crossed * float(np.linalg.norm(null.whiten_templates(shift[:, None]))) > STRAIGHT


def _settled(before: Vector, now: Fit) -> bool:
    """Whether amplitudes have hardly moved: by their errors, or by a share of themselves where errors are tiny."""
    precision = np.linalg.pinv(now.covariance)
    moved = now.amplitudes - before
    length = float(now.amplitudes @ precision @ now.amplitudes)
    return float(moved @ precision @ moved) < max(MOVED**2, SETTLED**2 * length)


def _close(before: Vector | None, now: Vector, covariance: NDArray[np.float64]) -> bool:
    if before is None:
        return False
    moved = now - before
    return float(moved @ np.linalg.pinv(covariance) @ moved) < MOVED**2
