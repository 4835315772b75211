"""The grammar of unlisted effects where splits are every n-th ring: scores and time lines against the simulator."""

from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import pytest

from instruments import two_channels
from mcsim import config
from mcsim.datavector.filter_model import Model, model_of
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.wiener_filter import wiener_filter
from mcsim.instrument.scan import MapGrid, ScanModel
from mcsim.reconstruction import simulated_scores
from mcsim.reconstruction.forms import InTime
from mcsim.reconstruction.grammar import structures
from mcsim.reconstruction.plugin import plugin
from mcsim.reconstruction.scores import Scene
from mcsim.reconstruction.structure import ALIKE, OPPOSITE
from mcsim.simulation import simulate, tod
from mcsim.simulation.survey import survey

NSIDE, PERIOD = 16, "period 5640.0"
TABLE = two_channels("rings", lmax=24, nside=NSIDE, fwhm_arcmin=300.0, period_s=311.0)


def model(split_by: str) -> Model:
    run = config.load(TABLE | {"map": TABLE["map"] | {"split_by": split_by}})
    return model_of(survey(run, orders=4), DiagnosisSettings())


@lru_cache(maxsize=1)
def seen() -> tuple[Model, Scene]:
    by_rings = model("rings")
    return by_rings, simulated_scores.with_chosen(by_rings, simulated_scores.scene_of(by_rings), [PERIOD])


@pytest.mark.parametrize(
    ("stage", "frame", "kind", "split"),
    [
        ("added", "time", "year 1", ALIKE),
        ("added", "time", "year 2", "half1"),
        ("added", "time", "trend", ALIKE),
        ("added", "time", "spin 1", OPPOSITE),
        ("added", "time", PERIOD, "half2"),
        ("added", "time", "from 91.31", ALIKE),
        ("added", "sky", "degrees 0-4", "half2"),
        ("added", "spacecraft", "orientation 2", "half1"),
        ("added", "Sun", "dipole", "half1"),
        ("gain", "time", "spin 3", "half2"),
        ("gain", "time", "step 205.5", ALIKE),
        ("gain", "time", PERIOD, ALIKE),
        ("elsewhere", "spacecraft", "lag", ALIKE),
    ],
)
def test_a_score_is_the_product_of_residuals_and_what_the_effect_adds(stage, frame, kind, split):
    """The effect that a structure becomes acts in the rings of its splits, as its score says."""
    by_rings, scene = seen()
    run = by_rings.survey.config
    filtered = wiener_filter(by_rings, list(simulate.maps(by_rings.survey, 7)))
    u = simulated_scores.scores_of_maps(by_rings, scene, list(simulate.maps(by_rings.survey, 7)))
    wanted = (stage, frame, kind, split, "W1")
    structure = next(w for w in structures(scene) if (w.stage, w.frame, w.kind, w.split, w.channel) == wanted)
    theta = np.random.default_rng(3).normal(size=structure.size) * 1e-3
    effect = plugin("unlisted_1", structure, theta, scene)
    assert effect is not None
    table = config.Effect(name="unlisted_1", channel="W1", parameters={"amplitude": 1.0})
    acting = survey(replace(run, effects=(table,)), library={"unlisted_1": effect.kind()})
    before = simulate.maps(survey(run), 0, sky=filtered.sky)
    added = simulate.maps(acting, 0, sky=filtered.sky) - before
    size = np.sqrt(np.sum(added**2, axis=1))
    if split in ("half1", "half2"):
        assert size[2 if split == "half2" else 3] < 1e-9 * size.max()  # the other half of the channel
    product = sum(r @ one for r, one in zip(filtered.residual, added, strict=True))
    scale = np.sqrt(sum(r @ r * (one @ one) for r, one in zip(filtered.residual, added, strict=True)) / NSIDE**2 / 12)
    assert abs(product - theta @ structure.of(u)) < (0.1 if stage == "gain" else 0.05) * scale


@pytest.mark.parametrize("place", [200, 3000, 20000])
def test_the_power_of_a_period_is_that_of_its_waves_in_the_rings_of_each_map(place):
    by_rings, scene = seen()
    line, members, draw = scene.time_lines[1], scene.of(1), np.random.default_rng(2)
    products = [draw.normal(size=12 * NSIDE**2) for _ in members]
    period_s = line._padded * line.span_s / place
    waves = [simulated_scores._waves(by_rings, i, {"wave": "period", "period_s": period_s}) for i in members]
    cosine, sine = (sum(one @ both[k] for one, both in zip(products, waves, strict=True)) for k in (0, 1))
    assert line.power(products)[place] == pytest.approx(cosine**2 + sine**2, rel=1e-3)


def test_rings_of_splits_are_apart_and_sets_have_no_time_line():
    _, scene = seen()
    one, other = (np.asarray(visits.sum(axis=1)).ravel() > 0.0 for visits in scene.time_lines[0].visits)
    assert one.mean() > 0.4
    assert other.mean() > 0.4
    assert simulated_scores.scene_of(model("sets")).time_lines == ()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_factor_of_rings_is_that_of_the_samples_in_them(sign):
    time_s = np.arange(0.0, 1000.0, 7.0)
    form = SimpleNamespace(name="alternating", splits=(1.0, -0.5), by_rings=True)
    site = SimpleNamespace(pointed=lambda _: SimpleNamespace(model=SimpleNamespace(spin_period_s=sign * 129.3)))
    assert np.array_equal(InTime.factor(form, time_s, site) == 1.0, tod.on_rings(time_s, sign * 129.3, 2, 0))
    assert InTime.factor(form, time_s, site)[0] == 1.0


@pytest.mark.parametrize("number", [2, 3, 7])
def test_a_factor_of_parts_of_the_survey_is_that_of_the_samples_in_their_maps(number):
    survey = replace(ScanModel.load("wmap").with_sampling(613.0), duration_days=11.0)  # no part has a whole number
    line = survey.lines_of_sight[0]
    site = SimpleNamespace(pointed=lambda _: SimpleNamespace(model=survey, line=line))
    form = SimpleNamespace(name="parts", splits=tuple(range(number)), by_rings=False)
    for part in range(number):
        first, last = MapGrid(8, time_range=(part / number, (part + 1) / number)).sample_range(survey, line)
        assert np.all(InTime.factor(form, 613.0 * np.arange(first, last), site) == part)
