"""The grammar of unlisted effects: its scores against maps that the simulator makes, its words, its plug-ins."""

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from types import SimpleNamespace

import healpy
import numpy as np
import pytest

from instruments import two_channels
from mcsim import config, reconstruction, systematics
from mcsim.datavector.filter_model import model_of
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.wiener_filter import wiener_filter
from mcsim.diagnosis import api
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import MapGrid
from mcsim.instrument.scan.pointing import pointing
from mcsim.reconstruction import forms, simulated_scores, sky_changes, words
from mcsim.reconstruction.figure import structure_figure
from mcsim.reconstruction.grammar import structures
from mcsim.reconstruction.plugin import Plugin, plugin
from mcsim.reconstruction.result import Reconstructed
from mcsim.reconstruction.scores import SUN
from mcsim.reconstruction.search import Search
from mcsim.reconstruction.structure import ALIKE
from mcsim.simulation import simulate, tod
from mcsim.simulation.survey import survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, real
from mcsim.systematics import spacecraft
from refusals import refused

LMAX, NSIDE = 24, 16
MODEL = two_channels("unlisted", lmax=LMAX, nside=NSIDE, fwhm_arcmin=300.0, period_s=311.0)


@lru_cache(maxsize=1)
def seen():
    """Run, scene, filtered sky, residuals and scores of one realization."""
    run = config.load(MODEL)
    model = model_of(survey(run, orders=4), DiagnosisSettings())
    maps = list(simulate.maps(model.survey, 7))
    scene = simulated_scores.with_chosen(
        model, simulated_scores.scene_of(model), ["period 5640.0", "source 40.0 -25.0"]
    )
    return run, scene, wiener_filter(model, maps), simulated_scores.scores_of_maps(model, scene, maps)


@lru_cache(maxsize=1)
def grammar():
    return structures(seen()[1])


def random_alm(seed, lmax):
    draw = np.random.default_rng(seed).normal(size=(2, alm_.size(lmax)))
    alm = draw[0] + 1j * draw[1]
    alm[: lmax + 1] = alm[: lmax + 1].real
    return alm


# In the simulator patterns are added to the sky, or multiply it, before the beam, and behind it in the scores. The
# round part of the beam acts on the samples' offsets in their pixels as well.
TOLERANCE = {
    "order 0": 0.1,
    "order 0 as l^2": 0.1,
    "added": 0.05,
    "rotation": 0.05,
    "gain": 0.1,
    "square": 0.3,
    "cube": 0.3,
    "lag": 0.05,  # a difference of places as near as pixels
    "source 40.0 -25.0": 0.3,  # as small as pixels, in which the samples' offsets move it: 6 to 9 % rms in the maps
}


def test_files_of_effects_can_name_every_form():
    assert set(forms.FORMS) == set(reconstruction.__all__)


def added_by(structure, theta):
    """Return what the effect that a structure becomes adds to every map of the filtered sky in the simulator."""
    run, scene, filtered, _ = seen()
    effect = plugin("unlisted_1", structure, theta, scene)
    table = config.Effect(name="unlisted_1", channel="W1", parameters={"amplitude": 1.0})
    acting = survey(replace(run, effects=(table,)), library={"unlisted_1": effect.kind()})
    before = simulate.maps(survey(run), 0, sky=filtered.sky)
    return [a - b for a, b in zip(simulate.maps(acting, 0, sky=filtered.sky), before, strict=True)]


