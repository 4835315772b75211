"""Time comparisons of maps that exist, and measure their memory, each in a process of its own.

    python workflows/simulators/cost.py [same|one|two|unknown|masked|noisy ...] [--nside 256] [--period 2.0]
        [--moments]

The survey is that of the packaged run "quickstart" with its beam and lmax, for nside 128, scaled to the nside: one year
of WMAP's scan, 15.8 million samples at 2 s, as single samples or, with --moments, as a run of mcsim makes its maps.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import healpy
import numpy as np

import mcsim
from mcsim import config
from mcsim.simulation import sampled, simulate
from mcsim.simulation.survey import survey

Maps = list[np.ndarray]


def run_of(nside: int, period_s: float, angle_deg: float = 0.0) -> config.RunConfig:
    """Return the run, its beam turned by an angle."""
    size = 128.0 / nside
    beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 60.0 * size, "fwhm_minor_arcmin": 50.0 * size}
    scan = {"kind": "hit_averaged", "model": "wmap", "sample_period_s": period_s}
    channel = {"name": "demo", "beam": beam | {"angle_deg": angle_deg}, "scan": scan}
    return config.load(
        {
            "schema": 1, "name": "cost", "sky": {"spectrum": "wmap7", "lmax": 2 * nside}, "ensemble": {"seed": 3},
            "map": {"nside": nside}, "channel": [channel],
        }
    )  # fmt: skip


def maps_of(run: config.RunConfig, moments: bool) -> Maps:
    """Return the maps of a run."""
    whole, nthreads = survey(run), os.cpu_count() or 1
    return list(simulate.maps(whole, 0, nthreads)) if moments else [m for _, m in sampled.maps(whole, 0, nthreads)]


def sides(kind: str, nside: int, period_s: float, moments: bool) -> tuple[Maps, Maps]:
    """Return both sides: the same to 1e-4 of the sky, a beam turned by 2 degrees, that and a factor, or a square.

    Turned as well are the beams of maps with a band of 30 % of the sky masked, and with noise of a tenth of it.
    """
    a, draw = maps_of(run_of(nside, period_s), moments), np.random.default_rng(1)
    if kind == "same":
        b = [m + 1e-4 * m[m != healpy.UNSEEN].std() * draw.standard_normal(m.size) for m in a]
    elif kind == "unknown":
        b = [m + 1e-4 * m**2 for m in a]
    else:
        b = [(1.005 if kind == "two" else 1.0) * m for m in maps_of(run_of(nside, period_s, 2.0), moments)]
    if kind == "masked":
        hole = np.abs(healpy.pix2vec(nside, np.arange(12 * nside**2))[2]) < 0.3
        a = [np.where(hole, healpy.UNSEEN, m) for m in a]
    if kind == "noisy":
        noise = 0.1 * a[0][a[0] != healpy.UNSEEN].std() * draw.standard_normal(a[0].size)
        a, b = ([np.where(m == healpy.UNSEEN, m, m + noise) for m in side] for side in (a, b))
    return a, [np.where(m == healpy.UNSEEN, m, other) for m, other in zip(a, b, strict=True)]


def compared(path: Path, run: config.RunConfig) -> str:
    """Compare maps of a file; return what was said, processor and wall seconds, and the largest memory in GB."""
    both = np.load(path)
    start, used = time.time(), time.process_time()
    (channel,) = mcsim.compare(list(both["a"]), list(both["b"]), run).channels
    wall, cpu = time.time() - start, time.process_time() - used
    said = " + ".join(f"{d.name} {d.amplitude:.4g}" for d in channel.differences) or channel.verdict
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return f"{said} | {channel.accuracy:.1e} | {cpu:.0f} | {wall:.0f} | {memory:.1f} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", default=["same", "one", "two", "unknown"])
    parser.add_argument("--nside", type=int, default=256)
    parser.add_argument("--period", type=float, default=2.0, help="of the samples, s")
    parser.add_argument("--moments", action="store_true")
    parser.add_argument("--maps", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.maps is not None:
        print(compared(given.maps, run_of(given.nside, given.period)))
        return
    print("| nside | sides | named | rms / sky | CPU s | wall s | GB |\n|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for kind in given.kinds:
            path = Path(folder) / f"{kind}.npz"
            a, b = sides(kind, given.nside, given.period, given.moments)
            np.savez(path, a=a, b=b)
            alone = [sys.executable, __file__, f"--nside={given.nside}", f"--period={given.period}", f"--maps={path}"]
            row = subprocess.run(alone, check=True, capture_output=True, text=True).stdout.strip()
            print(f"| {given.nside} | {kind} | {row}", flush=True)


if __name__ == "__main__":
    main()
