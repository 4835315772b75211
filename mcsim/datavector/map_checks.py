"""Read observed maps, and refuse maps that a survey cannot have made."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations, compress
from pathlib import Path

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.datavector.filter_model import Model, sky_variance
from mcsim.datavector.parts import Part
from mcsim.datavector.summaries import Element
from mcsim.ensemble.external_maps import in_uk, parts_of
from mcsim.ensemble.maps import POINTING, file_names, first_realization
from mcsim.errors import InputError
from mcsim.simulation import simulate
from mcsim.simulation.survey import SurveyMap
from mcsim.sphere import alm, healpix, map_files
from mcsim.sphere.checks import UNSEEN_BELOW
from mcsim.sphere.header import T_CMB_K, first_table, opened
from mcsim.sphere.mask import kept_mask
from mcsim.sphere.pixel_order import check_ring
from mcsim.support.arrays import Map
from mcsim.support.folders import user_path
from mcsim.support.numbers import some

ZEROS = 3  #: times as many pixels as have any other value, as maps of few digits have, that may be exactly 0
QUIET = 1e-3  #: noise of a pixel, uK, below which two maps of a channel may be the same but for round-off
WHOLE = 0.9  #: mean or dipole of a map over that of the CMB, from which on that is in it
ALIKE = 1e-7  #: rms of their difference, over that of one of them, up to which they are


def checked_map(model: Model, part: Part, map_: Map, name: str) -> Map:
    """Return the map, called ``name``, if it can be of the survey; else raise InputError."""
    _check_size(model.survey.config, map_, name)
    broken = int(np.sum(~np.isfinite(map_)))
    if broken:
        raise InputError(f"{name} has {broken} pixels that are not finite; mark what was not observed as UNSEEN.")
    map_ = np.where(map_ > UNSEEN_BELOW, map_, healpy.UNSEEN)  # of single precision it is another number
    fiducial, limits = part.precision > 0, model.settings
    lost = share_left_out(part, map_)
    if lost > limits.missing_share:
        raise InputError(
            f"{name} leaves out {100 * lost:.3g} % of the pixels that the fiducial scan hits, at most "
            f"{100 * limits.missing_share:g} % may be; give the model a mask (map.mask) that leaves them out too."
        )
    if lost and part.name in (m.name for channel in model.survey.channels for m in channel.maps if _quiet(m)):
        raise InputError(
            f"{name} leaves out {round(lost * fiducial.sum())} pixels that the model observes, and the model has no "
            "noise in it, or hardly any: nothing in their place is as exact as the map; give the model a mask "
            "(map.mask) that leaves them out too, or noise."
        )
    seen = map_[fiducial & (map_ != healpy.UNSEEN)]
    values, counts = np.unique(seen, return_counts=True)
    zeros, others = int(counts[values == 0.0].sum()), int(counts[values != 0.0].max(initial=1))
    if zeros > ZEROS * others and not model.survey.config.preparation:  # which may multiply with zeros
        raise InputError(
            f"{name} is exactly 0 in {zeros} pixels that the model observes; mark what was not observed as UNSEEN, and "
            "give the model a mask (map.mask) that leaves it out too."
        )
    check_ring(map_, name)
    rms = float(np.std(seen))
    if rms == 0.0:
        raise InputError(f"{name} is constant; give an observed map.")
    sky, noise = sky_variance(model.cl, model.response[part.channel]), np.mean(1.0 / part.precision[fiducial])
    ratio = rms / float(np.sqrt(sky + noise))
    if not 1.0 / limits.rms_ratio < ratio < limits.rms_ratio:
        raise InputError(
            f"{name} has an rms of {rms:.3g} uK where the model expects {rms / ratio:.3g} uK, beyond a factor of "
            f"{limits.rms_ratio:g} either way; is it in another unit, or is the dipole still in it? Say the unit in "
            "its header (TUNIT1), or give it in uK."
        )
    return map_


def check_pixels(model: Model, elements: Sequence[Element]) -> None:
    """Raise InputError for a map with fewer observed pixels than numbers are measured of it."""
    for part in model.parts:
        own = (model.channels[part.channel],)
        needed = sum(one.channels == own and one.split in (None, part.split) for one in elements)
        if (observed := int(np.sum(part.precision > 0.0))) < needed:
            raise InputError(
                f"the model observes {observed} pixels of map {part.name}, and a diagnosis measures {needed} numbers "
                f"of it, for which it needs {needed} pixels or more; give a mask (map.mask) that hides less, or finer "
                "pixels."
            )


def share_left_out(part: Part, map_: Map) -> float:
    """Return the share of the pixels of a map of the model that a map leaves out in its place."""
    return float(np.mean(map_[part.precision > 0] == healpy.UNSEEN))


def exchanges(parts: Sequence[Part]) -> list[tuple[int, ...]]:
    """Return the orders of the maps in which two channels, or two splits of all channels or of one, are exchanged."""
    keys: list[tuple[int | str | None, ...]] = [(part.channel, part.split) for part in parts]
    found = []
    for axis in (0, 1):
        for one, other in combinations(dict.fromkeys(key[axis] for key in keys), 2):
            swap = {one: other, other: one}
            moved = [tuple(swap.get(k, k) if i == axis else k for i, k in enumerate(key)) for key in keys]
            found.append(tuple(keys.index(key) for key in moved))
    if len({part.channel for part in parts}) > 1:  # else the splits of all channels are those of one
        for one, other in combinations(range(len(parts)), 2):
            if parts[one].channel == parts[other].channel:
                found.append(tuple({one: other, other: one}.get(i, i) for i in range(len(parts))))
    return found


def _check_size(run: config.RunConfig, map_: Map, name: str) -> None:
    """Raise InputError for a map with other pixels than those of a run; one without pixels is refused as a model."""
    nside = config.prepared_grid(run)[0]
    if nside and map_.shape != (12 * nside**2,):
        size = healpy.npix2nside(map_.size) if map_.ndim == 1 and healpy.isnpixok(map_.size) else None
        found = f"the shape {map_.shape}" if size is None else f"nside {size}"
        remedy = "set map.nside of the model to that of the data, or say in [[preparation]] how they were degraded"
        if run.preparation and size == run.map.nside:
            remedy = "do to the data what [[preparation]] does to simulations (mcsim prepare)"
        raise InputError(f"{name} has {found}, the model {nside}; {remedy}.")


def given_maps(run: config.RunConfig, data: str | Path | Sequence[Map] | Mapping[str, Map]) -> dict[str, Map]:
    """Return the maps of a folder, or given ones, in the order of the run's, uK, by the names of messages.

    InputError is raised for what :func:`read_maps` refuses without a model, which may take minutes.
    """
    return _read(run, data) if isinstance(data, str | Path) else _taken(run, data)


def checked_maps(model: Model, given: Mapping[str, Map]) -> list[Map]:
    """Return the maps of :func:`given_maps` if they can be of the survey; else raise InputError."""
    named = zip(model.parts, given.items(), strict=True)
    maps = [checked_map(model, part, map_, name) for part, (name, map_) in named]
    check_differ(model, maps, list(given))
    return maps


def read_maps(model: Model, data: str | Path | Sequence[Map] | Mapping[str, Map]) -> list[Map]:
    """Read the maps of every channel and split, in the order of the model's, uK.

    A folder has ``{channel}.fits``, or ``{channel}_{split}.fits`` where the model has splits: HEALPix in uK (or the
    unit of its header), ``healpy.UNSEEN`` if not observed, in RING order or with a header that says another. Given maps
    are in uK, or as their attributes say, by name or in the order of the model's. InputError is raised if one is
    missing or unreadable, has another nside, frame or unit, or values that are no map of this survey: not finite,
    constant, without what the fiducial scan hits, or far from the size of the model. Others are not read, which a
    warning says.
    """
    return checked_maps(model, given_maps(model.survey.config, data))


def of_pixel_means(model: Model, folder: str | Path) -> bool:
    """Return True if the headers of all maps of a folder say that mcsim's default route made them."""
    name, wanted = POINTING[False]
    files = file_names(model.survey.config)
    for part in model.parts:
        with opened(user_path(folder) / files[part.name]) as hdus:
            if first_table(hdus).header.get(name) != wanted:
                return False
    return True


