"""Rings with exact quadrature (``[map] grid = "gl"``) against HEALPix: binned A^20 of the same skies, and the time.

    python workflows/grids/compare.py [--lmax 512] [--realizations 16] [--repeats 6]

Parallel transport, and the long-time limit of the WMAP scan, which HEALPix takes from a file of moments. The beam is
the paper's ellipse, as wide as the multipoles allow; no noise. Times are of one thread, realizations in turn.
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mcsim import config
from mcsim.instrument import scan
from mcsim.simulation import simulate, survey

SEED = 5


def fiducial(lmax: int, grid: dict[str, object], orientation: dict[str, object], realizations: int) -> survey.Survey:
    """A survey with an elliptical beam."""
    size = 1024 / lmax
    beam = {
        "kind": "elliptical_gaussian",
        "fwhm_major_arcmin": 13.9 * size,
        "fwhm_minor_arcmin": 12.7 * size,
        "m_max": 2,
    }
    return survey.survey(
        config.load(
            {
                "schema": 1,
                "name": "grids",
                "sky": {"spectrum": "wmap7", "lmax": lmax},
                "map": grid,
                "channel": [{"name": "W1", "beam": beam, "scan": orientation}],
                "ensemble": {"realizations": realizations, "seed": SEED},
            }
        )
    )


def limit_file(nside: int, path: Path) -> Path:
    """Moments of the WMAP scan's long-time limit at the centres of pixels."""
    model = scan.ScanModel.load("wmap")
    scan.write_moments_fits(path, scan.Moments.limit(model, nside, 2))
    return path


def binned(one: survey.Survey, realizations: int) -> tuple[np.ndarray, np.ndarray]:
    """l(l+1)(-1)^l A^20_ll / sqrt(2l+1) in bins, and its paired difference, shape (realization, bin)."""
    row = [mode.name for mode in one.estimator.modes].index("L2M0d0")
    width = max(one.lmax // 20, 1)
    ell = np.arange(2, 2 + (one.lmax - 1) // width * width)
    factor = ell * (ell + 1) * (-1.0) ** ell / np.sqrt(2 * ell + 1)
    plain, control = [], []
    for realization in range(realizations):
        found = simulate.realize(one, realization)
        plain.append(factor * found["biposh"][0, row, ell].real)
        control.append(factor * found["biposh_circular"][0, row, ell].real)
    shape = (realizations, -1, width)
    together, apart = np.array(plain), np.array(plain) - np.array(control)
    return together.reshape(shape).mean(axis=-1), apart.reshape(shape).mean(axis=-1)


def seconds(surveys: Sequence[survey.Survey], repeats: int) -> list[float]:
    """Smallest time of a realization of each, taken in turn."""
    taken: list[list[float]] = [[] for _ in surveys]
    for repeat in range(repeats):
        for one, times in zip(surveys, taken, strict=True):
            start = time.perf_counter()
            simulate.realize(one, repeat)
            times.append(time.perf_counter() - start)
    return [min(times) for times in taken]


def main() -> None:
    """Print both comparisons."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lmax", type=int, default=512)
    parser.add_argument("--nside", type=int, default=None, help="of the HEALPix maps; default: lmax / 2")
    parser.add_argument("--realizations", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=6)
    arguments = parser.parse_args()
    lmax, nside, count = arguments.lmax, arguments.nside or arguments.lmax // 2, arguments.realizations
    with tempfile.TemporaryDirectory() as folder:
        limit = str(limit_file(nside, Path(folder) / "limit.fits"))
        cases: list[tuple[str, dict[str, object], dict[str, object]]] = [
            ("parallel transport", {"kind": "parallel_transport"}, {"kind": "parallel_transport"}),
            ("WMAP, long-time limit", {"kind": "moments", "path": limit}, {"kind": "hit_averaged", "model": "wmap"}),
        ]
        for title, pixels, rings in cases:
            # Moments that depend on latitude alone have no finer structure that a pixel would smooth.
            surveys = (
                fiducial(lmax, {"nside": nside, "pixel_window": "none"}, pixels, count),
                fiducial(lmax, {"grid": "gl"}, rings, count),
            )
            (first, _), (second, apart) = (binned(one, count) for one in surveys)
            gap = np.abs(first.mean(axis=0) - second.mean(axis=0))
            one, paired = second.std(axis=0, ddof=1), apart.std(axis=0, ddof=1)
            most = [(gap / error).max() for error in (one, one / np.sqrt(count), paired / np.sqrt(count))]
            times = seconds(surveys, arguments.repeats)
            print(
                f"{title}, lmax {lmax}, nside {nside}, {count} skies: mean A^20 apart by at most {most[0]:.1e} of the "
                f"error bar of one sky, {most[1]:.1e} of that of the mean, {most[2]:.1e} of that of the paired mean; "
                f"{times[0]:.3f} s against {times[1]:.3f} s, {times[0] / times[1]:.2f} times faster"
            )


if __name__ == "__main__":
    main()
