"""Comparisons of configurations with what another program made of the same samples and sky."""

import healpy
import numpy as np
import pytest
from astropy.table import Table

import mcsim
from mcsim import config
from mcsim.comparison import pairs
from mcsim.simulation import simulate, tod
from mcsim.simulation.survey import survey

NSIDE, LMAX = 8, 12
MODEL = """schema = 1
name = "few-samples"
sky = {{ spectrum = "wmap7", lmax = 12 }}
map = {{ nside = 8 }}
[[channel]]
name = "X"
beam = {{ kind = "elliptical_gaussian", fwhm_major_arcmin = 1100.0, fwhm_minor_arcmin = 800.0, m_max = 4 }}
scan = {{ kind = "pointing", path = "pointing.fits" }}
noise = {{ sigma0_uk = {noise} }}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a configuration, its few samples a pixel, and the maps of a program that takes each."""
    found, rng = tmp_path_factory.mktemp("samples"), np.random.default_rng(4)
    theta, phi = np.arccos(rng.uniform(-1, 1, 9000)), rng.uniform(0, 2 * np.pi, 9000)
    psi = rng.normal(0.0, 0.5, theta.size)
    Table({"theta": theta, "phi": phi, "psi": psi}).write(found / "pointing.fits")
    (found / "model.toml").write_text(MODEL.format(noise=0.0))
    (found / "noisy.toml").write_text(MODEL.format(noise=500.0))
    sky = simulate.draw_sky(survey(config.load(found / "model.toml")), 0)
    beam = mcsim.Beam.elliptical(1100.0, 800.0, lmax=LMAX, mmax=4)
    pixel = healpy.ang2pix(NSIDE, theta, phi)
    samples = [tod.Samples(0.0 * psi, theta, phi, psi, pixel, 0.0 * psi)]
    binned = tod.bin_samples(tod.sky_signal(sky, LMAX, beam, 1e-8, 1)(samples), NSIDE)[0]
    (found / "maps").mkdir()
    made = np.where(np.bincount(pixel, minlength=binned.size) > 0, binned, healpy.UNSEEN)
    healpy.write_map(found / "maps" / "X.fits", made, dtype=np.float64, column_units="uK", coord="E")
    return found


def test_samples_of_a_file_are_simulated_one_by_one_where_the_other_side_is(folder):
    """Of 12 samples a pixel the orientation moments miss per cents of the sky."""
    found = mcsim.compare(folder / "model.toml", folder / "maps")
    assert found.verdict == "identical"
    assert found.accuracy < 1e-5


def test_a_side_that_is_a_configuration_has_no_noise(folder):
    quiet, noisy = (pairs.read(folder / name, folder / "maps").pairs[0] for name in ("model.toml", "noisy.toml"))
    np.testing.assert_array_equal(noisy.a, quiet.a)
    [both] = pairs.read(folder / "noisy.toml", folder / "model.toml").pairs
    assert not both.noise_uk.any()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_monopole_does_not_choose_how_a_configuration_is_simulated(folder, sign, tmp_path):
    """It is like what single samples change, whose mean is not zero."""
    run = folder / "model.toml"
    [made] = mcsim.write_maps(run, tmp_path, realizations=0)
    map_ = healpy.read_map(made / "X.fits", dtype=np.float64)
    shifted = np.where(map_ > -1e20, map_ + sign * 1000.0, map_)
    healpy.write_map(made / "X.fits", shifted, dtype=np.float64, column_units="uK", coord="E", overwrite=True)
    found = mcsim.compare(run, made)
    assert [d.name for d in found.channels[0].differences] == ["monopole"]
    assert found.channels[0].left_rms_uk < 1e-3
