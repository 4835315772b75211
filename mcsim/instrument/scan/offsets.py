"""Moments of the samples' offsets from their pixels' centres beyond the mean: squares, cubes, fourth powers."""

import math

import numpy as np
from numpy.typing import NDArray

from mcsim.sphere import healpix
from mcsim.support.compiled import njit

HIGHEST = 4  #: degree of the highest moments


def exponents(order: int) -> list[tuple[int, int]]:
    """Return (a, b) of every moment <dtheta^a dphi^b> of degree 2 to ``order``, in the order in which they are kept."""
    return [(degree - b, b) for degree in range(2, order + 1) for b in range(degree + 1)]


def order_of(rows: int) -> int | None:
    """Return the highest degree of so many moments; None if there is none of that number."""
    return next((order for order in range(2, HIGHEST + 1) if len(exponents(order)) == rows), None)


def spin_moment(rows: NDArray[np.float64], spin: int) -> NDArray:
    """Return <rho^(n - s) (dtheta + i dphi)^s>, rho^2 = dtheta^2 + dphi^2, from the moments of degree n.

    They are <dtheta^(n - b) dphi^b> in row b, shape (n + 1, npix); s <= n, n - s even. Complex; real at spin 0.
    """
    powers = np.ones(1, dtype=complex)
    for _ in range(spin):
        powers = np.convolve(powers, [1.0, 1j])
    for _ in range((len(rows) - 1 - spin) // 2):
        powers = np.convolve(powers, [1.0, 0.0, 1.0])
    real = powers.real @ rows
    return real + 1j * (powers.imag @ rows) if spin else np.asarray(real)


def centres(nside: int) -> NDArray[np.float64]:
    """Return the unit vectors of the pixels' centres in RING order, shape (npix, 3)."""
    return np.ascontiguousarray(healpix.centres(nside).T)


@njit(nogil=True, error_model="numpy")
def add_powers(sums, column, order, centre, x, y, z):  # type: ignore[no-untyped-def]
    """Add the powers of a sample's offset to a pixel's sums from ``column`` on, in the order of :func:`exponents`.

    The offset is the component of the sample's unit vector in the plane that touches the sphere at the centre: no
    difference of coordinates, which would be wrong to second order near the poles.
    """
    sine = math.sqrt(centre[0] * centre[0] + centre[1] * centre[1])
    south = centre[2] * (x * centre[0] + y * centre[1]) / sine - z * sine
    east = (y * centre[0] - x * centre[1]) / sine
    down = (1.0, south, south * south, south * south * south, south * south * south * south)
    across = (1.0, east, east * east, east * east * east, east * east * east * east)
    for degree in range(2, order + 1):
        for b in range(degree + 1):
            sums[column] += down[degree - b] * across[b]
            column += 1
