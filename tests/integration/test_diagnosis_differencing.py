"""Differencing scans in a diagnosis: maps solved at once, templates, moments of both sides, an effect that is named."""

from dataclasses import replace

import healpy
import numpy as np
import pytest

import mcsim
from mcsim import config
from mcsim.datavector.analysis import analysis_of
from mcsim.errors import RunError
from mcsim.instrument.scan.pointing import pointing
from mcsim.simulation import differencing, mapmaking, power, simulate
from mcsim.simulation.survey import survey
from mcsim.systematics.mapmaking import MapmakingConvergence
from refusals import refused

NSIDE, LMAX, SIGMA0 = 8, 16, 40.0
LONG = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 700.0, "fwhm_minor_arcmin": 600.0, "angle_deg": 20.0}


def run_of(effects=(), beam=LONG, sigma0=SIGMA0, **channel):
    scan = {"kind": "differencing", "model": "wmap_focal_plane", "pair": "W1", "sample_period_s": 631.2}
    return config.load(
        {
            "schema": 1,
            "name": "differences",
            "sky": {"spectrum": "wmap7", "lmax": LMAX, "dipole_uk": 3364.5},
            "map": {"nside": NSIDE, "splits": ["half1", "half2"]},
            "channel": [{"name": "W1", "beam": beam, "noise": {"sigma0_uk": sigma0}, "scan": scan} | channel],
            "biposh": {"L_max": 2},
            "effect": [{"channel": "W1", **one} for one in effects],
            "ensemble": {"keep_maps": True, "seed": 5},
        }
    )


def effect(name, amplitude, **parameters):
    return {"name": name, "amplitude": amplitude, **parameters}


def weights(m):
    """Return P, dense, of x = 0, from the pointing of the model and healpy's pixels."""
    pairs = m.pairs
    first, last = pairs.grid.sample_range(pairs.model, pairs.side_a)
    matrix = np.zeros((last - first, pairs.npix))
    for line, weight in ((pairs.side_a, 1.0), (pairs.side_b, -1.0)):
        theta, phi, _ = pointing(pairs.model, line, first, last - first, pairs.grid.frame)
        matrix[np.arange(last - first), healpy.ang2pix(NSIDE, theta, phi)] = weight
    return matrix


@pytest.mark.parametrize("effects", [[], [effect("mapmaking_convergence", 30.0), effect("beam_width", 0.05)]])
def test_maps_solved_at_once_are_those_of_a_run(effects):
    shared = survey(run_of(effects))
    kept, at_once = simulate.realize(shared, 1)["observed_map"], simulate.maps(shared, 1)
    # Both routes solve to 1e-8 of the right-hand side.
    np.testing.assert_allclose(at_once, kept, atol=1e-6 * kept.std())


def test_stopping_early_starts_from_zeros():
    """After one iteration the map is the right-hand side over the weights, up to a factor and the mean."""
    shared = survey(run_of([effect("mapmaking_convergence", 1000.0)], sigma0=0.0))
    sky = simulate.draw_sky(shared, 0)
    (m, *_), (found, *_) = shared.channels[0].maps, simulate.maps(shared, 0, sky=sky)
    p = weights(m)
    whole = simulate.maps(survey(run_of(sigma0=0.0)), 0, sky=sky)[0]
    first = p.T @ (p @ whole) / np.diag(p.T @ p)
    correlation = np.corrcoef(found, first)[0, 1]
    assert correlation > 1.0 - 1e-6


def test_imbalance_leaves_what_dense_map_making_leaves_of_the_dipole():
    shared = survey(run_of())
    (channel,), x = shared.channels, 3e-3
    for m, found in zip(channel.maps, differencing.of_dipole(channel, x), strict=True):
        p = weights(m)
        towards = np.stack(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2)))
        # The dipole through beam and pixel window, by hand.
        dipole = channel.response.factors[0, 1].real * (channel.site.dipole_uk @ towards)
        extra = x * (np.abs(p) @ dipole)  # (1 + x) T_A - (1 - x) T_B less T_A - T_B
        expected = np.linalg.lstsq(p.T @ p, p.T @ extra, rcond=1e-10)[0]
        # A run's true imbalance is x, and its map-making takes none: weights stay those of x = 0.
        np.testing.assert_allclose(found, expected - expected.mean(), atol=1e-5 * expected.std())


