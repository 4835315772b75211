"""What a beam is to the rest of the package: its harmonic coefficients, normalised and cut in m."""

from dataclasses import dataclass
from typing import Self

import ducc0
import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere.checks import check_finite

MMAX_TOLERANCE = 4e-4
"""Largest fraction of a beam's power that :func:`choose_mmax` leaves beyond m_max."""

CIRCULAR_POWER = 1e-20
"""Fraction of a beam's power below which what is not m = 0 is round-off, and the beam circular."""


@dataclass(frozen=True, eq=False)
class Beam:
    """Harmonic coefficients of a beam that points at the pole.

    Parameters
    ----------
    blm
        b_lm at ``blm[m, l]``, complex, shape (mmax + 1, lmax + 1), zero for l < m; b_l0 = sqrt((2l+1)/4pi) B_l
        with B_0 = 1.
    neglected_power
        Sum of |b_lm|^2 over |m| > mmax and l <= lmax, over the same sum for all m.
    integral
        Integral over the sphere before the normalisation to B_0 = 1, in the units of the source times sr (a beam map
        in mK: mK sr; a file of coefficients: sqrt(4pi) b_00; closed forms: 1).

    Notes
    -----
    The beam is B(n) = sum_lm b_lm Y_lm(n) in sr^-1, with b_{l,-m} = (-1)^m conj(b_lm) and the azimuth counted from the
    beam's x axis, the direction of the scan (spin axis) x (boresight), towards y; (x, y, outward) is right-handed.
    """

    blm: NDArray[np.complex128]
    neglected_power: float = 0.0
    integral: float = 1.0

    def __post_init__(self) -> None:
        """Raise InputError unless the coefficients are finite and stand at ``blm[m, l]``, zero for l < m."""
        blm = self.blm
        if not isinstance(blm, np.ndarray) or not np.iscomplexobj(blm) or blm.ndim != 2 or not blm.size:
            raise InputError(f"blm has shape {np.shape(blm)}, but it must be complex, (mmax + 1, lmax + 1).")
        check_mmax(self.mmax, self.lmax)
        check_finite(blm, "blm")
        if any(blm[m, :m].any() for m in range(1, len(blm))):
            raise InputError("blm has coefficients with l < m, which do not exist: give blm[m, l].")

    @property
    def lmax(self) -> int:
        """Largest degree."""
        return int(self.blm.shape[1]) - 1

    @property
    def mmax(self) -> int:
        """Largest order."""
        return int(self.blm.shape[0]) - 1

    @property
    def window(self) -> NDArray[np.float64]:
        """Window B_l of the circular part, shape (lmax + 1,)."""
        window: NDArray[np.float64] = self.blm[0].real * np.sqrt(4 * np.pi / (2 * np.arange(self.lmax + 1) + 1))
        return window

    def truncated(self, mmax: int) -> Self:
        """Return the beam without its orders above ``mmax``; what it loses is added to ``neglected_power``."""
        check_mmax(mmax, self.lmax)
        if mmax >= self.mmax:
            return self
        power = power_by_order(self.blm)
        lost = (1 - self.neglected_power) * power[mmax + 1 :].sum() / power.sum()
        return type(self)(self.blm[: mmax + 1].copy(), float(self.neglected_power + lost), self.integral)

    def circular(self) -> Self:
        """Return the m = 0 part."""
        return self.truncated(0)

    def packed(self) -> NDArray[np.complex128]:
        """Return the coefficients in healpy's m-major order, m up to mmax only."""
        return np.concatenate([self.blm[m, m:] for m in range(self.mmax + 1)])

    def values(self, theta: NDArray[np.float64], phi: NDArray[np.float64], nthreads: int = 1) -> NDArray[np.float64]:
        """Evaluate the beam, as far as its lmax and mmax resolve it.

        Parameters
        ----------
        theta, phi
            Angle from the beam's centre and azimuth from its x axis towards y, radians, of one shape.
        nthreads
            Number of threads.

        Returns
        -------
        ndarray
            B in sr^-1, in the shape of ``theta``.
        """
        if np.any((theta < 0.0) | (theta > np.pi)):
            raise InputError("theta must lie between 0 and pi radians: give the angle from the centre of the beam.")
        direction = np.stack([np.ravel(theta), np.ravel(phi) % (2 * np.pi)], axis=1)
        values: NDArray[np.float64] = ducc0.sht.synthesis_general(
            alm=self.packed()[None],
            lmax=self.lmax,
            mmax=self.mmax,
            spin=0,
            loc=direction,
            epsilon=1e-12,
            nthreads=nthreads,
        )[0].reshape(np.shape(theta))
        return values


