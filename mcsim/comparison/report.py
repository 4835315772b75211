"""One self-contained page about a comparison: what differs, in maps, by degree and by hits."""

import textwrap
from pathlib import Path
from typing import Any

import healpy
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator
from numpy.typing import NDArray

from mcsim.comparison.result import ChannelResult, ComparisonResult
from mcsim.plot.sky import mollweide
from mcsim.sphere import healpix
from mcsim.support import page as page_
from mcsim.support.numbers import number

DOTS_PER_INCH = 110
SHOWN = 64  #: nside of the maps in pictures
_TICKS = [digit * 10**power for power in range(9) for digit in (1, 2, 5)]  #: multipoles or samples that an axis names
_MOST_TICKS = 9  #: of which the numbers stand apart; of more, powers of ten
_LETTERS = 40  #: of a line of the words beside the maps
_LEGEND: dict[str, Any] = {
    "frameon": False,
    "fontsize": 9,
    "ncols": 4,
    "loc": "lower right",
    "bbox_to_anchor": (1.0, 1.0),
    "borderaxespad": 0.2,
}  # above the panel: lines go everywhere
_ROUNDED = 1e-20  #: power over the largest of side A below which it is that of rounding errors


def page(result: ComparisonResult) -> str:
    """Return the page as text."""
    pictures = [
        (channel, page_.embedded(page_.png(figure(channel, result.frame), DOTS_PER_INCH)))
        for channel in result.channels
    ]
    return page_.render(
        Path(__file__).with_name("report.html.j2"),
        {"number": number},
        result=result,
        pictures=pictures,
    )


def figure(channel: ChannelResult, frame: str | None = None) -> Figure:
    """Draw the first map of a channel that differs: both sides, their difference and its parts, spectra, and hits.

    ``frame``: of the maps, for the title.
    """
    made = Figure(figsize=(12.0, 7.4), layout="constrained")
    axes = made.subplot_mosaic("aabbcc;ddeeff;ggghhh", height_ratios=(1.0, 1.0, 1.15))
    first = _first(channel)
    a, b, explained, seen = (one[first] for one in (channel.a, channel.b, channel.explained, channel.seen))
    difference = b - a
    for key, title, values, signed in (
        ("a", ", ".join(filter(None, ("A", channel.splits[first], frame))), a, False),
        ("b", "B", b, False),
        ("c", "B − A", difference, True),
        ("d", "explained", explained, True),
        ("e", "left", difference - explained, True),
    ):
        _draw_map(axes[key], np.where(seen, values, np.nan), title, signed)
    _draw_words(axes["f"], channel)
    _draw_spectra(axes["g"], channel)
    _draw_depth(axes["h"], channel)
    return made


def _first(channel: ChannelResult) -> int:
    """Return the number of the first map that is compared: those that are identical are left out."""
    return int(np.argmax(channel.seen.any(axis=1)))


def _draw_map(axes: Axes, values: NDArray[np.float64], title: str, signed: bool) -> None:
    """Draw a Mollweide view, its colours up to the 99.5th percentile of |value|: about zero if ``signed``, or the mean.

    The rms of a ``signed`` map, a difference, has its mean in it, as in the words of the page.
    """
    nside = min(SHOWN, healpy.npix2nside(values.size))
    coarse = healpy.ud_grade(np.where(np.isfinite(values), values, healpy.UNSEEN), nside)
    coarse = np.where(coarse == healpy.UNSEEN, np.nan, coarse)
    mean = float(np.nanmean(values))
    middle = 0.0 if signed else mean
    rms = float(np.sqrt(np.nanmean((values - middle) ** 2)))
    words = (
        f"rms {number(rms)} µK" if abs(middle) <= 0.1 * rms else f"mean {number(mean)}, rms about it {number(rms)} µK"
    )
    largest = float(np.nanquantile(np.abs(values - middle), 0.995)) or 1.0
    shown = mollweide(axes, coarse, 500, cmap="RdBu_r", vmin=middle - largest, vmax=middle + largest)
    axes.set_title(f"{title}: {words}", fontsize=10, parse_math=False)
    axes.figure.colorbar(
        shown, ax=axes, orientation="horizontal", shrink=0.7, aspect=30, pad=0.02, ticks=MaxNLocator(4)
    ).set_label("µK")


