"""Maps of differencing scans: are p-values uniform where nothing is wrong, and effects named where they are put in?

    python workflows/diagnosis/differencing/check.py [--nside 64] [--skies 200] [--cases 4] [--controls N] [--nuisances]
        [--first NUMBER] [--effects NAME ...] [--strong] [--parts FOLDER] [-o FILE]

With ``--parts`` every result of a simulation is kept, and a run that was stopped goes on where it was.

Two channels, V1 and W1 of WMAP's focal plane, each the difference of its two sides, in two halves of a year. Data are
the maps that ``mcsim run`` keeps, every difference of the survey by itself, with another seed than any simulation of
the model. Effects are put into W1, with the amplitudes of an expected S/N of 6 and 10, or with six and four iterations
of the map-making; and an ellipse into the beam of its side B alone. With ``--controls`` as many perfect data sets are
diagnosed as ``mcsim diagnose --controls`` does; with ``--nuisances`` beam width, noise level and imbalance of each
channel are known to 0.5 %, 3 % and 0.001 alone, and drawn for every control.
"""

import argparse
import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy import stats

import mcsim
from mcsim import config
from mcsim.datavector.analysis import Analysis, Job, analysis_of, data_vectors
from mcsim.datavector.campaign import asking, batch, with_effects
from mcsim.diagnosis import controls
from mcsim.diagnosis.api import prepared
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.stats.look_elsewhere import global_test
from mcsim.support.code import package_digest

PROPOSED = (
    "beam_ellipticity",
    "beam_width",
    "dipole_modulation",
    "dipole_residual",
    "mapmaking_convergence",
    "noise_level",
    "pointing_offset",
    "transmission_imbalance",
)
PUT_IN = ("beam_ellipticity", "transmission_imbalance", "mapmaking_convergence")
ONE_SIDE = "an ellipse as the beam of side B"
SNR = (6.0, 10.0)
KNOWN_TO = {"beam_width": 0.005, "noise_level": 0.03, "transmission_imbalance": 0.001}
SEED = 20261122


def model(nside: int, nuisances: bool = False) -> mcsim.RunConfig:
    """Return a model of V1 and W1, S/N per pixel about that of some years of WMAP, at l up to 2 nside."""
    widths = KNOWN_TO if nuisances else {}
    channels = [
        {
            "name": name,
            "frequency_ghz": frequency,
            "beam": {"kind": "gaussian", "fwhm_arcmin": 5600.0 / nside},
            "noise": {"sigma0_uk": 120.0},
            "scan": {
                "kind": "differencing",
                "model": "wmap_focal_plane",
                "pair": name,
                "sample_period_s": 30.7 if nside > 32 else 157.8,
                "tolerance": 1e-6,
            },
        }
        for name, frequency in (("V1", 61.0), ("W1", 94.0))
    ]
    return mcsim.load_config(
        {
            "name": f"differencing-{nside}",
            "sky": {"spectrum": "wmap7", "lmax": 2 * nside, "dipole_uk": 3364.5},
            "map": {"nside": nside, "splits": ["half1", "half2"]},
            "channel": channels,
            "nuisance": [
                {"effect": effect, "channel": channel["name"], "width": width}
                for channel in channels
                for effect, width in widths.items()
            ],
            "biposh": {"L_max": 2},
            "ensemble": {"keep_maps": True, "paired": False, "seed": SEED},
        }
    )


def kept(folder: Path | None, text: str, make: Callable[[], np.ndarray]) -> np.ndarray:
    """Return an array from a folder, where it is made and kept if it is not there; None: make it."""
    if folder is None:
        return make()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{hashlib.sha256((package_digest(['mcsim']) + text).encode()).hexdigest()[:32]}.npy"
    if not path.exists():
        found = make()
        with path.with_suffix(".part").open("wb") as file:
            np.save(file, found)
        path.with_suffix(".part").rename(path)
    return np.load(path)


