"""Light that channels share by their frequencies: where it is, and how its scores are measured."""

from dataclasses import replace

import numpy as np
import pytest

from instruments import two_channels
from mcsim import config
from mcsim.datavector.filter_model import model_of
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.wiener_filter import wiener_filter
from mcsim.reconstruction import simulated_scores, words
from mcsim.reconstruction.grammar import structures
from mcsim.reconstruction.plugin import CONSTANT, plugin
from mcsim.reconstruction.scores import GROWTH
from mcsim.reconstruction.structure import ALIKE, OPPOSITE
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey

SMALL = {"lmax": 16, "nside": 8, "fwhm_arcmin": 600.0, "period_s": 3011.0}


def test_what_frequencies_share_is_in_all_maps_but_those_of_a_component_separation():
    """Beside these what V1 and W1 have alike is told, too, which without them would be the sky itself."""
    table = two_channels("foregrounds", **SMALL)
    table["channel"].append(table["channel"][0] | {"name": "CMB", "frequency_ghz": 143.0, "foregrounds": False})
    run = config.load(table)
    scene = simulated_scores.scene_of(model_of(survey(run, orders=2), DiagnosisSettings()))
    for index, says, what in (
        (0.0, "alike in these", "quadrupole"),
        (1.5, "as the frequency to the power 1.5", "quadrupole"),
        (GROWTH, "as the frequency to the power 2", "constant"),
    ):
        told = (what, None, ALIKE, index)
        (found,) = (one for one in structures(scene) if one.says[3:] == told)
        assert found.views == (0, 1, 2, 3)
        assert says in words.says(found, np.ones(found.size), np.eye(found.size), scene)
        kind = plugin("unlisted_1", found, np.ones(found.size), scene).kind()
        effect = config.Effect(name="unlisted_1", parameters={"amplitude": 1.0})
        acting = survey(replace(run, effects=(effect,)), library={"unlisted_1": kind})
        pairs = zip(simulate.maps(acting, 0), simulate.maps(survey(run), 0), strict=True)
        v1, _, w1, _, *cmb = (np.std(one - other) for one, other in pairs)
        assert w1 / v1 == pytest.approx((94.0 / 61.0) ** index, rel=0.01)  # samples have other places
        assert max(cmb) == 0.0


@pytest.mark.parametrize(
    ("stage", "frame", "kind", "split", "index"),
    [
        ("added", "sky", "degrees 0-2", "half2", -3.0),
        ("added", "sky", "degrees 0-2", "opposite", -3.0),
        ("added", "sky", "orientation 2 degree 2", "half2", -3.0),
        ("added", "time", "spin 1", ALIKE, -3.0),
        ("added", "Sun", "dipole", "opposite", -2.0),
        ("gain", "", "constant", ALIKE, GROWTH),
        ("gain", "sky", "degrees 0-1", ALIKE, GROWTH),
        ("gain", "time", "year 1", "half2", GROWTH),
        ("beam", "scan", "order 2 as l^2", ALIKE, GROWTH),
    ],
)
def test_scores_of_what_grows_with_the_frequency(stage, frame, kind, split, index):
    """The score is the product of residuals and what the effect adds in all channels, in some splits or in all."""
    run = config.load(two_channels("halves", lmax=24, nside=16, fwhm_arcmin=300.0, period_s=311.0))
    model = model_of(survey(run, orders=2), DiagnosisSettings())
    maps, scene = list(simulate.maps(model.survey, 7)), simulated_scores.scene_of(model)
    filtered, u = wiener_filter(model, maps), simulated_scores.scores_of_maps(model, scene, maps)
    told = (frame, kind, None, split, index)
    (structure,) = (one for one in structures(scene) if one.stage == stage and one.says[2:] == told)
    theta = np.random.default_rng(7).normal(size=structure.size) * (1.0 if stage == "added" else 1e-3)
    made = plugin("unlisted_1", structure, theta, scene).kind()
    effect = config.Effect(name="unlisted_1", parameters={"amplitude": 1.0})
    acting = survey(replace(run, effects=(effect,)), library={"unlisted_1": made})
    both = (simulate.maps(one, 0, sky=filtered.sky) for one in (acting, survey(run)))
    added = [one - other for one, other in zip(*both, strict=True)]
    if kind.startswith("degrees") and stage == "added":
        assert np.std(added[1]) == pytest.approx((94.0 / 61.0) ** 3 * np.std(added[3]), rel=0.02)
    assert (split == "half2") == (not np.any(added[0]) and not np.any(added[2]))
    products = list(zip(filtered.residual, added, strict=True))
    scale = np.sqrt(sum(r @ r * (one @ one) for r, one in products) / added[0].size)
    tolerance = 0.05 if stage == "added" else 0.1  # of products with a sky that samples see beside pixels' centres
    assert abs(sum(r @ one for r, one in products) - theta @ structure.of(u)) < tolerance * scale


