"""One self-contained page about a comparison: what differs, in maps, by degree and by hits."""

from pathlib import Path

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
_TICKS = (2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)  #: multipoles that an axis names


def page(result: ComparisonResult) -> str:
    """Return the page as text."""
    pictures = [(channel, page_.embedded(page_.png(figure(channel), DOTS_PER_INCH))) for channel in result.channels]
    return page_.render(
        Path(__file__).with_name("report.html.j2"),
        {"number": number},
        result=result,
        pictures=pictures,
    )


def figure(channel: ChannelResult) -> Figure:
    """Draw the first map of a channel that differs: both sides, their difference and its parts, spectra, and hits."""
    made = Figure(figsize=(12.0, 7.4), layout="constrained")
    axes = made.subplot_mosaic("aabbcc;ddeeff;ggghhh", height_ratios=(1.0, 1.0, 1.15))
    first = _first(channel)
    a, b, explained, seen = (one[first] for one in (channel.a, channel.b, channel.explained, channel.seen))
    difference = b - a
    for key, title, values in (
        ("a", f"A: {channel.splits[first]}", a),
        ("b", "B", b),
        ("c", "B − A", difference),
        ("d", "explained", explained),
        ("e", "left", difference - explained),
    ):
        _draw_map(axes[key], np.where(seen, values, np.nan), title)
    _draw_words(axes["f"], channel)
    _draw_spectra(axes["g"], channel)
    _draw_depth(axes["h"], channel)
    return made


def _first(channel: ChannelResult) -> int:
    """Return the number of the first map that is compared: those that are identical are left out."""
    return int(np.argmax(channel.seen.any(axis=1)))


def _draw_map(axes: Axes, values: NDArray[np.float64], title: str) -> None:
    """Draw a Mollweide view, its colours up to the 99.5th percentile of |value|."""
    nside = min(SHOWN, healpy.npix2nside(values.size))
    coarse = healpy.ud_grade(np.where(np.isfinite(values), values, healpy.UNSEEN), nside)
    coarse = np.where(coarse == healpy.UNSEEN, np.nan, coarse)
    middle = float(np.nanmean(values))
    largest = float(np.nanquantile(np.abs(values - middle), 0.995)) or 1.0
    shown = mollweide(axes, coarse, 500, cmap="RdBu_r", vmin=middle - largest, vmax=middle + largest)
    axes.set_title(f"{title}: rms {number(float(np.nanstd(values)))} µK", fontsize=10, parse_math=False)
    axes.figure.colorbar(
        shown, ax=axes, orientation="horizontal", shrink=0.7, aspect=30, pad=0.02, ticks=MaxNLocator(4)
    ).set_label("µK")


def _plain_ticks(axes: Axes) -> None:
    """Write the ticks of a logarithmic x axis as numbers, and no others."""
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
    axes.xaxis.set_minor_locator(NullLocator())


def _draw_words(axes: Axes, channel: ChannelResult) -> None:
    """Say in words what was found, beside the maps."""
    lines = [d.words for d in channel.differences]
    lines += [f"  {key}: {value if isinstance(value, str) else number(value)}" for d in channel.differences
              for key, value in d.parameters.items()]  # fmt: skip
    axes.axis("off")
    lines += ["or " + " and ".join(d.words for d in one) for one in channel.alternatives]
    text = "\n".join([channel.verdict, *lines])
    axes.text(0.05, 0.9, text, va="top", fontsize=11, linespacing=1.5, transform=axes.transAxes, parse_math=False)


def _draw_spectra(axes: Axes, channel: ChannelResult) -> None:
    """Draw power by degree: side A, the difference, what is explained, and what is left."""
    nside = healpy.npix2nside(channel.a.shape[1])
    first, lmax = _first(channel), 2 * nside
    ell = np.arange(2, lmax + 1)
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
    axes.set_xticks([tick for tick in _TICKS if 2 <= tick <= lmax])
    _plain_ticks(axes)
    axes.set(xlabel="multipole $\\ell$", ylabel="$\\ell(\\ell + 1) C_\\ell / 2\\pi$  [µK²]", title="by degree")
    axes.legend(frameon=False, fontsize=9)


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
    axes.set_xticks([*middle[:: max(1, (middle.size - 1) // 3)]])
    _plain_ticks(axes)
    axes.set(xlabel="samples in a pixel", ylabel="rms  [µK]", title="by hits")
    axes.legend(frameon=False, fontsize=9)
