"""Each step of a preparation against healpy, brute force or Monte Carlo; and the check of the sky power."""

from dataclasses import replace
from types import SimpleNamespace

import healpy
import numpy as np
import pytest
from astropy.io import fits

import mcsim
from mcsim import config
from mcsim.config import preparation as declared
from mcsim.diagnosis.api import _warnings
from mcsim.ensemble import detectability, plan
from mcsim.ensemble.prepare import prepare_files
from mcsim.instrument import scan
from mcsim.simulation import power, sampled, simulate, windows
from mcsim.simulation.preparation import preparation
from mcsim.simulation.steps import Average, Filled, Regression, Rotated, Weighted
from mcsim.simulation.survey import survey
from mcsim.sphere import healpix, map_files, rotation
from mcsim.sphere.sky import gaussian_alm
from refusals import refused, unnamed

FINE, COARSE = 32, 8
NPIX = 12 * FINE**2
X, Y, Z = healpy.pix2vec(FINE, np.arange(NPIX))
BAND = np.where(np.abs(Z) > 0.3, 1.0, 0.0)
SOFT = np.clip(np.abs(Z) / 0.3, 0.0, 1.0)


@pytest.fixture
def rng():
    return np.random.default_rng(1)


def run_with(*steps, **changes):
    base = {
        "name": "prepared",
        "sky": {"spectrum": "wmap7", "lmax": 60},
        "map": {"nside": FINE},
        "biposh": {"lmax": 16},
        "ensemble": {"realizations": 2, "seed": 5},
        "channel": [
            {
                "name": "V",
                "frequency_ghz": 61.0,
                "beam": {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 260.0, "fwhm_minor_arcmin": 220.0},
                "noise": {"sigma0_uk": 50.0},
                "scan": {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 30.0, "line_of_sight": "A"},
            }
        ],
        "preparation": list(steps),
    }
    return config.load(base | changes)


def prepare(run, map_uk):
    return preparation(run, run.channels[0], None, observed=True).apply(map_uk)


def test_averages_are_those_of_healpy(rng):
    map_uk = rng.standard_normal(NPIX)
    map_uk[rng.random(NPIX) < 0.3] = healpy.UNSEEN
    map_uk[healpy.query_disc(FINE, [0, 0, 1], 0.5)] = healpy.UNSEEN
    found = prepare(run_with({"kind": "degrade", "nside": COARSE}), map_uk)
    assert found == pytest.approx(healpy.ud_grade(map_uk, COARSE), rel=1e-12)
    assert np.any(found == healpy.UNSEEN)


def test_coarse_pixels_have_the_hits_of_the_fine_ones_that_are_observed(rng):
    hits = np.where(rng.random(NPIX) < 0.6, 10.0, 0.0)
    steps = preparation(run := run_with({"kind": "degrade", "nside": COARSE}), run.channels[0], None)
    found = steps.moments(scan.Moments(FINE, "ecliptic", hits, np.zeros((1, NPIX), dtype=complex))).hits
    variance = steps.noise_uk(50.0 * (hits > 0.0), hits) ** 2  # of a mean of n pixels 50^2 / n
    assert found * variance == pytest.approx(np.full(found.size, 10.0 * 50.0**2))


def test_two_averages_are_one(rng):
    map_uk = rng.standard_normal(NPIX)
    twice = prepare(run_with({"kind": "degrade", "nside": 16}, {"kind": "degrade", "nside": COARSE}), map_uk)
    assert twice == pytest.approx(prepare(run_with({"kind": "degrade", "nside": COARSE}), map_uk), rel=1e-12)


@pytest.mark.parametrize("method", ["average", "harmonics"])
def test_windows_of_degrading_are_those_of_gaussian_skies(method, rng):
    """Degrees l <= 20 of 40 skies: each estimate of W_l^2 has a relative scatter of sqrt(2 / (40 (2l + 1)))."""
    run = run_with({"kind": "degrade", "nside": COARSE, "method": method})
    lmax, skies = 3 * COARSE - 4, 40
    window = survey(run).channels[0].maps[0].preparation.pixel_window(lmax)
    ratio, chance = [], 0.0
    for _ in range(skies):
        alm = gaussian_alm(np.ones(lmax + 1), rng)
        sky = healpix.synthesis(alm[None], FINE, lmax)[0]
        back = healpix.analysis(prepare(run, sky), lmax, iterations=3)
        ratio.append(healpy.alm2cl(back) / healpy.alm2cl(alm))
    found = np.sqrt(np.mean(ratio, axis=0))[2:]
    # Only the mixing of degrees scatters; it is below the window's own difference from 1 times a tenth.
    assert found == pytest.approx(window[2:], abs=0.01 + 0.05 * (1.0 - window.min()) + chance)