def check_lmax(lmax: int) -> None:
    """Refuse a degree that is no degree."""
    if not isinstance(lmax, int | np.integer) or lmax < 1:
        raise InputError(f"lmax = {lmax} must be a whole number of 1 or more for a beam")


def check_mmax(mmax: int, lmax: int) -> None:
    """Refuse an order that no coefficient up to ``lmax`` has."""
    if not isinstance(mmax, int | np.integer) or not 0 <= mmax <= lmax:
        raise InputError(
            f"mmax = {mmax} of a beam must be whole and lie between 0 and its lmax = {lmax}: lower mmax or raise lmax"
        )


def power_by_order(blm: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Sum over l of |b_lm|^2, both signs of m together, shape (mmax + 1,)."""
    power: NDArray[np.float64] = np.sum(np.abs(blm) ** 2, axis=1)
    power[1:] *= 2
    return power


def choose_mmax(blm: NDArray[np.complex128], tolerance: float = MMAX_TOLERANCE) -> int:
    """Choose the order above which a beam may be cut.

    Parameters
    ----------
    blm
        Coefficients to a larger order than can matter, shape (mmax + 1, lmax + 1).
    tolerance
        Largest fraction of the power, over the degrees given, that may be neglected.

    Returns
    -------
    int
        0 for a beam that is circular to round-off, else the smallest m >= 2 that neglects no more than ``tolerance``.

    Notes
    -----
    Never 1, nor 0 for a beam that is not circular: m = 2 may hold less than the tolerance and still be all of
    A^{20}. Orders that differ by 2 feed A^{20} in pairs, so that the leading neglected effect is b_l4 b_l2 over
    b_l2 b_l0. At the default, and lmax = 1024, the WMAP-7 beam maps V2, W1 and W4 get mmax = 4. On the same skies under
    parallel transport (mmax = 4 against 10, bins of 50 in l) that left out at most 0.5 uK^2 of a binned A^{20}_ll that
    reaches 269 uK^2 for V2, and 0.9 of 476 uK^2 for W1 (0.2 % of the largest), where mmax = 2 leaves out 2.7 and
    5.2 uK^2 (1 %). What is studied at L > 2 may need more: pass mmax then.
    """
    power = power_by_order(blm)
    if power[1:].sum() <= CIRCULAR_POWER * power.sum():
        return 0
    beyond = np.append(np.cumsum(power[::-1])[::-1][1:], 0.0) / power.sum()
    smallest = int(np.argmax(beyond <= tolerance))
    return min(max(2, smallest), len(power) - 1)


def normalize(blm: NDArray[np.complex128], mmax: int | None, origin: str, neglected_power: float = 0.0) -> Beam:
    """Build a beam with B_0 = 1 from coefficients in any unit.

    Parameters
    ----------
    blm
        Coefficients, shape (>= mmax + 1, lmax + 1), to the largest order that is known.
    mmax
        Order to cut at; ``None`` takes that of :func:`choose_mmax`.
    origin
        What the coefficients are of, for messages.
    neglected_power
        Fraction of the power that ``blm`` lacks already.

    Raises
    ------
    InputError
        If a coefficient is not finite, the integral of the beam is not positive, or it has no order ``mmax``.
    """
    if not np.all(np.isfinite(blm)):
        raise InputError(f"{origin} has coefficients that are not finite: repair it before use")
    integral = float(blm[0, 0].real * np.sqrt(4 * np.pi))
    if integral <= 0:
        raise InputError(f"{origin} integrates to {integral:.3g} over the sphere where a beam must be positive")
    if mmax is not None:
        check_mmax(mmax, blm.shape[1] - 1)
        if mmax >= len(blm):
            raise InputError(f"mmax = {mmax} exceeds the largest order {len(blm) - 1} of {origin}: lower mmax")
    whole = Beam(blm / integral, neglected_power, integral)
    return whole.truncated(choose_mmax(blm) if mmax is None else mmax)
