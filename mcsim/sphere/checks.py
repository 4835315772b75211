"""Checks of arguments: a wrong size, type or value raises InputError instead of giving a wrong number.

The arrays come from users and other packages, and compiled loops do not check their bounds.
"""

import math
import os
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere import alm as alm_
from mcsim.support.arrays import numbers

NSIDE_MAX = 8192

UNSEEN_BELOW = -1e30  #: values below this are ``healpy.UNSEEN`` (-1.6375e30), exactly or in single precision
LARGEST_ANGLE = 4.0 * math.pi  #: two turns: a larger angle in radians is probably one in degrees


def check_whole(value: Any, name: str, least: int = 0) -> None:
    """Raise InputError unless ``value`` is a whole number of type int, ``least`` or more."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise InputError(f"{name} is {value!r}, but it must be a whole number (int) >= {least}.")


def check_truth(value: Any, name: str) -> None:
    """Raise InputError unless ``value`` is True or False."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name} is {value!r}, but it must be True or False.")


def check_memory(size: float, what: str, remedy: str) -> None:
    """Raise InputError if ``size`` bytes are more than this machine's memory; ``what`` needs them."""
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if size > there:
        raise InputError(f"{what} takes {size / 1e9:.3g} GB, but this machine has {there / 1e9:.3g} GB; {remedy}.")


def check_number(value: Any, name: str, unit: str) -> None:
    """Raise InputError unless ``value`` is one plain number."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise InputError(f"{name} is {value!r}, but it must be one plain number, in {unit}.")


def check_nside(nside: Any) -> None:
    """Raise InputError unless ``nside`` is a power of two between 1 and NSIDE_MAX."""
    whole = isinstance(nside, int | np.integer) and not isinstance(nside, bool)
    if not whole or nside < 1 or nside > NSIDE_MAX or nside & (nside - 1):
        raise InputError(f"nside is {nside!r}, but it must be a power of two between 1 and {NSIDE_MAX}.")


def check_angle(angle: float, name: str) -> None:
    """Raise InputError unless an angle in radians is finite and at most two turns."""
    check_number(angle, name, "radians")
    if not abs(angle) <= LARGEST_ANGLE:
        raise InputError(f"{name} is {angle:g} rad, but angles go up to 4 pi; convert degrees to radians.")


def check_alm(alm: Any, lmax: int, name: str = "alm", shape: tuple[int, ...] = ()) -> None:
    """Raise InputError unless ``alm`` are complex coefficients for ``lmax``, of shape (*shape, size(lmax))."""
    check_whole(lmax, "lmax")
    if not isinstance(alm, np.ndarray) or not np.iscomplexobj(alm):
        kind = f"an array of {alm.dtype}" if isinstance(alm, np.ndarray) else f"a {type(alm).__name__}"
        raise InputError(f"{name} is {kind}, but coefficients are a complex numpy array in healpy's order.")
    wanted = (*shape, alm_.size(lmax))
    if alm.shape != wanted:
        found = alm_.lmax_of(alm.shape[-1]) if alm.ndim else None
        of = "" if found is None else f" (as of lmax = {found})"
        raise InputError(f"{name} has shape {alm.shape}{of}, but lmax = {lmax} needs {wanted}; use alm.resize.")


def check_finite(values: NDArray, name: str) -> None:
    """Raise InputError if a value is NaN or infinite."""
    # One pass without a temporary array; NaN and infinity survive the sum.
    if not np.isfinite(values.sum()) and not np.isfinite(values).all():
        raise InputError(f"{name} has values that are not finite; repair it.")


def check_shape(values: Any, shape: tuple[int, ...], name: str) -> None:
    """Raise InputError unless an array of plain numbers has this shape."""
    numbers(values, name)
    if np.shape(values) != shape:
        raise InputError(f"{name} has shape {np.shape(values)}, but {shape} is needed.")


def check_cl(cl: Any, lmax: int, name: str = "the spectrum", cross: bool = False) -> None:
    """Raise InputError unless ``cl`` is real, finite, of shape (> lmax,) and, unless ``cross``, >= 0."""
    check_whole(lmax, "lmax")
    if not isinstance(cl, np.ndarray) or cl.ndim != 1 or cl.dtype.kind not in "fiu":
        raise InputError(f"{name} has shape {np.shape(cl)}, but it must be a real numpy array, one value for each ell.")
    if len(cl) <= lmax:
        raise InputError(f"{name} ends at ell = {len(cl) - 1}, below lmax {lmax}; lower lmax or extend the spectrum.")
    check_finite(cl, name)
    if not cross and cl.min() < 0.0:
        raise InputError(f"{name} is {cl.min():g} at ell = {int(cl.argmin())}, but power is not negative; repair it.")


def check_map(map_: Any, nside: int | None = None, name: str = "the map") -> int:
    """Return nside of a real HEALPix map, shape (npix,); raise InputError for anything else or another nside."""
    if not isinstance(map_, np.ndarray) or map_.ndim != 1 or map_.dtype.kind not in "fiub":
        raise InputError(f"{name} has shape {np.shape(map_)}, but it must be a real numpy array of shape (npix,).")
    found = nside_of(map_.size, name)
    if nside is not None and found != nside:
        raise InputError(f"{name} has nside {found}, but {nside} is needed; bring both to the same.")
    return found


def check_complete(map_: NDArray, name: str = "the map") -> None:
    """Raise InputError if a pixel of a map is NaN, infinite or unseen."""
    # One pass for a valid map: a pixel that is NaN, infinite or unseen shows in the sum.
    if not abs(map_.sum()) < -0.1 * UNSEEN_BELOW and not (map_.min() > UNSEEN_BELOW and map_.max() < math.inf):
        raise InputError(f"{name} has pixels that are not finite or unseen (UNSEEN); set them to 0 by a mask first.")


def check_not_infinite(map_: NDArray, name: str) -> None:
    """Raise InputError if pixels of a map are infinite, which is no word for not observed."""
    if infinite := int(np.isinf(map_).sum()):
        raise InputError(f"{name} has {infinite} pixels that are infinite; mark what was not observed as UNSEEN.")


def nside_of(npix: int, where: str) -> int:
    """Return nside of a full sky of ``npix`` pixels; raise an InputError that names ``where`` if there is none."""
    nside = math.isqrt(max(npix, 0) // 12)
    if nside == 0 or 12 * nside * nside != npix or nside & (nside - 1):
        raise InputError(f"{where} has {npix} pixels, which is no full HEALPix sky; write all 12 nside^2 pixels.")
    return nside
