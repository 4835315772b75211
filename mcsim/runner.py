"""The batch: one Dask task per chunk of realizations, results from worker to store, a tree of sums to the summary.

The only module that touches dask. Nothing large is in the graph: tasks carry the configuration as text and load beams
and moments on the worker, once.
"""

import logging
import os
import tempfile
from asyncio import CancelledError
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, wait
from distributed.comm.core import CommClosedError
from numpy.typing import NDArray

from mcsim import config, plan, repair, simulate, statistics, store, summary
from mcsim.errors import InputError, RunError
from mcsim.layout import listed
from mcsim.lock import locked
from mcsim.progress import Journal, reporting
from mcsim.statistics import Sums
from mcsim.survey import Survey, survey
from mcsim.tasks import ATTEMPTS, Failure, Job, check_same_packages, empty, packages, realize_chunk, summarise_node

# Ctrl-C reaches all processes of a terminal, and it is the driver that ends the run; workers that lose it say nothing.
_WORKER_SETUP = """
import logging, signal
signal.signal(signal.SIGINT, signal.SIG_IGN)
logging.getLogger("distributed").setLevel(logging.CRITICAL)
"""


TURN_S = 30.0
ALONE_S = 300.0
"""How long a run waits for a worker when all are gone."""


@dataclass(frozen=True)
class Result:
    """What a run left behind: the store, how many realizations it now holds, how many were computed, what failed."""

    store: Path
    finished: int
    computed: int
    failures: tuple[Failure, ...]


def run(
    source: str | Path | dict[str, Any] | config.RunConfig,
    path: str | Path | None = None,
    *,
    resume: bool = False,
    realizations: slice | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    client: Client | None = None,
    quiet: bool = True,
) -> Result:
    """Run an ensemble, or continue or extend the one that is stored.

    Parameters
    ----------
    source
        Configuration: a TOML file, the name of a packaged workflow, a dict, or one that is loaded.
    path
        Store; default ``{name}.zarr`` in the working folder.
    resume
        Demand that the store exists, read all of it first, and compute again what is damaged.
    realizations
        Only these of the ensemble, for slices that :func:`merge` joins.
    workers
        Processes of the local cluster; default: the configuration's.
    scheduler
        Address of a running scheduler, ``tcp://host:port`` (or ``tls://``, with the keys that Dask's configuration
        names), whose workers see the same files.
    client
        An existing client, left open.
    quiet
        Report no progress on standard error.

    Raises
    ------
    InputError
        For bad input, an unwritable or foreign store, a scheduler that does not answer. The store is then as it was.
    """
    loaded = source if isinstance(source, config.RunConfig) else config.load(source)
    wanted = plan.wanted(loaded, realizations)
    target = Path(path) if path is not None else plan.default_store(loaded, realizations)
    exists = plan.exists(target)
    if resume and not exists:
        raise InputError(f"There is no store {target} to resume; leave out --resume to start it.")
    if exists and not resume and _finished(target, loaded, wanted):
        return Result(target, int(store.done(target).sum()), 0, ())
    if exists:
        plan.check_same(target, loaded)
    store.check_writable(target)
    config.check_skies(loaded, wanted)
    journal = Journal(target, quiet)
    with ExitStack() as stack:
        if client is None and scheduler is not None:
            client = stack.enter_context(_remote_client(scheduler))
        with reporting("orientation moments", 1.0, "", quiet) as report:
            shared = survey(loaded, nthreads=os.cpu_count() or 1, progress=report)
        simulate.draw_sky(shared, wanted.start)  # bad files of skies are to be found before a store is made
        stack.enter_context(locked(target))
        stack.enter_context(_written_down(journal, loaded, wanted))
        if resume:
            _mend(target, shared, journal, quiet)
            if _finished(target, loaded, wanted):
                return Result(target, int(store.done(target).sum()), 0, ())
        if client is None:
            client = stack.enter_context(local_client(workers or loaded.compute.workers))
        return _run(client, shared, target, wanted, journal)


def _finished(target: Path, run: config.RunConfig, wanted: range) -> bool:
    """Whether a store of this configuration has all that is wanted, its summary included."""
    plan.check_same(target, run)
    done = store.done(target)
    return wanted.stop <= len(done) and bool(done[wanted].all()) and store.summarised(target) == done.sum()


@contextmanager
def _written_down(journal: Journal, run: config.RunConfig, wanted: range) -> Iterator[None]:
    """Log how a run starts and what ends it."""
    journal.write(
        f"start: {run.name}, realizations {wanted.start} to {wanted.stop - 1}, mcsim {dict(packages())['mcsim']}"
    )
    try:
        yield
    except BaseException as error:
        journal.write(f"end: {type(error).__name__}: {error}")
        raise
    journal.write("end: store released")


