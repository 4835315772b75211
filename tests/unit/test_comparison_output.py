"""The folder of a comparison: maps, and the reports of others, are not written over."""

import json
import shutil
from pathlib import Path

import healpy
import numpy as np
import pytest

import mcsim
from mcsim.comparison.output import check_output, place
from refusals import refused


@pytest.fixture
def sides(tmp_path: Path) -> tuple[Path, Path]:
    found = tmp_path / "here", tmp_path / "there"
    for side in found:
        side.mkdir()
        healpy.write_map(side / "W1.fits", np.arange(12.0), coord="E", column_units="uK", dtype=float)
    return found


@pytest.mark.parametrize("number", [0, 1])
def test_a_report_is_not_written_among_the_maps(sides, number):
    with refused(sides[number], "-o"):
        mcsim.compare(*sides, output=sides[number])
    assert [path.name for path in sides[number].iterdir()] == ["W1.fits"]


def test_a_report_is_not_written_into_the_realization_that_is_compared(sides):
    first = sides[0] / "00000"
    first.mkdir()
    (sides[0] / "W1.fits").rename(first / "W1.fits")
    with refused(first, "-o"):
        mcsim.compare(*sides, output=first)


def test_a_report_takes_the_place_of_its_own_case_alone(sides, tmp_path):
    out = tmp_path / "out"
    for _ in range(2):
        mcsim.compare(*sides, output=out)
    with refused(out, "there", "here", "-o"):
        mcsim.compare(*sides[::-1], output=out)
    assert json.loads((out / "compare.json").read_text())["case"] == "there"


def test_a_report_with_another_side_a_is_not_replaced(sides, tmp_path, monkeypatch):
    """It is of the same case, that of side B, and was replaced without a word."""
    other, out = tmp_path / "other", tmp_path / "out"
    shutil.copytree(sides[0], other)
    monkeypatch.chdir(tmp_path)
    mcsim.compare("here", "there", output=out)
    with refused(out, sides[0], other, "-o"):
        mcsim.compare(other, sides[1], output=out)
    said = json.loads((out / "compare.json").read_text())["sides"]
    assert said == [str(side) for side in sides]
    assert str(sides[0]) in (out / "report.html").read_text()
    mcsim.compare(*sides, output=out)  # by another path of the same


def test_a_report_with_a_side_b_of_the_same_name_is_not_replaced(sides, tmp_path):
    other = tmp_path / "later" / "there"
    shutil.copytree(sides[1], other)
    mcsim.compare(*sides, output=tmp_path / "out")
    with refused(sides[1], other, "-o"):
        mcsim.compare(sides[0], other, output=tmp_path / "out")


def test_a_report_that_says_no_sides_is_replaced(sides, tmp_path):
    """That of an earlier version."""
    (tmp_path / "compare.json").write_text('{"case": "there"}')
    check_output(tmp_path, sides, "there")


def test_a_packaged_configuration_is_the_same_side_in_any_folder(sides, tmp_path, monkeypatch):
    monkeypatch.chdir(sides[0])
    assert place("tiny") == "tiny"
    assert place("W1.fits") == str(sides[0] / "W1.fits")


@pytest.mark.parametrize("text", ["", "[]", '{"case": 3, "sides": 2}'])
def test_what_is_no_comparison_is_replaced(sides, tmp_path, text):
    (tmp_path / "compare.json").write_text(text)
    check_output(tmp_path, sides, "there")


def test_the_report_of_a_diagnosis_is_not_replaced(sides, tmp_path):
    (tmp_path / "verdict.json").write_text("{}")
    with refused(tmp_path, "report.html", "-o"):
        check_output(tmp_path, sides, "there")