def test_window_of_the_mean_is_a_ratio_of_pixel_windows():
    lmax = 24
    ratio = healpix.pixel_window(COARSE, lmax) / healpix.pixel_window(FINE, lmax)
    assert windows.of_average(FINE, COARSE, lmax) == pytest.approx(ratio, abs=2e-3)
    assert windows.of_pixels(COARSE, lmax) == pytest.approx(healpix.pixel_window(COARSE, lmax), abs=1e-3)


def test_window_of_the_mean_is_the_variance_of_the_means():
    """Sum over m of |mean of Y_lm over the centres inside a pixel|^2, averaged over pixels: by brute force."""
    for ell in (5, 30):
        total = np.zeros(12 * COARSE**2)
        for m in range(ell + 1):
            alm = np.zeros(healpy.Alm.getsize(ell), complex)
            for value in (1.0, 1j) if m else (1.0,):
                alm[healpy.Alm.getidx(ell, ell, m)] = value / (np.sqrt(2.0) if m else 1.0)
                total += Average(FINE, COARSE).apply(healpix.synthesis(alm[None], FINE, ell)[0]) ** 2
        expected = np.sqrt(total.mean() * 4 * np.pi / (2 * ell + 1))
        assert windows.of_average(FINE, COARSE, ell)[ell] == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("weights", [BAND, SOFT])
def test_dipole_is_that_of_healpy(weights, rng):
    map_uk = rng.standard_normal(NPIX) + 30.0 + 5.0 * X - 8.0 * Z
    run = run_with({"kind": "subtract_dipole", "mask": weights})
    left = prepare(run, map_uk)
    if weights is BAND:
        monopole, dipole = healpy.fit_dipole(np.where(weights > 0, map_uk, healpy.UNSEEN))
        assert left == pytest.approx(map_uk - monopole - dipole @ np.stack([X, Y, Z]), abs=1e-9)
    assert prepare(run, left) == pytest.approx(left, abs=1e-9)
    assert weights @ left == pytest.approx(0.0, abs=1e-8)


def test_templates_are_projected_out_or_subtracted(rng):
    templates = rng.standard_normal((2, NPIX))
    noise = rng.standard_normal(NPIX)
    step = {"kind": "templates", "templates": list(templates), "mask": BAND, "monopole": True}
    cleaned = prepare(run_with(step), noise + 3.0 * templates[0] - 2.0 * templates[1] + 100.0)
    assert cleaned == pytest.approx(prepare(run_with(step), noise), abs=1e-8)
    assert templates @ (BAND * cleaned) == pytest.approx(0.0, abs=1e-7)
    given = {"kind": "templates", "templates": list(templates), "coefficients": [3.0, -2.0]}
    assert prepare(run_with(given), noise) == pytest.approx(noise - 3.0 * templates[0] + 2.0 * templates[1])
    run = run_with(given)
    assert preparation(run, run.channels[0], None).apply(noise) == pytest.approx(noise)
    run = run_with(given | {"simulated": True})
    assert preparation(run, run.channels[0], None).apply(noise) == pytest.approx(prepare(run, noise))


def test_filled_pixels_are_the_means_of_their_neighbours(rng):
    map_uk = healpy.smoothing(rng.standard_normal(NPIX), fwhm=0.2)
    hole = BAND == 0.0
    found = Filled(hole, None).apply(map_uk)
    near = healpy.get_all_neighbours(FINE, np.flatnonzero(hole))
    means = np.ma.masked_array(found[near], near < 0).mean(axis=0)
    assert found[hole] == pytest.approx(np.asarray(means), abs=1e-8 * map_uk.std())
    assert np.array_equal(found[~hole], map_uk[~hole])
    assert Filled(hole, None).apply(found) == pytest.approx(found, abs=1e-8)
    assert np.all(Filled(hole, 7.0).apply(map_uk)[hole] == 7.0)


