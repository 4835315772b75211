"""Realizations and workers that fail every time, disks that fill, kills at awkward moments: nothing is lost."""

import errno
import json
import logging
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import dask
import pytest
from distributed import Client, KilledWorker, LocalCluster
from distributed.client import ClosedClientError, FutureCancelledError, FuturesCancelledError
from distributed.comm.core import CommClosedError
from distributed.diagnostics.plugin import WorkerPlugin
from zarr.storage import _local

from mcsim import config
from mcsim.ensemble import repair, runner, store, tasks
from mcsim.ensemble.runner import batch, cluster
from mcsim.errors import RunError
from mcsim.simulation import simulate
from mcsim.support.progress import Journal
from refusals import refused

from .conftest import table
from .test_damage import truncate
from .test_runner import assert_same


@pytest.mark.parametrize("address", ["nonsense", "xyz://127.0.0.1:1"])
def test_an_address_of_no_scheduler_is_a_sentence_to_the_end_of_python(address: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mcsim", "run", "tiny", "-o", tmp_path / "x.zarr", "--scheduler", address]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 2
    assert found.stderr.splitlines()[-1].startswith("mcsim: ")
    assert "Traceback" not in found.stderr


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


@pytest.mark.parametrize("there", [True, False])
def test_a_worker_with_another_disk_is_refused_by_name(
    there: bool, small_store: Path, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A store of another seed at the same path was summarised in place of the run's, and no realization stored."""
    other = tmp_path / "node" / "x.zarr"
    if there:
        shutil.copytree(small_store, other)

    def realize_chunk(job: tasks.Job, *rest: Any) -> Any:
        return tasks.realize_chunk(replace(job, path=str(other)), *rest)

    def summarise_node(_: str, *rest: Any) -> Any:
        return tasks.summarise_node(str(other), *rest)

    monkeypatch.setattr(batch, "realize_chunk", realize_chunk)
    monkeypatch.setattr(batch, "summarise_node", summarise_node)
    run = table()
    run["ensemble"]["seed"] += 1
    with refused(socket.gethostname(), other, "-o", by=RunError):
        runner.run(run, tmp_path / "x.zarr", workers=client)
    monkeypatch.undo()
    assert runner.run(run, tmp_path / "x.zarr", workers=client).computed == len(store.done(small_store))


def test_other_packages_are_refused_by_name(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another checkout of mcsim, of the same version, is another package."""
    own = dict(tasks.packages())
    for name, other in (("numcodecs", "0.1"), ("code of mcsim", "0123456789ab")):
        monkeypatch.setattr(batch, "packages", lambda changed=own | {name: other}: tuple(changed.items()))
        with refused(socket.gethostname(), name.split()[-1], own[name], other):
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


LOSSES = (FuturesCancelledError([]), FutureCancelledError("realize_chunk-0", "scheduler-connection-lost"))


@pytest.mark.parametrize("error", [*LOSSES, ClosedClientError("closed"), CommClosedError("closed")], ids=repr)
def test_a_scheduler_that_is_lost_during_a_task_is_a_sentence(
    error: Exception, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(cluster, "wait", lost)
    with refused("scheduler", "x.zarr", by=RunError):
        runner.run(table(), tmp_path / "x.zarr", workers=client)
    with refused("scheduler", by=RunError):
        list(runner.completed(client, pow, [(2, 3)]))


@pytest.mark.parametrize("error", [OSError("Timed out trying to connect"), AttributeError("None has no ncores")])
def test_a_scheduler_that_is_lost_between_tasks_is_a_sentence(error: Exception) -> None:
    class Lost:
        def nthreads(self) -> dict[str, int]:
            raise error

    with refused("scheduler", by=RunError):
        list(runner.completed(Lost(), pow, [(2, 3)]))


def test_a_scheduler_that_is_killed_leaves_no_traceback(tmp_path: Path) -> None:
    """The client printed 32 lines of its attempt to connect again, before the sentence of the command."""
    printed: list[logging.LogRecord] = []
    listener = logging.Handler()
    listener.emit = printed.append  # type: ignore[method-assign]
    logging.getLogger("distributed.client").addHandler(listener)
    file = tmp_path / "scheduler.json"
    options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", file]
    command = [sys.executable, "-m", "dask", "scheduler", *options]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as scheduler:
        try:
            while not (file.exists() and file.stat().st_size):
                assert scheduler.poll() is None
                time.sleep(0.05)
            with cluster.connected(json.loads(file.read_text())["address"]) as client:
                scheduler.kill()
                while client.status == "running":
                    time.sleep(0.02)
                time.sleep(0.5)  # in which it tries to connect again
        finally:
            scheduler.kill()
            logging.getLogger("distributed.client").removeHandler(listener)
    assert printed == []


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
