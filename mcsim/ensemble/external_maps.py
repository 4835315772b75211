"""Maps of another program: the maps of one realization in order, and those that are stored as files."""

import glob
import hashlib
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Formatter
from typing import Any, NamedTuple

import healpy
import numpy as np

from mcsim import config
from mcsim.config import arrays
from mcsim.errors import InputError
from mcsim.sphere import header
from mcsim.sphere.checks import UNSEEN_BELOW
from mcsim.sphere.map_files import read_uk
from mcsim.support.arrays import Alm, Map, reals
from mcsim.support.folders import unreadable
from mcsim.support.loading import once_per_content

ATTRIBUTES = {
    "units": ("unit", "tunit", "bunit"),
    "frame": ("coordsys", "coord"),
    "ordering": ("order", "indexing_scheme"),
}
"""Attributes of given maps that are read, each with other names for it, in any case."""


class Part(NamedTuple):
    """Name one map: as in a run (``W1:half1``), its channel and split, and what its unit and frame are read with."""

    name: str
    channel: str
    split: str | None
    frequency_ghz: float | None
    frame: str


@dataclass(frozen=True)
class Source(ABC):
    """Offer simulated maps of another program."""

    parts: tuple[Part, ...]  #: the maps of one realization, in order
    label: str  #: the source in words
    effects: tuple[str, ...] = ()  #: names of the effects that it can add
    takes_sky: bool = False  #: True if the sky can be given

    @property
    def count(self) -> int | None:
        """Return the number of realizations; None: as many as are wanted."""
        return None

    def words(self, seed: int, realization: int) -> str:
        """Return which maps these are, for messages."""
        return f"realization {realization} of {self.label}"

    def maps(
        self, seed: int, realization: int, effects: Sequence[config.Effect] = (), sky: Alm | None = None
    ) -> list[Map]:
        """Return the maps of one realization, uK, in the order of the parts; InputError if one is missing.

        ``seed`` tells streams of realizations apart; ``sky``: a_lm in place of those that would be drawn.
        """
        where = self.words(seed, realization)
        return in_order(self._given(seed, realization, effects, sky), self.parts, where)

    @abstractmethod
    def identity(self) -> str:
        """Return a hash of all that the maps depend on, besides the description of the instrument."""

    @abstractmethod
    def _given(self, seed: int, realization: int, effects: Sequence[config.Effect], sky: Alm | None) -> Any:
        """Return maps by name, as mappings or xarray objects."""


def in_order(given: Any, parts: Sequence[Part], where: str) -> list[Map]:
    """Return maps in the order of the parts, uK; InputError for one missing, given twice or no array of numbers.

    ``given``: mappings, xarray objects, or both nested: channel, then split. Names may be ``W1:half1``, ``W1/half1`` or
    ``W1_half1``. An attribute ``units`` says another unit; ``frame`` and ``ordering`` are those of the parts and RING,
    or missing.
    """
    names = {alias: part for part in parts for alias in (part.name, *(part.name.replace(":", s) for s in "/_"))}
    if len(parts) == 1:
        names[""] = parts[0]
    found: dict[str, Map] = {}
    for labels, one in _flat(given):
        part = names.get(label := ":".join(labels))
        if part is not None:
            name = f"the map {part.name} of {where}"
            if part.name in found:
                raise InputError(f"{name} is given twice, the second time as {label!r}; give each map under one name.")
            found[part.name] = in_uk(one, name, part.frame, part.frequency_ghz)
    missing = [part.name for part in parts if part.name not in found]
    if missing:
        there = ", ".join(":".join(labels) or "an unnamed map" for labels, _ in _flat(given)) or "none"
        raise InputError(f"{where} lacks the map {missing[0]}; it has {there}. Give maps by name.")
    return [found[part.name] for part in parts]