def test_unobserved_pixels_are_filled_too():
    map_uk = np.where(BAND > 0, X, healpy.UNSEEN)
    assert prepare(run_with({"kind": "fill"}), map_uk).min() > -1.01


def test_masks_multiply(rng):
    map_uk = rng.standard_normal(NPIX)
    assert np.array_equal(prepare(run_with({"kind": "mask", "mask": SOFT}), map_uk), SOFT * map_uk)
    twice = [{"kind": "mask", "mask": BAND}] * 2
    assert np.array_equal(prepare(run_with(*twice), map_uk), BAND * map_uk)


def test_rotation_moves_maps_and_orientations(rng):
    """A beam at psi points at the same place of the sky whichever frame psi is measured in."""
    lmax = 20
    alm = gaussian_alm(np.ones(lmax + 1), rng)
    turned = rotation.rotate_alm(alm, lmax, "ecliptic", "galactic")
    before, after = (healpix.synthesis(one[None], FINE, lmax)[0] for one in (alm, turned))
    step = Rotated("ecliptic", "galactic", FINE)
    assert step.apply(before) == pytest.approx(after, abs=1e-4 * after.std())
    moments = mcsim.Moments.from_model("wmap", FINE, 2, "ecliptic", (0.0, 1e-3))
    wanted = mcsim.Moments.from_model("wmap", FINE, 2, "galactic", (0.0, 1e-3))
    found = step.orientations(moments.w)
    both = (np.abs(found[0]) > 0.5) & (np.abs(wanted.w[0]) > 0.5)
    assert both.sum() > 500
    assert np.median(np.abs(found[:, both] - wanted.w[:, both])) < 0.1


CASES = {
    "average": [{"kind": "degrade", "nside": COARSE}],
    "apodised": [{"kind": "mask", "mask": SOFT}, {"kind": "degrade", "nside": COARSE}],
    "masked": [{"kind": "mask", "mask": BAND}, {"kind": "degrade", "nside": COARSE}],
    "smoothed": [{"kind": "smooth", "fwhm_arcmin": 500.0}, {"kind": "degrade", "nside": COARSE}],
    "averaged before smoothing": [{"kind": "degrade", "nside": 16}, {"kind": "smooth", "fwhm_arcmin": 300.0}],
    "harmonics": [{"kind": "degrade", "nside": COARSE, "method": "harmonics"}],
    "rotated": [{"kind": "rotate", "frame": "galactic"}],
    "filled": [{"kind": "fill", "method": "constant", "mask": BAND}, {"kind": "degrade", "nside": COARSE}],
}


@pytest.mark.parametrize("name", CASES)
def test_noise_of_prepared_pixels_is_that_of_monte_carlo(name, rng):
    """Variances of 60 maps over expectation, averaged over pixels: within 4 sqrt(2 / (60 n)), n >= 80 in effect."""
    shared = survey(run_with(*CASES[name]))
    source, made = shared.source.channels[0].maps[0], shared.channels[0].maps[0]
    draws = np.stack([source.preparation.apply(source.noise_uk * rng.standard_normal(NPIX)) for _ in range(60)])
    seen = made.noise_uk > 0.05 * made.noise_uk.max()
    assert np.mean(draws[:, seen] ** 2 / made.noise_uk[seen] ** 2) == pytest.approx(1.0, abs=0.06)


def test_spectra_of_prepared_maps_are_those_of_the_survey_that_describes_them():
    """C_l over B_l^2 C_l + N_l of 30 skies, averaged over 2 < l <= 16: its scatter is sqrt(2 / (30 * 285)) = 1.5 %."""
    for steps in CASES["average"], CASES["smoothed"]:
        run = run_with(*steps)
        shared = survey(run)
        channel = shared.channels[0]
        cl = np.mean([simulate.realize(shared, r)["cl"][0] for r in range(30)], axis=0)
        ell = np.arange(3, 17)
        beam = (channel.response.factors[0].real / channel.window)[ell]
        expected = shared.cl[ell] * beam**2
        assert np.average(cl[ell] / expected, weights=2 * ell + 1) == pytest.approx(1.0, abs=0.06)


