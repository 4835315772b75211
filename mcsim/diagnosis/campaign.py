"""Plan the simulations that a diagnosis needs, and turn them into a null ensemble and templates."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.diagnosis.analysis import Analysis, Job
from mcsim.diagnosis.candidate import Candidate
from mcsim.diagnosis.null_ensemble import NullEnsemble
from mcsim.diagnosis.residual_maps import rms
from mcsim.diagnosis.settings import DiagnosisSettings
from mcsim.diagnosis.templates import TemplateBank
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.systematics import Effect

Ask = Callable[[Sequence[Job]], list[NDArray[np.float64]]]
"""Return the results of jobs, in order; in this process or on a cluster."""

_PER_TASK = 10
_CONSTRAINED_PER_TASK = 4

# The same seed is never used for two purposes, nor for the data of a run that counts from seed 0.
_COVARIANCE, _RESPONSE = (0x6D63 * 1_000 + stream for stream in (1, 2))


@dataclass(frozen=True)
class Plan:
    """List jobs and their purposes; the result of each is an array (count, p)."""

    jobs: tuple[Job, ...]
    purposes: tuple[tuple[Any, ...], ...]


def plan(run: config.RunConfig, analysis: Analysis, simulations: int | None = None, time_ordered: bool = True) -> Plan:
    """List all simulations from which :func:`learned` estimates null ensemble and templates.

    Parameters
    ----------
    run, analysis
        Fiducial model and its analysis.
    simulations
        Number for the covariance; default: ``settings.sims_per_element`` for every element of the data vector, of
        which :func:`simulated` leaves some out.
    time_ordered
        Compare with the time-ordered reference if every channel's pointing is known.
    """
    settings, fiducial = analysis.settings, config.to_json(run)
    wanted = settings.sims_per_element * len(analysis.elements) if simulations is None else simulations
    jobs, purposes = [], []

    def add(purpose: tuple[Any, ...], simulated: config.RunConfig, first: int, count: int) -> None:
        job = Job(fiducial, config.to_json(simulated), first, count, purpose[0] == "time-ordered", analysis.without)
        scanned = purpose[0] == "null" and first < settings.scan_sims
        jobs.append(replace(job, bipolar_scan=scanned, settings=settings))
        purposes.append(purpose)

    base = seeded(run, _RESPONSE)
    if time_ordered and all(c.site.pointing is not None for c in analysis.model.survey.channels):
        quiet = replace(base, channels=tuple(replace(c, noise=config.Noise()) for c in base.channels))
        for sky in range(settings.time_ordered_skies):
            add(("time-ordered", sky), quiet, sky, 1)
            add(("default", sky), quiet, sky, 1)
    for first in range(0, wanted, _PER_TASK):
        add(("null", first), seeded(run, _COVARIANCE), first, min(_PER_TASK, wanted - first))
    for first in range(0, settings.noisy_skies, _PER_TASK):
        add(("reference", first), base, first, min(_PER_TASK, settings.noisy_skies - first))
    for candidate, column, sign, effect in _steps(analysis):
        count = skies(candidate, analysis.model.lmax, settings)
        add(("response", column, sign), with_effects(base, [candidate.table(effect)]), 0, count)
    return Plan(tuple(jobs), tuple(purposes))


def simulated(plan: Plan, analysis: Analysis, ask: Ask) -> tuple[Plan, list[NDArray[np.float64]]]:
    """Run those jobs of a plan that are needed, and return them with their results.

    Some elements are redundant: the first simulations tell how many are independent, and so how many simulations are
    needed.
    """
    size, settings = len(analysis.elements), analysis.settings
    pilot = settings.pilot_sims_per_element * size
    first = [k for k, job in enumerate(plan.jobs) if plan.purposes[k][0] == "null" and job.first < pilot]
    results = dict(zip(first, ask([plan.jobs[k] for k in first]), strict=True))
    drawn = np.concatenate([result[:, :size] for result in results.values()])
    independent = SimulatedGaussian.from_simulations(drawn, floor=settings.redundant).dimension
    rest = [
        k
        for k, job in enumerate(plan.jobs)
        if k not in results and (plan.purposes[k][0] != "null" or job.first < settings.sims_per_element * independent)
    ]
    results |= zip(rest, ask([plan.jobs[k] for k in rest]), strict=True)
    kept = sorted(results)
    needed = Plan(tuple(plan.jobs[k] for k in kept), tuple(plan.purposes[k] for k in kept))
    return needed, [results[k] for k in kept]


def learned(
    analysis: Analysis, plan: Plan, results: Sequence[NDArray[np.float64]]
) -> tuple[NullEnsemble, TemplateBank]:
    """Return the null ensemble and the templates that the results of a plan make up.

    A template is [x(+step) - x(-step)]/(2 step), of the same skies; if the effect has one sign, [x(step) - x(0)]/step.
    """
    size = len(analysis.elements)
    by_purpose = dict(zip(plan.purposes, results, strict=True))

    def stacked(kind: str) -> NDArray[np.float64]:
        rows = [by_purpose[purpose][:, :size] for purpose in plan.purposes if purpose[0] == kind]
        return np.concatenate(rows) if rows else np.zeros((0, size))

    reference = stacked("reference")
    shape = (size, sum(len(candidate.columns) for candidate in analysis.candidates))
    matrix, curvature, error = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for candidate, column, sign, effect in _steps(analysis):
        other = by_purpose.get(("response", column, -sign))
        if sign < 0 and other is not None:
            continue  # done with the other sign
        here = by_purpose["response", column, sign]
        step = effect.parametrization.coordinates(effect)[candidate.columns.index(column)]
        same = reference[: len(here)]
        if other is None:
            each = (here - same) / step
        else:
            each = (here - other) / (2.0 * step)
            curvature[:, column] = np.mean(here + other - 2.0 * same, axis=0) / (2.0 * step**2)
        matrix[:, column] = each.mean(axis=0)
        error[:, column] = each.std(axis=0, ddof=1) / np.sqrt(len(each))
    time_ordered, default = stacked("time-ordered"), stacked("default")
    offset = np.mean(time_ordered - default, axis=0) if len(time_ordered) else np.zeros(size)
    rest = [result[:, size:] for job, result in zip(plan.jobs, results, strict=True) if job.bipolar_scan]
    scan, coarse = _scanned(analysis, np.concatenate(rest))
    ensemble = NullEnsemble(
        stacked("null"),
        offset,
        analysis.elements,
        reference,
        scan,
        coarse.mean(axis=0),
        coarse.std(axis=0, ddof=1),
        rms(coarse),
        analysis.settings.redundant,
    )
    return ensemble, TemplateBank(matrix, error, curvature)


def _scanned(analysis: Analysis, rows: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Split what follows the data vectors into bipolar scan, shape (n, numbers), and coarse residuals, (n, map, npix).

    Measured spectra have neither.
    """
    numbers = len(analysis.bipolar_scan.elements) if rows.shape[1] else 0
    return rows[:, :numbers], rows[:, numbers:].reshape(len(rows), len(analysis.model.parts), -1)