def _warn_of_others(names: Iterable[str]) -> None:
    """Warn of what stands beside the maps, and may be one that the model should have."""
    if found := some(sorted(names), 3):
        warnings.warn(
            f"{found} in the data will not be looked at: no map of the model has that name; if it "
            "is an observed map, give the model its channel or split.",
            stacklevel=3,
        )


def warn_of_no_noise(model: Model) -> None:
    """Warn of maps of a model that have no noise, where the data may have some."""
    if found := [m.name for channel in model.survey.channels for m in channel.maps if m.noise_uk is None]:
        warnings.warn(
            f"the model has no noise in {some(found, 3)}, so that noise of the data is a gap that no effect explains; "
            "give the channel noise (noise.sigma0_uk or noise.depth_uk_arcmin above 0), unless the data have none.",
            stacklevel=3,
        )


def warn_of_parts_of_pixels(model: Model) -> None:
    """Warn of finer masks than the maps that hide a part of pixels, each of which a diagnosis uses as a whole."""
    run, found = model.survey.config, set()
    for channel, split in run.each_map:
        if (mask := channel.mask or run.map.mask) is not None:
            found.add(config.channel_path(mask, channel.name, split))
    for path in sorted(found):
        fine, _, _ = map_files.read_map(path, bad=0.0)
        weight = kept_mask(path, model.nside, model.frame, run.map.mask_frame)
        parts = int(np.sum((weight > 0.0) & (weight < 1.0)))
        if fine.size > weight.size and parts and np.isin(fine, (0.0, 1.0)).all():
            said = (
                f"{path} has nside {healpy.npix2nside(fine.size)} and hides a part of {parts} pixels of the maps, of "
                f"nside {model.nside}; a diagnosis uses these as a whole, with what the mask hides of them, which a "
                "mask of the maps' nside that is 0 there leaves out."
            )
            warnings.warn(str(InputError(said)), stacklevel=3)  # as errors name what was given as an array


