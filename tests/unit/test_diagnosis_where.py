"""The ranked list of places: what departs most first, and of each kind one before the others."""

from types import SimpleNamespace
from typing import Any

import healpy
import numpy as np
import pytest

from mcsim.datavector.bipolar_scan import BipolarScan
from mcsim.datavector.localisation import outstanding, places
from mcsim.datavector.summaries import Element

KINDS = [("V1", "ecliptic", 2), ("W1", "ecliptic", 2), ("W2", "ecliptic", 2), ("V1", "galactic", 1), ("W1", None, 0)]


def elements() -> list[Element]:
    return [
        Element(f"{channel}/{frame}/{L}", "biposh", (channel,), frame=frame, L=L, M=0, parity="even")
        for channel, frame, L in KINDS
    ]


def ranked(x: list[float]) -> list[tuple[str, int | None]]:
    simulations = np.random.default_rng(1).normal(size=(400, len(KINDS)))
    return [(place.element.channels[0], place.element.L) for place in places(np.array(x), simulations, elements())]


def test_each_kind_comes_before_more_of_the_same():
    assert ranked([9.0, 12.0, 10.0, 7.0, 0.1])[:4] == [("W1", 2), ("V1", 1), ("W2", 2), ("V1", 2)]


def test_what_is_not_significant_is_brought_before_nothing():
    assert ranked([9.0, 12.0, 10.0, 1.0, 0.1])[:3] == [("W1", 2), ("W2", 2), ("V1", 2)]


def test_of_what_is_not_significant_each_kind_comes_before_more_of_the_same():
    assert ranked([1.5, 2.0, 1.8, 1.0, 0.1])[:4] == [("W1", 2), ("V1", 1), ("W1", 0), ("W2", 2)]
    assert ranked([9.0, 2.0, 1.8, 1.0, 0.1])[:3] == [("V1", 2), ("V1", 1), ("W1", 0)]


@pytest.mark.parametrize("split", ["half1", "half2"])
def test_power_at_high_degrees_keeps_its_split(split):
    """Power of one map above its lowest bin is no power that the splits have in common."""
    parts = [
        SimpleNamespace(channel=c, name=f"{name}:{half}", split=half)
        for c, name in enumerate(("V1", "W1"))
        for half in ("half1", "half2")
    ]
    survey = SimpleNamespace(lmax=60)
    model: Any = SimpleNamespace(parts=parts, channels=("V1", "W1"), survey=survey, frame="ecliptic")
    powers = list(BipolarScan(model)._powers())
    here = [one.name.startswith(f"cl/W1:{split},W1:{split}/") and one.ell != (2, 12) for one in powers]
    assert sum(here) == 2
    simulations = np.random.default_rng(2).normal(size=(400, len(powers)))
    first = places(20.0 * np.array(here), simulations, powers)[0].element
    assert (first.channels, first.split) == (("W1",), split)
    across = {one.split for one in powers if one.name.startswith("cl/W1:half1,W1:half2/")}
    assert across == {None}


def test_a_glitch_stands_out_of_its_map_and_what_acts_everywhere_does_not():
    """Residuals over a scatter that 60 simulations told, of maps that are right, ten times too noisy, and dipoles."""
    rng, count, npix = np.random.default_rng(7), 60, 3072
    drawn = rng.normal(size=(200, 1, npix)) / np.sqrt(rng.chisquare(count - 1, size=(200, 1, npix)) / (count - 3.0))
    assert not any(outstanding(own, count, 1e-6) for own in drawn)
    noisy, dipole = 10.0 * drawn[0, 0], drawn[1, 0] + 50.0 * np.linspace(-1.0, 1.0, npix)
    glitch = drawn[2, 0] + 12.0 * (np.arange(npix) == 1234)
    hole = np.where(np.arange(npix) < 100, np.nan, glitch)
    nothing = np.full(npix, np.nan)
    uneven = drawn[3, 0] * (1.0 + 4.0 * healpy.pix2vec(16, np.arange(npix))[2] ** 8)
    two = glitch - 30.0 * (np.arange(npix) == 1000)
    found = outstanding(np.stack([noisy, glitch, dipole, hole, nothing, uneven, two]), count, 1e-6)
    assert np.abs(uneven).max() > 9.0
    assert {number: list(sizes) for number, sizes in found.items()} == {1: [1234], 3: [1234], 6: [1000, 1234]}
    assert found[1][1234] == pytest.approx(12.0, abs=4.0)
    assert found[6][1000] == pytest.approx(30.0, abs=4.0)


@pytest.mark.parametrize("seen", [0, 1, 3, 10, 40])
def test_of_a_few_pixels_none_stands_out_by_chance(seen):
    """The median distance of three from their median is that of the middle one: one of two such maps had a place."""
    drawn = np.random.default_rng(4).standard_normal((1000, 1, 3072))
    drawn[:, :, seen:] = np.nan
    assert not any(outstanding(one, 10_000, 1e-6) for one in drawn)
    drawn[0, 0, 0] = 100.0
    assert list(outstanding(drawn[0], 10_000, 1e-6)) == [0] * (seen >= 40)
