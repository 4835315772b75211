"""A beam around its centre: as values that can be multiplied, stretched and added to, and as an object to be turned.

Values are differences from the beam as it was: what an effect does not touch keeps its coefficients bit for bit.
"""

from dataclasses import dataclass, replace

import ducc0
import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.instrument.beams.coefficients import unpacked
from mcsim.sphere import alm as alm_

Blm = NDArray[np.complex128]
Values = NDArray[np.float64]

NEGLECTED = 1e-8  #: largest fraction of a beam's power that is cut off beyond m_max when an effect is done with it

_TAIL = 1e-12
_HIGHEST = 65536
_FITTED = 0.6
_FAR = 40.0  #: lmax times an angle from which on a series of turns takes longer than a rotation of all orders


@dataclass(frozen=True, eq=False)
class Shape:
    """Values, sr^-1, shape (rings, columns), of a beam on rings about its centre, which can hold m up to ``orders``.

    They are those of ``whole``, the ``original`` beam continued to a degree at which nothing is left of it. ``theta``
    is the angle from the centre, shape (rings, 1), ``phi`` the azimuth from beam x, shape (1, columns), radians.
    """

    original: Beam
    whole: Beam
    orders: int
    theta: Values
    phi: Values
    values: Values

    @property
    def peak(self) -> float:
        """Return the value at the centre, sr^-1."""
        return float(self.whole.values(np.zeros(1), np.zeros(1))[0])

    @property
    def sigma(self) -> float:
        """Return sigma of the Gaussian that has the beam's solid angle (integral over central value), radians.

        InputError for a beam that is not positive at its centre.
        """
        if self.peak <= 0.0:
            raise InputError(
                f"the effect counts distances in widths of the beam, which is {self.peak:.3g} sr^-1 at its centre and "
                "should be above 0; leave the effect out, or centre the beam on its peak."
            )
        return float(np.sqrt(np.sqrt(4.0 * np.pi) * self.whole.blm[0, 0].real / self.peak / (2.0 * np.pi)))

    def with_added(self, added: Values, least: int, keep_integral: bool = True) -> Beam:
        """Return the beam plus ``added``, like ``values``; the result is kept up to the order ``least`` in any case.

        ``keep_integral``: scale the sum to the integral that the beam had.
        """
        lmax, mmax = self.original.lmax, min(self.orders, self.original.lmax)
        packed = ducc0.sht.analysis_2d(map=added[None], spin=0, lmax=lmax, mmax=mmax, geometry="GL", nthreads=1)[0]
        blm = unpacked(packed, lmax, mmax)
        blm[: self.original.mmax + 1] += self.original.blm
        if keep_integral:
            blm *= self.original.blm[0, 0].real / blm[0, 0].real
        return trimmed(blm, self.original, least)


def shape(beam: Beam, orders: int) -> Shape:
    """Return the values of a beam on rings that hold ``orders`` more orders than the beam has.

    Notes
    -----
    Gauss-Legendre rings, as many as the continued beam has degrees: products with polynomials of low degree, and their
    coefficients up to the beam's lmax, are exact to round-off.
    """
    whole = extended(beam)
    rings, highest = max(whole.lmax, beam.lmax) + 1, beam.mmax + orders
    columns = 2 * highest + 2
    theta = np.asarray(ducc0.misc.GL_thetas(rings))[:, None]
    phi = (np.arange(columns) * 2.0 * np.pi / columns)[None, :]
    values = whole.on_rings(rings, columns, "GL")
    return Shape(beam, whole, highest, theta, phi, values)


def stretched(beam: Beam, along: float, across: float, angle: float, orders: int, least: int) -> Beam:
    """Make a beam ``along`` times as wide in the direction ``angle`` (from x towards y), ``across`` times across it.

    Notes
    -----
    What is stretched is sqrt(sin theta / theta) B in the plane (x, y) = theta (cos phi, sin phi), so that a Gaussian
    exp(-theta^2 / 2 sigma^2) sqrt(theta / sin theta) becomes the elliptical Gaussian of
    :mod:`mcsim.instrument.beams.gaussian`. The integral stays what it was.
    """
    form = shape(beam, orders)
    x = form.theta * np.cos(form.phi - angle) / along
    y = form.theta * np.sin(form.phi - angle) / across
    radius = np.hypot(x, y)
    inside = radius < np.pi
    origin = np.zeros_like(form.values)
    origin[inside] = form.whole.values(radius[inside], (np.arctan2(y, x) + angle)[inside])
    # sinc(t / pi) = sin(t) / t; the last ring before the pole opposite keeps it from zero.
    scale = np.sqrt(np.sinc(np.minimum(radius, form.theta[-1]) / np.pi) / np.sinc(form.theta / np.pi))
    return form.with_added(origin * scale / (along * across) - form.values, least)


