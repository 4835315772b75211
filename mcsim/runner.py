"""The batch: one Dask task per chunk of realizations, results from worker to store, a tree of sums to the summary.

The only module that touches dask. Nothing large is in the graph: tasks carry the configuration as text and load beams
and moments on the worker, once.
"""

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import dask
import numpy as np
from distributed import Client, KilledWorker, LocalCluster, as_completed
from numpy.typing import NDArray

from mcsim import config, plan, simulate, statistics, store, summary
from mcsim.errors import InputError, RunError
from mcsim.lock import locked
from mcsim.progress import reporting
from mcsim.statistics import Sums
from mcsim.survey import Survey, survey


@dataclass(frozen=True)
class Failure:
    """A realization that could not be computed."""

    realization: int
    reason: str


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
        Demand that the store exists.
    realizations
        Only these of the ensemble, for slices that :func:`merge` joins.
    workers
        Processes of the local cluster; default: the configuration's.
    scheduler
        Address of a running scheduler, ``tcp://host:port``, whose workers see the same files.
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
    if not plan.exists(target):
        if resume:
            raise InputError(f"There is no store {target} to resume; leave out --resume to start it.")
        store.check_writable(target)
    elif _finished(target, loaded, wanted):
        return Result(target, int(store.done(target).sum()), 0, ())
    config.check_skies(loaded, wanted)
    with ExitStack() as stack:
        if client is None and scheduler is not None:
            client = stack.enter_context(_remote_client(scheduler))
        with reporting("orientation moments", 1.0, "", quiet) as report:
            shared = survey(loaded, nthreads=os.cpu_count() or 1, progress=report)
        simulate.draw_sky(shared, wanted.start)  # bad files of skies are to be found before a store is made
        stack.enter_context(locked(target))
        if client is None:
            client = stack.enter_context(local_client(workers or loaded.compute.workers))
        return _run(client, shared, target, wanted, quiet)


def _finished(target: Path, run: config.RunConfig, wanted: range) -> bool:
    """Whether a store of this configuration has all that is wanted, its summary included."""
    plan.check_same(target, run)
    done = store.done(target)
    return wanted.stop <= len(done) and bool(done[wanted].all()) and store.summarised(target) == done.sum()


def _run(client: Client, shared: Survey, target: Path, wanted: range, quiet: bool) -> Result:
    """Make or extend the store, compute what is missing, summarise."""
    run = shared.config
    if not target.exists():
        store.create(target, plan.layout(shared), plan.attributes(run))
    elif run.ensemble.realizations > store.size(target):
        store.extend(target, run.ensemble.realizations, plan.attributes(run))
    before = int(store.done(target).sum())
    try:
        failures = _simulate(client, target, run, wanted, quiet)
        _summarise(client, target, plan.recipe(shared), quiet)
    except KilledWorker as error:
        raise RunError(
            f"Workers died again and again on {error.task} (out of memory?); what is finished is stored in {target}."
        ) from error
    finished = int(store.done(target).sum())
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
            merged = {name: _empty(stop - start, a) for name, a in rows.items()}
        for name, array in rows.items():
            merged[name][: len(present)][present] = array[present]
    done = merged.pop("done")
    if done.any():
        store.write(target, start, merged, done)


def _empty(count: int, like: NDArray) -> NDArray:
    """Rows of realizations that do not exist: not done, or NaN."""
    return np.full((count, *like.shape[1:]), False if like.dtype == bool else np.nan, like.dtype)


@contextmanager
def local_client(workers: int) -> Iterator[Client]:
    """Client of a local cluster of single-threaded processes, whose ports are open to this machine alone."""
    single = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "DUCC0", "NUMBA")}
    settings = {"distributed.nanny.pre-spawn-environ": single, "logging.distributed": "error"}
    with (
        dask.config.set(settings),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            memory_limit=None,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


@contextmanager
def _remote_client(scheduler: str) -> Iterator[Client]:
    try:
        client = Client(scheduler, timeout=5)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"No Dask scheduler answers at {scheduler} within 5 s ({type(error).__name__}); "
            "start one or correct the address."
        ) from error
    with client:
        yield client


def _simulate(client: Client, target: Path, run: config.RunConfig, wanted: range, quiet: bool) -> list[Failure]:
    """Compute what is missing, chunk by chunk, with a bounded number of tasks in flight."""
    text, digest, chunk, done = config.to_json(run), config.digest(run), store.chunk(target), store.done(target)
    starts = [
        start
        for start in range(wanted.start // chunk * chunk, wanted.stop, chunk)
        if any(not done[r] for r in range(max(start, wanted.start), min(start + chunk, wanted.stop)))
    ]
    total = sum(not done[r] for r in wanted)
    arguments = ((text, digest, str(target.absolute()), start, chunk, wanted.start, wanted.stop) for start in starts)
    failures: list[Failure] = []
    finished = 0
    with reporting("realizations", float(total), "realizations", quiet) as report:
        for computed, failed in _bounded(client, realize_chunk, arguments):
            finished += computed
            failures += failed
            report(float(finished), len(failures))
    return sorted(failures, key=lambda failure: failure.realization)


def _bounded(client: Client, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
    """Results of calls in the order of completion, three tasks in flight for every worker thread there is by then."""
    waiting = iter(arguments)
    flying = as_completed([], with_results=False)
    count = 0

    def fill() -> int:
        room = 3 * max(1, sum(client.nthreads().values())) - count
        calls = list(islice(waiting, max(room, 0)))
        for call in calls:
            flying.add(client.submit(function, *call, pure=False))
        return len(calls)

    count += fill()
    for future in flying:
        yield future.result()
        count -= 1
        count += fill()


@lru_cache(maxsize=1)
def _survey_of(text: str, digest: str) -> Survey:
    """The survey of a configuration, made once per worker process and contents of its files."""
    run = config.from_json(text)
    found = config.digest(run)
    if found != digest:
        raise RunError("A worker sees other files than the driver does; let them share the files that the run names.")
    return survey(run)


def realize_chunk(
    text: str, digest: str, path: str, start: int, chunk: int, wanted_start: int, wanted_stop: int
) -> tuple[int, list[Failure]]:
    """Task: compute what is missing of one chunk and write the chunk whole; returns the count and what failed."""
    shared, target = _survey_of(text, digest), Path(path)
    done = store.done(target, start, start + chunk)
    stop = start + len(done)
    rows: dict[str, NDArray] = store.read(target, start, stop, maps=True) if done.any() else {}
    rows.pop("done", None)
    computed, failures = 0, []
    for r in range(max(start, wanted_start), min(stop, wanted_stop)):
        if done[r - start]:
            continue
        try:
            values = simulate.realize(shared, r)
            if not np.all(np.isfinite(values["cl"])):
                raise FloatingPointError("its power spectrum is not finite")
        except Exception as error:  # whatever one realization meets, the others are to finish
            failures.append(Failure(r, f"{type(error).__name__}: {error}"))
            continue
        for name, value in values.items():
            if name not in rows:
                rows[name] = _empty(stop - start, value[None])
            rows[name][r - start] = value
        done[r - start] = True
        computed += 1
    if computed:
        store.write(target, start, rows, done)
    return computed, failures


def summarise_node(path: str, recipe: summary.Recipe, start: int, stop: int, chunk: int) -> Sums | None:
    """Task: statistics of the realizations of a node of the tree, read chunk by chunk."""
    target = Path(path)
    starts = range(start, stop, chunk)

    def node(index: int) -> Sums | None:
        first = starts[index]
        return summary.reduce_rows(recipe, store.read(target, first, min(first + chunk, stop)), first)

    return statistics.tree(node, len(starts))


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
