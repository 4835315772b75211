"""Residual dipoles and calibration errors far above the noise: most of what they do is in squares of the maps."""

import numpy as np
import pytest

from instruments import ask, data_of, learned, two_channels
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
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


def test_a_bright_calibration_error_is_no_dipole():
    """It leaves one of 101 uK, of whose products with noise the covariance of the model knows nothing."""
    table = two_channels("bright", sigma0_uk=30.0)
    model = learned(table, "calibration", "beam_width", "dipole_residual", "noise_level", "beam_sidelobe")
    maps = list(simulate.maps(data_of(model.run, "calibration", "W1", amplitude=0.03), 1))
    verdict = diagnose_data(ObservedMaps(model, maps, ask), "calibration")
    ((one,),) = (each.effects for each in verdict.sets)
    assert (verdict.kind, one.name, one.channel) == ("effect", "calibration", "W1")
    assert abs(one.amplitude - 0.03) < 4.0 * one.sigma
    assert one.sigma < 1e-4


def test_the_error_of_a_calibration_without_splits_is_that_of_its_scatter():
    """Most of it is found by the square of the dipole that it leaves, which noise scatters: over 32 skies by 3.1e-5.

    Errors of eight skies, which were the same for all data, were 0.65 of that.
    """
    table = two_channels("whole", sigma0_uk=30.0)
    del table["map"]["splits"]
    model = learned(table, "calibration")
    errors = []
    for realization in (0, 1):
        maps = list(simulate.maps(data_of(model.run, "calibration", "V1", amplitude=0.002), realization))
        (one,) = diagnose_data(ObservedMaps(model, maps, ask), "calibration").effects
        assert (one.name, one.channel) == ("calibration", "V1")
        assert abs(one.amplitude - 0.002) < 4.0 * one.sigma
        errors.append(one.sigma)
    np.testing.assert_allclose(errors, 3.1e-5, rtol=0.3)