def _mend(target: Path, shared: Survey, journal: Journal, quiet: bool) -> None:
    verdict = repair.mend(target, plan.layout(shared), plan.attributes(shared.config), quiet)
    for damage in verdict.damages:
        if damage.lost:
            journal.write(f"damaged, to be computed again: {listed(damage.lost)} ({damage.reason})", aloud=True)
    for name, reason in verdict.broken.items():
        journal.write(f"damaged, made again: {name} ({reason})", aloud=True)


def _run(client: Client, shared: Survey, target: Path, wanted: range, journal: Journal) -> Result:
    """Make or extend the store, compute what is missing, summarise."""
    run = shared.config
    if not target.exists():
        store.create(target, plan.layout(shared), plan.attributes(run))
    plan.check_same(target, run)
    if run.ensemble.realizations > store.size(target):
        store.extend(target, run.ensemble.realizations, plan.attributes(run))
    before = int(store.done(target).sum())
    try:
        failures = _simulate(client, target, run, wanted, journal)
        _summarise(client, target, plan.recipe(shared), journal.quiet)
    except KilledWorker as error:
        raise RunError(
            f"Workers died again and again on {error.task} (out of memory?); what is finished is stored in {target}."
        ) from error
    except (CancelledError, CommClosedError) as error:
        raise RunError(
            f"The connection to the scheduler is lost; what is finished is stored in {target}, and the same command "
            "goes on."
        ) from error
    finished = int(store.done(target).sum())
    journal.write(f"done: {finished} realizations stored, {finished - before} of them new, {len(failures)} failed")
    return Result(target, finished, finished - before, tuple(failures))


def merge(paths: Iterable[str | Path], path: str | Path, quiet: bool = True) -> Result:
    """Join stores of slices of one ensemble into a new store.

    Raises
    ------
    InputError
        If the stores are not of one configuration, or ``path`` exists.
    """
    sources = [Path(p) for p in paths]
    target = Path(path)
    if not sources:
        raise InputError("There is nothing to merge; name the stores of the slices.")
    if target.exists():
        raise InputError(f"{target} exists already; merge into a new folder.")
    first = store.attributes(sources[0])
    for other in sources[1:]:
        plan.check_mergeable(sources[0], first, other, store.attributes(other))
    size = max(store.size(source) for source in sources)
    layout, recipe = plan.stored(sources[0], size)
    first["configuration"]["ensemble"]["realizations"] = size
    with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=store.check_writable(target)) as folder:
        scratch = Path(folder) / "merged"
        store.create(scratch, layout, first)
        with reporting("merge", float(size), "realizations", quiet) as report:
            for start in range(0, size, layout.chunk):
                stop = min(start + layout.chunk, size)
                _merge_chunk(sources, scratch, start, stop)
                report(float(stop))
        _write_summary(scratch, recipe, summarise_node(str(scratch), recipe, 0, size, layout.chunk))
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(scratch, target)
    return Result(target, int(store.done(target).sum()), 0, ())


def _merge_chunk(sources: list[Path], target: Path, start: int, stop: int) -> None:
    merged: dict[str, NDArray] = {}
    for source in sources:
        rows = store.read(source, start, stop, maps=True)
        present = rows["done"]
        if not merged:
            merged = {name: empty(stop - start, a) for name, a in rows.items()}
        for name, array in rows.items():
            merged[name][: len(present)][present] = array[present]
    done = merged.pop("done")
    if done.any():
        store.write(target, start, merged, done)


