"""A diagnosis in pictures: the verdict, the evidence block by block, candidates, what is left, and the calibration."""

import textwrap
from typing import Any

import healpy
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from mcsim.diagnosis.inference import Diagnosis
from mcsim.diagnosis.view import APART, ExcessSummary, ReportView

# Okabe and Ito's palette: told apart with any colour vision.
BLUE, RED, GREEN, AMBER = "#0072b2", "#d55e00", "#00785a", "#e69f00"
_VERDICTS = {"none": GREEN, "effect": BLUE, "mixture": BLUE, "degenerate": "#8a5c00", "unknown": "#b04a00"}

TOP = 15
"""Candidates in the picture of impacts; the table has all."""

MAPS = 12
"""Residual maps in the picture."""

LIMIT = 8.0
"""Deviate at which the colours of the block picture end."""


def first_screen(diagnosis: Diagnosis) -> Figure:
    """The verdict in one picture: the sentence, the gap before and after, and the candidates that matter most.

    Parameters
    ----------
    diagnosis
        Of one case.
    """
    view = ReportView(diagnosis.verdict, diagnosis.evidence)
    kind = diagnosis.verdict["verdict"]
    lines = textwrap.wrap(_plain(sentence_for_people(diagnosis)), 110)
    top = 0.8 + 0.24 * len(lines)
    height = 2.6 + top
    figure = Figure(figsize=(9.6, height))
    figure.set_layout_engine("constrained", rect=(0.0, 0.0, 1.0, 1.0 - top / height), w_pad=0.15)
    figure.text(
        0.02,
        1.0 - 0.3 / height,
        f" {_plain(_short(str(diagnosis.verdict['case']), 60))}: {kind} ",
        fontsize=13,
        fontweight="bold",
        color="white",
        va="center",
        bbox={"facecolor": _VERDICTS[kind], "edgecolor": "none", "boxstyle": "round,pad=0.3"},
    ).set_in_layout(False)
    words = figure.text(0.02, 1.0 - 0.6 / height, "\n".join(lines), fontsize=10.5, va="top", linespacing=1.35)
    words.set_in_layout(False)
    left, right = figure.subplots(1, 2)
    draw_gap(left, view.excess)
    draw_impacts(right, view, 6)
    return figure


def sentence_for_people(diagnosis: Diagnosis) -> str:
    """The verdict's sentence with signs that a screen can show."""
    return diagnosis.sentence.replace(" +- ", " ± ")


def gap_figure(view: ReportView) -> Figure:
    """Gap before and after."""
    figure = Figure(figsize=(6.4, 2.2), layout="constrained")
    draw_gap(figure.subplots(), view.excess)
    return figure


def draw_gap(axes: Axes, gap: ExcessSummary) -> None:
    """Bars of the gap, with what was predicted to remain."""
    values = [(gap.before, gap.before_sigma, "gap now" if gap.after is None else "before", RED)]
    if gap.after is not None:
        values.append((gap.after, gap.after_sigma, "with the effect" if gap.expected is not None else "after", BLUE))
    for row, (value, sigma, _, colour) in enumerate(values):
        axes.barh(row, value, height=0.62, color=colour)
        if sigma > 0.0:
            axes.errorbar(value, row, xerr=sigma, color="black", capsize=3, linewidth=1.2)
        axes.annotate(
            f"{value:.0f} ± {sigma:.0f}" if sigma > 0.0 else f"{value:.0f}",
            (max(value + sigma, 0.0), row),
            xytext=(6, 0),
            textcoords="offset points",
            va="center",
            fontsize=9,
        )
    axes.set_yticks(range(len(values)), [label for *_, label, _ in values])
    axes.set_ylim(len(values) - 0.45, -0.55)
    if gap.expected is not None:
        axes.plot([gap.expected] * 2, [0.6, 1.4], color="black", linestyle=":", linewidth=1.8, label="predicted")
        axes.legend(frameon=False, fontsize=8)
    reach = max(value + sigma for value, sigma, *_ in values)
    low = min(0.0, *(value - sigma for value, sigma, *_ in values), gap.expected or 0.0)
    axes.set_xlim(1.1 * low, max(1.3 * reach, -0.35 * low, 1.0))
    axes.axvline(0.0, color="black", linewidth=0.8)
    axes.set_xlabel(f"gap: $\\chi^2$ above expectation\n({_plain(gap.words)})", fontsize=9)
    _bare(axes)


