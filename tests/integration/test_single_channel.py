"""The only channel behind a mask: the dipole that an effect leaves meets this very sky, its power any."""

import healpy
import numpy as np
import pytest

from instruments import ask, data_of, learned, two_channels
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.simulation import simulate


@pytest.fixture(scope="module")
def known():
    table = two_channels("alone", lmax=20, nside=8, fwhm_arcmin=1150.0, sigma0_uk=92.0)
    table["channel"] = table["channel"][:1]
    table["map"]["mask"] = (np.abs(healpy.pix2vec(8, np.arange(12 * 8**2))[2]) > 0.3).astype(float)
    return learned(table, "calibration", "dipole_residual", simulations=300)


@pytest.mark.parametrize("seed", [77, 78, 79])
def test_a_calibration_error_is_no_dipole_alone(known, seed):
    """Its dipole of 13 uK in a typical sky fitted worse than a residual one in this sky, which was named."""
    data = data_of(known.run, "calibration", "V1", seed=seed, amplitude=0.004)
    found = diagnose_data(ObservedMaps(known, list(simulate.maps(data, 0)), ask), "alone")
    (calibration, *_) = [own.effects[0] for own in found.sets if own.effects[0].name == "calibration"]
    assert calibration.amplitude == pytest.approx(0.004, abs=3.0 * calibration.sigma)
    assert calibration.sigma < 0.001


def test_a_dipole_is_no_calibration_error(known):
    """It lies across the dipole of the CMB, which is at longitude 172 and latitude -11 degrees of the ecliptic."""
    data = data_of(known.run, "dipole_residual", "V1", amplitude=25.0, lon_deg=82.0, lat_deg=0.0)
    found = diagnose_data(ObservedMaps(known, list(simulate.maps(data, 0)), ask), "across")
    assert {own.effects[0].name for own in found.sets} == {"dipole_residual"}
