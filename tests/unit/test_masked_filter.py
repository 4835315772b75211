"""Maps that lack a part of the sky are filtered by their inverse covariance, and all maps where one asks for it."""

from dataclasses import replace

import healpy
import numpy as np
import pytest

from instruments import two_channels
from mcsim import config
from mcsim.config.noise import NoiseCorrelated
from mcsim.config.preparation import Mask, Templates
from mcsim.datavector.analysis import analysis_of, data_vectors
from mcsim.datavector.bipolar_scan import BipolarScan
from mcsim.datavector.filter_model import model_of
from mcsim.datavector.parts import LEFT
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.shared_sky import shared_sky
from mcsim.datavector.summaries import blocks_of
from mcsim.datavector.wiener_filter import wiener_filter
from mcsim.diagnosis.consistency import FOLDS
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, rotation
from mcsim.sphere.sky import gaussian_alm

NSIDE, LMAX = 16, 32
CUT = 0.3  #: sine of the latitude up to which the equator is hidden
HEIGHT = healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("mask") / "mask.fits"
    healpy.write_map(path, (np.abs(HEIGHT) > CUT).astype(float), dtype=np.float64)
    table = two_channels("masked", lmax=LMAX, nside=NSIDE, fwhm_arcmin=500.0, sigma0_uk=200.0, period_s=311.0)
    table["map"] |= {"mask": str(path), "mask_frame": "ecliptic"}
    return config.load(table)


def modelled(run, **settings):
    return model_of(survey(run, orders=2), DiagnosisSettings(beam_orders=2, **settings))


def isotropic(model):
    """Return the model with the filter of the full sky."""
    settings = replace(model.settings, hidden_share=1.0, uneven_noise=np.inf)
    return replace(model, inverse=None, pooled=0.0, settings=settings)


def unbalanced(model, maps):
    """Return S^1/2 (sum_i P_i^t r_i) - S^-1/2 s^, relative to the second: zero for the inverse covariance."""
    filtered = wiener_filter(model, maps)
    each = zip(filtered.adjoint, model.parts, strict=True)
    left = sum(alm_.multiply(a, model.response[p.channel], LMAX) for a, p in each)
    white = alm_.multiply(filtered.sky, np.sqrt(model.inverse_cl), LMAX)
    return np.linalg.norm(alm_.multiply(left, np.sqrt(model.cl), LMAX) - white) / np.linalg.norm(white)


def test_the_residuals_of_masked_maps_are_those_of_the_inverse_covariance(run):
    """C^-1 d = N^-1 (d - P s^) with s^ = S P^t C^-1 d up to the tolerance, 1; samples off the centres add 0.45."""
    model, maps = modelled(run), list(simulate.maps(survey(run), 3))
    assert model.inverse is not None
    assert unbalanced(model, maps) < 1.3
    assert unbalanced(modelled(run, filter_tolerance=0.01), maps) < 0.6
    assert unbalanced(isotropic(model), maps) > 4.0


def test_the_sky_of_masked_maps_is_that_of_the_exact_filter(run):
    """Most of what is left at the tolerance of simulations is behind the mask."""
    model, maps = modelled(run), np.array(list(simulate.maps(survey(run), 4)))
    exact = model.inverse.wiener(maps)
    for found, tolerance in ((wiener_filter(model, list(maps)).sky, 0.3), (shared_sky(model, list(maps)), 0.01)):
        assert np.linalg.norm(found - exact) < tolerance * np.linalg.norm(exact)
    other = shared_sky(isotropic(model), list(maps))
    assert np.linalg.norm(other - exact) > 0.4 * np.linalg.norm(exact)


SOFT = {"kind": "mask", "mask": "soft.fits", "mask_frame": "ecliptic"}
WHOLE = SOFT | {"mask": "whole.fits"}
DIPOLE = {"kind": "subtract_dipole", "mask": "whole.fits", "mask_frame": "ecliptic"}
ROTATE = {"kind": "rotate", "frame": "galactic"}


