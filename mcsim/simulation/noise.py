"""Noise of the pixels of a map: its standard deviation, from what a run says of the channel's noise."""

from dataclasses import replace
from pathlib import Path

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.config import noise as declared
from mcsim.errors import InputError
from mcsim.instrument.scan import Moments
from mcsim.sphere import header, healpix
from mcsim.sphere.checks import UNSEEN_BELOW

Map = NDArray[np.float64]


def in_pixels(spec: config.Channel, split: str | None, moments: Moments) -> tuple[Moments, Map | None]:
    """Return the moments with the hits of the map, and the standard deviation of its noise, uK, (npix,); None: none.

    A map of hits takes the place of the scan's. What is not observed in a map of hits or variances is not observed.
    InputError if a file of the run cannot be used; its pixels and frame must be those of the maps that are made.
    """
    noise = spec.noise_of(split)
    if isinstance(noise, declared.Noise) and noise.hits is not None:
        path = config.channel_path(noise.hits, spec.name, split)
        hits, _ = _read(path, moments, healpix.HITS, "hits")
        moments = replace(moments, hits=np.where(moments.hits > 0, hits, 0.0))
    if declared.is_noise_free(noise):
        return moments, None
    match noise:
        case declared.Noise():
            observed = moments.hits > 0
            zeros = np.zeros(observed.size)
            return moments, np.divide(noise.sigma0_uk, np.sqrt(moments.hits), out=zeros, where=observed)
        case declared.NoiseDepth():
            side = np.rad2deg(healpy.nside2resol(moments.nside)) * 60.0
            return moments, np.where(moments.hits > 0, noise.depth_uk_arcmin / side, 0.0)
        case declared.NoiseVariance():
            path = config.channel_path(noise.variance, spec.name, split)
            variance, unit = _read(path, moments, healpix.VARIANCE, "variances")
            variance = header.to_uk2(unit, path, spec.frequency_ghz) * variance
            moments = replace(moments, hits=np.where(variance > 0.0, moments.hits, 0.0))
            return moments, np.where(moments.hits > 0, np.sqrt(variance), 0.0)


def _read(path: Path, moments: Moments, names: tuple[str, ...], what: str) -> tuple[Map, str | None]:
    """Return a map of hits or variances, 0 where nothing was observed, and its unit."""
    values, frame, unit = healpix.read_map(path, names)
    nside = healpy.npix2nside(values.size)
    if nside != moments.nside:
        raise InputError(
            f"{path} has {what} of nside {nside}, but maps are made with map.nside = {moments.nside}; set map.nside to "
            f"{nside} (a preparation can degrade the maps)."
        )
    if frame not in (None, moments.frame):
        raise InputError(
            f'{path} is in {frame} coordinates, but maps are made in {moments.frame} ones; set map.frame = "{frame}".'
        )
    values = np.where(np.isfinite(values) & (values > UNSEEN_BELOW), values, 0.0)
    if values.min() < 0.0 or not np.any((values > 0.0) & (moments.hits > 0)):
        raise InputError(
            f"{path} has {what} between {values.min():g} and {values.max():g} where the scan observes; they must be "
            "positive, and 0 or UNSEEN where nothing was observed."
        )
    return values, unit
