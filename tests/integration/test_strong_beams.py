"""Beams far from the model's are named with their size: observed skies are found as such beams see them."""

import numpy as np
import pytest

from instruments import ask, data_of, learned, two_channels
from mcsim import config
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.simulation import simulate


@pytest.fixture(scope="module")
def model():
    return learned(two_channels("small"), "calibration", "beam_width")


@pytest.mark.parametrize("amplitude", [-0.3, -0.08, 0.08])
def test_a_wide_or_narrow_beam_has_its_size(model, amplitude):
    """In skies that the model's beam was taken to see, -0.3 was -0.22, -0.08 was -0.072 and 0.08 was 0.085."""
    found = []
    for realization in range(3):
        maps = list(simulate.maps(data_of(model.run, "beam_width", "W1", amplitude=amplitude), realization))
        verdict = diagnose_data(ObservedMaps(model, maps, ask), "beam")
        assert verdict.kind == "effect"
        ((one,),) = (each.effects for each in verdict.sets)
        assert (one.name, one.channel) == ("beam_width", "W1")
        found.append((one.amplitude, one.sigma))
    values, errors = np.array(found).T
    assert abs(values.mean() - amplitude) < 3.0 * np.sqrt(np.mean(errors**2) / len(values))


@pytest.fixture(scope="module")
def windowed():
    scan = {"kind": "parallel_transport"}
    channel = {"frequency_ghz": 94.0, "noise": {"kind": "depth", "depth_uk_arcmin": 900.0}, "scan": scan}
    beams = {name: {"kind": "gaussian", "fwhm_arcmin": fwhm} for name, fwhm in (("A", 400.0), ("B", 330.0))}
    table = {
        "name": "windowed",
        "sky": {"spectrum": "wmap7", "lmax": 32},
        "map": {"nside": 16, "splits": ["h1", "h2"], "split_by": "sets", "pixel_window": "computed"},
        "channel": [{"name": name, "beam": beam, **channel} for name, beam in beams.items()],
    }
    return learned(table, "pixelization", "beam_width")


def test_windows_of_pixels_change_observed_skies_as_beams_do(windowed):
    """In skies that were found through the model's window, a response of none at all fitted with 0.87 of itself."""
    lost, found = config.Effect(name="pixelization", channel="B", parameters={"amplitude": 1.0}), []
    for realization in range(4):
        maps = list(simulate.maps(data_of(windowed.run, "pixelization", "B", amplitude=1.0), realization))
        observed = ObservedMaps(windowed, maps, ask)
        response = observed.respond([lost], 8).mean(axis=0)
        fit = windowed.null.fit(observed.x, response[:, None])
        found.append((fit.amplitudes[0], fit.errors[0]))
    values, errors = np.array(found).T
    assert abs(values.mean() - 1.0) < 3.0 * np.sqrt(np.mean(errors**2) / len(values))
