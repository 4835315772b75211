"""Hold quadratic maximum-likelihood A^{LM} of the WMAP-7 beams outside KQ85 against prediction and plain estimator.

    python workflows/filter/compare.py wmap7-filtered.zarr wmap7-plain.zarr -o filter.png [--json result.json]

The prediction is that of the full sky, exact in the beam, for M = 0 up to L = 6 (the scan depends on longitude by its
samples alone). What L > 2 adds to the bins of L <= 2 through the mask is computed with the random maps that normalise
the estimates. The two estimators are held against each other as unbiased estimates of the same numbers: what the plain
one measures of every bin and mode comes from random maps too.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

import mcsim
from mcsim.bipolar import Estimator, estimate, estimator
from mcsim.bipolar.modes import bin_factor
from mcsim.ensemble.expectation import means, scanned_beams
from mcsim.simulation import simulate
from mcsim.simulation.filtering import Bands, Filtering
from mcsim.simulation.inverse_covariance import InverseCovariance
from mcsim.simulation.survey import Survey, survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix

HERE = Path(__file__).parent
L_LEAK, L_MOMENTS, PROBES, DRAWN = 6, 32, 40, 70
MODES = {"L2M0d0": r"$A^{20}_{\ell\ell}$", "L2M0d2": r"$A^{20}_{\ell-2,\ell}$"}


def expected(shared: Survey, number: int, few: Filtering, probes: list) -> tuple[np.ndarray, np.ndarray]:
    """Mean band powers of what the beam adds, and their variance by the normalisation and by themselves, as numbers."""
    x, y = shared.pairs[number]
    every = estimator(L_LEAK, shared.lmax)
    zonal = tuple(mode for mode in every.modes if mode.M == 0)
    tables = Estimator(shared.lmax, zonal, tuple(band for band in every.bands if band.M == 0))
    wide = replace(shared, estimator=tables)
    found = means(wide, scanned_beams(wide, L_MOMENTS), (x, y), exact=True)
    added = np.nan_to_num(found.beam - found.circular)
    bands = Bands(tables.modes, shared.lmax, shared.lmax + 1, True)

    def change(first: np.ndarray, second: np.ndarray) -> float:
        both = 0.5 * (estimate(tables, first, second) + estimate(tables, second, first))
        return float(2.0 * np.sum(bands.count * (added.conj() * np.nan_to_num(both)).real))

    joint = few.response(probes, number, change).matrix
    fisher, mixed = joint[:-1, :-1], joint[:-1, -1]
    mean = np.linalg.solve(fisher, mixed)
    # What of the change is no sum of the bins adds scatter to the regression on them.
    left = max(joint[-1, -1] - mixed @ mean, 0.0)
    pairs = [n * (n - 1) / 2 for n in (shared.filtering.drawn, len(probes))]
    sigma2 = np.diag(shared.filtering.inverses[number])
    return mean, (sigma2 * (mixed @ mean) + mean**2) / pairs[0] + sigma2 * left / pairs[1]


def same_numbers(shared: Survey, number: int, beam: np.ndarray) -> dict[str, np.ndarray]:
    """Variances of the estimators for the same numbers, filtered over plain, and what the plain one measures of each.

    Of independent maps d, e of covariance C, filtered to x, y: 2 <(x'C_p y / 2)(x'C_q y / 2)> is F, and with the plain
    estimate d'E_p e, R = Tr[E_p C_q] = 2 <(d'E_p e)(x'C_q y / 2)> is its response, 2 <(d'E_p e)(d'E_q e)> its
    covariance. By construction R^-1 V R^-t - F^-1 has no negative eigenvalue. No map has a monopole or a dipole, and
    both estimators know it.
    """
    x, _ = shared.pairs[number]
    bands, tables, lmax = shared.filtering.bands[number], shared.estimator, shared.lmax
    given = shared.filtering.filters[x]
    maps = given.inverse.maps
    one = replace(given, inverse=InverseCovariance(shared.cl, maps, given.inverse.tolerance, given.inverse.nthreads))
    used, (mode, place, part) = bands.count > 0.0, bands.numbers
    factor = np.stack([bin_factor(each, lmax) for each in bands.modes])
    norm = shared.pair_norm[number] / np.add.reduceat(used.astype(float), bands.first, axis=-1)[mode, place]

    def plain(raw: np.ndarray) -> np.ndarray:
        total = np.add.reduceat(np.where(used, factor * np.where(used, raw, 0.0), 0.0), bands.first, axis=-1)
        return norm * np.where(part == 0, total.real[mode, place], total.imag[mode, place])

    drawn = []
    for draw in range(DRAWN):
        map_uk = one.inverse.draw("compare", draw)[0]
        alm = healpix.analysis(shared.maps[x].weight * map_uk, lmax, nthreads=one.inverse.nthreads)
        drawn.append((one.apply(map_uk)[0], alm_.multiply(alm, 1.0 / one.window[: lmax + 1], lmax)))
    found = np.zeros((2, 2, bands.size, bands.size))
    for i, first in enumerate(drawn):
        for second in drawn[:i]:
            both = [0.5 * (estimate(tables, a, b) + estimate(tables, b, a)) for a, b in zip(first, second, strict=True)]
            values = np.stack([bands.sums(both[0]), plain(both[1])])
            found += 2.0 * values[:, None, :, None] * values[None, :, None, :] / (DRAWN * (DRAWN - 1) / 2)
    fisher, response, covariance = found[0, 0], found[1, 0], found[1, 1]
    back = np.linalg.inv(response)
    unbiased, own = back @ covariance @ back.T, np.diag(response)
    information = beam @ fisher @ beam, response @ beam @ np.linalg.solve(covariance, response @ beam)
    return {
        "all_unknown": np.diag(np.linalg.inv(fisher)) / np.diag(unbiased),
        "one_unknown": own**2 / np.diag(covariance) / np.diag(fisher),
        "response_plain": own,
        "beam_amplitude": np.full(own.size, information[1] / information[0]),
    }


def compared(shared: Survey, filtered: xr.Dataset, plain: xr.Dataset) -> dict[str, dict[str, list[float]]]:
    """Means, errors, pulls and variance ratios by channel and mode; bins from the second on."""
    filtering = shared.filtering
    assert filtering is not None
    few = replace(filtering, probes=PROBES)
    probes, result = few.probed(), {}
    sigma = filtering.errors()
    for number, pair in enumerate(shared.pair_names):
        numbers, variance = expected(shared, number, few, probes)
        bands = filtering.bands[number]
        wanted, parts = bands.spectra(numbers), bands.spectra(variance)
        uncertain = np.sqrt(parts.real + parts.imag)
        same = {name: bands.spectra(values) for name, values in same_numbers(shared, number, numbers).items()}
        for row, mode in enumerate(shared.estimator.modes):
            if mode.L == 0:
                continue
            one = filtered.sel(pair=pair, mode=mode.name)
            other = plain.sel(pair=pair, mode=mode.name)
            # The stored error has that of the normalisation, which is computed here.
            error = one.biposh_qml_difference_standard_deviation.values / np.sqrt(one["count"].item())
            mean = one.biposh_qml_difference_mean.values
            total = np.hypot(error, uncertain[row]) / (np.sqrt(2.0) if mode.M else 1.0)  # of one part
            part = np.imag if mode.M == 0 and mode.parity == "odd" else np.real
            scatter = other.biposh_binned_standard_deviation.values
            result[f"{pair.split(',')[0]} {mode.name}"] = {
                "mean": part(mean).tolist(),
                "error": error.tolist(),
                "expected": part(wanted[row]).tolist(),
                "error_of_normalisation": uncertain[row].tolist(),
                "pull": (part(mean - wanted[row]) / total).tolist(),
                "sigma_fisher": sigma[number, row].tolist(),
                "sigma_filtered": one.biposh_qml_standard_deviation.values.tolist(),
                "sigma_plain": scatter.tolist(),
                "variance_ratio": ((sigma[number, row] / scatter) ** 2).tolist(),
                "variance_ratio_binned": ((one.biposh_binned_standard_deviation.values / scatter) ** 2).tolist(),
                **{name: part(values[row]).tolist() for name, values in same.items()},
            }
    return result


def timed(shared: Survey) -> float:
    """Processor time of a realization, s."""
    simulate.realize(shared, 0)
    start = time.process_time()
    simulate.realize(shared, 1)
    simulate.realize(shared, 2)
    return (time.process_time() - start) / 2.0


def draw(result: dict, middle: np.ndarray) -> Figure:
    """Means on the left, variance ratios on the right."""
    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, colour in (("V2", "#c44e22"), ("W1", "#1f5fa8")):
        for mode, marker in zip(MODES, "os", strict=True):
            # The last bin is a single degree at the end.
            one = {key: np.array(value)[:-1] for key, value in result[f"{name} {mode}"].items()}
            error = np.hypot(one["error"], one["error_of_normalisation"])
            label = f"{name}, {MODES[mode]}"
            shown = {"color": colour, "marker": marker, "ms": 5, "mfc": colour if marker == "o" else "white"}
            left.errorbar(middle, one["mean"], error, ls="", label=label, **shown)
            left.plot(middle, one["expected"], "-" if marker == "o" else "--", color=colour, lw=1)
            style = "-" if marker == "o" else "--"
            right.plot(middle, one["variance_ratio"], style, color=colour, lw=0.7)
            right.plot(middle, one["all_unknown"], style, label=label, **shown)
    left.set(
        xlabel=r"multipole $\ell$",
        ylabel=r"$\ell(\ell+1)A/2\pi$  [$\mu$K$^2$]",
        title="mean: points; prediction: lines",
    )
    left.axhline(0.0, color="0.7", lw=0.8)
    title = "one sky: as they stand (thin), of the same numbers (thick)"
    right.set(xlabel=r"multipole $\ell$", ylabel="variance, filtered / plain", title=title, ylim=(0.0, 1.6))
    right.axhline(1.0, color="0.7", lw=0.8)
    for axes in (left, right):
        axes.legend(frameon=False, fontsize=9)
    return figure


def main() -> None:
    """Read the stores, compare, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("filtered", type=Path)
    parser.add_argument("plain", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("filter.png"))
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    filtered, plain = (mcsim.open_summary(path).load() for path in (arguments.filtered, arguments.plain))
    shared = survey(mcsim.load_config(HERE / "filtered.toml"))
    result = compared(shared, filtered, plain)
    pulls = np.concatenate([each["pull"] for each in result.values()])
    ratio = np.concatenate(
        [np.square(each["sigma_filtered"]) / np.square(each["sigma_fisher"]) for each in result.values()]
    )
    print(f"pulls of {pulls.size} means: rms {np.sqrt(np.mean(pulls**2)):.2f}, largest {np.abs(pulls).max():.1f}")
    print(f"variance of {int(filtered['count'])} skies over that of the Fisher matrix: {ratio.mean():.3f}")
    first = filtered["bin_first"].values
    titles = {
        "variance_ratio": "as they stand",
        "all_unknown": "of the same numbers, all unknown",
        "one_unknown": "of the same number, all others known",
        "response_plain": "(no ratio) what a bin of the plain estimator has of its own",
        "beam_amplitude": "of the amplitude of the beam's spectra",
    }
    for key, title in titles.items():
        print(f"variance, filtered over plain, {title}; bins from l =", *first)
        for name, each in result.items():
            print(f"  {name:10s}", *(f"{value:6.2f}" for value in each[key]))
    alone = np.mean([each["variance_ratio_binned"] for each in result.values()], axis=0)
    print("each mode normalised alone, mean over modes:", *(f"{value:.2f}" for value in alone))
    seconds = {name: timed(survey(mcsim.load_config(HERE / f"{name}.toml"))) for name in ("filtered", "plain")}
    print(f"one realization: {seconds['filtered']:.2f} s filtered, {seconds['plain']:.2f} s plain, processor time")
    draw(result, filtered["bin"].values[:-1]).savefig(arguments.output, dpi=110)
    if arguments.json:
        whole = {"bin_first": first.tolist(), "seconds": seconds, "results": result}
        arguments.json.write_text(json.dumps(whole, indent=1) + "\n")


if __name__ == "__main__":
    main()
