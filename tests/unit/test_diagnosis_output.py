"""Folders of verdicts: what a diagnosis does not write over."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from mcsim.diagnosis.output import DIGEST, check_outside, check_replaced, digest
from refusals import refused

from .test_diagnosis_report import diagnosis

MAPS = [np.arange(4.0), np.zeros(4)]


def test_the_folder_of_the_data_is_refused(tmp_path: Path) -> None:
    with refused(tmp_path, "-o"):
        check_outside(tmp_path, str(tmp_path))
    (tmp_path / "again").symlink_to(tmp_path)
    with refused(tmp_path / "again", "-o"):
        check_outside(tmp_path / "again", tmp_path)
    (tmp_path / "table.ecsv").write_text("")
    for data in (tmp_path / "table.ecsv", tmp_path / "new", MAPS):
        check_outside(tmp_path, data)
    check_outside(tmp_path / "new", tmp_path)


def test_the_report_of_a_comparison_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "compare.json").write_text("{}")
    with refused(tmp_path, "report.html", "-o"):
        check_outside(tmp_path, MAPS)


def test_a_verdict_is_replaced_by_one_of_its_own_case_and_data_alone(tmp_path: Path) -> None:
    check_replaced(tmp_path, "first", digest(MAPS))
    found = diagnosis("none")
    replace(found, case="first", provenance={DIGEST: digest(MAPS)}).save(tmp_path)
    check_replaced(tmp_path, "first", digest([one.astype(np.float32) for one in MAPS]))
    with refused(tmp_path, "first", "second", "-o"):
        check_replaced(tmp_path, "second", digest(MAPS))
    with refused(tmp_path, "first", "-o"):
        check_replaced(tmp_path, "first", digest(MAPS[::-1]))
    replace(found, case="first", provenance={}).save(tmp_path)  # as earlier versions did
    check_replaced(tmp_path, "first", digest(MAPS[::-1]))