def check_subtracted(model: Model, given: Mapping[str, Map]) -> None:
    """Raise InputError for maps, of :func:`given_maps`, with the monopole or the dipole of the CMB still in them."""
    dipole = np.asarray(model.survey.channels[0].site.dipole_uk)
    pattern = dipole @ healpix.centres(model.nside)
    for part, (name, map_) in zip(model.parts, given.items(), strict=True):
        seen = (part.precision > 0) & (map_ > UNSEEN_BELOW) & np.isfinite(map_)
        if not seen.any():
            continue
        mean = float(np.mean(map_[seen]))
        if mean > WHOLE * 1e6 * T_CMB_K:
            raise InputError(
                f"{name} has a mean of {mean:.4g} uK, about that of the CMB itself ({1e6 * T_CMB_K:g} uK), which is in "
                "no simulation; subtract it, and give the differences from it."
            )
        share, error = _share_of(pattern, model, part, map_, seen)
        if abs(share - 1.0) < 1.0 - WHOLE and error < (1.0 - WHOLE) / 2.0:
            raise InputError(
                f"{name} has {share:.3g} times the dipole of the CMB, {np.linalg.norm(dipole):g} uK, in it, which is "
                "subtracted from simulations; subtract it, as mcsim prepare does by a step subtract_dipole."
            )


def _share_of(pattern: Map, model: Model, part: Part, map_: Map, seen: NDArray[np.bool_]) -> tuple[float, float]:
    """Return how many times a pattern is in the seen pixels of a map, and the error by sky and noise of the model."""
    t = np.where(seen, pattern - np.mean(pattern[seen]), 0.0)
    square = float(t @ t)
    if square == 0.0:
        return 0.0, np.inf
    power = alm.power(healpix.adjoint(t, model.lmax), model.lmax)
    sky = float(np.dot(model.cl * model.response[part.channel] ** 2, power))
    noise = float(np.sum(t[seen] ** 2 / part.precision[seen]))
    return float(t[seen] @ map_[seen]) / square, float(np.sqrt(sky + noise)) / square


