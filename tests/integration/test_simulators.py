"""Simulators of others: the same maps as ours on runs of ours, what their arguments change, and what they do wrong."""

import importlib
import threading
from pathlib import Path

import healpy
import numpy as np
import pytest

import mcsim
from mcsim import config
from mcsim.datavector.campaign import with_effects
from mcsim.datavector.map_checks import read_maps
from mcsim.diagnosis import api
from mcsim.ensemble.external import source_of
from mcsim.ensemble.external_maps import in_order, parts_of
from mcsim.errors import RunError
from mcsim.simulation import sampled
from mcsim.simulation.survey import survey
from refusals import refused

from .test_external import FEW, MODEL, SETTINGS, Plain, arrays_of, diagnosed, native

pytestmark = pytest.mark.filterwarnings("ignore")  # theirs
FOLDER = Path(__file__).parents[2] / "workflows" / "simulators"
PACKAGES = {"litebird": "litebird_sim", "toast3": "toast", "totalconvolve": "ducc0", "healpy_pipeline": "healpy"}
ACCURACY = {"litebird": 1e-4, "toast3": 1e-6, "totalconvolve": 1e-6, "healpy_pipeline": 1e-3}
DIFFERENT = {
    "litebird": ({"turned_deg": 90.0}, "psi_offset"),
    "toast3": ({"calibrate": False}, "calibration"),
    "totalconvolve": ({"centred": True}, "pixel_centres"),
    "healpy_pipeline": ({"nest": True}, "ordering"),
}


def _run(circular: bool) -> config.RunConfig:
    beam = {
        "kind": "elliptical_gaussian",
        "fwhm_major_arcmin": 400.0,
        "fwhm_minor_arcmin": 400.0 - 80.0 * (not circular),
    }
    scan = {"kind": "hit_averaged", "model": "wmap", "line_of_sight": "A", "sample_period_s": 121.0}
    return config.load(
        {
            "schema": 1, "name": "small", "sky": {"spectrum": "wmap7", "lmax": 40},
            "map": {"nside": 16, "splits": ["half1", "half2"]},
            "channel": [{"name": "W1", "beam": beam, "scan": scan}], "ensemble": {"seed": 5},
        }
    )  # fmt: skip


@pytest.mark.parametrize("name", PACKAGES)
def test_a_simulator_of_others_makes_our_maps_and_its_arguments_are_named(name, monkeypatch, tmp_path):
    pytest.importorskip(PACKAGES[name])
    monkeypatch.syspath_prepend(str(FOLDER))
    inputs, theirs = importlib.import_module("inputs"), importlib.import_module(name)
    run = _run(circular=name == "healpy_pipeline")
    given = inputs.of(run)
    ours = dict(sampled.maps(survey(run), 0))
    made = theirs.simulate(given)
    inputs.write(tmp_path, made, given.frame)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["W1_half1.fits", "W1_half2.fits"]
    assert healpy.read_map(tmp_path / "W1_half1.fits") == pytest.approx(made["W1_half1"])
    found = mcsim.compare(list(ours.values()), list(made.values()), run)
    assert found.verdict == "identical"
    assert found.accuracy < ACCURACY[name]
    arguments, difference = DIFFERENT[name]
    found = mcsim.compare(list(ours.values()), list(theirs.simulate(given, **arguments).values()), run)
    assert [d.name for d in found.channels[0].differences] == [difference]
    assert all(np.isfinite(m).all() for m in made.values())


def test_litebird_sim_as_a_model_adds_an_effect_to_the_sky_that_it_is_given(monkeypatch):
    pytest.importorskip("litebird_sim")
    monkeypatch.syspath_prepend(str(FOLDER))
    theirs = importlib.import_module("external_model")
    scan = {"kind": "hit_averaged", "model": "wmap", "line_of_sight": "B", "sample_period_s": 1201.0}
    channel = dict(theirs.MODEL["channel"][1], scan=scan, noise={"sigma0_uk": 0.0})
    run = config.load(dict(theirs.MODEL, channel=[channel]))
    effect = config.Effect(name="beam_ellipticity", channel="W1", parameters={"amplitude": -0.3, "angle_deg": 20.0})
    sky = importlib.import_module("inputs").of(run, 3).sky
    source = source_of(run, theirs.Litebird)
    plain, changed = source.maps(0, 0, (), sky), source.maps(0, 0, (effect,), sky)
    ours = [dict(sampled.maps(survey(with_effects(run, own)), 3)) for own in ((), (effect,))]
    for before, after, name in zip(plain, changed, ours[0], strict=True):
        seen = (before != healpy.UNSEEN) & (ours[0][name] != healpy.UNSEEN)
        expected = ours[1][name] - ours[0][name]
        assert np.std((before - ours[0][name])[seen]) < 1e-4 * np.std(before[seen])
        assert np.std((after - before - expected)[seen]) < 0.02 * np.std(expected[seen])


