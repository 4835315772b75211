"""Draw A^{20} of W1 as differences and map-making leave it, beside parallel transport and the hit average.

    python workflows/full-scan/figure.py FOLDER -o full-scan.png

FOLDER holds the stores of the six runs of this folder, NAME.zarr each; MCSIM_DATA is set as for the runs. All runs
share their skies, so ratios are far more precise than the spectra; their errors are jackknives over the realizations.
"""

import argparse
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import mcsim
from mcsim import beamfit, config
from mcsim.ensemble.detectability import sky_fraction
from mcsim.instrument import scan
from mcsim.simulation.channels import load_beam
from mcsim.simulation.survey import survey
from mcsim.sphere import spectra
from mcsim.stats.streaming import jackknife

HERE = Path(__file__).parent
RUNS = (
    "parallel-transport",
    "hit-averaged",
    "full-scan",
    "full-scan-turned",
    "parallel-transport-masked",
    "full-scan-masked",
)
MODES = {"L2M0d0": r"A^{20}_{\ell\ell}", "L2M0d2": r"A^{20}_{\ell-2,\ell}"}
STYLE = {
    "parallel-transport": ("o", "#333333", "parallel transport"),
    "hit-averaged": ("s", "#c44e22", "hit average"),
    "full-scan": ("D", "#1f5fa8", "differences, map-making"),
    "full-scan-masked": ("^", "#4f9a4f", "the same, KQ85 mask"),
}
TURN_DEG = -140.0
FIRST = 1  # the first bin, l < 25, is left out of overall ratios


def binned_differences(folder: Path, run: str, mode: str) -> np.ndarray:
    """Paired difference of every realization, binned, shape (realization, bin), uK^2."""
    found = beamfit.from_store(
        folder / f"{run}.zarr", beamfit.Selection((mode,), kind="difference", pair="W1,W1")
    ).realizations
    assert found is not None  # as of every store
    return found


def overall(part: np.ndarray, whole: np.ndarray) -> tuple[float, float]:
    """Ratio of the sums over all bins but the first, and its error."""
    value, error = jackknife(lambda a, b: a[FIRST:].sum() / b[FIRST:].sum(), part, whole)
    return float(value), float(error)


