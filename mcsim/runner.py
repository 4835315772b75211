"""The batch: one Dask task per chunk of realizations, results from worker to store, a tree of sums to the summary.

The only module that touches dask. Nothing large is in the graph: tasks carry the configuration as text and load beams
and moments on the worker, once.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import dask
import numpy as np
from distributed import Client, LocalCluster, as_completed
from numpy.typing import NDArray

from mcsim import config, plan, simulate, statistics, store, summary
from mcsim.errors import InputError
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
    target = Path(path) if path is not None else Path(f"{loaded.name}.zarr")
    wanted = plan.wanted(loaded, realizations)
    exists = target.exists()
    if resume and not exists:
        raise InputError(f"There is no store {target} to resume; leave out --resume to start it.")
    if exists:
        plan.check_same(target, loaded)
        stored = store.done(target)
        if all(r < len(stored) and stored[r] for r in wanted):
            return Result(target, int(stored.sum()), 0, ())
    else:
        store.check_writable(target)
    config.check_skies(loaded, wanted)
    with reporting("orientation moments", 1.0, "", quiet) as report:
        shared = survey(loaded, nthreads=os.cpu_count() or 1, progress=report)
    layout, recipe, attributes = plan.layout(shared), plan.recipe(shared), plan.attributes(loaded)
    with _connected(client, scheduler, workers or loaded.compute.workers) as connected:
        if not exists:
            store.create(target, layout, attributes)
        elif layout.realizations > len(store.done(target)):
            store.extend(target, layout.realizations, attributes)
        before = int(store.done(target).sum())
        failures = _simulate(connected, target, loaded, wanted, quiet)
        _summarise(connected, target, recipe, quiet)
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
    size = max(len(store.done(source)) for source in sources)
    layout, recipe = plan.stored(sources[0], size)
    store.create(target, layout, first)
    chunk = layout.chunk
    with reporting("merge", float(size), "realizations", quiet) as report:
        for start in range(0, size, chunk):
            stop = min(start + chunk, size)
            _merge_chunk(sources, target, start, stop)
            report(float(stop))
    done = store.done(target)
    nodes = [summary.reduce_rows(recipe, store.read(target, a, min(a + chunk, size)), a) for a in range(0, size, chunk)]
    _write_summary(target, recipe, statistics.tree(nodes.__getitem__, len(nodes)))
    return Result(target, int(done.sum()), 0, ())


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
def _connected(client: Client | None, scheduler: str | None, workers: int) -> Iterator[Client]:
    """The client to work with: the given one, that of a running scheduler, or one of a local cluster."""
    if client is not None:
        yield client
    elif scheduler is None:
        with local_client(workers) as local:
            yield local
    else:
        try:
            remote = Client(scheduler, timeout=5)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(
                f"No Dask scheduler answers at {scheduler} within 5 s ({type(error).__name__}); "
                "start one or correct the address."
            ) from error
        with remote:
            yield remote


def _simulate(client: Client, target: Path, run: config.RunConfig, wanted: range, quiet: bool) -> list[Failure]:
    """Compute what is missing, chunk by chunk, with a bounded number of tasks in flight."""
    text, chunk, done = config.to_json(run), store.chunk(target), store.done(target)
    starts = [
        start
        for start in range(wanted.start // chunk * chunk, wanted.stop, chunk)
        if any(not done[r] for r in range(max(start, wanted.start), min(start + chunk, wanted.stop)))
    ]
    total = sum(not done[r] for r in wanted)
    arguments = ((text, str(target.absolute()), start, chunk, wanted.start, wanted.stop) for start in starts)
    failures: list[Failure] = []
    finished = 0
    with reporting("realizations", float(total), "realizations", quiet) as report:
        for computed, failed in _bounded(client, realize_chunk, arguments):
            finished += computed
            failures += failed
            report(float(finished), len(failures))
    return sorted(failures, key=lambda failure: failure.realization)


def _bounded(client: Client, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
    """Results of calls in the order of completion, three tasks per worker thread in flight."""
    waiting = iter(arguments)
    flying = as_completed([], with_results=False)
    room = 3 * max(1, sum(client.nthreads().values()))
    for _ in range(room):
        if (call := next(waiting, None)) is not None:
            flying.add(client.submit(function, *call, pure=False))
    for future in flying:
        yield future.result()
        if (call := next(waiting, None)) is not None:
            flying.add(client.submit(function, *call, pure=False))


@lru_cache(maxsize=1)
def _survey_of(text: str) -> Survey:
    """The survey of a configuration, made once per worker process."""
    return survey(config.from_json(text))


def realize_chunk(
    text: str, path: str, start: int, chunk: int, wanted_start: int, wanted_stop: int
) -> tuple[int, list[Failure]]:
    """Task: compute what is missing of one chunk and write the chunk whole; returns the count and what failed."""
    shared, target = _survey_of(text), Path(path)
    stop = min(start + chunk, len(store.done(target)))
    done = store.done(target)[start:stop]
    rows: dict[str, NDArray] = store.read(target, start, stop, maps=True) if done.any() else {}
    rows.pop("done", None)
    computed, failures = 0, []
    for r in range(max(start, wanted_start), min(stop, wanted_stop)):
        if done[r - start]:
            continue
        try:
            values = simulate.realize(shared, r)
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
    chunk, size = store.chunk(target), len(store.done(target))
    node = chunk
    while node * 64 < size:
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
        store.write_summary(target, summary.dataset(recipe, total))