@pytest.mark.usefixtures("here")
def test_realizations_that_repeat_others_are_refused():
    """Each would count as one of its own: the covariance would be too small, or singular."""
    stack = native(1, 70)
    for repeated, words in (
        (np.concatenate([stack, stack[3:33]]), ("realization 3", "realization 70", 100, 70)),
        (np.repeat(stack[:1], 100, axis=0), ("realization 0", "realization 1", 100, 1)),
    ):
        with refused(*words):
            mcsim.diagnose(mcsim.ExternalModel(MODEL, repeated), list(stack[0]), settings=SETTINGS)
        with refused(*words[:2]):
            mcsim.diagnose(mcsim.ExternalModel(MODEL, repeated), list(stack[0]), settings=FEW)

    def few(seed):
        return dict(zip(("V:a", "V:b"), arrays_of(Plain().simulate(seed % 30)), strict=True))

    with refused("few", "seed", 130, 30):
        diagnosed(few)


@pytest.mark.usefixtures("here")
def test_data_that_are_one_of_the_realizations_are_refused():
    """They are nearer to the mean than other data: of 150 realizations of 82 elements all had p-values above 0.9."""
    stack = native(1, 150)
    model = mcsim.ExternalModel(MODEL, stack)
    with refused("realization 17", "p-value"):
        mcsim.diagnose(model, list(stack[17]), settings=FEW)
    assert mcsim.diagnose(model, list(native(2, 1)[0]), settings=FEW).test.pvalue < 1.0


class Wrong(Plain):
    """A simulator that says that it widens its beam, and what it does with effects instead."""

    def __init__(self, wrong):
        super().__init__(effects=("beam_width",))
        object.__setattr__(self, "wrong", wrong)

    def simulate(self, seed, effects=(), sky=None):
        return self.wrong(seed, effects)


def noisier(seed, effects):
    """Draw further noise, a tenth of the other, when there are effects."""
    maps = Plain().simulate(seed, effects)
    more = np.random.default_rng(seed + 1).normal(scale=3.0 * bool(effects), size=3072)
    return {"V": {"a": maps["V"]["a"] + more, "b": maps["V"]["b"]}}


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        (lambda seed, effects: Plain().simulate(seed), "ignores"),
        (lambda seed, effects: Plain().simulate(seed + 7 * bool(effects), effects), "draws"),
        (noisier, "draws"),
    ],
    ids=["ignores", "other sky and noise", "other noise"],
)
def test_an_effect_has_to_change_the_maps_of_a_seed_and_nothing_else(wrong, word):
    with refused("Wrong", "beam_width", word):
        diagnosed(Wrong(wrong))


@pytest.mark.usefixtures("here")
def test_seeds_are_told_apart_where_maps_are_observed():
    def masked(seed, effects=()):
        maps = Plain().simulate(seed, effects)["V"]
        return {f"V:{name}": np.where(np.arange(3072) < 20, healpy.UNSEEN, one) for name, one in maps.items()}

    masked.effects = ("beam_width",)
    data = list(masked(3).values())
    assert mcsim.diagnose(mcsim.ExternalModel(MODEL, masked), data, settings=FEW).agreement.effects == ("beam_width",)


def test_what_is_not_observed_may_be_of_single_precision():
    """As ``float32`` the value UNSEEN is another number, and the map is not refused for the size of it."""
    parts = tuple(parts_of(config.load(MODEL)))
    run, maps = config.load(MODEL), np.float32(native(5, 1)[0])
    maps[:, :30] = healpy.UNSEEN
    given = dict(zip(("V:a", "V:b"), maps, strict=True))
    assert all(np.all(one[:30] == healpy.UNSEEN) for one in in_order(given, parts, "here"))
    model = api.analysis_of(run, settings=SETTINGS.of_a_simulation()).model
    for found, one in zip(read_maps(model, given), maps, strict=True):
        np.testing.assert_array_equal(found[:30], healpy.UNSEEN)
        np.testing.assert_array_equal(found[30:], np.float64(one[30:]))


