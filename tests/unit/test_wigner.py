"""Clebsch-Gordan bands against wignernj, which works with exact integers."""

import numpy as np
import pytest
import wignernj

from mcsim.sphere.clebsch import band, evaluate


def exact(L: int, M: int, l1: int, m1: int, l2: int) -> float:
    m2 = m1 - M
    return (-1) ** m2 * float(wignernj.clebsch_gordan(l1, m1, l2, -m2, L, M))


@pytest.mark.parametrize("M", range(5))
@pytest.mark.parametrize("d", range(-4, 5))
def test_every_coefficient_of_a_small_band(M: int, d: int) -> None:
    tables = band(4, M, d, lmax=9)
    for l2 in range(max(0, d), 10):
        l1 = l2 - d
        for m1 in range(-l1, l1 + 1):
            for L in range(tables.L_min, 5):
                if abs(m1 - M) <= l2 and l1 + l2 >= L:
                    assert evaluate(tables, L, l2, m1) == pytest.approx(exact(L, M, l1, m1, l2), abs=2e-15)


@pytest.mark.parametrize(("M", "d"), [(0, 0), (0, 2), (1, -1), (2, 0), (2, 1), (3, -3), (8, 0), (5, 8), (8, -8)])
def test_large_degrees(M: int, d: int) -> None:
    """To round-off at l = 2000, edges of the m range included: the coefficients are of order sqrt((2L+1)/(2l+1))."""
    l2 = 2000
    l1 = l2 - d
    tables = band(8, M, d, l2)
    edge = min(l1, l2 + M)
    lowest = max(-l1, M - l2)
    for m1 in (lowest, lowest + 1, -1503, -M, 0, 7, 1502, edge - 1, edge):
        for L in range(tables.L_min, 9):
            scale = np.sqrt((2 * L + 1) / (2 * l2 + 1))
            assert abs(evaluate(tables, L, l2, m1) - exact(L, M, l1, m1, l2)) < 1e-13 * scale


def test_what_does_not_exist_is_zero() -> None:
    tables = band(2, 1, 1, 4)
    assert evaluate(tables, 1, 0, 0) == 0.0  # l1 = -1
    assert evaluate(tables, 2, 1, 0) == 0.0  # triangle (0, 1, 2)
    assert evaluate(tables, 1, 2, 2) == 0.0  # |m1| > l1
