"""Results of several files: a process that is killed leaves no new picture beside an old table."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from mcsim.benchmark import report
from mcsim.benchmark.summary import Score
from mcsim.information.result import Limits
from mcsim.information.settings import LimitSettings
from pictures import quick_pictures


def write_limits(name: str, folder: Path) -> None:
    nothing = np.zeros((0, 0))
    Limits(name, (), nothing, nothing, (), 1, "", LimitSettings()).save(folder, name.encode())


def write_score(name: str, folder: Path) -> None:
    with quick_pictures(empty=True):
        report.write(Score(name, []), folder)


@pytest.mark.parametrize(("write", "table"), [(write_limits, "limit.json"), (write_score, "score.json")])
def test_the_table_goes_first_and_comes_last(write, table, tmp_path, monkeypatch) -> None:
    for name in ("first", "second"):
        write(name, tmp_path)
    assert "second" in (tmp_path / table).read_text()
    whole = sorted(path.name for path in tmp_path.iterdir())
    moved = []

    def killed(source: Path, target: Path) -> None:
        assert {path for path in tmp_path.iterdir() if path.name[0] != "."} == set(moved)
        moved.append(Path(target))
        if len(moved) == len(whole):
            raise KeyboardInterrupt
        source.rename(target)

    monkeypatch.setattr(shutil, "move", killed)
    with pytest.raises(KeyboardInterrupt):
        write("third", tmp_path)
    assert moved[-1] == tmp_path / table
    assert sorted([*(path.name for path in tmp_path.iterdir()), table]) == whole
