"""Figures of the scan: orientation of the beam over the sky, and the three factors of multiple hits."""

import numpy as np
from matplotlib.figure import Figure

from mcsim.instrument import scan
from mcsim.instrument.scan.limit import limit_quadrature
from mcsim.plot.scan import scan_figure

NSIDE = 128
SAMPLE_PERIOD_S = 0.2048
"""Four times WMAP's: 154 million samples are 780 in each pixel, enough for a picture."""


def moments() -> tuple[scan.ScanModel, scan.Moments]:
    """Scan model and one year of its orientation moments, from the cache where they are there already."""
    model = scan.ScanModel.load("wmap").with_sampling(SAMPLE_PERIOD_S)
    folder = scan.cached_moments(model, scan.MapGrid(NSIDE), 2, nthreads=2)
    return model, scan.Moments.load(folder)


def scan_maps(model: scan.ScanModel, one_year: scan.Moments) -> Figure:
    """Mean orientation rho-bar and <cos 2 rho> in ecliptic coordinates."""
    return scan_figure(one_year, "One year of a WMAP-like scan, ecliptic coordinates", model)


def factors(model: scan.ScanModel, one_year: scan.Moments) -> Figure:
    """f_l beside the two factors that it is taken for, and the weights by which the three average w_2."""
    ell = np.unique(np.round(np.geomspace(2, 1000, 60)).astype(int)).tolist()
    limit, measured = scan.limit_factors(model, ell), scan.scan_factors(one_year, ell)
    colours = {"biposh": "#c44e22", "mean": "#3c8c3c", "f": "#1f5fa8"}
    figure = Figure(figsize=(10.5, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(ell, limit.f_ell, color=colours["f"], label=r"$f_\ell$ of the paper, $m = 2$: long-time limit")
    left.plot(ell, measured.f_ell, ".", color=colours["f"], ms=5, label=r"$f_\ell$: one year, streamed")
    for value, key, text in (
        (limit.quadrupole_ratio, "biposh", r"$A^{20}$: $\int w_2\sin^2\theta\,/\int\sin^2\theta$"),
        (limit.sky_mean, "mean", r"least squares over isotropic skies: $\langle w_2\rangle$"),
    ):
        left.axhline(value, color=colours[key], label=f"{text} = {value:.4f}")
    left.set_xscale("log")
    left.set_ylim(0.40, 0.82)
    left.set_xlabel(r"multipole $\ell$")
    left.set_ylabel("factor over parallel transport")
    left.legend(frameon=False, fontsize=8, loc="upper right")

    theta, _ = limit_quadrature(model)
    latitude = 90.0 - np.degrees(theta)
    right.plot(latitude, scan.limit_moments(model, theta, 2)[1][1].real, color="black", lw=1.2, label=r"$w_2$")
    for weight, key, text in (
        (1.5 * np.sin(theta) ** 2, "biposh", r"$\sin^2\theta$: weight of $A^{20}$"),
        (np.ones_like(theta), "mean", "1: weight of the sky mean"),
        (
            2.0 / (np.pi * np.maximum(np.sin(theta), 1e-2)),
            "f",
            r"$\propto 1/\sin\theta$: of $(d^\ell_{22})^2$ at large $\ell$",
        ),
    ):
        right.plot(latitude, weight, "--", color=colours[key], label=text)
    right.set_xlim(-90, 90)
    right.set_ylim(-0.05, 2.4)
    right.set_xticks(range(-90, 91, 30))
    right.set_xlabel("ecliptic latitude [degrees]")
    right.set_ylabel(r"$w_2$, and weights per solid angle")
    right.legend(frameon=False, fontsize=8, loc="upper center")
    return figure