def test_both_routes_and_the_user_prepare_by_the_same_code():
    steps = [{"kind": "degrade", "nside": COARSE}, {"kind": "subtract_dipole"}]
    quiet = {"noise": config.Noise()}
    plain, run = (
        replace(r, channels=tuple(replace(c, **quiet) for c in r.channels)) for r in (run_with(), run_with(*steps))
    )
    made, prepared = simulate.maps(survey(plain), 0), simulate.maps(survey(run), 0)
    assert np.array_equal(mcsim.prepare(list(made), run)[0], prepared[0])
    assert np.array_equal(mcsim.prepare({"V": made[0]}, run)["V"], prepared[0])
    [(_, streamed)] = sampled.maps(survey(run), 0)
    assert np.std(streamed - prepared[0]) < 0.02 * np.std(prepared[0])


def test_splits_and_differencing_are_prepared():
    step = {"kind": "degrade", "nside": 4}
    scan = {"kind": "differencing", "model": "wmap_focal_plane", "pair": "W1", "sample_period_s": 157.8}
    channel = {"name": "W1", "beam": {"kind": "gaussian", "fwhm_arcmin": 300.0}, "scan": scan}
    changes = {
        "map": {"nside": 8, "splits": ["a", "b"]},
        "sky": {"spectrum": "wmap7", "lmax": 20},
        "biposh": {"lmax": 8},
    }
    result = simulate.realize(survey(run_with(step, channel=[channel], **changes)), 0)
    assert result["cl"].shape == (3, 9)
    assert np.all(np.isfinite(result["cl"]))


def test_control_differs_by_the_noncircular_part_alone():
    paired = simulate.realize(survey(run_with(*CASES["average"])), 0)
    assert paired["cl_circular"][0, 2:] == pytest.approx(paired["cl"][0, 2:], rel=0.02)
    assert not np.array_equal(paired["cl_circular"], paired["cl"])


def test_weights_of_apodised_steps_count_once():
    weights = healpy.ud_grade(SOFT, COARSE)
    by_step = survey(run_with({"kind": "degrade", "nside": COARSE}, {"kind": "mask", "mask": weights}))
    by_map = survey(run_with({"kind": "degrade", "nside": COARSE}, map={"nside": FINE, "mask": weights}))
    assert by_step.pair_norm == pytest.approx(by_map.pair_norm)
    assert detectability.sky_fraction(by_step, (0, 0)) == pytest.approx(detectability.sky_fraction(by_map, (0, 0)))
    assert simulate.realize(by_step, 0)["cl"] == pytest.approx(simulate.realize(by_map, 0)["cl"], rel=1e-9)


def test_wmap_maps_need_more_sky_than_their_lmax(tmp_path):
    """The known case: V and W of WMAP-7 at nside 32 called perfect skies different with lmax 95, and not with 300."""
    channels = [
        {
            "name": name,
            "beam": {"kind": "gaussian", "fwhm_arcmin": fwhm},
            "noise": {"sigma0_uk": sigma0},
            "scan": {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 61.0, "line_of_sight": "A"},
        }
        for name, fwhm, sigma0 in (("V", 21.0, 25.0), ("W", 13.2, 38.0))
    ]
    latitude = np.abs(healpy.pix2vec(32, np.arange(12 * 32**2))[2])
    changes = {
        "map": {"nside": 32, "mask": (latitude > 0.38).astype(float)},
        "biposh": {"lmax": 64},
        "channel": channels,
    }
    low, enough = (survey(run_with(sky={"spectrum": "wmap7", "lmax": lmax}, **changes)) for lmax in (95, 300))
    found = power.neglected(low)
    assert 300 < found.needed < 450
    assert found.shift > 20.0
    assert power.neglected(enough) is None
    short = np.array([0.0, 0.0, *(1e3 / np.arange(2, 150) ** 2)])
    found = power.neglected(survey(run_with(sky={"spectrum": short, "lmax": 140}, **changes)))
    assert found.last == 149
    assert "ends at 149" in str(found)


