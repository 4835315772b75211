"""The ensemble store: one Zarr 3 group per run, and the only module that touches zarr.

Arrays have the dimensions (realization, pair, mode, ell) and are chunked along realization alone; one task writes whole
chunks, ``done`` last. Nothing but ``done`` says that a realization exists.
"""

import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray
from zarr.codecs import ZstdCodec

from mcsim.biposh import Mode
from mcsim.errors import InputError, RunError


@dataclass(frozen=True)
class Layout:
    """Shape of a store: realizations and how many of them one task owns, maps, pairs, modes, degrees."""

    realizations: int
    chunk: int
    maps: tuple[str, ...]
    pairs: tuple[str, ...]
    modes: tuple[Mode, ...]
    lmax: int
    paired: bool
    kept_npix: int | None

    def variables(self) -> dict[str, tuple[tuple[str, ...], str, str, str]]:
        """Dimensions, type, unit and long name of every array over realizations."""
        spectra = {
            "biposh": (
                ("pair", "mode", "ell"),
                "complex128",
                "uK^2",
                "BipoSH coefficient A^{LM}_{l2-d,l2} at ell = l2",
            ),
            "cl": (("pair", "ell"), "float64", "uK^2", "power spectrum C_l"),
        }
        found = dict(spectra)
        if self.paired:
            for name, (dims, dtype, unit, text) in spectra.items():
                found[f"{name}_circular"] = (dims, dtype, unit, f"{text} of the circular twin")
        if self.kept_npix is not None:
            found["map"] = (("map_name", "pixel"), "float32", "uK", "simulated map, HEALPix RING")
        return found

    def sizes(self) -> dict[str, int]:
        """Length of every dimension."""
        return {
            "realization": self.realizations,
            "pair": len(self.pairs),
            "mode": len(self.modes),
            "ell": self.lmax + 1,
            "map_name": len(self.maps),
            "pixel": self.kept_npix or 0,
        }

    def realization_bytes(self) -> int:
        """Uncompressed size of one realization."""
        sizes = self.sizes()
        return sum(
            int(np.prod([sizes[dim] for dim in dims])) * np.dtype(dtype).itemsize
            for dims, dtype, _, _ in self.variables().values()
        )

    def files(self) -> int:
        """Number of data files of the finished store, coordinates and metadata included."""
        chunks = -(-self.realizations // self.chunk)
        # Coordinates and the summary's 32 variables or so come with metadata and one chunk each.
        return (len(self.variables()) + 1) * (chunks + 1) + 100


def check_writable(path: Path) -> Path:
    """Refuse a place where no store can be made, leave it as it was, and return the innermost folder that exists.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    folder = path.absolute().parent
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    with _refuse_unwritable(path), tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=folder):
        return folder


def create(path: Path, layout: Layout, attributes: Mapping[str, Any]) -> None:
    """Make an empty store at ``path``, whole or not at all.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    with _refuse_unwritable(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        with _refuse_unwritable(path):
            group = zarr.create_group(scratch / "new")
            group.attrs.update({**attributes, "coordinates": "L M d parity"})
            _write_coordinates(group, layout)
            sizes = layout.sizes()
            for name, (dims, dtype, unit, text) in layout.variables().items():
                shape = tuple(sizes[dim] for dim in ("realization", *dims))
                _array(group, name, shape, (layout.chunk, *shape[1:]), dtype, ("realization", *dims), unit, text)
            _array(group, "done", (layout.realizations,), (layout.chunk,), "bool", ("realization",), "1", "finished")
            _consolidate(scratch / "new")
            os.replace(scratch / "new", path)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def write(path: Path, first: int, values: Mapping[str, NDArray], done: NDArray[np.bool_]) -> None:
    """Write whole chunks of realizations from ``first`` on; ``done`` goes last.

    ``values`` holds arrays of shape (n, ...); rows that are not done are stored as NaN.

    Raises
    ------
    RunError
        If the store cannot be written.
    """
    with _faults_named(path):
        group = _open(path, "r+")
        stop = first + len(done)
        for name, rows in values.items():
            _member(group, name)[first:stop] = rows
        _member(group, "done")[first:stop] = done


def read(path: Path, start: int, stop: int, maps: bool = False) -> dict[str, NDArray]:
    """Arrays over realizations ``start`` to ``stop``, ``done`` among them; kept maps only if asked for.

    Raises
    ------
    RunError
        If an array is missing or damaged.
    """
    with _faults_named(path):
        group = _open(path)
        left_out = {"realization"} if maps else {"realization", "map"}
        found = {name: array for name, array in group.arrays() if name not in left_out and _over_realizations(array)}
        return {name: np.asarray(array[start:stop]) for name, array in found.items()}


def done(path: Path, start: int = 0, stop: int | None = None) -> NDArray[np.bool_]:
    """Which realizations from ``start`` to ``stop`` are finished; by default all."""
    with _faults_named(path):
        return np.asarray(_member(_open(path), "done")[start:stop])


def size(path: Path) -> int:
    """Number of realizations that a store has room for."""
    with _faults_named(path):
        return int(_member(_open(path), "done").shape[0])


def attributes(path: Path) -> dict[str, Any]:
    """Attributes of a store.

    Raises
    ------
    InputError
        If there is no mcsim store at ``path``.
    """
    try:
        found = dict(_open(path).attrs)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} is not an ensemble store; name the folder that mcsim run wrote.") from error
    if "science" not in found:
        raise InputError(f"{path} is a Zarr group but not an ensemble store; name the folder that mcsim run wrote.")
    return found


def chunk(path: Path) -> int:
    """Realizations that one task owns."""
    with _faults_named(path):
        return int(_member(_open(path), "done").chunks[0])


def extend(path: Path, realizations: int, update: Mapping[str, Any]) -> None:
    """Grow a store to more realizations; those that are finished stay.

    ``done``, whose length is that of the store, grows last: a call that was cut short is made good by another.
    """
    with _refuse_unwritable(path):
        group = _open(path, "r+")
        growing = {name: array for name, array in group.arrays() if _over_realizations(array)}
        last = growing.pop("done")
        for array in (*growing.values(), last):
            array.resize((realizations, *array.shape[1:]))
            if array is growing["realization"]:
                array[:] = np.arange(realizations)
        group.attrs.update(update)
        _consolidate(path)


def write_summary(path: Path, summary: xr.Dataset) -> None:
    """Put the summary group in place of the former one."""
    with _faults_named(path), tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as scratch:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", category=UserWarning)
            summary.to_zarr(Path(scratch) / "summary", zarr_format=3, consolidated=False)
        shutil.rmtree(path / "summary", ignore_errors=True)
        os.replace(Path(scratch) / "summary", path / "summary")
        _consolidate(path)


def summarised(path: Path) -> int:
    """Number of realizations that the summary speaks of; 0 without one."""
    if not (path / "summary").is_dir():
        return 0
    with _faults_named(path):
        return int(np.asarray(_member(_open(path / "summary"), "count")[()]))


def open_ensemble(path: str | Path) -> xr.Dataset:
    """Open the realizations of a store lazily.

    Returns
    -------
    xarray.Dataset
        ``biposh``, ``cl``, their circular twins, ``done``; coordinates realization, pair, mode (with L, M, d, parity),
        ell.
        ``.sel(mode="L2M0d0")`` picks a spectrum.

    Raises
    ------
    InputError
        If there is no store at ``path``.
    """
    attributes(Path(path))
    with _faults_named(Path(path)):
        return xr.open_zarr(path)


def open_summary(path: str | Path) -> xr.Dataset:
    """Open the summary of a store: means, standard errors, standard deviations, binned spectra and covariances.

    Raises
    ------
    InputError
        If there is no store at ``path``, or it has no summary yet.
    """
    attributes(Path(path))
    if not (Path(path) / "summary").is_dir():
        raise InputError(
            f"{path} has no summary, because no run on it has ended yet; continue it with mcsim run --resume."
        )
    with _faults_named(Path(path)):
        return xr.open_zarr(path, group="summary")


def _write_coordinates(group: zarr.Group, layout: Layout) -> None:
    _index(group, "realization", np.arange(layout.realizations), "index of the realization")
    _index(group, "ell", np.arange(layout.lmax + 1), "degree l2")
    _labels(group, "pair", layout.pairs, "ordered pair of maps X,Y: l1 is of X, l2 of Y")
    _labels(group, "mode", [mode.name for mode in layout.modes], "BipoSH mode")
    for name, text in (("L", "bipolar degree"), ("M", "bipolar order"), ("d", "l2 - l1")):
        _index(group, name, np.array([getattr(mode, name) for mode in layout.modes]), text, "mode")
    _labels(group, "parity", [mode.parity for mode in layout.modes], "parity of l1 + l2 + L", "mode")
    if layout.kept_npix is not None:
        _labels(group, "map_name", layout.maps, "map")


def _array(  # type: ignore[no-untyped-def]
    group: zarr.Group, name: str, shape, chunks, dtype: str, dims: tuple[str, ...], unit: str, text: str
) -> None:
    fill: Any = {"bool": False, "complex128": complex(np.nan, np.nan)}.get(dtype, np.nan)
    array = group.create_array(
        name,
        shape=shape,
        chunks=chunks,
        dtype=dtype,
        fill_value=fill,
        dimension_names=dims,
        compressors=[ZstdCodec(level=1, checksum=True)],
    )
    array.attrs.update({"units": unit, "long_name": text})


def _open(path: Path, mode: Literal["r", "r+"] = "r") -> zarr.Group:
    """The group as it is, not as its consolidated metadata remember it."""
    return zarr.open_group(path, mode=mode, use_consolidated=False)


def _index(group: zarr.Group, name: str, values: NDArray[np.int64], text: str, dim: str | None = None) -> None:
    array = group.create_array(name, data=values, chunks=values.shape, dimension_names=[dim or name])
    array.attrs.update({"units": "1", "long_name": text})


def _labels(group: zarr.Group, name: str, values, text: str, dim: str | None = None) -> None:  # type: ignore[no-untyped-def]
    array = group.create_array(name, shape=(len(values),), dtype=str, dimension_names=[dim or name])
    array[:] = np.array(values, dtype=object)
    array.attrs["long_name"] = text


def _member(group: zarr.Group, name: str) -> zarr.Array:
    array = group[name]
    if not isinstance(array, zarr.Array):
        raise KeyError(name)
    return array


def _over_realizations(array: zarr.Array) -> bool:
    return (getattr(array.metadata, "dimension_names", None) or ("",))[0] == "realization"


def _consolidate(path: Path) -> None:
    """Metadata in one file, so that xarray opens the store in one read; zarr warns that the format is young."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", category=UserWarning)
        zarr.consolidate_metadata(path)


@contextmanager
def _faults_named(path: Path) -> Iterator[None]:
    """Turn what a damaged or vanished store, or a full disk, makes of zarr's calls into one sentence."""
    try:
        yield
    except (OSError, KeyError, ValueError, RuntimeError, TypeError) as error:
        if isinstance(error, RunError):
            raise
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RunError(
            f"The store {path} cannot be used ({type(error).__name__}: {reason}); repair it or its disk."
        ) from error


@contextmanager
def _refuse_unwritable(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"The store {path} cannot be written ({reason}); choose a writable folder with -o.") from error