@pytest.mark.parametrize(
    "steps",
    [[{"kind": "smooth", "fwhm_arcmin": 700.0}], [ROTATE], [WHOLE, ROTATE], [SOFT], [DIPOLE, SOFT, ROTATE]],
    ids=["smoothed", "rotated", "masked, then rotated", "behind a soft mask", "without a dipole, and so"],
)
def test_masked_maps_that_were_filtered_tell_the_sky(run, tmp_path, monkeypatch, steps):
    """An isotropic filter takes zeros for data: outside the mask what it finds differs from the sky by far more."""
    monkeypatch.chdir(tmp_path)
    for name, edge in (("soft", 0.2), ("whole", 1e-6)):
        mask = np.clip((np.abs(HEIGHT) - CUT) / edge, 0.0, 1.0)
        healpy.write_map(f"{name}.fits", mask, dtype=np.float64)
    table = two_channels("filtered", lmax=LMAX, nside=NSIDE, fwhm_arcmin=500.0, sigma0_uk=60.0, period_s=101.0)
    table["map"] |= {"frame": "ecliptic", "mask": run.map.mask, "mask_frame": "ecliptic"}
    model = modelled(config.load(table | {"preparation": steps}))
    assert model.inverse is None
    sky = simulate.draw_sky(model.survey, 6)
    maps = list(simulate.maps(model.survey, 6, sky=sky))
    true = rotation.rotate_alm(sky, LMAX, "ecliptic", model.frame)
    seen = np.min([part.precision for part in model.parts], axis=0) > 0.0

    def error(sky):
        return np.std(healpix.synthesis((sky - true)[None], NSIDE, LMAX)[0][seen])

    other = isotropic(model)
    assert error(shared_sky(model, maps)) < 0.85 * error(shared_sky(other, maps))
    assert error(wiener_filter(model, maps).sky) < 0.85 * error(wiener_filter(other, maps).sky)


def excesses(model, pattern, *filters):
    """Return the variance over its response of the score of a pattern that is added in one channel of two."""
    skies, found = [list(simulate.maps(model.survey, k)) for k in range(100)], []
    for one in filters:
        scores = [wiener_filter(one, maps).residual[:2].sum(axis=0) @ pattern for maps in skies]
        changed = [m + pattern if i < 2 else m for i, m in enumerate(skies[0])]
        response = wiener_filter(one, changed).residual[:2].sum(axis=0) @ pattern - scores[0]
        found.append(np.var(scores, ddof=1) / response)
    return found


def test_the_score_of_a_signal_has_the_variance_of_its_response(run):
    """The score t'C^-1 d of a signal t has the variance t'C^-1 t, which is its response, and no filter has less."""
    model = modelled(run, filter_tolerance=0.01)
    exact, other = excesses(model, HEIGHT, model, isotropic(model))
    assert abs(exact - 1.0) < 4.0 * np.sqrt(2.0 / 99)
    assert other > 1.2 * exact


def test_masked_maps_without_their_dipole_are_filtered_as_if_it_were_not_known(run):
    """The scores of a signal have the variance of its response; of the fit's weights they do not depend."""
    table = config.to_dict(run) | {"preparation": [{"kind": "subtract_dipole", "mask": run.map.mask}]}
    model = modelled(config.load(table), filter_tolerance=0.01)
    pattern = np.where(np.abs(HEIGHT) > CUT, 5.0 * HEIGHT**3 - 3.0 * HEIGHT, 0.0)
    exact, other = excesses(model, pattern, model, isotropic(model))
    assert abs(exact - 1.0) < 4.0 * np.sqrt(2.0 / 99)
    assert other > 1.2 * exact
    maps = list(simulate.maps(model.survey, 0))
    for residual, part in zip(wiener_filter(model, maps).residual, model.parts, strict=True):
        # Of the dipole there is a trace of what its noise alone would have.
        assert 0.0 < abs(residual @ HEIGHT) < 1e-3 * np.sqrt(HEIGHT**2 @ part.precision)
    moved = [map_ + 40.0 * HEIGHT + 7.0 for map_ in maps]
    np.testing.assert_allclose(shared_sky(model, moved), shared_sky(model, maps), rtol=0, atol=1e-6)


