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
from typing import Any

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray
from zarr.codecs import ZstdCodec

from mcsim.biposh import Mode
from mcsim.errors import InputError


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
        return (len(self.variables()) + 1) * (chunks + 1) + 20


def check_writable(path: Path) -> None:
    """Refuse a place where no store can be made, and leave it as it was.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    folder = path.absolute().parent
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    with _refuse_unwritable(path), tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=folder):
        pass


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
    """
    group = zarr.open_group(path, mode="r+", use_consolidated=False)
    stop = first + len(done)
    for name, rows in values.items():
        _member(group, name)[first:stop] = rows
    _member(group, "done")[first:stop] = done


def read(path: Path, start: int, stop: int, maps: bool = False) -> dict[str, NDArray]:
    """Arrays over realizations ``start`` to ``stop``, ``done`` among them; kept maps only if asked for."""
    group = zarr.open_group(path, mode="r", use_consolidated=False)
    left_out = {"realization"} if maps else {"realization", "map"}
    found = {name: array for name, array in group.arrays() if name not in left_out and _over_realizations(array)}
    return {name: np.asarray(array[start:stop]) for name, array in found.items()}


def done(path: Path) -> NDArray[np.bool_]:
    """Which realizations are finished, shape (realizations,)."""
    return np.asarray(_member(zarr.open_group(path, mode="r", use_consolidated=False), "done")[:])


def attributes(path: Path) -> dict[str, Any]:
    """Attributes of a store.

    Raises
    ------
    InputError
        If there is no mcsim store at ``path``.
    """
    try:
        found = dict(zarr.open_group(path, mode="r", use_consolidated=False).attrs)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} is not an ensemble store; name the folder that mcsim run wrote.") from error
    if "science" not in found:
        raise InputError(f"{path} is a Zarr group but not an ensemble store; name the folder that mcsim run wrote.")
    return found


def chunk(path: Path) -> int:
    """Realizations that one task owns."""
    return int(_member(zarr.open_group(path, mode="r", use_consolidated=False), "done").chunks[0])


def extend(path: Path, realizations: int, update: Mapping[str, Any]) -> None:
    """Grow a store to more realizations; those that are finished stay."""
    with _refuse_unwritable(path):
        group = zarr.open_group(path, mode="r+", use_consolidated=False)
        for name, array in group.arrays():
            if _over_realizations(array) and name != "realization":
                array.resize((realizations, *array.shape[1:]))
        _index(group, "realization", np.arange(realizations), "index of the realization")
        group.attrs.update(update)
        _consolidate(path)


def write_summary(path: Path, summary: xr.Dataset) -> None:
    """Put the summary group in place of the former one."""
    scratch = path / "summary.new"
    shutil.rmtree(scratch, ignore_errors=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", category=UserWarning)
        summary.to_zarr(scratch, zarr_format=3, consolidated=False)
    shutil.rmtree(path / "summary", ignore_errors=True)
    os.replace(scratch, path / "summary")
    _consolidate(path)


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


def _index(group: zarr.Group, name: str, values: NDArray[np.int64], text: str, dim: str | None = None) -> None:
    array = group.create_array(name, data=values, chunks=values.shape, dimension_names=[dim or name], overwrite=True)
    array.attrs.update({"units": "1", "long_name": text})


def _labels(group: zarr.Group, name: str, values, text: str, dim: str | None = None) -> None:  # type: ignore[no-untyped-def]
    array = group.create_array(name, shape=(len(values),), dtype=str, dimension_names=[dim or name])
    array[:] = np.array(values, dtype=object)
    array.attrs["long_name"] = text


def _member(group: zarr.Group, name: str) -> zarr.Array:
    array = group[name]
    if not isinstance(array, zarr.Array):
        raise InputError(f"{group.store_path} has a group where the array {name} should be; the store is damaged.")
    return array


def _over_realizations(array: zarr.Array) -> bool:
    return (getattr(array.metadata, "dimension_names", None) or ("",))[0] == "realization"


def _consolidate(path: Path) -> None:
    """Metadata in one file, so that xarray opens the store in one read; zarr warns that the format is young."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", category=UserWarning)
        zarr.consolidate_metadata(path)


@contextmanager
def _refuse_unwritable(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"The store {path} cannot be written ({reason}); choose a writable folder with -o.") from error
