"""Pictures of a diagnosis: excess chi^2, candidates, elements, residual maps, correlations and calibration."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from mcsim.datavector.summaries import KINDS
from mcsim.diagnosis.control_result import Controls
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.diagnosis.selection import Contrast
from mcsim.plot.cells import write_cells
from mcsim.plot.sky import mollweide
from mcsim.stats.detection import snr_to_separate
from mcsim.support.numbers import measured, p_equals

# Okabe and Ito's palette: told apart with any colour vision.
BLUE, RED, AMBER = "#0072b2", "#d55e00", "#e69f00"
GREY, PALE = "#999999", "#dcdcdc"

TOP, MAPS, LEAST = 15, 12, 1e-8
"""Candidates that are drawn, residual maps, and the p-value where the scale of controls ends."""

WHOLE = 64
"""Characters up to which the names of candidates and elements are drawn whole."""

LIMIT = 8.0
"""Deviation at which the colours of the table of blocks end."""


def excess_figure(result: DiagnosisResult) -> Figure:
    """Draw the excess chi^2 before and after, on held-out data where they are measured."""
    figure = Figure(figsize=(6.4, 2.2), layout="constrained")
    axes = figure.subplots()
    found, expected = result.held_out, 0.0
    rows, of = [("model", result.excess, RED)], "all data"
    if found is not None:
        rows, of = [("model", found.before, RED), ("with the effects", found.after, BLUE)], f"data: {found.data}"
        expected = found.before.value * (1.0 - found.predicted.value)
        axes.plot([expected] * 2, [0.6, 1.4], color="black", linestyle=":", linewidth=1.8, label="predicted", zorder=3)
        axes.legend(frameon=False, fontsize=8)
    elif result.sets:
        rows.append(("after the fit", result.sets[0].excess, BLUE))
        of = "the data that were fitted"
    beside: dict[str, Any] = {"xytext": (6, 0), "textcoords": "offset points", "va": "center", "fontsize": 9}
    ends = [max(one.value + one.sigma, 0.0) for _, one, _ in rows]
    if found is not None:
        ends[1] = max(ends[1], expected)  # the number stands beyond the line of what was predicted
    for row, (_, one, colour) in enumerate(rows):
        axes.barh(row, one.value, 0.62, color=colour, xerr=one.sigma, capsize=3, error_kw={"linewidth": 1.2})
        axes.annotate(measured(one.value, one.sigma), (ends[row], row), **beside)
    axes.set_yticks(range(len(rows)), [label for label, *_ in rows])
    axes.set_ylim(len(rows) - 0.45, -0.55)
    low = min(0.0, expected, *(one.value - one.sigma for _, one, _ in rows))
    axes.set_xlim(1.1 * low, max(1.4 * max(ends), -0.35 * low, 1.0))
    axes.axvline(0.0, color="black", linewidth=0.8)
    axes.spines["left"].set_visible(False)
    axes.set_xlabel(f"excess $\\chi^2$ (0: the model is right)\n{_label(of, 60)}", fontsize=9)
    _bare(axes)
    return figure


def candidates_figure(result: DiagnosisResult) -> Figure:
    """Draw the candidates fitted alone, ranked."""
    rows = result.ranked[:TOP]
    figure = Figure(figsize=(7.2, 1.0 + 0.27 * len(rows)), layout="constrained")
    axes = figure.subplots()
    accepted = [{result.candidates[k].label for k in one.candidates} for one in result.sets]
    named, others = (accepted[0] if accepted else set()), set().union(*accepted[1:])
    level = result.settings.alpha
    colours = [
        BLUE if row.label in named else AMBER if row.label in others else GREY if row.pvalue < level else PALE
        for row in rows
    ]
    axes.barh(range(len(rows)), [row.significance for row in rows], height=0.7, color=colours)
    beside: dict[str, Any] = {"xytext": (4, 0), "textcoords": "offset points", "va": "center", "fontsize": 7.5}
    for place, row in enumerate(rows):
        axes.annotate(p_equals(row.pvalue), (row.significance, place), **beside)
    axes.set_yticks(range(len(rows)), _labels([row.label for row in rows], WHOLE), fontsize=8)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xlim(0.0, 1.25 * max([row.significance for row in rows], default=0.0) or 1.0)
    shown = [
        ("blue: best set", BLUE),
        ("amber: an alternative", AMBER),
        (f"pale: not significant, p ≥ {level:g}", PALE),
    ]
    key = ", ".join(word for word, colour in shown if colour in colours)
    words = "fitted alone: $\\sqrt{\\Delta\\chi^2}$; p: look-elsewhere effect included"
    axes.set_xlabel(words + (f"\n({key})" if key else ""), fontsize=9)
    _bare(axes)
    return figure


def blocks_figure(result: DiagnosisResult) -> Figure:
    """Draw the largest deviation of every kind of element in every map, before and after the fit."""
    columns = [
        ("several channels" if len(e.channels) != 1 else " ".join(filter(None, (e.channels[0], e.split))))
        for e in result.elements
    ]
    names = sorted(set(columns), key=lambda name: (name == "several channels", name))
    kinds = list(dict.fromkeys(element.family for element in result.elements))
    at = np.array(
        [(kinds.index(e.family), names.index(column)) for e, column in zip(result.elements, columns, strict=True)]
    )
    panels = {"data less the model": result.z}
    if result.z_after is not None:
        panels = {"before": result.z, "after the best fit": result.z_after}
    rows = _labels(kinds, 80)
    # Beside the names of the rows panels of less than 1.6 inches would cut their titles and the words of the bar.
    width = 0.3 + 0.062 * max(map(len, rows)) + len(panels) * max(0.62 * len(names) + 0.3, 1.6)
    figure = Figure(figsize=(width, 2.6 + 0.27 * len(kinds)), layout="constrained")
    grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    shown: Any = None
    for axes, (title, z) in zip(grid, panels.items(), strict=True):
        table = np.full((len(kinds), len(names)), np.nan)
        # The largest deviation of each kind and map is written last, and stays.
        order = np.argsort(np.abs(z))
        table[tuple(at[order].T)] = z[order]
        axes.set_facecolor("#e6e6e6")
        shown = axes.imshow(table, cmap="RdBu_r", vmin=-LIMIT, vmax=LIMIT, aspect="auto")
        numbers = (
            (cell, f"{value:+.1f}".replace("-", "−")) for cell, value in np.ndenumerate(table) if np.isfinite(value)
        )
        write_cells(axes, numbers, np.abs(table) > 0.62 * LIMIT, 7)
        axes.set_xticks(range(len(names)), _labels(names, 22), rotation=45, ha="right", fontsize=8)
        axes.set_yticks(range(len(kinds)), rows, fontsize=8)
        axes.set_title(title, fontsize=10)
    label = "largest deviation\n[standard deviations]\ngrey: not measured"
    figure.colorbar(shown, ax=list(grid), label=label, extend="both", location="bottom", shrink=0.6, aspect=40)
    return figure


def elements_figure(result: DiagnosisResult) -> Figure:
    """Draw the deviation of every element before and after the fit, kind by kind."""
    shown = [(e.component if e.kind == "table" else None) or KINDS.get(e.kind, e.kind) for e in result.elements]
    kinds = list(dict.fromkeys(shown))
    order = sorted(range(len(shown)), key=lambda k: kinds.index(shown[k]))
    figure = Figure(figsize=(10.5, 4.4), layout="constrained")
    axes = figure.subplots()
    axes.axhspan(-2.0, 2.0, color="#e9e9e9", zorder=0)
    place = np.arange(len(order))
    first = "data less the model" if result.z_after is None else "before"
    axes.plot(place, result.z[order], "o", markersize=3.2, color=RED, label=first)
    if result.z_after is not None:
        axes.plot(place, result.z_after[order], "o", markersize=3.2, color=BLUE, label="after the best fit")
    grey: dict[str, Any] = {"color": "0.6", "linewidth": 0.6}
    line = {"arrowstyle": "-", "shrinkA": 0.0, "shrinkB": 0.0, "relpos": (0.0, 0.0), **grey}
    tilted: dict[str, Any] = {"rotation": 35, "rotation_mode": "anchor", "fontsize": 8, "arrowprops": line}
    coordinates: dict[str, Any] = {"xycoords": axes.get_xaxis_transform(), "textcoords": "axes fraction"}
    for number, kind in enumerate(kinds):
        own = place[[shown[k] == kind for k in order]]
        axes.axvline(own[0] - 0.5, **grey)
        # Names stand apart from each other, whatever the number of elements of each kind.
        name, beyond = _label(kind, 60), ((number + 0.3) / len(kinds), 1.09)
        axes.annotate(name, (own.mean(), 1.0), beyond, **coordinates, **tilted)
    axes.set_yscale("symlog", linthresh=5.0)
    largest = max(float(np.max(np.abs(result.z))), 5.0)
    ticks = [tick for tick in (0.0, 2.0, 5.0, 10.0, 30.0, 100.0, 300.0, 1000.0) if tick <= largest]
    axes.set_yticks([*(-tick for tick in ticks[:0:-1]), *ticks])
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set(xlim=(-1.0, len(order)), ylim=(-1.2 * largest, 1.2 * largest), xlabel="element of the data vector")
    axes.set_ylabel("deviation [standard deviations]\n(logarithmic beyond 5)")
    figure.legend(loc="outside lower right", frameon=False, fontsize=8, ncols=2)
    return figure


def residual_figure(result: DiagnosisResult) -> Figure | None:
    """Draw the residual of every map, or of those with the most unusual rms; None where the data were no maps."""
    if result.residual_maps is None or result.residual_range is None:
        return None
    rms = np.sqrt(np.nanmean(result.residual_maps**2, axis=1))
    middle, width = result.residual_range.mean(axis=1), np.ptp(result.residual_range, axis=1)
    chosen = np.sort(np.argsort(-np.abs(rms - middle) / width, kind="stable")[:MAPS])
    columns = min(2, len(chosen))
    rows = -(-len(chosen) // columns)
    figure = Figure(figsize=(4.9 * columns, 2.8 * rows + 0.8), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    shown: Any = None
    # Sharp pixels: smoothed ones make the file three times as large.
    style: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -4.0, "vmax": 4.0, "interpolation": "nearest"}
    names = _labels([result.maps[k].replace(":", " ") for k in chosen], 40)
    for axes, k, name in zip(grid, chosen, names, strict=False):
        shown = mollweide(axes, result.residual_maps[k], 700, **style)
        low, high = result.residual_range[k]
        axes.set_title(f"{name}: rms {rms[k]:.2f} (simulations {low:.2f} to {high:.2f})", fontsize=9)
    for axes in grid:
        axes.set_axis_off()
    label = "residual over the scatter of simulations"
    figure.colorbar(shown, ax=list(grid), orientation="horizontal", shrink=0.5, aspect=35, extend="both", label=label)
    return figure


def correlation_figure(result: DiagnosisResult) -> Figure:
    """Draw the largest canonical correlation of every pair of candidates."""
    scale = {"cmap": "Blues", "vmin": 0.0, "vmax": 1.0}
    return _matrix(result, result.correlation, "correlation of the responses", scale)


def separation_figure(result: DiagnosisResult) -> Figure:
    """Draw the strength at which the right one of each pair is chosen in 95 cases of 100."""
    needed = snr_to_separate(result.correlation)
    np.fill_diagonal(needed, np.nan)
    scale = {"cmap": "viridis_r", "norm": LogNorm(2.0, 100.0)}
    return _matrix(result, np.clip(needed, None, 1e4), "amplitude/error needed to choose the right one", scale)


def calibration_figure(result: DiagnosisResult) -> Figure:
    """Draw the p-values of simulations against the others, and the data's p-value among draws of the model."""
    figure = Figure(figsize=(9.0, 3.1), layout="constrained")
    left, right = figure.subplots(1, 2)
    held, bins = result.held_out_pvalues, 20
    left.hist(held, bins=bins, range=(0.0, 1.0), histtype="step", color=BLUE, linewidth=1.6)
    low, high = stats.binom.interval(0.95, len(held), 1.0 / bins)
    left.axhspan(low, high, color="0.88", zorder=0)
    left.axhline(len(held) / bins, color="black", linewidth=0.8)
    left.set(xlim=(0.0, 1.0), ylim=(0.0, None), ylabel=f"number of {len(held)} simulations")
    left.set_xlabel(r"p-value of the $\chi^2$ of each simulation")
    left.set_title("grey: 95 % of bins if uniform", fontsize=9)
    draws = np.maximum(np.sort(result.calibration), 1e-12)
    rank = (1.0 + np.arange(len(draws))) / (1.0 + len(draws))
    right.plot(draws, rank, color=BLUE, label="draws of the model")
    p = result.test.pvalue
    inside = p >= rank[0]
    at = float(np.interp(p, rank, draws)) if inside else draws[0]
    shown = p if inside else rank[0] / 2.0
    right.plot(at, shown, "o" if inside else "v", color=RED, markersize=8, label=f"data, {p_equals(p)}")
    right.axhline(0.05, color="black", linewidth=0.8, linestyle="--")
    right.annotate("5 %", (draws[0], 0.05), xytext=(2, 3), textcoords="offset points", fontsize=8)
    right.set(xscale="log", yscale="log", ylim=(rank[0] / 3.0, 1.5), ylabel="fraction of draws below")
    right.set_xlabel(r"smaller p-value: $\chi^2$ or best candidate")
    right.set_title("" if inside else "triangle: below all draws", fontsize=9)
    right.legend(frameon=False, fontsize=8, loc="lower right")
    for axes in (left, right):
        _bare(axes)
    return figure


