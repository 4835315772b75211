"""Coefficients of beams from files and arrays, checked."""

from pathlib import Path

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.beams.coefficients import cut, power_by_order, unpacked
from mcsim.sphere import alm as alm_
from mcsim.sphere.header import read_coefficients
from mcsim.support.arrays import numbers
from mcsim.support.folders import user_path
from mcsim.support.npy import read_npy

LEAST_CIRCULAR_POWER = 0.5
REALITY_TOLERANCE = 1e-6
LEAST_FIRST_WINDOW = 0.8
"""B_1 = <cos theta> over the beam: 0.98 for a FWHM of 20 deg; 0.58 where b_l0 is B_l itself, 1.7 where 2l + 1 is."""


def checked_blm(source: str | Path | NDArray, lmax: int | None = None) -> tuple[NDArray[np.complex128], str]:
    """Return b_lm, shape (source's mmax + 1, lmax + 1), and what they are of, for messages.

    What is read, and what is refused, says :meth:`mcsim.instrument.beams.Beam.from_blm`.
    """
    if isinstance(source, str | Path):
        path, origin = user_path(source), str(source)
        blm = _of_array(read_npy(path, ndims=(1, 2))) if path.suffix == ".npy" else _read(path)
    else:
        origin = "the array of b_lm"
        blm = _of_array(numbers(source, origin))
    blm = cut(blm, lmax, origin)
    if not np.all(np.isfinite(blm)):
        raise InputError(f"{origin} has coefficients that are not finite: repair it before use")
    if np.max(np.abs(blm[0].imag)) > REALITY_TOLERANCE * np.max(np.abs(blm[0])):
        raise InputError(
            f"{origin} has complex coefficients at m = 0, where a real beam has real ones: check its order"
        )
    power = power_by_order(blm)
    if not power[0] > LEAST_CIRCULAR_POWER * power.sum():
        raise InputError(
            f"{origin} has {power[0]:.2g} of its power {power.sum():.2g} at m = 0, where a beam pointed at the pole "
            f"has more than a fraction {LEAST_CIRCULAR_POWER}: rotate the beam to the pole before taking its "
            "coefficients"
        )
    first = float(blm[0, 1].real / blm[0, 0].real / np.sqrt(3.0)) if blm[0, 0].real > 0.0 else 1.0
    if not LEAST_FIRST_WINDOW < first < 2.0 - LEAST_FIRST_WINDOW:
        raise InputError(
            f"{origin} has B_1 = {first:.3g} where any beam has nearly B_0 = 1: its coefficients are not b_lm with "
            "b_l0 = sqrt((2l+1)/4pi) B_l, so multiply or divide them by a power of sqrt(2l+1)"
        )
    blm[0] = blm[0].real
    return blm, origin


def _of_array(array: NDArray) -> NDArray[np.complex128]:
    """Return a copy of an array as [m, l]: of healpy's m-major order with every m up to lmax, or of [m, l] itself."""
    lmax = alm_.lmax_of(array.size) if array.ndim == 1 else None
    if lmax is not None:
        return unpacked(array, lmax, lmax)
    if array.ndim != 2 or not 0 < array.shape[0] <= array.shape[1]:
        raise InputError(
            f"an array of b_lm has the shape {array.shape}: give healpy's order with every m up to lmax, or [m, l] of "
            "shape (mmax + 1, lmax + 1)"
        )
    own = alm_.lmax_of(array.shape[1]) if len(array) == 3 else None
    # T has no l = m = 1 without an offset, E and B have none and begin at l = 2; B_l of a round beam does not vanish.
    if own is not None and own > 1 and not np.any(array[1:, [0, 1, own + 1]]):
        polarised = bool(np.any(array[1:])) or array[0, own + 1] == 0.0
    else:
        polarised = False
    if polarised:
        raise InputError(
            f"an array of b_lm has the shape {array.shape}, that of T, E and B of a beam up to l = {own}: give its "
            "first row, the temperature beam"
        )
    return np.triu(array).astype(np.complex128)


def _read(path: Path) -> NDArray[np.complex128]:
    if not path.is_file():
        raise InputError(f"beam coefficients {path} do not exist: give the path of a FITS file of b_lm")
    packed, mmax, _ = read_coefficients(path, "beam coefficients")
    return unpacked(packed, healpy.Alm.getlmax(len(packed), mmax), mmax)
