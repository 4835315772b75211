"""Noise with more memory than a model says: its knee is named, or stands beside a level of white noise."""

import pytest

from instruments import ask, data_of, two_channels
from mcsim import config, systematics
from mcsim.datavector import campaign
from mcsim.datavector.analysis import analysis_of, check_asked
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.context import context
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.simulation import simulate
from refusals import refused

PROPOSED = ("beam_ellipticity", "noise_level", "noise_knee")
WITHOUT = [name for name in systematics.catalogue() if name not in PROPOSED]


def model(noise):
    table = two_channels("memory", sigma0_uk=21.0, period_s=122.0)
    for channel in table["channel"]:
        channel["noise"] = noise(channel["noise"]["sigma0_uk"])
    return config.load(table)


def drifting(sigma0_uk):
    return {"kind": "correlated", "sigma0_uk": sigma0_uk, "f_knee_hz": 1e-3, "f_min_hz": 1e-5}


@pytest.fixture(scope="module")
def known():
    analysis = analysis_of(model(drifting), without=WITHOUT, settings=DiagnosisSettings())
    return context(analysis, *campaign.learned(analysis, ask, 260, time_ordered=False))


@pytest.mark.parametrize(("name", "amplitude"), [("noise_knee", 1.0), ("noise_level", 0.2)])
def test_a_knee_and_a_level_are_named_or_one_beside_the_other(known, name, amplitude):
    data = data_of(known.run, name, "W1", seed=1024, amplitude=amplitude)
    found = diagnose_data(ObservedMaps(known, list(simulate.maps(data, 0)), ask), "memory")
    sets = {tuple((one.name, one.channel) for one in own.effects): own.effects[0] for own in found.sets}
    assert ((name, "W1"),) in sets
    assert set(sets) <= {(("noise_knee", "W1"),), (("noise_level", "W1"),)}
    own = sets[((name, "W1"),)]
    assert own.amplitude == pytest.approx(amplitude, abs=3.0 * own.sigma)
    assert own.amplitude > 5.0 * own.sigma


def test_white_noise_has_no_knee():
    analysis = analysis_of(model(lambda sigma0_uk: {"sigma0_uk": sigma0_uk}), without=WITHOUT)
    assert {one.name for one in analysis.candidates} == {"beam_ellipticity", "noise_level"}
    with refused("noise_knee", "memory"):
        check_asked(analysis, ["noise_knee"])
