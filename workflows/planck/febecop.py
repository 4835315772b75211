"""Hold a prediction against the L = 2 BipoSH of Planck's FEBeCoP simulations at 30, 44 and 70 GHz.

    python workflows/planck/febecop.py [-o planck.png]

MCSIM_DATA names a folder with

- planck/LFI_FPDB_DX11D_R2.2.fits: LFI focal-plane database (place, FWHM, ellipticity and its direction of each of 22
  radiometers; hpc4cmb/libconviqt, folder data);
- biposh_reference/AL2Ms_febecop_{030,044,070}.txt.gz: Re A^{2M}_{l,l+D} of 50 CMB maps convolved with the effective
  beams, row 3 M + D, columns l = 2...2048, in uK^2, l(l+1)/2pi times the Bennett normalisation, galactic frame
  (Souradeep-CMBLab/NC_beam_codes_Akashdeep, folder febecop_biposh_analysis).

Every radiometer is an elliptical Gaussian; their b_lm are averaged over the horns of a frequency. One year of a
Planck-like scan gives the orientation moments in ecliptic coordinates; A^{2M} follows to leading order and is rotated
to galactic ones. The README of this folder says how close the two are.
"""

import argparse
import os
from itertools import pairwise
from pathlib import Path

import numpy as np
from astropy.io import fits
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mcsim.bipolar import to_bennett
from mcsim.bipolar.theory import ScannedBeam, cmb_biposh_leading, orientation_harmonics
from mcsim.instrument import beams, scan
from mcsim.sphere import rotation, spectra
from mcsim.sphere.healpix import pixel_window
from mcsim.support import resources

LMAX = 1024
NSIDE, MAP_NSIDE = 128, 1024
"""Of the moments, whose L = 2 part needs no more; of Planck's LFI maps, whose pixels the effective beams include."""
SAMPLE_PERIOD_S = 0.1
MODES = [(2, M, d) for d in (0, 2) for M in (0, 1, 2)]
FREQUENCIES = {"030": (150, 400), "044": (150, 500), "070": (150, 700)}
"""Frequency in GHz -> multipoles that are compared: where the beam leaves a signal."""
READINGS = {"horn": "-", "line of sight": ":"}
"""Frame of psi_ell -> style of its line."""

Shape = tuple[float, float, float]


def focal_plane(path: Path, frequency: str, reading: str) -> list[Shape]:
    """FWHM of both axes in arcmin, and direction of the major axis in degrees from in-scan x, of each radiometer.

    ``psi_ell`` counts from the U axis: of the horn's own frame ("horn"), which ``psi_uv`` turns against that of the
    line of sight, or of the latter ("line of sight"). There U points towards the spin axis: along y of mcsim's beam
    frame, across the scan.
    """
    table = fits.getdata(path, 1)
    rows = table[np.round(table["nu_cen"] / 1e9).astype(int) == int(frequency)]
    found = []
    for row in rows:
        root = float(np.sqrt(row["ellipticity"]))
        # FWHM is the geometric mean of the axes, in arcmin although the header says degrees.
        fwhm = float(row["beamfwhm"])
        turn = float(row["psi_uv"]) if reading == "horn" else 0.0
        found.append((fwhm * root, fwhm / root, turn + float(row["psi_ell"]) + 90.0))
    return found


def mean_beam(radiometers: list[Shape]) -> NDArray[np.complex128]:
    """b_lm of the mean of elliptical Gaussians, m <= 2, shape (3, LMAX + 1)."""
    made = [beams.Beam.elliptical(*widths, angle_deg=angle, lmax=LMAX, mmax=2) for *widths, angle in radiometers]
    return np.mean([beam.blm for beam in made], axis=0)


def predicted(blm: NDArray[np.complex128], w: NDArray[np.complex128]) -> tuple[NDArray, NDArray]:
    """Spectra of MODES like those of the table, uK^2, shape (6, LMAX + 1): ecliptic, galactic."""
    cl = spectra.load(resources.spectrum("planck2018"), LMAX)
    ecliptic = cmb_biposh_leading(MODES, cl, LMAX, ScannedBeam(blm * pixel_window(MAP_NSIDE, LMAX), w))
    galactic = rotation.rotate_biposh(ecliptic, MODES, "ecliptic", "galactic")
    ell = np.arange(LMAX + 1)
    scale = ell * (ell + 1) / (2 * np.pi)
    return to_bennett(ecliptic, MODES).real * scale, to_bennett(galactic, MODES).real * scale


def reference(path: Path) -> NDArray[np.float64]:
    """Rows of the table in the order of MODES, at ell = l2, shape (6, LMAX + 1)."""
    rows = np.loadtxt(path)
    result = np.full((len(MODES), LMAX + 1), np.nan)
    for target, (_, M, d) in zip(result, MODES, strict=True):
        target[2 + d :] = rows[3 * M + d, : LMAX - 1 - d]
    return result


def orientations() -> NDArray[np.complex128]:
    """w_{s,LM} of one year of the Planck-like scan, ecliptic."""
    model = scan.ScanModel.load("planck").with_sampling(SAMPLE_PERIOD_S)
    moments = scan.Moments.load(scan.cached_moments(model, scan.MapGrid(NSIDE), 2, nthreads=2))
    print(f"scan: BipoSH factor over parallel transport {scan.scan_factors(moments).quadrupole_ratio:.3f}")
    return orientation_harmonics(np.asarray(moments.w), 2)