def straight_line(part: np.ndarray, whole: np.ndarray, ell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """alpha and beta of the ratio alpha + beta l, and their errors."""
    weight = 1.0 / jackknife(np.divide, part, whole)[1][FIRST:]
    return jackknife(lambda a, b: np.polyfit(ell[FIRST:], (a / b)[FIRST:], 1, w=weight)[::-1], part, whole)


def factors() -> dict[float, str]:
    """What the paper calls ~0.45, three numbers, in the limit of a long survey with the lines of sight of W1."""
    model = scan.ScanModel.load("wmap_focal_plane")
    sides = [scan.limit_factors(model.with_lines_of_sight(line)) for line in ("W1A", "W1B")]
    return {
        float(np.mean([sign.quadrupole_ratio for sign in sides])): "mean of $w_2$ that A$^{20}$ sees",
        float(np.mean([sign.sky_mean for sign in sides])): "sky mean of $w_2$",
        float(np.mean([sign.f_ell[-1] for sign in sides])): "$f_\\ell$ of the paper",
    }


def turned_factor(delta_deg: np.ndarray) -> np.ndarray:
    """Mean of both sides' b_l2 over side A's as A^{20}_ll sees it, side B's beam being side A's turned by an angle.

    At leading order the binned A^{20}_ll is linear in l(l+1) C_l b_l0 Re b_l2 / (2l+1): these are the weights.
    """
    run = config.load(HERE / "full-scan.toml")
    beam, cl = load_beam(run.channels[0], 256).blm, spectra.load(run.sky.spectrum, 256)
    ell = np.arange(25, 257)
    share = ell * (ell + 1.0) / (2.0 * ell + 1.0) * cl[ell] * beam[0, ell].real
    both = 0.5 * (beam[2, ell] + beam[2, ell] * np.exp(-2j * np.deg2rad(delta_deg))[:, None])
    return both.real @ share / (beam[2, ell].real @ share)


def draw_spectrum(axes: Axes, summaries: dict[str, xr.Dataset], mode: str, lines: dict[float, str]) -> None:
    """Binned spectra of the runs, and parallel transport scaled by the smallest and the largest factor."""
    for number, (run, (marker, colour, label)) in enumerate(STYLE.items()):
        one = summaries[run].sel(pair="W1,W1", mode=mode)
        x, value = one["bin"].values, one["biposh_difference_binned_mean"].values.real
        error = one["biposh_difference_binned_standard_error"].values
        axes.errorbar(x + 1.5 * (number - 1.5), value, error, fmt=marker, ms=4, lw=1, color=colour, label=label)
        if run == "parallel-transport":
            for factor, line in zip((min(lines), max(lines)), (":", "-"), strict=True):
                axes.plot(x, factor * value, line, color="0.55", lw=1, label=f"parallel transport × {factor:.3f}")
    axes.axhline(0, color="0.8", lw=0.8)
    axes.set_xlabel(r"multipole $\ell$")
    axes.set_ylabel(rf"$\ell(\ell+1){MODES[mode]}/2\pi$  [$\mu$K$^2$]")
    axes.legend(frameon=False, fontsize=7.5)


def draw_ratio(axes: Axes, folder: Path, ell: np.ndarray, lines: dict[float, str]) -> None:
    """Runs over parallel transport, bin by bin."""
    offset = 0.0
    for run in ("hit-averaged", "full-scan"):
        for mode, name in MODES.items():
            ratio, error = jackknife(np.divide, *(binned_differences(folder, r, mode) for r in (run, RUNS[0])))
            marker, colour, label = STYLE[run]
            fill = colour if mode == "L2M0d0" else "white"
            axes.errorbar(
                ell + offset, ratio, error, fmt=marker, ms=4, lw=1, color=colour, mfc=fill, label=f"{label}, ${name}$"
            )
            offset += 2.0
    for factor, text in lines.items():
        axes.axhline(factor, color="0.55", lw=1, ls="--", zorder=0)
        axes.text(258, factor - 0.016, f"{factor:.3f}: {text}", ha="right", va="top", fontsize=7.5, color="0.35")
    axes.set_ylim(0.42, 0.76)
    axes.set_xlabel(r"multipole $\ell$")
    axes.set_ylabel("over parallel transport")
    axes.legend(frameon=False, fontsize=7.5, ncols=2, loc="upper right")


def draw_orientation(axes: Axes, folder: Path) -> None:
    """The factor against the relative orientation of the two sides: leading order, and two simulated points."""
    mode = "L2M0d0"
    whole = binned_differences(folder, RUNS[0], mode)
    average, _ = overall(binned_differences(folder, "hit-averaged", mode), whole)
    angle = np.linspace(-180.0, 0.0, 181)
    axes.plot(angle, average * turned_factor(angle), color="#c44e22", lw=1.2, label="leading order, hit average")
    for run, at in (("full-scan", 0.0), ("full-scan-turned", TURN_DEG)):
        value, error = overall(binned_differences(folder, run, mode), whole)
        axes.errorbar([at], [value], [error], fmt="D", ms=5, color="#1f5fa8", label="simulated" if at == 0.0 else None)
    axes.axhline(0.45, color="0.55", lw=1, ls="--")
    axes.text(-90, 0.455, "0.45", ha="center", va="bottom", fontsize=8, color="0.35")
    axes.set_xlabel("side B turned against side A, from x towards y  [degrees]")
    axes.set_ylabel(r"$A^{20}_{\ell\ell}$ over parallel transport")
    axes.legend(frameon=False, fontsize=8)


def report(folder: Path, ell: np.ndarray) -> None:
    """Print ratios with their errors, overall and bin by bin, and the line through them."""
    plain, masked = "parallel-transport", "parallel-transport-masked"
    for mode in MODES:
        for run, reference in (
            ("hit-averaged", plain),
            ("full-scan", plain),
            ("full-scan-turned", plain),
            ("full-scan-masked", plain),
            ("full-scan-masked", masked),
            ("full-scan", "hit-averaged"),
        ):
            part, whole = (binned_differences(folder, name, mode) for name in (run, reference))
            value, error = overall(part, whole)
            line, line_error = straight_line(part, whole, ell)
            each = zip(*jackknife(np.divide, part, whole), strict=True)
            print(
                f"{mode} {run} over {reference}: {value:.4f} ± {error:.4f}; as alpha + beta l: "
                f"alpha {line[0]:.3f} ± {line_error[0]:.3f}, beta {line[1]:.1e} ± {line_error[1]:.1e}\n    "
                + " ".join(f"{v:.3f}±{e:.3f}" for v, e in each)
            )
    hit, whole = (binned_differences(folder, run, "L2M0d0") for run in ("hit-averaged", plain))
    angle = np.linspace(-180.0, 0.0, 18001)
    curve = overall(hit, whole)[0] * turned_factor(angle)
    reached = angle[:-1][np.diff(np.sign(curve - 0.45)) != 0]
    print(f"leading order: 0.45 at {', '.join(f'{a:.1f}' for a in reached)} degrees", end="; ")
    # Half a turn changes nothing at m = 2: -40 degrees is +140.
    for at in (-140.0, -40.0):
        print(f"{curve[np.argmin(np.abs(angle - at))]:.4f} at {at:g} degrees", end="; ")
    print(f"turned by {TURN_DEG:g}, the simulation is above")


def report_mask(summaries: dict[str, xr.Dataset]) -> None:
    """Print the mask's mean field, and what the mask does to the error bars."""
    fraction = sky_fraction(survey(config.load(HERE / "full-scan-masked.toml")), (0, 0))
    print(f"mask: effective f_sky = <W^2>^2 / <W^4> = {fraction:.3f}, 1 / sqrt(f_sky) = {fraction**-0.5:.2f}")
    for mode in MODES:
        both = [summaries[run].sel(pair="W1,W1", mode=mode) for run in ("full-scan", "full-scan-masked")]
        for kind, text in (
            ("biposh_circular", "mean field of the mask"),
            ("biposh_difference", "beam, mean field off"),
        ):
            mean = both[1][f"{kind}_binned_mean"].values.real
            error = both[1][f"{kind}_binned_standard_error"].values
            print(f"{mode} {text}: " + " ".join(f"{m:.1f}±{e:.1f}" for m, e in zip(mean, error, strict=True)))
        for kind, text in (("biposh", "a map"), ("biposh_difference", "a paired difference")):
            scatter = [one[f"{kind}_binned_standard_deviation"].values[1:] for one in both]
            print(
                f"{mode} scatter of {text}, uK^2, last bin: {scatter[0][-1]:.1f} without, {scatter[1][-1]:.1f} with "
                f"mask; ratio, rms over bins {np.sqrt(np.mean((scatter[1] / scatter[0]) ** 2)):.2f}"
            )


def main() -> None:
    """Read the stores, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("full-scan.png"))
    arguments = parser.parse_args()
    summaries = {run: mcsim.open_summary(arguments.folder / f"{run}.zarr").load() for run in RUNS}
    ell = summaries["full-scan"]["bin"].values
    figure = Figure(figsize=(10.5, 8.0), layout="constrained")
    top_left, top_right, bottom_left, bottom_right = figure.subplots(2, 2).ravel()
    lines = factors()
    draw_spectrum(top_left, summaries, "L2M0d0", lines)
    draw_spectrum(top_right, summaries, "L2M0d2", lines)
    draw_ratio(bottom_left, arguments.folder, ell, lines)
    draw_orientation(bottom_right, arguments.folder)
    figure.savefig(arguments.output, dpi=100)
    report(arguments.folder, ell)
    report_mask(summaries)


if __name__ == "__main__":
    main()