def controls_figure(result: DiagnosisResult, controls: Controls) -> Figure:
    """Draw the p-values of the controls against their ranks, with that of the data."""
    figure = Figure(figsize=(5.4, 3.1), layout="constrained")
    axes, count = figure.subplots(), len(controls.members)
    p, rank = np.maximum(controls.pvalues, LEAST), np.arange(1, count + 1)
    expected = rank / (count + 1.0)
    axes.fill_between(expected, *stats.beta.interval(0.95, rank, count + 1 - rank), color="0.88", zorder=0)
    axes.plot([expected[0] / 2.0, 1.0], [expected[0] / 2.0, 1.0], color="black", linewidth=0.8)
    axes.plot(expected, p, "o", color=BLUE, markersize=5, label="controls")
    data = f"data, {p_equals(result.test.pvalue)}" + " (off the scale)" * (result.test.pvalue < LEAST)
    axes.axhline(max(result.test.pvalue, LEAST), color=RED, linewidth=1.4, label=data)
    level = f"different at {100.0 * controls.alpha:g} %"
    axes.axhline(controls.alpha, color="black", linewidth=0.8, linestyle="--", label=level)
    axes.set(xscale="log", yscale="log", xlabel="expected p-value of this rank", ylabel="global p-value")
    ticks = [tick for tick in (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0) if tick >= expected[0] / 2.0]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    figure.legend(frameon=False, fontsize=8, loc="outside upper center", ncols=3)
    _bare(axes)
    return figure


