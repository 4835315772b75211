"""A residual dipole far above the noise of smoothed maps: most of what it does is in squares of the maps."""

import pytest

from instruments import ask, data_of, learned, two_channels
from mcsim.diagnosis.inference import diagnose_data
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.simulation import simulate


@pytest.fixture(scope="module")
def model():
    table = two_channels("smooth", sigma0_uk=100.0)
    table["preparation"] = [{"kind": "smooth", "fwhm_arcmin": 560.0}]
    return learned(table, "calibration", "beam_width", "dipole_residual", "noise_level", "noise_anisotropy")


@pytest.mark.parametrize("amplitude", [6.0, 12.0])
def test_a_strong_dipole_has_its_size(model, amplitude):
    there = {"amplitude": amplitude, "lon_deg": 160.0, "lat_deg": 30.0}
    maps = list(simulate.maps(data_of(model.run, "dipole_residual", "W1", **there), 1))
    verdict = diagnose_data(ObservedMaps(model, maps, ask), "dipole")
    ((one,),) = (each.effects for each in verdict.sets)
    assert (verdict.kind, one.name, one.channel) == ("effect", "dipole_residual", "W1")
    assert abs(one.amplitude - amplitude) < 3.0 * one.sigma
    assert one.sigma < 0.1 * amplitude
