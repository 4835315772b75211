"""Does the noise of the real W-band map agree with sigma0^2 / N_OBS?

    python workflows/nobs/noise.py -o noise.png -j noise.json

MCSIM_DATA names a folder with
    wmap_maps/wmap_band_iqumap_r9_7yr_W_v4_first26264pix.fits
        PIXEL (NESTED, nside 512, Galactic), TEMPERATURE [mK] and N_OBS of pixels 0 to 26263 of the seven-year W-band
        map wmap_band_iqumap_r9_7yr_W_v4.fits; public: https://lambda.gsfc.nasa.gov/product/wmap/dr4/skymap_info.html
    wmap_maps/wmap_temperature_analysis_mask_r9_7yr_v4_udgraded32.fits
        the mask KQ85 of the same release at nside 32, from the tests of healpy
    wmap7_beams/wmap_hybrid_beam_W1_A_7yr_v4.fits.gz
        side A of the beam map of W1; public: https://lambda.gsfc.nasa.gov/product/wmap/dr4/beam_maps_get.html

Two estimates of sigma0, both also of simulated patches. The first knows nothing of the sky: of every 2 x 2 pixels
the combination t1 - t2 - t3 + t4, which no gradient enters, over its noise per unit of sigma0. The second is the most
likely sigma0 of blocks of 8 x 8 pixels, of covariance (CMB through beam and pixel) + sigma0^2 / N_OBS, after what a
quadratic surface can fit is taken out of every block (Galactic emission).
"""

import argparse
import json
import os
from itertools import pairwise
from pathlib import Path

import healpy
import numpy as np
from matplotlib.figure import Figure
from scipy.linalg import eigh
from scipy.optimize import brentq

from mcsim import config
from mcsim.instrument.beams import Beam
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.sphere import healpix, map_files, spectra
from mcsim.sphere.mask import read_mask

NSIDE, BLOCK = 512, 64
PIXELS = 26264 // BLOCK * BLOCK
PUBLISHED_UK = 6549.0
"""Of the W-band map of seven years, by LAMBDA's table."""
ASKED_UK = 6500.0
LMAX = 1500
LATITUDES = (0.0, 2.0, 5.0, 10.0, 15.0, 20.0, 25.0)
SADDLE = np.array([1.0, -1.0, -1.0, 1.0])


def data_file(name: str) -> Path:
    """A file of the folder that MCSIM_DATA names."""
    folder = os.environ.get("MCSIM_DATA")
    if folder is None:
        raise SystemExit("MCSIM_DATA is not set; let it name the folder that this script's first lines describe.")
    return Path(folder) / name


