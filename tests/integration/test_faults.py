"""Damage to a store, realizations and workers that fail every time, kills at awkward moments: nothing is lost."""

import asyncio
import errno
import json
import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr
from distributed import Client, KilledWorker, LocalCluster
from distributed.comm.core import CommClosedError
from distributed.diagnostics.plugin import WorkerPlugin
from zarr.core import sync
from zarr.storage import _local

from mcsim import cli, config
from mcsim.ensemble import describe, opening, repair, runner, store, tables, tasks
from mcsim.ensemble.runner import batch, cluster
from mcsim.errors import RunError
from mcsim.plot.spectra import ensemble_figure
from mcsim.simulation import simulate
from mcsim.support.progress import Journal
from refusals import refused

from .conftest import ensemble, table
from .test_runner import assert_same


@pytest.fixture
def copy(small_store: Path, tmp_path: Path) -> Path:
    path = tmp_path / "copy.zarr"
    shutil.copytree(small_store, path)
    return path


def flip(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 0x10
    file.write_bytes(bytes(data))


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-7])


def remove(file: Path) -> None:
    file.unlink()


CHUNKS = {"biposh": "c/1/0/0/0", "biposh_circular": "c/0/0/0/0", "cl": "c/1/0/0", "done": "c/1"}
LOST = {"c/1": range(4, 8), "c/0": range(4), "c/2": range(8, 10)}


@pytest.mark.parametrize("harm", [flip, truncate, remove])
@pytest.mark.parametrize("name", CHUNKS)
def test_damaged_chunk_is_named(name: str, harm: Callable[[Path], None], copy: Path) -> None:
    assert repair.verify(copy).intact
    harm(copy / name / CHUNKS[name])
    verdict = repair.verify(copy)
    if (name, harm) == ("done", remove):  # nothing but done says that a realization exists
        assert (verdict.finished, verdict.intact) == (6, True)
        return
    lost = LOST[CHUNKS[name][:3]]
    assert verdict.lost == tuple(lost)
    assert verdict.finished == 10 - len(lost)
    assert f"realizations {lost[0]}-{lost[-1]}: " in verdict.text()


def test_resume_computes_what_is_damaged_and_no_more(small_store: Path, client: Client, copy: Path) -> None:
    flip(copy / "biposh" / "c/2/0/0/0")  # in the last, incomplete chunk
    truncate(copy / "done" / "c/0")
    (copy / "cl" / "c/1/0/0.0123.partial").write_bytes(b"half a file")
    result = runner.run(table(), copy, resume=True, workers=client)
    assert (result.finished, result.computed) == (10, 6)
    assert_same(copy, small_store)
    assert {file.relative_to(copy) for file in copy.rglob("*")} == {
        file.relative_to(small_store) for file in small_store.rglob("*")
    }
    log = copy.with_name("copy.zarr.log").read_text()
    assert "damaged, to be computed again: realizations 8-9 (biposh: " in log
    assert "damaged, to be computed again: realizations 0-3 (done: " in log


PARTS = ["biposh/zarr.json", "L/c/0", "mode/c/0", "realization/zarr.json", "summary/count/c", "summary/cl_mean/c/0/0"]


@pytest.mark.parametrize("harm", [truncate, remove])
def test_metadata_coordinates_and_summary_are_made_again(
    harm: Callable[[Path], None], small_store: Path, client: Client, copy: Path
) -> None:
    for part in PARTS:
        harm(copy / part)
    verdict = repair.verify(copy)
    assert not verdict.intact
    assert verdict.broken.keys() >= {"biposh", "L", "mode", "realization"}
    assert any(name.startswith("summary") for name in verdict.broken)
    result = runner.run(table(), copy, resume=True, workers=client)
    assert result.computed == 0
    assert_same(copy, small_store)
    assert repair.verify(copy).intact


@pytest.mark.parametrize("part", ["biposh/c/1", "cl", "ell/c/0", "summary/cl_mean"])
def test_a_finished_store_that_lacks_files_is_not_finished(part: str, copy: Path) -> None:
    assert runner.run(table(), copy).computed == 0
    (shutil.rmtree if (copy / part).is_dir() else os.remove)(copy / part)
    with refused(part, "--resume", by=RunError):
        runner.run(table(), copy)


BINNED = "summary/biposh_difference_binned_mean/c/0/0/0"
READERS = {
    "summary": lambda path: opening.open_summary(path),
    "info": lambda path: describe.describe(path),
    "export": lambda path: tables.table(opening.read_in(opening.open_summary(path), path)),
    "plot": lambda path: ensemble_figure(path),
}


