"""Packaged files are found in an installed package, in a checkout, and from any folder."""

from dataclasses import replace
from pathlib import Path

import pytest

from mcsim import config
from mcsim.simulation import power
from mcsim.simulation.survey import survey
from mcsim.support import resources
from refusals import refused


@pytest.fixture(params=["installed", "checkout"])
def layout(request, tmp_path, monkeypatch):
    """A package folder whose scan models are inside it (wheel) or beside it (checkout)."""
    package = tmp_path / "site" / "mcsim"
    package.mkdir(parents=True)
    folder = (package if request.param == "installed" else package.parent) / "scan_models"
    folder.mkdir()
    (folder / "wmap.toml").write_text("")
    (folder / "planck.toml").write_text("")
    (folder / "notes.md").write_text("")
    monkeypatch.setattr(resources, "_PACKAGE", package)
    return folder


def test_name_is_found_in_both_layouts(layout):
    assert resources.scan_model("wmap") == layout / "wmap.toml"
    assert resources.names("scan_models") == ("planck", "wmap")


def test_unknown_name_lists_what_there_is(layout):
    with refused("wmpa", "planck", "wmap"):
        resources.scan_model("wmpa")


def test_nothing_packaged_is_said(monkeypatch, tmp_path):
    monkeypatch.setattr(resources, "_PACKAGE", tmp_path / "mcsim")
    with refused("quickstart"):
        resources.workflow("quickstart")


def test_packaged_name_wins_over_a_file_and_dot_slash_chooses_the_file(layout, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("wmap").write_text("")
    assert resources.scan_model("wmap") == layout / "wmap.toml"
    assert resources.scan_model("./wmap") == tmp_path / "wmap"


@pytest.mark.parametrize("name", ["a\0b", "x" * 5000])
def test_names_that_no_file_system_takes(name):
    with refused(repr(name)):
        resources.spectrum(name)


def test_this_installation_has_its_files_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert {"wmap7", "planck2018"} <= set(resources.names("data"))
    assert resources.workflow("quickstart").is_file()
    assert resources.scan_model("wmap").is_file()
    assert resources.spectrum("wmap7").is_file()


def test_demonstration_differs_from_its_model_by_one_effect():
    model, truth = (config.load(name) for name in ("demo-model", "demo-truth"))
    assert [(effect.name, effect.channel) for effect in truth.effects] == [("beam_ellipticity", "W1")]
    assert replace(truth, name=model.name, effects=(), ensemble=model.ensemble) == model
    assert power.neglected(survey(model)) is None  # its report opens without a warning