def _flat(given: Any, labels: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield arrays with the names of their channels and splits."""
    import xarray as xr  # here and below: workers of mcsim's own simulator start without it

    if isinstance(given, xr.Dataset):
        labelled = {name: one for name, one in given.data_vars.items() if {"map_name", "channel"} & set(one.dims)}
        whole = {name: one for name, one in labelled.items() if set(one.dims) - {"map_name", "channel", "split"}}
        if len(whole) > 1:
            raise InputError(f"a dataset has maps in {', '.join(map(str, whole))}; give the variable that is meant.")
        given = next(iter(whole.values())) if whole else {n: one for n, one in given.data_vars.items() if one.ndim}
    if isinstance(given, xr.DataArray):
        for dim in ("map_name", "channel", "split"):
            if dim in given.dims:
                for place, label in enumerate(given[dim].values):
                    yield from _flat(given.isel({dim: place}), (*labels, str(label)))
                return
    if isinstance(given, Mapping):
        for name, one in given.items():
            yield from _flat(one, (*labels, str(name)))
    elif given is not None:
        yield labels, given


def in_uk(one: Any, name: str, frame: str, frequency_ghz: float | None) -> Map:
    """Return a given map in uK, ``healpy.UNSEEN`` where not observed; its attribute ``units`` may say another unit.

    Values that are not finite stay so: they do not say that a pixel was not observed, and diagnoses refuse them.
    ``name`` names it in messages. InputError for no array of numbers, or if its attributes ``frame`` or ``ordering``
    say another frame or another order than RING. Their other usual names are read too (:data:`ATTRIBUTES`).
    """
    own = {str(key).strip().lower(): _word(value) for key, value in (getattr(one, "attrs", None) or {}).items()}
    if own.get("order", "").removesuffix(".0").isdecimal():  # that of the resolution: 5 is nside 32
        del own["order"]
    said = {key: next((own[n] for n in (key, *names) if own.get(n)), None) for key, names in ATTRIBUTES.items()}
    found = reals(one, name, healpy.UNSEEN)
    factor = header.to_uk(said["units"], Path(name), frequency_ghz)
    stated = header.frame_named(said["frame"], name, "frame")
    if stated not in (None, frame):
        raise InputError(f"{name} is in {stated} coordinates, but the model is {frame}; rotate it first.")
    order = str(said["ordering"] or "RING").strip().upper()
    if order != "RING":
        raise InputError(f"{name} has ordering = {order!r}, but maps in memory and stores are RING; reorder it first.")
    return np.where((found > UNSEEN_BELOW) | ~np.isfinite(found), factor * found, healpy.UNSEEN)


def _word(value: Any) -> str:
    """Return an attribute as text, of bytes, as HDF5 files hold them, too; empty for what says nothing."""
    if value is None:
        return ""
    word = (value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)).strip()
    return "" if word.lower() in header.SILENT else word


def parts_of(run: config.RunConfig) -> Iterator[Part]:
    """Yield the maps of a run, as they are analysed."""
    frame = config.prepared_grid(run)[1]
    for one in run.each_map:
        yield Part(one.name, one.channel.name, one.split, one.channel.frequency_ghz, frame)


@dataclass(frozen=True)
class FitsMaps(Source):
    """FITS files, named by a template with {realization}, {channel} and {split}."""

    template: str = ""
    realizations: tuple[int, ...] = ()

    @property
    def count(self) -> int:
        return len(self.realizations)

    def words(self, seed: int, realization: int) -> str:
        return f"realization {self.realizations[realization]} of {self.label}"

    def identity(self) -> str:
        files = [self._path(part, r) for r in self.realizations for part in self.parts]
        return hash_of(*map(_of_file, files))

    def _path(self, part: Part, realization: int) -> Path:
        return Path(self.template.format(channel=part.channel, split=part.split, realization=realization))

    def _given(self, seed: int, realization: int, effects: Sequence[config.Effect], sky: Alm | None) -> Any:
        files = {part.name: (part, self._path(part, self.realizations[realization])) for part in self.parts}
        return {name: read_uk(path, part.frame, part.frequency_ghz) for name, (part, path) in files.items()}


@dataclass(frozen=True)
class StoredMaps(Source):
    """A Zarr store that xarray opens, or a .npy file of shape (realization, map, pixel)."""

    path: str = ""

    def _opened(self) -> Any:
        """Return an array of the maps of a .npy file, or the dataset of a store."""
        if not self.path.endswith(".npy"):
            return _zarr(self.path)
        with unreadable(self.path, "an array of numpy", "write numbers with np.save"):
            found = np.load(self.path, mmap_mode="r", allow_pickle=False)
        if found.ndim != 3 or found.shape[1] != len(self.parts):
            raise InputError(
                f"{self.path} has the shape {found.shape}; give (realization, map, pixel), with the "
                f"{len(self.parts)} maps {', '.join(part.name for part in self.parts)}."
            )
        return found

    @property
    def count(self) -> int:
        found = self._opened()
        return len(found) if isinstance(found, np.ndarray) else int(found.sizes["realization"])

    def identity(self) -> str:
        path = Path(self.path)
        files = sorted(one for one in path.rglob("*") if one.is_file()) if path.is_dir() else [path]
        return hash_of(*((str(one.relative_to(path)), *_of_file(one)[1:]) for one in files))

    def _given(self, seed: int, realization: int, effects: Sequence[config.Effect], sky: Alm | None) -> Any:
        found = self._opened()
        if isinstance(found, np.ndarray):
            return {part.name: one for part, one in zip(self.parts, found[realization], strict=True)}
        return found.isel(realization=realization)


def fits_maps(parts: tuple[Part, ...], template: str) -> FitsMaps:
    """Find the realizations of a template."""
    found = FitsMaps(parts, _label(template), template=os.path.abspath(template))
    try:
        named = {path: (part, r) for part in parts for path, r in _numbered(found.template, part)}
        numbers = sorted({r for _, r in named.values()})
        others = sorted(path for path, (part, r) in named.items() if str(found._path(part, r)) != path)
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(
            f"{template} is no template of files ({error}); use {{realization}}, {{channel}} and {{split}}."
        ) from None
    if others:
        raise InputError(
            f"{others[0]} fits {template} but for the digits of its number; write {{realization}} with the digits that "
            "the names have, {realization:05d} for 00001 and {realization} for 1, or move it away."
        )
    if not numbers:
        raise InputError(
            f"no file fits {template}; check its folder, and that {{realization}} stands once, where the number does."
        )
    if len({found._path(part, numbers[0]) for part in parts}) < len(parts):
        raise InputError(f"{template} has one file for several maps; write {{channel}} and {{split}} into it.")
    for r in numbers:
        for part in parts:
            if not os.path.isfile(found._path(part, r)):
                raise InputError(f"{found._path(part, r)} does not exist, the map {part.name} of realization {r}.")
    return FitsMaps(parts, found.label, template=found.template, realizations=tuple(numbers))


def _numbered(template: str, part: Part) -> Iterator[tuple[str, int]]:
    """Yield the files of one map that a template names, with the numbers of their realizations."""
    pattern, expression = "", ""
    for text, field, _, _ in Formatter().parse(template):
        pattern, expression = pattern + glob.escape(text), expression + re.escape(text)
        if field is not None:
            own = {"channel": part.channel, "split": part.split}.get(field)
            pattern += "*" if own is None else glob.escape(own)
            expression += r"(\d+)" if own is None else re.escape(own)
    for match in (re.fullmatch(expression, path) for path in glob.glob(pattern)):
        if match is not None and match.re.groups:
            yield match[0], int(match[1])


def _label(template: str) -> str:
    """Return the end of a template that says which maps these are: its first field, and the folder that has it."""
    places = Path(template).parts
    first = next(place for place, part in enumerate(places) if "{" in part)
    return str(Path(*places[max(first - 1, 0) :])) if first < len(places) - 1 else places[first]


@once_per_content(1)
def _zarr(path: str) -> Any:
    """Open a store once for all realizations, and again if it was written anew."""
    import xarray as xr

    with unreadable(path, "a Zarr store", "give one of maps"):
        found = xr.open_zarr(path, chunks=None, consolidated=False)
    return _checked_stack(found, path)


def _checked_stack(found: Any, where: str) -> Any:
    if "realization" not in found.sizes:
        raise InputError(f"{where} has the dimensions {', '.join(map(str, found.sizes))}; name one realization.")
    done = getattr(found, "data_vars", {}).get("done")
    if done is not None and done.dims == ("realization",):  # of a store of mcsim run
        unfinished = np.flatnonzero(~done.values.astype(bool))
        if unfinished.size:
            raise InputError(
                f"{where} has {unfinished.size} realizations that are not finished, {unfinished[0]} among them; finish "
                "it with mcsim run, or give the others in Python, as xarray selects them by their variable done."
            )
    return found


def stacked(given: Any, parts: tuple[Part, ...]) -> str:
    """Write maps that are in memory once into the cache, and return the path of the file."""
    import xarray as xr

    if isinstance(given, np.ndarray):
        if given.ndim != 3:
            raise InputError(f"the given maps have the shape {given.shape}; give (realization, map, pixel).")
        names = [part.name for part in parts]
        if given.shape[1] != len(names):
            raise InputError(f"{given.shape[1]} maps of a realization were given, the model has {', '.join(names)}.")
        given = xr.DataArray(given, dims=("realization", "map_name", "pixel"), coords={"map_name": names})
    stack = _checked_stack(given, "what is given")
    number = int(stack.sizes["realization"])
    if number == 0:
        raise InputError("what is given has no realization; give some.")

    def rows(r: int) -> list[Map]:
        return in_order(stack.isel(realization=r), parts, f"realization {r} of the given maps")

    shapes = {one.shape for one in rows(0)}
    if len(shapes) > 1 or len(shape := shapes.pop()) != 1:
        raise InputError("the given maps are no maps of one resolution; give arrays over pixels, in RING order.")

    def write(folder: Path) -> None:
        layout = {"descr": "<f8", "fortran_order": False, "shape": (number, len(parts), *shape)}
        with (folder / "maps.npy").open("wb") as stream:
            np.lib.format.write_array_header_1_0(stream, layout)
            for r in range(number):
                stream.write(np.stack(rows(r)).astype("<f8").tobytes())

    return str(arrays.kept(write, "maps") / "maps.npy")


def _of_file(path: Path) -> tuple[str, int, str]:
    return path.name, path.stat().st_size, arrays.sha256_of(path)


def hash_of(*parts: Any) -> str:
    """Return the SHA-256 of values, from their texts."""
    return hashlib.sha256("\n".join(map(repr, parts)).encode()).hexdigest()
