"""Infer from one data set whether, where, by which effects and how far it departs from the model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import block_diag

from mcsim import config
from mcsim.datavector.bent import bent_templates
from mcsim.datavector.candidate import Candidate, columns_of, parts_of, scatters_of, tables_at, tables_beside
from mcsim.datavector.nuisances import with_priors
from mcsim.diagnosis.assemble import result_of
from mcsim.diagnosis.context import DataSet, DiagnosisContext
from mcsim.diagnosis.drawn import as_seen
from mcsim.diagnosis.found_noise import in_words, with_found_noise
from mcsim.diagnosis.naming import agreeing, probable, unconfirmed
from mcsim.diagnosis.noise_of_splits import certain
from mcsim.diagnosis.partial import PartialSearch
from mcsim.diagnosis.refine import Refined, Refiner
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.diagnosis.rivals import with_rivals
from mcsim.diagnosis.selection import Attribution, Explanation
from mcsim.diagnosis.words import refuted
from mcsim.errors import InputError
from mcsim.stats.excess import HeldOut, excess
from mcsim.stats.gaussian import Fit
from mcsim.stats.scattered import GROWS, with_drawn_scatter, with_scatter, with_tangents
from mcsim.support.arrays import Matrix, Vector
from mcsim.support.numbers import measured
from mcsim.systematics import acts_through, if_possible

EXPLAINED = 0.5  #: share of the excess chi^2 that a single effect explains which is more likely than an exchange


@dataclass(frozen=True, eq=False)
class Inferred:
    """Hold what data say: with which data that is found, and what is reported of it."""

    data: DataSet
    refined: Refined
    reduction: HeldOut | None = None
    notes: tuple[str, ...] = ()
    orders: tuple[str, ...] = ()

    @property
    def best(self) -> tuple[tuple[int, ...], Fit]:
        """Return members and fit of the best set, or else of what is detected, or of what explains most by itself."""
        found, detected = self.refined.attribution, self.refined.partial
        if found.explanations:
            return found.explanations[0].members, found.explanations[0].fit
        if detected is not None:
            return detected.members, detected.fit
        index = max(range(len(found.singles)), key=lambda k: found.singles[k].delta_chi2)
        return (index,), found.singles[index]

    @property
    def acting(self) -> list[config.Effect]:
        """Return the effects of :attr:`best` at their amplitudes; none if they cannot act."""
        with if_possible():
            return tables_at(self.data.context.candidates, *self.best)
        return []

    def result(self, case: str, *notes: str) -> DiagnosisResult:
        """Return the result of a case, with notes before its own and those on the data."""
        said = (*notes, *self.data.notes(), *self.notes)
        return replace(result_of(self.data, case, self.refined, self.reduction, said), orders=self.orders)


def inferred(data: DataSet) -> Inferred:
    """Return what data say as they are."""
    context = data.context
    if _is_no_effect(data, first := Refiner(data).unrefined()):
        first = replace(first, attribution=first.attribution.unexplained())
        return Inferred(data, first, orders=tuple(data.instead))
    t = data.templates()
    start = bent_templates(context.null, data.x, t, context.bank.curvature, context.candidates)
    refined = Refiner(data).run(t, context.candidates, start=start)
    plain = data, refined
    data, refined = with_found_noise(data, refined)
    found, reduction = refined.attribution.if_named(data.context.settings), None
    # What describes the data and is no effect says more than any effects, but for a single one.
    instead = [] if found.explanations and len(found.explanations[0].members) == 1 else data.instead
    refusals = list[str]()
    if not instead:
        data, refined, found, refusals = _compared(data, refined)
        if data.context.noise and found.explanations and not _has_noise(refined, found):
            data, refined, found, refusals = _compared(*plain)  # noise that is not there hides what is left
    notes = in_words(data.context)
    context, detected = data.context, refined.partial
    if instead:
        found, detected = found.unexplained(), None
    elif found.explanations:
        found = _with_errors(data, refined, found)
        found, reduction = confirmed(
            context, found, reduction_of(data, replace(refined, attribution=found)), notes, refusals
        )
        if why := unconfirmed(context, found, reduction is not None):
            refusals.append(why)
            found = found.unexplained()
    # What the rest of the data contradicts is not detected in it; after an unknown gap it was looked for already.
    named = refined.attribution.if_named(context.settings)
    searched = instead or (refusals and named.explanations) or found.faint or refined.attribution.verdict == "unknown"
    if found.verdict == "unknown" and not searched:
        detected = PartialSearch(data).run(refined.templates, refined.candidates)
    notes += refusals
    if found.verdict == "none":
        notes += data.noise_in_common
    notes += certain(data.noise_of_splits)
    for own in found.explanations[:1] if detected is None else [detected]:
        notes += as_seen(context, own.members, own.fit)
    refined = replace(refined, attribution=found, partial=detected)
    return Inferred(data, refined, reduction, tuple(notes), tuple(instead))


def _compared(data: DataSet, refined: Refined) -> tuple[DataSet, Refined, Attribution, list[str]]:
    """Return data and attribution with rivals that take part, what parts of the data bear out of it, and refusals."""
    found, refusals = _borne_out(data, refined)
    if (beside := with_rivals(data, refined, found)) is not None:
        again, refused = _borne_out(*beside)
        if again.explanations or found.explanations:
            return *beside, again, refused
    return data, refined, found, refusals


def _borne_out(data: DataSet, refined: Refined) -> tuple[Attribution, list[str]]:
    """Return the attribution as far as it is probable and parts of the data agree, and sentences on what is refused."""
    found, refusals = probable(data.context, refined)
    return agreeing(data, refined, found) if found.explanations else (found, refusals)


def _has_noise(refined: Refined, found: Attribution) -> bool:
    """Return True if an effect on noise alone is in one of the sets."""
    members = {member for one in found.explanations for member in one.members}
    return any(refined.candidates[member].parametrization.noise_alone for member in members)


def _is_no_effect(data: DataSet, first: Refined) -> bool:
    """Return True if maps in another order, or with noise in common, fit the model, and no effect explains much."""
    null = data.context.null
    most = max((fit.delta_chi2 for fit in first.attribution.singles), default=0.0)
    return null.hartlap_factor * most < EXPLAINED * excess(null, data.x).value and bool(data.instead)


def confirmed(
    context: DiagnosisContext, found: Attribution, reduction: HeldOut | None, notes: list[str], refusals: list[str]
) -> tuple[Attribution, HeldOut | None]:
    """Return attribution and reduction if they hold once the best set is simulated.

    A set that increases the excess chi^2 of the held-out data, reduces it by less than half of the prediction, or
    leaves most of it where what remains is significant, all beyond error, is not named. Held-out data without excess
    beyond its own error measure no reduction. ``refusals`` or ``notes`` get a sentence on either.
    """
    if reduction is None:
        return found, None
    if reduction.refutes(context.settings.reduction_sigma, context.settings.unexplained_pvalue):
        best, *others = found.explanations
        title = " and ".join(context.candidates[member].title for member in best.members)
        alike = ", nor is what fits alike" if others else ""
        refusals.append(f"The best fit, {title}, is not named{alike}: {refuted(reduction)}.")
        return replace(found.unexplained(), contradicted=(*found.contradicted, best)), None
    if reduction.before.value < reduction.before.sigma:
        own = measured(reduction.before.value, reduction.before.sigma)
        notes.append(f"No reduction on held-out data is given: they show no excess χ² by themselves ({own}).")
        return found, None
    return found, reduction


def _with_errors(data: DataSet, refined: Refined, found: Attribution) -> Attribution:
    """Return the attribution, sets with priors of nuisances in errors, those that are compared also with effects."""
    context, sets = data.context, list[Explanation]()
    for one in found.explanations:
        members = [refined.candidates[member] for member in one.members]
        t = refined.templates[:, columns_of(context.candidates, one.members)]
        null = context.null.with_extra_covariance(*scatters_of(refined.candidates, one.members))
        acting = len(sets) < context.settings.compared_sets
        scattered = [partial(_scattered, data, refined.candidates, one.members, t)] if acting else []
        sets.append(replace(one, fit=with_priors(null, t, one.fit, members, *scattered)))
    return replace(found, explanations=tuple(sets))


def _scattered(data: DataSet, candidates: Sequence[Candidate], members: Sequence[int], t: Matrix, first: Fit) -> Fit:
    """Return the fit of a set with the errors that its amplitudes have with its effects in the data.

    ``t`` are its templates, shape (p, K), and ``candidates`` those with whose scatter it was made.
    """
    context, fit = data.context, first
    if scatters := scatters_of(candidates, members):
        parts = parts_of(context.candidates, members, first)
        alone = [_alone(data, *part) for part in parts if candidates[part[0]].scatter is not None]
        return with_drawn_scatter(context.null, t, first, scatters, alone)
    with if_possible():  # between what was fitted and what can be
        acting = tables_at(context.candidates, members, first)
        groups, unknown = data.in_same_skies(acting), [one for one in acting if not context.knows(one)]
        pairs, scatter = _pairs(data, groups), data.in_same_skies(unknown)
        for skies in (context.settings.constrained_skies, context.settings.strong_skies):
            fit = first
            for pair in _pairs(data, scatter, skies):
                fit = with_scatter(context.null, t, fit, *pair)
            if np.all(fit.errors**2 <= (1.0 + GROWS) * first.errors**2):
                break
        bend = context.null.whiten_templates(t - context.templates[:, columns_of(context.candidates, members)])
        tables = tables_beside(context.candidates, members, first, bend, context.settings.nonlinear_sigma)
        return with_tangents(context.null, t, fit, [_slope(data, groups, pairs, *one) for one in tables])
    return fit


def _alone(data: DataSet, member: int, theta: Vector, covariance: Matrix) -> Matrix | None:
    """Return deviations of data without a member of a fit, in the skies of its scatter; None if it draws a pattern."""
    candidate = data.context.candidates[member]
    if candidate.parametrization.stochastic:
        return None
    table = None
    with if_possible():
        table = candidate.table(candidate.detected(theta, covariance))
    if table is None:
        return None
    before, _ = data.pair_extended([table], data.context.settings.scatter_skies)
    return data.scatter(before[:, : len(data.x)])


def _pairs(
    data: DataSet, groups: Sequence[Sequence[config.Effect]], skies: int | None = None
) -> list[tuple[Matrix, Matrix]]:
    return [pair for own in groups if (pair := data.pair(own, skies)) is not None]


def _slope(
    data: DataSet,
    groups: Sequence[Sequence[config.Effect]],
    pairs: Sequence[tuple[Matrix, Matrix]],
    step: float,
    moved: Sequence[config.Effect] | None,
) -> Matrix | None:
    """Return the derivative of the response, (skies, p_raw), in the one amplitude that has moved by a step.

    ``pairs`` are the data without and with the effects of ``groups``. The skies are those without the gain of the
    effects, which moves as well.
    """
    for before, pair, after in zip(groups, pairs, () if moved is None else data.in_same_skies(moved), strict=False):
        if after != before and (end := data.pair(after)) is not None:
            return (end[1] - end[0] - (pair[1] - pair[0])) / step
    return None


def reduction_of(data: DataSet, refined: Refined) -> HeldOut | None:
    """Fit one half of the data vector, freeze, add the effects to the simulator, and test the other half.

    None if there are no halves, one of them is hardly sensitive to the effects, or the half that is fitted asks for an
    amplitude that an effect cannot have, or at which its response there is far above what was fitted. Without splits
    the halves are degrees and pixels, which constrain beams and pointing little. Fitted parameters that are given with
    an error, like a spectral index, are those of all data: the powers in a half tell hardly more than an amplitude.
    """
    context = data.context
    members, best = refined.attribution.explanations[0].members, refined.attribution.explanations[0].fit
    t = refined.templates[:, columns_of(context.candidates, members)]
    scatters = scatters_of(refined.candidates, members)
    if (apart := data.in_halves(t @ best.amplitudes)) is None:
        return None
    halves, matrix, words = apart
    if any(acts_through(context.candidates[member].effect, "steady_gain") for member in members):
        words += ": of what these have in common, alternate degrees and pixels"
    t, scatters = matrix @ t, [matrix @ one for one in scatters]
    parts = parts_of(context.candidates, members, best)
    fitted = [(context.candidates[member].parametrization, theta) for member, theta, _ in parts]
    free = block_diag(*(theta[:, None] if how.measured else np.eye(len(theta)) for how, theta in fitted))

    def acting_at(frozen: Fit) -> list[config.Effect]:
        if free.shape[1] < len(free):
            # Where the coordinates of an effect move together, those of all data say which of them are near.
            covariance = free @ frozen.covariance @ free.T + best.covariance
            frozen = replace(frozen, amplitudes=free @ frozen.amplitudes, covariance=covariance)
        return tables_at(context.candidates, members, frozen)

    def respond(frozen: Fit) -> Vector:
        acting = acting_at(frozen)
        change: Vector = matrix @ data.respond(acting, context.settings.constrained_skies).mean(axis=0)
        if not scatters and halves.exceeds(change, t @ free @ frozen.amplitudes, context.settings.reduction_sigma):
            raise InputError("the response is far from straight between the amplitudes of all data and of a half.")
        return change

    def skies(frozen: Fit) -> tuple[Matrix, Matrix] | None:
        acting = acting_at(frozen)
        noisier = any(how.noise_alone for how, _ in fitted) and not any(map(context.knows, acting))
        pair = data.pair(acting) if noisier and not scatters else None
        return None if pair is None else (pair[0] @ matrix.T, pair[1] @ matrix.T)

    with if_possible():
        return halves.reduction(t @ free, respond, scatters, words, skies)
    return None