def test_too_little_sky_is_refused_where_a_preparation_is_declared(tmp_path):
    low = run_with({"kind": "degrade", "nside": COARSE}, sky={"spectrum": "wmap7", "lmax": 20})
    needed = power.neglected(survey(low)).needed
    for call in (
        lambda: mcsim.run(low, tmp_path / "low.zarr", quiet=True),
        lambda: mcsim.predict(low),
        lambda: mcsim.diagnose(low, [np.zeros(12 * COARSE**2)], tmp_path / "new" / "verdict"),
    ):
        with refused("sky.lmax", 20, needed):
            call()
    assert list(tmp_path.iterdir()) == []
    power.check(survey(replace(low, preparation=())))
    enough = survey(replace(low, sky=replace(low.sky, lmax=needed)))
    power.check(enough)
    assert power.neglected(enough) is None


def test_samples_at_the_centres_of_fine_pixels_are_predicted_in_coarse_ones():
    """Without the blur of the fine pixels, which the analysis divides out; the means over them blur all the same."""
    channel = {"name": "W", "beam": {"kind": "gaussian", "fwhm_arcmin": 400.0}, "scan": {"kind": "parallel_transport"}}
    changes = {
        "map": {"nside": FINE, "pixel_window": "computed"},
        **{"channel": [channel], "effect": [{"name": "pixelization", "channel": "W", "amplitude": 1.0}]},
        "biposh": {"lmax": 20},
    }
    sky = {"spectrum": "wmap7", "lmax": 60, "dipole_uk": 3000.0}
    shared, ell = survey(run_with({"kind": "degrade", "nside": COARSE}, sky=sky, **changes)), np.arange(21)
    beam, fine = shared.channels[0].beam.window, healpix.pixel_window(FINE, shared.config.sky.lmax)
    expected = shared.cl[ell] * (beam / fine)[ell] ** 2
    assert mcsim.predict(shared).cl_mean.values[0] == pytest.approx(expected, rel=1e-9)  # no warning of a dipole


def every_command(run, folder):
    """What a user may do with a run, the maps of which are at nside 32."""
    return (
        lambda: mcsim.run(run, folder / "some.zarr", quiet=True),
        lambda: plan.describe(run),
        lambda: mcsim.predict(run),
        lambda: mcsim.write_maps(run, folder / "maps"),
        lambda: mcsim.diagnose(run, [X], folder / "verdict"),
    )


@pytest.mark.parametrize(
    ("steps", "named"),
    [
        ([{"kind": "smooth", "fwhm_arcmin": 600.0}], ("smooth", "fill")),
        ([{"kind": "subtract_dipole"}, {"kind": "rotate", "frame": "galactic"}], ("rotate", "fill")),
        ([{"kind": "subtract_dipole", "mask": np.where(Z > 0.99, 1.0, 0.0)}], ("0 pixels", "4 templates")),
    ],
)
def test_steps_that_the_scan_does_not_allow_are_refused_before_anything_is_written(steps, named, tmp_path):
    moments = mcsim.Moments.from_model("wmap", FINE, 2, "ecliptic", (0.0, 0.4))
    hits = np.where(Z < 0.95, moments.hits, 0.0)
    seen = hits > 0
    moments = replace(moments, hits=hits, w=np.where(seen, moments.w, 0.0), dtheta=None, dphi=None, offset_moments=None)
    run = run_with(*steps)
    run = run_with(*steps, channel=[config.to_dict(run)["channel"][0] | {"scan": {"kind": "moments", "path": moments}}])
    holes = () if "0 pixels" in named else (int(np.sum(~seen)),)
    for call in every_command(run, tmp_path):
        with refused(*named, *holes):
            call()
    assert list(tmp_path.iterdir()) == []


def test_steps_that_follow_a_filling_are_accepted():
    """Of the parts of the sky alone that data will have, without the steps themselves."""
    steps = [{"kind": "fill"}, {"kind": "smooth", "fwhm_arcmin": 600.0}, {"kind": "degrade", "nside": COARSE}]
    run = run_with(*steps, {"kind": "mask", "mask": np.ones(12 * COARSE**2)})
    preparation(run, run.channels[0], None).check(BAND)


