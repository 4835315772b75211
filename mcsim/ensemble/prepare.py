"""Prepare observed maps as the maps of a run are prepared, by the same code."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import healpy
import numpy as np
from numpy.typing import ArrayLike

from mcsim import config
from mcsim.config.schema import MapOf
from mcsim.ensemble.maps import POINTING, file_names, write_map
from mcsim.errors import InputError
from mcsim.simulation.preparation import preparation
from mcsim.sphere import spectra
from mcsim.sphere.checks import UNSEEN_BELOW, check_map, check_not_infinite
from mcsim.sphere.header import first_table, opened
from mcsim.sphere.map_files import read_uk
from mcsim.support.arrays import Map, reals
from mcsim.support.folders import appearing, not_filled, unwritable, user_path, writable

SMALLEST_RMS = 2e-3
"""Rms of an observed map over that of the sky of the run, at least: above a map in mK or K that is taken for uK."""

ZEROS = 0.01  #: share of the pixels of an observed map that may be exactly 0: more were not observed

Source = str | Path | Mapping[str, Any] | config.RunConfig


@overload
def prepare(maps: Mapping[str, ArrayLike], source: Source) -> dict[str, Map]: ...
@overload
def prepare(maps: Sequence[ArrayLike], source: Source) -> list[Map]: ...
def prepare(maps: Mapping[str, ArrayLike] | Sequence[ArrayLike], source: Source) -> dict[str, Map] | list[Map]:
    """Prepare observed maps by the steps of ``[[preparation]]``, as a run prepares its simulated maps.

    Parameters
    ----------
    maps
        By name, "channel" or "channel:split"; or all maps of the run in their order, channel by channel. Each in uK,
        RING order, shape (12 nside^2,) with ``map.nside`` of the run, in ``map.frame``, ``healpy.UNSEEN`` where nothing
        was observed.
    source
        Configuration: a TOML file, the name of a packaged workflow, a dict, or a loaded one.

    Returns
    -------
    dict or list
        The prepared maps, uK, named or ordered as given, ``healpy.UNSEEN`` where nothing was observed.

    Raises
    ------
    InputError
        For a run without ``[[preparation]]``, maps that are not its, and steps that cannot be applied.

    Notes
    -----
    Data may need more than simulations do: templates with given coefficients are subtracted from data only.

    Examples
    --------
    >>> import healpy
    >>> import numpy as np
    >>> import mcsim
    >>> model = {
    ...     "name": "mine",
    ...     "sky": {"spectrum": "wmap7", "lmax": 40},
    ...     "map": {"nside": 32},
    ...     "biposh": {"lmax": 20},
    ...     "channel": [
    ...         {
    ...             "name": "W",
    ...             "beam": {"kind": "gaussian", "fwhm_arcmin": 300.0},
    ...             "scan": {"kind": "parallel_transport"},
    ...         }
    ...     ],
    ...     "preparation": [{"kind": "degrade", "nside": 8}, {"kind": "subtract_dipole"}],
    ... }
    >>> x, y, z = healpy.pix2vec(32, np.arange(12 * 32**2))
    >>> prepared = mcsim.prepare({"W": 100.0 + 5.0 * z}, model)
    >>> prepared["W"].shape, bool(abs(prepared["W"]).max() < 0.1)
    ((768,), True)
    """
    if isinstance(maps, str | Path | config.RunConfig) or (isinstance(maps, Mapping) and "channel" in maps):
        raise InputError("maps are a configuration, not maps; give maps first, as in mcsim.prepare(maps, run).")
    run = config.load(source)
    if not run.preparation:
        raise InputError(f"{run.name} has no [[preparation]], so there is nothing to do; declare its steps.")
    names = config.map_names(run)
    if isinstance(maps, Mapping):
        return {name: _prepared(run, name, map_) for name, map_ in maps.items()}
    if len(maps) != len(names):
        raise InputError(f"{len(maps)} maps were given, {run.name} has {len(names)}; give all, or a dict by name.")
    return [_prepared(run, name, map_) for name, map_ in zip(names, maps, strict=True)]


def _prepared(run: config.RunConfig, name: str, map_: ArrayLike) -> Map:
    spec, split = _map_called(run, name)
    given = reals(map_, f"map {name}", healpy.UNSEEN)
    check_map(given, run.map.resolution, f"map {name}")
    check_not_infinite(given, f"map {name}")
    steps = preparation(run, spec, split, observed=True)
    assert steps is not None  # the run has steps
    zeros, seen = int(np.sum(steps.used(given.size) & (given == 0.0))), int(np.sum(given > UNSEEN_BELOW))
    if zeros > ZEROS * seen and given.any():  # a map of zeros has no rms
        raise InputError(
            f"map {name} is exactly 0 in {zeros} pixels, which the steps would take for data; mark what was not "
            "observed as UNSEEN."
        )
    prepared = steps.apply(given)
    _check_rms(run, given[given > UNSEEN_BELOW], f"map {name}")
    return prepared


def _check_rms(run: config.RunConfig, seen: Map, name: str) -> None:
    """Raise InputError for a map that varies far less than its sky: in K it would have 1e-6 of the rms."""
    rms, sky = float(np.nanstd(seen)) if seen.size else 0.0, 0.0
    if run.sky.spectrum is not None:
        ell = np.arange(run.sky.lmax + 1)
        cl = spectra.load(run.sky.spectrum, run.sky.lmax)
        sky = float(np.sqrt(np.sum((2 * ell + 1) * cl) / (4.0 * np.pi)))
    if rms <= SMALLEST_RMS * sky:
        raise InputError(
            f"{name} has an rms of {rms:.3g} uK where the sky of {run.name} has {sky:.3g} uK; is it in another unit? "
            "Say the unit in its header (TUNIT1), or give it in uK."
        )


def _map_called(run: config.RunConfig, name: str) -> MapOf:
    maps = {one.name: one for one in run.each_map}
    if name not in maps:
        raise InputError(f"map {name!r} is no map of {run.name}; use one of {', '.join(maps)}.")
    return maps[name]


def prepare_files(source: Source, files: Sequence[str], folder: str | Path) -> list[Path]:
    """Prepare FITS files and write them to a new folder, complete or not at all, which :func:`mcsim.diagnose` can read.

    Files are ``.../{channel}.fits`` or ``{channel}_{split}.fits``, or NAME=PATH with any path. Unit and frame are those
    of the header; without them uK and the frame of the run. What it says of the samples (POINTING) is handed on.
    """
    run = config.load(source)
    target, names = user_path(folder), file_names(run)
    not_filled(target)
    read, pointing = dict[str, Map](), dict[str, list[tuple[str, Any]]]()
    for file in files:
        name, path = _called(run, names, file)
        if name in read:
            raise InputError(f"map {name} is given twice, the second time as {file}; give each map once.")
        read[name] = read_uk(path, run.map.frame, _map_called(run, name).channel.frequency_ghz)
        with opened(path) as hdus:
            header = first_table(hdus).header
            pointing[name] = [card for card in POINTING.values() if header.get(card[0]) == card[1]]
    done = prepare(read, run)
    writable(target.absolute().parent)
    keywords = [("RUN", run.name.encode("ascii", "backslashreplace").decode()), ("DIGEST", config.digest(run))]
    with unwritable(target, "choose another folder with -o"), appearing(target) as scratch:
        for name, map_uk in done.items():
            write_map(scratch / names[name], map_uk, config.prepared_grid(run)[1], [*keywords, *pointing[name]])
    return [target / names[name] for name in done]


def _called(run: config.RunConfig, names: Mapping[str, str], file: str) -> tuple[str, Path]:
    """Return the name of a map of the run, and the path of its file: NAME is also what the file would be called."""
    named, equals, path = file.partition("=")
    named = next((name for name, own in names.items() if own == f"{named}.fits"), named)
    if not equals or (named not in names and os.path.isfile(user_path(file))):
        path, equals = file, ""
        named = next((name for name, own in names.items() if own == Path(file).name), "")
    if named not in names:
        known = ", ".join(names.values())
        if equals:
            raise InputError(f"{named} of {file} is no map of {run.name}; use one of {', '.join(names)}.")
        raise InputError(f"{file} is none of {known}; rename it, or say which map it is: NAME={file}.")
    return named, user_path(path)
