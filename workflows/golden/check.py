"""Hold today's numbers against frozen ones to 1e-9: ensembles, and verdicts of all five kinds.

    python workflows/golden/check.py              compare; exit code 1 if anything differs
    python workflows/golden/check.py effect none  only the results whose names contain a word
    python workflows/golden/check.py --freeze     write the numbers anew: only where a change of them is meant
    python workflows/golden/check.py --fresh 10 effect mixture    name the effects of ten other data sets instead, with
                                                  the default number of simulations

Run it before and after a change that must not alter a result. It takes three minutes on two cores. It says of which
ensembles not even the bits are others: another kind of processor rounds otherwise.
"""

import argparse
import hashlib
import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mcsim
from mcsim.datavector.settings import DiagnosisSettings

HERE = Path(__file__).parent
TOLERANCE = 1e-9
SENTENCES = ("unit", "notes")
"""Keys of a verdict that hold words."""

BITS = "sha256"  #: key of what is told, but is no difference

ELLIPSE = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 300.0, "fwhm_minor_arcmin": 250.0, "angle_deg": 15.0}
ROUND = {"kind": "gaussian", "fwhm_arcmin": 300.0}
YEAR = {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 61.0}
PAIR = {"kind": "differencing", "model": "wmap_focal_plane", "pair": "W1", "sample_period_s": 157.8}
NOISE = {"sigma0_uk": 30.0}
HALVES = {"nside": 16, "splits": ["half1", "half2"]}
EVERY_EFFECT = [
    {"name": "beam_ellipticity", "channel": "W1", "amplitude": 0.2, "angle_deg": 10.0},
    {"name": "beam_coma", "channel": "W1", "amplitude": 0.05},
    {"name": "beam_sidelobe", "channel": "W1", "amplitude": 0.001},
    {"name": "beam_width", "channel": "W1", "amplitude": 0.05},
    {"name": "pointing_offset", "channel": "W1", "amplitude": 5.0},
    {"name": "time_constant", "channel": "W1", "amplitude": 0.01},
    {"name": "pixelization", "channel": "W1", "amplitude": 1.0},
    {"name": "gain_drift", "channel": "W1", "amplitude": 0.01},
    {"name": "noise_level", "channel": "W1", "amplitude": 0.1},
    {"name": "noise_anisotropy", "channel": "W1", "amplitude": 0.2},
    {"name": "dipole_residual", "channel": "W1", "amplitude": 3.0},
    {"name": "foreground_residual", "amplitude": 5.0},
    {"name": "point_sources", "amplitude": 0.1},
    {"name": "spectrum", "amplitude": 0.1},
    {"name": "dipole_modulation", "amplitude": 0.1},
    {"name": "quadrupole_modulation", "amplitude": 0.1},
    {"name": "boost", "amplitude": 0.001},
]


def channel(**changes: Any) -> dict[str, Any]:
    """A channel W1 with an elliptical beam under parallel transport; ``changes`` replace keys."""
    scan = {"kind": "parallel_transport", "psi0_deg": 20.0}
    return {"name": "W1", "frequency_ghz": 94.0, "beam": ELLIPSE, "scan": scan} | changes


def run(**changes: Any) -> dict[str, Any]:
    """A run of six realizations; ``changes`` replace whole sections."""
    base: dict[str, Any] = {
        "schema": 1,
        "name": "golden",
        "sky": {"spectrum": "wmap7", "lmax": 32},
        "map": {"nside": 16},
        "channel": [channel()],
        "biposh": {"L_max": 2, "summary_bin": 10},
        "ensemble": {"realizations": 6, "seed": 7},
        "compute": {"chunk": 4, "workers": 2},
    }
    return base | changes


