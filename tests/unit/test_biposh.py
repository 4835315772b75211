"""The estimator against the explicit sum over exact Clebsch-Gordan coefficients, and its conventions one by one."""

import numpy as np
import pytest
import wignernj

from mcsim import bipolar
from mcsim.bipolar import Mode
from mcsim.sphere import alm as alm_
from mcsim.sphere.sky import gaussian_alm
from refusals import refused

LMAX = 7


def draw(seed: int, lmax: int = LMAX) -> np.ndarray:
    return gaussian_alm(np.ones(lmax + 1), np.random.default_rng(seed))


def coefficient(alm: np.ndarray, ell: int, m: int) -> complex:
    value = alm[alm_.start(LMAX, abs(m)) + ell]
    return value if m >= 0 else (-1) ** m * np.conj(value)


def explicit(x: np.ndarray, y: np.ndarray, mode: Mode, l2: int) -> complex:
    l1 = l2 - mode.d
    total = 0j
    for m1 in range(-l1, l1 + 1):
        m2 = m1 - mode.M
        if abs(m2) <= l2:
            clebsch = float(wignernj.clebsch_gordan(l1, m1, l2, -m2, mode.L, mode.M))
            total += coefficient(x, l1, m1) * np.conj(coefficient(y, l2, m2)) * (-1) ** m2 * clebsch
    return total


@pytest.mark.parametrize("cross", [False, True])
def test_explicit_sum(cross: bool) -> None:
    x, y = draw(1), draw(2)
    tables = bipolar.estimator(4, LMAX, both_orders=cross)
    found = bipolar.estimate(tables, x, y if cross else None)
    for row, mode in enumerate(tables.modes):
        for l2 in range(LMAX + 1):
            l1 = l2 - mode.d
            if 0 <= l1 <= LMAX and l1 + l2 >= mode.L:
                assert found[row, l2] == pytest.approx(explicit(x, y if cross else x, mode, l2), abs=1e-13)
            else:
                assert np.isnan(found[row, l2])


def test_modes_of_one_map_leave_out_what_vanishes_and_what_repeats() -> None:
    names = [mode.name for mode in bipolar.modes(2, both_orders=False)]
    assert names == ["L0M0d0", "L1M0d1", "L1M1d1"] + [f"L2M{M}d{d}" for M in range(3) for d in range(3)]
    assert Mode(2, 0, 1).parity == "odd"
    assert len(bipolar.modes(2, both_orders=True)) == 1 + 2 * 3 + 3 * 5


def test_one_map_in_a_table_of_pairs_fills_only_its_own_modes() -> None:
    tables = bipolar.estimator(2, LMAX, both_orders=True)
    found = bipolar.estimate(tables, draw(1))
    for row, mode in enumerate(tables.modes):
        assert np.isnan(found[row]).all() == (not mode.in_auto)


def test_symmetries_of_one_map() -> None:
    """A_{l2 l1} = (-1)^{l1+l2-L} A_{l1 l2}; M = 0 is real for even parity, imaginary for odd (paper, Sec. II)."""
    x = draw(3)
    tables = bipolar.estimator(3, LMAX, both_orders=True)
    pair = dict(zip((mode.name for mode in tables.modes), bipolar.estimate(tables, x, x), strict=True))
    for mode in tables.modes:
        swapped = pair[Mode(mode.L, mode.M, -mode.d).name]
        sign = -1.0 if mode.parity == "odd" else 1.0
        shifted = np.full(LMAX + 1, np.nan + 0j)
        inside = np.arange(max(0, mode.d), min(LMAX, LMAX + mode.d) + 1)
        shifted[inside] = swapped[inside - mode.d]
        exists = np.isfinite(pair[mode.name])
        np.testing.assert_allclose(pair[mode.name][exists], sign * shifted[exists], atol=1e-13)
        if mode.M == 0:
            vanishing = pair[mode.name].imag if mode.parity == "even" else pair[mode.name].real
            assert np.all(vanishing[exists] == 0.0)


def test_monopole_is_the_power_spectrum() -> None:
    """A^{00}_ll = (-1)^l sqrt(2l+1) C_l, and C_l in the Bennett normalisation."""
    x, y = draw(4), draw(5)
    ell = np.arange(LMAX + 1)
    found = bipolar.estimate(bipolar.estimator(0, LMAX, True), x, y)[0]
    cl = bipolar.power_spectrum(x, y, LMAX)
    np.testing.assert_allclose(found, (-1.0) ** ell * np.sqrt(2 * ell + 1) * cl, atol=1e-13)
    np.testing.assert_allclose(found * bipolar.bennett_factor(Mode(0, 0, 0), LMAX), cl, atol=1e-13)


@pytest.mark.parametrize("mode", [Mode(2, 0, 0), Mode(2, 1, 2), Mode(4, 0, -2), Mode(1, 0, 1)])
def test_bennett_factor(mode: Mode) -> None:
    factor = bipolar.bennett_factor(mode, 6)
    for l2 in range(7):
        l1 = l2 - mode.d
        if l1 < 0 or l1 + l2 < mode.L:
            assert np.isnan(factor[l2])
            continue
        clebsch = float(wignernj.clebsch_gordan(l1, 0, l2, 0, mode.L, 0))
        expected = np.sqrt(2 * mode.L + 1) / (np.sqrt((2 * l1 + 1) * (2 * l2 + 1)) * clebsch)
        assert factor[l2] == pytest.approx(expected, rel=1e-13)


def test_bennett_factor_needs_even_parity() -> None:
    with refused("L2M0d1", "parity"):
        bipolar.bennett_factor(Mode(2, 0, 1), 4)


def test_bad_l_max() -> None:
    with refused("L_max", 9, 7):
        bipolar.estimator(9, LMAX)


@pytest.mark.parametrize("L_max", [1.0, True])
def test_tables_that_are_kept_let_no_bad_l_max_pass(L_max) -> None:
    bipolar.estimator(1, LMAX)
    with refused("L_max", L_max):
        bipolar.estimator(L_max, LMAX)
