"""Figure of the binned BipoSH spectra of an ensemble with error bars."""

import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from mcsim.ensemble import opening
from mcsim.errors import InputError

_COLOURS = ("#1f5fa8", "#c44e22", "#3c8c3c", "#7b4fa3", "#8c6d1f", "#1f8f94")

_LEGEND: dict[str, Any] = {"fontsize": 8, "frameon": False}

SIGNAL, DWARFED = 5.0, 5.0
"""Errors from zero that make a signal of a point; height of axes, over that of the points, that hides it."""


def ensemble_figure(
    path: str | Path,
    L: int | None = None,
    M: int | None = None,
    d: int | None = None,
    pair: str | None = None,
    prediction: xr.Dataset | None = None,
    caption: bool = True,
) -> Figure:
    """Draw the binned BipoSH spectra of one pair of maps.

    ``path``: store with a summary. ``L``, ``M``, ``d``: draw only these; by default one panel for every L > 0 and M (L
    = 0 if there is no other). ``pair``: label of the pair; by default the first. ``prediction``: prediction by
    :func:`mcsim.predict`, drawn as dashed lines. ``caption``: with a title, and with notes below. Raise InputError if
    the selection is empty, or the prediction is in another frame or lacks the pair or a mode.
    """
    with opening.open_summary(path) as summary:
        pairs = [str(label) for label in summary["pair"].values]
        label = pairs[0] if pair is None else pair
        if label not in pairs:
            raise InputError(f"There is no pair {label} in {path}; choose among {'; '.join(pairs)}.")
        chosen = opening.read_in(summary.sel(pair=label), path)
    keep = np.ones(chosen.sizes["mode"], dtype=bool)
    wanted = {name: value for name, value in (("L", L), ("M", M), ("d", d)) if value is not None}
    for name, value in wanted.items():
        keep &= chosen[name].values == value
    if L is None and np.any(chosen["L"].values > 0):
        keep &= chosen["L"].values > 0
    # Modes that only pairs have (d < 0) are all NaN for an auto spectrum: nothing to draw.
    keep &= np.isfinite(chosen["biposh_binned_mean"].values).any(axis=-1)
    modes = chosen.isel(mode=np.flatnonzero(keep))
    if modes.sizes["mode"] == 0:
        asked = ", ".join(f"{name} = {value}" for name, value in wanted.items())
        raise InputError(
            f"{path} has no mode with {asked or 'finite values'} of the pair {label}; mcsim info names what it holds."
        )
    expected = None if prediction is None else _matching(prediction, label, modes)
    title = f"{Path(path).name}: {label.replace(',', ' × ')}, {int(modes['count'])} realizations"
    return _draw(modes, title if caption else None, expected)


def _matching(prediction: xr.Dataset, pair: str, modes: xr.Dataset) -> xr.Dataset:
    """Return the same pair and modes of a prediction."""
    own, other = (one.attrs.get("frame") for one in (modes, prediction))
    if None not in (own, other) and own != other:
        raise InputError(f"the ensemble is in the {own} frame, the prediction in the {other} one; predict in the same.")
    for dim, wanted in (("pair", [pair]), ("mode", modes["mode"].values.tolist())):
        there = prediction[dim].values.tolist()
        if lacking := [name for name in wanted if name not in there]:
            raise InputError(
                f"the prediction has no {dim} {lacking[0]} but {', '.join(map(str, there[:6]))}; predict from the "
                "configuration of the ensemble."
            )
    return prediction.sel(pair=pair, mode=modes["mode"].values)


def _draw(modes: xr.Dataset, title: str | None, expected: xr.Dataset | None) -> Figure:
    """Draw a panel for each L and M; ``title`` None: neither title nor notes."""
    panels = sorted({(int(a), int(b)) for a, b in zip(modes["L"].values, modes["M"].values, strict=True)})
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    size = (5.2 * columns, 3.6 * rows + 0.4) if len(panels) > 1 else (6.6, 4.6)
    figure = Figure(figsize=size, layout="constrained")
    paired = "biposh_difference_binned_mean" in modes
    for number, (L, M) in enumerate(panels):
        axes = figure.add_subplot(rows, columns, number + 1)
        inside = (modes["L"].values == L) & (modes["M"].values == M)
        for colour, index in zip(_COLOURS * 9, np.flatnonzero(inside), strict=False):
            _spectrum(axes, modes.isel(mode=index), colour, paired)
            if expected is not None:
                _expected(axes, expected.isel(mode=index), colour, paired)
        if paired and M == 0:
            _frame(axes, modes.isel(mode=np.flatnonzero(inside)))
        axes.axhline(0.0, color="0.6", linewidth=0.8, zorder=0)
        if title is not None or len(panels) > 1:
            axes.set_title(f"L = {L}, M = {M}", fontsize=10)
        quantity = rf"$\ell(\ell+1)\hat{{A}}^{{{L}{M}}}/2\pi$  [$\mu$K$^2$]"
        axes.set(xlabel=r"multipole $\ell = \ell_2$", ylabel=quantity)
        axes.legend(handles=[*axes.get_legend_handles_labels()[0], *_styles(paired and M == 0, expected)], **_LEGEND)
    if title is None:
        return figure
    figure.suptitle(title, fontsize=11, parse_math=False)
    notes = [r"$\hat{A}$: Bennett normalisation (odd parity: Hajian-Souradeep, rescaled alike)"]
    if paired:
        notes += ["points: non-circular minus circular-beam control; bands may leave the panel"]
    if expected is not None:
        notes.append(f"prediction: {expected.attrs['prediction']}")
    # Some 15 letters of this size fill an inch: longer lines would be cut off at both ends.
    figure.supxlabel(textwrap.fill(";  ".join(notes), round(14 * figure.get_figwidth())), fontsize=9)
    return figure


