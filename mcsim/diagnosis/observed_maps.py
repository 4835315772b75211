"""Observed maps from a folder, refused in one sentence where they cannot be what the model describes."""

from collections.abc import Sequence
from pathlib import Path

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.wiener_filter import Model
from mcsim.errors import InputError
from mcsim.sphere import header, healpix

Map = NDArray[np.float64]

MISSING = 0.01
"""Largest fraction of the pixels that the believed scan hits which data may leave out."""

RMS_RATIO = 20.0
"""Largest ratio of the rms of a map to that of the model, either way: beyond it the unit is wrong."""


def read_maps(model: Model, folder: str | Path) -> list[Map]:
    """Maps of every channel and split, in the order of the model's.

    Parameters
    ----------
    model
        What is believed.
    folder
        With ``{channel}.fits``, or ``{channel}_{split}.fits`` where the model has splits; HEALPix in uK (or the unit
        of its header), ``healpy.UNSEEN`` where not observed, in RING order or with an honest header.

    Raises
    ------
    InputError
        For a file that is missing or unreadable, has another nside, frame or unit, or values that are no map of this
        survey: not finite, constant, without what the believed scan saw, or far from the size of the model.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; give one with the observed maps, {_file_name(model, 0)} and so on.")
    return [_read(model, i, folder / _file_name(model, i)) for i in range(len(model.parts))]


def checked(model: Model, maps: Sequence[Map]) -> list[Map]:
    """Maps given as arrays, in the order of the model's, uK; refused like those of a folder."""
    if len(maps) != len(model.parts):
        raise InputError(f"{len(maps)} maps were given, the model has {len(model.parts)}; give one for each.")
    return [
        _checked(model, i, np.asarray(map_, dtype=np.float64), f"map {model.parts[i].name}")
        for i, map_ in enumerate(maps)
    ]


def _file_name(model: Model, part: int) -> str:
    channel, _, split = model.parts[part].name.partition(":")
    return f"{channel}_{split}.fits" if split else f"{channel}.fits"


def _read(model: Model, part: int, path: Path) -> Map:
    if not path.is_file():
        raise InputError(
            f"{path} does not exist; the model has a map {model.parts[part].name}, give it under that name."
        )
    map_, frame, unit = healpix.read_map(path)
    expected = model.survey.config.map.frame
    if frame not in (None, expected):
        raise InputError(f"{path} is in {frame} coordinates, the model in {expected}; rotate the map.")
    frequency = model.survey.channels[model.parts[part].channel].site.frequency_ghz
    factor = header.to_uk(unit, path, frequency)
    return _checked(model, part, np.where(map_ == healpy.UNSEEN, map_, factor * map_), str(path))


def _checked(model: Model, part: int, map_: Map, name: str) -> Map:
    """The map, if it can be of the survey."""
    if map_.shape != (12 * model.nside**2,):
        size = healpy.npix2nside(map_.size) if map_.ndim == 1 and healpy.isnpixok(map_.size) else None
        found = f"the shape {map_.shape}" if size is None else f"nside {size}"
        raise InputError(f"{name} has {found}, the model {model.nside}; bring them to the same.")
    broken = int(np.sum(~np.isfinite(map_)))
    if broken:
        raise InputError(f"{name} has {broken} pixels that are not finite; mark what was not observed as UNSEEN.")
    unseen = map_ == healpy.UNSEEN
    fiducial = model.parts[part].precision > 0
    lost = float(np.mean(unseen[fiducial]))
    if lost > MISSING:
        raise InputError(
            f"{name} leaves out {100 * lost:.0f} % of the pixels that the believed scan hits, at most "
            f"{100 * MISSING:.0f} % may be; give the model a mask (map.mask) that leaves them out too."
        )
    seen = map_[fiducial & ~unseen]
    rms = float(np.std(seen))
    if rms == 0.0:
        raise InputError(f"{name} is constant; give an observed map.")
    ratio = rms / expected_rms(model, part)
    if not 1.0 / RMS_RATIO < ratio < RMS_RATIO:
        raise InputError(
            f"{name} has an rms of {rms:.3g} uK where the model expects {rms / ratio:.3g} uK; is it in another "
            "unit, or is the dipole still in it? Say the unit in its header (TUNIT1), or give it in uK."
        )
    return map_


def expected_rms(model: Model, part: int) -> float:
    """Rms over the sky of what the model expects in a map, sky and noise, uK."""
    whole = model.survey
    assert whole.cl is not None  # a model of a diagnosis has a spectrum
    channel = whole.channels[model.parts[part].channel]
    response = channel.response.factors[0].real
    ell = np.arange(response.size)
    sky = float(np.sum((2 * ell + 1) / (4 * np.pi) * whole.cl * response**2))
    precision = model.parts[part].precision
    return float(np.sqrt(sky + np.mean(1.0 / precision[precision > 0])))


def exchanges(names: Sequence[str]) -> list[tuple[int, ...]]:
    """Orders of the maps in which two channels, or two splits of all channels, are exchanged."""
    places = {name: place for place, name in enumerate(names)}
    channels = list(dict.fromkeys(name.partition(":")[0] for name in names))
    splits = list(dict.fromkeys(name.partition(":")[2] for name in names))
    found = []
    for kind, values in ((0, channels), (2, splits)):
        for i, one in enumerate(values):
            for other in values[:i]:
                swap = {one: other, other: one}
                order = []
                for name in names:
                    parts = list(name.partition(":"))
                    parts[kind] = swap.get(parts[kind], parts[kind])
                    order.append(places["".join(parts)])
                found.append(tuple(order))
    return found
