"""Draws of the compressed evidence, without maps: thousands of cases that are judged like full skies."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mcsim.benchmark.prior import CaseSampler, Drawn, Prior
from mcsim.benchmark.record import Geometry, Record, most_probable
from mcsim.benchmark.reduced import without
from mcsim.diagnosis.analysis import Proposal
from mcsim.diagnosis.batch import Batch
from mcsim.diagnosis.candidate import Candidate, columns_of
from mcsim.diagnosis.inference import DiagnosisContext
from mcsim.diagnosis.refine import effects_at, significant_templates
from mcsim.diagnosis.selection import Attribution, attribute
from mcsim.diagnosis.validation import Prediction, Shrink, achieved, predicted
from mcsim.errors import InputError
from mcsim.sphere import rng
from mcsim.stats.detection import power
from mcsim.stats.gaussian import SimulatedGaussian, fit, whitened_templates
from mcsim.stats.look_elsewhere import Calibration, calibrate, global_test

Vector = NDArray[np.float64]

HELD_OUT = 0.25
"""Share of the simulations that serve as data and not for the scatter."""

TASK = 20
FAR = 0.3
"""Cosine below which an effect that is not there is unlike what is."""

STRONG = 8.0


@dataclass(frozen=True, eq=False)
class Bench:
    """What draws are judged with: a court's numbers, small enough to travel.

    Attributes
    ----------
    null, used, fresh
        Of the whole evidence, of its fold 0, of its fold 1; None where it has none.
    first, second
        Entries of both folds.
    templates
        Shape (p, K).
    candidates, proposals, calibration
        Of the library.
    data
        Evidence of simulations that the null has not seen, shape (n, p).
    """

    null: SimulatedGaussian
    used: SimulatedGaussian | None
    fresh: SimulatedGaussian | None
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    templates: NDArray[np.float64]
    candidates: tuple[Candidate, ...]
    proposals: tuple[Proposal, ...]
    calibration: Calibration
    data: NDArray[np.float64]


def bench(context: DiagnosisContext, names: tuple[str, ...] = ()) -> Bench:
    """Of a court, without some effects; a quarter of its simulations become data."""
    fewer = without(context.analysis, context.known, names)
    known, analysis = fewer.known, fewer.analysis
    kept = len(known.simulations) - int(HELD_OUT * len(known.simulations))
    seen = replace(known, simulations=known.simulations[:kept])
    folds = np.array([-1 if element.fold is None else element.fold for element in analysis.elements])
    first, second = np.flatnonzero(folds == 0), np.flatnonzero(folds == 1)
    of = {proposal.label: one for proposal, one in zip(context.analysis.proposals, context.candidates, strict=True)}
    # Templates are exact here, also those of what draws: its scatter, which a diagnosis would measure, is none.
    candidates = tuple(
        replace(of[proposal.label], columns=columns, shape_error=None)
        for proposal, columns in zip(analysis.proposals, analysis.columns, strict=True)
    )
    whole, t = seen.null(), significant_templates(known)
    groups = whitened_templates(whole, t, [candidate.columns for candidate in candidates])
    return Bench(
        whole,
        seen.null(first) if len(first) and len(second) else None,
        seen.null(second) if len(first) and len(second) else None,
        first,
        second,
        t,
        candidates,
        analysis.proposals,
        calibrate(whole, groups),
        known.simulations[kept:] + known.offset,
    )


def draws(
    context: DiagnosisContext, number: int, seed: int, *, prior: Prior | None = None, call: Batch | None = None
) -> list[Record]:
    """Draw evidence and judge it.

    Parameters
    ----------
    court
        Of the model.
    number
        Of draws.
    seed
        Of what is drawn.
    prior
        What is drawn; inventions have no template and are not among it.
    call
        Runs tasks; default: in this process.

    Returns
    -------
    list
        One record for every draw, judged by :func:`mcsim.diagnosis.selection.attribute`.

    Notes
    -----
    x = evidence of a simulation without effects that the null has not seen (the first one again when all have been
    used), plus templates times coordinates: responses are straight lines here, and templates exact. What they are not,
    and everything else that a map goes through, is tested by full skies.
    """
    prior = prior or Prior()
    full = bench(context)
    sampler = sampler_of(full, prior)
    kinds = sampler.kinds(seed, number, False)
    by_library: dict[tuple[str, ...], list[tuple[int, Drawn]]] = {}
    for case in range(number):
        one = sampler.draw(kinds, seed, case)
        by_library.setdefault(one.without, []).append((case, one))
    tasks = []
    for names, cases in by_library.items():
        here = bench(context, names) if names else full
        rows = without(context.analysis, context.known, names).rows
        posed = [Draw(case, one, response_of(full, one)[rows]) for case, one in cases]
        tasks += [(here, prior, seed, posed[start : start + TASK]) for start in range(0, len(posed), TASK)]
    records: list[Record] = []
    for _, found in call(judged, tasks) if call else ((0, judged(*task)) for task in tasks):
        records += found
    return sorted(records, key=lambda record: record.case)


def sampler_of(bench: Bench, prior: Prior) -> CaseSampler:
    """What draws from the library of a bench."""
    columns = [candidate.columns for candidate in bench.candidates]
    return CaseSampler(prior, bench.proposals, columns, bench.templates, bench.null.expected_snr, {})


@dataclass(frozen=True, eq=False)
class Draw:
    """Number of a draw, what it is, and how the evidence of its bench responds to that."""

    case: int
    drawn: Drawn
    response: Vector


def response_of(bench: Bench, drawn: Drawn) -> Vector:
    """Change of the evidence by all that was drawn, shape (p,)."""
    total = np.zeros(len(bench.templates))
    for member in drawn.members:
        assert member.candidate is not None  # inventions are not drawn here
        columns = list(bench.candidates[member.candidate].columns)
        total += bench.templates[:, columns] @ np.array(member.coordinates)
    return total


def judged(bench: Bench, prior: Prior, seed: int, cases: Sequence[Draw]) -> list[Record]:
    """Task: judge draws."""
    geometry = Geometry.of(bench.null, bench.templates, bench.candidates, bench.calibration)
    bayes = geometry.bayes(sampler_of(bench, prior))
    found = []
    for draw in cases:
        x = bench.data[draw.case % len(bench.data)] + draw.response
        members, truth = draw.drawn.members, frozenset(member.identity for member in draw.drawn.members)
        said = attribute(bench.null, x, bench.templates, bench.candidates, bench.calibration)
        best, right = None, np.nan
        if draw.drawn.kind in ("none", "one", "two"):
            best, right = most_probable(bayes.probabilities(x))
        shrink = shrunk(bench, x, said.explanations[0].members) if said.explanations else None
        found.append(
            Record(
                f"draw-{draw.case:05d}",
                draw.drawn.kind,
                truth,
                bench.null.expected_snr(draw.response),
                len(members[0].coordinates) if len(members) == 1 else 0,
                geometry.rival(draw.response, truth) if truth else 0.0,
                geometry.distances(draw.response) if draw.drawn.kind in ("left_out", "invented") else (),
                said.gap.pvalue,
                said.gap.maximum,
                said.verdict,
                answers_of(said, bench.candidates),
                best,
                right,
                *_pulls(said, draw.drawn),
                None if shrink is None else shrink[0].fraction.value,
                None if shrink is None else shrink[1].fraction.value,
                None if shrink is None else shrink[1].fraction.sigma,
                None if shrink is None else (shrink[1].before.value, shrink[1].after.value),
                _absent(bench, geometry, draw, x, truth, seed),
            )
        )
    return found


def answers_of(said: Attribution, candidates: Sequence[Candidate]) -> tuple[frozenset[tuple[str, str | None]], ...]:
    """Accepted sets by name and channel, the best first."""
    return tuple(
        frozenset(candidates[member].identity for member in explanation.members) for explanation in said.explanations
    )


def _pulls(said: Attribution, drawn: Drawn) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Of the only effect, where it was named, and whether or not."""
    if drawn.kind != "one":
        return (), ()
    (member,) = drawn.members
    assert member.candidate is not None  # inventions are not drawn here
    alone = said.singles[member.candidate]
    pulls = tuple(float(pull) for pull in (alone.amplitudes - np.array(member.coordinates)) / alone.errors)
    named = bool(said.explanations) and said.explanations[0].members == (member.candidate,)
    return pulls if named else (), pulls


