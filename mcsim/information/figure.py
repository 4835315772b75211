"""Picture of the limit: errors and detectable amplitudes of every effect, which are possible, and which told apart."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from mcsim.information.result import Limits
from mcsim.support.numbers import number

REACH = 12.0  #: amplitude over sigma at which the bars end

BLUE, AMBER, GREY = "#0072b2", "#e69f00", "#b5b5b5"


def limit_figure(found: Limits) -> Figure:
    """Draw sigma and detectable amplitudes in units of sigma, with their values, and the matrix of correlations.

    Amplitudes that an effect cannot have are hatched, and their values have an asterisk.
    """
    effects = found.effects
    count = len(effects)
    figure = Figure(figsize=(13.5, 2.4 + 0.27 * count), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.0))
    rows = np.arange(count)
    for key, colour, text in (
        ("amplitude_90", AMBER, "detected among all effects"),
        ("amplitude_90_known", BLUE, "detected if alone tested"),
        ("sigma", GREY, "sigma"),
    ):
        ratio = [getattr(one, key) / one.sigma if np.isfinite(one.sigma) else 0.0 for one in effects]
        left.barh(rows, ratio, height=0.72, color=colour, label=text)
    apart = np.array([np.inf if np.isinf(one.separable) else one.separable / one.sigma for one in effects])
    inside, beyond = apart < REACH, apart >= REACH  # neither without another effect
    starred = np.array([one.amplitude("separable").endswith("*") for one in effects])
    style: dict[str, Any] = {"markersize": 9, "markeredgewidth": 1.6, "linestyle": "none", "color": "black"}
    left.plot(apart[inside], rows[inside], marker="|", label="told apart from the most similar", **style)
    left.plot(
        [0.97 * REACH] * int(np.sum(beyond)), rows[beyond], marker="$>$", label="that lies farther right", **style
    )
    left.plot([0.92 * REACH] * int(np.sum(beyond & starred)), rows[beyond & starred], "*", color="black", markersize=5)
    _hatch_impossible(left, found)
    beside: dict[str, Any] = {"va": "center", "fontsize": 7, "parse_math": False}
    for row, one in enumerate(effects):
        unit = "" if one.unit.startswith("1") else f" ({one.unit})".replace("uK", "µK").replace("^2", "²")
        shown = f"{number(one.sigma)} | {one.amplitude('amplitude_90')}{unit}"
        left.annotate(shown, (1.0, row), (4, 0), ("axes fraction", "data"), "offset points", **beside)
    left.set_yticks(rows, [one.title for one in effects], fontsize=8, parse_math=False)
    left.set_ylim(count - 0.4, -0.6)
    left.set_xlim(0.0, REACH)
    of = found.settings
    left.set_xlabel(
        "amplitude / sigma;  at the right: sigma | detected among all\n"
        f"detected: {100 * of.power:g} % power at a level of {100 * of.alpha:g} %;  "
        f"told apart: right in {100 * of.separation:g} %",
        fontsize=9,
    )
    left.legend(frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    shades = ListedColormap(["#ffffff", "#dbe9f4", "#a6cbe3", "#5fa2cf", "#e69f00", "#b04a00"])
    levels = [0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0]
    steps = np.digitize(np.minimum(found.correlation, 0.999999), levels) - 0.5
    image = right.imshow(steps, cmap=shades, vmin=0, vmax=6, aspect="auto")
    right.set_ylim(left.get_ylim())
    right.set_xticks(rows, [one.title for one in effects], fontsize=7, rotation=90, parse_math=False)
    right.set_yticks(rows, [""] * count)
    right.set_title("canonical correlation |ρ| of the responses", fontsize=10)
    bar = figure.colorbar(image, ax=right, ticks=range(7), shrink=0.7, aspect=40)
    bar.ax.set_yticklabels([f"{level:g}" for level in levels])
    return figure


def _hatch_impossible(axes: Axes, found: Limits) -> None:
    """Hatch amplitudes that are more than each effect can have, with a line of the legend if there are any."""
    ends = [REACH if np.isinf(one.sigma) else min(one.amplitude_max / one.sigma, REACH) for one in found.effects]
    faded: dict[str, Any] = {"facecolor": (1.0, 1.0, 1.0, 0.6), "edgecolor": "0.55", "linewidth": 0.0, "hatch": "////"}
    label = "*, hatched: not possible" if found.impossible or min(ends) < REACH else None
    axes.barh(range(len(ends)), REACH - np.array(ends), left=ends, height=0.72, label=label, **faded)
