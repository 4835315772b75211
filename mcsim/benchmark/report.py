"""Write a score as JSON, as one self-contained HTML page, as a picture, and as lines for a terminal."""

import json
from dataclasses import is_dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from scipy import stats

from mcsim import systematics
from mcsim.benchmark.summary import ALPHA, FAR, NAMED, REDUCED, Confusion, Score, confusion
from mcsim.plot.cells import write_cells
from mcsim.stats.intervals import Metric, binomial_interval
from mcsim.support import page
from mcsim.support.folders import filling, replacing

DOTS_PER_INCH = 110
BLUE, RED, GREY = "#1f5fa8", "#c44e22", "0.45"
SHARE = (-0.03, 1.03)


def write(score: Score, folder: Path) -> None:
    """Write ``score.json``, ``report.html`` and ``score.png`` into a folder, which is made if it does not exist."""
    everything, in_library = confusion(score.records), confusion(score.in_library)
    bayes = confusion(score.in_library, bayes=True)
    content = {
        "schema": 1,
        "version": version("mcsim"),
        "title": score.title,
        "figures": score.metrics,
        "confusion": everything,
        "confusion_library": in_library,
        "confusion_bayes": bayes,
        "left_out": score.unlisted,
        "cases": score.records,
    }
    picture = page.png(score_figure(score, everything, bayes), DOTS_PER_INCH)
    text = page.render(
        Path(__file__).with_name("report.html.j2"),
        {"value": _value, "interval": _interval, "mark": _mark, "words": _words},
        score=score,
        metrics=_ordered(score),
        missed=[metric.name for metric in score.metrics if _mark(metric) == "missed"],
        short=[metric.name for metric in score.metrics if _mark(metric) == "short"],
        open=sum(bool(metric.target) and metric.met is None for metric in score.metrics),
        confusions=[
            ("Diagnosis, all cases", everything),
            ("Bayes classifier, cases whose truth is in the library", bayes),
            ("Diagnosis, cases whose truth is in the library", in_library),
        ],
        picture=page.embedded(picture),
    )
    with filling(folder), replacing(folder, "score.json") as scratch:
        (scratch / "score.png").write_bytes(picture)
        (scratch / "report.html").write_text(text, encoding="utf-8")
        plain = json.dumps([_plain(content)], indent=1, allow_nan=False) + "\n"
        (scratch / "score.json").write_text(plain, encoding="utf-8")


def lines(score: Score) -> list[str]:
    """Return a head and the metrics for a terminal, those that miss their target first."""
    return ["       figure: value [95 % interval] of so many cases; target (short: the interval reaches it)"] + [
        f"{_mark(one):<6} {one.name}: {_value(one)}{f' [{_interval(one)}]' if _interval(one) else ''} of {one.count}"
        + (f"; target: {one.target}" if one.target else "")
        for one in _ordered(score)
    ]


