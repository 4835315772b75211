"""Refuse maps that a survey cannot have made."""

import healpy
import numpy as np

from mcsim.diagnosis.wiener_filter import Model, Part, sky_variance
from mcsim.errors import InputError
from mcsim.support.arrays import Map


def checked_map(model: Model, part: Part, map_: Map, name: str) -> Map:
    """Return the map, called ``name``, if it can be of the survey; else raise InputError."""
    if map_.shape != (12 * model.nside**2,):
        size = healpy.npix2nside(map_.size) if map_.ndim == 1 and healpy.isnpixok(map_.size) else None
        found = f"the shape {map_.shape}" if size is None else f"nside {size}"
        raise InputError(
            f"{name} has {found}, the model {model.nside}; set map.nside of the model to that of the data, or say in "
            "[[preparation]] how they were degraded."
        )
    broken = int(np.sum(~np.isfinite(map_)))
    if broken:
        raise InputError(f"{name} has {broken} pixels that are not finite; mark what was not observed as UNSEEN.")
    unseen = map_ == healpy.UNSEEN
    fiducial, limits = part.precision > 0, model.settings
    lost = float(np.mean(unseen[fiducial]))
    if lost > limits.missing_share:
        raise InputError(
            f"{name} leaves out {100 * lost:.0f} % of the pixels that the fiducial scan hits, at most "
            f"{100 * limits.missing_share:.0f} % may be; give the model a mask (map.mask) that leaves them out too."
        )
    seen = map_[fiducial & ~unseen]
    rms = float(np.std(seen))
    if rms == 0.0:
        raise InputError(f"{name} is constant; give an observed map.")
    sky, noise = sky_variance(model.cl, model.response[part.channel]), np.mean(1.0 / part.precision[fiducial])
    ratio = rms / float(np.sqrt(sky + noise))
    if not 1.0 / limits.rms_ratio < ratio < limits.rms_ratio:
        raise InputError(
            f"{name} has an rms of {rms:.3g} uK where the model expects {rms / ratio:.3g} uK; is it in another "
            "unit, or is the dipole still in it? Say the unit in its header (TUNIT1), or give it in uK."
        )
    return map_