def impacts_figure(view: ReportView) -> Figure:
    """Candidates fitted alone, ranked."""
    count = min(TOP, len(view.ranked))
    figure = Figure(figsize=(7.2, 1.0 + 0.27 * count), layout="constrained")
    draw_impacts(figure.subplots(), view, TOP)
    return figure


def draw_impacts(axes: Axes, view: ReportView, count: int) -> None:
    """Bars of the root of the fall of chi^2 of each candidate alone; those of the accepted set in colour."""
    rows = view.ranked[:count]
    colours = [BLUE if row.accepted else AMBER if row.alternative else "#b5b5b5" for row in rows]
    axes.barh(range(len(rows)), [row.impact for row in rows], height=0.7, color=colours)
    axes.set_yticks(range(len(rows)), [_plain(_short(row.label, 34)) for row in rows], fontsize=8)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    shown = [("blue: best explanation", BLUE), ("amber: an alternative", AMBER)]
    words = ", ".join(word for word, colour in shown if colour in colours)
    axes.set_xlabel(r"fitted alone: $\sqrt{\Delta\chi^2}$ [sigmas]" + (f"\n({words})" if words else ""), fontsize=9)
    _bare(axes)


def blocks_figure(view: ReportView) -> Figure:
    """Largest deviate of every block, before and after the fit."""
    kinds, columns, tables = view.blocks
    width = 2.4 + len(tables) * (0.62 * len(columns) + 0.3)
    figure = Figure(figsize=(width, 2.6 + 0.27 * len(kinds)), layout="constrained")
    grid = figure.subplots(1, len(tables), sharey=True, squeeze=False)[0]
    titles = ["data against model", "left by the best explanation"]
    shown: Any = None
    for axes, table, title in zip(grid, tables, titles, strict=False):
        axes.set_facecolor("#e6e6e6")
        shown = axes.imshow(table, cmap="RdBu_r", vmin=-LIMIT, vmax=LIMIT, aspect="auto")
        for (row, column), value in np.ndenumerate(table):
            if np.isfinite(value):
                colour = "white" if abs(value) > 0.62 * LIMIT else "black"
                axes.text(column, row, f"{value:+.1f}", ha="center", va="center", fontsize=7, color=colour)
        axes.set_xticks(
            range(len(columns)), [_plain(_short(name, 22)) for name in columns], rotation=45, ha="right", fontsize=8
        )
        axes.set_yticks(range(len(kinds)), [_plain(_short(kind, 36)) for kind in kinds], fontsize=8)
        axes.set_title(title, fontsize=10)
    words = "largest deviate in a block\n[sigmas]; grey: none"
    figure.colorbar(shown, ax=list(grid), label=words, extend="both", location="bottom", shrink=0.6, aspect=40)
    return figure