def correlation(window: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles across a block, and the correlation of the CMB through a window there, uK^2."""
    cl = spectra.load("wmap7", window.size - 1)
    angle = np.linspace(0.0, np.deg2rad(2.0), 2001)
    ell = np.arange(window.size)
    weight = (2 * ell + 1) / (4 * np.pi) * cl * window**2
    return angle, np.polynomial.legendre.legval(np.cos(angle), weight)


def modes(first: int, t: np.ndarray, n_obs: np.ndarray, xi: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Independent modes of a block and the variance of the CMB in them, (2, mode), in units of noise per observation.

    Their variances are that of the CMB plus sigma0^2.
    """
    vectors = np.stack(healpy.pix2vec(NSIDE, np.arange(first, first + BLOCK), nest=True), axis=1)
    centre = vectors.mean(axis=0)
    axes = np.linalg.svd(centre[None])[2][1:]
    x, y = axes @ (vectors - centre).T / 0.01
    surface = np.stack([np.ones(BLOCK), x, y, x * x, x * y, y * y], axis=1)
    rest = np.linalg.svd(surface)[0][:, surface.shape[1] :]
    angle = 2.0 * np.arcsin(np.clip(np.linalg.norm(vectors[:, None] - vectors, axis=2) / 2.0, 0.0, 1.0))
    sky = rest.T @ np.interp(angle, *xi) @ rest
    variance, basis = eigh(sky, rest.T @ (rest / n_obs[:, None]))
    return np.stack([basis.T @ (rest.T @ t), variance])


def most_likely(found: np.ndarray) -> tuple[float, float]:
    """The most likely sigma0 of modes (2, n), and its standard error."""
    value, sky = found

    def slope(log_sigma: float) -> float:
        total = sky + np.exp(2.0 * log_sigma)
        return float(np.sum((value**2 / total - 1.0) / total))

    sigma = float(np.exp(brentq(slope, np.log(100.0), np.log(100_000.0))))
    information = 0.5 * np.sum((2.0 * sigma / (sky + sigma**2)) ** 2)
    return sigma, float(1.0 / np.sqrt(information))


def of_saddles(t: np.ndarray, n_obs: np.ndarray) -> tuple[float, float]:
    """The rms of the combinations of 2 x 2 pixels over their noise per unit of sigma0, and its standard error."""
    z = t.reshape(-1, 4) @ SADDLE / np.sqrt((1.0 / n_obs).reshape(-1, 4).sum(axis=1))
    return float(np.sqrt(np.mean(z**2))), float(np.sqrt(np.mean(z**2) / (2 * z.size)))


def estimates(
    t: np.ndarray, n_obs: np.ndarray, first: int, blocks: np.ndarray, xi: tuple[np.ndarray, np.ndarray]
) -> list[tuple[float, float]]:
    """Both estimates from some of the blocks of a patch, whose first pixel is ``first``."""
    t, n_obs = t.reshape(-1, BLOCK), n_obs.reshape(-1, BLOCK)
    found = [modes(first + BLOCK * k, t[k], n_obs[k], xi) for k in np.flatnonzero(blocks)]
    return [of_saddles(t[blocks], n_obs[blocks]), most_likely(np.concatenate(found, axis=1))]


def simulated(n_obs: np.ndarray, realization: int) -> np.ndarray:
    """A whole sky in NESTED order: CMB through the beam, noise of 6.5 mK with the hits of the patch everywhere."""
    tiled = np.resize(n_obs, 12 * NSIDE**2)[healpy.ring2nest(NSIDE, np.arange(12 * NSIDE**2))]
    channel = {
        "name": "W",
        "beam": {"kind": "map", "path": str(data_file("wmap7_beams/wmap_hybrid_beam_W1_A_7yr_v4.fits.gz"))},
        "scan": {"kind": "parallel_transport"},
        "noise": {"sigma0_uk": ASKED_UK, "hits": tiled},
    }
    pixels = {"nside": NSIDE, "frame": "galactic", "pixel_window": "computed"}
    run = {"name": "patch", "sky": {"spectrum": "wmap7", "lmax": LMAX}, "map": pixels, "channel": [channel]}
    shared = survey(config.load(run | {"biposh": {"lmax": 1024, "L_max": 0}}))
    return healpy.reorder(simulate.maps(shared, realization, nthreads=1)[0], r2n=True)


def main() -> None:
    """Print and draw the estimates of the data and of simulated patches."""
    parser = argparse.ArgumentParser()
    parser.add_argument("-o", "--output", type=Path, default=Path("noise.png"))
    parser.add_argument("-j", "--json", type=Path, default=None)
    parser.add_argument("--skies", type=int, default=1)
    arguments = parser.parse_args()
    path = data_file("wmap_maps/wmap_band_iqumap_r9_7yr_W_v4_first26264pix.fits")
    ring = healpy.nest2ring(NSIDE, np.arange(PIXELS))
    t, n_obs = 1e3 * map_files.read_map(path)[0][ring], map_files.read_map(path, map_files.HITS)[0][ring]
    mask = read_mask(data_file("wmap_maps/wmap_temperature_analysis_mask_r9_7yr_v4_udgraded32.fits"), NSIDE, "galactic")
    clean = np.all(mask[ring].reshape(-1, BLOCK) == 1.0, axis=1)
    latitude = healpy.pix2ang(NSIDE, np.arange(PIXELS), nest=True, lonlat=True)[1].reshape(-1, BLOCK).mean(axis=1)
    beam = Beam.from_map(data_file("wmap7_beams/wmap_hybrid_beam_W1_A_7yr_v4.fits.gz"), LMAX)
    xi = correlation(beam.window * healpix.pixel_window(NSIDE, LMAX))

    bins = [(low, high, (latitude >= low) & (latitude < high)) for low, high in pairwise(LATITUDES)]
    data = {f"{low:g}-{high:g}": estimates(t, n_obs, 0, blocks, xi) for low, high, blocks in bins}
    data["KQ85"] = estimates(t, n_obs, 0, clean, xi)
    quartile = np.quantile(n_obs.reshape(-1, BLOCK).mean(axis=1)[clean], [0.0, 0.25, 0.5, 0.75, 1.0])
    mean = n_obs.reshape(-1, BLOCK).mean(axis=1)
    by_hits = [
        (float(mean[own].mean()), estimates(t, n_obs, 0, own, xi)[1])
        for low, high in pairwise(quartile)
        if (own := clean & (mean >= low) & (mean <= high)).any()
    ]
    each = []
    for realization in range(arguments.skies):
        sky = simulated(n_obs, realization)
        for first in range(0, sky.size - PIXELS, PIXELS):
            own = estimates(sky[first : first + PIXELS], n_obs, first, clean, xi)
            each.append([estimate for estimate, _ in own])
    control = np.array(each)
    report(data, by_hits, control, int(clean.sum()))
    if arguments.json:
        result = {"data": data, "by_hits": by_hits, "control_mean": control.mean(axis=0).tolist(),
                  "control_scatter": control.std(axis=0, ddof=1).tolist(), "patches": len(control)}  # fmt: skip
        arguments.json.write_text(json.dumps(result, indent=1) + "\n")
    draw(data, by_hits, control).savefig(arguments.output, dpi=110)


def report(data: dict, by_hits: list, control: np.ndarray, clean: int) -> None:
    """Print the estimates."""
    for name, own in data.items():
        print(f"{name:>8}: " + ", ".join(f"{value:7.0f} +- {error:4.0f} uK" for value, error in own))
    print(f"KQ85 leaves {clean} blocks of {BLOCK} pixels")
    for hits, (value, error) in by_hits:
        print(f"N_OBS {hits:6.0f}: {value:7.0f} +- {error:4.0f} uK")
    for place, what in enumerate(("2 x 2 pixels", "likelihood")):
        own = control[:, place]
        error = own.std(ddof=1) / np.sqrt(own.size)
        value, sigma = data["KQ85"][place]
        below = np.mean(own < value)
        print(
            f"control, {what}: mean {own.mean():.0f} +- {error:.0f} uK for {ASKED_UK:g}, scatter "
            f"{own.std(ddof=1):.0f} of {own.size} patches, stated error {sigma:.0f}; {100 * below:.0f} % below the data"
        )
        corrected = value * ASKED_UK / own.mean()
        for wanted in (ASKED_UK, PUBLISHED_UK):
            pull = (corrected - wanted) / own.std(ddof=1)
            print(f"  data over control: {corrected:.0f}, {pull:+.2f} sigma from {wanted:g}")


def draw(data: dict, by_hits: list, control: np.ndarray) -> Figure:
    """Estimates by latitude and hits, and those of simulated patches."""
    figure = Figure(figsize=(10.5, 3.6), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    names = [name for name in data if name != "KQ85"]
    centre = [np.mean([float(x) for x in name.split("-")]) for name in names]
    for place, (label, mark) in enumerate((("2 x 2 pixels", "s"), ("likelihood", "o"))):
        value, error = np.array([data[name][place] for name in names]).T
        left.errorbar(np.array(centre) + 0.3 * place, value / 1e3, error / 1e3, fmt=mark, label=label, mfc="none")
        value, error = data["KQ85"][place]
        right.hist(control[:, place] / 1e3, bins=20, histtype="step", color=f"C{place}", label=f"simulated, {label}")
        right.axvline(value / 1e3, color=f"C{place}", ls="--")
    left.set(xlabel="Galactic latitude  [degrees]", ylabel=r"$\sigma_0$  [mK]", yscale="log")
    left.set_yticks([6, 7, 8, 10], labels=["6", "7", "8", "10"])
    left.minorticks_off()
    hits, value, error = np.array([(h, *own) for h, own in by_hits]).T
    middle.errorbar(hits, value / 1e3, error / 1e3, fmt="o", color="C1")
    middle.set(xlabel=r"$N_\mathrm{obs}$ outside KQ85", ylabel=r"$\sigma_0$, likelihood  [mK]")
    right.set(xlabel=r"$\sigma_0$  [mK]", ylabel="number of simulated patches")
    left.set_title("line: what the model asks for", fontsize=10)
    right.set_title("dashed: data outside KQ85", fontsize=10)
    for axes in (left, middle):
        axes.axhline(ASKED_UK / 1e3, color="k", lw=0.8)
    right.axvline(ASKED_UK / 1e3, color="k", lw=0.8)
    left.legend(fontsize=8)
    right.legend(fontsize=7)
    return figure


if __name__ == "__main__":
    main()