def test_a_sky_that_is_accepted_and_still_too_small_is_told():
    run = run_with({"kind": "degrade", "nside": COARSE})
    for lmax in range(20, 60):
        shared = survey(replace(run, sky=replace(run.sky, lmax=lmax)))
        if (found := power.neglected(shared)).shift <= power.TOLERANCE:
            break
    power.check(shared)
    assert found.shift > power.ENOUGH
    assert unnamed(str(found), lmax, "V", found.needed) == []
    assert str(power.TOLERANCE) not in str(found)
    assert _warnings(SimpleNamespace(model=SimpleNamespace(survey=shared)))[0].startswith(str(found))


@pytest.mark.parametrize(
    ("step", "named"),
    [
        ({"kind": "degrade", "nside": FINE}, ("preparation[0].nside", FINE, "map.nside")),
        ({"kind": "degrade", "nside": 4}, ("biposh.lmax", 16, 11, 4)),
        ({"kind": "rotate", "frame": "ecliptic"}, ("preparation[0].frame", "ecliptic")),
        ({"kind": "smooth"}, ("preparation[0]", "fwhm_arcmin", "window")),
        ({"kind": "smooth", "fwhm_arcmin": 600.0, "channels": ["Q"]}, ("preparation[0].channels", "'Q'", "V")),
        (
            {"kind": "templates", "templates": [Z], "coefficients": [1.0, 2.0]},
            ("coefficients", "2 numbers", "1 templates"),
        ),
        ({"kind": "subtract_dipole", "monopole": False, "dipole": False}, ("monopole", "dipole")),
        ({"kind": "mask"}, ("preparation[0].mask",)),
        ({"kind": "subtract_dipole", "mask_frame": "galactic"}, ("mask_frame",)),
        ({"kind": "fill", "value_uk": 3.0}, ("value_uk", "diffuse")),
        ({"kind": "sharpen"}, ("degrade", "rotate")),
    ],
)
def test_declared_steps_that_cannot_be_are_refused(step, named):
    with refused(*named):
        run_with(step)


@pytest.mark.parametrize(
    ("steps", "map_uk", "named"),
    [
        ([{"kind": "smooth", "fwhm_arcmin": 30.0}], X, ("V", 10)),
        (
            [{"kind": "smooth", "fwhm_arcmin": 600.0}],
            np.where(BAND > 0, X, healpy.UNSEEN),
            ("smooth", np.sum(BAND == 0), "fill"),
        ),
        ([{"kind": "templates", "templates": [Z, 2.0 * Z]}], X, ("templates", "mask")),
        ([{"kind": "templates", "templates": [np.ones(12)]}], X, ("nside 1",)),
        ([{"kind": "fill"}], np.full(NPIX, healpy.UNSEEN), ("mask",)),
        ([{"kind": "subtract_dipole"}], np.full(NPIX, healpy.UNSEEN), ("0 pixels", "4 templates")),
        ([{"kind": "subtract_dipole"}], np.zeros(48), ("nside 2", 32)),
        ([{"kind": "degrade", "nside": 8}], np.where(Z > 0.99, np.inf, X), ("V", np.sum(Z > 0.99), "UNSEEN")),
        ([{"kind": "degrade", "nside": 8}], np.where(Z > 0.99, -np.inf, X), ("V", np.sum(Z > 0.99), "UNSEEN")),
        ([{"kind": "degrade", "nside": 8}], np.where(Z > 0.9, 0.0, X), ("V", np.sum(Z > 0.9) + 0, "UNSEEN")),
        ([{"kind": "mask", "mask": np.zeros(NPIX)}], X, ("mask", "preparation[0]")),
        ([], X, ("prepared", "[[preparation]]")),
    ],
)
def test_maps_and_steps_that_do_not_fit_are_refused(steps, map_uk, named):
    with refused(*named):
        mcsim.prepare([map_uk], run_with(*steps))


@pytest.mark.parametrize(
    "steps",
    [
        [{"kind": "mask", "mask": BAND}],
        [{"kind": "fill", "mask": BAND}, {"kind": "degrade", "nside": 8}],
        [{"kind": "subtract_dipole", "mask": BAND}, {"kind": "mask", "mask": BAND}],
    ],
)
def test_zeros_that_steps_hide_are_no_data(steps):
    """Maps that were multiplied by the mask that the first steps have."""
    run, map_uk = run_with(*steps), np.where(BAND > 0.0, 100.0 + 30.0 * X, 0.0)
    there = np.where(BAND > 0.0, map_uk, 55.0)
    np.testing.assert_allclose(mcsim.prepare([map_uk], run)[0], mcsim.prepare([there], run)[0], atol=1e-9)