@pytest.mark.parametrize(
    ("stage", "frame", "kind", "split"),
    [
        ("added", "sky", "degrees 0-4", ALIKE),
        ("added", "sky", "degrees 0-4", "half2"),
        ("added", "sky", "dipole", "opposite"),
        ("added", "sky", "latitude galactic", ALIKE),
        ("added", "sky", "latitude ecliptic 0-2", "half1"),
        ("added", "sky", "quadrupole", ALIKE),
        ("added", "spacecraft", "orientation 1", ALIKE),
        ("added", "spacecraft", "orientation 2", "half1"),
        ("added", "time", "year 1", ALIKE),
        ("added", "time", "year 2", "half1"),
        ("added", "time", "year 1-4", ALIKE),
        ("added", "time", "trend", ALIKE),
        ("added", "time", "spin 1", "opposite"),
        ("added", "time", "from 91.31", ALIKE),
        ("added", "time", "decay 45.7", ALIKE),
        ("added", "sky", "latitude equatorial", ALIKE),
        ("added", "sky", "source 40.0 -25.0", ALIKE),
        ("gain", "time", "step 205.5", ALIKE),
        ("gain", "time", "until 205.5", ALIKE),
        ("gain", "time", "spin 3", "half2"),
        ("gain", "", "constant", ALIKE),
        ("gain", "", "constant", "half2"),
        ("gain", "sky", "degrees 0-2", ALIKE),
        ("gain", "sky", "degrees 0-2", "half2"),
        ("gain", "sky", "latitude galactic", "opposite"),
        ("gain", "time", "year 1", ALIKE),
        ("gain", "time", "spin 3", ALIKE),
        ("gain", "time", "trend", ALIKE),
        ("gain", "time", "spin 1-4", ALIKE),
        ("gain", "spacecraft", "orientation 2", ALIKE),
        ("gain", "Sun", "dipole", "half2"),
        ("gain", "Sun", "elongation", ALIKE),
        ("elsewhere", "spacecraft", "line V1", ALIKE),
        ("elsewhere", "spacecraft", "opposite", ALIKE),
        ("elsewhere", "spacecraft", "lag", ALIKE),
        ("added", "spacecraft", "Galaxy", "half1"),
        ("added", "spacecraft", "degrees 0-2", "half2"),
        ("added", "sky", "orientation 1 degree 1", ALIKE),
        ("added", "sky", "orientation 2 degrees 2-4", "opposite"),
        ("added", "time", "month", ALIKE),
        ("added", "time", "period 5640.0", "half2"),
        ("gain", "time", "period 5640.0", ALIKE),
        ("elsewhere", "spacecraft", "spin -1/4", ALIKE),
        ("beam", "scan", "order 0", ALIKE),
        ("beam", "scan", "order 1", ALIKE),
        ("beam", "scan", "order 2", ALIKE),
        ("beam", "scan", "order 1 as l^1", ALIKE),
        ("beam", "scan", "order 0 as l^2", ALIKE),
        ("beam", "scan", "order 4", ALIKE),
        ("square", "", "square", ALIKE),
        ("square", "", "square with a constant", ALIKE),
        ("cube", "", "cube", ALIKE),
        ("added", "time", "spin 1-4", ALIKE),
        ("added", "spacecraft", "line V1", ALIKE),
        ("added", "Sun", "dipole", "half1"),
        ("added", "Sun", "elongation", ALIKE),
        ("added", "Sun", "crossing 285 8", ALIKE),
        ("added", "spacecraft", "lobe", ALIKE),
        ("beam", "scan", "order 0 at low l", ALIKE),
        ("rotation", "sky", "rotation", ALIKE),
    ],
)
def test_a_score_is_the_product_of_residuals_and_what_the_effect_adds(stage, frame, kind, split):
    """The effect that a structure becomes, in the simulator, adds the map whose product with the residual it scores."""
    _, _, filtered, u = seen()
    structure = next(
        w for w in grammar() if (w.stage, w.frame, w.kind, w.split, w.channel) == (stage, frame, kind, split, "W1")
    )
    theta = np.random.default_rng(3).normal(size=structure.size) * 1e-3
    added = added_by(structure, theta)
    assert not np.any(added[:2])  # the other channel
    products = np.array([r @ one for r, one in zip(filtered.residual, added, strict=True)])
    scale = np.sqrt(sum(r @ r * (one @ one) for r, one in zip(filtered.residual, added, strict=True)) / NSIDE**2 / 12)
    assert abs(products.sum() - theta @ structure.of(u)) < TOLERANCE.get(kind, TOLERANCE.get(stage, 0.01)) * scale


