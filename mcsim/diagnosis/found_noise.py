"""Test data with the scatter that they have with noise that was found, where it is far from the model's."""

from dataclasses import replace

import numpy as np

from mcsim import config
from mcsim.datavector.bent import bent_templates
from mcsim.datavector.campaign import after_jobs, null_jobs
from mcsim.datavector.candidate import columns_of, parts_of
from mcsim.diagnosis.context import DataSet, DiagnosisContext, context
from mcsim.diagnosis.refine import Refined, Refiner
from mcsim.stats.gaussian import Fit, SimulatedGaussian
from mcsim.support.arrays import Matrix
from mcsim.systematics import if_possible

STRONG = 1.0
"""Standard deviations of chi^2 by which noise moves its mean, from which on its scatter is simulated: with less, what
few skies tell of the scatter along each response suffices."""

ROUNDS = 3  #: of finding noise with the scatter of what was found before


def with_found_noise(data: DataSet, refined: Refined) -> tuple[DataSet, Refined]:
    """Return data and attribution with the scatter that data have with the noise that was found.

    They are those that are given if none was found that moves chi^2 by STRONG, if mcsim does not simulate the model,
    and beside places that stand out, which look like noise.

    Notes
    -----
    Strong noise hides what is faint beside it: tests of a residual and fits have the weights of the model's noise, and
    the skies that maps constrain are found with these. As many simulations as the model's have the noise; responses
    stay those from the model. The gap is tested as before.
    """
    model = data.context
    if refined.attribution.verdict == "none" or model.analysis.source is not None or data.bad_pixels([]):
        return data, refined
    for _ in range(ROUNDS):
        pair = None
        with if_possible():
            noise = _noise(data, refined)
            pair = data.pair(list(noise.values())) if noise else None
        if pair is None or _moved(data.context.null, data.context.ensemble.reference, pair[1]) < STRONG:
            break
        data = replace(data, context=_scattered(data, model, tuple(noise.values())))
        own, t = data.context, data.templates()
        start = bent_templates(own.null, data.x, t, own.bank.curvature, own.candidates)
        columns = columns_of(own.candidates, list(noise))
        start[:, columns] = refined.templates[:, columns]
        refined = Refiner(data).run(t, own.candidates, start=start)
    return data, refined


def in_words(context: DiagnosisContext) -> list[str]:
    """Return a sentence on the noise with whose scatter data are tested, if that is not the model's."""
    named = {(one.name, one.channel) for one in context.noise}
    titles = [one.title for one in context.candidates if one.identity in named]
    if not titles:
        return []
    number = len(context.ensemble.simulations)
    return [f"All but the gap is tested with the scatter of {number} simulations that have the {' and '.join(titles)}."]


def _scattered(data: DataSet, model: DiagnosisContext, noise: tuple[config.Effect, ...]) -> DiagnosisContext:
    """Return what data are tested with, with the scatter of simulations that have noise effects."""
    analysis, ensemble = model.analysis, model.ensemble
    simulations = data.ask(null_jobs(analysis, len(ensemble.simulations), noise))
    reference = data.ask([replace(job, slices=True) for job in after_jobs(analysis, noise)])
    ensemble = ensemble.scattered_as(np.concatenate(simulations), np.concatenate(reference))
    return replace(context(analysis, ensemble, model.bank), noise=noise, without_noise=model)


def _noise(data: DataSet, refined: Refined) -> dict[int, config.Effect]:
    """Return the noise effects of the best set, or else of what is detected, at their amplitudes, by their indices.

    Where there are none in what is detected, it is that which explains most beside it, if that is significant: what
    scatters more than the model says looks less significant than it is, until that is known.
    """
    candidates, found, null = refined.candidates, refined.attribution, data.context.null
    t, detected = refined.templates, refined.partial
    if found.explanations:
        members, fit = found.explanations[0].members, found.explanations[0].fit
    else:
        members, t = ((), t) if detected is None else (detected.members, detected.templates)

        def together(every: tuple[int, ...]) -> Fit:
            return null.fit(data.x, t[:, columns_of(candidates, every)])

        fit = together(members)
        noise = [index for index, one in enumerate(candidates) if one.parametrization.noise_alone]
        if noise and not set(noise) & set(members):
            beside = {(*members, index): together((*members, index)) for index in noise}
            best = min(beside, key=lambda every: beside[every].chi2)
            taken, columns = fit.chi2 - beside[best].chi2, len(candidates[best[-1]].columns)
            pvalue = null.nested_test(taken, fit.chi2, columns, len(fit.amplitudes))
            if data.context.calibration.global_pvalue(pvalue) <= data.context.settings.further_level:
                members, fit = best, beside[best]
    return {
        member: candidates[member].table(candidates[member].detected(theta, covariance))
        for member, theta, covariance in parts_of(candidates, members, fit)
        if candidates[member].parametrization.noise_alone
    }


def _moved(null: SimulatedGaussian, before: Matrix, after: Matrix) -> float:
    """Return by how much the mean of chi^2 moves, over its standard deviation.

    Data are those of the same skies without effects and with them, shape (skies, p_raw) each.
    """
    without, having = (null.whiten_templates(rows.T).var(axis=1, ddof=1).sum() for rows in (before, after))
    return float(abs(having - without) * null.hartlap_factor / np.sqrt(2.0 * null.dimension))