@pytest.mark.parametrize("kind", ["differencing", "hit_averaged"])
def test_samples_nearer_to_the_centres_of_pixels_leave_nothing_of_the_dipole(kind):
    """It is taken off where the samples are: some uK were left where its pixel window was that of others."""
    scan = {"kind": kind, "model": "wmap_focal_plane", "sample_period_s": 631.2}
    run = run_of([effect("pixelization", -1.0)], scan=scan | ({"pair": "W1"} if kind == "differencing" else {}))
    without = replace(run, sky=replace(run.sky, dipole_uk=0.0))
    found, expected = (simulate.maps(survey(one), 0) for one in (run, without))
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("steps", [(), ({"kind": "degrade", "nside": 4},)], ids=["made", "prepared"])
def test_sky_that_is_left_out_counts_against_the_noise_of_differences(steps):
    """As where a diagnosis has asked for the noise of the pixels."""
    run = config.load(config.to_dict(run_of(sigma0=4000.0)) | {"preparation": list(steps), "biposh": {"lmax": 8}})
    by_noise = survey(run, orders=2)
    assert all(m.noise_uk is not None for m in by_noise.maps)
    found, expected = (list(power._shifts(one, "wmap7")) for one in (survey(run), by_noise))
    for (_, _, shift), (_, _, other) in zip(found, expected, strict=True):
        np.testing.assert_allclose(shift, other)
        assert shift[LMAX] < power.ENOUGH
    power.check(survey(run))


def test_a_template_is_the_finite_difference_of_the_chain():
    """The imbalance of skies without CMB is that of the dipole; the matched filter's template is that per step."""
    step = 1e-3
    sky = np.zeros_like(simulate.draw_sky(survey(run_of()), 0))
    up, down = (
        simulate.maps(survey(run_of([effect("transmission_imbalance", s * step)])), 2, sky=sky) for s in (1, -1)
    )
    template = np.stack(differencing.of_dipole(survey(run_of()).channels[0], step))
    np.testing.assert_allclose((up - down) / 2.0, template, atol=1e-4 * template.std())


def test_moments_are_those_of_both_sides():
    shared = survey(run_of(), orders=2)
    assert np.all(np.isnan(survey(run_of()).channels[0].maps[0].moments.w))
    m = shared.channels[0].maps[0]
    pairs, total = m.pairs, np.zeros((2, 12 * NSIDE**2), complex)
    first, last = pairs.grid.sample_range(pairs.model, pairs.side_a)
    for line in (pairs.side_a, pairs.side_b):
        theta, phi, psi = pointing(pairs.model, line, first, last - first, pairs.grid.frame)
        pixel = healpy.ang2pix(NSIDE, theta, phi)
        for s in (1, 2):
            np.add.at(total[s - 1], pixel, np.exp(-1j * s * psi))
    np.testing.assert_allclose(m.moments.w[:2], total / m.moments.hits, atol=1e-9)
    assert m.moments.dtheta is None
    np.testing.assert_allclose(m.noise_uk, SIGMA0 / np.sqrt(m.moments.hits))


def test_noise_effects_act_on_differences():
    """A right-hand side of noise alone has the variance of each sample's two pixels."""
    pairs = survey(run_of()).channels[0].maps[0].pairs
    nothing = [(np.zeros((pairs.npix, 1)), np.zeros((pairs.npix, 1)))]
    height = healpy.pix2vec(NSIDE, np.arange(pairs.npix))[2]
    factor = 1.0 + 2.0 * (height > 0.0)

    def rhs(seed, own):
        noise = mapmaking.DifferenceNoise(1.0, np.random.default_rng(seed), own)
        return mapmaking.rhs_from_maps(pairs, nothing, noise=noise)[0]

    draws = np.stack([rhs(seed, factor) for seed in range(240)])
    p = np.abs(weights(survey(run_of()).channels[0].maps[0]))
    expected = p.T @ (p @ factor / 2.0)
    # A variance of 240 draws of a Gaussian is known to sqrt(2/240); the mean of 768 correlated ones to far better.
    ratio = draws.var(axis=0) / expected
    assert abs(ratio.mean() - 1.0) < 5.0 * np.sqrt(2.0 / 240.0 / 300.0)
    assert np.all(np.abs(ratio - 1.0) < 6.0 * np.sqrt(2.0 / 240.0))
    np.testing.assert_array_equal(rhs(3, np.ones(pairs.npix)), rhs(3, None))
    louder = survey(run_of([effect("noise_level", 0.1)])).channels[0].side_b
    np.testing.assert_allclose(louder.noise_factor, 1.21)