class Kept:
    """Data vectors of jobs, kept in a folder."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder

    def __call__(self, job: Job) -> np.ndarray:
        values = {one.name: getattr(job, one.name) for one in fields(job) if one.name != "library"}
        del values["settings"]  # on which no data vector of this script depends
        values["observed"] = None if job.observed is None else hashlib.sha256(job.observed.tobytes()).hexdigest()
        text = repr([values, [name for name, _ in job.library]])
        return kept(self.folder, text, lambda: data_vectors(job))


def data(run: mcsim.RunConfig, realization: int) -> list[np.ndarray]:
    """Return the maps that ``mcsim run`` keeps."""
    return list(simulate.realize(survey(run), realization)["observed_map"])


def amplitudes(context: DiagnosisContext, name: str) -> list[tuple[float, float | None]]:
    """Return amplitudes with their expected S/N; None of a map-making that stops early, which depends on the sky.

    Of that they are two and four iterations more than where its response is measured: six and four are done.
    """
    candidate = next(one for one in context.candidates if one.identity == (name, "W1"))
    if candidate.step is not None:
        return [(candidate.step + 2.0, None), (candidate.step + 4.0, None)]
    per_unit = context.null.expected_snr(context.templates[:, candidate.columns[0]])
    return [(float(target / per_unit), target) for target in SNR]


def nulls(run: mcsim.RunConfig, analysis: Analysis, context: DiagnosisContext, count: int, parts: Path | None) -> dict:
    """Return the p-values of skies without effects."""
    groups = context.null.whiten_groups(context.templates, [one.columns for one in context.candidates])
    pvalues, omnibus = [], []
    for realization in range(count):
        text = f"{run} {realization} {[element.name for element in analysis.elements]}"
        x = kept(parts, text, lambda r=realization: analysis.data_vector(data(run, r)))
        pvalues.append(float(global_test(context.null, x, groups, context.calibration).pvalue))
        omnibus.append(float(context.null.pvalue(x)))
    alarms = int(np.sum(np.array(pvalues) <= 0.05))
    low, high = stats.binomtest(alarms, count).proportion_ci(method="exact")
    return {
        "skies": count,
        "ks_p_value": float(stats.kstest(pvalues, "uniform").pvalue),
        "ks_p_value_of_chi2": float(stats.kstest(omnibus, "uniform").pvalue),
        "false_alarms_at_5_percent": alarms,
        "rate_interval_95": [float(low), float(high)],
        "smallest": min(pvalues),
        "p_values": pvalues,
    }


def pulls(
    run: mcsim.RunConfig, analysis: Analysis, context: DiagnosisContext, count: int, parts: Path | None
) -> dict[str, dict[str, float]]:
    """Return mean and width of the pulls of the first coordinate of effects, fitted alone with linear templates."""
    found = {}
    for place, name in enumerate(("beam_ellipticity", "transmission_imbalance")):
        candidate = next(one for one in context.candidates if one.identity == (name, "W1"))
        amplitude, values = amplitudes(context, name)[0][0] / 3.0, []  # of S/N 2, where the responses are linear
        for number in range(count):
            with_effect = acting(run, name, amplitude)
            text = f"{with_effect} {100_000 * (1 + place) + number} {[element.name for element in analysis.elements]}"
            x = kept(
                parts, text, lambda r=with_effect, n=100_000 * (1 + place) + number: analysis.data_vector(data(r, n))
            )
            fit = context.null.fit(x, context.templates[:, list(candidate.columns)])
            values.append((fit.amplitudes[0] - amplitude) / fit.errors[0])
        found[name] = {
            "skies": count,
            "amplitude": amplitude,
            "mean": float(np.mean(values)),
            "mean_error": float(1.0 / np.sqrt(count)),
            "width": float(np.std(values, ddof=1)),
            "width_error": float(1.0 / np.sqrt(2.0 * (count - 1))),
        }
    return found


def main() -> None:
    """Print and write what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nside", type=int, default=64)
    parser.add_argument("--skies", type=int, default=200)
    parser.add_argument("--pulls", type=int, default=100, help="skies with each effect whose amplitude is fitted alone")
    parser.add_argument("--cases", type=int, default=4, help="skies of each effect and S/N")
    parser.add_argument("--first", type=int, default=0, help="number of the first of these skies")
    parser.add_argument("--effects", nargs="+", choices=(*PUT_IN, ONE_SIDE), default=(*PUT_IN, ONE_SIDE))
    parser.add_argument("--strong", action="store_true", help="the larger amplitude of each alone")
    parser.add_argument("--controls", type=int, default=0, help="perfect data sets that are diagnosed")
    parser.add_argument("--nuisances", action="store_true", help="declare what is known of each channel")
    parser.add_argument("--simulations", type=int, help="of the model; default: ten for each element")
    parser.add_argument("--responses", type=int, help="skies of common and of noisy responses; default: as a diagnosis")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--parts", type=Path, help="folder for results of simulations, with which a run goes on")
    parser.add_argument("-o", "--output", type=Path)
    chosen = parser.parse_args()
    run = model(chosen.nside, chosen.nuisances)
    library = {name: kind for name, kind in mcsim.effects().items() if name in PROPOSED}
    fewer = {} if chosen.responses is None else {"noisy_skies": chosen.responses, "common_skies": chosen.responses}
    settings = mcsim.DiagnosisSettings(simulations=chosen.simulations, **fewer)
    analysis = analysis_of(run, settings=settings, library=library)
    result: dict = {"nside": chosen.nside, "elements": len(analysis.elements)}

    def write() -> None:
        if chosen.output is not None:
            chosen.output.write_text(json.dumps(result, indent=1) + "\n")

    with batch(chosen.workers) as call:
        with asking(call, True, Kept(chosen.parts), "simulations of the model") as ask:
            context = prepared(run, analysis, ask)
            result["simulations"] = len(context.ensemble.simulations)
        result["expected_snr_per_unit_coordinate"] = {
            one.label: float(context.null.expected_snr(context.templates[:, one.columns[0]]))
            for one in context.candidates
        }
        if chosen.skies:
            result["null"] = nulls(run, analysis, context, chosen.skies, chosen.parts)
        print({k: v for k, v in result.get("null", {}).items() if k != "p_values"}, flush=True)
        write()
        if chosen.controls:
            key = f"{package_digest(['mcsim'])} {run} {settings.simulations}"
            drawn = controls.diagnose_controls(context, key, chosen.controls, call)
            result["controls"] = drawn.to_json()
            print(drawn.counted, "; drawn with", drawn.drawn, flush=True)
            write()
        if chosen.pulls:
            result["pulls"] = pulls(run, analysis, context, chosen.pulls, chosen.parts)
            print(result["pulls"], flush=True)
            write()
        result["cases"] = []
        with asking(call, True, Kept(chosen.parts), "simulations of fitted effects") as ask:
            for amplitude, target, name, number in cases(context, chosen):
                maps = data(acting(run, name, amplitude), number)
                found = diagnose_data(ObservedMaps(context, maps, ask), name)
                result["cases"].append(described(found, name, amplitude, target))
                print(result["cases"][-1], flush=True)
                write()