def test_what_a_simulator_says_of_effects():
    run = config.load(MODEL)
    for effects in (None, (), []):
        assert source_of(run, Plain(effects=effects)).effects == ()
    assert source_of(run, Plain(effects={"beam_width"})).effects == ("beam_width",)
    for effects in ("beam_width", 3, (1,)):
        with refused("Plain.effects", repr(effects)):
            source_of(run, Plain(effects=effects))


@pytest.mark.parametrize("name", ["effects", "state"])
@pytest.mark.parametrize("error", [RuntimeError, AttributeError, SystemExit])
def test_what_a_simulator_fails_to_say_of_itself_is_refused(name, error):
    """It ended in a traceback; an AttributeError of a property was a simulator without effects."""

    def fails(self):
        raise error("of a user")

    kind = type("Survey", (), {"simulate": lambda self, seed, effects=(): {}, name: property(fails)})
    with refused(f"Survey.{name}", error.__name__):
        source_of(config.load(MODEL), kind())


@pytest.mark.parametrize("error", [ValueError("first\nsecond"), SystemExit(3), None])
def test_a_class_that_cannot_be_made_is_refused(error):
    """Its error was passed on bare where the class itself is given; None: it needs more than the description."""

    class Survey:
        def __init__(self, description, *more, **needed):
            if error is not None:
                raise error

        def simulate(self, seed):
            return {}

    class Demanding(Survey):
        def __init__(self, description, beams):
            super().__init__(description)

    kind = Demanding if error is None else Survey
    with refused(kind.__name__, type(error or TypeError()).__name__) as caught:
        source_of(config.load(MODEL), kind)
    assert "second" not in str(caught.value)


def test_a_class_that_cannot_be_sent_to_workers_is_refused():
    kind = type("Survey", (), {"simulate": lambda self, seed: {}, "lock": threading.Lock()})
    with refused(kind, "_thread.lock"):
        source_of(config.load(MODEL), kind)


def test_an_effect_that_is_declared_twice_is_one():
    kind = type("Survey", (), {"simulate": lambda self, seed, effects=(): {}, "effects": ["beam_width", "beam_width"]})
    assert source_of(config.load(MODEL), kind()).effects == ("beam_width",)


def test_a_simulator_that_exits_fails_with_its_seed(tmp_path):
    def exits(seed):
        raise SystemExit("no licence")

    source = source_of(config.load(MODEL), exits)
    with refused("exits", "seed", "SystemExit", source.words(0, 0).split()[-1], by=RunError):
        source.maps(0, 0)
    (tmp_path / "exits.py").write_text("raise SystemExit(3)")
    with refused("exits.py:simulate", "SystemExit"):
        source_of(config.load(MODEL), f"{tmp_path / 'exits.py'}:simulate")


def test_a_dry_run_refuses_the_counts_that_a_diagnosis_refuses():
    size = len(api.analysis_of(config.load(MODEL)).elements)
    every = mcsim.DiagnosisSettings(simulations=size - 1)
    for model, settings, words in (
        (config.load(MODEL), every, (size - 1, size)),
        (mcsim.ExternalModel(MODEL, native(1, 20)), mcsim.DiagnosisSettings(), (20, size)),
        (mcsim.ExternalModel(MODEL, native(1, 20)), mcsim.DiagnosisSettings(simulations=500), (20, 500)),
    ):
        with refused(*words):
            api.describe(model, settings)
        with refused(*words):
            mcsim.diagnose(model, list(native(5, 1)[0]), settings=settings)


@pytest.mark.parametrize(
    ("template", "shown"),
    [
        ("many/{realization:05d}/{channel}_{split}.fits", "many/{realization:05d}/{channel}_{split}.fits"),
        ("many/{split}/{realization}.fits", "many/{split}/{realization}.fits"),
        ("many/{channel}_{split}_{realization}.fits", "{channel}_{split}_{realization}.fits"),
    ],
)
def test_stored_maps_are_called_by_what_tells_them_apart(template, shown, tmp_path):
    run = config.load(MODEL)
    for part in parts_of(run):
        path = tmp_path / template.format(realization=3, channel=part.channel, split=part.split)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    found = source_of(run, str(tmp_path / template))
    assert found.label == shown
    assert found.words(0, 0) == f"realization 3 of {shown}"
