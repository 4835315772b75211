"""What settings of a run do not go together, and where each limit is."""

import warnings
from contextlib import nullcontext

import numpy as np
import pytest

from mcsim import config
from refusals import refused

from .conftest import DIFFERENCING, REMOVED, changed


def with_all(plain: dict, changes: dict) -> dict:
    for key, value in changes.items():
        plain = changed(plain, key, value)
    return plain


@pytest.mark.parametrize(("key", "largest"), [("biposh.L_max", 64), ("channel.0.beam.m_max", 128)])
def test_orders_and_degrees_may_be_as_large_as_what_they_are_of(plain, folder, key, largest) -> None:
    plain = changed(plain, "biposh.lmax", 64)
    assert config.load(changed(plain, key, largest)) is not None
    with refused(largest + 1, largest):
        config.load(changed(plain, key, largest + 1))


@pytest.mark.parametrize(("share", "warned"), [(0.99, True), (1.01, False)])
def test_widths_that_no_map_shows_may_be_radians(plain, folder, share, warned) -> None:
    """Up to 0.03/lmax radians: such a Gaussian beam passes more than 0.9999 of the smallest structure."""
    width = float(np.degrees(share * 0.03 / 128.0) * 60.0)
    expected = pytest.warns(UserWarning, match=f"{width * 3437.7468:.4g} arcmin") if warned else nullcontext()
    with warnings.catch_warnings(), expected:
        config.load(changed(plain, "channel.1.beam.fwhm_arcmin", width))


GL = {"map.nside": REMOVED, "map.grid": "gl"}
WEIGHTED = {"biposh.filter": "inverse_covariance", "biposh.lmax": 64}
NOISY = {"channel.0.noise": {"sigma0_uk": 100.0}, "channel.1.noise": {"sigma0_uk": 100.0}}


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        (GL | {"map.frame": "equatorial"}, ("map.frame", "equatorial")),
        (GL | {"map.frame": "galactic"}, ("map.frame", "galactic")),
        (WEIGHTED | NOISY | {"channel.0.scan": DIFFERENCING}, ("W1",)),
        (WEIGHTED | {"channel.0.noise": NOISY["channel.0.noise"]}, ("V1",)),
        (WEIGHTED | NOISY | {"sky": {"alm": "alm.fits", "lmax": 128}}, ("spectrum",)),
    ],
)
def test_what_does_not_go_together_is_refused(plain, folder, changes, named) -> None:
    with refused(*named):
        config.load(with_all(plain, changes))


def test_the_same_without_what_is_refused_is_taken(plain, folder) -> None:
    assert config.load(with_all(plain, GL)).map.grid == "gl"
    assert config.load(with_all(plain, WEIGHTED | NOISY)).biposh.filtered
