"""A plain script that calls mcsim.run at module level, as the README prints it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from mcsim import open_summary
from refusals import unnamed

from .conftest import ensemble, table

SCRIPT = """
import json
import mcsim

with open("started", "a") as stream:
    stream.write("x")
mcsim.run(json.load(open("small.json")), "small.zarr")
"""

POOL = """
import multiprocessing
run = mcsim.run  # loaded here: a worker of the pool is a fork
with multiprocessing.get_context("fork").Pool(1) as pool:
    try:
        pool.apply(run, (json.load(open("small.json")), "pool.zarr"))
    except mcsim.InputError as error:
        print(error)
"""


@pytest.mark.parametrize("way", ["script", "stdin"])
def test_scripts_need_no_guard(way: str, tmp_path: Path) -> None:
    """The script calls mcsim from a worker of a pool too, which is told where to call."""
    (tmp_path / "small.json").write_text(json.dumps(table(**ensemble(2), compute={"workers": 1})))
    (tmp_path / "study.py").write_text(SCRIPT.replace("mcsim.run(", POOL + "mcsim.run("))
    words = {"script": ["study.py"], "stdin": ["-"]}[way]
    done = subprocess.run(
        [sys.executable, *words], cwd=tmp_path, input=SCRIPT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "started").read_text() == "x"
    assert int(open_summary(tmp_path / "small.zarr")["count"]) == 2
    if way == "script":
        assert unnamed(done.stdout, "concurrent.futures.ProcessPoolExecutor") == []
        assert not (tmp_path / "pool.zarr").exists()


ALIASED = """
schema = 1
name = "aliased"
sky = { spectrum = "wmap7", lmax = 20 }
map = { nside = 8 }
biposh = { summary_bin = 10 }
ensemble = { realizations = 2 }

[[channel]]
name = "A"
beam = { kind = "elliptical_gaussian", fwhm_major_arcmin = 700.0, fwhm_minor_arcmin = 600.0 }
noise = { sigma0_uk = 10.0 }
scan = { kind = "hit_averaged", model = "wmap", sample_period_s = 129.3 }
"""


@pytest.mark.parametrize("words", [["run"], ["limit", "--only", "calibration", "--probes", "4"]])
def test_a_warning_is_said_once(words: list[str], tmp_path: Path) -> None:
    """Workers make the survey that the command has made, and a limit makes a second one."""
    (tmp_path / "aliased.toml").write_text(ALIASED)
    command = [sys.executable, "-m", "mcsim", words[0], "aliased.toml", *words[1:]]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("every 129.3 s") == 1
    assert "UserWarning" not in done.stderr