def _plain_ticks(axes: Axes, low: float, high: float) -> None:
    """Write few round numbers at a logarithmic x axis that spans these values, and no others."""
    ticks = [tick for tick in _TICKS if low <= tick <= high]
    if len(ticks) > _MOST_TICKS:
        ticks = [tick for tick in ticks if str(tick).startswith("1")]
    axes.set_xticks(ticks or [low, high])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
    axes.xaxis.set_minor_locator(NullLocator())


def _draw_words(axes: Axes, channel: ChannelResult) -> None:
    """Say in words what was found, beside the maps."""
    lines = [d.words for d in channel.differences]
    lines += [f"  {key}: {value if isinstance(value, str) else number(value)}" for d in channel.differences
              for key, value in d.parameters.items()]  # fmt: skip
    axes.axis("off")
    lines += ["or " + " and ".join(d.words for d in one) for one in channel.alternatives]
    wrapped = [textwrap.fill(line, _LETTERS, subsequent_indent="    ") for line in lines]
    text = "\n".join([channel.verdict, *wrapped])
    axes.text(0.05, 0.9, text, va="top", fontsize=11, linespacing=1.5, transform=axes.transAxes, parse_math=False)


def _draw_spectra(axes: Axes, channel: ChannelResult) -> None:
    """Draw power by degree: side A, the difference, what is explained, and what is left."""
    nside = healpy.npix2nside(channel.a.shape[1])
    first, lmax = _first(channel), 2 * nside
    ell, floor = np.arange(2, lmax + 1), 0.0
    difference = channel.b - channel.a
    for label, values, colour, style in (
        ("A", channel.a, "#444444", "-"),
        ("B − A", difference, "#0072b2", "-"),
        ("explained", channel.explained, "#d55e00", "--"),
        ("left", difference - channel.explained, "#00785a", "-"),
    ):
        alm = healpix.analysis(np.where(channel.seen[first], values[first], 0.0), lmax)
        power = healpy.alm2cl(alm)[2:]
        if power.max() > 0.0:
            axes.loglog(ell, ell * (ell + 1) / (2.0 * np.pi) * power, label=label, color=colour, ls=style, lw=1.2)
        if label == "A" and axes.lines:
            floor = _ROUNDED * float(np.max(axes.lines[0].get_ydata()))
    bottom, top = axes.get_ylim()
    if bottom < floor < top:
        axes.set_ylim(floor, top)
    _plain_ticks(axes, 2, lmax)
    axes.set(xlabel="multipole $\\ell$", ylabel="$\\ell(\\ell + 1) C_\\ell / 2\\pi$  [µK²]")
    axes.set_title("by degree", loc="left")
    axes.legend(**_LEGEND)


def _draw_depth(axes: Axes, channel: ChannelResult) -> None:
    """Draw the rms of the difference, and of what is left, against the samples in a pixel."""
    if channel.hits is None or np.ptp(channel.hits[channel.seen]) == 0.0:
        axes.axis("off")
        return
    hits = channel.hits[channel.seen]
    difference = (channel.b - channel.a)[channel.seen]
    left = difference - channel.explained[channel.seen]
    edges = np.unique(np.quantile(hits, np.linspace(0.0, 1.0, 13)))
    bins = np.clip(np.searchsorted(edges, hits, side="right") - 1, 0, edges.size - 2)
    count = np.maximum(np.bincount(bins, minlength=edges.size - 1), 1)
    middle = np.bincount(bins, hits, edges.size - 1) / count
    for label, values, colour in (("B − A", difference, "#0072b2"), ("left", left, "#00785a")):
        rms = np.sqrt(np.bincount(bins, values**2, edges.size - 1) / count)
        if rms.any():
            axes.loglog(middle, rms, "o-", ms=4, label=label, color=colour)
    if not axes.lines:
        axes.text(0.5, 0.5, "no difference", ha="center", va="center", transform=axes.transAxes)
        axes.axis("off")
        return
    _plain_ticks(axes, float(middle.min()), float(middle.max()))
    axes.set(xlabel="samples in a pixel", ylabel="rms  [µK]")
    axes.set_title("by hits", loc="left")
    axes.legend(**_LEGEND)