def after_jobs(
    run: config.RunConfig, analysis: Analysis, found: Sequence[config.Effect], skies: int | None = None
) -> list[Job]:
    """List two jobs that simulate the model with effects, over the skies with which responses are measured."""
    total = analysis.settings.noisy_skies if skies is None else skies
    half = -(-total // 2)
    job = _job(run, analysis, found)
    return [replace(job, first=first, count=min(half, total - first)) for first in (0, half)]


def constrained_jobs(
    run: config.RunConfig,
    analysis: Analysis,
    found: Sequence[config.Effect],
    observed: NDArray[np.complex128],
    realizations: range,
) -> list[Job]:
    """List jobs that simulate the model with effects, over skies that are constrained by an observed one."""
    job = replace(_job(run, analysis, found), observed=observed)
    return [
        replace(job, first=first, count=min(_CONSTRAINED_PER_TASK, realizations.stop - first))
        for first in range(realizations.start, realizations.stop, _CONSTRAINED_PER_TASK)
    ]


def _job(run: config.RunConfig, analysis: Analysis, found: Sequence[config.Effect]) -> Job:
    changed = config.to_json(with_effects(seeded(run, _RESPONSE), found))
    return Job(config.to_json(run), changed, 0, 0, without=analysis.without, settings=analysis.settings)


def _steps(analysis: Analysis) -> Iterator[tuple[Candidate, int, int, Effect]]:
    """Yield candidate, column, sign and effect of every response that is simulated."""
    for candidate in analysis.candidates:
        for column, effect in zip(candidate.columns, candidate.basis, strict=True):
            for sign in (1, -1):
                if candidate.effect.parametrization.sign in (0, sign):
                    yield candidate, column, sign, effect.scaled(sign)


def skies(candidate: Candidate, lmax: int, settings: DiagnosisSettings) -> int:
    """Return the number of skies over which the response to a candidate is averaged."""
    if candidate.random_response:
        return settings.noisy_skies
    fewest = settings.channel_skies
    if candidate.channel is None:
        fewest = settings.typical_skies if candidate.effect.parametrization.mean_response else settings.common_skies
    return min(max(fewest, -(-settings.response_modes // lmax**2)), settings.noisy_skies)


def with_effects(run: config.RunConfig, found: Sequence[config.Effect]) -> config.RunConfig:
    """Return the run with further effects."""
    return replace(run, effects=(*run.effects, *found))


def seeded(run: config.RunConfig, seed: int) -> config.RunConfig:
    """Return the run with another seed."""
    return replace(run, ensemble=replace(run.ensemble, seed=seed))
