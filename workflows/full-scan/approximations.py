"""What the default route leaves out: against samples at their own places, and the long-time limit against a year.

    python workflows/full-scan/approximations.py [--nside 128 256 512] [--seconds 1.0] [--figure offsets.png] [--limit]

First one sky through the paper's elliptical W beam and a year of the WMAP model, sample by sample, against the spin
maps without corrections, with the pixel window, with the centroids too, and with moments of the samples' offsets up to
the fourth; and with every sample moved to the centre of its pixel. With --limit w_2 of the scan's long-time limit at
nside 128 against streamed moments as well, by sampling and duration.
"""

import argparse
import os
import time
from dataclasses import replace

import healpy
import matplotlib.pyplot as plt
import numpy as np

from mcsim.instrument import beams, scan
from mcsim.instrument.scan.geometry import MapGrid
from mcsim.instrument.scan.limit import caustics
from mcsim.simulation import convolve, tod
from mcsim.simulation.observe import observe
from mcsim.sphere import rng, spectra
from mcsim.sphere.sky import gaussian_alm

THREADS = int(os.environ.get("OMP_NUM_THREADS", "2"))
CENTRED_NSIDE = 256
LIMIT_NSIDE = 128
AWAY_DEG = (2.0, 3.0)
PARTS = 16
"""Of a pixel's side, in an average over the pixel."""


def against_samples(nside: int, period_s: float) -> dict[str, float]:
    """Print the residual of the default route against the time-ordered reference, uK; return it over the effect."""
    lmax = 2 * nside + nside // 2
    model = scan.ScanModel.load("wmap").with_sampling(period_s).with_lines_of_sight("A")
    beam = beams.Beam.elliptical(13.9, 12.7, lmax=lmax, mmax=2)
    sky = gaussian_alm(spectra.load("wmap7", lmax), rng.generator(1, 0, "sky"))
    moments = scan.Moments.on_grid(model, MapGrid(nside, offset_order=4), 2, nthreads=THREADS)
    line, grid = model.line_of_sight("A"), MapGrid(nside)
    truth, hits = tod.observe(model, line, grid, [tod.sky_signal(sky, lmax, beam, nthreads=THREADS)])
    seen = hits > 0
    bare = convolve.response(beam, lmax)
    effect = convolve.noncircular_map(convolve.spin_maps(sky, bare, nside, THREADS), moments)
    unspread = convolve.circular_map(sky, bare, nside, THREADS) + effect
    whole, size = np.std(truth[seen]), np.std(effect[seen])
    print(
        f"nside {nside}, lmax {lmax}, a sample every {period_s:g} s, {np.median(hits):.0f} in a pixel: sky {whole:.1f} "
        f"uK rms, effect {size:.3f} uK"
    )
    routes = {
        "no correction": lambda: unspread,
        "window": lambda: observe(sky, beam, moments.up_to_offsets(0), pixel_window=True, nthreads=THREADS),
        "window and centroids": lambda: observe(sky, beam, moments.up_to_offsets(1), nthreads=THREADS),
        "second moments": lambda: observe(sky, beam, moments.up_to_offsets(2), nthreads=THREADS),
        "third moments": lambda: observe(sky, beam, moments.up_to_offsets(3), nthreads=THREADS),
        "fourth moments": lambda: observe(sky, beam, moments, nthreads=THREADS),
    }
    found = {}
    for name, route in routes.items():
        start = time.perf_counter()
        left = np.std((truth - route())[seen])
        found[name] = float(left / size)
        print(
            f"  {name}: {left:.3f} uK, {left / whole:.5f} of the sky, {left / size:.3f} of the effect "
            f"({time.perf_counter() - start:.2f} s)"
        )
    if nside <= CENTRED_NSIDE:
        exact = tod.sky_signal(sky, lmax, beam, epsilon=1e-11, nthreads=THREADS)
        centred, _ = tod.observe(model, line, grid, [exact], at_pixel_centres=True)
        left = np.max(np.abs((centred - unspread)[seen])) / whole
        print(f"  samples at the centres of their pixels: largest difference {left:.1e} of the sky's rms")
    return found


