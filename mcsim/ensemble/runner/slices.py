"""Merging of stores that hold slices of one ensemble."""

import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcsim.ensemble import opening, plan, repair, store, summary
from mcsim.ensemble.lock import locked
from mcsim.ensemble.runner.batch import Result
from mcsim.ensemble.tasks import empty, summarise_node
from mcsim.errors import InputError, RunError
from mcsim.support.folders import is_full, real_path, user_path
from mcsim.support.progress import reporting


def merge(paths: Iterable[str | Path], path: str | Path, quiet: bool = True) -> Result:
    """Join stores of slices of one ensemble into a new store.

    Parameters
    ----------
    paths
        Stores that :func:`mcsim.run` made with ``realizations``.
    path
        The new store.
    quiet
        Report no progress on standard error.

    Returns
    -------
    Result
        ``store``, and the number of realizations ``finished``.

    Raises
    ------
    InputError
        If the stores are not of one configuration, one is named twice, or ``path`` exists or is within a store.
    RunError
        If the disk is full; nothing of the new store is left.

    Examples
    --------
    >>> import mcsim
    >>> parts = [mcsim.run("tiny", realizations=part).store for part in (slice(0, 16), slice(16, 32))]
    >>> mcsim.merge(parts, "merged.zarr").finished
    32
    """
    if not isinstance(paths, str | Path | Iterable):
        raise InputError(f"paths is {paths!r}, but it must be a list of stores.")
    sources = [user_path(p) for p in ([paths] if isinstance(paths, str | Path) else paths)]
    target = real_path(user_path(path))
    if not sources:
        raise InputError("There is nothing to merge; name the stores of the slices.")
    _check_new(target)
    first = store.attributes(sources[0])
    for other in sources[1:]:
        joining = store.attributes(other)
        plan.check_mergeable(sources[0], first, other, joining)
        first |= plan.mixed(target, first, joining)
    named: dict[str, Path] = {}
    for source in sources:
        if (before := named.setdefault(os.path.realpath(source), source)) is not source:
            twice = f"{source} is named twice" if source == before else f"{source} is the store {before}"
            raise InputError(f"{twice}, and a merge takes each store once; name another slice, or leave it out.")
    size = max(store.size(source) for source in sources)
    layout = opening.layout(sources[0], size)
    first["configuration"]["ensemble"]["realizations"] = size
    place = store.check_writable(target)
    with _disk_named(target), locked(target) as inherited, ExitStack() as stack:
        _check_new(target)  # once more: another one may have ended just before
        if inherited:
            repair.sweep(target)
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=place))
        scratch = Path(folder) / "merged"
        store.create(scratch, layout, first)
        there = np.zeros(size, dtype=bool)
        for source in sources:
            done = store.done(source)
            there[: len(done)] |= done
        with reporting("merge", float(there.sum()), "realizations", quiet) as report:
            for start in range(0, size, layout.chunk):
                stop = min(start + layout.chunk, size)
                _merge_chunk(sources, scratch, start, stop)
                report(float(there[:stop].sum()))
        total = summarise_node(str(scratch), layout, 0, size)
        if total is not None:
            store.write_summary(scratch, summary.dataset(layout, total, first))
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(scratch, target)
    return Result(target, int(store.done(target).sum()), 0, (), summarised=total is not None)


def _check_new(target: Path) -> None:
    if target.exists():
        raise InputError(f"{target} exists already; merge into a new folder.")


@contextmanager
def _disk_named(target: Path) -> Iterator[None]:
    """Name the store to make, not the scratch folder, where its disk is full; there is nothing to resume."""
    try:
        yield
    except (OSError, RunError) as error:
        full = error if is_full(error) else error.__cause__
        if not isinstance(full, OSError) or not is_full(full):
            raise
        raise RunError(f"{target} cannot be written ({full.strerror}); make room there and merge again.") from error


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
