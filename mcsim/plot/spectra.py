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

# Okabe and Ito's palette: told apart with any colour vision. Markers tell more than six apart, and without colours.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_MARKERS = "os^Dv"

_LEGEND: dict[str, Any] = {"fontsize": 8, "frameon": False}

INSIDE = 4
"""Lines up to which the legend of a single panel stands inside it."""

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
    count, frame = int(modes["count"]), modes.attrs.get("frame")
    which = f" (of {len(pairs)} pairs)" if len(pairs) > 1 else ""
    title = f"{Path(path).name}: {label.replace(',', ' × ')}{which}, {count} realization{'s' if count != 1 else ''}"
    return _draw(modes, title + (f", {frame} frame" if frame else "") if caption else None, expected)


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
    # The same d looks the same in every panel.
    order = sorted({int(d) for d in modes["d"].values}, key=lambda d: (abs(d), d < 0))
    looks = {d: (_COLOURS[k % len(_COLOURS)], _MARKERS[k % len(_MARKERS)]) for k, d in enumerate(order)}
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    paired = "biposh_difference_binned_mean" in modes
    bands = paired and any(M == 0 for _, M in panels) and int(modes["count"]) > 1
    legend = _legend(modes, looks, bands, expected)
    beside = len(panels) > 1 or len(legend) > INSIDE
    size = (5.2 * columns, 3.6 * rows + 0.4) if len(panels) > 1 else (6.6, 4.6)
    figure = Figure(figsize=(size[0] + 1.4 * beside, size[1]), layout="constrained")
    for number, (L, M) in enumerate(panels):
        axes = figure.add_subplot(rows, columns, number + 1)
        inside = (modes["L"].values == L) & (modes["M"].values == M)
        for index in np.flatnonzero(inside):
            look = looks[int(modes["d"].values[index])]
            _spectrum(axes, modes.isel(mode=index), look, paired)
            if expected is not None:
                _expected(axes, expected.isel(mode=index), look[0], paired)
        if paired and M == 0:
            _frame(axes, modes.isel(mode=np.flatnonzero(inside)))
        if modes.sizes["bin"] == 1:  # not a part of one degree
            axes.set_xlim(float(modes["bin_first"][0]) - 0.5, float(modes["bin_last"][0]) + 0.5)
        axes.axhline(0.0, color="0.6", linewidth=0.8, zorder=0)
        if title is not None or len(panels) > 1:
            axes.set_title(f"L = {L}, M = {M}", fontsize=10)
        quantity = rf"$\ell(\ell+1)\hat{{A}}^{{{L}{M}}}/2\pi$  [$\mu$K$^2$]"
        axes.set(xlabel=r"multipole $\ell = \ell_2$", ylabel=quantity)
    if beside:
        figure.legend(handles=legend, loc="outside right upper", **_LEGEND)
    else:
        figure.axes[0].legend(handles=legend, **_LEGEND)
    if title is None:
        return figure
    figure.suptitle(title, fontsize=11, parse_math=False)
    # Some 15 letters of this size fill an inch: longer lines would be cut off at both ends.
    notes = textwrap.fill(";  ".join(_notes(modes, bands, expected)), round(14 * figure.get_figwidth()))
    figure.supxlabel(notes, fontsize=9)
    return figure


def _legend(
    modes: xr.Dataset, looks: dict[int, tuple[str, str]], bands: bool, expected: xr.Dataset | None
) -> list[Artist]:
    """Return what the legend says: d by colour and marker, then parts, bands and lines, whatever their colour."""
    found: list[Artist] = [
        Line2D([], [], color=colour, marker=marker, markersize=4, linestyle="none", label=f"$d$ = {d}")
        for d, (colour, marker) in looks.items()
    ]
    parts = {imaginary for k in range(modes.sizes["mode"]) for imaginary in _parts(modes.isel(mode=k))}
    grey: dict[str, Any] = {"color": "0.3", "marker": "o", "markersize": 4, "linestyle": "none"}
    if True in parts:
        found += [Line2D([], [], label="filled: real part", **grey)] if False in parts else []
        found.append(Line2D([], [], mfc="white", label="open: imaginary part", **grey))
    if bands:
        found.append(Patch(color="0.5", alpha=0.3, linewidth=0, label="plain mean ± 1σ\n(no control taken off)"))
    if expected is not None:
        line: dict[str, Any] = {"color": "0.3", "linewidth": 1.0}
        real = "prediction" if True not in parts else "prediction, real"
        found += [Line2D([], [], linestyle="--", label=real, **line)] if False in parts else []
        if True in parts:
            found.append(Line2D([], [], linestyle=":", label="prediction, imaginary", **line))
    return found


def _notes(modes: xr.Dataset, bands: bool, expected: xr.Dataset | None) -> list[str]:
    """Return the notes below the figure."""
    count = int(modes["count"])
    scatter = f"± 1σ of the mean of {count} realizations" if count > 1 else "one realization, without errors"
    mean = "mean" if count > 1 else "value"
    notes = [r"$\hat{A}$: Bennett normalisation (odd parity: Hajian-Souradeep, rescaled alike)", r"$d=\ell_2-\ell_1$"]
    if "biposh_difference_binned_mean" in modes:
        notes.append(f"points: {mean} of non-circular minus circular-beam control of the same skies, {scatter}")
    else:
        notes.append(f"points: {mean}, {scatter}")
    if bands:
        notes.append("bands: plain mean, of the non-circular skies alone (M = 0); they may leave the panel")
    if modes.sizes["mode"] > 1:
        notes.append("points of a bin stand side by side")
    if expected is not None:
        notes.append(f"prediction: {expected.attrs['prediction']}")
    return notes


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


def _abscissa(one: xr.Dataset, imaginary: bool = False) -> np.ndarray:
    """Return the centres of the bins, with modes of one panel a tenth of a bin apart, and their two parts less."""
    width = float(np.max(one["bin_last"].values - one["bin_first"].values)) + 1.0
    part = 0.04 * (imaginary and int(one["M"]) > 0)
    return np.asarray(one["bin"].values + width * (0.1 * int(one["d"]) + part))


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
        x, values = _widened(_abscissa(one, imaginary), _component(one, name, imaginary))
        axes.plot(x, values, ":" if imaginary else "--", color=colour, linewidth=1.0)


def _spectrum(axes: Axes, one: xr.Dataset, look: tuple[str, str], paired: bool) -> None:
    """Draw one mode: points with errors and, if paired, the band of the plain mean behind them."""
    colour, marker = look
    name = f"biposh{'_difference' if paired else ''}_binned"
    for imaginary in _parts(one):
        x, filling = _abscissa(one, imaginary), "white" if imaginary else colour
        values, error = _component(one, f"{name}_mean", imaginary), _error(one, name, imaginary)
        axes.errorbar(x, values, error, fmt=marker, ms=3.5, mfc=filling, color=colour, linewidth=1.0, capsize=2)
        if paired and int(one["M"]) == 0:
            x, middle, width = _widened(
                x, _component(one, "biposh_binned_mean", imaginary), _error(one, "biposh_binned", imaginary)
            )
            axes.fill_between(x, middle - width, middle + width, color=colour, alpha=0.15, linewidth=0)


def _widened(x: np.ndarray, *values: np.ndarray) -> list[np.ndarray]:
    """Return places and values as they are, or a single place as a short stretch, so that a line or band shows."""
    if len(x) > 1:
        return [x, *values]
    return [x[0] + np.array([-0.5, 0.5]), *(np.repeat(one, 2) for one in values)]