@pytest.mark.parametrize("hidden", [False, True])
def test_the_exact_filter_knows_the_noise_and_the_offsets_of_samples(run, hidden):
    """On a sky far above uneven noise the isotropic filter leaves a score twice the variance of its response."""
    noisy = [replace(one, noise=replace(one.noise, sigma0_uk=30.0)) for one in run.channels]
    seen = run.map if hidden else replace(run.map, mask=None, mask_frame=None)
    model = modelled(replace(run, channels=tuple(noisy), map=seen))
    exact, other = excesses(model, 3.0 * HEIGHT**2 - 1.0, model.exact, isotropic(model))
    assert abs(exact - 1.0) < 4.0 * np.sqrt(2.0 / 99)
    assert other > 1.5 * exact


def test_the_exact_filter_is_of_white_noise_alone(run):
    model = modelled(run)
    assert model.exact_known
    assert model.exact.inverse.maps[0].moments is not None
    stripes = NoiseCorrelated(sigma0_uk=200.0, f_knee_hz=1e-3, f_min_hz=1e-5)
    unknown = modelled(replace(run, channels=(replace(run.channels[0], noise=stripes), *run.channels[1:])))
    assert not unknown.exact_known
    assert unknown.exact is unknown


def uneven(sigma0_uk=100.0, lmax=LMAX, fwhm_arcmin=500.0, **more):
    """Return a run of the full sky whose poles are seen a thousand times as often."""
    hits = 3.0 + 3000.0 * np.exp((np.abs(HEIGHT) - 1.0) / 0.03)
    table = two_channels("uneven", lmax=lmax, nside=NSIDE, fwhm_arcmin=fwhm_arcmin) | more
    for channel in table["channel"]:
        channel |= {"scan": {"kind": "parallel_transport"}, "noise": {"sigma0_uk": sigma0_uk, "hits": hits}}
    del table["map"]["splits"]
    return config.load(table)


def test_very_uneven_noise_is_known_to_the_filter_of_the_full_sky():
    """A map was filtered as if its worst pixels were everywhere.

    A calibration of 1 % was then a residual dipole, 3 standard errors too large.
    """
    run = uneven()
    model = modelled(run)
    sky = gaussian_alm(survey(run).cl, np.random.default_rng(5))
    maps = list(simulate.maps(survey(run), 0, sky=sky))
    assert model.inverse is not None
    own, other = (shared_sky(one, maps) - sky for one in (model, modelled(run, uneven_noise=np.inf)))
    cap = np.abs(HEIGHT) > 0.95
    left, before = (np.std(healpix.synthesis(one[None], NSIDE, LMAX)[0][cap]) for one in (own, other))
    assert left < 0.5 * before


BEYOND = {"sigma0_uk": 20.0, "lmax": 47, "fwhm_arcmin": 200.0, "biposh": {"L_max": 2, "lmax": 24}}
SMOOTHED = {"preparation": [{"kind": "smooth", "fwhm_arcmin": 300.0}]}


