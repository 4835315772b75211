"""A modulation behind a mask: perfect skies do not look like it, though each responds as its own products fluctuate."""

from dataclasses import replace

import healpy
import numpy as np
import pytest

from instruments import ask, data_of, learned, two_channels
from mcsim import config, systematics
from mcsim.datavector.analysis import analysis_of
from mcsim.datavector.same_skies import SameSkies, makes_means
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.simulation import simulate

SKIES = 8


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """Return a table behind a cut of 70 % of the sky, 5 uK of noise a hit."""
    mask = np.abs(np.cos(healpy.pix2ang(16, np.arange(healpy.nside2npix(16)))[0])) >= 0.7
    path = tmp_path_factory.mktemp("mask") / "cut.fits"
    healpy.write_map(path, mask.astype(float), dtype=np.float32)
    found = two_channels("cut", lmax=24, sigma0_uk=5.0)
    found["map"]["mask"] = str(path)
    return found


def test_behind_a_mask_no_sky_looks_like_its_own_modulation(table):
    """With products of two maps as they respond in each sky the mean of -log p is 6.7 for a quadrupole."""
    known = learned(table, "dipole_modulation", "quadrupole_modulation", proposed=())
    model = known.analysis.model
    always = replace(known.analysis, model=replace(model, settings=replace(model.settings, alpha=1.0)))
    known = replace(known, analysis=always)
    data, found = data_of(known.run), []
    for realization in range(SKIES):
        maps = ObservedMaps(known, list(simulate.maps(data, realization)), ask)
        t, chi2 = maps.templates(), known.null.chi2(maps.x)
        for one in known.candidates:
            fit = known.null.fit(maps.x, t[:, list(one.columns)])
            found.append(-np.log(float(known.null.nested_test(fit.delta_chi2, chi2, len(one.columns)))))
    assert len(known.candidates) == 2
    # -log p of a uniform p has mean and variance 1.
    assert np.all(np.abs(np.mean(np.reshape(found, (SKIES, 2)), axis=0) - 1.0) < 3.0 / np.sqrt(SKIES))


def test_what_makes_a_dipole_of_other_degrees_is_a_pattern(table):
    analysis = analysis_of(config.load(table))
    skies = SameSkies(analysis, lambda _: [], ())
    patterns = {one.name for one in analysis.candidates if skies.is_pattern(one.table(one.basis[0]))}
    assert patterns == {"dipole_modulation", "quadrupole_modulation"}
    site = analysis.model.survey.channels[0].site
    basis = {name: systematics.basis_of(systematics.get(name))[0] for name in ("boost", "spectrum", "dipole_residual")}
    assert {name: makes_means(one, site) for name, one in basis.items()} == {
        "boost": True,
        "spectrum": False,
        "dipole_residual": False,
    }


@pytest.mark.parametrize(("name", "amplitude"), [("dipole_modulation", 0.05), ("quadrupole_modulation", 0.02)])
def test_what_a_modulation_makes_of_the_dipole_is_in_its_template(name, amplitude):
    """The dipole that it makes of the sky's quadrupole looks like a calibration by that of our motion."""
    known = learned(two_channels("whole", lmax=24, sigma0_uk=5.0), name, "calibration")
    effect = config.Effect(name=name, parameters={"amplitude": amplitude})
    data = (data_of(known.run), data_of(known.run, name, amplitude=amplitude))
    plain, changed = (list(simulate.maps(one, 0)) for one in data)
    before, after = (known.analysis.data_vector(one) for one in (plain, changed))
    maps = ObservedMaps(known, changed, ask)
    (own,) = [one for one in known.candidates if one.name == name]
    coordinates = own.parametrization.coordinates(systematics.get(name)(amplitude=amplitude))
    response = maps.templates()[:, list(own.columns)] @ coordinates
    true, found = known.null.whiten_templates(np.stack([after - before, response], axis=1)).T
    assert np.linalg.norm(true) > 15.0
    assert true @ found > 0.95 * np.linalg.norm(true) * np.linalg.norm(found)
    # In skies that are found without the modulation it does what it did.
    there, here = maps.pair([effect])
    again = known.null.whiten_templates(np.mean(here - there, axis=0)[:, None])[:, 0]
    assert np.linalg.norm(again - true) < 0.1 * np.linalg.norm(true)
