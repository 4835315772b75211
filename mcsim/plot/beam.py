"""Figure of a beam: its peak, its faint surroundings and its coefficients."""

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from mcsim.instrument.beams import Beam, BeamMap, BeamSummary, summarize
from mcsim.instrument.beams.beammap import solid_angle_values

FLOOR_DB = 40.0
_PIXELS = 361
_CONTOURS = (0.1, 0.25, 0.5, 0.75, 0.9)
_LARGEST_ORDER = 8
_LONG_ARCMIN = 120.0  # from which on axes are in degrees
_FLOOR = 1e-6  # of the coefficients drawn
_ARCMIN = np.degrees(1.0) * 60
# Negative blue, positive ochre, white at and below the floor: safe for colour-blind readers.
_SIGNED = LinearSegmentedColormap.from_list(
    "signed_db", ["#08204a", "#1f5fa8", "#a9cbe8", "#ffffff", "#f5cfa0", "#c8641e", "#4f1605"]
)


def beam_figure(beam: Beam, beam_map: BeamMap | None = None, title: str = "") -> Figure:
    """Draw a beam's peak, its faint annulus in dB with the sign, and |b_lm|.

    Without a map of the beam the pattern is synthesised from the coefficients. The figure is independent of pyplot.
    """
    summary = summarize(beam, beam_map)
    figure = Figure(figsize=(15.0, 4.9), layout=ConstrainedLayoutEngine(wspace=0.06))
    peak_axes, faint_axes, blm_axes = figure.subplots(1, 3, width_ratios=[1, 1.12, 1.25])
    if title:
        figure.suptitle(title, fontsize=13, fontweight="bold", parse_math=False)
    fwhm = summary.fwhm_major_arcmin if np.isfinite(summary.fwhm_major_arcmin) else np.degrees(0.5) * 60
    off_centre = float(np.hypot(*summary.centroid_arcmin))
    _draw_peak(peak_axes, beam, beam_map, summary, 1.25 * fwhm + off_centre)
    # To the outermost pixel with data inside the cut of a map.
    reach = 5 * fwhm + off_centre if beam_map is None else 1.05 * _ARCMIN * float(solid_angle_values(beam_map)[1].max())
    _draw_faint(faint_axes, beam, beam_map, min(reach, 90 * 60))
    _draw_blm(blm_axes, beam)
    return figure


def _pattern(beam: Beam, beam_map: BeamMap | None, reach_arcmin: float) -> NDArray[np.float64]:
    """Return the response over the largest in a square of +-reach in theta (cos phi, sin phi); row = y."""
    axis = np.linspace(-reach_arcmin, reach_arcmin, _PIXELS) / _ARCMIN
    x, y = np.meshgrid(axis, axis)
    theta, phi = np.hypot(x, y), np.arctan2(y, x)
    shown, end = (beam, np.pi) if beam_map is None else (beam_map, beam_map.cut_rad)
    values = np.where(theta <= end, shown.values(np.minimum(theta, end), phi), 0.0)
    return values / values.max()


def _square(axes: Axes, values: NDArray[np.float64], reach_arcmin: float, **style: Any) -> AxesImage:
    """Draw values on a square of +-reach around the centre of the beam."""
    side, unit = (reach_arcmin / 60.0, "deg") if reach_arcmin > _LONG_ARCMIN else (reach_arcmin, "arcmin")
    axes.set(xlabel=f"x, in-scan  [{unit}]", ylabel=f"y, cross-scan  [{unit}]")
    return axes.imshow(values, origin="lower", extent=(-side, side, -side, side), **style)


def _draw_peak(axes: Axes, beam: Beam, beam_map: BeamMap | None, summary: BeamSummary, reach: float) -> None:
    values = _pattern(beam, beam_map, reach)
    image = _square(axes, values, reach, cmap="YlGnBu_r", vmin=0, vmax=1, interpolation="bilinear")
    colours, widths = ["w", "w", "w", "k", "k"], [0.8, 0.8, 1.8, 0.8, 0.8]
    contours = axes.contour(values, _CONTOURS, extent=image.get_extent(), colors=colours, linewidths=widths)
    axes.clabel(contours, fmt=lambda level: f"{level:.0%}", fontsize=7)
    fwhm = f"{summary.fwhm_major_arcmin:.1f}′ × {summary.fwhm_minor_arcmin:.1f}′ FWHM"
    axes.set_title(f"Peak: {fwhm}, ratio {summary.axis_ratio:.3f}", fontsize=10)
    axes.figure.colorbar(image, ax=axes, label="response / peak", shrink=0.85, pad=0.02)


def _draw_faint(axes: Axes, beam: Beam, beam_map: BeamMap | None, reach: float) -> None:
    values = _pattern(beam, beam_map, reach)
    with np.errstate(divide="ignore"):
        above_floor = np.maximum(FLOOR_DB + 10 * np.log10(np.abs(values)), 0.0)
    style = {"cmap": _SIGNED, "vmin": -FLOOR_DB, "vmax": FLOOR_DB, "interpolation": "nearest"}
    image = _square(axes, np.sign(values) * above_floor, reach, **style)
    axes.set_title("Surroundings, with the sign of the response", fontsize=10)
    bar = axes.figure.colorbar(image, ax=axes, shrink=0.85, pad=0.02)
    ticks = np.arange(-FLOOR_DB, FLOOR_DB + 1, 10).tolist()
    bar.set_ticks(ticks, labels=[_decibel_label(tick) for tick in ticks])
    bar.set_label("negative   |   positive     [dB below the peak]")


def _decibel_label(tick: float) -> str:
    if tick == 0:
        return f"below −{FLOOR_DB:.0f}"
    below = FLOOR_DB - abs(tick)
    return f"{'+' if tick > 0 else '−'}  {'0' if below == 0 else f'−{below:.0f}'}"


def _draw_blm(axes: Axes, beam: Beam) -> None:
    ell = np.arange(beam.lmax + 1)
    scale = np.sqrt(4 * np.pi / (2 * ell + 1))
    drawn = [m for m in range(min(beam.mmax, _LARGEST_ORDER) + 1) if np.any(beam.blm[m])]
    colours = ["#222222", *colormaps["viridis"](np.linspace(0.1, 0.9, max(len(drawn) - 1, 1)))]
    last = 1
    for m, colour in zip(drawn, colours, strict=False):
        size = scale[m:] * np.abs(beam.blm[m, m:])
        width, dashes = 2.0 if m in (0, 2) else 1.1, "--" if m % 2 else "-"
        axes.semilogy(ell[m:], size, dashes, color=colour, linewidth=width, label=f"{m}")
        last = max([last, *ell[m:][size > _FLOOR]])
    axes.set(xlim=(0, min(1.05 * last, beam.lmax)), ylim=(_FLOOR, 2), xlabel="multipole ℓ")
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.grid(which="major", color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_ylabel(r"$|b_{\ell m}|\,\sqrt{4\pi/(2\ell+1)}$   ($m=0$: $|B_\ell|$)")
    beyond = f"; {beam.neglected_power:.1e} of the power beyond" if beam.neglected_power > 0 else ""
    orders = f"m ≤ {beam.mmax}" if beam.mmax else "m = 0 alone"
    axes.set_title(f"Coefficients, {orders}{beyond}", fontsize=10)
    axes.legend(title="m", fontsize=8, ncols=3, loc="best", framealpha=0.9)
