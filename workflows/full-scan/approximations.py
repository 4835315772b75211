"""What the default route leaves out: against samples at their own places, and the long-time limit against a year.

    python workflows/full-scan/approximations.py [--nside 256] [--seconds 1.0]

First one sky through the paper's elliptical W beam and a year of the WMAP model, sample by sample, against the spin
maps without corrections, with the pixel window, and with the centroids too; and with every sample moved to the centre
of its pixel. Then w_2 of the scan's long-time limit at nside 128 against streamed moments at three sampling periods.
"""

import argparse
import time

import healpy
import numpy as np

from mcsim import beams, convolve, healpix, resources, rng, scan, spectra, tod
from mcsim.scan.limit import caustics
from mcsim.sky import gaussian_alm

LIMIT_NSIDE = 128
PERIODS_S = (3.2, 0.4, 0.1, 0.0512)
CAUSTIC_DEG = 2.0


def against_samples(nside: int, period_s: float) -> None:
    """Residual of the default route against the referee, uK."""
    lmax = 2 * nside + nside // 2
    model = scan.load_model(resources.scan_model("wmap")).with_sampling(period_s)
    beam = beams.elliptical_gaussian(13.9, 12.7, 0.0, lmax, 2)
    sky = gaussian_alm(spectra.load("wmap7", lmax), rng.generator(1, 0, "sky"))
    moments = scan.stream_moments(model, nside, 2, lines_of_sight=["A"], nthreads=2)
    truth, hits = tod.observe(sky, lmax, beam, model, nside, line_of_sight="A", nthreads=2)
    centred, _ = tod.observe(
        sky, lmax, beam, model, nside, line_of_sight="A", at_pixel_centres=True, nthreads=2, epsilon=1e-11
    )
    seen = hits > 0

    def route(window: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        response = convolve.response(beam, lmax, window)
        effect = convolve.noncircular_map(convolve.spin_maps(sky, response, nside, 2), moments)
        gradient = healpix.gradient(convolve.circular_alm(sky, response), nside, lmax, 2)
        return convolve.circular_map(sky, response, nside, 2) + effect, effect, convolve.centroid_map(gradient, moments)

    bare, effect, _ = route(None)
    windowed, _, centroid = route(healpix.pixel_window(nside, lmax))
    whole, size = np.std(truth[seen]), np.std(effect[seen])
    print(f"nside {nside}, lmax {lmax}, a sample every {period_s:g} s: sky {whole:.1f} uK rms, effect {size:.3f} uK")
    for name, map_uk in (("no correction", bare), ("window", windowed), ("window and centroids", windowed + centroid)):
        left = np.std((truth - map_uk)[seen])
        print(f"  {name}: {left:.3f} uK, {left / whole:.4f} of the sky, {left / size:.3f} of the effect")
    left = np.max(np.abs((centred - bare)[seen])) / whole
    print(f"  samples at the centres of their pixels: largest difference {left:.1e} of the sky's rms")


def against_the_limit() -> None:
    """Ring means and pixel scatter of streamed w_2 against the exact limit."""
    model = scan.load_model(resources.scan_model("wmap"))
    start = time.perf_counter()
    theta = healpy.pix2ang(LIMIT_NSIDE, np.arange(12 * LIMIT_NSIDE**2))[0]
    colatitude, rings = np.unique(np.round(theta, 10), return_inverse=True)
    exact = scan.limit_moments(model, colatitude, 2, "A")[1][1].real
    took = time.perf_counter() - start
    turns = caustics(model, "A")
    far = np.min(np.abs(colatitude[:, None] - turns), axis=1) > np.radians(CAUSTIC_DEG)
    print(f"limit at nside {LIMIT_NSIDE}: {took:.3f} s")
    for period in PERIODS_S:
        start = time.perf_counter()
        year = scan.stream_moments(model.with_sampling(period), LIMIT_NSIDE, 2, lines_of_sight=["A"], nthreads=2)
        took = time.perf_counter() - start
        mean = np.bincount(rings, year.hits * year.w[1].real) / np.bincount(rings, year.hits)
        apart = np.abs(mean - exact)[far]
        scatter = np.std((year.w[1].real - exact[rings])[far[rings]])
        print(
            f"  a sample every {period:g} s ({took:.1f} s): ring means differ by {np.sqrt(np.mean(apart**2)):.1e} rms, "
            f"{apart.max():.1e} at most; pixels by {scatter:.1e} rms"
        )


def main() -> None:
    """Print both comparisons."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nside", type=int, default=256)
    parser.add_argument("--seconds", type=float, default=1.0, help="sampling period of the sample-by-sample maps")
    arguments = parser.parse_args()
    against_samples(arguments.nside, arguments.seconds)
    against_the_limit()


if __name__ == "__main__":
    main()