def against_the_limit() -> None:
    """Ring means and pixel scatter of streamed w_2 against the exact limit, by sampling and by duration."""
    model = scan.ScanModel.load("wmap").with_lines_of_sight("A")
    start = time.perf_counter()
    theta = healpy.pix2ang(LIMIT_NSIDE, np.arange(12 * LIMIT_NSIDE**2))[0]
    colatitude, rings = np.unique(np.round(theta, 10), return_inverse=True)
    exact = scan.limit_moments(model, colatitude, 2)[1][1].real
    print(f"limit at nside {LIMIT_NSIDE}: {time.perf_counter() - start:.3f} s")
    wide = over_pixels(model, rings)
    distance = np.min(np.abs(colatitude[:, None] - caustics(model)), axis=1)
    for period, years in ((3.2, 1), (0.4, 1), (0.1, 0.25), (0.1, 1), (0.1, 4), (0.0512, 1)):
        start = time.perf_counter()
        scanned = replace(model.with_sampling(period), duration_days=365.25 * years)
        moments = scan.Moments.from_model(scanned, LIMIT_NSIDE, 2, nthreads=2)
        took = time.perf_counter() - start
        w = moments.w[1].real
        mean = np.bincount(rings, moments.hits * w) / np.maximum(np.bincount(rings, moments.hits), 1)
        print(f"  {years:g} years, a sample every {period:g} s ({took:.1f} s)")
        for degrees in AWAY_DEG:
            far = distance > np.radians(degrees)
            centre, within = np.abs(mean - exact)[far], np.abs(mean - wide)[far]
            scatter = np.std((w - exact[rings])[far[rings] & (moments.hits > 0)])
            print(
                f"    {degrees:g} deg and more from the caustics: ring means differ by {rms(centre):.1e} rms, "
                f"{centre.max():.1e} at most; from the limit over the pixels {rms(within):.1e}, {within.max():.1e}; "
                f"pixels scatter by {scatter:.1e}"
            )


def over_pixels(model: scan.ScanModel, rings: np.ndarray) -> np.ndarray:
    """The limit's w_2 as samples see it that fall anywhere in the pixels of a ring, shape (rings,)."""
    fine = LIMIT_NSIDE * PARTS
    pixel = np.arange(12 * fine**2)
    colatitude, row = np.unique(np.round(healpy.pix2ang(fine, pixel, nest=True)[0], 10), return_inverse=True)
    density, w = scan.limit_moments(model, colatitude, 2)
    parent = rings[healpy.nest2ring(LIMIT_NSIDE, pixel // PARTS**2)]
    return np.bincount(parent, (density * w[1].real)[row]) / np.bincount(parent, density[row])


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def draw(found: dict[int, dict[str, float]], path: str) -> None:
    """Draw what is left over the effect of the beam's shape, by nside."""
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    for nside, left in found.items():
        axes.semilogy(list(left), list(left.values()), "o-", label=f"nside {nside}")
    axes.axhline(0.3, color="grey", ls=":", label="0.3")
    axes.set(ylabel="rms left / rms of the effect\nof the beam's shape")
    axes.tick_params(axis="x", rotation=20)
    axes.legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Print both comparisons."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nside", type=int, nargs="*", default=[128, 256, 512])
    parser.add_argument("--seconds", type=float, default=1.0, help="sampling period of the sample-by-sample maps")
    parser.add_argument("--figure", help="draw what is left to this file")
    parser.add_argument("--limit", action="store_true", help="compare the long-time limit as well")
    arguments = parser.parse_args()
    found = {nside: against_samples(nside, arguments.seconds) for nside in arguments.nside}
    if arguments.figure:
        draw(found, arguments.figure)
    if arguments.limit:
        against_the_limit()


if __name__ == "__main__":
    main()
