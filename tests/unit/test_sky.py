import numpy as np

from mcsim import bipolar
from mcsim.sphere import alm
from mcsim.sphere.sky import gaussian_alm


def test_power_is_that_asked_for() -> None:
    """Mean of C_l over skies within 5 sigma of its known variance 2 C_l^2 / (2l + 1)."""
    n, lmax = 400, 20
    cl = 1.0 / (1.0 + np.arange(lmax + 1.0)) ** 2
    rng = np.random.default_rng(20121024)
    skies = [gaussian_alm(cl, rng) for _ in range(n)]
    mean = np.mean([bipolar.power_spectrum(a, a, lmax) for a in skies], axis=0)
    sigma = cl * np.sqrt(2.0 / (2 * np.arange(lmax + 1) + 1) / n)
    assert np.all(np.abs(mean - cl) < 5 * sigma)


def test_real_and_imaginary_parts_share_the_power_and_m0_is_real() -> None:
    n, lmax = 4000, 3
    rng = np.random.default_rng(1)
    skies = np.array([gaussian_alm(np.ones(lmax + 1), rng) for _ in range(n)])
    assert np.all(skies[:, : lmax + 1].imag == 0.0)
    above = skies[:, lmax + 1 :]
    sigma = 0.5 * np.sqrt(2.0 / n)
    assert np.all(np.abs(np.mean(above.real**2, axis=0) - 0.5) < 5 * sigma)
    assert np.all(np.abs(np.mean(above.imag**2, axis=0) - 0.5) < 5 * sigma)


def test_no_power_where_there_is_none() -> None:
    cl = np.array([0.0, 0.0, 1.0])
    sky = gaussian_alm(cl, np.random.default_rng(0))
    assert np.all(sky[alm.degrees(2) < 2] == 0.0)
    assert np.all(sky[alm.degrees(2) == 2] != 0.0)