def shrunk(bench: Bench, x: Vector, members: Sequence[int]) -> tuple[Prediction, Shrink] | None:
    """Shrink predicted and achieved: fitted to fold 0, frozen, and judged on fold 1."""
    if bench.used is None or bench.fresh is None:
        return None
    columns = np.array(columns_of(bench.candidates, members))
    here = bench.templates[np.ix_(bench.second, columns)]
    frozen = fit(bench.used, x[bench.first], bench.templates[np.ix_(bench.first, columns)])
    try:
        effects = effects_at(bench.candidates, bench.proposals, members, frozen)
    except InputError:
        return None
    coordinates = np.concatenate([effect.coordinates() for effect in effects])
    expected = predicted(bench.fresh, x[bench.second], here, frozen.amplitudes, frozen.covariance)
    after = replace(bench.fresh, mean=bench.fresh.mean + here @ coordinates)
    return expected, achieved(bench.fresh, after, x[bench.second])


def _absent(
    bench: Bench, geometry: Geometry, draw: Draw, x: Vector, truth: frozenset[tuple[str, str | None]], seed: int
) -> tuple[float, float] | None:
    """Gap before and after one effect that is neither there nor like what is there."""
    if len(truth) != 1 or draw.drawn.kind != "one":
        return None
    if bench.null.expected_snr(draw.response) < STRONG:
        return None
    white = bench.null.whiten_templates(draw.response[:, None])[:, 0]
    cosines = np.sqrt(geometry.groups.delta_chi2(white)) / np.linalg.norm(white)
    unlike = [
        index
        for index, candidate in enumerate(bench.candidates)
        if candidate.identity not in truth and cosines[index] < FAR and geometry.groups.sizes[index] > 0
    ]
    if not unlike:
        return None
    chosen = unlike[int(rng.generator(seed, draw.case, "challenge/absent").integers(len(unlike)))]
    shrink = shrunk(bench, x, (chosen,))
    return None if shrink is None else (shrink[1].before.value, shrink[1].after.value)


