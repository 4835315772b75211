"""Kill workers, nannies, schedulers and drivers of runs at random times; count what is lost, doubled or different.

Every store is filled by a chain of runs, each of which is hit at times drawn uniformly over its duration: with the
driver or the scheduler it ends, and the next ``resume`` continues; a worker or its nanny is replaced. The last run of a
chain is left alone. Then all arrays are compared bit for bit with those of an undisturbed run. Right before a kill the
victim writes its stack, which says what it was doing.

    python workflows/faults/campaign.py --kills 100
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import numpy as np
import psutil

# Numba and the transforms are loaded here, once: drivers are forks of this process, which itself has no threads.
from distributed.utils import get_mp_context

from mcsim import config, open_ensemble, open_summary, repair, runner, store, tasks

HERE = Path(__file__).resolve().parent
REALIZATIONS = int(os.environ.get("MCSIM_FAULTS_REALIZATIONS", "200"))
LIMIT_S = 120.0
CHAIN = 4


def configuration() -> config.RunConfig:
    """200 realizations at nside 8 in 100 chunks: most of the time goes into files, where a kill may hurt."""
    return config.load(
        {
            "schema": 1,
            "name": "faults",
            "sky": {"spectrum": "wmap7", "lmax": 16},
            "map": {"nside": 8},
            "channel": [
                {
                    "name": "W1",
                    "beam": {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 500.0, "fwhm_minor_arcmin": 400.0},
                    "scan": {"kind": "parallel_transport"},
                }
            ],
            "biposh": {"L_max": 2, "summary_bin": 5},
            "ensemble": {"realizations": REALIZATIONS, "seed": 5},
            "compute": {"workers": 2, "chunk": 2},
        }
    )


@dataclass
class Kill:
    """One kill: of whom, when after the start of the run, in which phase, and how many realizations were stored."""

    cluster: str
    victim: str
    after_s: float
    phase: str
    stored: int


@dataclass
class Tally:
    """What the campaign found."""

    kills: list[Kill] = field(default_factory=list)
    stores: int = 0
    lost: int = 0
    doubled: int = 0
    differing: int = 0
    trouble: list[str] = field(default_factory=list)


class Cluster:
    """Scheduler and two workers as people start them; parts that were killed are started again."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.file = folder, folder / "scheduler.json"
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def heal(self) -> str:
        """Start what does not run; the address of the scheduler."""
        scheduler = self.processes.get("scheduler")
        if scheduler is None or scheduler.poll() is not None:
            self.stop()
            self.file.unlink(missing_ok=True)
            self._start("scheduler", "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
            wait_for(self.file.exists)
        for name in ("node 0", "node 1"):
            if name not in self.processes or self.processes[name].poll() is not None:
                self._start(
                    name, "worker", "--nthreads", "1", "--host", "127.0.0.1", "--no-dashboard", "--memory-limit", "0"
                )
        return str(json.loads(self.file.read_text())["address"])

    def _start(self, name: str, *arguments: str) -> None:
        command = [sys.executable, "-m", "dask", *arguments, "--scheduler-file", str(self.file)]
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(command, stdout=log, stderr=log, cwd=self.folder)

    def victims(self, kind: str) -> list[int]:
        """Processes that are a scheduler, a nanny or a worker by now."""
        if kind == "scheduler":
            return [self.processes["scheduler"].pid]
        nannies = [self.processes[name].pid for name in ("node 0", "node 1")]
        return nannies if kind == "nanny" else [pid for nanny in nannies for pid in workers_of(nanny)]

    def stop(self) -> None:
        """End everything."""
        for process in self.processes.values():
            process.kill()
            process.wait()
        self.processes.clear()


def wait_for(condition: Any, seconds: float = 60.0) -> None:
    """Wait until something is so."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError("the cluster does not start")
        time.sleep(0.02)


def workers_of(parent: int) -> list[int]:
    """Worker processes of this process's drivers, or of a nanny: children of its fork server."""
    try:
        servers = [
            p for p in psutil.Process(parent).children() if "multiprocessing.forkserver" in " ".join(p.cmdline())
        ]
        return [child.pid for server in servers for child in server.children()]
    except psutil.Error:
        return []


def drive(path: Path, scheduler: str | None, answer: Path, resume: bool) -> int:
    """Start a driver as a fork of this process; its result is left in a file."""
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        sink = os.open(path.with_suffix(".noise"), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        try:
            result = runner.run(configuration(), path, resume=resume, scheduler=scheduler)
            found = {
                "computed": result.computed,
                "finished": result.finished,
                "failed": [asdict(f) for f in result.failures],
            }
        except Exception as error:
            found = {"error": f"{type(error).__name__}: {error}"}
        answer.write_text(json.dumps(found))
        code = 0
    finally:
        os._exit(code)


def phase(pid: int, traces: Path) -> str:
    """What a process is doing: from its stack, innermost line of mcsim first."""
    trace = traces / str(pid)
    before = trace.stat().st_size if trace.exists() else None
    if before is None:
        return "starting"
    os.kill(pid, signal.SIGUSR1)
    end = time.monotonic() + 0.5
    while trace.stat().st_size == before and time.monotonic() < end:
        time.sleep(0.0002)
    text = trace.read_text()[before:]
    found = {line.split(" in ")[-1] for line in text.splitlines() if "/mcsim/" in line}
    written = [line for line in text.splitlines() if "mcsim/store.py" in line and line.endswith(" in write")]
    if written:
        number = int(written[0].split("line ")[1].split()[0])
        line = Path(store.__file__).read_text().splitlines()[number - 1]
        return "between data and done, or in done" if '"done"' in line else "writing data"
    for name, meaning in (
        ("_write", "before writing"),
        ("realize", "computing"),
        ("write_summary", "writing the summary"),
        ("summarise_node", "summing"),
        ("_summarise", "waiting for sums"),
        ("create", "making the store"),
        ("mend", "verifying"),
        ("realize_chunk", "around a chunk"),
        ("_simulate", "waiting for chunks"),
        ("local_client", "starting or ending the cluster"),
        ("_remote_client", "connecting"),
    ):
        if name in found:
            return meaning
    return "idle or starting"


def stored(path: Path) -> set[int]:
    """Realizations that count as finished."""
    if not path.exists():
        return set()
    return {int(r) for r in np.flatnonzero(store.done(path))}


def chain(
    path: Path, victims: list[str], cluster: Cluster | None, traces: Path, duration: list[float], tally: Tally
) -> None:
    """Fill one store by runs that are hit, one victim each, and a last one that is not."""
    known: set[int] = set()
    for victim in [*victims, None]:
        scheduler = None if cluster is None else cluster.heal()
        before = stored(path)
        if known - before:
            tally.lost += len(known - before)
            tally.trouble.append(f"{path.name}: lost {sorted(known - before)}")
        known = before
        answer = path.with_suffix(".json")
        answer.unlink(missing_ok=True)
        driver = drive(path, scheduler, answer, resume=path.exists())
        start = time.monotonic()
        ended = False
        while victim is not None and not ended:
            moment = time.monotonic() + random.uniform(0.0, duration[-1])
            candidates: list[int] = []
            while (time.monotonic() < moment or not candidates) and not ended:
                time.sleep(0.005)
                ended = os.waitpid(driver, os.WNOHANG)[0] != 0
                if time.monotonic() - start > LIMIT_S:
                    break
                candidates = (
                    [driver] if victim == "driver" else cluster.victims(victim) if cluster else workers_of(os.getpid())
                )
            if not candidates:
                break
            if not ended:
                tally.kills.append(
                    kill(random.choice(candidates), victim, driver, time.monotonic() - start, path, cluster, traces)
                )
                if victim in ("driver", "scheduler"):
                    break
                if victim == "nanny" and cluster is not None:
                    cluster.heal()
        while not ended and time.monotonic() - start < 2 * LIMIT_S:
            time.sleep(0.01)
            ended = os.waitpid(driver, os.WNOHANG)[0] != 0
            if cluster is not None and not ended and victim != "scheduler":
                cluster.heal()  # on a busy machine a worker may have given up before it was there
        if not ended:
            tally.trouble.append(f"{path.name}: a driver did not end in {2 * LIMIT_S:g} s after a kill of the {victim}")
            os.kill(driver, signal.SIGKILL)
            os.waitpid(driver, 0)
        result = json.loads(answer.read_text()) if answer.exists() else {}
        if "computed" in result:
            again = result["computed"] - len(stored(path) - before)
            tally.doubled += max(again, 0)
            if victim is None:
                duration.append(time.monotonic() - start)
        if result.get("failed") or (victim is None and "computed" not in result):
            tally.trouble.append(f"{path.name}: after the {victim}: {result}")
        known |= stored(path)


def kill(
    chosen: int, victim: str, driver: int, after_s: float, path: Path, cluster: Cluster | None, traces: Path
) -> Kill:
    """End one process with SIGKILL, having asked it, or for a scheduler the driver, what it does."""
    doing = "gone"
    with suppress(ProcessLookupError, psutil.Error):
        doing = f"driver {phase(driver, traces)}" if victim in ("scheduler", "nanny") else phase(chosen, traces)
        os.kill(chosen, signal.SIGKILL)
    return Kill("separate" if cluster else "local", victim, after_s, doing, len(stored(path)))


def compare(path: Path, reference: Path, tally: Tally) -> None:
    """Count what a store has not, has otherwise, or counts twice."""
    with open_ensemble(path) as found, open_ensemble(reference) as expected:
        tally.lost += int((~found["done"].values).sum())
        differing = np.zeros(REALIZATIONS, dtype=bool)
        for name in expected.data_vars:
            a, b = found[name].values, expected[name].values
            differing |= (
                (np.ascontiguousarray(a).view(np.uint8) != np.ascontiguousarray(b).view(np.uint8))
                .reshape(REALIZATIONS, -1)
                .any(axis=1)
            )
        tally.differing += int(differing.sum())
    with open_summary(path) as found, open_summary(reference) as expected:
        if not found.identical(expected):
            tally.trouble.append(f"{path.name}: another summary")
        tally.doubled += max(int(found["count"]) - REALIZATIONS, 0)
    verdict = repair.verify(path)
    if not verdict.intact:
        tally.trouble.append(verdict.text())
    tally.stores += 1


def campaign(kills: int, kinds: list[str], seconds: float, seed: int, folder: Path) -> Tally:
    """All kills, spread over the kinds of cluster and victims."""
    random.seed(seed)
    traces = folder / "traces"
    traces.mkdir()
    os.environ |= {
        "MCSIM_TRACE": str(traces),
        "PYTHONPATH": os.pathsep.join([str(HERE / "hook"), str(HERE.parents[1]), os.environ.get("PYTHONPATH", "")]),
        "DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD": "forkserver",
        "NUMBA_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
    }
    sys.path.insert(0, str(HERE / "hook"))
    import sitecustomize  # (the interpreter had none of ours when it started; its forks are to have it)

    sitecustomize._folder = str(traces)
    os.register_at_fork(after_in_child=sitecustomize._register)
    import dask

    dask.config.refresh()
    # One fork server, with all loaded, makes the workers of all local clusters.
    get_mp_context().set_forkserver_preload(["distributed", "mcsim.tasks"])
    forkserver.ensure_running()
    forkserver._forkserver.ensure_running = lambda: None
    end = time.monotonic() + seconds
    tally, cluster = Tally(), Cluster(folder)
    reference = folder / "reference.zarr"
    durations: dict[str, list[float]] = {kind: [] for kind in kinds}
    kinds = [kind for kind in kinds for _ in range(2 if kind == "separate" else 1)]
    try:
        for kind in dict.fromkeys(kinds):  # the undisturbed runs; the later ones tell how long a warm one takes
            for name in (reference, folder / f"timing-{kind}.zarr"):
                shutil.rmtree(name, ignore_errors=True)
                chain(name, [], cluster if kind == "separate" else None, traces, durations[kind], tally)
            compare(folder / f"timing-{kind}.zarr", reference, tally)
        number = 0
        while len(tally.kills) < kills and time.monotonic() < end:
            kind = kinds[number % len(kinds)]
            pool = (
                ["worker", "driver"]
                if kind == "local"
                else ["worker", "driver", "scheduler", "worker", "driver", "nanny"]
            )
            victims = [random.choice(pool) for _ in range(min(CHAIN, kills - len(tally.kills)))]
            path = folder / f"store-{number}.zarr"
            chain(path, victims, cluster if kind == "separate" else None, traces, durations[kind], tally)
            compare(path, reference, tally)
            shutil.rmtree(path)
            number += 1
            print(summary(tally), flush=True)
    finally:
        cluster.stop()
    return tally


def summary(tally: Tally) -> str:
    """The campaign in a line."""
    return (
        f"{len(tally.kills)} kills, {tally.stores} stores of {REALIZATIONS} realizations: lost {tally.lost}, "
        f"doubled {tally.doubled}, differing {tally.differing}, other trouble {len(tally.trouble)}."
    )


def report(tally: Tally) -> str:
    """The campaign as a Markdown table."""
    rows = Counter((kill.cluster, kill.victim, kill.phase) for kill in tally.kills)
    lines = ["| cluster | killed | while it was | kills |", "|---|---|---|---|"]
    lines += [
        f"| {cluster} | {victim} | {doing} | {count} |" for (cluster, victim, doing), count in sorted(rows.items())
    ]
    return "\n".join(
        [
            summary(tally),
            "",
            *lines,
            *(f"\nTrouble: {text}" for text in tally.trouble),
        ]
    )


def main() -> int:
    """Run the campaign; exit code 1 if anything was lost, doubled, different, or otherwise wrong."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--clusters", nargs="+", choices=["local", "separate"], default=["local", "separate"])
    parser.add_argument("--seconds", type=float, default=1200.0, help="start no further chain after that time")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, help="write the kills as JSON")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="mcsim-faults-") as folder:
        tally = campaign(chosen.kills, chosen.clusters, chosen.seconds, chosen.seed, Path(folder))
        if tally.trouble:
            for noise in Path(folder).glob("*.noise"):
                print(noise.name, noise.read_text()[-2000:], sep="\n", file=sys.stderr)
    print(report(tally))
    if chosen.output:
        chosen.output.write_text(json.dumps(asdict(tally), indent=1) + "\n")
    return int(bool(tally.lost or tally.doubled or tally.differing or tally.trouble))


if __name__ == "__main__":
    assert tasks.ATTEMPTS  # loaded above, for the forks
    sys.exit(main())