@pytest.mark.parametrize("reader", READERS)
def test_a_summary_that_lacks_files_is_not_read_as_zeros(reader: str, copy: Path) -> None:
    READERS[reader](copy)
    remove(copy / BINNED)
    with refused(BINNED, "--resume", by=RunError):
        READERS[reader](copy)
    assert opening.open_ensemble(copy).done.all()  # the realizations are there


@pytest.mark.parametrize("reader", ["info", "export", "plot"])
def test_a_damaged_summary_is_a_sentence(reader: str, copy: Path) -> None:
    flip(copy / BINNED)
    with refused(copy, "--verify", "--resume", by=RunError):
        READERS[reader](copy)


@pytest.mark.parametrize("part", ["biposh/c/1/0/0/0", "cl/c/0/0/0", "ell/c/0"])
def test_finished_realizations_that_lack_files_are_not_opened_as_nan(part: str, copy: Path) -> None:
    remove(copy / part)
    with refused(part, "--resume", by=RunError):
        opening.open_ensemble(copy)
    assert int(opening.open_summary(copy)["count"]) == 10


def test_absent_numbers_of_a_summary_are_none(copy: Path) -> None:
    """Whoever opens a store without mcsim."""
    for part in ("biposh_mean/c/0/0/0", "cl_mean/c/0/0", "count/c"):
        remove(copy / "summary" / part)
    with xr.open_zarr(copy, group="summary") as found:
        assert np.isnan(found["biposh_mean"].values).all()
        assert np.isnan(found["cl_mean"].values).all()
        assert int(found["count"]) < 0


def test_every_piece_of_a_large_summary_is_missed(copy: Path) -> None:
    """Zarr cuts large arrays along all their dimensions."""
    large = np.ones((2, 1500, 1500))
    store.write_summary(copy, xr.Dataset({"large": (("pair", "mode", "bin"), large)}))
    assert store.absent_files(copy) == []
    remove(copy / "summary/large/c/1/2/1")
    assert store.absent_files(copy) == ["summary/large/c/1/2/1"]


def test_a_read_that_fails_leaves_none_behind(copy: Path) -> None:
    """Zarr begins many reads at once; one that is left complains when Python ends."""
    layout = replace(opening.layout(copy, 256), chunk=1)
    many = copy.with_name("many.zarr")
    store.create(many, layout, store.attributes(copy))
    store.write(many, 0, {}, np.ones(256, dtype=bool))
    truncate(many / "done/c/0")
    with refused(many, "--resume", by=RunError):
        store.done(many)
    assert asyncio.all_tasks(sync._get_loop()) == set()


