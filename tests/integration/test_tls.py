"""TLS between scheduler, worker and driver, with the settings of workflows/cluster/tls.yaml; nobody else gets in."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask
import pytest
import yaml

from mcsim import cli

from .conftest import SMALL, assert_refused
from .test_runner import assert_same

TEMPLATE = Path(__file__).parents[2] / "workflows" / "cluster" / "tls.yaml"

pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl command to make certificates with")


def certify(folder: Path) -> Path:
    """An authority and a certificate of its own, as the template says."""
    folder.mkdir(parents=True)
    lines = TEMPLATE.read_text().splitlines()
    commands = [line.lstrip("# ") for line in lines if line.lstrip("# ").startswith("openssl ")]
    assert len(commands) == 3
    for command in commands:
        quick = command.replace("rsa:2048", "ec -pkeyopt ec_paramgen_curve:prime256v1")
        subprocess.run(quick.split(), cwd=folder, check=True, capture_output=True)
    return folder


def settings(folder: Path) -> str:
    return TEMPLATE.read_text().replace("/home/you", str(folder))


def merged(text: str) -> dict[str, Any]:
    """Dask's configuration with a file in it, as a process that starts with the file has it."""
    return dask.config.merge(dask.config.config, yaml.safe_load(text))


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """Scheduler with the template's settings, and a worker with the options of the command: address and settings."""
    home = tmp_path_factory.mktemp("home")
    keys = certify(home / "mcsim-tls")
    (home / "dask").mkdir()
    (home / "dask" / "tls.yaml").write_text(settings(home))
    file = home / "scheduler.json"
    options = ["--tls-ca-file", keys / "ca.pem", "--tls-cert", keys / "own.pem", "--tls-key", keys / "own.key"]
    dask_ = [sys.executable, "-m", "dask"]
    environment = os.environ | {"DASK_CONFIG": str(home / "dask")}
    commands = {
        "scheduler": [*dask_, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"],
        "worker": [*dask_, "worker", "--nthreads", "1", "--no-nanny", "--host", "tls://127.0.0.1", *options],
    }
    processes = []
    try:
        for name, command in commands.items():
            with (home / f"{name}.out").open("wb") as out:
                processes.append(
                    subprocess.Popen(
                        [*command, "--scheduler-file", file],
                        env=environment if name == "scheduler" else os.environ,
                        stdout=out,
                        stderr=out,
                    )
                )
            for _ in range(600):
                if file.exists() and file.stat().st_size:
                    break
                assert processes[0].poll() is None, (home / "scheduler.out").read_text()
                time.sleep(0.1)
        yield json.loads(file.read_text())["address"], settings(home)
    finally:
        for process in processes:
            process.kill()
            process.wait()


def mcsim_run(
    store: Path, address: str, capsys: pytest.CaptureFixture[str], patch: pytest.MonkeyPatch
) -> tuple[int, str]:
    """``mcsim run`` in this process: exit code and standard error."""
    config = store.with_suffix(".toml")
    config.write_text(SMALL)
    patch.setattr(sys, "argv", ["mcsim", "run", str(config), "-o", str(store), "--scheduler", address])
    code = 0
    try:
        cli.main()
    except SystemExit as end:
        code = int(end.code or 0)
    return code, capsys.readouterr().err


def test_run_with_certificates(
    cluster: tuple[str, str],
    small_store: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    address, own = cluster
    assert address.startswith("tls://127.0.0.1:")
    with dask.config.set(merged(own)):
        code, err = mcsim_run(tmp_path / "x.zarr", address, capsys, monkeypatch)
    assert code == 0, err
    assert_same(tmp_path / "x.zarr", small_store)


@pytest.mark.parametrize(
    ("who", "named"),
    [
        ("nobody", ("distributed.comm.tls",)),
        ("a stranger", ("distributed.comm.tls",)),
        ("tcp", ("5 s",)),
    ],
)
def test_others_are_refused_in_a_sentence(
    who: str,
    named: tuple[str, ...],
    cluster: tuple[str, str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    address = cluster[0].replace("tls:", "tcp:") if who == "tcp" else cluster[0]
    if who == "a stranger":
        certify(tmp_path / "mcsim-tls")
    with dask.config.set(merged(settings(tmp_path)) if who == "a stranger" else {}):
        code, err = mcsim_run(tmp_path / "x.zarr", address, capsys, monkeypatch)
    assert_refused((code, "", err), address, *named)
    assert not list(tmp_path.glob("x.zarr*"))