def in_half_and_both(stage, acts_on, kind):
    """Return the same structure of W1 in the second half, and in both."""
    every = (w for split in ("half2", ALIKE) for w in grammar() if w.channel == "W1" and w.split == split)
    return [w for w in every if (w.stage, w.acts_on, w.kind) == (stage, acts_on, kind) and w.frame != SUN]


def test_a_gain_of_one_half_needs_no_pointing():
    """It acts on sky and dipole alike: on the sky alone only where there is no dipole."""
    scene, theta = replace(seen()[1], elsewhere=()), np.array([1e-3])
    alike, of_sky = (in_half_and_both("gain", on, "constant")[0] for on in ("sky and dipole", "sky"))
    made = plugin("unlisted_1", alike, theta, scene)
    assert made == plugin("unlisted_1", of_sky, theta, replace(scene, dipole_uk=np.zeros(3)))
    assert plugin("unlisted_1", of_sky, theta, scene) is None
    site = survey(seen()[0]).channels[1].site
    errors = [made.kind()(amplitude=2.0).steady_gain(replace(site, split=split)) for split in scene.splits]
    assert errors == pytest.approx([0.0, 2e-3 / np.sqrt(4.0 * np.pi)])
    with refused("half1", "half2", "none"):
        made.kind()(amplitude=2.0).steady_gain(replace(site, splits=()))


@pytest.mark.parametrize(
    ("stage", "acts_on"), [("rotation", "sky and dipole"), ("square", "sky"), ("cube", "sky and dipole")]
)
def test_in_one_half_a_structure_is_that_of_both_in_its_maps(stage, acts_on):
    """What no effect of the simulator can do to one half is simulated by that of both, in the maps of the half."""
    _, scene, filtered, u = seen()
    half, both = in_half_and_both(stage, acts_on, stage)
    theta = np.random.default_rng(5).normal(size=half.size) * 1e-3
    assert half.by_map
    assert plugin("unlisted_1", half, theta, scene) is None
    added, residual = added_by(both, theta)[3], filtered.residual[3]
    scale = np.sqrt(residual @ residual * (added @ added) / len(added))
    assert abs(residual @ added - theta @ half.of(u)) < TOLERANCE[stage] * scale


@pytest.mark.parametrize("acts_on", ["sky and dipole", "sky"])
def test_a_gain_with_a_pattern_in_one_half_is_that_of_both_there(acts_on):
    half, both = in_half_and_both("gain", acts_on, "degrees 0-1")
    theta = np.random.default_rng(6).normal(size=half.size) * 1e-3
    found, expected = added_by(half, theta), added_by(both, theta)
    assert not np.any(found[2])
    whole = added_by(in_half_and_both("gain", "sky and dipole", "degrees 0-1")[1], theta)[3]
    difference = found[3] - expected[3]  # pixels of the pattern, and offsets of samples in pixels
    assert np.std(difference) < 0.01 * np.std(whole)


def test_real_harmonics_are_those_of_a_lm():
    values = np.random.default_rng(1).normal(size=25)
    n = healpy.pix2vec(8, np.arange(768))
    map_ = healpix.synthesis(real.to_alm(values, 6)[None], 8, 6)[0]
    np.testing.assert_allclose(real.field(values, *n), map_, atol=1e-12)
    np.testing.assert_allclose(real.coefficients(real.to_alm(values, 6), 6, 4), values, atol=1e-14)
    pole = np.array([0.6, 0.0, 0.8])
    np.testing.assert_allclose(
        real.field(real.zonal(pole, 2)[1], *n), np.sqrt(0.75 / np.pi) * (pole @ np.stack(n)), atol=1e-12
    )


def test_a_rotation_moves_the_map():
    alm, angle, n = random_alm(2, 6), 1e-5, np.stack(healpy.pix2vec(8, np.arange(768)))
    values = real.coefficients(alm, 6, 6)
    for axis, change in enumerate(sky_changes.rotations(alm, 6)):
        back = n - angle * np.cross(np.eye(3)[axis], n.T).T
        moved = (real.field(values, *(back / np.linalg.norm(back, axis=0))) - real.field(values, *n)) / angle
        found = healpix.synthesis(change[None], 8, 6)[0]
        np.testing.assert_allclose(found, moved, atol=1e-3 * np.abs(moved).max())


