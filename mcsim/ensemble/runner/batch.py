"""Run of an ensemble: make, continue or extend a store, compute what is missing, summarise."""

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from distributed import Client, KilledWorker

from mcsim import config
from mcsim.ensemble import plan, repair, store, summary
from mcsim.ensemble.layout import Layout, listed
from mcsim.ensemble.lock import holder, locked
from mcsim.ensemble.runner.cluster import LOST, Roll, Workers, answers, check_workers, connected, death
from mcsim.ensemble.tasks import Failure, Job, packages, realize_chunk, summarise_node
from mcsim.errors import RunError
from mcsim.simulation import power, simulate
from mcsim.simulation.channels import check_effects
from mcsim.simulation.survey import Survey, survey
from mcsim.stats import streaming
from mcsim.stats.streaming import Sums
from mcsim.support.progress import Journal, reporting


@dataclass(frozen=True)
class Result:
    """Result of a run: the store, its number of finished realizations, the number computed, the failures.

    ``summarised`` is True if the summary was made anew, for more realizations or other bins.
    """

    store: Path
    finished: int
    computed: int
    failures: tuple[Failure, ...]
    summarised: bool = False


def run(
    source: str | Path | dict[str, Any] | config.RunConfig,
    path: str | Path | None = None,
    *,
    resume: bool = False,
    realizations: slice | None = None,
    workers: Workers | None = None,
    quiet: bool = True,
) -> Result:
    """Run an ensemble, or continue or extend a stored one.

    Parameters
    ----------
    source
        Configuration: a TOML file, the name of a packaged workflow, a dict, or a loaded one.
    path
        Store; default ``{name}.zarr`` in the working folder.
    resume
        Require an existing store, check all of it first, and compute damaged realizations again.
    realizations
        Compute only these; :func:`mcsim.merge` joins such slices.
    workers
        Number of processes of a local cluster; default: the configuration's. Or the address of a running scheduler,
        ``tcp://host:port`` (or ``tls://``, with the keys that Dask's configuration names), whose workers share the file
        system; or an existing ``distributed.Client``, which is left open.
    quiet
        Report no progress on standard error.

    Raises
    ------
    InputError
        For bad input, an unwritable or foreign store, or a scheduler that does not answer. The store is unchanged.
    RunError
        If the disk is full, or scheduler or workers are lost. What is finished is stored: call it again to go on.

    Returns
    -------
    Result
        ``store``, the numbers of realizations ``finished`` in all and ``computed`` now, and the ``failures``.

    Examples
    --------
    >>> import mcsim
    >>> result = mcsim.run("tiny", "tiny.zarr")
    >>> result.finished
    32
    >>> mcsim.run("tiny", "tiny.zarr").computed  # all is there already
    0
    """
    if workers is not None:
        check_workers(workers)
    loaded = config.load(source)
    wanted = plan.wanted(loaded, realizations)
    target = plan.target(loaded, realizations, path)
    exists = plan.check_store(target, loaded, resume)
    if exists and not resume and plan.finished(target, loaded, wanted):
        store.check_whole(target)
        return Result(target, int(store.done(target).sum()), 0, ())
    store.check_writable(target)
    config.check_skies(loaded, wanted)
    check_effects(loaded)
    journal = Journal(target, quiet)
    with ExitStack() as stack:
        client = None
        if workers is not None and not isinstance(workers, int):
            client = stack.enter_context(connected(workers))
        with reporting("orientation moments", 1.0, "", quiet) as report:
            shared = survey(loaded, nthreads=os.cpu_count() or 1, progress=report)
        power.check(shared)
        if shared.filtering is not None:
            with reporting("normalisation of the filter", 1.0, "", quiet) as report:
                shared.filtering.fisher(report)
        # Bad sky files are found before a store is made.
        power.check_not_empty(shared, simulate.draw_sky(shared, wanted.start))
        if stack.enter_context(locked(target)):
            repair.sweep(target)
        stack.enter_context(_written_down(journal, loaded, wanted))
        if resume:
            _mend(target, shared, journal, quiet)
            if plan.finished(target, loaded, wanted):
                return Result(target, int(store.done(target).sum()), 0, ())
        if client is None:
            client = stack.enter_context(connected(workers or loaded.compute.workers))
        return _run(client, shared, target, wanted, journal)


@contextmanager
def _written_down(journal: Journal, run: config.RunConfig, wanted: range) -> Iterator[None]:
    """Log the start and the end of a run."""
    what = f"{run.name}, realizations {wanted.start} to {wanted.stop - 1}"
    journal.write(f"start: {what}, mcsim {dict(packages())['mcsim']}")
    try:
        yield
    except BaseException as error:
        journal.write(f"end: {type(error).__name__}: {error}")
        raise
    journal.write("end: store released")


def _attributes(shared: Survey) -> dict[str, Any]:
    """Return the attributes of a store; of filtered maps with the number of random probes that normalise them."""
    probes = {} if shared.filtering is None else {"probes": shared.filtering.drawn}
    return plan.attributes(shared.config) | probes