ENSEMBLES: dict[str, dict[str, Any] | str] = {
    "parallel-transport": run(),
    "splits-and-noise": run(
        map=HALVES, channel=[channel(scan=YEAR, noise=NOISE), {"name": "V1", "beam": ROUND, "scan": YEAR}]
    ),
    "rings": run(map={"grid": "gl"}),
    "differencing": run(channel=[channel(scan=PAIR, noise=NOISE)]),
    "every-effect": run(
        sky={"spectrum": "wmap7", "lmax": 32, "dipole_uk": 3364.5},
        map=HALVES,
        channel=[channel(beam=ROUND, scan=YEAR | {"line_of_sight": "A"}, noise=NOISE)],
        effect=EVERY_EFFECT,
    ),
    "quickstart": "quickstart",
}

MODEL: dict[str, Any] = {
    "schema": 1,
    "name": "golden",
    "sky": {"spectrum": "wmap7", "lmax": 40, "dipole_uk": 3364.5},
    "map": HALVES,
    "biposh": {"L_max": 2},
    "channel": [
        {
            "name": name,
            "frequency_ghz": frequency_ghz,
            "beam": {"kind": "gaussian", "fwhm_arcmin": 350.0},
            "noise": NOISE,
            "scan": YEAR | {"line_of_sight": line},
        }
        for name, frequency_ghz, line in (("V1", 61.0, "A"), ("W1", 94.0, "B"))
    ],
}

FOUR = ("beam_ellipticity", "pointing_offset", "noise_level", "dipole_modulation")
# Effects in the data, seed of the data, effects that are proposed. The name is the kind of the verdict.
VERDICTS: dict[str, tuple[list[dict[str, Any]], int, tuple[str, ...]]] = {
    "none": ([], 80, FOUR),
    "effect": ([{"name": "beam_ellipticity", "channel": "W1", "amplitude": 0.25, "angle_deg": 20.0}], 77, FOUR),
    "mixture": (
        [
            {"name": "beam_ellipticity", "channel": "W1", "amplitude": 0.2},
            {"name": "noise_level", "channel": "V1", "amplitude": 0.1},
        ],
        83,
        FOUR,
    ),
    "degenerate": (
        [{"name": "time_constant", "channel": "W1", "amplitude": 0.01}],
        91,
        ("time_constant", "pointing_offset", "beam_ellipticity"),
    ),
    "unknown": (
        [{"name": "quadrupole_modulation", "amplitude": 0.35}],
        77,
        ("beam_ellipticity", "pointing_offset", "noise_level", "beam_width"),
    ),
    "stochastic": (
        [{"name": "point_sources", "amplitude": 0.6}],
        77,
        ("beam_ellipticity", "point_sources", "foreground_residual", "spectrum", "noise_level"),
    ),
}

DEFAULTS = {"default-none": "none", "default-mixture": "mixture"}
"""Verdicts of the same data with the default numbers of simulations, whose covariance is shrunk."""


def ensemble(name: str, folder: Path) -> dict[str, dict[str, Any]]:
    """Run an ensemble; return the fingerprint of every array of it and of its summary."""
    store = folder / f"{name}.zarr"
    mcsim.run(ENSEMBLES[name], store)
    return {
        prefix + variable: fingerprint(dataset[variable].values)
        for prefix, dataset in (("", mcsim.open_ensemble(store)), ("summary/", mcsim.open_summary(store)))
        for variable in sorted(map(str, dataset.data_vars))
    }


def fingerprint(values: NDArray[Any]) -> dict[str, Any]:
    """Return the hash of an array, its norm and its product with random numbers, those of its parts if it is complex.

    Two arrays of which all of these agree are the same, whatever their hashes are.
    """
    flat = np.ascontiguousarray(values).ravel()
    parts = np.nan_to_num(flat.view(np.float64) if np.iscomplexobj(flat) else flat.astype(np.float64))
    along = float(parts @ np.random.default_rng(0).standard_normal(parts.size))
    return {BITS: hashlib.sha256(flat.tobytes()).hexdigest(), "norm": float(np.linalg.norm(parts)), "along": along}


def verdict(name: str, folder: Path) -> dict[str, Any]:
    """Make data with effects in them, and diagnose them with as few simulations as when they were frozen."""
    return diagnosed(name, VERDICTS[name][1], folder, simulations=260, opposite_share=1.0, time_ordered_skies=6)


