"""Gaussian and elliptical Gaussian beams in closed form."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, ive

from mcsim.errors import InputError
from mcsim.instrument.beams.coefficients import check_lmax, check_mmax
from mcsim.sphere.checks import check_number

SIGMA_PER_FWHM = 1 / np.sqrt(8 * np.log(2))
MAX_FWHM_ARCMIN = 1200.0
"""Widest beam for which the small-angle closed form is offered: its error is measured up to here."""
_LARGEST_ORDER = 64


def check_fwhm(width: float, name: str) -> None:
    """Raise InputError unless a full width at half maximum in arcmin is one that is offered."""
    check_number(width, name, "arcmin")
    if not 0 < width <= MAX_FWHM_ARCMIN:
        raise InputError(
            f"{name} = {width} must be above 0 and at most {MAX_FWHM_ARCMIN:g} arcmin; correct it, or give a wider "
            "beam by its B_l (a window) or b_lm."
        )


def elliptical_blm(
    fwhm_major_arcmin: float, fwhm_minor_arcmin: float, angle_deg: float, lmax: int, mmax: int | None = None
) -> NDArray[np.complex128]:
    """Return the coefficients of an elliptical Gaussian beam, to a larger order than can matter.

    Return b_lm, shape (>= mmax + 1, lmax + 1), with b_00 = 1/sqrt(4pi) up to the accuracy below. Parameters, and what
    is refused, are those of :meth:`mcsim.instrument.beams.Beam.elliptical`.

    Notes
    -----
    The beam is sqrt(theta / sin theta) exp(-x^2 / 2 sigma_1^2 - y^2 / 2 sigma_2^2) with (x, y) = theta (cos phi, sin
    phi) along its axes, scaled to B_0 = 1. With kappa^2 = l(l+1) + (1 - m^2)/3,

        b_lm = sqrt((2l+1)/4pi) sqrt((l+m)!/(l-m)!) kappa^-m exp(-kappa^2 (s1^2 + s2^2)/4)
               I_{m/2}(kappa^2 (s1^2 - s2^2)/4) exp(-i m angle).

    This kappa follows from the equation of P_lm(cos theta) sqrt(sin theta) with 1/sin^2 theta = 1/theta^2 + 1/3 + ...,
    which makes P_lm a Bessel function J_m(kappa theta) sqrt(theta / sin theta) up to terms in theta^4; for a circular
    beam it is exp(-l(l+1) sigma^2/2) exactly. The paper's formula (arXiv:1210.7318, eq. blm-EG) has (l + 1/2)^2 in
    place of kappa^2 and no root in the beam; the root changes the coefficients of 13.9' x 12.7' by less than 1e-6.

    Largest error against quadrature on the sphere, relative to the largest |b_lm| of the order (lmax 1024 for the
    first, 200 for the others; tests/unit/test_beams_gaussian.py):

    ================  ======  ======  ======  ===========================
    FWHM (arcmin)     m = 0   m = 2   m = 4   m = 2, beam without the root
    ================  ======  ======  ======  ===========================
    13.9 x 12.7       4e-12   4e-12   2e-11   5e-7
    60 x 45           8e-12   6e-10   4e-9    8e-6
    300 x 200         5e-9    3e-7    2e-6    2e-4
    1200 x 800        1e-6    7e-5    5e-4    3e-3
    ================  ======  ======  ======  ===========================

    With (l + 1/2)^2 the second row is 3e-5 at m = 2 instead, whichever of the two beams is meant.
    """
    check_lmax(lmax)
    check_fwhm(fwhm_major_arcmin, "fwhm_major_arcmin")
    check_fwhm(fwhm_minor_arcmin, "fwhm_minor_arcmin")
    if fwhm_major_arcmin < fwhm_minor_arcmin:
        raise InputError(
            f"fwhm_major_arcmin = {fwhm_major_arcmin} is less than fwhm_minor_arcmin = {fwhm_minor_arcmin}: "
            "exchange them and add 90 to angle_deg"
        )
    check_number(angle_deg, "angle_deg", "degrees")
    if not np.isfinite(angle_deg):
        raise InputError(f"angle_deg = {angle_deg} must be a finite number of degrees")
    if mmax is not None:
        check_mmax(mmax, lmax)
    highest = min(lmax, max(_LARGEST_ORDER, mmax or 0))
    blm = np.zeros((highest + 1, lmax + 1), dtype=np.complex128)
    sigma_major, sigma_minor = np.radians(np.array([fwhm_major_arcmin, fwhm_minor_arcmin]) / 60) * SIGMA_PER_FWHM
    for m in range(0, highest + 1 if fwhm_major_arcmin > fwhm_minor_arcmin else 1, 2):
        phase = np.exp(-1j * m * np.radians(angle_deg))
        blm[m, m:] = phase * _order(m, lmax, sigma_major, sigma_minor)
    return blm


def _order(m: int, lmax: int, sigma_major: float, sigma_minor: float) -> NDArray[np.float64]:
    """Return the coefficients m <= l <= lmax of one even order, with the major axis along x."""
    ell = np.arange(m, lmax + 1)
    kappa2 = ell * (ell + 1) + (1 - m**2) / 3
    # ive carries exp(-argument): the two exponents are joined so that neither overflows at large l.
    bessel = ive(m // 2, kappa2 * (sigma_major**2 - sigma_minor**2) / 4) * np.exp(-kappa2 * sigma_minor**2 / 2)
    scale = np.exp((gammaln(ell + m + 1) - gammaln(ell - m + 1) - m * np.log(kappa2)) / 2)
    order: NDArray[np.float64] = np.sqrt((2 * ell + 1) / (4 * np.pi)) * scale * bessel
    return order
