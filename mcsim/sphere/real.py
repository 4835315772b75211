"""Real spherical harmonics: as many real numbers as a real map has, in the place of complex coefficients.

R_l0 = Y_l0, and for m > 0 there are two, sqrt(2) Re Y_lm ("real") and -sqrt(2) Im Y_lm ("imaginary"), in the order of
l, then m, then these. They are orthonormal.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import sph_harm_y

from mcsim.sphere import alm as alm_
from mcsim.support.arrays import Alm, Vector


def harmonics(lmax: int) -> list[tuple[int, int, str]]:
    """Return degree, order and component ("real", "imaginary", or "" for m = 0) of each harmonic up to ``lmax``."""
    parts = [(degree, order) for degree in range(lmax + 1) for order in range(degree + 1)]
    return [(*one, word) for one in parts for word in (("real", "imaginary") if one[1] else ("",))]


def coefficients(alm: Alm, lmax: int, top: int) -> Vector:
    """Return the first (top + 1)^2 real coefficients of a_lm of ``lmax``."""
    found = []
    for degree, order, component in harmonics(top):
        value = alm[alm_.start(lmax, order) + degree]
        part = value.imag if component == "imaginary" else value.real
        found.append(part * (np.sqrt(2.0) if order else 1.0))
    return np.array(found)


def to_alm(values: Vector, lmax: int) -> Alm:
    """Return the a_lm up to ``lmax`` of a map with these real coefficients, whose number is (top + 1)^2."""
    top = int(np.sqrt(len(values))) - 1
    alm = np.zeros(alm_.size(max(lmax, top)), dtype=np.complex128)
    for (degree, order, component), value in zip(harmonics(top), values, strict=True):
        unit = 1.0 if order == 0 else np.sqrt(0.5)
        alm[alm_.start(max(lmax, top), order) + degree] += (1j if component == "imaginary" else 1.0) * unit * value
    return alm_.resize(alm, max(lmax, top), lmax)


def field(values: Vector, x: Vector, y: Vector, z: Vector) -> Vector:
    """Return the map with these real coefficients at directions (x, y, z), which broadcast."""
    theta, phi = np.arccos(np.clip(z, -1.0, 1.0)), np.arctan2(y, x)
    total = np.zeros(np.broadcast(theta, phi).shape)
    for (degree, order, component), value in zip(harmonics(int(np.sqrt(len(values))) - 1), values, strict=True):
        if value != 0.0:
            complex_ = sph_harm_y(degree, order, theta, phi)
            part = -complex_.imag if component == "imaginary" else complex_.real
            total = total + value * (np.sqrt(2.0) if order else 1.0) * part
    return np.asarray(total)


def zonal(pole: Vector, top: int) -> NDArray[np.float64]:
    """Return the real coefficients of the harmonics Y_l0 about a pole, a unit vector, shape (top + 1, (top + 1)^2)."""
    rows = np.zeros((top + 1, (top + 1) ** 2))
    for place, (degree, _, _) in enumerate(harmonics(top)):
        unit = np.zeros((top + 1) ** 2)
        unit[place] = 1.0
        rows[degree, place] = np.sqrt(4.0 * np.pi / (2 * degree + 1)) * field(unit, *pole)
    return rows
