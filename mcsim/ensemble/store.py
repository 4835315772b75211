"""The ensemble store: one Zarr 3 group per run.

Arrays have the dimensions (realization, pair, mode, ell) and are chunked along realization alone. One task writes whole
chunks, ``done`` last. A realization exists only if ``done`` is True.
"""

import asyncio
import json
import os
import shutil
import tempfile
import warnings
from collections.abc import Collection, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import ZstdCodec
from zarr.core.sync import sync
from zarr.storage import MemoryStore

from mcsim.ensemble.datasets import Files, write_dataset, write_files
from mcsim.ensemble.layout import Layout, listed
from mcsim.errors import InputError, RunError
from mcsim.support.folders import exchanged, is_full, outside_stores, unwritable, write_whole

if TYPE_CHECKING:
    import xarray as xr

_CODECS: dict[str, Any] = {"compressors": (ZstdCodec(level=1, checksum=True),)}
# Write chunks of fill values too, so that a missing file means damage.
_WHOLE: dict[str, Any] = {"config": {"write_empty_chunks": True}, **_CODECS}
MAP, FORMER_MAP = "observed_map", "map"
"""Name of kept maps, and their name in older stores, which hides an xarray method."""

SETTLING_S = 5.0
_FAULTS = (OSError, KeyError, ValueError, RuntimeError, TypeError)


@dataclass(frozen=True)
class Damage:
    """A damaged chunk: the lost realizations, and the reason.

    ``lost`` is empty for leftovers: files of realizations not marked as finished.
    """

    start: int
    lost: tuple[int, ...]
    reason: str


def check_writable(path: Path) -> Path:
    """Check that a store can be made, without making anything; return the innermost existing folder.

    A new store within another one is refused.
    """
    if not path.exists():
        outside_stores(path)
    folder = path.absolute().parent
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    with refuse_unwritable(path):
        for place in (folder, path) if path.is_dir() else (folder,):
            with tempfile.TemporaryFile(dir=place):
                pass
    return folder


def create(path: Path, layout: Layout, attributes: Mapping[str, Any]) -> None:
    """Make an empty store at ``path``, complete or not at all."""
    with refuse_unwritable(path), ExitStack() as stack:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent)
        stack.callback(shutil.rmtree, scratch, ignore_errors=True)
        files: Files = {}
        group = zarr.create_group(MemoryStore(files))
        group.attrs.update({**attributes, "coordinates": "L M d parity"})
        for name, (dim, values, attrs) in layout.coordinates().items():
            form: dict[str, Any] = {"dtype": str if values.dtype == object else values.dtype, **_WHOLE}
            array = group.create_array(name, shape=values.shape, chunks=values.shape, dimension_names=[dim], **form)
            array[:] = values
            array.attrs.update(attrs)
        sizes = layout.sizes()
        whole = {**layout.variables(), "done": ((), "bool", "1", "finished")}
        for name, (dims, dtype, unit, text) in whole.items():
            dims = ("realization", *dims)
            shape = tuple(sizes[dim] for dim in dims)
            fill = {"bool": False, "complex128": complex(np.nan, np.nan)}.get(dtype, np.nan)
            form = {"dtype": dtype, "fill_value": fill, **_CODECS}
            array = group.create_array(
                name, shape=shape, chunks=(layout.chunk, *shape[1:]), dimension_names=dims, **form
            )
            array.attrs.update({"units": unit, "long_name": text})
        if layout.kept_npix is not None:
            group[layout.kept_name].attrs.update(layout.kept_attributes())
        _consolidate(MemoryStore(files))
        write_files(files, Path(scratch) / "new")
        os.replace(Path(scratch) / "new", path)


def write(path: Path, first: int, values: Mapping[str, NDArray], done: NDArray[np.bool_]) -> None:
    """Write whole chunks of realizations from ``first`` on; ``done`` is written last.

    ``values`` holds arrays of shape (n, ...); rows that are not done are stored as NaN.
    """
    with faults_named(path):
        group = _open(path, "r+")
        stop = first + len(done)
        for name, rows in values.items():
            _member(group, FORMER_MAP if name == MAP and name not in group else name)[first:stop] = rows
        _member(group, "done")[first:stop] = done


def read(path: Path, start: int, stop: int, maps: bool = False) -> dict[str, NDArray]:
    """Read the arrays over realizations ``start`` to ``stop``, with ``done``; kept maps only if ``maps``."""
    with faults_named(path):
        group = _open(path)
        left_out = {"realization"} if maps else {"realization", MAP, FORMER_MAP}
        found = {name: array for name, array in group.arrays() if name not in left_out and _over_realizations(array)}
        rows = {MAP if name == FORMER_MAP else name: np.asarray(array[start:stop]) for name, array in found.items()}
    absent = _absent(rows)
    if absent.any():
        raise RunError(
            f"{path} lacks numbers of realizations that count as finished ({listed(start + np.flatnonzero(absent))}); "
            "mcsim run --resume computes them again."
        )
    return rows