def extended(beam: Beam) -> Beam:
    """Continue a beam beyond its lmax, to where nothing is left of it.

    Notes
    -----
    The coefficients of a beam that is not resolved at lmax end in a step, and rings in its values that any product
    with a polynomial amplifies. ln B_l is continued as a quadratic in l(l+1), b_lm / (l(l+1))^{m/2} b_l0 too, fitted
    over the upper part of the degrees: exact for a circular Gaussian. Beyond lmax a beam is a guess, of which
    the effects' coefficients at l <= lmax feel only what is within about 1 / sigma of lmax. A beam whose window is not
    positive and falling there is left as it is: real beam maps have fallen to the noise of their wings by then.
    InputError for one that would end in a step all the same, at the highest degree that values are computed of.
    """
    window, lmax = beam.window, beam.lmax
    first = min(int(_FITTED * lmax), max(lmax - 8, 0))
    fitted = np.arange(first, lmax + 1)
    top = window[first:]
    if np.any(top <= 0.0) or top[-1] < _TAIL * window[0] or len(fitted) < 4:
        return beam
    x = fitted * (fitted + 1.0) / (lmax * (lmax + 1.0))
    for degree in (2, 1):
        logarithm = np.polynomial.Polynomial.fit(x, np.log(top), degree, domain=[0.0, 1.0], window=[0.0, 1.0])
        slope = logarithm.deriv()
        if slope(1.0) < 0.0 and (degree == 1 or logarithm.coef[2] <= 0.0 or _falls(logarithm, window[0])):
            break
    else:
        return beam
    ell = np.arange(lmax + 1, _HIGHEST + 1)
    x_beyond = ell * (ell + 1.0) / (lmax * (lmax + 1.0))
    exponent = logarithm(x_beyond) - np.log(window[0])
    gone = np.nonzero(exponent < np.log(_TAIL))[0]
    if not gone.size:
        raise InputError(
            f"an effect on its shape needs a beam of which nothing is left at l = {_HIGHEST}, which a FWHM above 0.93 "
            f"arcmin makes sure of; this one falls too slowly at its lmax = {lmax}. Leave the effect out, or raise "
            "sky.lmax if the beam is wider."
        )
    size = int(gone[0]) + 1
    beyond = window[0] * np.exp(exponent[:size])
    blm = np.zeros((beam.mmax + 1, lmax + 1 + size), dtype=np.complex128)
    blm[:, : lmax + 1] = beam.blm
    blm[0, lmax + 1 :] = np.sqrt((2 * ell[:size] + 1) / (4 * np.pi)) * beyond
    for m in range(1, beam.mmax + 1):
        if np.any(beam.blm[m]):
            known = fitted[fitted >= m]  # there is no order m below l = m
            own = x[-len(known) :]
            ratio = beam.blm[m, known] / beam.blm[0, known] / own ** (m / 2)
            degree = min(2, len(known) - 1)
            curve = np.polynomial.polynomial.polyfit(own - 1.0, np.stack([ratio.real, ratio.imag], axis=1), degree)
            real, imaginary = np.polynomial.polynomial.polyval(x_beyond[:size] - 1.0, curve)
            continued = (real + 1j * imaginary) * x_beyond[:size] ** (m / 2)
            blm[m, lmax + 1 :] = continued * blm[0, lmax + 1 :]
    return replace(beam, blm=blm)


def _falls(logarithm: np.polynomial.Polynomial, peak: float) -> bool:
    """Return True if a quadratic that bends upwards gets to the tail before it turns."""
    turn = -logarithm.coef[1] / (2.0 * logarithm.coef[2])
    return bool(turn > 1.0 and logarithm(turn) < np.log(_TAIL * peak))


