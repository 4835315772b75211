"""Kill workers, nannies, schedulers and drivers of runs at random times; count what is lost, doubled or different.

Every store is filled by a chain of runs, each of which is hit at times drawn uniformly over its duration: with the
driver or the scheduler it ends, and the next ``resume`` continues; a worker or its nanny is replaced. The last run of a
chain is left alone. Then all arrays are compared bit for bit with those of an undisturbed run. Right before a kill the
victim writes its stack, which says what it was doing. Aimed kills, counted apart, hit a worker as soon as a chunk has
all of its data and no ``done``; whether they did is seen on the disk when the worker is dead.

    python workflows/faults/campaign.py --kills 100
"""

import argparse
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from multiprocessing import forkserver
from pathlib import Path

import numpy as np
import psutil

# Numba and the transforms are loaded here, once: drivers are forks of this process, which itself has no threads.
from distributed.utils import get_mp_context
from same import difference
from separate import Cluster, workers_of

from mcsim import config
from mcsim.ensemble import repair, runner, store, tasks

HERE = Path(__file__).resolve().parent
REALIZATIONS = int(os.environ.get("MCSIM_FAULTS_REALIZATIONS", "200"))
LIMIT_S = 300.0
CHAIN, HITS = 4, 3
"""Runs of a chain that are hit, and workers that are killed in one of them: a new one takes longer than a chunk."""


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
    aimed: bool = False


@dataclass
class Tally:
    """What the campaign found."""

    kills: list[Kill] = field(default_factory=list)
    stores: int = 0
    lost: int = 0
    doubled: int = 0
    differing: int = 0
    trouble: list[str] = field(default_factory=list)


def drive(path: Path, scheduler: str | None, answer: Path, resume: bool, workers: int = 2) -> int:
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
            result = runner.run(configuration(), path, resume=resume, workers=scheduler or workers)
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
        ("remote_client", "connecting"),
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
        hits = 0
        while victim is not None and not ended and hits < HITS:
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
                hits += 1
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
    found = difference(path, reference)
    tally.lost += found["lost"]
    tally.doubled += found["doubled"]
    tally.differing += found["differing"]
    if not found["same_summary"]:
        tally.trouble.append(f"{path.name}: another summary")
    verdict = repair.verify(path)
    if not verdict.intact:
        tally.trouble.append(verdict.text())
    tally.stores += 1


def between_data_and_done(path: Path) -> set[str]:
    """Numbers of chunks whose data are all on the disk, but not their ``done``."""
    try:
        started = set(os.listdir(path / "biposh" / "c")) - set(listed_done(path))
    except FileNotFoundError:
        return set()
    files = ("biposh/c/{}/0/0/0", "biposh_circular/c/{}/0/0/0", "cl/c/{}/0/0", "cl_circular/c/{}/0/0")
    return {number for number in started if all((path / file.format(number)).exists() for file in files)}


def listed_done(path: Path) -> list[str]:
    """Numbers of chunks that have a ``done``."""
    with suppress(FileNotFoundError):
        return os.listdir(path / "done" / "c")
    return []


def aim(path: Path, count: int, tally: Tally) -> None:
    """Run with one worker, which is killed between the data of ``count`` chunks and their done."""
    hit, before = set[str](), 0
    driver = drive(path, None, path.with_suffix(".json"), resume=False, workers=1)
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, -10)  # who looks late misses; root may look first
    start, ended, workers = time.monotonic(), False, list[int]()
    while not ended and time.monotonic() - start < 4 * LIMIT_S:
        ended = os.waitpid(driver, os.WNOHANG)[0] != 0
        if len(hit) == count:
            time.sleep(0.05)
        elif not workers or not psutil.pid_exists(workers[0]):
            time.sleep(0.01)
            workers, before = workers_of(os.getpid()), len(listed_done(path))
        # A nanny that does not yet know that its worker runs would not start another: it is to have done something.
        elif len(listed_done(path)) > before and (target := between_data_and_done(path) - hit):
            with suppress(ProcessLookupError, psutil.Error):
                os.kill(workers[0], signal.SIGKILL)
                while psutil.Process(workers[0]).status() != psutil.STATUS_ZOMBIE:
                    time.sleep(0.01)
            workers.clear()
            hit |= target
            doing = "between data and done" if target & between_data_and_done(path) else "done"
            tally.kills.append(Kill("local", "worker", time.monotonic() - start, doing, len(stored(path)), aimed=True))
        else:
            time.sleep(0.001)
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, 0)
    if not ended:
        tally.trouble.append(f"{path.name}: a driver did not end in {4 * LIMIT_S:g} s after aimed kills")
        os.kill(driver, signal.SIGKILL)
        os.waitpid(driver, 0)


def campaign(kills: int, aimed: int, kinds: list[str], seconds: float, seed: int, folder: Path) -> Tally:
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
    get_mp_context().set_forkserver_preload(["distributed", "mcsim.ensemble.tasks"])
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
        if aimed:
            aim(folder / "aimed.zarr", aimed, tally)
            chain(folder / "aimed.zarr", [], None, traces, [], tally)
            compare(folder / "aimed.zarr", reference, tally)
            print(summary(tally), flush=True)
        kills += len(tally.kills)
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
    aimed = sum(kill.aimed for kill in tally.kills)
    kills = f"{len(tally.kills)} kills, " + (f"{aimed} of them aimed, " if aimed else "")
    return (
        f"{kills}{tally.stores} stores of {REALIZATIONS} realizations: lost {tally.lost}, doubled {tally.doubled}, "
        f"differing {tally.differing}, other trouble {len(tally.trouble)}."
    )


def report(tally: Tally) -> str:
    """The campaign as Markdown: what the victim was doing, or the driver where another was the victim, by victim."""
    victims = ("worker", "nanny", "driver", "scheduler")
    lines = [summary(tally)]
    for aimed in (False, True):
        counts = Counter((kill.phase, kill.victim) for kill in tally.kills if kill.aimed == aimed)
        if counts:
            title = "aimed kills" if aimed else "kills at random times"
            lines += ["", f"| {title} | {' | '.join(victims)} |", "|---|---|---|---|---|"]
            for phase in sorted({phase for phase, _ in counts}):
                lines.append(f"| {phase} | {' | '.join(str(counts[phase, victim] or '') for victim in victims)} |")
    return "\n".join([*lines, *(f"\nTrouble: {text}" for text in tally.trouble)])


def main() -> int:
    """Run the campaign; exit code 1 if anything was lost, doubled, different, or otherwise wrong."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--aimed", type=int, default=0, help="more kills, between a chunk's data and its done")
    parser.add_argument("--clusters", nargs="+", choices=["local", "separate"], default=["local", "separate"])
    parser.add_argument("--seconds", type=float, default=2400.0, help="start no further chain after that time")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, help="write the kills as JSON")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="mcsim-faults-") as folder:
        tally = campaign(chosen.kills, chosen.aimed, chosen.clusters, chosen.seconds, chosen.seed, Path(folder))
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
