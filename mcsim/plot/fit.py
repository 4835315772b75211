"""Figure of effective beams: measured BipoSH with the best fits, their residuals, and f_l."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mcsim.beamfit import Fit
from mcsim.support.numbers import measured

_COLOURS = {"constant": "#c44e22", "linear": "#1f5fa8", "spline": "#3c8c3c", "orientation": "#7b4fa3"}


def fit_figure(fits: Sequence[Fit]) -> Figure:
    """Draw fits of several models to the same data.

    A column for every mode (and part) has the data and the best fits above their residuals in sigmas; the last column
    has f_l and its 68 % band.
    """
    data = fits[0].measured
    columns = list(dict.fromkeys((row.mode, row.imaginary) for row in data.rows))
    figure = Figure(figsize=(4.4 * (len(columns) + 1), 5.4), layout="constrained")
    what = "spectra less those of the circular-beam control" if data.kind == "difference" else "spectra"
    figure.suptitle(f"{data.origin}: {what}", fontsize=11, parse_math=False)
    axes = figure.subplots(2, len(columns) + 1, height_ratios=(2.2, 1.0), squeeze=False)
    errors, scaling = np.sqrt(np.diag(data.covariance)), data.scaling
    quantity = r"\ell(\ell+1)A/2\pi" if scaling.spectrum else "A"
    centres = np.array([0.5 * (row.ell_min + row.ell_max) for row in data.rows])
    for column, (mode, imaginary) in enumerate(columns):
        here = [i for i, row in enumerate(data.rows) if (row.mode, row.imaginary) == (mode, imaginary)]
        x = centres[here]
        above, below = axes[0, column], axes[1, column]
        above.errorbar(
            x, data.value[here], errors[here], fmt="o", color="0.2", markersize=3.5, capsize=2, label="data ± 1σ"
        )
        below.axhspan(-1.0, 1.0, color="0.92", linewidth=0, zorder=0)
        largest = 2.0
        for number, one in enumerate(fits):
            colour = _COLOURS[one.model.name]
            # Later ones are dashed: a fit that lies on another one is seen too.
            above.plot(x, one.best[here], "--" if number else "-", color=colour, label=one.model.name)
            pull = (data.value - one.best)[here] / errors[here]
            shift = 0.12 * (number - 0.5 * (len(fits) - 1)) * (x[1] - x[0] if len(x) > 1 else 1.0)
            below.plot(x + shift, pull, "o", color=colour, markersize=3.5)
            largest = max(largest, float(np.max(np.abs(pull))))
        part = (r"\mathrm{Im}\," if imaginary else r"\mathrm{Re}\,") if mode.M > 0 or imaginary else ""
        first = r"\ell" if mode.d == 0 else rf"\ell{-mode.d:+d}"
        above.set_title(rf"${part}A^{{{mode.L}{mode.M}}}_{{{first},\ell}}$", fontsize=10)
        above.set_ylabel(rf"${quantity}$  [$\mu$K$^2$], {'Bennett' if scaling.bennett else 'Hajian-Souradeep'}")
        above.legend(fontsize=8, frameon=False)
        below.set(xlabel=r"multipole $\ell$", ylabel=r"residual / $\sigma$", ylim=(-1.2 * largest, 1.2 * largest))
        for one_axes in (above, below):
            one_axes.axhline(0.0, color="0.6", linewidth=0.8, zorder=0)
    _factors(axes[0, -1], fits)
    _words(axes[1, -1], fits)
    return figure


def _factors(axes: Axes, fits: Sequence[Fit]) -> None:
    drawn = [one.factor() for one in fits]
    for one, (factor, width) in zip(fits, drawn, strict=True):
        colour = _COLOURS[one.model.name]
        axes.plot(one.ell, factor, color=colour, label=f"{one.model.name} ± 1σ")
        axes.fill_between(one.ell, factor - width, factor + width, color=colour, alpha=0.2, linewidth=0)
    axes.axhline(1.0, color="0.6", linewidth=0.8, zorder=0)
    # At low l, where the templates vanish, a flexible model is unconstrained: its band may exceed the axes.
    from_there = [(f[len(f) // 4 :], np.broadcast_to(w, f.shape)[len(f) // 4 :]) for f, w in drawn]
    centre = np.concatenate([factor for factor, _ in from_there])
    margin = max(float(np.ptp(centre)), *(4.0 * float(np.median(width)) for _, width in from_there))
    margin = max(margin, 1e-3 * float(np.max(np.abs(centre))))
    axes.set_ylim(float(centre.min()) - margin, float(centre.max()) + margin)
    axes.set_title(r"$f_\ell = b_{\ell 2}^\mathrm{eff} / b_{\ell 2}$", fontsize=10)
    axes.set_xlabel(r"multipole $\ell$")
    axes.legend(fontsize=8, frameon=False)


def _words(axes: Axes, fits: Sequence[Fit]) -> None:
    """Write the parameters and tests as text under f_l."""
    axes.set_axis_off()
    lines = []
    for one in fits:
        found = one.solution
        values = zip(one.model.parameters, found.parameters, found.errors, strict=True)
        shown = ", ".join(f"{name} = {measured(value, error)}" for name, value, error in values)
        lines += [
            f"{one.model.name}: {shown if len(found.parameters) <= 2 else f'{len(found.parameters)} parameters'}",
            rf"   $\chi^2$/dof = {found.chi2:.1f}/{found.dof} = {found.reduced_chi2:.2f}",
            f"   p = {found.probability:.2g}",
        ]
    axes.text(0.0, 0.95, "\n".join(lines), transform=axes.transAxes, fontsize=8, va="top")
