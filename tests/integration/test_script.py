"""A plain script that calls mcsim.run at module level, as the README prints it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from mcsim import open_summary

from .conftest import ensemble, table

SCRIPT = """
import json
import mcsim

with open("started", "a") as stream:
    stream.write("x")
mcsim.run(json.load(open("small.json")), "small.zarr")
"""


@pytest.mark.parametrize("way", ["script", "stdin"])
def test_scripts_need_no_guard(way: str, tmp_path: Path) -> None:
    (tmp_path / "small.json").write_text(json.dumps(table(**ensemble(2), compute={"workers": 1})))
    (tmp_path / "study.py").write_text(SCRIPT)
    words = {"script": ["study.py"], "stdin": ["-"]}[way]
    done = subprocess.run(
        [sys.executable, *words], cwd=tmp_path, input=SCRIPT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "started").read_text() == "x"
    assert int(open_summary(tmp_path / "small.zarr")["count"]) == 2


def test_workers_of_a_pool_are_told_where_to_call(tmp_path: Path) -> None:
    (tmp_path / "small.json").write_text(json.dumps(table(**ensemble(2), compute={"workers": 1})))
    (tmp_path / "study.py").write_text(
        "import json, multiprocessing\n"
        "from mcsim import run\n"  # before the pool, whose worker is a fork
        "if __name__ == '__main__':\n"
        "    with multiprocessing.Pool(1) as pool:\n"
        "        pool.apply(run, (json.load(open('small.json')), 'small.zarr'))\n"
    )
    done = subprocess.run([sys.executable, "study.py"], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert "InputError" in done.stderr
    assert "ProcessPoolExecutor" in done.stderr
    assert not (tmp_path / "small.zarr").exists()
