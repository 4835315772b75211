"""Plan and run the simulations that a diagnosis needs, and turn them into a null ensemble and templates."""

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cache
from itertools import starmap
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.datavector.analysis import Analysis, Job, data_vectors
from mcsim.datavector.bipolar_scan import rms
from mcsim.datavector.candidate import TemplateBank, numbered, signal_share
from mcsim.datavector.kept import Kept
from mcsim.datavector.null_ensemble import NullEnsemble, without_nuisances
from mcsim.datavector.repeats import check_alike, check_distinct, check_fresh
from mcsim.datavector.responses import responses, scaled, size_error, skies, steps
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.summaries import pair_classes
from mcsim.ensemble import runner
from mcsim.ensemble.external_maps import Source
from mcsim.errors import InputError
from mcsim.simulation.nuisance import draws
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.stats.shrinkage import shrunk
from mcsim.support.arrays import Alm, Cl, Matrix, Vector
from mcsim.support.progress import reporting

Rows = NDArray[np.float64]
Task = Callable[[Job], Rows]
Ask = Callable[[Sequence[Job]], list[Rows]]  #: return the results of jobs, in order; in this process or on a cluster

Batch = Callable[[Callable[..., Any], Iterable[tuple[Any, ...]]], Iterator[tuple[int, Any]]]
"""Call a function with tuples of arguments; yield (index, result) in the order of completion."""

LOOKED_AT = 500
"""Simulations from which on it is measured what their covariance is worth: of fewer the number scatters too much."""

LEAST, STEP = 1.25, 0.25  #: simulations per element at the first look, and between two at most

PER_TASK = 10
_CONSTRAINED_PER_TASK = 4

# The same seed is never used for two purposes, nor for the data of a run that counts from seed 0.
_COVARIANCE, _RESPONSE = (0x6D63 * 1_000 + stream for stream in (1, 2))


