"""Variance of the estimator under isotropy against its closed form (design: E|A|^2 = C_l1 C_l2 (1 + delta_{l1 l2}))."""

import numpy as np
import pytest

from mcsim import bipolar
from mcsim.sphere import rng
from mcsim.sphere.sky import gaussian_alm

LMAX, N, SEED = 12, 3000, 20121024


@pytest.fixture(scope="module")
def ensemble() -> tuple[bipolar.Estimator, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    cl = 1.0 / (1.0 + np.arange(LMAX + 1.0))
    cxy = 0.6 * cl
    tables = bipolar.estimator(2, LMAX, both_orders=True)
    auto, cross = [], []
    for r in range(N):
        common = gaussian_alm(cxy, rng.generator(SEED, r, "sky"))
        x = common + gaussian_alm(cl - cxy, rng.generator(SEED, r, "noise/X"))
        y = common + gaussian_alm(cl - cxy, rng.generator(SEED, r, "noise/Y"))
        auto.append(bipolar.estimate(tables, x))
        cross.append(bipolar.estimate(tables, x, y))
    return tables, np.array(auto), np.array(cross), {"cl": cl, "cxy": cxy}


@pytest.mark.parametrize("which", ["auto", "cross"])
def test_second_moment_of_every_mode(which: str, ensemble) -> None:
    tables, auto, cross, spectra = ensemble
    cl, cxy = spectra["cl"], spectra["cxy"]
    z = []
    for row, mode in enumerate(tables.modes):
        if mode.L == 0 or (which == "auto" and not mode.in_auto):
            continue
        sample = (auto if which == "auto" else cross)[:, row]
        for l2 in range(LMAX + 1):
            l1 = l2 - mode.d
            if not np.isfinite(sample[0, l2]):
                continue
            if which == "auto":
                expected = cl[l1] * cl[l2] * (1 + (l1 == l2))
            else:
                expected = cl[l1] * cl[l2] + (-1) ** mode.L * (l1 == l2) * cxy[l2] ** 2
            power = np.abs(sample[:, l2]) ** 2
            z.append((power.mean() - expected) / (power.std() / np.sqrt(N)))
    z = np.array(z)
    # The z are nearly independent and nearly normal: their rms is 1 within 5 sampling errors (the fourth moment of
    # these quadratic forms is heavier than normal, so the errors come from the sample).
    assert abs(np.mean(z**2) - 1.0) < 5.0 * np.sqrt(2.0 / z.size)
    assert np.abs(z).max() < 5.0


def test_m_splits_evenly_between_real_and_imaginary(ensemble) -> None:
    tables, auto, _, _ = ensemble
    for row, mode in enumerate(tables.modes):
        if mode.M > 0 and mode.in_auto and mode.L > 0:
            sample = auto[:, row][:, np.isfinite(auto[0, row])]
            real, imag = np.mean(sample.real**2, axis=0), np.mean(sample.imag**2, axis=0)
            # Each mean has a relative error of about sqrt(2 / N) for l >> 1, up to sqrt(8 / N) at the lowest l.
            assert np.all(np.abs(real / imag - 1.0) < 5.0 * np.sqrt(2 * 8.0 / N))
