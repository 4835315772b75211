"""Hold the hits of the WMAP scan model against the number of observations of the real W-band map.

    python workflows/nobs/compare.py -o nobs.png

MCSIM_DATA names a folder with
    wmap_maps/wmap_band_iqumap_r9_7yr_W_v4_first26264pix.fits
        PIXEL (NESTED, nside 512, Galactic) and N_OBS of pixels 0 to 26263 of the seven-year W-band map
        wmap_band_iqumap_r9_7yr_W_v4.fits; public: https://lambda.gsfc.nasa.gov/product/wmap/dr4/skymap_info.html
    wmap_maps/wmap_band_iqumap_r9_7yr_W_v4_udgraded32.fits
        the same map at nside 32, from the tests of healpy
"""

import argparse
import os
from pathlib import Path

import healpy
import numpy as np
from astropy.io import fits
from matplotlib.figure import Figure

from mcsim.instrument import scan
from mcsim.instrument.scan import ScanModel
from mcsim.instrument.scan.geometry import MapGrid
from mcsim.simulation import mapmaking
from mcsim.sphere import map_files

FRAGMENT = "wmap_maps/wmap_band_iqumap_r9_7yr_W_v4_first26264pix.fits"
COARSE = "wmap_maps/wmap_band_iqumap_r9_7yr_W_v4_udgraded32.fits"
LINES = tuple(f"W{number}{side}" for number in (1, 2, 3, 4) for side in "AB")
SPLIT = 4
"""Sub-pixels along a pixel's side: the hits are singular at the caustics."""
BIN_DEG = 1.0
INNER = slice(2, -2)
"""Latitudes at both ends of the fragment are seen by few pixels."""
BRIGHT = (0.0, 0.03, 0.06, 0.11)
"""Shares of the sky that are taken as too bright for the other side; 0.06 is drawn."""
DRAWN = 0.06
PLANE_DEG = 25.0


def data_file(name: str) -> Path:
    """A file of the folder that MCSIM_DATA names."""
    folder = os.environ.get("MCSIM_DATA")
    if folder is None:
        raise SystemExit("MCSIM_DATA is not set; let it name the folder that this script's first lines describe.")
    return Path(folder) / name


def read() -> tuple[int, np.ndarray, np.ndarray]:
    """nside, NESTED pixels in Galactic coordinates, and their numbers of observations."""
    with fits.open(data_file(FRAGMENT)) as hdus:
        table = hdus[1]
        nside, pixel, observations = table.header["NSIDE"], table.data["PIXEL"], table.data["N_OBS"]
        return int(nside), pixel.astype(np.int64), observations.astype(float)


def sub_pixels(nside: int, pixel: np.ndarray) -> np.ndarray:
    """Ecliptic colatitudes of the sub-pixels' centres, shape (pixel, SPLIT^2)."""
    inside = pixel[:, None] * SPLIT**2 + np.arange(SPLIT**2)
    theta, phi = healpy.pix2ang(SPLIT * nside, inside.ravel(), nest=True)
    return np.asarray(healpy.Rotator(coord="GE")(theta, phi)[0]).reshape(inside.shape)


def density(model: ScanModel, lines: tuple[str, ...], theta: np.ndarray) -> np.ndarray:
    """Hits per solid angle over their sky mean in the limit of endless time, mean of lines of sight and sub-pixels."""
    table = np.linspace(theta.min(), theta.max(), 20_001)
    hits = np.mean([scan.limit_moments(model.with_lines_of_sight(line), table, 1)[0] for line in lines], axis=0)
    return np.asarray(np.interp(theta, table, hits)).mean(axis=1)


def kept(pairs: mapmaking.DifferencingScan, share: float, nside: int, pixel: np.ndarray) -> np.ndarray:
    """Share of a pixel's samples whose other side is not in the brightest ``share`` of the sky."""
    coarse, _, _ = map_files.read_map(data_file(COARSE))
    latitude = 90.0 - np.degrees(healpy.pix2ang(32, np.arange(coarse.size))[0])
    coarse = np.where(np.abs(latitude) < PLANE_DEG, coarse, -np.inf)
    bright = healpy.ud_grade((coarse > np.quantile(coarse, 1.0 - share)).astype(float), pairs.grid.nside)
    lost = np.add.reduceat(pairs.count * bright[pairs.partner], pairs.row_start[:-1])
    return np.asarray(
        healpy.get_interp_val(1.0 - lost / (pairs.hits_a + pairs.hits_b), *healpy.pix2ang(nside, pixel, nest=True))
    )


def profile(latitude_deg: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres of bins of latitude, and means in them over their mean over all bins."""
    number = np.floor(latitude_deg / BIN_DEG).astype(int)
    count = np.bincount(number)
    means = np.bincount(number, weights=values)[count > 0] / count[count > 0]
    return (np.flatnonzero(count) + 0.5) * BIN_DEG, means / means[INNER].mean()


def main() -> None:
    """Compare, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("nobs.png"))
    output = parser.parse_args().output
    nside, pixel, observations = read()
    theta = sub_pixels(nside, pixel)
    latitude = np.abs(90.0 - np.degrees(theta.mean(axis=1)))
    focal_plane, nominal = (scan.ScanModel.load(name) for name in ("wmap_focal_plane", "wmap"))
    pairs = mapmaking.prepare(focal_plane.with_sampling(0.6), "W1", MapGrid(64, "galactic"), nthreads=2)
    limit = density(focal_plane, LINES, theta)
    models = {"one line of sight at 70.5°": density(nominal, ("A",), theta)}
    for share in BRIGHT:
        name = f"W1 to W4, without partners in the brightest {share:.0%}" if share else "W1 to W4, every sample"
        models[name] = limit * kept(pairs, share, nside, pixel) if share else limit
    x, data = profile(latitude, observations)
    print(f"{pixel.size} pixels, |ecliptic latitude| {latitude.min():.1f} to {latitude.max():.1f} degrees")
    print(f"N_obs: peak at {x[np.argmax(data)]:.1f} degrees")
    figure = Figure(figsize=(10.5, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(x, data, "ko", ms=4, label="N_obs, W band, seven years")
    drawn = {"W1 to W4, every sample": "#c44e22", f"W1 to W4, without partners in the brightest {DRAWN:.0%}": "#1f5fa8"}
    for name, hits in models.items():
        _, model = profile(latitude, hits)
        ratio = (data / model)[INNER]
        correlation = np.corrcoef(hits, observations)[0, 1]
        print(
            f"{name}: peak at {x[np.argmax(model)]:.1f} degrees; N_obs over model by latitude {ratio.min():.3f} (at "
            f"{x[INNER][np.argmin(ratio)]:.1f}) to {ratio.max():.3f}, rms {ratio.std():.3f}; correlation of pixels "
            f"{correlation:.4f}"
        )
        if name in drawn:
            left.plot(x, model, color=drawn[name], lw=1.3, label=name)
            right.plot(x[INNER], ratio, "o-", ms=3, lw=1, color=drawn[name], label=name)
    for axes, text in ((left, "hits over their mean"), (right, "N_obs over model")):
        axes.set_xlabel("|ecliptic latitude|  [degrees]")
        axes.set_ylabel(text)
        axes.legend(frameon=False, fontsize=8, loc="upper left" if axes is left else "best")
    left.set_ylim(top=1.75)  # room for the legend
    right.axhline(1.0, color="0.7", lw=0.8)
    figure.savefig(output, dpi=100)


if __name__ == "__main__":
    main()
