"""Run a large ensemble and watch it: memory of driver, scheduler and workers, files of the store, over time.

    python workflows/scale/run.py --realizations 100000 --nside 16 --workers 2
    python workflows/scale/run.py --realizations 1000 --nside 256 --workers 2

Scheduler, workers and driver are separate processes, so that each has a memory of its own. A line of JSON per run is
appended to --output, a picture goes to --picture.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import matplotlib
import psutil

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def configuration(realizations: int, nside: int) -> str:
    """One channel, paired, lmax = 2 nside, L <= 2."""
    fwhm = 6000.0 / nside
    return f"""schema = 1
name = "scale-{nside}"
[sky]
spectrum = "wmap7"
lmax = {2 * nside}
[map]
nside = {nside}
[[channel]]
name = "W1"
beam = {{ kind = "elliptical_gaussian", fwhm_major_arcmin = {fwhm}, fwhm_minor_arcmin = {0.85 * fwhm} }}
scan = {{ kind = "parallel_transport" }}
[biposh]
L_max = 2
[ensemble]
realizations = {realizations}
seed = 1
"""


def files_of(store: Path) -> int:
    """Number of files, which a run may be writing meanwhile."""
    return sum(len(names) for _, _, names in os.walk(store))


def resident(process: psutil.Process) -> float:
    """Memory in MB; workers are the children of their nannies."""
    try:
        return process.memory_info().rss / 1e6
    except psutil.Error:
        return 0.0


def start(folder: Path, workers: int) -> tuple[list[subprocess.Popen[bytes]], str]:
    """Scheduler and workers by the ordinary commands."""
    file = folder / "scheduler.json"
    single = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "DUCC0", "NUMBA")}
    single |= {"MALLOC_TRIM_THRESHOLD_": "65536"}  # as a nanny sets it: freed memory goes back

    def launch(*arguments: str) -> subprocess.Popen[bytes]:
        with (folder / f"{arguments[0]}.log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "dask", *arguments, "--scheduler-file", str(file)],
                env=os.environ | single, stdout=log, stderr=log, cwd=folder,
            )  # fmt: skip

    parts = [launch("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")]
    while not file.exists():
        time.sleep(0.05)
    for _ in range(workers):
        parts.append(launch("worker", "--nthreads", "1", "--memory-limit", "0", "--no-dashboard", "--no-nanny"))
    return parts, json.loads(file.read_text())["address"]


def watch(realizations: int, nside: int, workers: int, every_s: float, folder: Path) -> dict[str, Any]:
    """Run, and sample once in a while."""
    config, store = folder / "scale.toml", folder / "scale.zarr"
    config.write_text(configuration(realizations, nside))
    parts, address = start(folder, workers)
    samples: list[dict[str, Any]] = []
    try:
        begin = time.monotonic()
        driver = subprocess.Popen(
            [sys.executable, "-m", "mcsim.cli", "run", str(config), "-o", str(store), "--scheduler", address]
        )
        watched = [psutil.Process(p.pid) for p in (driver, *parts)]
        while driver.poll() is None:
            driver_mb, scheduler_mb, *worker_mb = [resident(process) for process in watched]
            sample = {"driver_mb": driver_mb, "scheduler_mb": scheduler_mb, "worker_mb": worker_mb}
            samples.append({"s": time.monotonic() - begin, "files": files_of(store), **sample})
            time.sleep(every_s)
        seconds = time.monotonic() - begin
    finally:
        for part in parts:
            part.kill()
            part.wait()
    code = (
        "import time; t = time.perf_counter(); import mcsim; "
        f"d = mcsim.open_ensemble({str(store)!r}); float(d.cl[-1, 0, 2]); print(time.perf_counter() - t)"
    )
    opened = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    size = sum(file.stat().st_size for file in store.rglob("*") if file.is_file())
    return {
        "realizations": realizations,
        "nside": nside,
        "workers": workers,
        "exit": driver.returncode,
        "seconds": seconds,
        "files": files_of(store),
        "bytes": size,
        "open_s": float(opened.stdout),
        "load": os.getloadavg()[1],
        "samples": samples,
    }


def draw(run: dict[str, Any], path: Path) -> None:
    """Memory and files over time."""
    figure, (above, below) = plt.subplots(2, 1, figsize=(7, 5), sharex=True, layout="constrained")
    time_s = [sample["s"] for sample in run["samples"]]
    for name, label in (("driver_mb", "driver"), ("scheduler_mb", "scheduler")):
        above.plot(time_s, [sample[name] for sample in run["samples"]], label=label)
    for number in range(run["workers"]):
        values = [sample["worker_mb"][number] for sample in run["samples"]]
        above.plot(time_s, values, label=f"worker {number}", ls="--")
    above.set(ylabel="resident memory [MB]", ylim=(0, None))
    above.legend(frameon=False, ncols=4)
    below.plot(time_s, [sample["files"] for sample in run["samples"]], color="k")
    below.set(xlabel="time [s]", ylabel="files in the store", ylim=(0, None))
    above.set_title(f"{run['realizations']:,} realizations, nside {run['nside']}, {run['workers']} workers")
    figure.savefig(path, dpi=110)


def main() -> None:
    """One run, its figures and its picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--realizations", type=int, default=100_000)
    parser.add_argument("--nside", type=int, default=16)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--every", type=float, default=1.0, help="seconds between samples")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--output", type=Path)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="mcsim-scale-") as folder:
        run = watch(chosen.realizations, chosen.nside, chosen.workers, chosen.every, Path(folder))
    if chosen.picture:
        draw(run, chosen.picture)
    half = run["samples"][len(run["samples"]) // 2 :]
    late = {name: [round(f([s[name] for s in half])) for f in (min, max)] for name in ("driver_mb", "scheduler_mb")}
    worker = [round(f(max(s["worker_mb"]) for s in half)) for f in (min, max)]
    print(json.dumps({key: value for key, value in run.items() if key != "samples"}))
    print("second half of the run, least and most MB:", json.dumps(late | {"largest_worker": worker}))
    if chosen.output:
        with chosen.output.open("a") as stream:
            stream.write(json.dumps(run) + "\n")


if __name__ == "__main__":
    main()