def contrast_figure(result: DiagnosisResult, one: Contrast) -> Figure:
    """Draw the elements in which two sets of effects differ most, with the data."""
    rows = [(k, share) for k, share in zip(one.elements, one.shares, strict=True) if share > 0.0][:8]
    where = [k for k, _ in rows]
    figure = Figure(figsize=(8.4, 1.6 + 0.36 * len(rows)), layout="constrained")
    axes = figure.subplots()
    for which, colour, marker, shift in ((one.first, BLUE, "D", -0.14), (one.second, AMBER, "s", 0.14)):
        label = _label(result.sets[which].label, 90)
        at = np.arange(len(rows)) + shift
        axes.plot(result.prediction(which)[where], at, marker, color=colour, linestyle="none", label=label)
    z = result.z[where]
    axes.errorbar(z, range(len(rows)), xerr=1.0, fmt="o", color="black", markersize=4, capsize=2, label="data")
    names = _labels([result.elements[k].words for k in where], WHOLE)
    labels = [f"{name}  ({100 * share:.0f} %)" for name, (_, share) in zip(names, rows, strict=True)]
    axes.set_yticks(range(len(rows)), labels, fontsize=8)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.axvline(0.0, color="0.6", linewidth=0.8, zorder=0)
    axes.set_xlabel("change of the element [standard deviations]", fontsize=9)
    _bare(axes)
    figure.legend(loc="outside upper left", frameon=False, fontsize=8)
    return figure


