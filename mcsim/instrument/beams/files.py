"""Beams that come as a file of coefficients."""

from pathlib import Path

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.beams._fits import opened
from mcsim.instrument.beams.beam import Beam, check_lmax, check_mmax, normalize, power_by_order
from mcsim.sphere import alm as alm_

LEAST_CIRCULAR_POWER = 0.5
REALITY_TOLERANCE = 1e-6
LEAST_FIRST_WINDOW = 0.8
"""B_1 = <cos theta> over the beam: 0.98 for a FWHM of 20 deg; 0.58 where b_l0 is B_l itself, 1.7 where 2l + 1 is."""


def from_blm_file(path: str | Path, lmax: int, mmax: int | None = None) -> Beam:
    """Read a beam from FITS coefficients as healpy reads them (index, real, imaginary).

    Parameters
    ----------
    path
        FITS file; its first table is the temperature beam, pointed at the pole.
    lmax
        Largest degree, no more than the file's.
    mmax
        Largest order, no more than the file's; ``None`` chooses it (:func:`mcsim.instrument.beams.choose_mmax`).

    Returns
    -------
    Beam
        Normalised to B_0 = 1; its ``integral`` says by how much: sqrt(4pi) b_00 of the file.

    Raises
    ------
    InputError
        If the file cannot be read, stops before lmax or mmax, has a complex b_l0, an integral that is not positive,
        another normalisation in l, or is not pointed at the pole.

    Notes
    -----
    Coefficients are those of B = sum b_lm Y_lm, b_lm = int B conj(Y_lm), with the Condon-Shortley phase, as
    optics codes in the Planck pipelines write them. In that convention b_00 of a beam that is
    normalised to 1 is 1/sqrt(4pi), or half of it for one polarisation; either is divided out. A file cannot show
    whether its azimuth starts at the scan direction: rotate by (``b_lm exp(-i m angle)``) before use if it does not.
    """
    path = Path(path)
    check_lmax(lmax)
    if mmax is not None:
        check_mmax(mmax, lmax)
    blm = _read(path)
    file_lmax, file_mmax = blm.shape[1] - 1, blm.shape[0] - 1
    if lmax > file_lmax:
        raise InputError(f"{path} stops at lmax = {file_lmax}, below the lmax = {lmax} asked for: lower lmax")
    if mmax is not None and mmax > file_mmax:
        raise InputError(f"{path} stops at mmax = {file_mmax}, below the mmax = {mmax} asked for: lower mmax")
    blm = blm[: lmax + 1, : lmax + 1]
    if not np.all(np.isfinite(blm)):
        raise InputError(f"{path} has coefficients that are not finite: repair it before use")
    if np.max(np.abs(blm[0].imag)) > REALITY_TOLERANCE * np.max(np.abs(blm[0])):
        raise InputError(f"{path} has complex coefficients at m = 0, where a real beam has real ones: check its order")
    power = power_by_order(blm)
    if not power[0] > LEAST_CIRCULAR_POWER * power.sum():
        raise InputError(
            f"{path} has {power[0]:.2g} of its power {power.sum():.2g} at m = 0, where a beam pointed at the pole has "
            f"more than a fraction {LEAST_CIRCULAR_POWER}: rotate the beam to the pole before taking its coefficients"
        )
    first = float(blm[0, 1].real / blm[0, 0].real / np.sqrt(3.0))
    if blm[0, 0].real > 0.0 and not LEAST_FIRST_WINDOW < first < 2.0 - LEAST_FIRST_WINDOW:
        raise InputError(
            f"{path} has B_1 = {first:.3g} where any beam has nearly B_0 = 1: its coefficients are not b_lm with "
            "b_l0 = sqrt((2l+1)/4pi) B_l, so multiply or divide them by a power of sqrt(2l+1)"
        )
    blm[0] = blm[0].real
    return normalize(blm, mmax, str(path))


def _read(path: Path) -> NDArray[np.complex128]:
    if not path.is_file():
        raise InputError(f"beam coefficients {path} do not exist: give the path of a FITS file of b_lm")
    try:
        # A file with infinities is refused later, by name; joining real and imaginary parts would warn of them.
        with opened(path) as hdus, np.errstate(invalid="ignore"):
            packed, mmax = healpy.read_alm(hdus, hdu=1, return_mmax=True)
        lmax = healpy.Alm.getlmax(len(packed), mmax)
    except Exception as error:  # libraries raise whatever a broken file makes of them
        raise InputError(
            f"{path} cannot be read as FITS coefficients with columns index, real, imaginary ({error})"
        ) from error
    blm = np.zeros((mmax + 1, lmax + 1), dtype=np.complex128)
    for m in range(mmax + 1):
        start = alm_.start(lmax, m)
        blm[m, m:] = packed[start + m : start + lmax + 1]
    return blm