@dataclass(frozen=True, eq=False)
class Power:
    """Single effects of given strengths, whether they were found, and the power that the same trials allow at best.

    Attributes
    ----------
    strengths, by_maximum, by_gap
        Of every draw: white length, and whether the largest of the templates, and the whole test, found it at 5 %.
    grid, limit
        Strengths, and the mean power with infinitely many simulations after Bonferroni over the library.
    finite
        The same with the simulations that there are.
    null_maximum, null_gap
        Probabilities of evidence without an effect.
    """

    strengths: Vector
    by_maximum: NDArray[np.bool_]
    by_gap: NDArray[np.bool_]
    grid: Vector
    limit: Vector
    finite: Vector
    null_maximum: Vector
    null_gap: Vector


def powers(context: DiagnosisContext, number: int, seed: int, *, alpha: float = 0.05) -> Power:
    """Detection of single effects against strength, from 1 to 9, without attribution."""
    here = bench(context)
    sampler = sampler_of(
        here, Prior(none=0.0, one=1.0, two=0.0, left_out=0.0, invented=0.0, weakest=1.0, strongest=9.0)
    )
    geometry = Geometry.of(here.null, here.templates, here.candidates, here.calibration)
    kinds = sampler.kinds(seed, number, False)
    strengths, columns, found = np.empty(number), np.zeros(number, dtype=int), np.empty((number, 2))
    for case in range(number):
        drawn = sampler.draw(kinds, seed, case)
        strengths[case], columns[case] = drawn.members[0].strength, len(drawn.members[0].coordinates)
        said = global_test(
            here.null, here.data[case % len(here.data)] + response_of(here, drawn), geometry.groups, here.calibration
        )
        found[case] = said.maximum, said.pvalue
    quiet = [global_test(here.null, x, geometry.groups, here.calibration) for x in here.data]
    grid = np.linspace(0.5, 9.0, 35)
    tests, p = here.calibration.tests, here.null.dimension
    kinds_of_columns, counts = np.unique(columns, return_counts=True)
    limit, finite = (
        np.array(
            [
                np.average([power(s, int(k), alpha / tests, p, simulations) for k in kinds_of_columns], weights=counts)
                for s in grid
            ]
        )
        for simulations in (None, here.null.count)
    )
    return Power(
        strengths,
        found[:, 0] <= alpha,
        found[:, 1] <= alpha,
        grid,
        limit,
        finite,
        np.array([one.maximum for one in quiet]),
        np.array([one.pvalue for one in quiet]),
    )
