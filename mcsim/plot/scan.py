"""Figure of a scan: orientation of the beam and <cos 2 psi> over the sky, hits and w_2 by latitude."""

import healpy
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.scan.factors import ring_means
from mcsim.instrument.scan.limit import limit_moments
from mcsim.instrument.scan.model import ScanModel
from mcsim.instrument.scan.moments import Moments
from mcsim.plot.sky import mollweide


def scan_figure(moments: Moments, title: str = "", model: ScanModel | None = None) -> Figure:
    """Draw the orientation of the beam in a survey.

    The moments need smax >= 2. The exact long-time limit of a ``model`` is drawn beside them; omit it outside the
    ecliptic frame and for models without such a limit. Four panels: psi-bar = -arg(w_2) / 2, the mean orientation of
    the beam's x axis from e_theta towards e_phi, an axis and so defined up to 180 degrees; <cos 2 psi> = Re w_2; hits
    and Re w_2 against latitude.

    Notes
    -----
    The paper (arXiv:1210.7318, fig. cos2rho) averages the angles themselves (rho there), which depends on where the
    circle is cut. The circular mean of e^{i psi}, -arg(w_1), would be +-90 degrees nearly everywhere: the two passes
    over a pixel have psi and 180 deg - psi.
    """
    if moments.smax < 2:
        raise InputError(f"the moments end at s = {moments.smax}, but the figure needs s = 2; use smax >= 2.")
    seen = np.asarray(moments.hits > 0.0)
    w2 = np.where(seen, moments.w[1], np.nan)
    figure = Figure(figsize=(11.0, 7.0), layout="constrained")
    nside = healpy.npix2nside(seen.size)
    named = f"{title}: " if title else ""
    where = f"{named}{moments.frame} frame, nside {nside}; Mollweide, longitude 0 in the middle, growing to the left"
    figure.suptitle(where, fontsize=11, parse_math=False)
    axes = figure.subplots(2, 2, height_ratios=(1.0, 0.8))
    _panel(
        axes[0, 0],
        np.degrees(-0.5 * np.angle(w2)),
        "twilight_shifted",
        90.0,
        "degrees from $e_\\theta$ (south) towards $e_\\phi$ (east), modulo 180",
    )
    axes[0, 0].set_title(r"mean orientation $\bar\psi = -\frac{1}{2}\,\arg w_2$")
    _panel(axes[0, 1], w2.real, "RdBu", 1.0, "1: along the meridian; −1: across")
    axes[0, 1].set_title(r"$\langle\cos 2\psi\rangle = \mathrm{Re}\,w_2$")
    _against_latitude(axes[1, 0], axes[1, 1], moments, model)
    return figure


def _panel(axes: Axes, values: NDArray[np.float64], colours: str, limit: float, unit: str) -> None:
    """Draw a map with a colour bar that is symmetric about zero."""
    ticks = limit * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    shown = mollweide(axes, values, 1200, cmap=colours, vmin=-limit, vmax=limit)
    axes.figure.colorbar(shown, ax=axes, orientation="horizontal", shrink=0.6, pad=0.02, label=unit, ticks=ticks)


def _against_latitude(hits_axes: Axes, w_axes: Axes, moments: Moments, model: ScanModel | None) -> None:
    theta, hits, w = ring_means(moments)
    latitude = 90.0 - np.degrees(theta)
    hits_axes.plot(latitude, hits, color="tab:blue", linewidth=1.2, label="mean of each ring")
    w_axes.plot(latitude, w[1].real, color="tab:blue", linewidth=1.2, label="mean of each ring")
    if model is not None:
        fine = np.radians(np.linspace(0.02, 179.98, 4000))
        density, limit = limit_moments(model, fine, 2)
        for axes, values in ((hits_axes, density), (w_axes, limit[1].real)):
            axes.plot(90.0 - np.degrees(fine), values, "--", color="black", linewidth=0.7, label="long-time limit")
    hits_axes.set(ylim=(0.0, 1.15 * float(hits.max())), ylabel="hits / mean")
    w_axes.set_ylabel(r"Re $w_2$")
    w_axes.axhline(0.0, color="0.6", linewidth=0.6)
    for axes in (hits_axes, w_axes):
        axes.set(xlim=(-90.0, 90.0), xticks=range(-90, 91, 30), xlabel=f"{moments.frame} latitude [degrees]")
    hits_axes.legend(frameon=False)  # the colours and styles of both panels
