r"""Clebsch-Gordan coefficients in the bands that BipoSH coefficients need.

For small L and |l1 - l2| <= L the coefficients of all l and m up to lmax fill bands. Their values follow from a
closed product at the smallest L of a band and a three-term recursion in L whose factors are linear in m; both are
kept as short tables in l, so that a band of lmax 2000 costs kilobytes and a handful of operations per coefficient.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Table = NDArray[np.float64]


class Band(NamedTuple):
    r"""Tables for G_L = (-1)^{m2} C^{LM}_{l1 m1 l2 -m2} with l1 = l2 - d, m2 = m1 - M and L = L_min ... L_max.

    ``G_{L_min} = norm[l2] * rising_a[x] * rising_b[y]`` and
    ``G_{L+1} = (constant[L] + slope[L] m1) G_L + previous[L] G_{L-1}`` with tables in l2.
    """

    #: M, d: order of the bipolar coefficient, >= 0, and l2 - l1
    M: int
    d: int
    #: L_min, L_max: first and last L; L_min = max(|d|, M)
    L_min: int
    L_max: int
    norm: Table  #: shape (lmax + 1,)
    #: rising_a, rising_b: sqrt((x + k)! / x!) for x >= 0, shape (2 lmax + M + |d| + 1,)
    rising_a: Table
    rising_b: Table
    #: shift_a, shift_b: x = l2 - m1 + shift_a and y = l2 + m1 + shift_b
    shift_a: int
    shift_b: int
    #: constant, slope, previous: shape (L_max - L_min, lmax + 1); row i leads to L_min + i + 1
    constant: Table
    slope: Table
    previous: Table


def _rising(x: Table, k: int) -> Table:
    """Return sqrt((x + k)! / x!) as a product of k factors, which avoids large factorials."""
    product = np.ones_like(x)
    for i in range(1, k + 1):
        product *= np.sqrt(x + i)
    return product


def band(L_max: int, M: int, d: int, lmax: int) -> Band:
    r"""Return the tables of the Clebsch-Gordan band of order M and offset d = l2 - l1 for l2 <= lmax.

    0 <= M <= L_max and -L_max <= d <= L_max.

    Notes
    -----
    At L = |d| >= M the larger of l1, l2 is the stretched sum of the others, at L = M > |d| the order is stretched;
    both are single products (Varshalovich et al. 1988, 8.5.1). The recursion in L is that of Schulten & Gordon (1975),
    J. Math. Phys. 16, 1961, run upwards from the bottom of the range, where L << l keeps it stable. Against
    exact integer arithmetic: below 1e-13 of the largest coefficient for l <= 2000, L <= 8
    (``tests/unit/test_wigner.py``).
    """
    l2 = np.arange(lmax + 1, dtype=np.float64)
    l1 = l2 - d
    L_min = max(abs(d), M)
    exists = (l1 >= 0) & (l1 + l2 >= L_min)
    x, zero = np.arange(2.0 * lmax + M + abs(d) + 1), np.zeros(())
    norm = np.zeros(lmax + 1)
    small, large = np.minimum(l1, l2)[exists], np.maximum(l1, l2)[exists]
    if abs(d) >= M:
        # C^{LM}_{l1 m1 l2 -m2} from the stretched C^{large}_{small, L}: (2 small)! (2 L)! / (2 large)!
        scale = np.sqrt((2 * L_min + 1) / (2 * large + 1)) / _rising(2 * small, 2 * L_min)
        norm[exists] = scale * _rising(zero + L_min - M, L_min + M) / _rising(zero, L_min + M)
        if d >= 0:
            a, b, shift_a, shift_b = d + M, d - M, -d, -d
            sign = np.where((l1 + M) % 2 == 0, 1.0, -1.0)
        else:
            a, b, shift_a, shift_b = -d - M, -d + M, M, -M
            sign = np.where(l2 % 2 == 0, 1.0, -1.0)
    else:
        a, b, shift_a, shift_b = M + d, M - d, -d, -M
        ends = _rising((l1 + l2)[exists] - M, 2 * M + 1)
        norm[exists] = _rising(zero, 2 * M + 1) / (ends * _rising(zero, M - d) * _rising(zero, M + d))
        sign = np.where((l1 + M) % 2 == 0, 1.0, -1.0)
    norm *= sign

    rows = L_max - L_min
    constant, slope, previous = np.zeros((3, rows, lmax + 1))
    for row in range(rows):
        L = L_min + row
        valid = exists & (l1 + l2 >= L + 1)
        j1, j2 = l1[valid], l2[valid]

        def root(L: int, j1: Table = j1, j2: Table = j2) -> Table:
            return np.sqrt((L**2 - d**2) * ((j1 + j2 + 1) ** 2 - L**2) * (L**2 - M**2))

        if L == 0:
            # The recursion is empty at L = 0: (-1)^m C^{10}_{l m l -m} over (-1)^m C^{00}_{l m l -m}.
            slope[row, valid] = np.sqrt(3.0 / (j1 * (j1 + 1)))
            continue
        lead = np.sqrt(2 * L + 3) / (L * root(L + 1))
        scale = lead * (2 * L + 1) / np.sqrt(2 * L + 1)
        constant[row, valid] = -scale * (M * (j1 * (j1 + 1) - j2 * (j2 + 1)) + L * (L + 1) * M)
        slope[row, valid] = scale * 2 * L * (L + 1)
        if L_min < L:
            previous[row, valid] = -lead * (L + 1) * root(L) / np.sqrt(2 * L - 1)
    return Band(M, d, L_min, L_max, norm, _rising(x, a), _rising(x, b), shift_a, shift_b, constant, slope, previous)


def evaluate(tables: Band, L: int, l2: int, m1: int) -> float:
    """Return one (-1)^{m2} C^{LM}_{l1 m1 l2 -m2}, with l1 = l2 - d and m2 = m1 - M, by the recursion."""
    l1, m2 = l2 - tables.d, m1 - tables.M
    if l1 < 0 or abs(m1) > l1 or abs(m2) > l2 or l1 + l2 < L:
        return 0.0
    value = tables.norm[l2] * tables.rising_a[l2 - m1 + tables.shift_a] * tables.rising_b[l2 + m1 + tables.shift_b]
    before = 0.0
    for row in range(L - tables.L_min):
        step = tables.constant[row, l2] + tables.slope[row, l2] * m1
        before, value = value, step * value + tables.previous[row, l2] * before
    return float(value)