def _matrix(result: DiagnosisResult, values: NDArray[np.float64], label: str, scale: dict[str, Any]) -> Figure:
    labels = _labels([one.label for one in result.candidates], WHOLE)
    size = 6.5 if len(labels) > 12 else 9
    side = 0.8 + 0.008 * size * max(map(len, labels), default=0) + max(2.4, 0.15 * len(labels))
    figure = Figure(figsize=(side, side + 0.8), layout="constrained")
    axes = figure.subplots()
    shown = axes.imshow(values, interpolation="nearest", **scale)
    axes.set_xticks(range(len(labels)), labels, rotation=90, fontsize=size)
    axes.set_yticks(range(len(labels)), labels, fontsize=size)
    accepted = result.sets[0].candidates if result.sets else ()
    for ticks in (axes.get_xticklabels(), axes.get_yticklabels()):
        for k in accepted:
            ticks[k].set(color=RED, fontweight="bold")
    extend = "neither" if "vmin" in scale else "both"
    bar = figure.colorbar(shown, ax=axes, location="top", aspect=30, extend=extend)
    if "norm" in scale:
        marks = [2, 3, 5, 10, 20, 50, 100]
        bar.set_ticks(marks, labels=[str(mark) for mark in marks])
        bar.ax.minorticks_off()
    bar.set_label(label, fontsize=9)
    return figure


def _labels(texts: Sequence[str], width: int) -> list[str]:
    """Return labels of at most ``width`` characters, or of as many more as keep different texts apart."""
    different = len(set(texts))
    while len({_label(text, width) for text in texts}) < different:
        width += 1
    return [_label(text, width) for text in texts]


def _label(text: str, width: int) -> str:
    """Return text with its middle left out where it is long, as labels differ at both ends, and without mathematics."""
    short = text if len(text) <= width else f"{text[: width // 2]}…{text[len(text) - (width - 1) // 2 :]}"
    return short.replace("$", r"\$")


def _bare(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
