"""Learn a model once and hold it in every worker: simulate effects in it and diagnose cases with it."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.benchmark.folder import Settings
from mcsim.benchmark.library import Library, reduced
from mcsim.benchmark.out_of_library import library_with
from mcsim.diagnosis.analysis import Job, analysis_of, data_vectors
from mcsim.diagnosis.api import prepared
from mcsim.diagnosis.batch import Batch, asking, batch
from mcsim.diagnosis.campaign import after_jobs, seeded, with_effects
from mcsim.diagnosis.context import DiagnosisContext, context
from mcsim.diagnosis.inference import diagnose_data
from mcsim.diagnosis.observed_maps import ObservedMaps, read_maps
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.diagnosis.settings import DiagnosisSettings
from mcsim.errors import RunError
from mcsim.support.progress import reporting

__all__ = ["Batch", "LearnedModel", "each_case", "learned_model", "simulated", "workers_of"]

Vector = NDArray[np.float64]

SKIES = 6
"""Skies that an expected S/N is the mean of."""

SKIES_OUT_OF_LIBRARY = 2
"""Skies that the response to an out-of-library effect is the mean of."""


@dataclass(frozen=True, eq=False)
class LearnedModel:
    """What every case of a model is diagnosed with, and the elements of the full data vector that this uses."""

    context: DiagnosisContext
    rows: NDArray[np.int64]

    @cached_property
    def library(self) -> Library:
        """Candidates and their templates."""
        return Library.of(self.context)

    def simulate(self, jobs: Sequence[Job]) -> list[Vector]:
        """Return the data vectors of simulations that are made in this process."""
        return [data_vectors(replace(job, without=()))[:, self.rows] for job in jobs]

    def diagnose(self, case: str, folder: Path) -> DiagnosisResult:
        """Diagnose the maps in a folder."""
        maps = read_maps(self.context.analysis.model, folder)
        return diagnose_data(ObservedMaps(self.context, maps, self.simulate), case)

    def expected_snr(self, effect: config.Effect) -> float:
        """Return the expected S/N of the mean response to an effect.

        The mean is split into two halves of the skies, so that their noise does not count as signal.
        """
        null, reference, start, halves = self.library.null, self.context.ensemble.reference, 0, []
        for after in self.simulate(after_jobs(self.context.run, self.context.analysis, [effect], SKIES)):
            change = (after - reference[start : start + len(after)]).mean(axis=0)
            halves.append(null.whiten_templates(change[:, None])[:, 0])
            start += len(after)
        return float(np.sqrt(max(null.hartlap_factor * float(halves[0] @ halves[1]), 0.0)))

    def expected_snr_on_sky(self, effect: config.Effect, seed: int) -> float:
        """Return the expected S/N of the response to an effect in the sky and noise of one seed."""
        run = seeded(self.context.run, seed)
        fiducial = config.to_json(self.context.run)
        runs = (config.to_json(with_effects(run, effects)) for effects in ((), (effect,)))
        jobs = [Job(fiducial, one, 0, 1, settings=self.context.settings) for one in runs]
        before, after = self.simulate(jobs)
        return self.library.null.expected_snr(after[0] - before[0])


@contextmanager
def workers_of(settings: Settings, workers: int | None, quiet: bool) -> Iterator[Batch]:
    """Start workers for as long as the block lasts, and learn the model with them if it is not in the cache.

    Parameters
    ----------
    settings
        Of the challenge.
    workers
        Number of processes; None: the model's; 0: this process.
    quiet
        Report no progress.
    """
    run = settings.model
    with batch(run.compute.workers if workers is None else workers) as call:
        with asking(call, quiet) as ask:
            prepared(run, analysis_of(run, settings=DiagnosisSettings(simulations=settings.simulations)), ask)
        yield call


def each_case(call: Batch, task: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], quiet: bool) -> None:
    """Run a task for every case, in any order, and report progress."""
    with reporting("cases", float(len(arguments)), "cases", quiet) as report:
        for done, _ in enumerate(call(task, arguments)):
            report(float(done + 1))


def learned_model(settings: Settings, without: tuple[str, ...] = ()) -> LearnedModel:
    """Return a model that was learned before, without some effects; RunError if it is not in the cache."""
    return _without(config.to_json(settings.model), settings.simulations, without)


@lru_cache(maxsize=1)
def _full(model: str, simulations: int | None) -> LearnedModel:
    run = config.from_json(model)
    found = prepared(run, analysis_of(run, settings=DiagnosisSettings(simulations=simulations)), _refuse)
    return LearnedModel(found, np.arange(len(found.analysis.elements)))


@lru_cache(maxsize=2)
def _without(model: str, simulations: int | None, names: tuple[str, ...]) -> LearnedModel:
    full = _full(model, simulations)
    if not names:
        return full
    analysis, ensemble, bank, rows = reduced(full.context, names)
    return LearnedModel(context(full.context.run, analysis, ensemble, bank), rows)


def _refuse(jobs: Sequence[Job]) -> list[Vector]:
    raise RunError("the simulations of the model are not in the cache of this worker; let all workers share one cache.")


def simulated(run: config.RunConfig, added: Iterable[Sequence[config.Effect]], file: str, call: Batch) -> list[Vector]:
    """Return the mean noiseless data vector of a run with each set of effects, made sample by sample.

    Parameters
    ----------
    run
        Fiducial run.
    added
        Sets of effects, of the library or of the file.
    file
        Python file with out-of-library effects.
    call
        Runs the simulations.
    """
    quiet = replace(run, channels=tuple(replace(channel, noise=config.Noise()) for channel in run.channels))
    rest = 0, SKIES_OUT_OF_LIBRARY, True
    fiducial = config.to_json(run)
    jobs = [Job(fiducial, config.to_json(with_effects(quiet, effects)), *rest) for effects in added]
    answers = dict(call(_data_vectors_with, [(job, file) for job in jobs]))
    return [answers[index].mean(axis=0) for index in range(len(jobs))]


def _data_vectors_with(job: Job, file: str) -> Vector:
    return data_vectors(job, library_with(file))