def _quiet(map_: SurveyMap) -> bool:
    """Return True for a map of the model without noise, or with hardly any."""
    return map_.noise_uk is None or bool(np.max(map_.noise_uk) < QUIET)


def check_splits_differ(model: Model) -> None:
    """Raise InputError for two maps of a channel that are simulated alike: nothing is measured by their difference.

    Its numbers would be constant, or have the scatter of round-off alone.
    """
    each = [[m for m in c.maps if _quiet(m)] for c in model.survey.channels]
    quiet = [pair for maps in each for pair in combinations(maps, 2)]
    if not quiet:
        return
    names = [part.name for part in model.parts]
    drawn = dict(zip(names, simulate.maps(model.survey, 0), strict=True))
    for one, other in quiet:
        a, b = (drawn[m.name] for m in (one, other))
        seen = (a != healpy.UNSEEN) & (b != healpy.UNSEEN)
        if seen.any() and np.std((a - b)[seen]) <= ALIKE * np.std(a[seen]):
            raise InputError(
                f"the model has no noise in {one.name} and {other.name}, or hardly any, and simulates the same map for "
                f"both, so that their difference measures nothing; give their channel noise (noise.sigma0_uk or "
                f"noise.depth_uk_arcmin), or leave out map.splits."
            )


def check_differ(model: Model, maps: Sequence[Map], names: Sequence[str]) -> None:
    """Raise InputError for two maps that are the same although both have noise of their own: one is a copy."""
    noisy = [m.noise_uk is not None for channel in model.survey.channels for m in channel.maps]
    for (one, name), (other, copied) in combinations(compress(zip(maps, names, strict=True), noisy), 2):
        if np.array_equal(one, other):
            raise InputError(f"{copied} is the same map as {name}; give each channel and split its own.")


def _read(run: config.RunConfig, folder: str | Path) -> dict[str, Map]:
    """Read the maps of a folder, by path; warn of others."""
    folder, names, found = user_path(folder), file_names(run), {}
    if not folder.is_dir():
        first = next(iter(names.values()))
        raise InputError(f"{folder} is no folder; give one with the observed maps, {first} and so on.")
    for part in parts_of(run):
        path = folder / names[part.name]
        if not path.is_file():
            inside = first_realization(folder)
            remedy = "give it under that name" if inside == folder else f"give the folder of a realization, {inside}"
            known = names.values()
            others = sorted(each.name for each in folder.iterdir() if each.is_file() and each.name not in known)
            beside = f" (the folder has {some(others, 3)})" if others else ""
            raise InputError(f"{path} does not exist; the model has a map {part.name}, {remedy}{beside}.")
        found[str(path)] = map_files.read_uk(path, part.frame, part.frequency_ghz)
        _check_size(run, found[str(path)], str(path))
    _warn_of_others(path.name for path in folder.glob("*.fits*") if path.name not in names.values())
    return found


def _taken(run: config.RunConfig, maps: Sequence[Map] | Mapping[str, Map]) -> dict[str, Map]:
    """Take given maps, by name or in the order of the run's; warn of others."""
    parts = list(parts_of(run))
    names = [part.name for part in parts]
    if isinstance(maps, Mapping):
        lacking = [name for name in names if name not in maps]
        if lacking:
            given = ", ".join(map(str, maps)) or "none"
            raise InputError(f"the maps lack {lacking[0]}; the model has {', '.join(names)}, and given are {given}.")
        _warn_of_others(str(name) for name in maps if name not in names)
        maps = [maps[name] for name in names]
    if not isinstance(maps, Sequence | np.ndarray):
        raise InputError(f"the maps are a {type(maps).__name__}; give a folder, or arrays for {', '.join(names)}.")
    if len(maps) != len(parts):
        raise InputError(f"{len(maps)} maps were given, the model has {len(parts)}; give one for each.")
    found = {}
    for part, map_ in zip(parts, maps, strict=True):
        name = f"map {part.name}"
        found[name] = in_uk(map_, name, part.frame, part.frequency_ghz)
        _check_size(run, found[name], name)
    return found