def test_files_are_prepared(tmp_path, rng):
    run = run_with({"kind": "degrade", "nside": COARSE})
    map_uk = rng.standard_normal(NPIX)
    healpy.write_map(tmp_path / "raw.fits", 1e-3 * map_uk, column_units="mK", coord="E", dtype=np.float64)
    [path] = prepare_files(run, [f"V={tmp_path / 'raw.fits'}"], tmp_path / "run=3")
    found, frame, unit = map_files.read_map(path)
    assert found == pytest.approx(prepare(run, map_uk), rel=1e-9)
    assert (path.name, frame, unit) == ("V.fits", "ecliptic", "uK")
    with refused(tmp_path / "run=3"):
        prepare_files(run, [f"V={tmp_path / 'raw.fits'}"], tmp_path / "run=3")
    with refused(tmp_path / "raw.fits", "V.fits"):
        prepare_files(run, [str(tmp_path / "raw.fits")], tmp_path / "other")
    with refused("V", "twice"):
        prepare_files(run, [f"V={tmp_path / 'raw.fits'}"] * 2, tmp_path / "other")
    with refused("Q", "prepared"):
        prepare_files(run, [f"Q={tmp_path / 'raw.fits'}"], tmp_path / "other")
    for value in (np.inf, -np.inf):
        infinite = np.where(np.arange(NPIX) < 5, value, map_uk)
        healpy.write_map(path, infinite, coord="E", overwrite=True, dtype=np.float64)
        with refused(path, "5 pixels", "UNSEEN"):
            prepare_files(run, [str(path)], tmp_path / "other")
    healpy.write_map(path, map_uk, coord="G", overwrite=True, dtype=np.float64)
    with refused(path, "map.frame", "galactic", "ecliptic"):
        prepare_files(run, [str(path)], tmp_path / "other")


def test_prepared_files_say_of_samples_what_their_sources_say(tmp_path, rng):
    """Without POINTING maps of pixel means were tested as maps of samples, with another chi^2."""
    run = run_with({"kind": "degrade", "nside": COARSE}, map={"nside": FINE, "splits": ["a", "b"]})
    files = {"V:a": tmp_path / "first.fits", "V_b": tmp_path / "second.fits"}
    for path, cards in zip(files.values(), ([("POINTING", "pixel means")], []), strict=True):
        map_uk = 50.0 * rng.standard_normal(NPIX)
        healpy.write_map(path, map_uk, column_units="uK", coord="E", dtype=np.float64, extra_header=cards)
    made = prepare_files(run, [f"{name}={path}" for name, path in files.items()], tmp_path / "out")
    assert [path.name for path in made] == ["V_a.fits", "V_b.fits"]
    assert [fits.getheader(path, 1).get("POINTING") for path in made] == ["pixel means", None]


def test_identity_of_a_run_has_its_preparation():
    plain, prepared = run_with(), run_with({"kind": "degrade", "nside": COARSE})
    assert "preparation" not in config.science(plain)
    assert config.digest(plain) != config.digest(prepared)
    assert config.from_json(config.to_json(prepared)) == prepared
    assert declared.frame_of(config.to_dict(run_with({"kind": "rotate", "frame": "galactic"}))) == "galactic"


def test_weights_and_regression_follow_their_steps():
    assert Weighted(BAND).local(np.ones(NPIX))[BAND == 0.0] == pytest.approx(np.nan, nan_ok=True)
    assert Regression(np.ones((1, NPIX)), np.ones(NPIX)).beam_window(3).tolist() == [1.0] * 4


def test_maps_and_run_in_the_wrong_order_are_refused():
    maps = {"V": np.zeros(12 * FINE**2)}
    for given in (run_with({"kind": "subtract_dipole"}), "quickstart", {"channel": [], "map": {}}):
        with refused("mcsim.prepare(maps, run)"):
            mcsim.prepare(given, maps)