def test_powers_of_splits_do_not_depend_on_their_order():
    """Of three splits, what differs between any two of them, and what any two have in common."""
    table = two_channels("thirds", **SMALL)
    table["map"]["splits"] = ["a", "b", "c"]
    run = config.load(table)
    model = model_of(survey(run, orders=2), DiagnosisSettings())
    scene = simulated_scores.scene_of(model)
    found = wiener_filter(model, list(simulate.maps(model.survey, 3)))
    rows = [k for k, key in enumerate(scene.keys) if key[:2] in (("difference", 1), ("common", 1))]
    own, moved = scene.of(1), np.arange(len(scene.views))
    moved[list(own)] = np.roll(own, 1)
    turned = replace(found, adjoint=found.adjoint[moved])
    np.testing.assert_allclose(scene.listed_values(turned)[rows], scene.listed_values(found)[rows], rtol=1e-9)
    half = len(rows) // 2
    apart, common = scene.listed_values(found)[rows[:half]], scene.listed_values(found)[rows[half:]]
    total = np.sum(found.adjoint[list(own)], axis=0)
    np.testing.assert_allclose(common + 0.25 * apart, scene._powers(total, total) / 3.0, rtol=1e-9)


@pytest.mark.parametrize(
    ("order", "angle", "at"), [(1, 90.0, "across the scan (+90°)"), (2, 30.0, "at 30° to the scan")]
)
def test_the_direction_of_a_beam_is_that_of_the_degrees_that_show_it(order, angle, at):
    """Coordinates are sizes of powers of l, and those of the lowest degrees mostly noise."""
    scene = simulated_scores.scene_of(
        model_of(survey(config.load(two_channels("low", **SMALL)), orders=4), DiagnosisSettings())
    )
    structure = next(w for w in structures(scene) if w.says[:5] == ("beam", "sky", "scan", f"order {order}", "W1"))
    errors = np.repeat([1.0, *np.full(structure.size // 2 - 1, 0.02)], 2)
    theta = 1.5 * errors * np.array([1.0, -1.0] * (structure.size // 2))
    phase = (-1) ** order * 0.3 * np.exp(-1j * order * np.deg2rad(angle))
    theta[-2:] = phase.real, phase.imag
    said = words.says(structure, theta, np.diag(errors**2), scene)
    low, high = words.profile_ranges(structure, scene)[-1]
    assert at in said
    assert f"ℓ {low}–{high}" in said


def test_a_lobe_in_maps_without_a_dipole_has_a_direction_about_the_line_of_sight_alone():
    scene = simulated_scores.scene_of(
        model_of(survey(config.load(two_channels("lobe", **SMALL)), orders=2), DiagnosisSettings())
    )
    lobe = next(w for w in structures(scene) if w.kind == "lobe" and w.channel == "W1")
    kept = replace(lobe, mix=np.eye(3)[:2])
    assert "90° from the line of sight" in words.says(lobe, np.array([0.0, 1.0, 0.0]), np.eye(3), scene)
    said = words.says(kept, np.array([0.0, 1.0]), np.eye(2), scene)
    assert "across the scan (+90°)" in said
    assert "90° from" not in said


@pytest.mark.parametrize(
    ("stage", "kind"), [("added", "orientation 1"), ("added", "orientation 2"), ("gain", "orientation 1")]
)
def test_orientations_are_counted_from_the_scan_whatever_the_frame_of_maps(stage, kind):
    """In galactic maps they were counted from the galactic meridian, of which a spacecraft knows nothing."""
    table = two_channels("galactic", lmax=24, nside=32, fwhm_arcmin=300.0, period_s=311.0)
    table["map"]["frame"] = "galactic"
    run = config.load(table)
    model = model_of(survey(run, orders=2), DiagnosisSettings())
    maps, scene = list(simulate.maps(model.survey, 7)), simulated_scores.scene_of(model)
    filtered, u = wiener_filter(model, maps), simulated_scores.scores_of_maps(model, scene, maps)
    told = ("sky and dipole" if stage == "gain" else "", "spacecraft", kind, "W1", ALIKE, None)
    (structure,) = (one for one in structures(scene) if one.says == (stage, *told))
    made = plugin("unlisted_1", structure, np.array([0.6, -0.8]), scene).kind()
    assert made.frame == "ecliptic"
    effect = config.Effect(name="unlisted_1", channel="W1", parameters={"amplitude": 1.0 if stage == "added" else 1e-3})
    acting = survey(replace(run, effects=(effect,)), library={"unlisted_1": made})
    both = (simulate.maps(one, 0, sky=filtered.sky) for one in (acting, survey(run)))
    products = [(r, one - other) for r, one, other in zip(filtered.residual, *both, strict=True)]
    size = 1.0 if stage == "added" else 1e-3
    scale = np.sqrt(sum(r @ r * (one @ one) for r, one in products) / len(maps[0]))
    expected = size * np.array([0.6, -0.8]) @ structure.of(u)
    # The angle between the meridians is that at the centres of pixels.
    assert abs(sum(r @ one for r, one in products) - expected) < 0.1 * scale


@pytest.mark.parametrize(
    ("split", "size"), [("half1", "21.0 % ± 0.7 % of its variance), W1 alone, in half1 alone"), (OPPOSITE, "")]
)
def test_a_level_of_noise_is_told_with_its_size(split, size):
    """Of one split no effect of the simulator makes it, so that nothing else says how large it is."""
    scene = simulated_scores.scene_of(
        model_of(survey(config.load(two_channels("noise", **SMALL)), orders=2), DiagnosisSettings())
    )
    level = next(w for w in structures(scene) if w.says[:5] == ("noise", "", "", "level", "W1"))
    theta, covariance = np.array([0.21 * CONSTANT]), np.array([[(0.007 * CONSTANT) ** 2]])
    said = words.says(replace(level, split=split), theta, covariance, scene)
    assert said.startswith("is noise (everywhere alike")
    assert size in said
    assert ("%" in said) == bool(size)
