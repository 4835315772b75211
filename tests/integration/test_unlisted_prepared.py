"""What is missing in prepared maps, which show more of the sky than the filter, behind a mask."""

import healpy
import numpy as np
import pytest

from instruments import ask, data_of, learned, scored, two_channels
from mcsim.diagnosis import unlisted
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.reconstruction import simulated_scores
from mcsim.simulation import simulate
from mcsim.sphere import real

NSIDE = 8
SKY = healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """Two channels and a third, quiet one, degraded to nside 8, without monopole and dipole outside a mask."""
    path = str(tmp_path_factory.mktemp("mask") / "mask.fits")
    healpy.write_map(path, (np.abs(SKY[2]) > 0.3).astype(float), dtype=np.float64)
    table = two_channels("prepared", lmax=96, nside=32, fwhm_arcmin=60.0, sigma0_uk=36.0, period_s=301.0)
    quiet = {"name": "CMB", "frequency_ghz": 143.0, "noise": {"sigma0_uk": 5.0}}
    table["channel"].append(table["channel"][0] | quiet)
    table["map"] = {"nside": 32, "mask": path, "mask_frame": "ecliptic"}
    table["biposh"]["lmax"] = 16
    outside = {"kind": "subtract_dipole", "mask": path, "mask_frame": "ecliptic"}
    table["preparation"] = [{"kind": "degrade", "nside": NSIDE}, outside]
    return learned(table, simulations=220)


def test_a_pattern_on_the_sky_of_prepared_maps_is_described(prepared):
    """A pattern of ten times the noise of a pixel, which the isotropic filter did not tell from the sky."""
    maps = list(simulate.maps(data_of(prepared.run), 1))
    seen = np.abs(SKY[2]) > 0.3
    quadrupole = real.field(np.array([0, 0, 0, 0, 0.3, -0.5, 2.0, 0.4, 0.6]), *SKY)
    pattern = prepared.analysis.model.survey.maps[1].preparation.steps[1].apply(np.where(seen, quadrupole, np.nan))
    pattern = 10.0 * pattern / np.nanstd(pattern)
    maps[1] = np.where(seen, maps[1] + pattern, maps[1])
    scene = simulated_scores.scene_for(prepared.analysis.job(prepared.run))
    search = simulated_scores.search_of(prepared.analysis, scene, scored)
    found, reduction = unlisted.structures_of(ObservedMaps(prepared, maps, ask), scene, search, scored)
    (only,) = found
    assert (only.stage, only.frame, only.channel) == ("added", "sky", "W1")
    assert only.kind in ("quadrupole", "degrees 0-2")
    assert abs(only.rms_uk / 10.0 - 1.0) < 4.0 * only.relative_error
    assert reduction.achieved.value > 0.5


def test_nothing_is_described_in_perfect_prepared_maps(prepared):
    scene = simulated_scores.scene_for(prepared.analysis.job(prepared.run))
    search = simulated_scores.search_of(prepared.analysis, scene, scored)
    for realization in range(2, 6):
        maps = list(simulate.maps(data_of(prepared.run), realization))
        assert unlisted.structures_of(ObservedMaps(prepared, maps, ask), scene, search, scored) == ((), None)


@pytest.mark.parametrize(("power", "rms_uk", "told"), [(-3.0, 1.0, (-3.0, -2.0)), (1.5, 3.0, (1.5,))])
def test_light_that_channels_share_is_described_with_nothing_beside_it(prepared, power, rms_uk, told):
    """Monopole and dipole, which were subtracted, are no coordinates: with them the fit was noise, or left a second.

    Three channels hardly tell -2 from -3.
    """
    maps, rng = list(simulate.maps(data_of(prepared.run), 27)), np.random.default_rng(12)
    seen, steps = np.abs(SKY[2]) > 0.3, prepared.analysis.model.survey.maps[0].preparation.steps
    pattern = steps[1].apply(np.where(seen, real.field(rng.normal(size=25), *SKY), np.nan))
    for number, channel in enumerate(prepared.run.channels):
        there = rms_uk / np.nanstd(pattern) * (channel.frequency_ghz / 94.0) ** power * pattern
        maps[number] = np.where(seen, maps[number] + there, maps[number])
    scene = simulated_scores.scene_for(prepared.analysis.job(prepared.run))
    search = simulated_scores.search_of(prepared.analysis, scene, scored)
    found, _ = unlisted.structures_of(ObservedMaps(prepared, maps, ask), scene, search, scored)
    (only,) = found
    assert (only.stage, only.frame, only.kind, only.channel) == ("added", "sky", "degrees 0-4", None)
    assert only.index in told