def _styles(band: bool, expected: xr.Dataset | None) -> list[Artist]:
    """Return what the legend says of bands and lines, whatever their colour."""
    found: list[Artist] = []
    if band:
        found.append(Patch(color="0.5", alpha=0.3, linewidth=0, label="plain mean ± its error"))
    if expected is not None:
        found.append(Line2D([], [], color="0.3", linestyle="--", linewidth=1.0, label="prediction"))
    return found


def _frame(axes: Axes, modes: xr.Dataset) -> None:
    """Let the axes show the points where these differ from zero and the bands would dwarf them."""
    values = modes["biposh_difference_binned_mean"].values
    error = modes["biposh_difference_binned_standard_error"].values
    if not np.isfinite(error).any():  # of one realization: there are no bands
        return
    parts = np.stack([values.real, values.imag])
    low, high = min(0.0, float(np.nanmin(parts - error))), max(0.0, float(np.nanmax(parts + error)))
    bottom, top = axes.get_ylim()
    if np.any(np.abs(values) > SIGNAL * error) and top - bottom > DWARFED * (high - low):
        axes.set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))


def _abscissa(one: xr.Dataset) -> np.ndarray:
    """Return the centres of the bins, with modes of one panel a tenth of a bin apart."""
    width = one["bin_last"].values - one["bin_first"].values + 1.0
    return np.asarray(one["bin"].values + 0.1 * width * int(one["d"]))


def _parts(one: xr.Dataset) -> list[bool]:
    """Return the nonzero parts of a mode: False for the real one, True for the imaginary one."""
    return [str(one["parity"].values) == "odd"] if int(one["M"]) == 0 else [False, True]


def _component(one: xr.Dataset, name: str, imaginary: bool) -> np.ndarray:
    values = one[name].values
    return np.asarray(values.imag if imaginary else values.real)


def _error(one: xr.Dataset, name: str, imaginary: bool) -> np.ndarray:
    """Return the standard error of a part; in summaries that do not have it parts share that of the modulus equally."""
    own = f"{name}_standard_error_{'imag' if imaginary else 'real'}"
    if own in one:
        return np.asarray(one[own].values)
    return np.asarray((1.0 if int(one["M"]) == 0 else np.sqrt(0.5)) * one[f"{name}_standard_error"].values)


def _expected(axes: Axes, one: xr.Dataset, colour: str, paired: bool) -> None:
    """Draw the prediction of one mode, a line for each part."""
    name = f"biposh{'_difference' if paired else ''}_binned_mean"
    for imaginary in _parts(one):
        dashes = ":" if imaginary and int(one["M"]) > 0 else "--"
        axes.plot(_abscissa(one), _component(one, name, imaginary), dashes, color=colour, linewidth=1.0)


def _spectrum(axes: Axes, one: xr.Dataset, colour: str, paired: bool) -> None:
    """Draw one mode: points with errors and, if paired, the band of the plain mean behind them."""
    d, M, odd = int(one["d"]), int(one["M"]), str(one["parity"].values) == "odd"
    name, x = f"biposh{'_difference' if paired else ''}_binned", _abscissa(one)
    for imaginary in _parts(one):
        label = f"d = {d}" + (f", {'imaginary' if imaginary else 'real'}" if M > 0 or odd else "")
        filling, marker = "white" if imaginary and M > 0 else colour, "s" if imaginary else "o"
        values, error = _component(one, f"{name}_mean", imaginary), _error(one, name, imaginary)
        axes.errorbar(
            x, values, error, fmt=marker, ms=3.5, mfc=filling, color=colour, linewidth=1.0, capsize=2, label=label
        )
        if paired and M == 0:
            middle = _component(one, "biposh_binned_mean", imaginary)
            width = _error(one, "biposh_binned", imaginary)
            axes.fill_between(x, middle - width, middle + width, color=colour, alpha=0.15, linewidth=0)
