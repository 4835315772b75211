"""Skies that the data constrain have the power of the model's, whatever a preparation or an effect did to the maps."""

from dataclasses import replace

import healpy
import numpy as np
import pytest

from instruments import two_channels
from mcsim import config
from mcsim.bipolar import power_spectrum
from mcsim.config.noise import Noise
from mcsim.datavector.analysis import analysis_of, simulated_maps
from mcsim.datavector.campaign import constrained_jobs, with_effects
from mcsim.datavector.same_skies import SameSkies
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.shared_sky import shared_sky
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.sphere import healpix

NSIDE = 16
DATA, SIMULATIONS = 6, 24
NEARLY = 0.05  # filters are approximate where noise is not white
SILENT = Noise(sigma0_uk=1e-3)
HEIGHT = np.abs(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2])

FILL = {"kind": "fill"}
ROTATE = {"kind": "rotate", "frame": "galactic"}
SMOOTH = {"kind": "smooth", "fwhm_arcmin": 700.0}
SOFT = {"kind": "mask", "mask": "soft.fits", "mask_frame": "ecliptic"}
DEGRADE = {"kind": "degrade", "nside": NSIDE}


def power(maps):
    """Return the power of two maps in five ranges of degrees."""
    ranges = np.array_split(np.arange(2, 2 * NSIDE + 1), 5)
    each = [healpix.analysis(np.where(one > -1e30, one, 0.0), 2 * NSIDE, 1) for one in maps[::2]]
    spectra = [power_spectrum(alm, alm, 2 * NSIDE) for alm in each]
    return np.array([np.sum((2 * ell + 1) * cl[ell]) for cl in spectra for ell in ranges])


@pytest.mark.parametrize(
    ("steps", "fine", "hidden"),
    [
        ([FILL, ROTATE], NSIDE, False),
        ([FILL, SMOOTH], NSIDE, False),
        ([ROTATE], NSIDE, True),
        ([ROTATE, SMOOTH], NSIDE, True),
        ([DEGRADE, SOFT], 2 * NSIDE, False),
    ],
    ids=["turned", "smoothed", "turned behind a mask", "turned and smoothed", "the sky beyond, behind a soft mask"],
)
def test_constrained_skies_have_the_power_of_the_model(steps, fine, hidden, tmp_path, monkeypatch):
    """Noise that a step in harmonics has taken from pixels is not less at low degrees; zeros in a mask are no data."""
    monkeypatch.chdir(tmp_path)
    healpy.write_map("mask.fits", (HEIGHT > 0.3).astype(float), dtype=np.float64)
    healpy.write_map("soft.fits", np.clip((HEIGHT - 0.3) / 0.06, 0.0, 1.0), dtype=np.float64)
    noise = 60.0 if hidden else 120.0
    table = two_channels("constrained", lmax=5 * fine // 2, nside=fine, fwhm_arcmin=300.0, sigma0_uk=noise)
    table["biposh"]["lmax"] = 2 * NSIDE
    if hidden:
        table["map"] |= {"mask": "mask.fits", "mask_frame": "ecliptic"}
    analysis = analysis_of(config.load(table | {"preparation": steps}), settings=DiagnosisSettings())
    model, run = analysis.model, analysis.run
    bare = replace(run.map, mask=None, mask_frame=None)
    quiet = tuple(replace(one, noise=SILENT) for one in run.channels)
    plain = replace(run, channels=quiet, map=bare, preparation=())
    jobs = []
    for realization in range(SIMULATIONS, SIMULATIONS + DATA):
        observed = shared_sky(model, list(simulate.maps(model.survey, realization)))
        jobs += constrained_jobs(analysis, (), observed, range(1))
    assert_power_of(plain, jobs)


def assert_power_of(plain, jobs):
    """Assert that the skies of jobs, in maps without noise and preparation, have the power of the model's."""
    expected = np.array([power(list(simulate.maps(survey(plain), k))) for k in range(SIMULATIONS)])
    simulated = [replace(job, simulated=config.to_json(plain)) for job in jobs]
    found = [power(one) for job in simulated for one in simulated_maps(job)]
    mean = expected.mean(axis=0)
    error = expected.std(axis=0, ddof=1) * np.sqrt(1.0 / len(found) + 1.0 / SIMULATIONS)
    assert np.all(np.abs(np.mean(found, axis=0) - mean) < 5.0 * error + NEARLY * mean)


@pytest.mark.parametrize(
    ("name", "amplitude"),
    [("beam_width", 0.6), ("beam_width", -0.6), ("noise_level", 2.0), ("noise_level", -0.6)],
    ids=["wider", "narrower", "noisier", "quieter"],
)
def test_skies_scatter_by_as_much_as_an_effect_hides(name, amplitude):
    """Of degrees that a beam or noise hides, less is known than by the filter of the model, which adds scatter."""
    table = two_channels("hidden", lmax=5 * NSIDE // 2, nside=NSIDE, fwhm_arcmin=600.0, sigma0_uk=40.0)
    table["biposh"]["lmax"] = 2 * NSIDE
    run = config.load(table)
    analysis = analysis_of(run, settings=DiagnosisSettings())
    names = [channel.name for channel in run.channels]
    found = [config.Effect(name=name, channel=one, parameters={"amplitude": amplitude}) for one in names]
    observed = survey(with_effects(run, found))
    jobs = []
    for realization in range(SIMULATIONS, SIMULATIONS + DATA):
        skies = SameSkies(analysis, lambda _: [], list(simulate.maps(observed, realization)))
        jobs += skies._jobs((), True, 1, there=found)
    assert_power_of(replace(run, channels=tuple(replace(one, noise=SILENT) for one in run.channels)), jobs)
