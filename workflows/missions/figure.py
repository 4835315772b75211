"""Draw what the scans of LiteBIRD and Planck leave of an elongated beam's A^{20}, and which modes stand out.

    python workflows/missions/figure.py FOLDER -o missions.png

FOLDER holds litebird.zarr and planck.zarr. The scan and parallel transport share their skies, so their ratio is far
more precise than the spectra; its errors are jackknives over the realizations. Lines are exact predictions.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

from mcsim import beamfit, config
from mcsim.bipolar.theory import orientation_harmonics
from mcsim.ensemble import prediction
from mcsim.instrument import scan
from mcsim.instrument.scan.factors import ScanFactors
from mcsim.simulation.survey import Survey, survey
from mcsim.stats.streaming import jackknife

HERE = Path(__file__).parent
MISSIONS = {"litebird": "LiteBIRD-like", "planck": "Planck-like"}
MODES = {"L2M0d0": r"A^{20}_{\ell\ell}", "L2M0d2": r"A^{20}_{\ell-2,\ell}"}
STYLE = {"parallel-transport": ("s", "#333333", "parallel transport"), "scan": ("o", "#1f5fa8", "one year of scan")}
REFERENCE = "parallel-transport"
FIRST = 1  # the first bin, l < 32, is left out of overall ratios


def binned_differences(store: Path, channel: str, mode: str) -> np.ndarray:
    """Paired difference of every realization, binned, shape (realization, bin), uK^2."""
    found = beamfit.from_store(
        store, beamfit.Selection((mode,), kind="difference", pair=f"{channel},{channel}")
    ).realizations
    assert found is not None  # as of every store
    return found


def hotelling(sample: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """chi^2 per degree of freedom of a mean against its expectation, corrected to have mean 1, and its probability."""
    n, p = sample.shape
    residual = sample.mean(axis=0) - expected
    f = (n - p) / (p * (n - 1)) * n * residual @ np.linalg.solve(np.cov(sample.T), residual)
    return f * (n - p - 2) / (n - p), float(stats.f.sf(f, p, n - p))


def exact_prediction(shared: Survey) -> xr.Dataset:
    """Exact predictions of both channels, each on its own: their pair is not needed, and costs as much as the two."""
    wanted = ["biposh_difference_mean", "biposh_difference_binned_mean", "signal_to_noise"]
    alone = []
    for channel, spec in zip(shared.channels, shared.config.channels, strict=True):
        one = replace(
            shared,
            config=replace(shared.config, channels=(spec,)),
            channels=(channel,),
            pairs=((0, 0),),
            pair_norm=(1.0,),
        )
        alone.append(prediction.predict(one, exact=True, snr=True, nthreads=2).load())
    return xr.concat([one[wanted] for one in alone], "pair").assign(bin_factor=alone[0]["bin_factor"])


def draw_spectrum(axes: Axes, store: Path, predicted: xr.Dataset, mode: str) -> None:
    """Binned spectra with errors, predictions through them."""
    for channel, (marker, colour, label) in STYLE.items():
        sample = binned_differences(store, channel, mode)
        error = sample.std(axis=0, ddof=1) / np.sqrt(len(sample))
        line = predicted.sel(pair=f"{channel},{channel}", mode=mode)
        axes.errorbar(line["bin"], sample.mean(axis=0), error, fmt=marker, ms=4, lw=1, color=colour, label=label)
        factor = predicted["bin_factor"].sel(mode=mode).values
        smooth = (factor * line["biposh_difference_mean"].values.real)[4:]
        axes.plot(line["ell"][4:], smooth, color=colour, lw=1, label="exact prediction" if marker == "o" else None)
    axes.axhline(0, color="0.8", lw=0.8)
    axes.set_xlabel(r"multipole $\ell$")
    axes.set_ylabel(rf"$\ell(\ell+1){MODES[mode]}/2\pi$  [$\mu$K$^2$]")
    axes.legend(frameon=False, fontsize=8)


def draw_ratio(axes: Axes, store: Path, predicted: xr.Dataset, factors: ScanFactors) -> None:
    """The scan over parallel transport, bin by bin, beside two of the three factors; the report has all."""
    for offset, (mode, name) in enumerate(MODES.items()):
        ratio, error = jackknife(
            np.divide, *(binned_differences(store, channel, mode) for channel in ("scan", REFERENCE))
        )
        fill = "#1f5fa8" if mode == "L2M0d0" else "white"
        x = predicted["bin"].values + 4 * offset
        axes.errorbar(x, ratio, error, fmt="o", ms=4, lw=1, color="#1f5fa8", mfc=fill, label=f"${name}$")
        exact = [predicted["biposh_difference_binned_mean"].sel(pair=f"{c},{c}", mode=mode).values.real for c in STYLE]
        axes.plot(x, exact[1] / exact[0], "-" if offset == 0 else "--", color="#c44e22", lw=1, label=f"exact, ${name}$")
    for value, text, style in (
        (factors.quadrupole_ratio, "mean of $w_2$ that A$^{20}$ sees", "-"),
        (float(factors.f_ell[-1]), r"$f_\ell$ of the paper, $\ell = 400$", ":"),
    ):
        axes.axhline(value, color="0.5", lw=1, ls=style, zorder=0, label=f"{value:.4f}: {text}")
    axes.set_xlabel(r"multipole $\ell$")
    axes.set_ylabel("scan over parallel transport")
    axes.margins(y=0.5)
    axes.legend(framealpha=1.0, edgecolor="none", fontsize=7, ncols=1)


def signal_to_noise(predicted: xr.Dataset, channel: str) -> dict[tuple[int, int], float]:
    """Signal to noise in one noise-free sky of each (L, M), all d together."""
    found: dict[tuple[int, int], float] = {}
    for mode in predicted["mode"].values:
        one = predicted.sel(pair=f"{channel},{channel}", mode=mode)
        if int(one["L"]) > 0 and np.isfinite(one["signal_to_noise"]):
            key = (int(one["L"]), int(one["M"]))
            found[key] = float(np.hypot(found.get(key, 0.0), float(one["signal_to_noise"])))
    return found


def draw_modes(axes: Axes, predicted: xr.Dataset) -> None:
    """Signal to noise by (L, M)."""
    for side, (channel, (_, colour, label)) in enumerate(STYLE.items()):
        values = signal_to_noise(predicted, channel)
        axes.bar(np.arange(len(values)) + 0.4 * side - 0.2, list(values.values()), 0.4, color=colour, label=label)
    axes.set_xticks(range(len(values)), [f"{L},{M}" for L, M in values], fontsize=8)
    axes.set_yscale("log")
    axes.set_ylim(1e-3, None)
    axes.set_xlabel("L, M")
    axes.set_ylabel("signal to noise in one sky")
    axes.legend(frameon=False, fontsize=8)


def report(name: str, store: Path, predicted: xr.Dataset, moments: scan.Moments, factors: ScanFactors) -> None:
    """Print factors, ratios, agreement with the prediction, and the strong modes."""
    print(
        f"{name}: {moments.hits.sum():.4g} samples, {np.mean(moments.hits > 0):.4%} of the sky; "
        f"factors {factors.quadrupole_ratio:.4f} (A20), {factors.sky_mean:.4f} (sky mean), "
        f"f_l {', '.join(f'{value:.4f}' for value in factors.f_ell)} at l = {', '.join(map(str, factors.ell))}"
    )
    for mode in MODES:
        part, whole = (binned_differences(store, channel, mode) for channel in ("scan", REFERENCE))
        value, error = jackknife(lambda a, b: a[FIRST:].sum() / b[FIRST:].sum(), part, whole)
        exact = [predicted["biposh_difference_binned_mean"].sel(pair=f"{c},{c}", mode=mode).values.real for c in STYLE]
        print(
            f"  {mode}: scan over parallel transport {value:.4f} ± {error:.4f}, exact prediction "
            f"{exact[1][FIRST:].sum() / exact[0][FIRST:].sum():.4f}; by bin {(exact[1] / exact[0])[FIRST:].min():.3f} "
            f"to {(exact[1] / exact[0])[FIRST:].max():.3f}"
        )
        for channel, expected in zip(STYLE, exact, strict=True):
            sample = binned_differences(store, channel, mode)
            chi2, probability = hotelling(sample, expected)
            mean, error = sample.mean(axis=0), sample.std(axis=0, ddof=1) / np.sqrt(len(sample))
            peak = int(np.argmax(np.abs(mean)))
            at = predicted["bin"].values[peak]
            print(
                f"    {channel}: peak {mean[peak]:.2f} ± {error[peak]:.2f} uK^2 at l = {at:.0f}; "
                f"exact prediction: chi^2/dof {chi2:.2f}, probability {probability:.3f}"
            )
    for channel in STYLE:
        ranked = sorted(signal_to_noise(predicted, channel).items(), key=lambda item: -item[1])
        print(
            f"  signal to noise in one sky, {channel}: " + ", ".join(f"({L},{M}) {s:.3g}" for (L, M), s in ranked[:7])
        )
    power = np.abs(orientation_harmonics(np.asarray(moments.w[:2]), 8)[2]) ** 2
    share = power / (4.0 * np.pi * np.mean(np.abs(moments.w[1]) ** 2))
    top = sorted(((share[L].sum(), L) for L in range(2, 9)), reverse=True)
    print("  power of w_2 by L: " + ", ".join(f"L = {L} {value:.1%}" for value, L in top))


def main() -> None:
    """Read the stores, predict, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("missions.png"))
    arguments = parser.parse_args()
    figure = Figure(figsize=(16, 7.5), layout="constrained")
    grid = figure.subplots(2, 4)
    for row, (name, title) in zip(grid, MISSIONS.items(), strict=True):
        store, shared = arguments.folder / f"{name}.zarr", survey(config.load(HERE / f"{name}.toml"))
        predicted = exact_prediction(shared)
        moments = shared.channels[0].maps[0].moments
        factors = scan.scan_factors(moments)
        for axes, mode in zip(row, MODES, strict=False):
            draw_spectrum(axes, store, predicted, mode)
        draw_ratio(row[2], store, predicted, factors)
        draw_modes(row[3], predicted)
        row[0].set_title(title, loc="left")
        report(name, store, predicted, moments, factors)
    figure.savefig(arguments.output, dpi=90)


if __name__ == "__main__":
    main()
