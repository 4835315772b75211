"""A small run that takes a fraction of a second, and workers to run it with: in this process, or quick to start."""

import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import dask
import pytest
from distributed import Client, LocalCluster
from matplotlib.figure import Figure

from mcsim import cli, config
from mcsim.datavector import campaign
from mcsim.diagnosis import api
from mcsim.ensemble import runner
from mcsim.ensemble.runner import cluster
from refusals import unnamed

Command = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="session")
def client() -> Iterator[Client]:
    """Two workers in this process, for runs; stores are read by threads instead, which is ten times as fast."""
    with (
        dask.config.set(cluster.QUIET),
        LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0") as threads,
        Client(threads) as connected,
        dask.config.set(scheduler="threads"),
    ):
        yield connected


@pytest.fixture
def in_this_process(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let commands run on ``client`` instead of processes, whose start takes seconds."""
    monkeypatch.setattr(cluster, "local_client", lambda workers: nullcontext(client))


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate what diagnoses ask for in this process, without workers, which cannot load what tests define."""
    original = campaign.batch
    monkeypatch.setattr(api, "batch", lambda workers: original(0))


def table(**changes: Any) -> dict[str, Any]:
    """Configuration of 10 realizations at nside 16; ``changes`` replace whole sections."""
    base: dict[str, Any] = {
        "schema": 1,
        "name": "small",
        "sky": {"spectrum": "wmap7", "lmax": 32},
        "map": {"nside": 16},
        "channel": [
            {
                "name": "W1",
                "beam": {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 300.0, "fwhm_minor_arcmin": 250.0},
                "scan": {"kind": "parallel_transport", "psi0_deg": 20.0},
            }
        ],
        "biposh": {"L_max": 2, "summary_bin": 10},
        "ensemble": {"realizations": 10, "seed": 7},
        "compute": {"chunk": 4},
    }
    return base | changes


def ensemble(realizations: int = 10, seed: int = 7, **more: Any) -> dict[str, Any]:
    return {"ensemble": {"realizations": realizations, "seed": seed, **more}}


@pytest.fixture(scope="session")
def small_store(client: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small run, finished; tests must not write to it."""
    path = tmp_path_factory.mktemp("store") / "small.zarr"
    runner.run(config.load(table()), path, workers=client)
    return path


@pytest.fixture(scope="session")
def short_store(client: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its first three realizations, to be copied and extended."""
    path = tmp_path_factory.mktemp("store") / "short.zarr"
    runner.run(config.load(table(**ensemble(3))), path, workers=client)
    return path


SMALL = """\
schema = 1
name = "small"
[sky]
spectrum = "wmap7"
lmax = 32
[map]
nside = 16
[[channel]]
name = "W1"
beam = { kind = "elliptical_gaussian", fwhm_major_arcmin = 300.0, fwhm_minor_arcmin = 250.0 }
scan = { kind = "parallel_transport", psi0_deg = 20.0 }
[biposh]
L_max = 2
summary_bin = 10
[ensemble]
realizations = 10
seed = 7
"""


@pytest.fixture
def mcsim(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Command:
    """Run a command in an empty folder: exit code, standard output, standard error.

    Its figures are saved small and without a layout engine, which draws them twice; unit tests draw them whole.
    """
    savefig = Figure.savefig

    def quick(figure: Figure, target: Any, **options: Any) -> None:
        figure.set_layout_engine(None)
        savefig(figure, target, **{**options, "dpi": 50})

    monkeypatch.setattr(Figure, "savefig", quick)

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["mcsim", *map(str, words)])
        code = 0
        try:
            cli.main()
        except SystemExit as stop:
            code = int(stop.code or 0)
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


def assert_refused(answer: tuple[int, str, str], *named: object) -> None:
    """Hold that a command ended with exit code 2 and one sentence that names all of ``named``."""
    code, _, err = answer
    assert code == 2
    assert err.count("\n") == 1
    assert "Traceback" not in err
    assert unnamed(err, *named) == []


@pytest.fixture
def copy(small_store: Path, tmp_path: Path) -> Path:
    path = tmp_path / "copy.zarr"
    shutil.copytree(small_store, path)
    return path
