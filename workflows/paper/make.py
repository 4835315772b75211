"""Make the figures of arXiv:1210.7318 again, and print the numbers that the README of this folder quotes.

    python workflows/paper/make.py [--ensembles FOLDER] [-o FOLDER]

Figures of measured beams need MCSIM_DATA (see ../wmap7/parallel-transport.toml); figures of ensembles need, in FOLDER,
the stores that ``mcsim run`` makes of ../predictions/elliptical.toml, ../wmap7/parallel-transport.toml and
../wmap7/hit-averaged.toml. What is missing is left out, with a line that says why.
"""

import argparse
import io
import os
from collections.abc import Callable
from pathlib import Path

import beam_figures
import biposh_figures
import numpy as np
import scan_figures
from matplotlib.figure import Figure
from PIL import Image

import mcsim
from mcsim import beamfit, config
from mcsim.ensemble import prediction
from mcsim.ensemble.expectation import survey_of
from mcsim.instrument import beams, scan

WORKFLOWS = Path(__file__).resolve().parent.parent
ELLIPTICAL = "predictions/elliptical.toml"
TRANSPORTED = "wmap7/parallel-transport.toml"
SCANNED = "wmap7/hit-averaged.toml"
ELL_RANGE = (50, 449)
"""Where leading order holds within the errors of 100 skies, and about where WMAP-7 has signal."""

MAX_BYTES = 149_000


class MissingError(Exception):
    """What a figure lacks, in words."""


def raw_maps() -> dict[str, beams.BeamMap]:
    """Beam maps V2 and W1, side A."""
    if "MCSIM_DATA" not in os.environ:
        raise MissingError(
            "set MCSIM_DATA to the folder of the WMAP-7 beam maps (wmap7/parallel-transport.toml describes it)"
        )
    folder = Path(os.environ["MCSIM_DATA"]) / "wmap7_beams"
    return {name: beams.read_map(folder / f"wmap_hybrid_beam_{name}_A_7yr_v4.fits.gz") for name in ("V2", "W1")}


def store_of(toml: str, folder: Path | None) -> Path:
    """The ensemble of a configuration."""
    name = {ELLIPTICAL: "elliptical", TRANSPORTED: "wmap7-parallel-transport", SCANNED: "wmap7-hit-averaged"}[toml]
    if folder is None or not (folder / f"{name}.zarr").exists():
        raise MissingError(f"make {name}.zarr with `mcsim run workflows/{toml}` and name its folder with --ensembles")
    if "${MCSIM_DATA}" in (WORKFLOWS / toml).read_text() and "MCSIM_DATA" not in os.environ:
        raise MissingError(f"set MCSIM_DATA to the folder that workflows/{toml} describes")
    return folder / f"{name}.zarr"


def against(toml: str, folder: Path | None, channels: dict[str, str]) -> Figure:
    """An ensemble with its predictions."""
    store = store_of(toml, folder)
    run = config.load(WORKFLOWS / toml)
    summary = mcsim.open_summary(store).load()
    exact, leading = (prediction.predict(run, exact=exact, nthreads=2) for exact in (True, False))
    print("\n".join(biposh_figures.agreement(summary, exact, leading, list(channels))))
    return biposh_figures.against_simulations(summary, exact, leading, channels)


def effective(folder: Path | None) -> Figure:
    """Effective beams of the hit average in terms of the beams under parallel transport."""
    store = store_of(SCANNED, folder)
    survey = survey_of(WORKFLOWS / TRANSPORTED)
    measured = {
        channel: beamfit.measurement(
            store, survey, beamfit.Selection(ell_range=ELL_RANGE, kind="plain", pair=f"{channel},{channel}")
        )
        for channel in ("V2", "W1")
    }
    fits = {
        channel: [beamfit.fit(measured[channel], survey, name) for name in ("constant", "linear")]
        for channel in ("V2", "W1")
    }
    for channel, models in fits.items():
        for one in models:
            values = zip(one.model.parameters, one.solution.parameters, one.solution.errors, strict=True)
            text = ", ".join(f"{name} = {value:.6f} +- {error:.6f}" for name, value, error in values)
            print(f"  {channel} {one.model.name}: {text}; probability {one.solution.probability:.3f}")
    model = scan_figures.moments()[0]
    return biposh_figures.effective_beams(fits, scan.limit_factors(model, [2]).quadrupole_ratio)


def raw_blm() -> Figure:
    """Coefficients of the raw beams, with |b_l2| / b_l0 printed."""
    maps = raw_maps()
    for name, beam_map in maps.items():
        blm = beams.Beam.from_map(beam_map, beam_figures.LMAX, 2).blm
        ratio = np.abs(blm[2]) / np.abs(blm[0])
        zero = np.flatnonzero(np.diff(np.sign(blm[2].real[20:]))) + 20
        at = ", ".join(f"{ratio[ell]:.4f} at l = {ell}" for ell in (100, 200, 500, 800))
        print(f"  {name}: |b_l2|/b_l0 = {at}; Re b_l2 changes sign after l = {', '.join(map(str, zero)) or 'none'}")
    return beam_figures.raw_blm(maps, scan.limit_factors(scan_figures.moments()[0], [2]).quadrupole_ratio)


def figures(folder: Path | None) -> dict[str, Callable[[], Figure]]:
    """Name of a picture -> what draws it, in the order of the paper."""
    ellipses = {
        name: f"{name}: elliptical Gaussian {fwhm:g}′, e = {e:g}, parallel transport"
        for name, (fwhm, e) in beam_figures.ELLIPSES.items()
    }
    raw = {name: f"{name}, side A: raw beam map, parallel transport" for name in ("V2", "W1")}
    return {
        "scan": lambda: scan_figures.scan_maps(*scan_figures.moments()),
        "elliptical-blm": beam_figures.elliptical_blm,
        "elliptical-a20": lambda: against(ELLIPTICAL, folder, ellipses),
        "factors": lambda: scan_figures.factors(*scan_figures.moments()),
        "raw-blm": raw_blm,
        "beam-maps": lambda: beam_figures.beam_maps(raw_maps()),
        "raw-a20": lambda: against(TRANSPORTED, folder, raw),
        "effective-beams": lambda: effective(folder),
    }


def save(figure: Figure, path: Path) -> None:
    """Write a small PNG: 128 colours where all of them would take more than MAX_BYTES."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=72)
    if len(buffer.getvalue()) <= MAX_BYTES:
        path.write_bytes(buffer.getvalue())
        return
    picture = Image.open(buffer).convert("RGB")
    picture.quantize(128, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(path, optimize=True)


def main() -> None:
    """Make every figure that can be made."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ensembles", type=Path, metavar="FOLDER", help="folder of the stores")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="figures to make (default: all)")
    parser.add_argument("-o", "--output", type=Path, default=Path(), metavar="FOLDER", help="folder of the pictures")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    for name, draw in figures(arguments.ensembles).items():
        if arguments.only and name not in arguments.only:
            continue
        try:
            figure = draw()
        except MissingError as missing:
            print(f"paper-{name}.png left out: {missing}.", flush=True)
            continue
        save(figure, arguments.output / f"paper-{name}.png")
        print(f"paper-{name}.png", flush=True)


if __name__ == "__main__":
    main()