def cases(context: DiagnosisContext, chosen: argparse.Namespace) -> Iterator[tuple[float, float | None, str, int]]:
    """Yield amplitude, expected S/N, what is put in, and realization."""
    numbers = range(chosen.first, chosen.first + chosen.cases)
    for number, high in product(numbers, (1,) if chosen.strong else (1, 0)):
        for place, name in enumerate((*PUT_IN, ONE_SIDE)):
            amplitude, target = amplitudes(context, "beam_ellipticity" if name == ONE_SIDE else name)[high]
            if name in chosen.effects and (high or name != ONE_SIDE):  # of one side half is seen
                yield amplitude, target, name, 10_000 * (1 + place) + 1000 * high + number


def acting(run: mcsim.RunConfig, name: str, amplitude: float) -> mcsim.RunConfig:
    """Return the run with an effect in W1, or with an ellipse as the beam of its side B alone."""
    if name != ONE_SIDE:
        return with_effects(run, [config.Effect(name=name, channel="W1", parameters={"amplitude": amplitude})])
    v1, w1 = run.channels
    fwhm, stretch = w1.beam.fwhm_arcmin, np.sqrt(1.0 + amplitude)
    ellipse = config.BeamEllipticalGaussian(fwhm_major_arcmin=fwhm * stretch, fwhm_minor_arcmin=fwhm / stretch)
    return replace(run, channels=(v1, replace(w1, beam_b=ellipse)))


def described(found: DiagnosisResult, name: str, amplitude: float, target: float | None) -> dict:
    """Return a case and what was found in it."""
    return {
        "effect": name,
        "amplitude": amplitude,
        "snr": target,
        "p_value": float(found.test.pvalue),
        "verdict": found.kind,
        "found": [
            {"name": one.name, "channel": one.channel, "amplitude": one.amplitude, "sigma": one.sigma}
            for one in (found.sets[0].effects if found.sets else ())
        ],
        "sets": [[f"{one.name} {one.channel}" for one in found_set.effects] for found_set in found.sets],
        "held_out": None if found.held_out is None else float(found.held_out.achieved.value),
        "notes": list(found.notes),
    }


if __name__ == "__main__":
    main()