def _plain(value: Any) -> Any:
    """Return nested dataclasses, arrays and sets as JSON has them, None in place of NaN."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, frozenset):  # effects by name and channel, which can be None
        return [list(one) for one in sorted(value, key=lambda one: (one[0], one[1] or ""))]
    if isinstance(value, tuple | list):
        return [_plain(one) for one in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return _plain(vars(value)) if is_dataclass(value) else value


def _ordered(score: Score) -> list[Metric]:
    return sorted(score.metrics, key=lambda metric: ("missed", "short", "met", "").index(_mark(metric)))


def _mark(metric: Metric) -> str:
    """Return how a value stands to its target; "short" of one that its interval reaches."""
    return "short" if metric.near else {True: "met", False: "missed", None: ""}[metric.met]


def _value(metric: Metric) -> str:
    return f"{metric.value:.3g}" if np.isfinite(metric.value) else "–"


def _interval(metric: Metric) -> str:
    return f"{metric.low:.3g}, {metric.high:.3g}" if np.isfinite(metric.low) else ""


def _words(column: str) -> str:
    """Return a row or column of a confusion matrix as people read it: effects of the library by their titles."""
    name, *rest = column.split(", ")
    library = systematics.catalogue()
    return ", ".join((library[name].label() if name in library else name.replace("_", " "), *rest))


def score_figure(score: Score, answers: Confusion, bayes: Confusion) -> Figure:
    """Draw a score of full skies, or of draws of the data vector.

    p-values without an effect, power against expected S/N, unknown effects against their S/N beyond the library; pulls,
    measured against predicted reduction of the excess chi^2, right answers against S/N beside those of the Bayes
    classifier; the confusion matrices of both.
    """
    figure = Figure(figsize=(15.0, 16.0), layout="constrained")
    words = "bars of fractions: 95 % intervals; bars of reductions: ± 1σ; shades of the tables: share of the row"
    figure.suptitle(f"{score.title}\n{words}", fontsize=11, parse_math=False)
    upper, lower = np.ravel(np.asarray(figure.subfigures(2, 1, height_ratios=(1.0, 1.05)), dtype=object))
    panels = (_calibration, _power, _unknown, _pulls, _reduction, _right)
    for axes, panel in zip(upper.subplots(2, 3).flat, panels, strict=True):
        panel(axes, score)
        if panel in (_power, _unknown, _right):
            axes.set_xlim(left=0.0)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8, framealpha=0.8, edgecolor="none")
    left, right = lower.subplots(1, 2, width_ratios=[max(len(matrix.answers), 1) for matrix in (answers, bayes)])
    _matrix(left, answers, "Answers of the diagnosis, all cases")
    _matrix(right, bayes, "Answers of the Bayes classifier,\ncases whose truth is in the library")
    return figure


def _calibration(axes: Axes, score: Score) -> None:
    p = np.sort(score.null_pvalues)
    axes.plot([0, 1], [0, 1], color=GREY, linewidth=0.8, label="uniform")
    if len(p):
        axes.ecdf(p, color=BLUE, label="measured")
        half = stats.kstwo.isf(0.05, len(p))
        axes.fill_between([0, 1], [-half, 1 - half], [half, 1 + half], color=GREY, alpha=0.2, linewidth=0, label="95 %")
    axes.set(xlabel="p-value of the global test", ylabel="Fraction of cases at or below", xlim=(0, 1), ylim=(0, 1))
    axes.set_title(f"{len(p)} cases without an effect")


def _binned(axes: Axes, x: ArrayLike, hits: ArrayLike, label: str, colour: str = BLUE, bins: int = 8) -> None:
    """Draw the share of hits in bins of equal numbers of cases, with its 95 % interval."""
    x, hits = np.asarray(x), np.asarray(hits, dtype=bool)
    if len(np.unique(x)) < 2:
        return
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, min(bins, max(len(x) // 8, 1)) + 1)))
    total, passed = (np.histogram(values, edges)[0] for values in (x, x[hits]))
    middle = 0.5 * (edges[:-1] + edges[1:])
    low, high = np.transpose([binomial_interval(int(k), int(n)) for k, n in zip(passed, total, strict=True)])
    value = passed / total
    error = np.maximum([value - low, high - value], 0.0)
    axes.errorbar(middle, value, error, fmt="o", color=colour, markersize=4, capsize=2, label=label)


def _power(axes: Axes, score: Score) -> None:
    if score.power is not None:
        power = score.power
        axes.plot(power.grid, power.limit, color=GREY, label="limit, known covariance")
        axes.plot(power.grid, power.finite, color=GREY, linestyle="--", label="limit, covariance of the simulations")
        _binned(axes, power.strengths, power.by_maximum, "largest matched filter", BLUE, 16)
        _binned(axes, 1.01 * power.strengths, power.by_gap, "global test", RED, 16)
    else:
        ones = [record for record in score.records if record.kind == "one"]
        s = np.array([record.strength for record in ones])
        _binned(axes, s, [record.maximum <= ALPHA for record in ones], "largest matched filter")
        _binned(axes, 1.01 * s, [record.p_value <= ALPHA for record in ones], "global test", RED)
    axes.axhline(0.9, color=GREY, linewidth=0.6, linestyle=":", label="90 %")
    axes.set(xlabel="Expected S/N", ylabel="Fraction detected at 5 %", title="Single effects", ylim=SHARE)


def _unknown(axes: Axes, score: Score) -> None:
    rows = [record for record in score.records if record.distances]
    beyond = [record.distances[-1] for record in rows]
    _binned(axes, beyond, [record.verdict == "unknown" for record in rows], "called unknown", BLUE, 6)
    _binned(axes, beyond, [record.wrong_name for record in rows], "wrong single name", RED, 6)
    axes.axvline(FAR, color=GREY, linewidth=0.6, linestyle=":", label=f"S/N {FAR:g}: targets are for those beyond")
    axes.set(xlabel="Expected S/N beyond every three effects of the library", ylabel="Fraction of cases")
    axes.set(title="Effects that the library does not have", ylim=SHARE)


def _pulls(axes: Axes, score: Score) -> None:
    pulls = [pull for record in score.records if record.strength >= NAMED for pull in record.pulls]
    x = np.linspace(-5, 5, 201)
    title = f"{len(pulls)} components of named effects, S/N ≥ {NAMED:g}"
    if pulls:
        title += f"\nmean {np.mean(pulls):.2f}, width {np.std(pulls):.2f}"
        axes.hist(np.clip(pulls, -5, 5), bins=30, range=(-5, 5), density=True, color=BLUE, alpha=0.7, label="measured")
    axes.plot(x, stats.norm.pdf(x), color=GREY, label="unit normal")
    axes.set(xlabel="Pull: fitted less true amplitude, over its error", ylabel="Density", title=title)


def _reduction(axes: Axes, score: Score) -> None:
    strong = [r for r in score.records if r.truth and r.best == r.truth and r.strength >= REDUCED]
    rows = [(r.predicted, r.achieved, r.sigma) for r in strong if r.achieved is not None]
    axes.plot([0, 1.2], [0, 1.2], color=GREY, linewidth=0.8, label="equal")
    if rows:
        x, y, error = np.array(rows, dtype=float).T
        name = f"right effect, S/N ≥ {REDUCED:g}"
        axes.errorbar(x, y, error, fmt="o", color=BLUE, markersize=3, elinewidth=0.5, alpha=0.7, label=name)
    absent = [1.0 - r.absent[1] / r.absent[0] for r in score.records if r.absent is not None and r.absent[0] > 0]
    if absent:
        axes.plot(np.zeros(len(absent)), absent, "x", color=RED, markersize=4, label="effect that does not act")
    axes.set(xlabel="Predicted fractional reduction", ylabel="Measured fractional reduction")
    axes.set(title=r"Reduction of the excess $\chi^2$ of held-out data", xlim=(-0.1, 1.2), ylim=(-0.6, 1.4))


def _right(axes: Axes, score: Score) -> None:
    known = [record for record in score.in_library if record.truth]
    s = np.array([record.strength for record in known])
    _binned(axes, s, [record.right for record in known], "diagnosis")
    _binned(axes, 1.01 * s, [record.bayes == record.truth for record in known], "Bayes classifier", RED)
    axes.set(xlabel="Expected S/N", ylabel="Fraction answered rightly", title="One and two effects", ylim=SHARE)


def _matrix(axes: Axes, matrix: Confusion, title: str) -> None:
    axes.set_title(title)
    if not matrix.truths:
        axes.axis("off")
        return
    shares = matrix.counts / matrix.counts.sum(axis=1, keepdims=True)
    axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    write_cells(axes, ((cell, str(count)) for cell, count in np.ndenumerate(matrix.counts) if count), shares > 0.5, 8)
    style: dict[str, Any] = {"fontsize": 8, "parse_math": False}
    axes.set_xticks(range(len(matrix.answers)), map(_words, matrix.answers), rotation=90, **style)
    axes.set_yticks(range(len(matrix.truths)), map(_words, matrix.truths), **style)
    axes.set(xlabel="Answer", ylabel="Truth")
