"""A score in one picture: calibration, power, confusion, pulls, shrink, what is unknown."""

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

if TYPE_CHECKING:
    from mcsim.benchmark.figures import Confusion, Score

BLUE, RED, GREY = "#1f5fa8", "#c44e22", "0.55"


def challenge_figure(score: "Score") -> Figure:
    """Draw a score.

    Parameters
    ----------
    score
        Of full skies, or of draws of the evidence.

    Returns
    -------
    Figure
        p-values without an effect, power against strength beside the limit, unknowns against distance; pulls, achieved
        against predicted shrink, right answers against strength beside Bayes'; the confusion matrices of both.
    """
    figure = Figure(figsize=(15.0, 16.0), layout="constrained")
    figure.suptitle(score.title, fontsize=12)
    upper, lower = np.ravel(np.asarray(figure.subfigures(2, 1, height_ratios=(1.0, 1.05)), dtype=object))
    axes = upper.subplots(2, 3)
    _calibration(axes[0, 0], score)
    _power(axes[0, 1], score)
    _unknown(axes[0, 2], score)
    _pulls(axes[1, 0], score)
    _shrink(axes[1, 1], score)
    _right(axes[1, 2], score)
    said, best = lower.subplots(1, 2, width_ratios=(max(len(score.said.answers), 1), max(len(score.best.answers), 1)))
    _matrix(said, score.said, "diagnosis")
    _matrix(best, score.best, "Bayes, cases of its library")
    return figure


def _calibration(axes: Axes, score: "Score") -> None:
    p = np.sort([record.p_value for record in score.records if record.kind == "none"])
    if score.power is not None:
        p = np.sort(score.power.null_gap)
    axes.plot([0, 1], [0, 1], color=GREY, linewidth=0.8)
    if len(p):
        rank = np.arange(1, len(p) + 1) / len(p)
        axes.step(p, rank, where="post", color=BLUE)
        half = 1.36 / np.sqrt(len(p))
        axes.fill_between([0, 1], [-half, 1 - half], [half, 1 + half], color=GREY, alpha=0.2, linewidth=0)
    axes.set(
        xlabel="p of the gap, nothing there", ylabel="share of cases", title=f"{len(p)} cases", xlim=(0, 1), ylim=(0, 1)
    )


