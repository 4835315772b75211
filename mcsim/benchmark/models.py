"""Describe what cases are judged with: candidates and templates, and a model that is learned once per process."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.benchmark.case import Identity, Member
from mcsim.benchmark.folder import Settings
from mcsim.datavector.analysis import Job, analysis_of, data_vectors
from mcsim.datavector.campaign import Ask, Batch, after_jobs, asking, batch, in_tasks, reduced, seeded, with_effects
from mcsim.datavector.candidate import Candidate, columns_of, coordinates_of, effects_at
from mcsim.datavector.halves import Halves
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.api import kept, prepared
from mcsim.diagnosis.context import DiagnosisContext, context
from mcsim.diagnosis.subsets import Subsets
from mcsim.ensemble.runner import Workers
from mcsim.errors import RunError
from mcsim.sphere import rng
from mcsim.stats.excess import HeldOut
from mcsim.stats.gaussian import Fit, SimulatedGaussian, WhitenedTemplates
from mcsim.stats.look_elsewhere import Calibration
from mcsim.support.arrays import Matrix, Vector, divided
from mcsim.systematics import if_possible

SKIES = 6  #: skies that an expected S/N is the mean of


@dataclass(frozen=True, eq=False)
class EffectsLibrary:
    """Candidates of a diagnosis, their templates, and the noise model that they are tested with.

    ``null`` describes the data vector, of p_raw elements, without any effect; the templates are its response per unit
    coordinate, shape (p_raw, K); ``rows`` are the elements of the full data vector that it uses.
    """

    null: SimulatedGaussian
    templates: NDArray[np.float64]
    candidates: Sequence[Candidate]
    calibration: Calibration
    rows: NDArray[np.int64]

    @cached_property
    def groups(self) -> WhitenedTemplates:
        """Whitened templates, candidate by candidate."""
        return self.null.whiten_groups(self.templates, [candidate.columns for candidate in self.candidates])

    @property
    def identities(self) -> list[Identity]:
        """Name and channel of each candidate."""
        return [candidate.identity for candidate in self.candidates]

    def response(self, members: Iterable[Member]) -> Vector:
        """Return the change of the data vector by effects of this library or of none, shape (p_raw,)."""
        total = np.zeros(len(self.templates))
        for member in members:
            if member.candidate is None:
                total += np.array(member.response)
            else:
                columns = list(self.candidates[member.candidate].columns)
                total += self.templates[:, columns] @ np.array(member.coordinates)
        return total

    def cosines(self, response: Vector) -> Vector:
        """Return the cosine of a response, shape (p_raw,), with the span of each candidate, shape (candidates,)."""
        white = self.null.whiten_templates(response)
        return divided(np.sqrt(self.groups.delta_chi2(white)), np.linalg.norm(white))

    def distances(self, response: Vector) -> tuple[float, ...]:
        """Return the S/N that the best sets of one, two and three candidates leave of a response."""
        white = self.null.whiten_templates(response)
        search = Subsets(self.null, white, self.groups, self.candidates, self.calibration)
        each = [[search.solve(rows).chi2.min() for rows in search.rows(size)] for size in (1, 2, 3)]
        left = np.minimum.accumulate([min([search.total, *chi2]) for chi2 in each])
        return tuple(np.sqrt(self.null.hartlap_factor * np.maximum(left, 0.0)).tolist())


@dataclass(frozen=True, eq=False)
class LinearModel(EffectsLibrary):
    """A library whose responses are straight lines: simulated data vectors plus templates times coordinates.

    Its covariance does not know the simulations that serve as ``data`` without an effect, shape (n, p_raw). ``halves``
    are the two folds of the data vector; None: there are none.
    """

    halves: Halves | None
    data: NDArray[np.float64]

    def held_out_reduction(self, x: Vector, members: Sequence[int]) -> HeldOut | None:
        """Fit candidates to one half of a data vector, and predict and measure the reduction of the other's excess.

        None if there are no halves, or if an effect cannot have the fitted amplitude.
        """
        if self.halves is None:
            return None
        t = self.templates[:, columns_of(self.candidates, members)]

        def respond(frozen: Fit) -> Vector:
            effects = effects_at(self.candidates, members, frozen)
            return np.asarray(t @ coordinates_of(self.candidates, members, effects))

        with if_possible():
            return replace(self.halves, x=x).reduction(t, respond)
        return None


def linear_model(known: DiagnosisContext, without: Sequence[str] = (), fresh: Matrix | None = None) -> LinearModel:
    """Make the linear model of a diagnosis, without some effects.

    Its data are ``fresh`` simulations (:func:`simulated`), shape (n, p_raw of the full library), or a quarter of its
    own. Templates are exact here: neither their errors nor the scatter of stochastic effects play a part.
    """
    analysis, ensemble, bank, rows = reduced(known.analysis, known.ensemble, known.bank, without)
    kept = len(ensemble.simulations) - (len(ensemble.simulations) // 4 if fresh is None else 0)
    seen, rest = ensemble.first(kept), ensemble.simulations[kept:] if fresh is None else fresh[:, rows]
    candidates = tuple(replace(candidate, shape_error=None) for candidate in analysis.candidates)
    null, templates = seen.gaussian, bank.significant(ensemble.spread, known.settings)
    groups = null.whiten_groups(templates, [candidate.columns for candidate in candidates])
    halves, data = Halves.of(seen, np.zeros(len(templates))), rest + ensemble.offset
    return LinearModel(null, templates, candidates, seen.calibration(null, groups), rows, halves, data)


def simulated(known: DiagnosisContext, number: int, seed: int, ask: Ask) -> Matrix:
    """Simulate data vectors without effects that no covariance knows, shape (number, p_raw)."""
    run = seeded(known.run, int(rng.generator(seed, 0, "challenge/draws").integers(2**40, 2**62)))
    job = replace(known.analysis.job(run), nuisances=bool(run.nuisances))
    return np.concatenate(ask(in_tasks(job, range(number))))


@dataclass(frozen=True, eq=False)
class LearnedModel(EffectsLibrary):
    """A library with all that cases of a model are diagnosed with."""

    context: DiagnosisContext

    def simulate(self, jobs: Sequence[Job]) -> list[Vector]:
        """Return the data vectors of simulations that are made in this process."""
        beside = len(self.context.analysis.slices)
        found = [data_vectors(replace(job, without=())) for job in jobs]
        return [
            row[:, [*self.rows, *range(row.shape[1] - beside, row.shape[1])] if job.slices else self.rows]
            for job, row in zip(jobs, found, strict=True)
        ]

    def expected_snr(self, effect: config.Effect) -> float:
        """Return the expected S/N of the mean response, from two halves of the skies: noise is no part of it."""
        halves = self.simulate(after_jobs(self.context.analysis, [effect], SKIES))
        before = np.split(self.context.ensemble.reference[:SKIES], [len(halves[0])])
        changes = [(after - same).mean(axis=0) for after, same in zip(halves, before, strict=True)]
        first, second = (self.null.whiten_templates(change) for change in changes)
        return float(np.sqrt(max(self.null.hartlap_factor * float(first @ second), 0.0)))

    def expected_snr_on_sky(self, effect: config.Effect, seed: int) -> float:
        """Return the expected S/N of the response to an effect in the sky and noise of one seed."""
        run = seeded(self.context.run, seed)
        jobs = [replace(self.context.analysis.job(with_effects(run, one)), count=1) for one in ((), (effect,))]
        before, after = self.simulate(jobs)
        return self.null.expected_snr(after[0] - before[0])


def learned_model(settings: Settings, without: tuple[str, ...] = ()) -> LearnedModel:
    """Return a model that was learned before, without some effects; RunError if it is not in the cache."""
    return _learned(config.to_json(settings.model), _proposing(settings), without)


def _proposing(settings: Settings) -> DiagnosisSettings:
    return DiagnosisSettings(simulations=settings.simulations, including=settings.including)


@lru_cache(maxsize=3)
def _learned(model: str, settings: DiagnosisSettings, without: tuple[str, ...]) -> LearnedModel:
    if without:
        full = _learned(model, settings, ()).context
        analysis, ensemble, bank, rows = reduced(full.analysis, full.ensemble, full.bank, without)
        known = context(analysis, ensemble, bank)
    else:
        run = config.from_json(model)
        known = prepared(run, analysis_of(run, settings=settings), _refuse)
        rows = np.arange(len(known.analysis.elements))
    return LearnedModel(known.null, known.templates, known.candidates, known.calibration, rows, known)


def _refuse(jobs: Sequence[Job]) -> list[Vector]:
    raise RunError("the simulations of the model are not in the cache of this worker; let all workers share one cache.")


@contextmanager
def workers_of(settings: Settings, workers: Workers | None, quiet: bool) -> Iterator[Batch]:
    """Start processes for as long as the block lasts, and learn the model with them if it is not in the cache.

    ``workers`` None: as many as the model says; 0: this process. Or the address of a scheduler, or a client.
    """
    run = settings.model
    with batch(run.compute.workers if workers is None else workers) as call:
        analysis = analysis_of(run, settings=_proposing(settings))
        with asking(call, quiet, kept=kept(run, analysis)) as ask:
            prepared(run, analysis, ask)
        yield call
