"""Figures of BipoSH: predictions against ensembles, and effective beams fitted to ensembles."""

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mcsim.beamfit import Fit
from mcsim.support.numbers import measured as with_error

SPECTRUM = {0: r"A^{20}_{\ell\ell}", 2: r"A^{20}_{\ell-2,\ell}"}
ENSEMBLE, EXACT, LEADING = "#c44e22", "#1f5fa8", "#3c8c3c"


def _mode(dataset: xr.Dataset, channel: str, d: int) -> xr.Dataset:
    return dataset.sel(pair=f"{channel},{channel}", mode=f"L2M0d{d}")


def against_simulations(
    summary: xr.Dataset, exact: xr.Dataset, leading: xr.Dataset, channels: dict[str, str]
) -> Figure:
    """A^{20} of every channel with its predictions, and below in units of the paired error.

    Parameters
    ----------
    summary
        Of a paired ensemble.
    exact, leading
        Its predictions.
    channels
        Name of a channel -> heading.
    """
    figure = Figure(figsize=(11.0, 4.9 * len(channels)), layout="constrained")
    grid = figure.subplots(2 * len(channels), 2, sharex=True, height_ratios=(2.4, 1.0) * len(channels))
    for row, (channel, title) in enumerate(channels.items()):
        for column, d in enumerate((0, 2)):
            above, below = grid[2 * row : 2 * row + 2, column]
            one, full, first = (_mode(dataset, channel, d) for dataset in (summary, exact, leading))
            _spectra(above, one, full)
            error = one["biposh_difference_binned_standard_error"].values
            measured, expected, approximate = (
                dataset["biposh_difference_binned_mean"].values.real for dataset in (one, full, first)
            )
            x = one["bin"].values
            below.errorbar(x, (measured - expected) / error, 1.0, fmt="o", ms=3, color=ENSEMBLE)
            below.plot(x, (approximate - expected) / error, color=LEADING, label="leading order")
            below.axhline(0, color=EXACT, lw=1)
            below.set_ylim(-6.5, 6.5)
            below.set_ylabel("residual / error")
            below.legend(frameon=False, fontsize=8, loc="lower right")
            above.set_title(title, fontsize=10)
            above.set_ylabel(rf"$\ell(\ell+1){SPECTRUM[d]}/2\pi$  [$\mu$K$^2$]")
            below.set_xlabel(r"multipole $\ell$")
            below.xaxis.set_tick_params(labelbottom=True)
    return figure


def _spectra(axes: Axes, one: xr.Dataset, exact: xr.Dataset) -> None:
    """Plain means with their errors, as the paper has them, paired differences, and the exact prediction."""
    x = one["bin"].values
    plain, paired = one["biposh_binned_mean"].values.real, one["biposh_difference_binned_mean"].values.real
    count = int(one["count"])
    axes.errorbar(
        x,
        plain,
        one["biposh_binned_standard_error"].values,
        fmt="s",
        ms=3,
        color="0.6",
        capsize=2,
        label=f"{count} skies, plain mean",
    )
    axes.errorbar(
        x,
        paired,
        one["biposh_difference_binned_standard_error"].values,
        fmt="o",
        ms=3.5,
        color=ENSEMBLE,
        label=f"{count} skies, paired difference",
    )
    axes.plot(x, exact["biposh_difference_binned_mean"].values.real, color=EXACT, lw=1.2, label="exact prediction")
    axes.axhline(0, color="0.6", lw=0.8)
    axes.legend(frameon=False, fontsize=8)


def agreement(summary: xr.Dataset, exact: xr.Dataset, leading: xr.Dataset, channels: Sequence[str]) -> list[str]:
    """A line for each channel and d: chi^2 per bin of the paired difference, and its largest value."""
    lines = []
    for channel in channels:
        for d in (0, 2):
            one = _mode(summary, channel, d).isel(bin=slice(0, -1))
            value = one["biposh_difference_binned_mean"].values.real
            covariance = one["biposh_difference_binned_covariance"].values.real[:, :-1] / int(one["count"])
            # Hartlap's factor: the inverse of a sample covariance of N skies is too large by its inverse.
            n, p = int(one["count"]), len(value)
            text = f"  {channel} d = {d}: strongest bin {value[np.argmax(np.abs(value))]:.1f} uK^2, chi^2/bins"
            for name, dataset in (("exact", exact), ("leading order", leading)):
                expected = (
                    _mode(dataset, channel, d).isel(bin=slice(0, -1))["biposh_difference_binned_mean"].values.real
                )
                residual = value - expected
                chi2 = (n - p - 2) / (n - 1) * residual @ np.linalg.solve(covariance, residual)
                text += f" {chi2 / p:.2f} ({name})"
            lines.append(text)
    return lines


def effective_beams(fits: Mapping[str, Sequence[Fit]], expected: float) -> Figure:
    """f_l of fits to hit-averaged data with parallel-transported beams, and the data over the template.

    Parameters
    ----------
    fits
        Heading -> constant and linear fit to the same data.
    expected
        Factor of the scan on A^{20}.
    """
    figure = Figure(figsize=(11.0, 3.9 * len(fits)), layout="constrained")
    grid = figure.subplots(len(fits), 2, squeeze=False)
    for (left, right), (title, models) in zip(grid, fits.items(), strict=True):
        measured = models[0].measured
        for one, colour in zip(models, (ENSEMBLE, EXACT), strict=True):
            solution, (factor, width) = one.solution, one.factor()
            values = ", ".join(
                f"$\\{name}$ = {with_error(value, error)}"
                for name, value, error in zip(one.model.parameters, solution.parameters, solution.errors, strict=True)
            )
            text = f"{values}\n$\\chi^2$/dof {solution.reduced_chi2:.2f}, probability {solution.probability:.2g}"
            left.plot(one.ell, factor, color=colour, label=text)
            left.fill_between(one.ell, factor - width, factor + width, color=colour, alpha=0.2, lw=0)
        left.axhline(expected, color="black", ls="--", lw=1, label=f"scan: {expected:.4f}")
        left.set_title(title, fontsize=10)
        left.set_ylabel(r"$f_\ell = b^\mathrm{eff}_{\ell 2}/b_{\ell 2}$")
        left.set_xlabel(r"multipole $\ell$")
        left.legend(frameon=False, fontsize=8, loc="upper right")
        low, high = left.get_ylim()
        left.set_ylim(low, high + 0.9 * (high - low))
        for mode, colour in zip(measured.modes, (ENSEMBLE, EXACT), strict=True):
            here = [i for i, row in enumerate(measured.rows) if row.mode == mode]
            x = [0.5 * (measured.rows[i].ell_min + measured.rows[i].ell_max) for i in here]
            error = np.sqrt(np.diag(measured.covariance))[here]
            right.errorbar(x, measured.value[here], error, fmt="o", ms=3.5, color=colour, label=f"${SPECTRUM[mode.d]}$")
            right.plot(x, models[0].best[here], color=colour, lw=1)
        right.axhline(0, color="0.6", lw=0.8)
        right.set_title("data, and the constant's best fit", fontsize=10)
        right.set_ylabel(r"$\ell(\ell+1)A/2\pi$  [$\mu$K$^2$]")
        right.set_xlabel(r"multipole $\ell$")
        right.legend(frameon=False, fontsize=9)
    return figure
