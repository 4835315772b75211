"""The noise that maps of one sky have, and draws of what they do not show."""

from types import SimpleNamespace

import healpy
import numpy as np
import pytest

from mcsim.comparison.shown_sky import _draw, _weight

NSIDE, LMAX, SIGMA = 16, 31, 40.0


def a_pair(splits: int, sky_uk: float, even: bool = False) -> SimpleNamespace:
    """Return maps of one sky with noise that is even, or over the square root of uneven hits, and is left of them."""
    rng, npix = np.random.default_rng(8), 12 * NSIDE**2
    hits = np.tile(np.where(np.arange(npix) < npix // 2, 4.0, 36.0), (splits, 1))
    noise = SIGMA * rng.normal(size=hits.shape) / (1.0 if even else np.sqrt(hits))
    sky = sky_uk * rng.normal(size=npix)
    # Of a single map the sky takes up as many degrees of freedom as it has coefficients.
    left = noise if splits > 1 else noise * np.sqrt(1.0 - (LMAX + 1.0) ** 2 / npix)
    response = SimpleNamespace(factors=[np.ones(LMAX + 1, dtype=complex)])
    return SimpleNamespace(
        scene=SimpleNamespace(preparations=(), response=response), hits=hits, seen=np.ones_like(hits, dtype=bool),
        a=sky + noise, unmade=left, nside=NSIDE, pointing=lambda: None,
    )  # fmt: skip


@pytest.mark.parametrize("even", [False, True])
@pytest.mark.parametrize("splits", [1, 2])
def test_weights_are_the_inverse_variance_of_the_noise(splits: int, even: bool) -> None:
    pair = a_pair(splits, 100.0, even)
    # A variance from 3072 pixels is known to 2.6 %.
    expected = np.ones_like(pair.hits) if even else pair.hits
    np.testing.assert_allclose(_weight(pair), expected / SIGMA**2, rtol=4.0 * 0.026)


@pytest.mark.parametrize(("share", "noisy"), [(0.7, True), (1.4, False)])
def test_noise_is_told_above_a_share_of_the_sky(share: float, noisy: bool) -> None:
    """The difference of two splits has twice the noise of their mean: of 0.02 of the sky none is told."""
    mean = SIGMA * np.sqrt(0.5 * (1 / 4.0 + 1 / 36.0)) / np.sqrt(2.0)
    assert (_weight(a_pair(2, share * mean / 0.02)) is not None) == noisy


def test_draws_have_the_power_that_is_asked_for() -> None:
    power = np.linspace(2.0, 1.0, 200)
    found = healpy.alm2cl(_draw(power, np.random.default_rng(3)))
    pulls = (found / power - 1.0) / np.sqrt(2.0 / (2.0 * np.arange(200) + 1.0))
    assert abs(pulls.mean()) < 4.0 / np.sqrt(200)
