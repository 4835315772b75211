"""Figures of beams: coefficients of elliptical Gaussians and of the raw WMAP-7 beam maps, and the maps themselves."""

import numpy as np
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from mcsim.instrument import beams
from mcsim.instrument.beams.beammap import solid_angle_values

ARCMIN = np.degrees(1.0) * 60.0
LMAX = 1024
SMOOTHING_ARCMIN = 5.0
COLOURS = {"V2": "#c44e22", "W1": "#1f5fa8"}
ELLIPSES = {"W": (13.579, 0.4), "V": (17.7036, 0.46)}
"""FWHM of the major axis in arcmin, and eccentricity, of the paper's elliptical Gaussians."""


def elliptical_blm() -> Figure:
    """|b_lm| of the paper's elliptical Gaussians for m = 0, 2, 4."""
    figure = Figure(figsize=(10.0, 4.0), layout="constrained")
    for axes, (name, (fwhm, eccentricity)) in zip(figure.subplots(1, 2, sharey=True), ELLIPSES.items(), strict=True):
        minor = fwhm * np.sqrt(1.0 - eccentricity**2)
        blm = beams.Beam.elliptical(fwhm, minor, lmax=LMAX, mmax=4).blm
        for m, colour in ((0, "#222222"), (2, "#1f5fa8"), (4, "#3c8c3c")):
            axes.semilogy(np.arange(m, LMAX + 1), np.abs(blm[m, m:]), color=colour, label=f"m = {m}")
        axes.set_ylim(1e-7, 20)
        axes.set_xlim(0, LMAX)
        axes.set_title(f"{name}: {fwhm:g}′ × {minor:.2f}′, e = {eccentricity:g}", fontsize=10)
        axes.set_xlabel(r"multipole $\ell$")
        axes.set_ylabel(r"$|b_{\ell m}|$")
        axes.legend(frameon=False)
    return figure


def raw_blm(maps: dict[str, beams.BeamMap], factor: float) -> Figure:
    """b_l0, b_l2 and b_l0 b_l2 of raw beam maps; dashed: b_l2 times the factor that a scan leaves."""
    figure = Figure(figsize=(12.5, 3.9), layout="constrained")
    panels = figure.subplots(1, 3)
    ell = np.arange(LMAX + 1)
    for name, beam_map in maps.items():
        blm = beams.Beam.from_map(beam_map, LMAX, 2).blm
        colour = COLOURS[name]
        panels[0].plot(ell, blm[0].real, color=colour, label=name)
        panels[1].plot(ell, 100 * blm[2].real, color=colour, label=f"{name}, real")
        panels[1].plot(ell, 100 * blm[2].imag, color=colour, lw=0.9, ls=":", label=f"{name}, imaginary")
        product = 100 * (blm[0] * blm[2]).real
        panels[2].plot(ell, product, color=colour, label=f"{name}, raw")
        panels[2].plot(ell, factor * product, color=colour, ls="--", label=rf"{name}, $\times$ {factor:.4f}")
    titles = (r"$b_{\ell 0}$", r"$100\; b_{\ell 2}$", r"$100\; b_{\ell 0}\,\mathrm{Re}\,b_{\ell 2}$")
    for axes, title in zip(panels, titles, strict=True):
        axes.axhline(0, color="0.6", lw=0.8)
        axes.set_title(title, fontsize=11)
        axes.set_xlim(0, LMAX)
        axes.set_xlabel(r"multipole $\ell$")
        axes.legend(frameon=False, fontsize=8)
    return figure


def _pattern(beam_map: beams.BeamMap, reach_arcmin: float, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Axis in arcmin and response over the peak on a square, row = y."""
    axis = np.linspace(-reach_arcmin, reach_arcmin, size)
    x, y = np.meshgrid(axis, axis)
    theta = np.hypot(x, y) / ARCMIN
    return axis, beam_map.values(theta, np.arctan2(y, x)) * (theta < beam_map.cut_rad) / beam_map.image.max()


def beam_maps(maps: dict[str, beams.BeamMap]) -> Figure:
    """The peak in three dimensions over its contours, and the whole map on a scale that shows where it is negative."""
    figure = Figure(figsize=(10.5, 8.4), layout="constrained")
    for row, (name, beam_map) in enumerate(maps.items()):
        axis, peak = _pattern(beam_map, 24.0, 97)
        solid = figure.add_subplot(2, 2, 2 * row + 1, projection="3d")
        solid.plot_surface(*np.meshgrid(axis, axis), peak, cmap="YlGnBu_r", rcount=97, ccount=97, linewidth=0)
        solid.contour(*np.meshgrid(axis, axis), peak, levels=[0.1, 0.3, 0.5, 0.7, 0.9], offset=-0.35, colors="0.3")
        solid.set_zlim(-0.35, 1.0)
        solid.view_init(28, -60)
        solid.set_title(f"{name}, side A: response / peak, contours 10 to 90 %", fontsize=10)
        solid.set_xlabel("x, in-scan [arcmin]")
        solid.set_ylabel("y, cross-scan [arcmin]")
        axis, whole = _pattern(beam_map, 150.0, 301)
        flat = figure.add_subplot(2, 2, 2 * row + 2)
        # At 1 arcmin a pixel; unsmoothed, the noise of the map hides the negative regions.
        drawn = flat.imshow(
            gaussian_filter(whole, SMOOTHING_ARCMIN),
            origin="lower",
            extent=(-150, 150, -150, 150),
            cmap="RdBu_r",
            norm=SymLogNorm(3e-4, vmin=-1, vmax=1),
        )
        label = f"response / peak, smoothed, $\\sigma$ = {SMOOTHING_ARCMIN:g}′"
        figure.colorbar(drawn, ax=flat, shrink=0.85, label=label, ticks=[-1, -0.1, -0.01, 0, 0.01, 0.1, 1])
        flat.set_title(f"{name}: negative response is {negative_share(beam_map):.1%} of the positive", fontsize=10)
        flat.set_xlabel("x, in-scan [arcmin]")
        flat.set_ylabel("y, cross-scan [arcmin]")
    return figure


def negative_share(beam_map: beams.BeamMap) -> float:
    """Sum of the negative pixels over that of the positive ones, inside the cut."""
    values, _, _ = solid_angle_values(beam_map)
    return float(-values[values < 0].sum() / values[values > 0].sum())