def _mend(target: Path, shared: Survey, journal: Journal, quiet: bool) -> None:
    verdict = repair.mend(target, plan.layout(shared), _attributes(shared), quiet)
    for damage in verdict.damages:
        if damage.lost:
            journal.write(f"damaged, to be computed again: {listed(damage.lost)} ({damage.reason})", aloud=True)
    for name, reason in verdict.broken.items():
        journal.write(f"damaged, made again: {name} ({reason})", aloud=True)


def _run(client: Client, shared: Survey, target: Path, wanted: range, journal: Journal) -> Result:
    """Make or extend the store, compute what is missing, summarise."""
    run, layout = shared.config, plan.layout(shared)
    if not target.exists():
        store.create(target, layout, _attributes(shared))
    plan.check_same(target, run)
    size, stored, own = store.size(target), store.attributes(target), _attributes(shared)
    found, extended = stored["configuration"], run.ensemble.realizations > size
    more = extended or not store.done(target, wanted.start, wanted.stop).all()
    update = plan.mixed(target, stored, own) if more else {}
    if extended:
        store.extend(target, run.ensemble.realizations, own | {"packages": stored["packages"]} | update)
    elif found["biposh"]["summary_bin"] != layout.bin_width:
        biposh = found["biposh"] | {"summary_bin": layout.bin_width}
        store.extend(target, size, {"configuration": found | {"biposh": biposh}} | update)
    elif update:
        store.extend(target, size, update)
    layout = replace(layout, realizations=store.size(target), chunk=store.chunk(target))
    before = int(store.done(target).sum())
    try:
        roll = Roll(client, journal)
        failures = _simulate(roll, target, run, wanted, journal)
        _summarise(roll, target, layout, journal.quiet)
    except (KilledWorker, *LOST) as error:
        lost = "The connection to the scheduler is lost"
        reason = f"The summary cannot be made, for {death(error)}" if isinstance(error, KilledWorker) else lost
        raise RunError(f"{reason}; what is finished is stored in {target}, and the same command goes on.") from error
    finished = int(store.done(target).sum())
    named = f" ({listed(failure.realization for failure in failures)})" if failures else ""
    counts = f"{finished} realizations stored, {finished - before} of them new, {len(failures)} failed"
    journal.write(f"done: {counts}{named}")
    return Result(target, finished, finished - before, tuple(failures), summarised=True)


def _simulate(roll: Roll, target: Path, run: config.RunConfig, wanted: range, journal: Journal) -> list[Failure]:
    """Compute what is missing, chunk by chunk."""
    chunk, done = store.chunk(target), store.done(target)
    path = str(target.absolute())
    job = Job(config.to_json(run), config.digest(run), path, chunk, wanted.start, wanted.stop, packages(), holder())
    missing = {
        start: absent
        for start in range(wanted.start // chunk * chunk, wanted.stop, chunk)
        if (absent := [r for r in range(max(start, wanted.start), min(start + chunk, wanted.stop)) if not done[r]])
    }
    total = sum(map(len, missing.values()))
    if total:
        journal.write(f"{total} realizations to compute, {roll.text()}", aloud=True)
    failures: list[Failure] = []
    finished = 0
    with reporting("realizations", float(total), "realizations", journal.quiet) as report:
        for computed, failed in _outcomes(roll, job, missing, journal):
            finished += computed
            failures += failed
            for failure in failed:
                journal.write(f"failed: realization {failure.realization}: {failure.reason}")
            report(float(finished), len(failures))
    return sorted(failures, key=lambda failure: failure.realization)


def _outcomes(
    roll: Roll, job: Job, missing: dict[int, list[int]], journal: Journal
) -> Iterator[tuple[int, list[Failure]]]:
    """Yield the results of the tasks of all chunks.

    A dying worker counts against all its tasks. Chunks whose workers died too often are computed again at the end, one
    realization at a time, so that only the one that kills workers fails.
    """
    starts, suspects = list(missing), []
    for index, outcome, killed in answers(roll, realize_chunk, ((job, start) for start in starts)):
        if killed is None:
            yield outcome
        else:
            suspects.append(starts[index])
            journal.write(f"tried again, one by one: {listed(missing[starts[index]])}, for {death(killed)}", aloud=True)
    for start in suspects:
        for r in missing[start]:
            for _, outcome, killed in answers(roll, realize_chunk, [(job, start, r)]):
                yield outcome if killed is None else (0, [Failure(r, death(killed))])


def _summarise(roll: Roll, target: Path, layout: Layout, quiet: bool) -> None:
    size, node = layout.realizations, layout.chunk
    while node * 16 < size:
        node *= 2
    calls = [(str(target.absolute()), layout, a, min(a + node, size), holder()) for a in range(0, size, node)]
    arriving, arrived = answers(roll, summarise_node, calls), dict[int, Sums | None]()
    with reporting("summary", float(len(calls)), "nodes", quiet) as report:

        def result(index: int) -> Sums | None:
            while index not in arrived:
                number, sums, killed = next(arriving)
                if killed is not None:
                    raise killed
                arrived[number] = sums
            report(index + 1.0)
            return arrived.pop(index)

        total = streaming.tree(result, len(calls))
    if total is not None:
        store.write_summary(target, summary.dataset(layout, total, store.attributes(target)))