@contextmanager
def batch(workers: runner.Workers) -> Iterator[Batch]:
    """Open a cluster of ``workers`` processes at the first call; with 0 call in this process.

    ``workers`` may be the address of a running scheduler, which is called at once, or a client; InputError for others.
    """
    if workers != 0:
        runner.check_workers(workers)
    with ExitStack() as stack:
        if not isinstance(workers, int):
            workers = stack.enter_context(runner.connected(workers))

        @cache
        def client() -> Any:
            return stack.enter_context(runner.connected(workers))

        def call(function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
            if workers == 0:
                return enumerate(starmap(function, arguments))
            return runner.completed(client(), function, arguments)

        yield call


@contextmanager
def asking(
    call: Batch, quiet: bool, task: Task = data_vectors, stage: str = "simulations", kept: Kept | None = None
) -> Iterator[Ask]:
    """Give the function that runs jobs; all that it runs is one stage of the progress.

    What is ``kept`` of an earlier call is not simulated again.
    """
    done = 0.0
    with reporting(stage, 0.0, "skies", quiet) as report:

        def ask(jobs: Sequence[Job]) -> list[Rows]:
            nonlocal done
            held: list[dict[int, Rows]] = [{} if kept is None else kept.found(job) for job in jobs]
            pieces = [
                (known, piece)
                for job, known in zip(jobs, held, strict=True)
                for piece in ([job] if kept is None else kept.missing(job, known))
            ]
            # Jobs of the same skies follow each other: what no effect changes is then made once for all of them.
            pieces.sort(key=lambda pair: pair[1].first)
            total = sum(job.count for job in jobs)
            report.expect(float(total))
            done += total - sum(piece.count for _, piece in pieces)
            report(done)
            for index, result in call(task, ((piece,) for _, piece in pieces)):
                known, piece = pieces[index]
                known.update(zip(range(piece.first, piece.first + piece.count), result, strict=True))
                if kept is not None:
                    kept.keep(piece, result)
                done += piece.count
                report(done)
            rows = zip(jobs, held, strict=True)
            return [np.stack([known[n] for n in range(job.first, job.first + job.count)]) for job, known in rows]

        yield ask


class Purpose(NamedTuple):
    """Say what a job is for; ``number`` is its first realization, or the column of a response of this sign."""

    kind: Literal["time-ordered", "default", "null", "reference", "external reference", "response"]
    number: int
    sign: int = 0


def plan(analysis: Analysis, simulations: int | None = None, time_ordered: bool = True) -> dict[Purpose, Job]:
    """Return all jobs from which :func:`learned` estimates null ensemble and templates.

    ``simulations`` for the covariance are by default what every element of the data vector needs (:func:`_needed`), or
    what is stored of an external ensemble. The default route is compared with the time-ordered reference if
    that is wanted, and every channel's pointing is known.
    """
    settings, run = analysis.settings, analysis.run
    wanted = _needed(settings, len(analysis.elements)) if simulations is None else simulations
    if analysis.source is not None and analysis.source.count is not None:
        wanted = min(wanted, analysis.source.count)
    base = seeded(run, _RESPONSE)
    jobs: dict[Purpose, Job] = {}
    known = all(channel.site.pointing is not None for channel in analysis.model.survey.channels)
    if time_ordered and analysis.of_maps and known:
        quiet = replace(base.unfiltered(), channels=tuple(c.without_noise() for c in base.channels))
        for job in in_tasks(analysis.job(quiet), range(scaled(analysis, settings.time_ordered_skies)), 1):
            jobs[Purpose("time-ordered", job.first)] = replace(job, sample_by_sample=True)
            jobs[Purpose("default", job.first)] = job
    for job in null_jobs(analysis, wanted):
        drawn = replace(job, bipolar_scan=job.first < settings.scan_sims)
        jobs[Purpose("null", job.first)] = replace(drawn, source=analysis.source)
    own = analysis.source_of(())
    for job in in_tasks(analysis.job(base), range(settings.noisy_skies)):
        jobs[Purpose("reference", job.first)] = job
        if own is not None:
            jobs[Purpose("external reference", job.first)] = replace(job, source=own)
    for candidate, column, sign, effect in steps(analysis):
        table = candidate.table(effect)
        acting = replace(analysis.job(with_effects(base, [table])), source=analysis.source_of([table]))
        if count := skies(analysis, candidate, sign):
            jobs[Purpose("response", column, sign)] = replace(acting, count=count)
    return {purpose: replace(job, slices=analysis.of_maps) for purpose, job in jobs.items()}


def null_jobs(analysis: Analysis, count: int, found: Sequence[config.Effect] = ()) -> list[Job]:
    """List jobs of as many simulations of the model for the covariance by mcsim, with effects on request."""
    job = analysis.job(with_effects(seeded(analysis.run, _COVARIANCE), found))
    return in_tasks(replace(job, nuisances=bool(analysis.run.nuisances), slices=analysis.of_maps), range(count))


def check_count(analysis: Analysis, simulations: int | None) -> None:
    """Raise InputError for a number of simulations, or of stored realizations, that cannot be enough for a covariance.

    How many are enough is known once some say how many elements are independent.
    """
    size, settings, source = len(analysis.elements), analysis.settings, analysis.source
    stored = None if source is None else source.count
    if simulations is not None and simulations <= size:
        raise InputError(
            f"{simulations} simulations are too few for the {size} elements of the data vector; give more than {size}, "
            f"better {settings.without_shrinkage().sims_per_element * size}."
        )
    if stored is not None and simulations is not None and stored < simulations:
        raise InputError(f"{simulations} simulations are asked for, but {stored} are stored; ask for as many at most.")
    if source is not None and stored is not None and stored <= size and simulations is None:
        raise InputError(
            f"{stored} realizations of {source.label} are too few for a data vector of {size} elements; give more than "
            f"{size}, {settings.sims_per_element} for each independent one, or leave effects out (--without)."
        )


def check_data(x: Vector, ensemble: NullEnsemble, source: Source) -> None:
    """Raise InputError if data, shape (p,), are a realization of an external simulator that they are tested with."""
    check_fresh(x, ensemble.simulations, source, _COVARIANCE)


def is_of_the_model(job: Job) -> bool:
    """Return True for simulations of the model for its covariance."""
    return config.from_json(job.simulated).ensemble.seed == _COVARIANCE


def in_tasks(job: Job, realizations: range, size: int = PER_TASK) -> list[Job]:
    """Return jobs of at most ``size`` of these realizations each."""
    stop = realizations.stop
    return [replace(job, first=first, count=min(size, stop - first)) for first in range(realizations.start, stop, size)]


def learned(
    analysis: Analysis, ask: Ask, simulations: int | None = None, time_ordered: bool = True
) -> tuple[NullEnsemble, TemplateBank]:
    """Simulate the model, and the same skies with every candidate: return null ensemble and templates.

    Arguments are those of :func:`plan`; some elements are redundant, and by default the first simulations tell how
    many are independent, and so how many simulations are needed.
    """
    size, jobs = len(analysis.elements), plan(analysis, simulations, time_ordered)
    whole = size + len(analysis.slices)
    results = _results(analysis, jobs, ask, simulations is None)

    def stacked(kind: str) -> Rows:
        rows = [result[:, :whole] for purpose, result in results.items() if purpose.kind == kind]
        return np.concatenate(rows) if rows else np.zeros((0, whole))

    null, references = stacked("null"), {False: stacked("reference"), True: stacked("external reference")}
    if analysis.source is not None:
        check_distinct(null[:, :size], analysis.source, _COVARIANCE)
        check_alike(null[:, :size], analysis.source, _COVARIANCE)
    labels = tuple(label for candidate in analysis.candidates for label in candidate.labels)
    offset = np.zeros(whole)
    if analysis.of_maps and len(default := stacked("default")):
        offset = np.mean(stacked("time-ordered") - default, axis=0)
    # Behind all these come bipolar scan and coarse residuals; measured spectra have neither.
    rest = np.concatenate([results[purpose][:, whole:] for purpose in results if jobs[purpose].bipolar_scan])
    numbers = len(analysis.bipolar_scan.elements) if analysis.of_maps else 0
    coarse = rest[:, numbers:].reshape(len(rest), len(analysis.model.parts), -1)
    reference, own_offset = references[False], None
    if analysis.source is not None:
        # The mean is that of the external simulations, whatever mcsim's routes differ by.
        own_offset, offset = offset[:size], np.zeros(whole)
    vectors = null[:, :size], offset[:size], analysis.elements, reference[:, :size]
    residuals = coarse.mean(axis=0), coarse.std(axis=0, ddof=1), rms(coarse)
    ensemble = NullEnsemble(
        *vectors,
        rest[:, :numbers],
        *residuals,
        redundant=analysis.settings.redundant,
        shrunk=analysis.settings.shrinks(simulations),
        external_reference=None if analysis.source is None else references[True],
        own_offset=own_offset,
        nuisances=_nuisances(analysis, len(null)),
        slices=null[:, size:],
        slice_offset=offset[size:],
        slice_reference=reference[:, size:],
        slice_elements=analysis.slices,
    )
    measured = _measured(analysis, jobs, ask, results, references, ensemble.gaussian.whitening)
    matrix, curvature, error = np.zeros((3, whole, len(labels)))
    share, number = np.ones((2, len(labels)))
    for column, (each, bend) in measured.items():
        matrix[:, column], curvature[:, column], number[column] = each.mean(axis=0), bend, len(each)
        error[:, column] = each.std(axis=0, ddof=1) / np.sqrt(len(each))
    bank = TemplateBank(matrix[:size], error[:size], curvature[:size], labels, share, number, matrix[size:])
    faint = bank.faint(ensemble.spread, analysis.settings)
    for column in np.flatnonzero(faint.any(axis=0)).tolist():
        share[column] = signal_share(measured[column][0][:, :size], faint[:, column], ensemble.gaussian.whitening)
    return ensemble, bank


def _measured(
    analysis: Analysis,
    jobs: Mapping[Purpose, Job],
    ask: Ask,
    results: Mapping[Purpose, Rows],
    references: Mapping[bool, Rows],
    whitening: Matrix,
) -> dict[int, tuple[Rows, Vector]]:
    """Return response in each sky, (skies, p + E), and curvature of every column, of as many skies as its size needs.

    ``references``: the same skies without effects, of mcsim (False) and of an external simulator.
    """
    settings, here, found = analysis.settings, dict(results), dict[int, tuple[Rows, Vector]]()
    while True:
        more: dict[Purpose, Job] = {}
        for candidate, column, sign, effect in steps(analysis):
            purpose, other = Purpose("response", column, sign), here.get(Purpose("response", column, -sign))
            if sign < 0 and other is not None:
                continue  # done with the other sign
            rows, job = here[purpose], jobs[purpose]
            step = candidate.parametrization.coordinates(effect)[candidate.columns.index(column)]
            found[column] = responses(step, rows, other, references[job.source is not None][: len(rows)])
            each, count = found[column][0][:, : whitening.shape[1]], min(2 * len(rows), settings.noisy_skies)
            single = analysis.of_maps and candidate.channel is not None
            if single and count > len(rows) and size_error(each, whitening) > settings.response_error:
                more[purpose] = replace(job, first=len(rows), count=count - len(rows))
        if not more:
            return found
        for purpose, rows in zip(more, ask(list(more.values())), strict=True):
            here[purpose] = np.concatenate([here[purpose], rows])


def reduced(
    analysis: Analysis, ensemble: NullEnsemble, bank: TemplateBank, names: Collection[str]
) -> tuple[Analysis, NullEnsemble, TemplateBank, NDArray[np.int64]]:
    """Leave effects out of what is :func:`learned` without learning anything again.

    Their candidates, the columns of their templates and the elements that are matched filters of them go. An element
    does not depend on the others, so the rest is what ``mcsim diagnose --without`` learns from the same simulations.
    The last array holds the elements of the full data vector that are kept.
    """
    kept = [candidate for candidate in analysis.candidates if candidate.name not in names]
    blocks = tuple(block for block in analysis.blocks if all(one.candidate not in names for one in block.elements))
    rows = np.flatnonzero([element.candidate not in names for element in analysis.elements])
    columns = [column for column, label in enumerate(bank.labels) if label.effect not in names]
    without = tuple(sorted({*analysis.without, *names}))
    fewer = replace(analysis, candidates=numbered(kept), blocks=blocks, without=without)
    return fewer, ensemble.restrict(rows), bank.subset(rows, columns), rows


def _results(analysis: Analysis, jobs: dict[Purpose, Job], ask: Ask, pilot: bool) -> dict[Purpose, Rows]:
    """Run jobs; after a pilot, only as many simulations of the model as the independent elements need."""

    def run(wanted: Sequence[Purpose]) -> dict[Purpose, Rows]:
        return dict(zip(wanted, ask([jobs[purpose] for purpose in wanted]), strict=True))

    if not pilot:
        return run(list(jobs))
    size, settings = len(analysis.elements), analysis.settings
    few, source = settings.pilot_sims_per_element * size, analysis.source
    stored = None if source is None else source.count
    ends_early = settings.shrinks(None) and stored is None
    if ends_early:
        few = min(few, max(LOOKED_AT, math.ceil(LEAST * size)))
    # What is needed in any case keeps workers busy to the end of the pilot; external simulations wait for its verdict.
    found = run([one for one in jobs if (one.number < few if one.kind == "null" else source is None)])
    drawn = _drawn(found, size)
    if source is not None:
        check_distinct(drawn, source, _COVARIANCE)
    quiet = without_nuisances(drawn, _nuisances(analysis, len(drawn)))
    independent = SimulatedGaussian.from_simulations(quiet, floor=settings.redundant).dimension
    enough = _needed(settings, independent)
    if source is not None and stored is not None and stored < settings.sims_per_element * independent:
        raise _too_few(source, independent, settings.sims_per_element)
    if ends_early and few >= LOOKED_AT:
        wanted = settings.worth_per_element * independent
        while few < enough and (worth := _worth(analysis, drawn)) < wanted:
            # About as many as lack if each is worth the same, but a task at least.
            few += math.ceil(min(STEP * independent, max(few * (wanted / worth - 1.0), PER_TASK)))
            found |= run([one for one in jobs if one not in found and one.kind == "null" and one.number < few])
            drawn = _drawn(found, size)
        enough = min(few, enough)
    found |= run([one for one in jobs if one not in found and (one.kind != "null" or one.number < enough)])
    return {purpose: found[purpose] for purpose in jobs if purpose in found}


def _drawn(found: Mapping[Purpose, Rows], size: int) -> Rows:
    """Return the data vectors of simulations of the model, shape (N, p)."""
    return np.concatenate([result[:, :size] for purpose, result in found.items() if purpose.kind == "null"])


def _worth(analysis: Analysis, drawn: Rows) -> int:
    """Return how many simulations of a sample covariance the shrunk one of some is worth."""
    return shrunk(drawn, analysis.settings.redundant, pair_classes(analysis.elements)).dof


def _needed(settings: DiagnosisSettings, elements: int) -> int:
    """Return the number of simulations that a covariance of so many elements, and the bipolar scan, need."""
    return max(settings.sims_per_element * elements, settings.scan_sims)


def _too_few(source: Source, independent: int, each: int) -> InputError:
    return InputError(
        f"{source.count} realizations of {source.label} are too few for a data vector of {independent} independent "
        f"elements; give {each * independent}, {each} for each, leave effects out (--without), or take the covariance "
        f"of this sample (--simulations {source.count}), which keeps less of every signal-to-noise ratio."
    )


def _nuisances(analysis: Analysis, count: int) -> Rows | None:
    """Return the coordinates of the nuisances that the first simulations of the model draw, shape (count, k)."""
    if not analysis.nuisances:
        return None
    return np.stack([draws(analysis.nuisances, _COVARIANCE, realization)[0] for realization in range(count)])


def after_jobs(analysis: Analysis, found: Sequence[config.Effect], skies: range | int | None = None) -> list[Job]:
    """List two jobs that simulate the model with effects, over the skies with which responses are measured."""
    if not isinstance(skies, range):
        skies = range(analysis.settings.noisy_skies if skies is None else skies)
    job = replace(_with(analysis, found), source=analysis.source_of(found))
    return in_tasks(job, skies, -(-len(skies) // 2))


def constrained_jobs(
    analysis: Analysis, found: Sequence[config.Effect], observed: Alm, realizations: range, spread: Cl | None = None
) -> list[Job]:
    """List jobs that simulate the model with effects, over skies that an observed one constrains, with this spread."""
    own = replace(_with(analysis, found), observed=observed, spread=spread)
    return in_tasks(own, realizations, _CONSTRAINED_PER_TASK)


def _with(analysis: Analysis, found: Sequence[config.Effect]) -> Job:
    return analysis.job(with_effects(seeded(analysis.run, _RESPONSE), found))


def without_repeats(noise: Sequence[config.Effect], found: Sequence[config.Effect]) -> Sequence[config.Effect]:
    """Return noise effects that act in all simulations; () if effects that are simulated say what they are."""
    own = {(one.name, one.channel) for one in found}
    return () if any((one.name, one.channel) in own for one in noise) else noise


def with_effects(run: config.RunConfig, found: Sequence[config.Effect]) -> config.RunConfig:
    """Return the run with further effects."""
    return replace(run, effects=(*run.effects, *found))


def seeded(run: config.RunConfig, seed: int) -> config.RunConfig:
    """Return the run with another seed."""
    return replace(run, ensemble=replace(run.ensemble, seed=seed))