def test_steps_are_fitted_as_what_grows_with_them():
    how = MapmakingConvergence.parametrization
    found = how.coordinates(MapmakingConvergence(amplitude=12.3))
    np.testing.assert_allclose(found, how.factor**12 - 1.0)
    assert how.nearest(found, np.eye(1))["amplitude"] == pytest.approx(12.0)
    assert how.nearest(np.array([-5.0]), np.eye(1))["amplitude"] < 0.0


def test_candidates_are_those_that_differences_can_have():
    never = {"gain_drift", "excess_noise", "time_constant", "sidelobe_pickup", "orientation_averaging"}
    only = {"transmission_imbalance", "mapmaking_convergence"}
    library = {name: mcsim.effects()[name] for name in never | only | {"beam_ellipticity", "noise_level"}}
    found = analysis_of(run_of(), library=library)
    assert {one.name for one in found.candidates} == only | {"beam_ellipticity", "noise_level"}
    # One matched filter for each half, so that one half can be tested with what the other says.
    own = [one for one in found.elements if one.candidate in only]
    assert [one.fold for one in own] == [0, 1, 0, 1]
    assert [one.split for one in own] == ["half1", "half2"] * 2
    one_beam = {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 631.2}
    others = analysis_of(run_of(scan=one_beam), library={name: library[name] for name in only}).candidates
    assert not {one.name for one in others} & only


def test_an_imbalance_is_named():
    """A tiny model learned from the chain names what a run of the chain has, with its amplitude."""
    wanted = ("beam_ellipticity", "transmission_imbalance")
    settings = mcsim.DiagnosisSettings(
        library={name: kind for name, kind in mcsim.effects().items() if name in wanted},
        simulations=130,
        noisy_skies=6,
        scan_sims=40,
        beam_orders=2,
        constrained_skies=3,
    )
    true = 0.02
    model = run_of(beam={"kind": "gaussian", "fwhm_arcmin": 650.0})
    model = replace(model, channels=tuple(replace(c, scan=replace(c.scan, tolerance=1e-5)) for c in model.channels))
    acting = config.Effect(name="transmission_imbalance", channel="W1", parameters={"amplitude": true})
    maps = list(simulate.realize(survey(replace(model, effects=(acting,))), 0)["observed_map"])
    found = mcsim.diagnose(model, maps, settings=settings, workers=0)
    assert found.kind == "effect"
    ((named,),) = [one.effects for one in found.sets]
    assert (named.name, named.channel) == ("transmission_imbalance", "W1")
    assert abs(named.amplitude - true) < 4.0 * named.sigma < true
    clean = list(simulate.realize(survey(model), 0)["observed_map"])
    assert mcsim.diagnose(model, clean, settings=settings, workers=0).kind == "none"


def test_maps_that_do_not_converge_end_in_a_sentence():
    run = run_of()
    few = replace(run, channels=tuple(replace(c, scan=replace(c.scan, max_iterations=2)) for c in run.channels))
    with refused("max_iterations", by=RunError):
        simulate.maps(survey(few), 0)


def test_effects_that_differences_do_not_have_are_refused():
    with refused("orientation_averaging", "W1", "differences", "hit_averaged"):
        survey(run_of([effect("orientation_averaging", 1.0)]))


def test_the_physical_limit_refuses_differences():
    with refused("W1", "differences", "hit_averaged"):
        mcsim.limit(run_of())