def examine(path: Path, start: int, leave_out: Collection[str] = ()) -> Damage | None:
    """Read every file of one chunk of realizations and check its checksum; return None if it is intact."""
    with faults_named(path):
        group = _open(path)
        last = _member(group, "done")
        numbers = np.arange(start, min(start + last.chunks[0], last.shape[0]))
        names = [name for name in _variables(path) if name not in leave_out]
    rows: dict[str, NDArray] = {}
    for name in ("done", *names):
        try:
            rows[name] = np.asarray(_member(group, name)[start : start + len(numbers)])
        except _FAULTS as error:
            lost = numbers[rows["done"]] if rows else numbers
            return Damage(start, tuple(lost.tolist()), f"{name}: {_reason(error)}")
    lost = numbers[_absent(rows)]
    return Damage(start, tuple(lost.tolist()), "numbers are missing") if lost.size else None


def discard(path: Path, damage: Damage) -> None:
    """Delete a damaged chunk, ``done`` first, so that an interrupted call leaves nothing that looks intact."""
    with faults_named(path):
        group = _open(path)
        for name in ("done", *_variables(path)):
            array = _member(group, name)
            key = array.metadata.encode_chunk_key((damage.start // array.chunks[0], *(0,) * (array.ndim - 1)))
            (path / name / key).unlink(missing_ok=True)


def absent_files(path: Path, summary: bool | None = None) -> list[str]:
    """Return the files of finished realizations, coordinates and summary that are not there, or empty; read none.

    ``summary``: True for those of the summary alone, False for all others.
    """
    with faults_named(path):
        finished, wanted = done(path), []
        for name, metadata in _remembered(path).items():
            if summary not in (None, name.split("/")[0] == "summary"):
                continue
            wanted.append(f"{name}/zarr.json")
            if (shape := getattr(metadata, "shape", None)) is None:
                continue  # a group
            by_row = _over_realizations(metadata) and name != "realization"
            long = metadata.chunk_grid.chunk_shape[0] if by_row else 0
            for index in metadata.chunk_grid.all_chunk_coords(shape):
                if not by_row or finished[index[0] * long : (index[0] + 1) * long].any():
                    wanted.append(f"{name}/{metadata.encode_chunk_key(index)}")
    return [file for file in wanted if not (path / file).is_file() or (path / file).stat().st_size == 0]


def check_whole(path: Path, summary: bool | None = None) -> None:
    """Raise RunError if there are :func:`absent_files`: zarr reads them as fill values, without a word.

    Files that a power cut has left are empty. What else is damaged only a reading of all files finds.
    """
    if absent := absent_files(path, summary):
        some = f"{len(absent)} of its files, {absent[0]} among them, or they are empty"
        raise RunError(f"{path} lacks {some}; mcsim run --resume makes them again.")


def broken_parts(path: Path) -> dict[str, str]:
    """Return the faults of metadata, coordinates and summary, by name; empty without faults."""
    with faults_named(path):
        group, remembered = _open(path), _remembered(path)
    broken = {}
    for name, metadata in remembered.items():
        try:
            found = group[name]
            if isinstance(found, zarr.Array):
                if _form(found.metadata.to_dict()) != _form(metadata.to_dict()):
                    raise ValueError("its metadata are not those that the store was made with")
                if name == "realization" or not _over_realizations(found):
                    np.asarray(found[...])
                    if found.nchunks_initialized < found.nchunks:
                        raise ValueError("its file is missing")
        except _FAULTS as error:
            broken[name] = _reason(error)
    if (path / "summary").is_dir() and "summary" not in remembered:
        broken["summary"] = "the metadata of the store, by which it is found, do not have it"
    return broken


def restore(path: Path, layout: Layout, update: Mapping[str, Any]) -> None:
    """Write metadata and coordinates anew, as those of a new store of this layout; drop the summary."""
    with faults_named(path), tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as scratch:
        shutil.rmtree(path / "summary", ignore_errors=True)
        remembered = _remembered(path)
        layout = _as_made(layout, remembered["done"], FORMER_MAP in remembered)
        fresh = Path(scratch) / "fresh"
        create(fresh, layout, {**attributes(path), **update})
        for file in sorted(fresh.rglob("*")):
            target = path / file.relative_to(fresh)
            if file.is_file():
                target.parent.mkdir(parents=True, exist_ok=True)
                os.replace(file, target)


def restore_attributes(path: Path, layout: Layout, attributes: Mapping[str, Any]) -> None:
    """Write the ``zarr.json`` of a :func:`headless` store anew: its attributes, and metadata of all but the summary."""
    with faults_named(path), tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as scratch:
        made = zarr.open_array(path / "done", mode="r").metadata
        create(Path(scratch) / "fresh", _as_made(layout, made, (path / FORMER_MAP).is_dir()), attributes)
        os.replace(Path(scratch) / "fresh" / "zarr.json", path / "zarr.json")


def _as_made(layout: Layout, done: Any, former: bool) -> Layout:
    """Return a layout with the length and chunks that the metadata of ``done`` have, and the name of kept maps."""
    length, chunk = done.shape[0], done.chunk_grid.chunk_shape[0]
    return replace(layout, realizations=length, chunk=chunk, kept_name=FORMER_MAP if former else MAP)


def done(path: Path, start: int = 0, stop: int | None = None) -> NDArray[np.bool_]:
    """Return True for each finished realization from ``start`` to ``stop``; by default of all."""
    with faults_named(path):
        return np.asarray(_member(_open(path), "done")[start:stop])


def size(path: Path) -> int:
    """Return the number of realizations that a store has room for."""
    with faults_named(path):
        return int(_member(_open(path), "done").shape[0])


def attributes(path: Path) -> dict[str, Any]:
    """Return the attributes of a store; raise InputError if there is none at ``path``, RunError if they are lost."""
    if headless(path):
        raise RunError(
            f"The attributes of the store {path}, in its zarr.json, are lost; mcsim run --resume with its "
            "configuration makes them again."
        )
    try:
        found = dict(_open(path).attrs)
    except _FAULTS as error:
        what = "is not an ensemble store" if path.exists() else "does not exist"
        raise InputError(f"{path} {what}; name the folder that mcsim run wrote.") from error
    if "science" not in found:
        raise InputError(f"{path} is a Zarr group but not an ensemble store; name the folder that mcsim run wrote.")
    return found


def headless(path: Path) -> bool:
    """Return True for a folder that has all of a store, and a summary, but no attributes that can be read."""
    try:
        rest = all((path / part / "zarr.json").is_file() for part in ("done", "biposh", "summary"))
    except OSError:
        return False
    try:
        return rest and "science" not in _open(path).attrs
    except _FAULTS as error:
        return not isinstance(error, PermissionError)


def origin(path: Path) -> dict[str, Any]:
    """Return the attributes that the summary of a store repeats: digest, conventions, packages."""
    with faults_named(path):
        found = dict(_open(path / "summary").attrs)
        return {name: found[name] for name in ("digest", "conventions", "packages")}


def keeps_maps(path: Path) -> bool:
    """Return True if realizations have their maps."""
    return any((path / name).is_dir() for name in (MAP, FORMER_MAP))


def chunk(path: Path) -> int:
    """Return the number of realizations per task."""
    with faults_named(path):
        return int(_member(_open(path), "done").chunks[0])


def extend(path: Path, realizations: int, update: Mapping[str, Any]) -> None:
    """Grow a store to more realizations, keep the finished ones, and change attributes.

    ``done``, whose length is that of the store, grows last, after the attributes: another call completes an interrupted
    one.
    """
    with refuse_unwritable(path):
        # Realization 0 may have a chunk of its own, whose only number is the fill value.
        with zarr.config.set({"array.write_empty_chunks": True}):
            group = _open(path, "r+")
            growing = {name: array for name, array in group.arrays() if _over_realizations(array)}
        last = growing.pop("done")
        for array in growing.values():
            array.resize((realizations, *array.shape[1:]))
        growing["realization"][:] = np.arange(realizations)
        group.attrs.update(update)
        last.resize((realizations, *last.shape[1:]))
        _consolidate(path)


def write_summary(path: Path, summary: "xr.Dataset") -> None:
    """Replace the summary group: whoever reads meanwhile finds one of both, or none."""
    with faults_named(path), tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as scratch:
        form: Any = {"zarr_format": 3, "write_empty_chunks": True, "consolidated": False}
        encoding = {name: _CODECS | _absent_value(array.dtype) for name, array in summary.variables.items()}
        write_dataset(summary, Path(scratch) / "summary", encoding=encoding, **form)
        _forget_summary(path)  # what ends before the metadata are written has none, not one that is described wrongly
        new, former = Path(scratch) / "summary", path / "summary"
        # Who has opened the former one reads NaN for files that are not there.
        if not exchanged(new, former):
            with suppress(FileNotFoundError):
                os.replace(former, Path(scratch) / "former")
            os.replace(new, former)
        _consolidate(path)


def _forget_summary(path: Path) -> None:
    """Take the summary out of the consolidated metadata, by which xarray finds it."""
    whole = json.loads((path / "zarr.json").read_bytes())
    named = (whole.get("consolidated_metadata") or {}).get("metadata", {})
    for name in [name for name in named if name.split("/")[0] == "summary"]:
        del named[name]
    write_whole(path / "zarr.json", json.dumps(whole))


def _absent_value(dtype: np.dtype) -> dict[str, Any]:
    """Return what stands for numbers whose file is missing, if zarr would take zero; xarray sees to real numbers."""
    if dtype.kind == "i":
        return {"fill_value": np.iinfo(dtype).min}
    return {"fill_value": complex(np.nan, np.nan)} if dtype.kind == "c" else {}


def summarised(path: Path) -> tuple[int, list[int]]:
    """Return the number of realizations in the summary, 0 without one, and the first ell of each of its bins."""
    with faults_named(path):
        if not (path / "summary").is_dir() or "summary" not in _remembered(path):
            return 0, []
        count, first = (np.asarray(_member(_open(path / "summary"), name)[...]) for name in ("count", "bin_first"))
        return int(count), first.tolist()


def _open(path: Path, mode: Literal["r", "r+"] = "r") -> zarr.Group:
    """Open the group without its consolidated metadata, which may be out of date."""
    return zarr.open_group(path, mode=mode, use_consolidated=False)


def _member(group: zarr.Group, name: str) -> zarr.Array:
    array = group[name]
    if not isinstance(array, zarr.Array):
        raise KeyError(name)
    return array


def _over_realizations(array: Any) -> bool:
    return (getattr(getattr(array, "metadata", array), "dimension_names", None) or ("",))[0] == "realization"


def _remembered(path: Path) -> dict[str, Any]:
    """Return the consolidated metadata, from when the store was made or last summarised."""
    consolidated = zarr.open_group(path, mode="r").metadata.consolidated_metadata
    return {} if consolidated is None else dict(consolidated.flattened_metadata)


def _variables(path: Path) -> list[str]:
    """Return the names of the arrays over realizations but ``done``, even if their files are missing."""
    found = [name for name, metadata in _remembered(path).items() if _over_realizations(metadata)]
    return [name for name in found if name not in ("realization", "done")]


def _form(metadata: dict[str, Any]) -> str:
    """Return metadata as text without the length, which an interrupted extension may have changed."""
    shape = metadata.pop("shape", ())
    return repr((sorted(metadata.items(), key=lambda item: item[0]), len(shape), tuple(shape)[1:]))


def _absent(rows: Mapping[str, NDArray]) -> NDArray[np.bool_]:
    """Return True for finished rows that an array lacks: its file is gone, or two runs wrote at once."""
    absent = np.zeros(rows["done"].shape, dtype=bool)
    for name, values in rows.items():
        if name != "done" and values.size:
            missing = np.isnan(values).reshape(len(values), -1)
            absent |= missing.any(axis=1) if name.startswith("cl") else missing.all(axis=1)
    return absent & rows["done"]


def _reason(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _consolidate(path: Path | MemoryStore) -> None:
    """Write all metadata into one file, which xarray reads at once; silence zarr's warning about the format."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", category=UserWarning)
        zarr.consolidate_metadata(path)


@contextmanager
def faults_named(path: Path) -> Iterator[None]:
    """Turn zarr's errors for a damaged or vanished store, or a full disk, into one sentence."""
    try:
        yield
    except (RunError, InputError):
        raise
    except _FAULTS as error:
        sync(_others_ended())
        disk = "make room on its disk" if is_full(error) else "repair its disk"
        remedy = disk if isinstance(error, OSError) else "mcsim info --verify says what is damaged"
        raise RunError(
            f"The store {path} cannot be used ({type(error).__name__}: {_reason(error)}); {remedy}, and mcsim run "
            "--resume goes on."
        ) from error


async def _others_ended() -> None:
    """Let the reads end that zarr began beside one that failed: those that are left complain when Python ends."""
    if others := asyncio.all_tasks() - {asyncio.current_task()}:
        await asyncio.wait(others, timeout=SETTLING_S)


def refuse_unwritable(path: Path) -> AbstractContextManager[None]:
    """Turn errors of the file system into one sentence."""
    return unwritable(f"The store {path}", "choose a writable folder with -o")
