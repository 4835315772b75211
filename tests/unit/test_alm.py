import healpy
import numpy as np
import pytest

from mcsim.sphere import alm


@pytest.mark.parametrize("lmax", [0, 1, 7, 64])
def test_order_is_that_of_healpy(lmax: int) -> None:
    ell, m = healpy.Alm.getlm(lmax)
    assert alm.size(lmax) == healpy.Alm.getsize(lmax)
    np.testing.assert_array_equal(alm.degrees(lmax), ell)
    assert [alm.start(lmax, order) + degree for degree, order in zip(ell, m, strict=True)] == list(range(ell.size))


def test_resize_keeps_what_both_have() -> None:
    rng = np.random.default_rng(1)
    small = rng.normal(size=alm.size(5)) + 1j * rng.normal(size=alm.size(5))
    large = alm.resize(small, 5, 9)
    np.testing.assert_array_equal(alm.resize(large, 9, 5), small)
    assert np.count_nonzero(large) == small.size
    np.testing.assert_array_equal(large[: alm.size(9)][alm.degrees(9) > 5], 0.0)


def test_multiply_scales_by_degree() -> None:
    factor = np.array([1.0, 2j, 3.0])
    np.testing.assert_array_equal(alm.multiply(np.ones(6, complex), factor, 2), [1, 2j, 3, 2j, 3, 3])


def test_power_is_the_spectrum_times_the_orders() -> None:
    rng = np.random.default_rng(2)
    found = rng.normal(size=alm.size(6)) + 1j * rng.normal(size=alm.size(6))
    found[:7] = found[:7].real
    np.testing.assert_allclose(alm.power(found, 6), (2 * np.arange(7) + 1) * healpy.alm2cl(found), rtol=1e-13)
