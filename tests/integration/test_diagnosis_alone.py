"""One channel alone: nothing else shows the sky from which its beam has taken power."""

from typing import Any

import pytest

import mcsim
from instruments import data_of
from mcsim import config
from mcsim.datavector.analysis import analysis_of
from mcsim.datavector.same_skies import SameSkies
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.simulation import simulate


def table(*names: str) -> dict[str, Any]:
    channel = {
        "frequency_ghz": 143.0,
        "beam": {"kind": "gaussian", "fwhm_arcmin": 240.0},
        "noise": {"kind": "depth", "depth_uk_arcmin": 250.0},
        "scan": {"kind": "parallel_transport"},
    }
    return {
        "name": "alone",
        "sky": {"spectrum": "wmap7", "lmax": 64},
        "map": {"nside": 32, "frame": "equatorial"},
        "channel": [{"name": name, **channel} for name in names],
    }


def test_what_a_beam_does_to_the_only_channel_is_measured_in_typical_skies() -> None:
    def skies_of(name: str, channel: str | None, *channels: str) -> str:
        skies = SameSkies(analysis_of(config.load(table(*channels))), lambda _: [], ())
        return skies.skies_of(config.Effect(name=name, channel=channel, parameters={"amplitude": 0.01}))

    for name in ("beam_width", "beam_ellipticity", "calibration", "pixelization"):
        assert skies_of(name, "T", "T") == "reference"
        assert skies_of(name, "T", "T", "U") == "constrained"
    assert skies_of("pointing_offset", "T", "T") == "constrained"
    assert skies_of("dipole_modulation", None, "T") == "constrained"
    assert skies_of("point_sources", None, "T", "U") == skies_of("point_sources", None, "T")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "amplitude"), [("beam_width", 0.139), ("beam_ellipticity", 0.361)])
def test_a_strong_beam_of_the_only_channel_has_its_name(name: str, amplitude: float) -> None:
    """A spectrum, or one with a calibration and half of the ellipse, described skies as the wider beam left them."""
    run = config.load(table("T"))
    maps = list(simulate.maps(data_of(run, name, "T", seed=4711, amplitude=amplitude), 30))
    (own,) = mcsim.diagnose(run, maps, settings=DiagnosisSettings(time_ordered_skies=0)).effects
    assert own.name == name
    assert abs(own.amplitude - amplitude) < 3.5 * own.sigma