def entries_figure(view: ReportView) -> Figure:
    """Every deviate before and after the fit, kind by kind."""
    order = sorted(range(len(view.elements)), key=lambda k: _family(view.elements[k]["name"]))
    families = [_family(view.elements[k]["name"]) for k in order]
    figure = Figure(figsize=(10.5, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.axhspan(-2.0, 2.0, color="#e9e9e9", zorder=0)
    place = list(range(len(order)))
    axes.plot(place, view.z[order], "o", markersize=3.2, color=RED, label="data against model")
    if view.left is not None:
        axes.plot(place, view.left[order], "o", markersize=3.2, color=BLUE, label="left by the best explanation")
    starts = [k for k in place if k == 0 or families[k] != families[k - 1]]
    for start, stop in zip(starts, [*starts[1:], len(order)], strict=True):
        axes.axvline(start - 0.5, color="0.6", linewidth=0.6)
        axes.text(
            (start + stop - 1) / 2,
            1.01,
            _plain(families[start][1].replace("score", "matched")),
            rotation=35,
            fontsize=8,
            transform=axes.get_xaxis_transform(),
            va="bottom",
        )
    axes.set_yscale("symlog", linthresh=5.0)
    largest = max(float(np.max(np.abs(view.z))), 5.0)
    axes.set_yticks(*_ticks(largest))
    axes.set_ylim(-1.2 * largest, 1.2 * largest)
    axes.set_xlim(-1.0, len(order))
    axes.set_xlabel("entry of the evidence (straight up to 5 sigmas, logarithmic beyond)")
    axes.set_ylabel("deviate [sigmas]")
    figure.legend(loc="outside lower right", frameon=False, fontsize=8, ncols=2)
    return figure


def residual_figure(view: ReportView) -> Figure | None:
    """Residual of every map, or of the most unusual ones, over its noise; None where the data were no maps."""
    if "residual_map" not in view.evidence:
        return None
    maps = view.evidence["residual_map"]
    rms = np.sqrt(np.nanmean(maps.values**2, axis=1))
    if len(rms) > MAPS:
        maps = maps.isel(map=np.sort(np.argsort(-np.abs(rms - 1.0))[:MAPS]))
    names = [str(name) for name in maps["map"].values]
    columns = min(2, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(4.9 * columns, 2.8 * rows + 0.8), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    shown: Any = None
    for axes, name, values in zip(grid, names, maps.values, strict=False):
        shown = _mollweide(axes, values)
        axes.set_title(f"{_plain(_short(name, 40))}: rms {np.sqrt(np.nanmean(values**2)):.2f}", fontsize=10)
    for axes in grid:
        axes.set(xticks=[], yticks=[], frame_on=False)
    figure.colorbar(
        shown,
        ax=list(grid),
        orientation="horizontal",
        shrink=0.5,
        aspect=35,
        extend="both",
        label="residual [standard deviations of the noise]",
    )
    return figure


def correlation_figure(view: ReportView) -> Figure:
    """Largest canonical correlation of every pair of candidates."""
    return _matrix(
        view,
        view.evidence["correlation"].values,
        "correlation of responses",
        {"cmap": "Blues", "vmin": 0.0, "vmax": 1.0},
    )


def isolation_figure(view: ReportView) -> Figure:
    """Strength at which each pair is told apart in 95 cases of 100."""
    needed = np.clip(view.isolating, None, 1e4)
    scale = {"cmap": "viridis_r", "norm": LogNorm(2.0, 100.0)}
    return _matrix(view, needed, "strength needed to tell apart, 95 % [sigmas]", scale)


def calibration_figure(view: ReportView) -> Figure:
    """Simulations judged by the others, and the data's probability among draws without a gap."""
    figure = Figure(figsize=(9.0, 3.1), layout="constrained")
    left, right = figure.subplots(1, 2)
    held = view.evidence["held_out"].values
    bins = 20
    left.hist(held, bins=bins, range=(0.0, 1.0), histtype="step", color=BLUE, linewidth=1.6)
    low, high = stats.binom.interval(0.95, len(held), 1.0 / bins)
    left.axhspan(low, high, color="0.88", zorder=0)
    left.axhline(len(held) / bins, color="black", linewidth=0.8)
    left.set_xlim(0.0, 1.0)
    left.set_ylim(0.0, None)
    left.set_xlabel("omnibus probability of a simulation held out")
    left.set_ylabel(f"simulations of {len(held)}")
    left.set_title("grey: where 95 % of the bins of a flat one are", fontsize=9)
    draws = np.maximum(view.evidence["calibration"].values, 1e-12)
    rank = (1.0 + np.arange(len(draws))) / (1.0 + len(draws))
    right.plot(draws, rank, color=BLUE, label="draws without a gap")
    p = max(float(view.verdict["gap"]["p_value"]), 1e-300)
    floor = rank[0] / 3.0
    inside = p >= rank[0]
    at = float(np.interp(p, rank, draws)) if inside else draws[0]
    right.plot(
        at, p if inside else floor * 1.4, "o" if inside else "v", color=RED, markersize=8, label=f"data, p = {p:.2g}"
    )
    right.axhline(0.05, color="black", linewidth=0.8, linestyle="--")
    right.annotate("5 %", (draws[0], 0.05), xytext=(2, 3), textcoords="offset points", fontsize=8)
    right.set(xscale="log", yscale="log", ylim=(floor, 1.5))
    right.set_xlabel("smaller of omnibus and best candidate's probability")
    right.set_ylabel("fraction of draws as small")
    right.set_title("triangle: below all draws" if not inside else "", fontsize=9)
    right.legend(frameon=False, fontsize=8, loc="lower right")
    for axes in (left, right):
        _bare(axes)
    return figure


def telling_figure(contrast: dict[str, Any]) -> Figure:
    """Entries in which two explanations differ most, with the data."""
    rows = contrast["entries"][:8]
    figure = Figure(figsize=(8.4, 1.3 + 0.36 * len(rows)), layout="constrained")
    axes = figure.subplots()
    for name, colour, marker, shift in (("first", BLUE, "D", -0.14), ("second", AMBER, "s", 0.14)):
        axes.plot(
            [row[name] for row in rows],
            np.arange(len(rows)) + shift,
            marker,
            color=colour,
            linestyle="none",
            label=_plain(_short(contrast[name], 70)),
        )
    data = [row["data"] for row in rows]
    axes.errorbar(
        data, range(len(rows)), xerr=1.0, fmt="o", color="black", markersize=4, capsize=2, label="data ± 1 sigma"
    )
    labels = [f"{_plain(_short(row['words'], 56))}  ({100 * row['share']:.0f} %)" for row in rows]
    axes.set_yticks(range(len(rows)), labels, fontsize=8)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.axvline(0.0, color="0.6", linewidth=0.8, zorder=0)
    axes.set_xlabel(
        f"change of the entry [sigmas]; apart by {contrast['separation']:.1f}, {APART} are needed", fontsize=9
    )
    _bare(axes)
    figure.legend(loc="outside upper left", frameon=False, fontsize=8)
    return figure


def _matrix(view: ReportView, values: NDArray[np.float64], label: str, scale: dict[str, Any]) -> Figure:
    labels = view.labels
    sign = 2.6 + max(3.0, 0.15 * len(labels))
    figure = Figure(figsize=(sign, sign + 0.8), layout="constrained")
    axes = figure.subplots()
    shown = axes.imshow(values, interpolation="nearest", **scale)
    size = 6.5 if len(labels) > 12 else 9
    accepted = {row.label for row in view.ranked if row.accepted}
    words = [_plain(_short(name, 36)) for name in labels]
    axes.set_xticks(range(len(labels)), words, rotation=90, fontsize=size)
    axes.set_yticks(range(len(labels)), words, fontsize=size)
    for ticks in (axes.get_xticklabels(), axes.get_yticklabels()):
        for tick, name in zip(ticks, labels, strict=True):
            if name in accepted:
                tick.set_color(RED)
                tick.set_fontweight("bold")
    extend = "neither" if "vmin" in scale else "both"
    bar = figure.colorbar(shown, ax=axes, location="top", aspect=30, extend=extend)
    bar.set_label(label, fontsize=9)
    return figure


def _mollweide(axes: Axes, values: NDArray[np.float64]) -> Any:
    """A RING map, longitude 0 in the middle and growing to the left."""
    nside = healpy.npix2nside(values.size)
    projector: Any = healpy.projector.MollweideProj(xsize=700)
    image = projector.projmap(values, lambda x, y, z: healpy.vec2pix(nside, x, y, z))
    image = np.ma.masked_invalid(np.where(np.isneginf(image), np.nan, image))
    # Sharp pixels: smoothed ones make the file three times as large.
    style: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -4.0, "vmax": 4.0, "interpolation": "nearest"}
    return axes.imshow(image, origin="lower", extent=projector.get_extent(), **style)


_FAMILIES = ("sky", "isotropy", "beam", "dipole", "noise", "square", "common", "difference", "contrast", "score")


def _family(name: str) -> tuple[int, str]:
    prefix = name.partition("/")[0]
    return (_FAMILIES.index(prefix) if prefix in _FAMILIES else len(_FAMILIES), prefix)


def _ticks(largest: float) -> tuple[list[float], list[str]]:
    values = [v for v in (5.0, 10.0, 30.0, 100.0, 300.0, 1000.0) if v <= max(5.0, largest)]
    both = [*(-v for v in reversed(values)), -2.0, 0.0, 2.0, *values]
    return both, [f"{v:g}" for v in both]


def _short(text: str, width: int) -> str:
    """Text with its middle left out where it is long: labels differ at both ends."""
    return text if len(text) <= width else f"{text[: width // 2]}…{text[len(text) - (width - 1) // 2 :]}"


def _plain(text: str) -> str:
    """Text that matplotlib does not take for mathematics."""
    return text.replace("$", r"\$")


def _bare(axes: Axes) -> None:
    for sign in ("top", "right"):
        axes.spines[sign].set_visible(False)