@contextmanager
def local_client(workers: int) -> Iterator[Client]:
    """Client of a local cluster of single-threaded processes, whose ports are open to this machine alone."""
    single = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "DUCC0", "NUMBA")}
    settings = {
        "distributed.nanny.pre-spawn-environ": single,
        "distributed.scheduler.allowed-failures": ATTEMPTS - 1,
        "distributed.worker.preload": [_WORKER_SETUP],
    }
    with (
        dask.config.set(settings),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            memory_limit=None,
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


@contextmanager
def _remote_client(scheduler: str) -> Iterator[Client]:
    try:
        client = Client(scheduler, timeout=5)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(
            f"No Dask scheduler answers at {scheduler} within 5 s ({type(error).__name__}); "
            "start one or correct the address."
        ) from error
    with client:
        _check_workers(client)
        yield client


def _check_workers(client: Client) -> None:
    """Refuse workers that cannot do what this driver would; those that join later are checked by their first task."""
    for address, answer in client.run(packages, on_error="return").items():
        if isinstance(answer, Exception):
            raise InputError(
                f"The worker {address} cannot import mcsim ({type(answer).__name__}: {answer}); "
                "start it from the driver's environment."
            )
        check_same_packages(f"The worker {address}", answer, packages())


def completed(
    client: Client, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[int, Any]]:
    """Call a function on the workers of a cluster, with a bounded number of calls in flight.

    Parameters
    ----------
    client
        Such as :func:`local_client` gives, or one of any other cluster.
    function
        Importable on the workers; what it returns comes back to this process, so it should be small.
    arguments
        Tuples of positional arguments, one for every call; consumed as calls are sent, so it may be long, or lazy.

    Yields
    ------
    tuple
        Index of the call and its result, in the order of completion. Three calls are in flight for every worker thread
        that there is by then, so workers may join and leave.

    Raises
    ------
    Exception
        What a call raised; ``distributed.KilledWorker`` where its worker died every time.
    """
    for index, future in _futures(client, function, arguments):
        yield index, future.result()


def _futures(
    client: Client, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[int, Future]]:
    waiting = enumerate(arguments)
    numbers: dict[Future, int] = {}

    def fill() -> None:
        room = 3 * max(1, sum(client.nthreads().values())) - len(numbers)
        for index, call in islice(waiting, max(room, 0)):
            future = client.submit(function, *call, pure=False)
            numbers[future] = index

    fill()
    while numbers:
        # Asked for in turns, for a call that no worker is left to answer would be waited for for ever.
        done, _ = _first_of(client, list(numbers))
        for future in done:
            yield numbers.pop(future), future
        fill()


def _first_of(client: Client, flying: list[Future]) -> tuple[set[Future], set[Future]]:
    """Futures that are done, at least one, and the others; RunError when no worker has been there for a while."""
    missed = 0
    while True:
        try:
            return tuple(wait(flying, timeout=TURN_S, return_when="FIRST_COMPLETED"))
        except TimeoutError:
            missed = 0 if client.nthreads() else missed + 1
        if missed * TURN_S >= ALONE_S:
            raise RunError(
                f"No worker has been there for {ALONE_S:g} s; start workers, then run the same command again: what is "
                "finished is kept."
            )


def _simulate(client: Client, target: Path, run: config.RunConfig, wanted: range, journal: Journal) -> list[Failure]:
    """Compute what is missing, chunk by chunk."""
    chunk, done = store.chunk(target), store.done(target)
    path = str(target.absolute())
    job = Job(config.to_json(run), config.digest(run), path, chunk, wanted.start, wanted.stop, packages())
    missing = {
        start: absent
        for start in range(wanted.start // chunk * chunk, wanted.stop, chunk)
        if (absent := [r for r in range(max(start, wanted.start), min(start + chunk, wanted.stop)) if not done[r]])
    }
    total = sum(map(len, missing.values()))
    if total:
        journal.write(f"{total} realizations to compute, {_workers(client)}", aloud=True)
    failures: list[Failure] = []
    finished = 0
    with reporting("realizations", float(total), "realizations", journal.quiet) as report:
        for computed, failed in _outcomes(client, job, missing, journal):
            finished += computed
            failures += failed
            for failure in failed:
                journal.write(f"failed: realization {failure.realization}: {failure.reason}")
            report(float(finished), len(failures))
    return sorted(failures, key=lambda failure: failure.realization)


def _outcomes(
    client: Client, job: Job, missing: dict[int, list[int]], journal: Journal
) -> Iterator[tuple[int, list[Failure]]]:
    """Results of the tasks of all chunks.

    Workers that die take the blame of all that they were given. What was blamed too often is tried again in the end,
    realization by realization and one at a time: then only the guilty one fails.
    """
    starts, suspects = list(missing), []
    for index, future in _futures(client, realize_chunk, ((job, start) for start in starts)):
        try:
            yield future.result()
        except KilledWorker:
            suspects.append(starts[index])
            journal.write(
                f"workers died on {listed(missing[starts[index]])}; it is tried again, one by one", aloud=True
            )
    for start in suspects:
        for r in missing[start]:
            try:
                yield client.submit(realize_chunk, job, start, r, pure=False).result()
            except KilledWorker:
                yield 0, [Failure(r, "each worker that computed it died (out of memory?)")]


def _workers(client: Client) -> str:
    """Who computes, in words, and where to watch them."""
    threads = client.nthreads()
    text = (
        f"{len(threads)} workers with {sum(threads.values())} threads" if threads else "no worker yet: waiting for one"
    )
    return f"{text}; dashboard {client.dashboard_link}" if find_spec("bokeh") and client.dashboard_link else text


def _summarise(client: Client, target: Path, recipe: summary.Recipe, quiet: bool) -> None:
    chunk, size = store.chunk(target), store.size(target)
    node = chunk
    while node * 16 < size:
        node *= 2
    starts = list(range(0, size, node))
    calls = [(str(target.absolute()), recipe, a, min(a + node, size), chunk) for a in starts]
    futures = client.map(summarise_node, *zip(*calls, strict=True), pure=False)
    with reporting("summary", float(len(starts)), "nodes", quiet) as report:

        def result(index: int) -> Sums | None:
            sums: Sums | None = futures[index].result()
            futures[index].release()
            report(index + 1.0)
            return sums

        total = statistics.tree(result, len(starts))
    _write_summary(target, recipe, total)


def _write_summary(target: Path, recipe: summary.Recipe, total: Sums | None) -> None:
    if total is not None:
        store.write_summary(target, summary.dataset(recipe, total, store.attributes(target)))