@pytest.mark.parametrize("kind", ["order 0 year 1", "order 1 spin 1", "order 2 spin 2", "motion"])
def test_a_score_of_a_beam_that_moves_is_the_product_with_its_maps(kind):
    _, scene, filtered, u = seen()
    structure = next(w for w in grammar() if (w.kind, w.channel, w.split) == (kind, "W1", "half2"))
    theta = np.random.default_rng(4).normal(size=structure.size)
    added = scene.moved(structure.moving, structure.order, theta, filtered.sky)[3]
    np.testing.assert_allclose(filtered.residual[3] @ added, theta @ structure.of(u), rtol=1e-9)
    assert plugin("unlisted_1", structure, theta, scene) is None


@pytest.mark.parametrize(
    ("wave", "coordinates"), [("spin 1", [1.0, 0.0, 0.0, 0.0]), ("Sun", [1.0, 0.0]), ("Sun", [0.0, 1.0])]
)
def test_a_pointing_that_moves_moves_the_dipole(wave, coordinates):
    """A displacement adds the dipole's change to every sample.

    It is along the beam's x axis, cos(spin phase) of it, or along the Earth's velocity, or towards the Sun.
    """
    run, scene, filtered, _ = seen()
    site, span = survey(run).channels[1].site, run.map.span(1)
    model, line = site.pointing.model, site.pointing.line

    def change(chunk):
        outward, south, east = spacecraft.axes(chunk.theta, chunk.phi)
        if wave == "Sun":
            towards = spacecraft.heading(model, chunk.time_s, "ecliptic", 0.5 * np.pi * coordinates[1])
            return scene.dipole_uk @ (towards - outward * np.sum(towards * outward, axis=0))
        along = np.cos(chunk.psi) * south + np.sin(chunk.psi) * east
        return np.cos(spacecraft.spin_phase(site.pointing, chunk.time_s)) * (scene.dipole_uk @ along)

    stream = tod.with_signal(change)(tod.samples(model, line, MapGrid(NSIDE, "ecliptic", span)))
    expected, hits = tod.bin_samples(stream, NSIDE)
    (view,) = (view for view in scene.views if (view.channel, view.split) == (1, 1))
    unit = LMAX * np.array(coordinates) / view.response[1]
    found = scene.moved(wave, 1, unit, np.zeros_like(filtered.sky))[3]
    difference = (found - expected)[hits > 0]  # samples are not at the centres of pixels
    assert np.std(difference) < 0.05 * np.std(expected[hits > 0])


def test_a_signal_from_elsewhere_is_from_where_each_channel_has_it():
    """Half a spin away is another direction of its frame for a beam at another angle to the spin axis."""
    there = tuple(simulated_scores.directions(own, {}) for own in ((70.0, 0.0), (35.0, 40.0), (70.0, 180.0)))
    scene = SimpleNamespace(channels=("V1", "W1", "Q1"), elsewhere=there, frame="ecliptic", timed=True)
    every = next(w for w in grammar() if (w.stage, w.kind, w.channel) == ("elsewhere", "spin 1/2", None))
    beam = Beam.gaussian(300.0, 12)
    effect = plugin("unlisted_1", every, np.full(1, 0.1), scene)
    made = effect.kind()(amplitude=1.0)
    for channel in scene.channels:
        site = systematics.Site(channel, 94.0, "ecliptic", NSIDE, 12, beam)
        alone = plugin("unlisted_1", replace(every, channel=channel), np.full(1, 0.1), scene).kind()(amplitude=1.0)
        np.testing.assert_array_equal(made.beam(beam, site).blm, alone.beam(beam, site).blm)
    with refused("V1, W1, Q1", "K1"):
        made.beam(beam, systematics.Site("K1", 94.0, "ecliptic", NSIDE, 12, beam))
    alike = SimpleNamespace(**{**vars(scene), "channels": ("V1", "Q1"), "elsewhere": there[::2]})
    assert isinstance(plugin("unlisted_1", every, np.ones(1), alike).values["towards"], tuple)


