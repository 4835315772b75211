"""Families of Wigner 3j and 6j symbols by the two-sided three-term recursion, compiled."""

import numpy as np

from mcsim.support.arrays import Vector
from mcsim.support.compiled import njit

# Loops stand where numpy's operations on slices would be shorter: numba compiles each of those with its messages about
# shapes, which takes seconds.

# Values that grow through a forbidden region are rescaled at this size, so that their squares stay finite.
_HUGE = 1e100


@njit(nogil=True)
def _root(j: float, sum_plus_one: float, difference: float) -> float:
    return np.sqrt(max((j * j - difference * difference) * (sum_plus_one * sum_plus_one - j * j), 0.0))


@njit(nogil=True)
def _minimal_at_both_ends(upper: Vector, diagonal: Vector, lower: Vector, n: int, out: Vector) -> None:
    """Solve upper_i f_{i+1} + diagonal_i f_i + lower_i f_{i-1} = 0, falling off at both ends, up to a factor.

    The recursion runs forward to the first decrease and backward from the top, where each is stable. Least squares
    over three points joins them.
    """
    out[0] = 1.0
    join = n - 1
    for i in range(n - 1):
        below = lower[i] * out[i - 1] if i > 0 else 0.0
        out[i + 1] = -(diagonal[i] * out[i] + below) / upper[i]
        if abs(out[i + 1]) > _HUGE:
            for k in range(i + 2):
                out[k] /= _HUGE
        if i >= 1 and abs(out[i + 1]) <= abs(out[i]):
            join = i + 1
            break
    if join == n - 1:
        return
    start = join - 2
    forward0, forward1, forward2 = out[start], out[start + 1], out[start + 2]
    out[n - 1] = 1.0
    for i in range(n - 1, start, -1):
        above = upper[i] * out[i + 1] if i < n - 1 else 0.0
        out[i - 1] = -(diagonal[i] * out[i] + above) / lower[i]
        if abs(out[i - 1]) > _HUGE:
            for k in range(i - 1, n):
                out[k] /= _HUGE
    overlap = forward0 * out[start] + forward1 * out[start + 1] + forward2 * out[start + 2]
    ratio = overlap / (forward0**2 + forward1**2 + forward2**2)
    for k in range(start):
        out[k] *= ratio


@njit(nogil=True)
def _normalise(jmin: int, n: int, factor: float, top_sign: float, out: Vector) -> None:
    """Scale to factor sum_j (2j+1) f_j^2 = 1 with the given sign at the top."""
    largest, norm = 0.0, 0.0
    for i in range(n):
        largest = max(largest, abs(out[i]))
    for i in range(n):
        norm += (2.0 * (jmin + i) + 1.0) * (out[i] / largest) ** 2
    scale = 1.0 / (largest * np.sqrt(norm * factor))
    if out[n - 1] * top_sign < 0.0:
        scale = -scale
    for i in range(n):
        out[i] *= scale


@njit(nogil=True)
def threej_family(j2: int, j3: int, m2: int, m3: int, out: Vector) -> tuple[int, int]:
    """Write the 3j symbols (j j2 j3; -m2-m3 m2 m3) for every j to the start of ``out``, |m2| <= j2 and |m3| <= j3.

    ``out`` has the shape (>= 2 min(j2, j3) + 1,). Return jmin = max(|j2 - j3|, |m2 + m3|) and their number n:
    ``out[i]`` belongs to j = jmin + i.

    Notes
    -----
    Schulten & Gordon, J. Math. Phys. 16, 1961 (1975). Against wignernj at j2 up to 1100: absolute error below 1e-14
    (tests/unit/test_predict_wigner.py).
    """
    m1 = -m2 - m3
    jmin = max(abs(j2 - j3), abs(m1))
    n = j2 + j3 - jmin + 1
    upper, diagonal, lower = np.zeros(n), np.zeros(n), np.zeros(n)
    for i in range(n):
        j = float(jmin + i)
        here = _root(j, j2 + j3 + 1.0, j2 - j3) * np.sqrt(j * j - m1 * m1)
        beyond = _root(j + 1.0, j2 + j3 + 1.0, j2 - j3) * np.sqrt((j + 1.0) ** 2 - m1 * m1)
        if jmin + i == 0:
            # The recursion divided by j, in its limit j -> 0, where j2 = j3 and m1 = 0.
            upper[i], diagonal[i] = beyond, m3 - m2
        else:
            upper[i] = j * beyond
            diagonal[i] = -(2.0 * j + 1.0) * ((j2 * (j2 + 1.0) - j3 * (j3 + 1.0)) * m1 - j * (j + 1.0) * (m3 - m2))
            lower[i] = (j + 1.0) * here
    _minimal_at_both_ends(upper, diagonal, lower, n, out)
    _normalise(jmin, n, 1.0, 1.0 if (j2 - j3 - m1) % 2 == 0 else -1.0, out)
    return jmin, n


@njit(nogil=True)
def sixj_family(j2: int, j3: int, j4: int, j5: int, j6: int, out: Vector) -> tuple[int, int]:
    """Write the 6j symbols {j j2 j3; j4 j5 j6} for every j to the start of ``out``.

    The triads (j4, j2, j6) and (j4, j5, j3) satisfy the triangle conditions. ``out`` has the shape
    (>= 2 min(j2, j3, j5, j6) + 1,). Return jmin = max(|j2 - j3|, |j5 - j6|) and their number n: ``out[i]`` belongs to
    j = jmin + i.

    Notes
    -----
    Schulten & Gordon, J. Math. Phys. 16, 1961 (1975). Against wignernj at j2 up to 1100: absolute error below 1e-14
    (tests/unit/test_predict_wigner.py).
    """
    jmin = max(abs(j2 - j3), abs(j5 - j6))
    n = min(j2 + j3, j5 + j6) - jmin + 1
    x2, x3, x4 = j2 * (j2 + 1.0), j3 * (j3 + 1.0), j4 * (j4 + 1.0)
    x5, x6 = j5 * (j5 + 1.0), j6 * (j6 + 1.0)
    upper, diagonal, lower = np.zeros(n), np.zeros(n), np.zeros(n)
    here = 0.0  # vanishes at jmin
    for i in range(n):
        j = float(jmin + i)
        beyond = _root(j + 1.0, j2 + j3 + 1.0, j2 - j3) * _root(j + 1.0, j5 + j6 + 1.0, j5 - j6)
        if jmin + i == 0:
            # The recursion divided by j, in its limit j -> 0, where j2 = j3 and j5 = j6.
            upper[i], diagonal[i] = beyond, 2.0 * (x2 + x5 - x4)
        else:
            x = j * (j + 1.0)
            upper[i] = j * beyond
            diagonal[i] = (2.0 * j + 1.0) * (x * (x2 + x3 - x) + x5 * (x + x2 - x3) + x6 * (x - x2 + x3) - 2.0 * x * x4)
            lower[i] = (j + 1.0) * here
        here = beyond
    _minimal_at_both_ends(upper, diagonal, lower, n, out)
    _normalise(jmin, n, 2.0 * j4 + 1.0, 1.0 if (j2 + j3 + j5 + j6) % 2 == 0 else -1.0, out)
    return jmin, n
