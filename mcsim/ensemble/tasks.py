"""Tasks of workers, without Dask: the realizations of a chunk, the sums of a node of the tree."""

import platform
import time
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.ensemble import store, summary
from mcsim.ensemble.layout import Layout
from mcsim.ensemble.lock import check_held
from mcsim.errors import InputError, RunError
from mcsim.simulation import simulate
from mcsim.simulation.survey import Survey, survey
from mcsim.stats import streaming
from mcsim.stats.streaming import Sums
from mcsim.support.code import package_digest, version

ATTEMPTS = 3
PAUSE_S = 0.1


@dataclass(frozen=True)
class Failure:
    """A realization that could not be computed."""

    realization: int
    reason: str


@dataclass(frozen=True)
class Job:
    """Parameters shared by all tasks of a run; each task carries them, so they are small.

    ``text`` is the configuration as JSON, ``digest`` the hash of it and of its files, ``path`` the store, ``chunk`` the
    number of realizations per task; wanted are ``first`` to ``stop - 1``; ``packages`` are the versions of the driver,
    ``holder`` is what its lock of the store says, "" without one.
    """

    text: str
    digest: str
    path: str
    chunk: int
    first: int
    stop: int
    packages: tuple[tuple[str, str], ...]
    holder: str = ""


def packages() -> tuple[tuple[str, str], ...]:
    """Return the versions of the packages that a realization's bits, or the store's files, depend on.

    Checkouts of mcsim that differ have the same version: the hash of its code is beside it.
    """
    names = ("mcsim", "numpy", "scipy", "ducc0", "healpy", "zarr", "numcodecs")
    python, code = ".".join(platform.python_version_tuple()[:2]), package_digest(["mcsim"])[:12]
    return ("python", python), *((name, version(name)) for name in names), ("code of mcsim", code)


def check_same_packages(where: str, theirs: Iterable[tuple[str, str]], own: Iterable[tuple[str, str]]) -> None:
    """Raise InputError unless a worker's versions, ``theirs``, are the driver's, ``own``."""
    found = dict(theirs)
    wrong = [f"{name} {found.get(name)} for {number}" for name, number in own if found.get(name) != number]
    if wrong:
        raise InputError(
            f"{where} has other packages than the driver ({', '.join(wrong)}); start it from the driver's environment."
        )


@lru_cache(maxsize=1)
def shared_survey(text: str, digest: str, own: tuple[tuple[str, str], ...]) -> Survey:
    """Return the survey of a configuration, made once per worker process and content of its files."""
    check_same_packages(f"A worker on {platform.node()}", packages(), own)
    run = config.from_json(text)
    found = config.digest(run)
    if found != digest:
        raise RunError("A worker sees other files than the driver does; let them share the files that the run names.")
    return survey(run)


def realize_chunk(job: Job, start: int, only: int | None = None) -> tuple[int, list[Failure]]:
    """Compute what is missing of one chunk and write the whole chunk; return the count and the failures.

    ``only`` limits it to one realization.
    """
    shared, target = shared_survey(job.text, job.digest, job.packages), Path(job.path)
    if job.holder:
        check_held(target, job.holder)
    done = store.done(target, start, start + job.chunk)
    first, stop = max(start, job.first), min(start + len(done), job.stop)
    computed: dict[int, dict[str, NDArray]] = {}
    failures = []
    for r in range(first, stop) if only is None else (only,):
        if done[r - start]:
            continue
        result = _attempt(shared, r)
        if isinstance(result, Failure):
            failures.append(result)
        else:
            computed[r - start] = result
    if computed:
        _write(target, start, len(done), computed)
    return len(computed), failures


def _attempt(shared: Survey, r: int) -> dict[str, NDArray] | Failure:
    """Return a realization, or its failure after several attempts, which help if disk or memory was short."""
    for attempt in range(ATTEMPTS):
        try:
            values = simulate.realize(shared, r)
            if not np.all(np.isfinite(values["cl"])):
                raise FloatingPointError("its power spectrum is not finite")
            return values
        except Exception as error:  # an error of one realization must not stop the others
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            if isinstance(error, InputError):
                break
            time.sleep(PAUSE_S * attempt)
    return Failure(r, reason)


def _write(target: Path, start: int, count: int, computed: dict[int, dict[str, NDArray]]) -> None:
    """Write a whole chunk: its present content and the new rows.

    The chunk is read again here, because another worker may have done a task given up for lost.
    """
    done = store.done(target, start, start + count)
    rows = store.read(target, start, start + count, maps=True) if done.any() else {}
    rows.pop("done", None)
    for row, values in computed.items():
        for name, value in values.items():
            if name not in rows:
                rows[name] = empty(count, value[None])
            rows[name][row] = value
        done[row] = True
    store.write(target, start, rows, done)


def empty(count: int, like: NDArray) -> NDArray:
    """Return rows of realizations that do not exist: not done, or NaN."""
    return np.full((count, *like.shape[1:]), False if like.dtype == bool else np.nan, like.dtype)


def summarise_node(path: str, layout: Layout, start: int, stop: int, holder: str = "") -> Sums | None:
    """Return the statistics of the realizations of a node of the tree, read chunk by chunk; ``holder`` as of a job."""
    target = Path(path)
    if holder:
        check_held(target, holder)
    starts = range(start, stop, layout.chunk)

    def node(index: int) -> Sums | None:
        first = starts[index]
        end = min(first + layout.chunk, stop)
        if not store.done(target, first, end).any():
            return None
        return summary.reduce_rows(layout, store.read(target, first, end))

    return streaming.tree(node, len(starts))