def test_another_channel_sees_the_dipole_where_its_line_of_sight_points():
    """The dipole in the frame of one beam, seen along the line of another, is the dipole of that line's pointing."""
    run, scene, _, _ = seen()
    sites = [channel.site for channel in survey(run).channels]
    structure = next(w for w in grammar() if (w.stage, *w.says[3:6]) == ("added", "line V1", "W1", ALIKE))
    effect = plugin("unlisted_1", structure, np.ones(1), scene).kind()(amplitude=1.0)
    own, other = (pointing(site.pointing.model, site.pointing.line, 1000, 50) for site in sites[::-1])
    time_s = sites[1].pointing.model.period_of_samples(sites[1].pointing.line) * np.arange(1000, 1050)
    expected = sites[1].dipole_uk @ healpy.ang2vec(*other[:2]).T
    np.testing.assert_allclose(effect.signal(time_s, *own, sites[1]), expected, atol=1e-6)


def test_a_direction_along_the_beam_is_a_pattern_of_spin_1():
    """b . x with a fixed vector b is the gradient of b . n along x, thus E of degree 1: Q = b . e_theta."""
    site = survey(seen()[0]).channels[1].site
    b, draw = np.array([0.5, 0.3, 0.81]), np.random.default_rng(1).uniform(size=(3, 2000))
    theta, phi, psi = np.arccos(1.0 - 2.0 * draw[0]), 2.0 * np.pi * draw[1], 2.0 * np.pi * draw[2]
    _, south, east = spacecraft.axes(theta, phi)
    structure = next(w for w in grammar() if w.kind == "orientation 1 degree 1" and w.channel == "W1")
    expected = b @ (np.cos(psi) * south + np.sin(psi) * east)
    made = [
        plugin("unlisted_1", structure, theta_, seen()[1]).kind()(amplitude=1.0).signal(psi, theta, phi, psi, site)
        for theta_ in np.eye(6)
    ]
    fitted = np.linalg.lstsq(np.array(made).T, expected, rcond=None)[0]
    assert np.std(fitted @ made - expected) < 0.005 * np.std(expected)  # a pixel at a pole holds all directions
    np.testing.assert_allclose(fitted[3:], 0.0, atol=0.01 * np.abs(fitted).max())


def test_orientations_are_those_of_the_pointing():
    """A gain takes times alone: psi follows from the rotations of the scan."""
    site = survey(seen()[0]).channels[1].site
    time_s = site.pointing.model.period_of_samples(site.pointing.line) * np.arange(1000, 1050)
    for frame in ("ecliptic", "galactic"):
        expected = pointing(site.pointing.model, site.pointing.line, 1000, 50, frame)[2]
        found = spacecraft.orientation(site.pointing, time_s, frame)
        np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * expected), atol=1e-7)


def test_a_period_that_stands_out_is_searched(monkeypatch):
    """A wave in the samples of one channel adds its period to the words; maps of the model add none."""
    run, scene, _, _ = seen()
    model = model_of(survey(run, orders=4), DiagnosisSettings())
    simulations = np.random.default_rng(3).normal(size=(400, len(scene.keys)))
    asked = []

    def null_scores(analysis, ask, chosen):
        asked.append(chosen)
        return np.random.default_rng(5).normal(size=(400, len(chosen) * len(scene.views) * 8))

    monkeypatch.setattr(simulated_scores, "null_scores", null_scores)
    search = Search(grammar(), simulations, np.random.default_rng(4).normal(size=(400, 4)) - 3.0)
    analysis = SimpleNamespace(model=model)
    maps = list(simulate.maps(model.survey, 8))
    assert simulated_scores.with_peaks(analysis, scene, search, maps, None) == (scene, search)
    period = 7321.0
    waves = simulated_scores.with_chosen(model, scene, [f"period {period!r}"])
    for i in (2, 3):
        wave = waves.views[i].periods[f"period {period!r}"][0]
        maps[i] = maps[i] + 12.0 * wave / np.sqrt(np.sum(model.parts[i].precision * wave**2))
    more, wider = simulated_scores.with_peaks(analysis, scene, search, maps, None)
    found = asked[-1][0]  # the most evident; a gain may be told by side bands of the same wave
    assert abs(1.0 / float(found.removeprefix("period ")) - 1.0 / period) < 0.25 / scene.time_lines[1].duration_s
    assert found in more.views[2].periods
    words_ = [w for w in wider.grammar if w.kind == found]
    assert {w.channel for w in words_} == {"V1", "W1", None}
    assert all(w.tried == scene.time_lines[0].tried for w in words_)