def compare(frequency: str, ecliptic: NDArray, galactic: NDArray, table: NDArray) -> None:
    """Print sizes and patterns of a frequency."""
    low, high = FREQUENCIES[frequency]
    use = slice(low, high + 1)
    turn = rotation.wigner_D(2, rotation.rotation_matrix("ecliptic", "galactic"))[2:, 2].real
    for d in (0, 2):
        rows = [MODES.index((2, M, d)) for M in (0, 1, 2)]
        measured, expected = table[rows, use], galactic[rows, use]
        # The ecliptic quadrupole whose rotation is nearest to the mean triplet.
        mean = measured.mean(axis=1)
        axial = turn @ mean / (turn @ turn)
        residual = np.abs(mean - turn * axial).max()
        # Their 50 skies scatter from one multipole to the next; bins of 25 tell by how much.
        count = measured.shape[1] // 25
        binned = [a[:, : 25 * count].reshape(3, count, 25).mean(axis=2).ravel() for a in (expected, measured)]
        scale = float(binned[0] @ binned[1] / (binned[0] @ binned[0]))
        print(
            f"    d = {d}: FEBeCoP ({', '.join(f'{x:6.1f}' for x in mean)})  "
            f"predicted ({', '.join(f'{x:6.1f}' for x in expected.mean(axis=1))}) uK^2;  "
            f"ecliptic A20 {axial:.1f} and {ecliptic[rows[0], use].mean():.1f}, triplet off a pure quadrupole by "
            f"{residual:.1f};  FEBeCoP = {scale:.2f} x predicted, correlation {np.corrcoef(*binned)[0, 1]:.3f}"
        )


def draw(results: dict[str, tuple[dict[str, NDArray], NDArray]]) -> Figure:
    """Triplets of every frequency: d = 0 above, d = 2 below; points FEBeCoP, lines predicted."""
    width = 25
    figure = Figure(figsize=(4.2 * len(results), 6.4), layout="constrained")
    grid = figure.subplots(2, len(results), sharex="col")
    for column, (frequency, (readings, table)) in zip(grid.T, results.items(), strict=True):
        edges = np.arange(25, FREQUENCIES[frequency][1] + 101, width)
        x = edges[:-1] + (width - 1) / 2
        for axes, d in zip(column, (0, 2), strict=True):
            for M, colour in zip((0, 1, 2), ("#1f5fa8", "#3c8c3c", "#c44e22"), strict=True):
                row = MODES.index((2, M, d))
                axes.plot(x, _binned(table[row], edges), "o", ms=3.5, color=colour, label=f"M = {M}")
                for reading, style in READINGS.items():
                    axes.plot(x, _binned(readings[reading][row], edges), style, color=colour, lw=1.3)
            axes.axhline(0, color="0.6", lw=0.8)
            axes.legend(frameon=False, fontsize=8)
            axes.set_title(f"{frequency.lstrip('0')} GHz, d = {d}", fontsize=10)
        column[-1].set_xlabel(r"multipole $\ell$")
    for axes, name in zip(grid[:, 0], (r"A^{2M}_{\ell\ell}", r"A^{2M}_{\ell-2,\ell}"), strict=True):
        axes.set_ylabel(rf"$\ell(\ell+1)\,\mathrm{{Re}}\,{name}/2\pi$  [$\mu$K$^2$], galactic")
    figure.suptitle(
        r"points: FEBeCoP simulations;  elliptical Gaussians under a Planck-like scan, $\psi_\mathrm{ell}$ counted "
        "in the horn's frame (solid), in the line of sight's (dotted)",
        fontsize=10,
    )
    return figure


def _binned(spectrum: NDArray[np.float64], edges: NDArray[np.int64]) -> list[float]:
    return [float(np.mean(spectrum[i:j])) for i, j in pairwise(edges)]


def main() -> None:
    """Predict, compare, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path)
    arguments = parser.parse_args()
    if "MCSIM_DATA" not in os.environ:
        parser.error("set MCSIM_DATA to the folder described above")
    data = Path(os.environ["MCSIM_DATA"])
    w = orientations()
    results = {}
    for frequency, (low, high) in FREQUENCIES.items():
        table = reference(data / "biposh_reference" / f"AL2Ms_febecop_{frequency}.txt.gz")
        found = {}
        for reading in READINGS:
            shapes = focal_plane(data / "planck" / "LFI_FPDB_DX11D_R2.2.fits", frequency, reading)
            major, minor, angle = np.array(shapes).T
            print(
                f"{frequency} GHz, psi_ell in the frame of the {reading}: {len(shapes)} radiometers, "
                f"{major.mean():.1f}' x {minor.mean():.1f}', <cos 2 angle to the scan> = "
                f"{np.cos(2 * np.radians(angle)).mean():.3f}; l = {low}-{high}, M = 0, 1, 2:"
            )
            ecliptic, found[reading] = predicted(mean_beam(shapes), w)
            compare(frequency, ecliptic, found[reading], table)
        results[frequency] = found, table
    if arguments.output:
        draw(results).savefig(arguments.output, dpi=75)


if __name__ == "__main__":
    main()
