"""The cache of a model's simulations: what changes them changes its key."""

import importlib
import re
import sys
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mcsim import config, systematics
from mcsim.datavector.candidate import Candidate
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis import api
from mcsim.reconstruction import simulated_scores
from mcsim.support import code, resources
from refusals import refused

SOURCE = """
from mcsim.systematics import Effect


class Tilt(Effect):
    name, scope, unit, step = "tilt", "common", "K", 0.1
    cause = signature = "A test."

    def sky(self, sky, site, draw):
        return sky * (1.0 + self.amplitude)
"""
RUN = config.load(resources.workflow("quickstart"))
NOTHING_COMPUTED = {"ensemble", "errors", "support"}
"""What is imported and no number depends on; what reads a user's simulator is in the key where there is one."""


def key(effect, settings=None, run=RUN):
    analysis = SimpleNamespace(
        candidates=(Candidate(effect, None, (0,)),),
        elements=(),
        settings=settings or DiagnosisSettings(),
        acting=set(),
        source=None,
    )
    return api._key(run, analysis)


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    path = tmp_path / "effects_of_a_user.py"
    path.write_text(SOURCE)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    yield path
    sys.modules.pop("effects_of_a_user", None)


def test_an_effect_with_other_code_is_learned_anew(plugin):
    effect = importlib.import_module("effects_of_a_user").Tilt
    before = key(effect)
    assert key(effect) == before
    plugin.write_text(SOURCE.replace("1.0 + self", "1.0 - 1.0 * self"))
    assert key(importlib.reload(sys.modules["effects_of_a_user"]).Tilt) != before


def test_a_constant_of_any_package_that_computes_is_learned_anew(plugin, monkeypatch):
    effect = importlib.import_module("effects_of_a_user").Tilt
    before, read = key(effect), set()
    monkeypatch.setattr(api, "package_digest", lambda packages, *_: read.update(packages) or "of other constants")
    assert key(effect) != before
    folder = Path(api.__file__).parents[1]
    text = "".join(path.read_text() for name in api.CODE for path in (folder / name).rglob("*.py"))
    used = set(re.findall(r"^ *from mcsim(?:\.| import )(\w+)", text, re.MULTILINE))
    assert {f"mcsim.{name}" for name in used - NOTHING_COMPUTED} <= read


def test_simulations_and_scores_are_made_anew_with_another_library(plugin, monkeypatch, tmp_path):
    """Scores were known by the code alone."""
    effect, names = importlib.import_module("effects_of_a_user").Tilt, []

    def cached(name, fill):
        names.append(name)
        np.save(tmp_path / "scores.npy", np.zeros(1))
        return tmp_path

    monkeypatch.setattr(simulated_scores.folders, "cached", cached)
    analysis = SimpleNamespace(run=RUN, nuisances=(), settings=DiagnosisSettings(), acting=set())
    for ducc0 in ("0.1", "0.2"):
        monkeypatch.setattr(code, "version", lambda library, ducc0=ducc0: ducc0 if library == "ducc0" else "1")
        code._package_digest.cache_clear()
        names.append(key(effect))
        simulated_scores.null_scores(analysis, None)
    code._package_digest.cache_clear()
    assert len(set(names)) == 4


NO_SCORE = {
    *("ensemble", "errors", "stats", "support"),
    *(f"reconstruction.{name}" for name in ("grammar", "search", "structure")),
    *(f"datavector.{name}" for name in ("bipolar_scan", "campaign", "candidate", "hindrance", "map_checks", "slices")),
    *("datavector.summaries", "datavector.settings"),
}
"""What is imported where scores of simulations are made, and makes none of them; settings are in the key by value."""


def test_scores_are_made_anew_with_other_code_of_any_module_that_makes_them():
    folder, used = Path(api.__file__).parents[1], set()
    for name in simulated_scores.CODE:
        path = folder / name.replace(".", "/")
        for file in path.rglob("*.py") if path.is_dir() else [path.with_suffix(".py")]:
            found = re.findall(r"^from mcsim(?:\.(\w+))?(?:\.| import )(\w+)", file.read_text(), re.MULTILINE)
            used |= {".".join(one) if one[0] in ("reconstruction", "datavector") else one[0] or one[1] for one in found}
    assert used - NO_SCORE <= set(simulated_scores.CODE)


@pytest.mark.parametrize("field", fields(DiagnosisSettings), ids=lambda field: field.name)
def test_every_setting_has_a_part_in_the_key(plugin, field):
    effect = importlib.import_module("effects_of_a_user").Tilt
    default = DiagnosisSettings()
    given = {"beam_orders": 3, "beam_bins": (3, 2, 2, 1, 1), "latitude_edges": (0.0, 1.0)}
    value = given.get(field.name, another(getattr(default, field.name)))
    assert key(effect, replace(default, **{field.name: value})) != key(effect)


def another(value):
    """Return another value that a setting may have."""
    match value:
        case bool():
            return not value
        case tuple():
            return (1.0,) if value else ("another",)
        case float():
            return value / 2
        case _:
            return (value or 0) + 1


def test_name_seed_and_number_of_realizations_do_not_count(plugin):
    effect = importlib.import_module("effects_of_a_user").Tilt
    other = replace(RUN, name="other", ensemble=replace(RUN.ensemble, seed=9, realizations=3))
    assert key(effect, run=other) == key(effect)


@pytest.mark.parametrize("asked", [("beam_width",), ("gain_drift", "sidelobe_pickup"), ("FILE", "beam_width")])
def test_effects_that_alone_are_proposed_are_those_that_are_not_left_out(asked, plugin):
    """And so have one key; ``sidelobe_pickup`` is proposed on request alone."""
    names = tuple(str(plugin) if name == "FILE" else name for name in asked)
    known = {**systematics.catalogue(), **{systematics.get(name).name: None for name in names}}
    others = tuple(name for name in known if name not in {systematics.get(name).name for name in names})
    only, _, _ = found = api._with_library(DiagnosisSettings(only=names), RUN)
    assert found[:2] == api._with_library(DiagnosisSettings(without=others, including=names), RUN)[:2]
    assert (only.without, only.only) == (tuple(sorted(others)), ())
    assert set(found[2]) == set(known) - set(others)


def test_a_nuisance_of_a_file_is_left_out_by_effects_that_alone_are_proposed(plugin):
    run = replace(RUN, nuisances=(config.Nuisance(effect=str(plugin), width=(1e-3,)),))
    found, _, _ = api._with_library(DiagnosisSettings(only=("beam_width",)), run)
    assert "tilt" in found.without


def test_what_effects_that_alone_are_proposed_contradict_is_refused():
    known = {"gain_drift": systematics.get("gain_drift"), "calibration": systematics.get("calibration")}
    for settings, named in (
        ({"only": ("beam_widht",)}, ("beam_widht", "beam_width")),
        ({"only": ("beam_width",), "library": known}, ("beam_width", *known)),
        ({"only": ("beam_width", "gain_drift"), "without": ("gain_drift",)}, ("gain_drift", "--only", "--without")),
        ({"only": ("beam_width",), "including": ("gain_spin",)}, ("gain_spin", "--only", "--with")),
    ):
        with refused(*named):
            api._with_library(DiagnosisSettings(**settings), RUN)