@pytest.mark.parametrize("on_sky", [True, False])
def test_gains_of_sky_and_of_dipole_are_together_that_of_both(on_sky):
    run, _, filtered, _ = seen()
    values = {"wave": "spin", "harmonic": 3, "coefficients": (1e-3, 2e-3)}
    made = [
        Plugin("both", "GainOverTime", "W1", values),
        *(Plugin(f"one_{k}", "GainOfOne", "W1", {**values, "on_sky": k}) for k in (on_sky, not on_sky)),
    ]
    changes = []
    for each in (made[:1], made[1:], []):
        tables = tuple(config.Effect(name=one.name, channel="W1", parameters={"amplitude": 1.0}) for one in each)
        acting = survey(replace(run, effects=tables), library={one.name: one.kind() for one in each})
        changes.append(np.array(list(simulate.maps(acting, 0, sky=filtered.sky))))
    np.testing.assert_allclose(changes[0], changes[1], atol=1e-6 * np.abs(changes[0] - changes[2]).max())


def test_a_boost_is_that_of_the_library_for_small_velocities():
    alm, beta = random_alm(3, 6), 1e-5
    sky = systematics.get("boost")(amplitude=beta, lon_deg=30.0, lat_deg=40.0)
    site = systematics.Site("W1", 94.0, "ecliptic", NSIDE, 6, Beam.gaussian(300.0, 6))
    change = (sky.sky(alm, site, None) - alm) / beta
    linear = sum(v * one for v, one in zip(sky.vector / beta, sky_changes.boosts(alm, 6), strict=True))
    np.testing.assert_allclose(linear, change, atol=1e-3)


def test_a_power_is_that_of_the_map():
    alm = random_alm(4, 8)
    map_ = healpix.synthesis(alm[None], 32, 8)[0]
    for power in (2, 3):
        expected = healpix.analysis(map_**power, 8, 5)
        np.testing.assert_allclose(sky_changes.raised(alm, 8, power), expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("name", "parameters", "order", "expected"),
    [
        ("pointing_offset", {"angle_deg": 0.0}, 1, "along the scan"),
        ("pointing_offset", {"angle_deg": 90.0}, 1, "across the scan (+90°)"),
        ("pointing_offset", {"angle_deg": -90.0}, 1, "across the scan (−90°)"),
        ("beam_ellipticity", {"angle_deg": 0.0}, 2, "along the scan"),
        ("beam_ellipticity", {"angle_deg": 90.0}, 2, "across the scan"),
        ("beam_ellipticity", {"angle_deg": 30.0}, 2, "at 30° to the scan"),
    ],
)
def test_the_direction_of_a_beam_is_said(name, parameters, order, expected):
    beam = Beam.gaussian(300.0, LMAX)
    site = systematics.Site("W1", 94.0, "ecliptic", NSIDE, LMAX, beam)
    effect = systematics.get(name)(amplitude=0.01, **parameters)
    change = systematics.seen_through((effect,), site).blm[order]
    kernel = beam.blm[0].real * (np.arange(LMAX + 1) / LMAX) ** order
    structure = next(w for w in grammar() if w.says[:4] == ("beam", "sky", "scan", f"order {order}"))
    edges = seen()[1].edges(order)
    v = np.array([np.mean(change[low:high] / kernel[low:high]) for low, high in pairwise(edges)])
    theta = np.stack([v.real, v.imag], axis=1).ravel()
    assert expected in words.says(structure, theta, np.eye(theta.size), seen()[1])


