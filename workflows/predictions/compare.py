"""Hold ensembles against their exact predictions: chi^2 over all modes, with its small-sample probability.

    python workflows/predictions/compare.py NAME.toml=NAME.zarr ... [-o predictions.png]

For every channel the paired differences of all modes with L > 0 (real and imaginary parts) are binned in three ranges
of ell; T^2 = N r' S^-1 r of their mean against the prediction, with the sample covariance S of N realizations, is
Hotelling's: (N - p) / (p (N - 1)) T^2 ~ F(p, N - p). The probabilities of all channels are then tested for uniformity.
Ensembles of p + 2 realizations or fewer are drawn and not tested.
"""

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

import mcsim
from mcsim import config
from mcsim.bipolar import Mode
from mcsim.bipolar.modes import bin_factor
from mcsim.ensemble import prediction

BINS = 3
TITLES = {
    "elliptical": "elliptical Gaussian of {}, parallel transport",
    "coma-parallel-transport": "{}, parallel transport",
    "coma-long-time-limit": "{}, WMAP-like scan without end",
    "coma-hit-averaged": "{}, one WMAP-like year",
    "planck-like": "ellipse of {}, one Planck-like year",
    "tilted": "ellipse, one WMAP-like year, Galactic frame",
    "wmap7-parallel-transport": "measured beam {}, parallel transport",
    "wmap7-hit-averaged": "measured beam {}, one WMAP-like year",
}
"""Name of a run -> heading of a panel, with the channel's name put in."""


def vectors(biposh: np.ndarray, modes: list[Mode], edges: np.ndarray) -> np.ndarray:
    """Binned real and imaginary parts of all modes, shape (..., p)."""
    columns = []
    for index, mode in enumerate(modes):
        if mode.L == 0:
            continue
        scaled = bin_factor(mode, biposh.shape[-1] - 1) * biposh[..., index, :]
        for a, b in pairwise(edges):
            value = np.nanmean(scaled[..., a:b], axis=-1)
            if mode.M > 0 or mode.parity == "even":
                columns.append(value.real)
            if mode.M > 0 or mode.parity == "odd":
                columns.append(value.imag)
    return np.stack(columns, axis=-1)


def probability(sample: np.ndarray, expected: np.ndarray) -> tuple[float, int, float]:
    """chi^2 per degree of freedom (corrected to have mean 1), degrees of freedom, probability."""
    n, p = sample.shape
    residual = sample.mean(axis=0) - expected
    t2 = n * residual @ np.linalg.solve(np.cov(sample.T), residual)
    f = (n - p) / (p * (n - 1)) * t2
    return f * (n - p - 2) / (n - p), p, float(stats.f.sf(f, p, n - p))


def main() -> None:
    """Compare, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="CONFIG=STORE")
    parser.add_argument("-o", "--output", type=Path)
    arguments = parser.parse_args()
    panels, found = [], []
    for text in arguments.runs:
        source, path = text.split("=")
        run = config.load(source)
        ensemble = mcsim.open_ensemble(path).load()
        modes = [Mode(int(L), int(M), int(d)) for L, M, d in zip(ensemble.L, ensemble.M, ensemble.d, strict=True)]
        edges = np.linspace(4, ensemble.sizes["ell"], BINS + 1).astype(int)
        orders = {order: prediction.predict(run, exact=order == "exact") for order in ("exact", "leading")}
        for channel in run.channels:
            pair = f"{channel.name},{channel.name}"
            one = ensemble.sel(pair=pair)
            difference = (one.biposh - one.biposh_circular).values
            sample = vectors(difference, modes, edges)
            if len(sample) > sample.shape[1] + 2:
                results = {}
                for order, predicted in orders.items():
                    expected = predicted.sel(pair=pair)["biposh_difference_mean"].values
                    results[order] = probability(sample, vectors(expected, modes, edges))
                found.append(results["exact"][2])
                print(
                    f"{run.name} {channel.name}: N = {len(sample)}, p = {results['exact'][1]}; "
                    f"exact chi^2/dof {results['exact'][0]:.2f}, probability {results['exact'][2]:.3f}; "
                    f"leading order {results['leading'][0]:.2f}, {results['leading'][2]:.2g}",
                    flush=True,
                )
            title = TITLES.get(run.name, f"{run.name}, {{}}").format(channel.name)
            panels.append((title, modes, difference, orders, pair))
    if found:
        test = stats.kstest(found, "uniform")
        print(f"Kolmogorov-Smirnov of {len(found)} exact probabilities against uniform: p = {test.pvalue:.3f}")
    if arguments.output:
        draw(panels).savefig(arguments.output, dpi=90)


def draw(panels: list) -> Figure:
    """A^{20} of every channel: ensemble with errors in bins of 32, exact prediction as lines."""
    columns = 2 if len(panels) % 3 else 3
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.4 * columns, 3.1 * rows), layout="constrained")
    figure.suptitle("points: paired differences of simulations, mean and error; lines: exact prediction", fontsize=10)
    for number, (title, modes, difference, orders, pair) in enumerate(panels):
        axes = figure.add_subplot(rows, columns, number + 1)
        lmax = difference.shape[-1] - 1
        edges = np.arange(0, lmax + 2, 32)
        for mode, colour, name in (
            (Mode(2, 0, 0), "#1f5fa8", r"$A^{20}_{\ell\ell}$"),
            (Mode(2, 0, 2), "#c44e22", r"$A^{20}_{\ell-2,\ell}$"),
        ):
            factor, index = bin_factor(mode, lmax), modes.index(mode)

            def binned(a: np.ndarray, factor: np.ndarray = factor, edges: np.ndarray = edges) -> np.ndarray:
                bounds = pairwise(edges)
                return np.stack([np.nanmean((factor * a)[..., i:j], axis=-1) for i, j in bounds], axis=-1).real

            sample = binned(difference[:, index])
            x = (edges[:-1] + edges[1:]) / 2
            error = sample.std(axis=0, ddof=1) / np.sqrt(len(sample))
            axes.errorbar(x, sample.mean(axis=0), error, fmt="o", ms=3, color=colour, label=name)
            exact = orders["exact"].sel(pair=pair, mode=mode.name)["biposh_difference_mean"].values
            axes.plot(x, binned(exact), color=colour, lw=1)
        axes.axhline(0, color="0.6", lw=0.8)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel(r"multipole $\ell$")
        axes.set_ylabel(r"$\ell(\ell+1)A^{20}/2\pi$  [$\mu$K$^2$]")
        axes.legend(frameon=False, fontsize=8)
    return figure


if __name__ == "__main__":
    main()
