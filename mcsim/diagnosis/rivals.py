"""Try effects that are proposed on request alone in the place of those that are about to be named."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mcsim.datavector.analysis import on_request
from mcsim.datavector.candidate import Candidate, beyond, columns_of, numbered, scatters_of
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.context import DataSet, DiagnosisContext
from mcsim.diagnosis.naming import slices_of
from mcsim.diagnosis.refine import Refined, Refiner
from mcsim.diagnosis.selection import Attribution
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.support.arrays import Matrix, Vector


def with_rivals(data: DataSet[Any], refined: Refined, found: Attribution) -> tuple[DataSet[Any], Refined] | None:
    """Return data and attribution with the effects on request that explain the data like the only set to be named.

    None if there are several sets, or no such effects.

    Notes
    -----
    As a candidate each of them would raise the bar for all. Here it becomes a candidate for these data alone, and only
    if it can take the place of a member, in the data vector and in the numbers beside it. Global p-values stay those of
    the candidates that are always proposed. It is simulated at the amplitude that it has there, as a member was.
    Patterns that are drawn are no rivals.
    """
    context = data.context
    if len(found.explanations) != 1:
        return None
    channels = {context.candidates[member].channel for member in found.explanations[0].members}
    others = [one for one in on_request(context.analysis) if not one.random_response]
    near = [one for one in others if one.channel in channels or None in (one.channel, *channels)]
    known = list(data.responses(near, context.settings.channel_skies))
    null, z, t = _widest(data, refined, found.explanations[0].members)
    wide = replace(refined, attribution=found, templates=t)
    places = list(in_place(null, z, wide, known, context.settings))
    if not places:
        return None
    data = replace(data, context=with_candidates(context, [known[rival] for rival, _ in places]))
    added = data.context.templates[:, context.templates.shape[1] :]
    candidates = (*refined.candidates, *data.context.candidates[len(context.candidates) :])
    members = found.explanations[0].members
    sets = [
        (*(one for one in members if one != member), len(context.candidates) + k)
        for k, (_, member) in enumerate(places)
    ]
    return data, Refiner(data).run(np.concatenate([refined.templates, added], axis=1), candidates, sets)


def _widest(data: DataSet[Any], refined: Refined, members: Sequence[int]) -> tuple[SimulatedGaussian, Vector, Matrix]:
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
    rivals: Sequence[tuple[Candidate, Matrix]],
    settings: DiagnosisSettings,
) -> Iterator[tuple[int, int]]:
    """Yield the indices of rivals, with their responses, that explain data in the place of a member of the only set.

    With each stands the member.

    Amplitudes are possible, and the likelihood is within ``odds_cut`` of that of the set, but for an error of the
    response that is tolerated (``consistency_error``). Data and templates are those of ``null``.
    """
    candidates, members = refined.candidates, refined.attribution.explanations[0].members
    whole = null.fit(z, refined.templates[:, columns_of(candidates, members)])
    least = float(null.log_likelihood(whole.chi2)) - np.log(settings.odds_cut)
    for index, (rival, response) in enumerate(rivals):
        every = numbered([*candidates, rival])
        t = np.concatenate([refined.templates, response[: len(z)]], axis=1)
        for member in members:
            changed = (*(one for one in members if one != member), len(candidates))
            columns = columns_of(every, changed)
            fit = null.fit(z, t[:, columns])
            wrong = settings.consistency_error * null.expected_snr(t[:, columns] @ fit.amplitudes)
            if null.log_likelihood(fit.chi2) + 0.5 * wrong**2 >= least and np.isfinite(beyond(every, changed, fit)):
                yield index, member
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