def _binned(axes: Axes, x: np.ndarray, hits: np.ndarray, colour: str, label: str, bins: int = 8) -> None:
    if len(x) < 2:
        return
    edges = np.quantile(x, np.linspace(0.0, 1.0, min(bins, max(len(x) // 8, 1)) + 1))
    for number, (low, high) in enumerate(pairwise(edges)):
        here = hits[(x >= low) & ((x < high) | (high == edges[-1]))]
        if not len(here):
            continue
        k, n = int(here.sum()), len(here)
        bottom = stats.beta.ppf(0.025, k, n - k + 1) if k else 0.0
        top = stats.beta.ppf(0.975, k + 1, n - k) if k < n else 1.0
        error = [[max(k / n - bottom, 0.0)], [max(top - k / n, 0.0)]]
        axes.errorbar(
            0.5 * (low + high), k / n, error, fmt="o", color=colour, markersize=4, capsize=2,
            label=label if number == 0 else None,
        )  # fmt: skip


def _power(axes: Axes, score: "Score") -> None:
    if score.power is not None:
        power = score.power
        axes.plot(power.grid, power.limit, color=GREY, label="limit, Bonferroni")
        axes.plot(power.grid, power.finite, color=GREY, linestyle="--", label="with the simulations that there are")
        _binned(axes, power.strengths, power.by_maximum, BLUE, "templates' maximum", 16)
        _binned(axes, power.strengths, power.by_gap, RED, "whole test", 16)
    else:
        ones = [record for record in score.records if record.kind == "one"]
        s = np.array([record.strength for record in ones])
        _binned(axes, s, np.array([record.maximum <= 0.05 for record in ones]), BLUE, "templates' maximum")
        _binned(axes, s, np.array([record.p_value <= 0.05 for record in ones]), RED, "whole test")
    axes.axhline(0.9, color=GREY, linewidth=0.6, linestyle=":")
    axes.set(xlabel="strength s", ylabel="found at 5 %", title="single effects", ylim=(-0.03, 1.03))
    _legend(axes)


def _unknown(axes: Axes, score: "Score") -> None:
    foreign = [record for record in score.records if record.distances]
    d = np.array([record.distances[-1] for record in foreign])
    _binned(axes, d, np.array([record.verdict == "unknown" for record in foreign]), BLUE, "unknown", 6)
    _binned(axes, d, np.array([record.wrong_name for record in foreign]), RED, "wrong single name", 6)
    axes.axvline(8.0, color=GREY, linewidth=0.6, linestyle=":")
    axes.set(xlabel="distance from every triple", ylabel="share", title="not in the library", ylim=(-0.03, 1.03))
    _legend(axes)


def _pulls(axes: Axes, score: "Score") -> None:
    pulls = [pull for record in score.records if record.strength >= 5.0 for pull in record.pulls]
    if pulls:
        axes.hist(np.clip(pulls, -5, 5), bins=list(np.linspace(-5, 5, 31)), color=BLUE, alpha=0.7, density=True)
        axes.set_title(f"{len(pulls)} amplitudes: mean {np.mean(pulls):.2f}, width {np.std(pulls):.2f}")
    x = np.linspace(-5, 5, 200)
    axes.plot(x, np.exp(-0.5 * x * x) / np.sqrt(2 * np.pi), color=GREY)
    axes.set(xlabel="fitted less true, over the error", ylabel="density")


def _shrink(axes: Axes, score: "Score") -> None:
    rows = [r for r in score.records if r.truth and r.best == r.truth and r.achieved is not None and r.strength >= 8.0]
    axes.plot([0, 1.2], [0, 1.2], color=GREY, linewidth=0.8)
    if rows:
        x, y, error = (
            np.array([getattr(r, key) for r in rows], dtype=float) for key in ("predicted", "achieved", "sigma")
        )
        axes.errorbar(
            x, y, error, fmt="o", color=BLUE, markersize=3, elinewidth=0.5, alpha=0.7, label="right effect, s >= 8"
        )
    absent = [1.0 - r.absent[1] / r.absent[0] for r in score.records if r.absent is not None and r.absent[0] > 0]
    if absent:
        axes.plot(np.zeros(len(absent)), absent, "x", color=RED, markersize=4, label="effect that is not there")
    axes.set(xlabel="predicted share of the gap", ylabel="achieved", title="shrink", xlim=(-0.1, 1.2), ylim=(-0.6, 1.4))
    _legend(axes)


def _right(axes: Axes, score: "Score") -> None:
    known = [record for record in score.records if record.bayes is not None and record.truth]
    s = np.array([record.strength for record in known])
    _binned(axes, s, np.array([record.right for record in known]), BLUE, "diagnosis")
    _binned(axes, s * 1.01, np.array([record.bayes == record.truth for record in known]), RED, "Bayes")
    axes.set(xlabel="strength s", ylabel="right answer", title="one and two effects", ylim=(-0.03, 1.03))
    _legend(axes)


def _legend(axes: Axes) -> None:
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, frameon=False)


def _matrix(axes: Axes, matrix: "Confusion", title: str) -> None:
    axes.set_title(title)
    if not matrix.truths:
        axes.axis("off")
        return
    shares = matrix.counts / np.maximum(matrix.counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for i, row in enumerate(matrix.counts):
        for j, count in enumerate(row):
            if count:
                axes.text(
                    j, i, str(count), ha="center", va="center", fontsize=7, color="w" if shares[i, j] > 0.5 else "k"
                )
    axes.set_xticks(range(len(matrix.answers)), matrix.answers, rotation=90, fontsize=7)
    axes.set_yticks(range(len(matrix.truths)), matrix.truths, fontsize=7)
    axes.set(xlabel="said", ylabel="there")