@pytest.mark.parametrize(
    ("table", "share"),
    [(BEYOND, 0.95), (BEYOND | SMOOTHED, 0.95), ({"sigma0_uk": 1.0, "fwhm_arcmin": 300.0}, 0.995)],
    ids=["beyond lmax", "smoothed", "to lmax"],
)
def test_a_full_sky_far_above_very_uneven_noise_is_found_by_the_isotropic_filter(table, share):
    """The inverse covariance takes it for noise: skies that maps constrain lacked up to 26 % at the last degrees."""
    run = uneven(**table)
    model, whole = modelled(run), survey(run)
    sky = gaussian_alm(whole.cl, np.random.default_rng(6))
    maps = list(simulate.maps(whole, 0, sky=sky))
    found = shared_sky(model, maps)
    own = alm_.resize(sky, run.sky.lmax, model.lmax)
    last = slice(2 * model.lmax // 3, None)
    cross = (alm_.power(own + found, model.lmax) - alm_.power(own - found, model.lmax))[last].sum() / 4.0
    assert cross > share * alm_.power(own, model.lmax)[last].sum()


def test_soft_edges_of_a_mask_are_no_uneven_noise(tmp_path):
    """What a mask multiplies noise with, it multiplies the sky with."""
    run = uneven()
    even = tuple(replace(one, noise=replace(one.noise, hits=None)) for one in run.channels)
    weight = np.where(np.abs(HEIGHT) > 0.9, 0.1, 1.0)
    np.save(tmp_path / "soft.npy", weight)
    for channels, expected in ((even, False), (run.channels, True)):
        soft = replace(run, channels=channels, preparation=(Mask(mask=str(tmp_path / "soft.npy")),))
        model = modelled(soft)
        precision = model.parts[0].precision
        assert np.mean(1.0 / precision) * np.mean(precision) > model.settings.uneven_noise
        assert (model.unmasked is not None) == expected


def test_maps_that_keep_the_isotropic_filter(run):
    """Where the sky is far above the noise at the last degree it is found with more noise, by another model."""
    assert modelled(replace(run, map=replace(run.map, mask=None, mask_frame=None))).inverse is None  # the full sky
    assert modelled(run, hidden_share=0.5).inverse is None  # less than that is hidden
    whole = modelled(replace(run, map=replace(run.map, mask=None, mask_frame=None)), hidden_share=0.0)
    assert whole.inverse is not None
    quiet = tuple(replace(one, noise=replace(one.noise, sigma0_uk=1.0)) for one in run.channels)
    bright = modelled(replace(run, channels=quiet))
    assert bright.inverse is None
    assert bright.unmasked is not None
    assert modelled(run, hidden_share=0.5).unmasked is None


def elements_of(model):
    return [element for block in blocks_of(model) for element in block.elements]


def vector_of(model, maps):
    filtered = wiener_filter(model, maps)
    return np.concatenate([np.atleast_1d(block.values(filtered)) for block in blocks_of(model)])


@pytest.fixture(scope="module")
def bright(run):
    """Maps degraded to pixels that show the sky far beyond the last degree of the filter, without dipole."""
    steps = [{"kind": "degrade", "nside": 8}, {"kind": "subtract_dipole", "mask": run.map.mask}]
    table = two_channels("bright", lmax=96, nside=32, fwhm_arcmin=80.0, sigma0_uk=60.0, period_s=61.0)
    table["channel"][1]["beam"]["fwhm_arcmin"] = 40.0
    table["map"] |= {"mask": run.map.mask, "mask_frame": "ecliptic"}
    table["biposh"]["lmax"] = 16
    for step in steps[1:]:
        step["mask_frame"] = "ecliptic"
    return modelled(config.load(table | {"preparation": steps}))


@pytest.mark.parametrize("degree", [2, 4])
def test_the_score_of_a_signal_in_bright_prepared_maps_has_the_variance_of_its_response(bright, degree):
    """What all maps have alike beyond the filter's last degree is noise of their mean, and none of a difference."""
    assert bright.exact_known
    assert bright.exact is bright
    height = healpy.pix2vec(8, np.arange(12 * 8**2))[2]
    legendre = np.polynomial.legendre.Legendre.basis(degree)(height)
    prepared = bright.survey.maps[0].preparation
    pattern = prepared.steps[1].apply(legendre)
    pattern = np.where(bright.parts[0].precision > 0.0, pattern, 0.0)
    exact, other = excesses(bright, pattern, bright, isotropic(bright))
    assert abs(exact - 1.0) < 4.0 * np.sqrt(2.0 / 99)
    assert other > 4.0 * exact


def test_the_score_of_a_signal_in_prepared_maps_is_that_of_what_the_preparation_leaves(bright):
    signal = np.where(bright.parts[0].precision > 0.0, 1.0 + 2.0 * healpy.pix2vec(8, np.arange(12 * 8**2))[0] ** 3, 0.0)
    left = bright.survey.maps[0].preparation.steps[1].apply(signal)
    maps = list(simulate.maps(bright.survey, 2))
    unaware = replace(bright.exact, parts=tuple(replace(part, subtracted=()) for part in bright.exact.parts))
    both = zip(wiener_filter(bright.exact, maps).residual, wiener_filter(unaware, maps).residual, strict=True)
    for residual, before in both:
        assert residual @ signal == pytest.approx(before @ (left + LEFT * (signal - left)), rel=1e-9)


def test_the_power_of_the_sky_beyond_the_filter_is_measured(bright):
    """Four fifths of its amplitude have 16/25 of the power."""
    elements, made = elements_of(bright), bright.survey
    fine = [place for place, one in enumerate(elements) if one.kind == "fine"]
    assert len(fine) == 2 * (len(bright.settings.latitude_edges) - 1)
    assert {elements[place].ell for place in fine} == {(bright.lmax + 1, made.config.sky.lmax)}
    # All splits have it in common: the report may not name one of them.
    assert {one.kind for one in elements if one.fold is not None and one.split is None} <= FOLDS.keys()
    weaker = np.where(np.arange(made.cl.size) > bright.lmax, 0.8, 1.0)
    power = np.zeros(2)
    for number in range(4):
        sky = gaussian_alm(made.cl, np.random.default_rng(number))
        for which, seen in enumerate((sky, alm_.multiply(sky, weaker, made.config.sky.lmax))):
            maps = list(simulate.maps(made.without_noise, number, sky=seen))
            power[which] += vector_of(bright, maps)[fine].sum()
    assert power[1] / power[0] == pytest.approx(0.64, abs=0.05)


def test_simulated_maps_are_filtered_as_observed_ones(bright):
    """Settings of a model that had a tolerance of its own gave it to the jobs, which made it ten times as small."""
    analysis = analysis_of(bright.survey.config, settings=bright.settings)
    (simulated,) = data_vectors(replace(analysis.job(analysis.run), count=1, bipolar_scan=True))
    maps = list(simulate.maps(analysis.model.survey, 0))
    np.testing.assert_allclose(simulated, analysis.data_vector(maps, bipolar_scan=True), rtol=1e-9, atol=0.0)


def test_the_only_channel_is_compared_with_the_sky_by_its_differences_alone(run):
    """The sum of its residuals is the sky itself; what differs is how far conjugate gradients went."""
    alone = modelled(replace(run, channels=run.channels[:1]))
    assert alone.inverse is not None
    compared = {(one.channels, one.split) for one in BipolarScan(alone).elements if one.kind == "biposh"}
    assert compared == {(alone.channels, None), (alone.channels, "difference")}
    elements = [one for one in BipolarScan(alone).elements if one.kind == "biposh" and one.split is None]
    assert {one.name.split("/")[1] for one in elements} == {"sky"}


def test_what_is_subtracted_may_depend_on_pixels_that_a_mask_hides(bright):
    """Their residuals, over noise that they have not, ended in a division by zero."""
    run = bright.survey.config
    whole = replace(run, preparation=(run.preparation[0], replace(run.preparation[1], mask=None, mask_frame=None)))
    model = modelled(whole)
    maps = list(simulate.maps(model.survey, 0))
    filtered = wiener_filter(model, maps)
    hidden = model.parts[0].precision == 0.0
    assert np.any(filtered.residual[0][hidden] != 0.0)
    assert np.all(filtered.difference[:, hidden] == 0.0)
    assert np.all(filtered.squares[:, hidden] == 0.0)


def test_what_is_fitted_behind_a_soft_mask_leaves_the_noise_of_pixels(run, tmp_path, monkeypatch):
    """Where the mask is nearly zero, what is left of a template was up to 130 times the noise."""
    monkeypatch.chdir(tmp_path)
    soft = (np.abs(HEIGHT) > CUT).astype(float)
    soft[100:105] = 10.0 ** -np.arange(2.0, 7.0)
    healpy.write_map("soft.fits", soft, dtype=np.float64)
    healpy.write_map("template.fits", 1.0 + HEIGHT**2, dtype=np.float64)
    steps = (
        Mask(mask="soft.fits", mask_frame="ecliptic"),
        Templates(templates=("template.fits",)),
    )
    prepared = replace(run, map=replace(run.map, mask=None, mask_frame=None), preparation=steps)
    model = modelled(prepared)
    filtered = wiener_filter(model, list(simulate.maps(model.survey, 5)))
    assert np.abs(filtered.difference).max() < 30.0  # of some 4,000 squares of unit normals, less one
    assert np.mean(filtered.difference[filtered.difference != 0.0]) == pytest.approx(0.0, abs=0.1)


def test_noise_with_memory_has_no_exact_scores_in_bright_maps(bright):
    stripes = NoiseCorrelated(sigma0_uk=60.0, f_knee_hz=1e-3, f_min_hz=1e-5)
    run = bright.survey.config
    unknown = modelled(replace(run, channels=(replace(run.channels[0], noise=stripes), *run.channels[1:])))
    assert not unknown.exact_known
    assert unknown.exact is unknown