def displaced(beam: Beam, angle: float, distance: float) -> Beam:
    """Move the centre of a beam by ``distance`` in the direction ``angle`` from x towards y, radians.

    Notes
    -----
    exp(-i distance k.J) b with the axis k = (-sin angle, cos angle, 0): J is tridiagonal in m, so the series costs
    a few sums over a band of orders at every degree, and no transform. Steps of at most 1/2 in l times distance keep
    the series from losing digits. Beyond _FAR, where they are many, ducc0 rotates all orders.
    """
    reach = beam.lmax * abs(distance)
    if reach > _FAR:
        every = np.zeros(alm_.size(beam.lmax), dtype=np.complex128)
        every[: beam.packed().size] = beam.packed()
        turned = ducc0.sht.rotate_alm(every, beam.lmax, -angle, distance, angle, nthreads=1)
        return trimmed(unpacked(turned, beam.lmax, beam.lmax), beam, 1)
    steps = max(1, int(np.ceil(2.0 * reach)))
    full = _both_signs(beam, beam.mmax + 16 + int(np.ceil(1.5 * reach)))
    axis = (-np.sin(angle), np.cos(angle))
    for _ in range(steps):
        term = full.copy()
        for order in range(1, 20):
            term = (-1j * distance / steps / order) * _turning(term, axis)
            full = full + term
    return trimmed(full[len(full) // 2 :], beam, 1)


def smeared(beam: Beam, boresight: float, lag: float) -> Beam:
    """Return the beam of a detector that answers late: its exponential trail along the circle about the spin axis.

    Beam x is the direction of motion, ``boresight`` the angle of the line of sight from the spin axis, and ``lag`` the
    angle through which the spin turns in one time constant, radians.

    Notes
    -----
    The trail is int du e^{-u} exp(+i u lag s.J) b = (1 - i lag s.J)^{-1} b: in the frame of the spin axis, b_lm over
    1 - i m lag. The spin axis is s = (0, sin boresight, cos boresight) in the beam's own frame, so that the inverse is
    that of a tridiagonal matrix at every degree, solved by elimination.
    """
    reach = beam.lmax * abs(lag) * np.sin(boresight)
    full = _both_signs(beam, min(beam.lmax, beam.mmax + 24 + int(np.ceil(20.0 * reach))))
    below, above, m = _ladder(full)
    pull = 0.5 * lag * np.sin(boresight)
    diagonal = 1.0 - 1j * lag * np.cos(boresight) * m * np.ones_like(below)
    # -i lag sin(boresight) J_y, J_y = (J_+ - J_-) / 2i
    under, over = -pull * below, pull * above
    pivot = np.empty_like(diagonal)
    result = full.copy()
    pivot[0] = diagonal[0]
    for row in range(1, len(full)):
        factor = under[row] / pivot[row - 1]
        pivot[row] = diagonal[row] - factor * over[row - 1]
        result[row] -= factor * result[row - 1]
    result[-1] /= pivot[-1]
    for row in range(len(full) - 2, -1, -1):
        result[row] = (result[row] - over[row] * result[row + 1]) / pivot[row]
    return trimmed(result[len(full) // 2 :], beam, 2)


def trimmed(blm: Blm, like: Beam, least: int) -> Beam:
    """Return a beam from coefficients made of those of ``like``, without the orders that hold next to nothing.

    Kept are the orders up to ``least``, those that ``like`` has, and as many as leave no more than NEGLECTED of the
    power beyond.
    """
    power = np.sum(np.abs(blm) ** 2, axis=1)
    beyond = 2.0 * np.append(np.cumsum(power[::-1])[::-1][1:], 0.0) / (power[0] + 2.0 * power[1:].sum())
    mmax = max(int(np.argmax(beyond <= NEGLECTED)), min(least, len(blm) - 1), min(like.mmax, len(blm) - 1))
    lost = like.neglected_power + (1.0 - like.neglected_power) * float(beyond[mmax])
    return replace(like, blm=blm[: mmax + 1].copy(), neglected_power=lost)


def _both_signs(beam: Beam, mmax: int) -> Blm:
    """Return b_lm for m from -mmax to mmax, shape (2 mmax + 1, lmax + 1); zeros where the beam has none."""
    full = np.zeros((2 * mmax + 1, beam.lmax + 1), dtype=np.complex128)
    full[mmax : mmax + beam.mmax + 1] = beam.blm
    for m in range(1, beam.mmax + 1):
        full[mmax - m] = (-1) ** m * beam.blm[m].conj()
    return full


def _ladder(full: Blm) -> tuple[Values, Values, Values]:
    """Return the factors of the coefficients one order below in (J_+ b)_m, one above in (J_- b)_m; m as a column."""
    mmax, lmax = len(full) // 2, full.shape[1] - 1
    m = np.arange(-mmax, mmax + 1, dtype=float)[:, None]
    ell = np.arange(lmax + 1, dtype=float)[None, :]
    below = np.sqrt(np.maximum((ell - m + 1) * (ell + m), 0.0))
    above = np.sqrt(np.maximum((ell - m) * (ell + m + 1), 0.0))
    outside = np.abs(m) > ell
    below[outside] = above[outside] = 0.0
    return below, above, m


def _turning(full: Blm, axis: tuple[float, float]) -> Blm:
    """Apply axis . J, the axis (x, y, 0), to coefficients: i d/da of their rotation by a about the axis."""
    below, above, _ = _ladder(full)
    raised, lowered = np.zeros_like(full), np.zeros_like(full)
    raised[1:] = below[1:] * full[:-1]
    lowered[:-1] = above[:-1] * full[1:]
    x, y = axis
    return 0.5 * x * (raised + lowered) - 0.5j * y * (raised - lowered)