@pytest.mark.parametrize("address", ["nonsense", "xyz://127.0.0.1:1"])
def test_an_address_of_no_scheduler_is_a_sentence_to_the_end_of_python(address: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mcsim", "run", "tiny", "-o", tmp_path / "x.zarr", "--scheduler", address]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 2
    assert found.stderr.splitlines()[-1].startswith("mcsim: ")
    assert "Traceback" not in found.stderr


@pytest.mark.parametrize("harm", [truncate, remove, lambda file: file.write_text(file.read_text().replace("sci", "x"))])
def test_attributes_of_a_store_are_made_again(
    harm: Callable[[Path], None], small_store: Path, client: Client, copy: Path
) -> None:
    harm(copy / "zarr.json")
    truncate(copy / "cl/c/1/0/0")
    for look in (describe.describe, repair.verify, lambda path: runner.run(table(), path)):
        with refused("zarr.json", copy, "--resume", by=RunError):
            look(copy)
    for other in (table(ensemble={"realizations": 10, "seed": 8}), table(**ensemble(10, keep_maps=True))):
        with refused(copy):
            runner.run(other, copy, resume=True, workers=client)
    result = runner.run(table(), copy, resume=True, workers=client)
    assert (result.finished, result.computed) == (10, 4)
    assert_same(copy, small_store)
    assert repair.verify(copy).intact
    assert store.attributes(copy) == store.attributes(small_store)


def test_hash_that_is_not_that_of_the_configuration_is_named(small_store: Path, client: Client, copy: Path) -> None:
    root = json.loads((copy / "zarr.json").read_text())
    root["attributes"]["digest"] = "0" * 64
    (copy / "zarr.json").write_text(json.dumps(root))
    assert "attributes" in repair.verify(copy).broken
    runner.run(table(), copy, resume=True, workers=client)
    assert_same(copy, small_store)


def test_every_bit_counts(copy: Path) -> None:
    """Whichever bit of a file is flipped, its realizations are named, or its contents are what they were."""
    file = copy / "done" / "c/1"
    data = file.read_bytes()
    named = 0
    for bit in range(8 * len(data)):
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        file.write_bytes(bytes(changed))
        damage = store.examine(copy, 4)
        if damage is None:
            assert store.done(copy).all(), bit
        else:
            assert damage.lost == (4, 5, 6, 7)
            named += 1
    assert named > 7 * len(data)


def test_rows_that_are_missing_are_never_summed(client: Client, copy: Path) -> None:
    """A done that says more than there is, as two writers at once could leave it."""
    (copy / "biposh" / "c/1/0/0/0").unlink()
    shutil.rmtree(copy / "summary")
    with refused("copy.zarr", "4-7", "--resume", by=RunError):
        runner.run(table(), copy, workers=client)
    assert runner.run(table(), copy, resume=True, workers=client).computed == 4


def test_verify_on_the_command_line(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def verify() -> int:
        with pytest.raises(SystemExit) as end:
            cli.app(["info", "--verify", str(copy)])
        return int(end.value.code or 0)

    assert verify() == 0
    assert "copy.zarr is intact: 10 of 10 realizations" in capsys.readouterr().out
    flip(copy / "cl" / "c/1/0/0")
    assert verify() == 1
    assert "realizations 4-7: cl: " in capsys.readouterr().out


def test_attempts_are_bounded_and_the_others_finish(
    small_store: Path, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, attempts = simulate.realize, dict.fromkeys(range(10), 0)

    def realize(shared: Any, r: int) -> Any:
        attempts[r] += 1
        if r == 4 or (r == 6 and attempts[r] < tasks.ATTEMPTS):
            raise MemoryError("no room\nfor it")
        return real(shared, r)

    monkeypatch.setattr(simulate, "realize", realize)
    result = runner.run(table(), tmp_path / "x.zarr", workers=client)
    assert [(f.realization, f.reason) for f in result.failures] == [(4, "MemoryError: no room for it")]
    assert (attempts[4], attempts[6], attempts[5]) == (tasks.ATTEMPTS, tasks.ATTEMPTS, 1)
    assert result.finished == 9
    monkeypatch.undo()
    runner.run(table(), tmp_path / "x.zarr", workers=client)
    assert_same(tmp_path / "x.zarr", small_store)


def test_a_task_given_up_for_lost_does_not_undo_another(
    small_store: Path, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker that was cut off comes back, having computed part of a chunk that another has finished since."""
    (copy / "done" / "c/1").unlink()
    run = config.load(table())
    real = simulate.realize

    def realize(shared: Any, r: int) -> Any:
        shutil.copy(small_store / "done" / "c/1", copy / "done" / "c/1")
        return real(shared, r)

    monkeypatch.setattr(simulate, "realize", realize)
    job = tasks.Job(config.to_json(run), config.digest(run), str(copy), 4, 4, 6, tasks.packages())
    assert tasks.realize_chunk(job, 4) == (2, [])
    assert_same(copy, small_store)


def test_other_packages_are_refused_by_name(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch, "packages", lambda: (*tasks.packages()[:-1], ("numcodecs", "0.1")))
    with refused(socket.gethostname(), "numcodecs", version("numcodecs"), 0.1):
        runner.run(table(), tmp_path / "x.zarr", workers=client)


def test_completed_gives_every_result_once(client: Client) -> None:
    calls = ((n, 2) for n in range(30))
    assert dict(runner.completed(client, pow, calls)) == {n: n**2 for n in range(30)}


def test_a_cluster_without_workers_is_not_waited_for_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    class Deserted:
        cluster, dashboard_link, as_current = None, "", staticmethod(nullcontext)

        def nthreads(self) -> dict[str, int]:
            return {}

        def submit(self, *call: Any, key: str) -> object:
            return object()

    def nothing(*asked: Any, **options: Any) -> None:
        raise TimeoutError

    monkeypatch.setattr(cluster, "wait", nothing)
    client = Deserted()
    with refused("300 s", by=RunError):
        list(runner.completed(client, pow, [(2, 2)]))


def test_workers_that_join_and_leave_are_logged(tmp_path: Path) -> None:
    class Changing:
        cluster, dashboard_link, as_current = None, "", staticmethod(nullcontext)

        def nthreads(self) -> dict[str, int]:
            return dict.fromkeys(rounds.pop(0), 2)

    rounds: list[list[str]] = [["a"], ["a"], ["a", *"fgbhc"], ["b"], [], ["c"]]
    roll = cluster.Roll(Changing(), Journal(tmp_path / "x.zarr"))
    assert roll.text() == "1 worker with 2 threads"
    assert [roll.call() for _ in range(5)] == [2, 12, 2, 0, 2]
    lines = [line.split(" ", 3)[-1] for line in (tmp_path / "x.zarr.log").read_text().splitlines()]
    assert lines == [
        "workers b, c, f, g, 1 more joined; 6 workers now",
        "workers a, c, f, g, 1 more left; 1 worker now",
        "worker b left; 0 workers now",
        "worker c joined; 1 worker now",
    ]
    assert roll.text() == "1 worker with 2 threads"


def test_worker_that_no_nanny_starts_again_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "TURN_S", 0.2)
    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": "100ms"}),
        LocalCluster(n_workers=1, processes=False, dashboard_address="127.0.0.1:0") as own,
        Client(own) as connected,
    ):
        own.sync(own.workers[0].close)
        assert dict(runner.completed(connected, pow, [(2, 3), (2, 4)])) == {0: 8, 1: 16}


def test_worker_that_leaves_while_it_is_asked_for_its_packages_is_no_foreign_one() -> None:
    class Leaving:
        def run(self, *_: Any, on_error: str) -> dict[str, Any]:
            return {"tcp://a": CommClosedError("closed"), "tcp://b": answer}

    answer: Any = tasks.packages()
    cluster._check_workers(Leaving())
    answer = ModuleNotFoundError("No module named 'mcsim'")
    with refused("tcp://b", "ModuleNotFoundError"):
        cluster._check_workers(Leaving())


@pytest.mark.parametrize("error", [RuntimeError("Nanny"), TimeoutError(7)])
def test_workers_that_do_not_start_are_a_sentence(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def late(**_: Any) -> None:
        raise error

    monkeypatch.setattr(cluster, "LocalCluster", late)
    with refused(type(error).__name__, str(error), by=RunError):
        runner.run(table(), tmp_path / "x.zarr")
    assert not (tmp_path / "x.zarr").exists()
    assert not (tmp_path / "x.zarr.lock").exists()


def test_summary_whose_workers_die_is_a_sentence(
    small_store: Path, copy: Path, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Last:
        address = "tcp://10.0.0.7:1"

    def dying(*_: Any) -> None:
        raise KilledWorker("summarise_node-0", Last(), 2)

    shutil.rmtree(copy / "summary")
    monkeypatch.setattr(batch, "summarise_node", dying)
    with refused("3 workers", "tcp://10.0.0.7:1", "copy.zarr", by=RunError):
        runner.run(table(), copy, workers=client)
    monkeypatch.undo()
    runner.run(table(), copy, workers=client)
    assert_same(copy, small_store)


@pytest.mark.parametrize("status", ["pending", "error"])
def test_result_that_is_lost_with_its_worker_is_waited_for_in_turns(
    status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker dies between the end of a call and the journey of its result; or the call itself gave up waiting."""

    class Lost:
        def result(self, timeout: float) -> int:
            if turns.pop():
                raise TimeoutError("late")
            return 8

    class Alone:
        cluster, dashboard_link, as_current = None, "", staticmethod(nullcontext)

        def nthreads(self) -> dict[str, int]:
            return {"a": 1}

        def submit(self, *call: Any, key: str) -> Lost:
            return future

    future, turns = Lost(), [False, True, True]
    future.status = status
    monkeypatch.setattr(cluster, "wait", lambda *asked, **options: ({future}, set()))
    if status == "error":
        with refused("late", by=TimeoutError):
            list(runner.completed(Alone(), pow, [(2, 3)]))
    else:
        assert list(runner.completed(Alone(), pow, [(2, 3)])) == [(0, 8)]
        assert turns == []


def test_error_of_a_call_is_raised(client: Client) -> None:
    with pytest.raises(ZeroDivisionError):
        list(runner.completed(client, divmod, [(1, 0)]))


def test_what_can_be_called_need_not_be_a_function(client: Client) -> None:
    assert list(runner.completed(client, partial(divmod, 7), [(2,)])) == [(0, (3, 1))]


def test_sentence_of_a_call_stays_one_where_its_cause_cannot_be_unpickled(client: Client, tmp_path: Path) -> None:
    with refused(tmp_path, "GroupNotFoundError", "--resume", by=RunError):
        list(runner.completed(client, store.done, [(tmp_path,)]))  # an empty folder


def test_interrupted_slices_are_verified_by_what_they_hold(client: Client, tmp_path: Path) -> None:
    path = tmp_path / "slice.zarr"
    runner.run(table(), path, realizations=slice(0, 5), workers=client)
    verdict = repair.verify(path)
    assert (verdict.finished, verdict.size, verdict.intact) == (5, 10, True)


def test_second_half_of_an_extension_is_repaired(
    small_store: Path, short_store: Path, client: Client, tmp_path: Path
) -> None:
    path = Path(shutil.copytree(short_store, tmp_path / "x.zarr"))
    truncate(path / "L" / "c/0")
    runner.run(table(), path, resume=True, workers=client)
    assert_same(path, small_store)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_disk_that_takes_no_more_stops_in_a_sentence_and_goes_on(
    number: int, small_store: Path, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x.zarr"
    written = []
    real = store.write

    def write(*arguments: Any) -> None:
        if written:
            monkeypatch.setattr(_local, "_put", full)
        written.append(1)
        real(*arguments)

    def full(*_: Any, **__: Any) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(store, "write", write)
    with refused("x.zarr", "--resume", by=RunError, errno=number):
        runner.run(table(), path, workers=client)
    monkeypatch.undo()
    assert not (tmp_path / "x.zarr.lock").exists()
    assert runner.run(table(), path, resume=True, workers=client).finished == 10
    assert_same(path, small_store)


def test_store_that_is_deleted_during_the_run(
    small_store: Path, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x.zarr"
    real = simulate.realize

    def realize(shared: Any, r: int) -> Any:
        if r == 5:
            path.rename(tmp_path / "gone.zarr")
        return real(shared, r)

    monkeypatch.setattr(simulate, "realize", realize)
    with refused("x.zarr", "--resume", by=RunError):
        runner.run(table(), path, workers=client)
    monkeypatch.undo()
    shutil.rmtree(path, ignore_errors=True)
    runner.run(table(), path, workers=client)
    assert_same(path, small_store)


def test_worker_that_dies_every_time_costs_its_realization_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "ATTEMPTS", 2)  # a new worker takes time
    path = tmp_path / "x.zarr"

    class Poison(WorkerPlugin):
        def setup(self, worker: Any) -> None:
            from mcsim.simulation import simulate

            real = simulate.realize

            def realize(shared: Any, r: int) -> Any:
                if r == 5:
                    os._exit(1)
                return real(shared, r)

            simulate.realize = realize

    with runner.local_client(2) as processes:
        processes.register_plugin(Poison())
        result = runner.run(table(), path, workers=processes)
    (failure,) = result.failures
    assert failure.realization == 5
    death = r"each of the 2 workers that computed it died, the last of them tcp://127\.0\.0\.1:\d+ \(out of memory\?\)"
    assert re.fullmatch(death, failure.reason)
    assert result.finished == 9
    log = path.with_name("x.zarr.log").read_text()
    assert re.search(f" tried again, one by one: realizations 4-7, for {death}\n", log)
    assert re.search(f" failed: realization 5: {death}\n", log)
    assert re.search(r" workers? tcp://127\.0\.0\.1:\d+.* left; [012] workers? now\n", log)
    assert re.search(r" workers? tcp://127\.0\.0\.1:\d+.* joined; [12] workers? now\n", log)
    assert log.count(" 1 failed (realization 5)\n") == 1


def test_kills_lose_nothing() -> None:
    """The fault campaign in short, of a worker and two drivers; workflows/faults has the long one."""
    script = Path(__file__).parents[2] / "workflows" / "faults" / "campaign.py"
    command = [sys.executable, script, "--kills", "3", "--clusters", "local", "--seed", "6"]
    environment = os.environ | {"MCSIM_FAULTS_REALIZATIONS": "16"}
    found = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert found.returncode == 0, found.stdout + found.stderr
    # A worker may be hit up to three times.
    assert int(re.findall(r"^(\d+) kills, ", found.stdout, re.MULTILINE)[-1]) >= 3, found.stdout
    assert "lost 0, doubled 0, differing 0, other trouble 0." in found.stdout
