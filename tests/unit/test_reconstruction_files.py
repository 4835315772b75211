"""What the Python files of reconstructed effects say of their use, and which channels they act in."""

import ast
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import healpy
import numpy as np
import pytest

from mcsim.reconstruction.plugin import Plugin, plugin
from mcsim.reconstruction.structure import ALIKE, Structure
from mcsim.systematics.sky import Boost


@pytest.mark.parametrize("channel", ["V1", 'é "1"', 'W """ 1'])
def test_a_file_says_how_it_is_used_whatever_the_channel_is_called(channel):
    for base, values in (("BeamOrder", {"order": 0}), ("BoostedSky", {"velocity": (0.0, 0.0, 0.1)})):
        text = Plugin("unlisted_1", base, channel, values).source(f"Of {channel}.")
        (said, *_) = ast.parse(text).body
        (table,) = tomllib.loads(said.value.value.split("\n\n")[2])["effect"]
        assert table.get("channel") == (channel if base == "BeamOrder" else None)


@pytest.mark.parametrize("speed", [1e-3, 1.5, 40.0])
def test_a_boost_of_any_size_that_maps_ask_for_can_be_simulated(speed):
    # A fit to maps that lack something else may give more than the velocity of light: a diagnosis ended there.
    velocity = tuple(speed * np.array([0.48, -0.6, 0.64]))
    kind = Plugin("unlisted_1", "BoostedSky", "V1", {"velocity": velocity, "frame": "galactic"}).kind()
    ell = np.arange(9)
    real, imaginary = np.random.default_rng(8).normal(size=(2, 45))
    sky = real + 1j * np.where(np.arange(45) < len(ell), 0.0, imaginary)
    found = kind(amplitude=1.0).sky(sky, SimpleNamespace(lmax=8, frame="galactic"), None)
    power = [healpy.alm2cl(one) @ (2.0 * ell + 1.0) for one in (sky, found)]
    assert power[1] == pytest.approx(power[0], rel=1e-9)  # a boost is unitary
    if speed < 0.01:
        lon_deg, lat_deg = np.rad2deg([np.arctan2(-0.6, 0.48), np.arcsin(0.64)])
        boost = Boost(amplitude=speed, lon_deg=lon_deg, lat_deg=lat_deg).sky(sky, SimpleNamespace(lmax=8), None)
        np.testing.assert_allclose(found, boost, atol=1e-6 * np.abs(sky).max())


@pytest.mark.parametrize("names", [("W 1", "W 2"), ("W 1-4", "W 2-4")])
def test_lines_of_sight_are_told_apart_whatever_the_channels_are_called(names):
    """Of the lines of two channels each is its own, and none is a wave because its name ends in a range."""
    rows = np.array([[0], [1], [2]])
    found = [
        Structure("added", "dipole", "spacecraft", f"line {name}", "V1", ALIKE, None, rows, np.ones(1))
        for name in names
    ]
    level = replace(found[0], stage="power", acts_on="", frame="", kind="monopole")
    assert not found[0].like(found[1])
    assert found[0].like(found[0])
    assert not replace(found[0], acts_on="").extends(replace(level, acts_on=""))
    scene = SimpleNamespace(channels=("V1", *names), splits=("half1", "half2"), timed=True, frame="ecliptic")
    (made, other) = (plugin("unlisted_1", one, np.array([0.1, 0.2, 0.3]), scene) for one in found)
    assert made.values["coefficients"] == other.values["coefficients"] == (0.1, 0.2, 0.3)