def test_the_sun_in_a_lobe_is_a_von_mises_function():
    """Six harmonics of exp(2 (cos x - 1)) are that function to 1e-4, and of the narrower one to 5 %."""
    turn = np.linspace(0.0, 2.0 * np.pi, 100)
    for narrow, tolerance in ((2, 1e-4), (8, 0.05)):
        structure = next(w for w in grammar() if w.kind == f"crossing 285 {narrow}")
        constant, none, *waves = plugin("unlisted_1", structure, np.ones(1), seen()[1]).values["coefficients"]
        assert none == 0.0
        k = np.arange(1, len(waves) // 2 + 1)[:, None]
        found = constant + waves[::2] @ np.cos(k * turn) + waves[1::2] @ np.sin(k * turn)
        expected = np.exp(narrow * (np.cos(turn - np.deg2rad(285.0)) - 1.0))
        np.testing.assert_allclose(found, expected, atol=tolerance)


@pytest.mark.parametrize(("stage", "kind"), [("beam", "order 2"), ("added", "degrees 0-2"), ("gain", "year 1")])
def test_a_file_is_the_same_effect(stage, kind, tmp_path, monkeypatch):
    monkeypatch.setattr("sys.path", list(__import__("sys").path))
    monkeypatch.setenv("PYTHONPATH", "")
    scene = seen()[1]
    structure = next(w for w in grammar() if (w.stage, w.kind, w.split, w.channel) == (stage, kind, ALIKE, "V1"))
    name = f"unlisted_of_{stage}"
    effect = plugin(name, structure, np.linspace(0.1, 0.7, structure.size) / 3.0, scene)
    path = tmp_path / f"{name}.py"
    path.write_text(effect.source('Says "so".'))
    kind_, made = systematics.get(str(path)), effect.kind()
    assert (kind_.name, kind_.scope, kind_.proposed) == (name, "channel", False)
    variables = [key for key in vars(made) if not key.startswith("_") and key not in ("amplitude", "signature")]
    assert {key: getattr(kind_, key) for key in variables} == {key: getattr(made, key) for key in variables}
    settings, library, _ = api._with_library(DiagnosisSettings(including=(str(path),)), config.load(MODEL))
    assert (settings.including, library[name]) == ((name,), kind_)
    run = {**MODEL, "effect": [{"name": str(path), "channel": "V1", "amplitude": 1.0}]}
    loaded = config.load(run)
    before = config.digest(loaded)
    path.write_text(path.read_text() + "\n# changed\n")
    assert config.digest(loaded) != before


def test_a_file_without_one_effect_is_refused(tmp_path):
    with refused(str(tmp_path / "none.py")):
        systematics.get(str(tmp_path / "none.py"))
    (tmp_path / "mcsim_two_of.py").write_text("x = 1\n")
    with refused(str(tmp_path / "mcsim_two_of.py"), 0):
        systematics.get(str(tmp_path / "mcsim_two_of.py"))
    (tmp_path / "mcsim_broken.py").write_text("1 / 0\n")
    with refused(str(tmp_path / "mcsim_broken.py")):
        systematics.get(str(tmp_path / "mcsim_broken.py"))


def test_every_structure_has_words_and_a_picture():
    scene = seen()[1]
    for structure in grammar():
        theta = np.linspace(0.5, 1.0, structure.size)
        text = words.says(structure, theta, np.eye(structure.size), scene)
        assert text
        assert (structure.channel or "") in text
        assert not structure.kind.startswith("source") or f"({scene.frame})" in text
        profile = words.profile(structure, theta, np.eye(structure.size), scene)
        assert bool(profile) == (words.profile_ranges(structure, scene) is not None)
    found = Reconstructed(
        *structure.says,
        text,
        1e-5,
        30.0,
        1,
        0.8,
        0.1,
        "",
        (),
        None,
        ((2, 8, 1.0, 0.1),),
        (1.0,) * 192,
        "W1",
        "unlisted_1",
        "x",
    )
    assert "0.80 µK ± 0.08 µK" in found.sentence
    assert "0.80 µK ± 0.04 µK" in replace(found, stage="noise").sentence  # the root of a variance known to 10 %
    assert found.to_json()["file"] == "unlisted_1.py"
    assert len(structure_figure(found, "ecliptic").axes) == 3
