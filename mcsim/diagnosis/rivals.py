"""Try effects that are proposed on request alone in the place of those that are about to be named, or of none."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from mcsim.datavector.analysis import on_request
from mcsim.datavector.bent import bent_templates
from mcsim.datavector.candidate import Candidate, beyond, columns_of, numbered, scatters_of
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.context import DataSet, DiagnosisContext
from mcsim.diagnosis.naming import slices_of
from mcsim.diagnosis.refine import Refined, Refiner
from mcsim.diagnosis.selection import Attribution
from mcsim.stats.excess import excess
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.support.arrays import Matrix, Vector
from mcsim.systematics import acts_through, if_possible

CLEAR = 1e-6  #: global p-value up to which effects on request are tried where no other explains a gap: it is no chance
MUCH = 0.4  #: share of the excess chi^2 that one of them explains alone then, before it is simulated at its amplitude


def with_rivals(data: DataSet, refined: Refined, found: Attribution) -> tuple[DataSet, Refined] | None:
    """Return data and attribution with the effects on request that explain the data like sets that are to be named.

    Where nothing else explains a clear gap, they are those of one split that explain much of it alone. None if there
    are none.

    Notes
    -----
    As a candidate each of them would raise the bar for all. Here it becomes a candidate for these data alone, and only
    if it can take the place of members of a set, in the data vector and in the numbers beside it: of several members,
    or, of the only set, of a single one. Global p-values stay those of the candidates that are always proposed. It is
    simulated at the amplitude that it has there, as a member was. Patterns that are drawn are no rivals. Alone only
    what acts in one split is tried, which the other splits can contradict: a band on the sky of one channel, which no
    library has, would be called a nonlinearity.
    """
    context, settings = data.context, data.context.settings
    sets = [one.members for one in found.explanations[: settings.compared_sets]]
    least = 1 if len(sets) == 1 else 2
    if max(map(len, sets), default=0) < least and (sets or found.faint or found.gap.pvalue > CLEAR):
        return None
    channels = {context.candidates[member].channel for members in sets for member in members}
    others = [one for one in on_request(context.analysis) if not one.random_response]
    near = [one for one in others if one.channel in channels or None in (one.channel, *channels)]
    near = near if sets else [one for one in others if acts_through(one.effect, "steady_gain")]
    if not near:
        return None
    known = list(data.responses(near, settings.channel_skies))
    bent = dict(_alone(data, known)) if not sets else {}
    places: list[tuple[int, tuple[int, ...]]] = [(rival, ()) for rival in bent]
    for members in sets:
        null, z, t = _widest(data, refined, members)
        wide = replace(refined, templates=t)
        own = list(in_place(null, z, wide, members, known, settings, least))
        # What one split has, another may have with the other sign: both are simulated before one is named.
        also = [(other, kept) for rival, kept in own for other in _in_other_splits(known, rival)]
        places = list(dict.fromkeys([*places, *own, *also]))
    if not places:
        return None
    chosen = list(dict.fromkeys(rival for rival, _ in places))
    data = replace(data, context=with_candidates(context, [known[rival] for rival in chosen]))
    added, first = data.context.templates[:, context.templates.shape[1] :], len(context.candidates)
    straight, start = (np.concatenate([refined.templates, *own], axis=1) for own in ([added], bent.values() or [added]))
    candidates = (*refined.candidates, *data.context.candidates[first:])
    tried = [(*kept, first + chosen.index(rival)) for rival, kept in places]
    return data, Refiner(data).run(straight, candidates, tried, start)


def _in_other_splits(rivals: Sequence[tuple[Candidate, Matrix]], index: int) -> Iterator[int]:
    """Yield the rivals that are one of them in another split."""
    one = rivals[index][0]
    for place, (other, _) in enumerate(rivals):
        if other.identity == one.identity and other.claim != one.claim:
            yield place


def _alone(data: DataSet, rivals: Sequence[tuple[Candidate, Matrix]]) -> Iterator[tuple[int, Matrix]]:
    """Yield rivals that explain much of the excess alone, with their templates, bent where the response is.

    Products of what a strong gain or signal adds to maps grow with the square of its amplitude.
    """
    context, null, size = data.context, data.context.null, len(data.x)
    least = MUCH * excess(null, data.x).value / null.hartlap_factor
    for index, (rival, response) in enumerate(rivals):
        (own,), t = numbered([rival]), response[:size]
        curvature = np.zeros_like(t)
        for column, (effect, step) in enumerate(zip(rival.basis, rival.steps, strict=True)):
            with if_possible():
                pair = [rival.table(one) for one in (effect, effect.inverse())]
                changes = [data.respond_extended([one], context.settings.channel_skies).mean(axis=0) for one in pair]
                curvature[:, column] = sum(changes)[:size] / (2.0 * step**2)
        # What was measured at a step ahead has the bent part of it.
        t = bent_templates(null, data.x, t - curvature * rival.steps, curvature, [own])
        fit = null.fit(data.x, t)
        if fit.delta_chi2 >= least and np.isfinite(beyond([own], (0,), fit)):
            yield index, t


def _widest(data: DataSet, refined: Refined, members: Sequence[int]) -> tuple[SimulatedGaussian, Vector, Matrix]:
    """Return null distribution, data and templates, with the numbers beside the data vector if they can be added.

    They cannot beside members whose scatter is known, and without simulations for so many elements.
    """
    slices, beside = slices_of(data), data.context.bank.slice_matrix
    scattered = scatters_of(refined.candidates, members)
    null = None if scattered or not len(beside) else slices.null(np.arange(len(slices.z)))
    if null is None:
        return data.context.null, data.x, refined.templates
    return null, slices.z, np.concatenate([refined.templates, beside])


def in_place(
    null: SimulatedGaussian,
    z: Vector,
    refined: Refined,
    members: Sequence[int],
    rivals: Sequence[tuple[Candidate, Matrix]],
    settings: DiagnosisSettings,
    least: int = 1,
) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Yield the indices of rivals, with their responses, that explain data in the place of members of a set.

    With each stand the members that are kept, as few as possible: ``least`` go at least. Amplitudes are possible, and
    the likelihood is within ``odds_cut`` of that of the set, but for an error of the response that is tolerated
    (``consistency_error``). Data and templates are those of ``null``.
    """
    candidates = refined.candidates
    whole = null.fit(z, refined.templates[:, columns_of(candidates, members)])
    lowest = float(null.log_likelihood(whole.chi2)) - np.log(settings.odds_cut)
    fewer = [kept for size in range(len(members) - least + 1) for kept in combinations(members, size)]
    for index, (rival, response) in enumerate(rivals):
        every = numbered([*candidates, rival])
        t = np.concatenate([refined.templates, response[: len(z)]], axis=1)
        for kept in fewer:
            changed = (*kept, len(candidates))
            columns = columns_of(every, changed)
            fit = null.fit(z, t[:, columns])
            wrong = settings.consistency_error * null.expected_snr(t[:, columns] @ fit.amplitudes)
            if null.log_likelihood(fit.chi2) + 0.5 * wrong**2 >= lowest and np.isfinite(beyond(every, changed, fit)):
                yield index, kept
                break


def with_candidates(context: DiagnosisContext, more: Sequence[tuple[Candidate, Matrix]]) -> DiagnosisContext:
    """Return what data are tested with, with further candidates and their responses, shape (p + E, K) each."""
    candidates = numbered([*context.candidates, *(one for one, _ in more)])
    added, response = candidates[len(context.candidates) :], np.concatenate([one for _, one in more], axis=1)
    templates = np.concatenate([context.templates, response[: len(context.templates)]], axis=1)
    return replace(
        context,
        bank=context.bank.with_columns([label for one in added for label in one.labels], response),
        candidates=candidates,
        sky_scatter=np.append(context.sky_scatter, np.zeros(len(added))),
        templates=templates,
    )
