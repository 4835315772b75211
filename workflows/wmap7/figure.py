"""Draw the beams' A^{20} under parallel transport and under the scan, and hold them against a table.

    python workflows/wmap7/figure.py wmap7-parallel-transport.zarr wmap7-hit-averaged.zarr -o wmap7.png
        [--reference TABLE.json]

The table has ``A20`` -> "WMAP7 V2A map PT d=0" and the like -> means over bins of 50 from l = 0, in uK^2.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

import mcsim

LABELS = {"PT": "parallel transport", "hit": "hit-averaged, one year"}
COLOURS = {"V2": "#c44e22", "W1": "#1f5fa8"}
SPECTRUM = {0: r"A^{20}_{\ell\ell}", 2: r"A^{20}_{\ell-2,\ell}"}


def spectrum(summary: xr.Dataset, channel: str, d: int) -> tuple[np.ndarray, np.ndarray]:
    """Binned paired difference and its standard error."""
    one = summary.sel(pair=f"{channel},{channel}", mode=f"L2M0d{d}")
    name = "biposh_difference_binned"
    return one[f"{name}_mean"].values.real, one[f"{name}_standard_error"].values


def draw(summaries: dict[str, xr.Dataset], reference: dict[str, list[float]]) -> Figure:
    """One panel for d = 0, one for d = 2: points from the ensembles, crosses from the table."""
    figure = Figure(figsize=(10.5, 4.2), layout="constrained")
    for panel, d in enumerate((0, 2)):
        axes = figure.add_subplot(1, 2, panel + 1)
        for scan, summary in summaries.items():
            for channel, colour in COLOURS.items():
                value, error = spectrum(summary, channel, d)
                x = summary["bin"].values
                style = {"fmt": "o-" if scan == "PT" else "s--", "mfc": colour if scan == "PT" else "white"}
                axes.errorbar(x, value, error, color=colour, ms=4, lw=1, label=f"{channel}, {LABELS[scan]}", **style)
                table = reference.get(f"WMAP7 {channel}A map {scan} d={d}")
                if table is not None:
                    first = (scan, channel) == ("PT", "V2")
                    label = "independent, leading order" if first else None
                    axes.plot(x[: len(table)], table, "x", color="black", ms=6, zorder=5, label=label)
        axes.axhline(0, color="0.6", lw=0.8)
        axes.set_xlabel(r"multipole $\ell$")
        axes.set_ylabel(rf"$\ell(\ell+1){SPECTRUM[d]}/2\pi$  [$\mu$K$^2$]")
        axes.set_xlim(0, 1025)
        axes.legend(frameon=False, fontsize=8)
    return figure


def compare(summaries: dict[str, xr.Dataset], reference: dict[str, list[float]]) -> None:
    """Print the largest deviation from the table over l = 50 ... 900, and where d = 0 changes its sign."""
    for scan, summary in summaries.items():
        for channel in COLOURS:
            for d in (0, 2):
                value, error = spectrum(summary, channel, d)
                table = np.array(reference[f"WMAP7 {channel}A map {scan} d={d}"])[1:18]
                difference = np.abs(value[1:18] - table)
                excess = np.minimum(difference / np.abs(table) / 0.02, difference)
                text = f"{channel} {scan:3s} d={d}: |difference| <= {difference.max():.2f} uK^2, error bars "
                text += f"<= {error[1:18].max():.2f}; in units of (2 % or 1 uK^2) <= {excess.max():.2f}"
                if d == 0:
                    crossing = summary["bin"].values[:-1][np.diff(np.sign(value)) != 0]
                    text += f"; changes sign after the bins at {', '.join(f'{x:.0f}' for x in crossing) or 'none'}"
                print(text)


def significance(summaries: dict[str, xr.Dataset]) -> None:
    """Print chi^2 of the plain mean and of the paired difference against zero, mode by mode."""
    for scan, summary in summaries.items():
        for channel in COLOURS:
            print(f"{channel} {scan}: chi^2 / bins of the paired difference against zero")
            for mode in summary["mode"].values:
                one = summary.sel(pair=f"{channel},{channel}", mode=mode)
                if int(one["L"]) == 0:
                    continue
                mean = one["biposh_difference_binned_mean"].values[1:]
                error = one["biposh_difference_binned_standard_error"].values[1:]
                largest = np.abs(mean).max()
                print(f"  {mode}: {np.sum(np.abs(mean / error) ** 2) / mean.size:9.2f}, largest |A| {largest:.3f} uK^2")


def main() -> None:
    """Read the stores, draw, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parallel_transport", type=Path)
    parser.add_argument("hit_averaged", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("wmap7.png"))
    parser.add_argument("--reference", type=Path)
    arguments = parser.parse_args()
    paths = {"PT": arguments.parallel_transport, "hit": arguments.hit_averaged}
    summaries = {scan: mcsim.open_summary(path).load() for scan, path in paths.items()}
    reference = json.loads(arguments.reference.read_text())["A20"] if arguments.reference else {}
    draw(summaries, reference).savefig(arguments.output, dpi=110)
    significance(summaries)
    if reference:
        compare(summaries, reference)


if __name__ == "__main__":
    main()