def by_default(name: str, folder: Path) -> dict[str, Any]:
    """Diagnose the data of a verdict with the default settings."""
    return diagnosed(DEFAULTS[name], VERDICTS[DEFAULTS[name]][1], folder)


def diagnosed(name: str, seed: int, folder: Path, **changes: Any) -> dict[str, Any]:
    """Diagnose data that have the effects of a verdict and a seed, with settings changed by name."""
    effects, _, proposed = VERDICTS[name]
    place = folder / f"{name}-{seed}-{len(changes)}"
    data = MODEL | {"ensemble": {"realizations": 1, "seed": seed, "keep_maps": True, "paired": False}}
    mcsim.run(data | ({"effect": effects} if effects else {}), place / "data.zarr")
    with mcsim.open_ensemble(place / "data.zarr") as opened:
        maps = list(opened[next(str(key) for key in opened.data_vars if "map" in str(key))].values[0])
    left_out = tuple(effect for effect in mcsim.effects() if effect not in proposed)
    mcsim.diagnose(MODEL, maps, place / "out", case=name, settings=DiagnosisSettings(without=left_out, **changes))
    found: dict[str, Any] = json.loads((place / "out" / "verdict.json").read_text())
    return found


def differences(old: Any, new: Any, where: str = "") -> Iterator[str]:
    """Say where two results differ: numbers by more than the tolerance, anything else at all; new keys are welcome."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in old:
            if key in SENTENCES or key == BITS:
                continue
            yield from differences(old[key], new[key], f"{where}.{key}") if key in new else [f"{where}.{key} is gone"]
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for index, (one, other) in enumerate(zip(old, new, strict=True)):
            yield from differences(one, other, f"{where}[{index}]")
    elif isinstance(old, float) and isinstance(new, int | float):
        if abs(old - new) > TOLERANCE * max(abs(old), abs(new)):
            yield f"{where}: {old!r} became {new!r}"
    elif old != new:
        yield f"{where}: {old!r} became {new!r}"


def fresh(name: str, folder: Path, number: int) -> None:
    """Diagnose other data with the effects of a verdict, and print what they are called."""
    truth = sorted((one["name"], one.get("channel")) for one in VERDICTS[name][0])
    right = 0
    for other in range(number):
        found = diagnosed(name, 2000 + other, folder)
        named = sorted((one["name"], one["channel"]) for one in found["effects"])
        single = found["verdict"] in ("effect", "mixture")
        right += single and named == truth
        print(f"{name} {other}: {found['verdict']} {named}", flush=True)
    print(f"{name}: {right} of {number} have the right name alone")


def main() -> int:
    """Compare or freeze."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", help="parts of names; default: everything")
    parser.add_argument("--freeze", action="store_true", help="write the numbers anew")
    parser.add_argument("--fresh", type=int, help="number of other data sets of each verdict")
    chosen = parser.parse_args()
    makers: dict[str, Callable[[str, Path], Any]] = {
        name: make
        for names, make in ((ENSEMBLES, ensemble), (VERDICTS, verdict), (DEFAULTS, by_default))
        for name in names
    }
    failed = 0
    with tempfile.TemporaryDirectory() as scratch:
        os.environ["MCSIM_CACHE"] = str(Path(scratch) / "cache")
        for name, make in makers.items():
            if chosen.words and not any(word in name for word in chosen.words):
                continue
            if chosen.fresh is not None:
                if name in VERDICTS and name in chosen.words:
                    fresh(name, Path(scratch), chosen.fresh)
                continue
            found, file = make(name, Path(scratch)), HERE / f"{name}.json"
            if chosen.freeze:
                file.write_text(json.dumps(found, indent=1) + "\n")
                print(f"{name}: frozen", flush=True)
                continue
            frozen = json.loads(file.read_text())
            changed = list(differences(frozen, found))
            failed += bool(changed)
            said = f"{len(changed)} differences" if changed else "the same"
            if not changed and name in ENSEMBLES:
                said += " bit for bit" if found == frozen else f" to {TOLERANCE:g}, with other bits"
            print(f"{name}: {said}", *changed[:8], sep="\n    ")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
