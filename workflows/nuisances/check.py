"""Data in realistic company, with the company declared as nuisances and not: p-values, names, pulls.

    python workflows/nuisances/check.py [--draws 600] [--skies 120] [--strength 8] [--seed 2026]
        [--workers 2] [--knee 0.003] [--folder FOLDER] [-o FILE]

Two channels at nside 32 with two splits. The company is drawn anew for every data set: calibrations off by 0.3 %, beam
widths by 0.5 %, noise levels by 3 % (standard deviations), and a foreground of known morphology with 2 uK rms at 94 GHz
and a spectral index of -3.0 +- 0.3. First, data vectors without an effect: the p-value of the model that declares the
company must be uniform; that of the model that does not cannot be. Then full skies, half of them with one effect of an
expected S/N of ``strength`` against the model that declares; both models diagnose each. With ``--knee`` (in Hz)
the noise is 1/f, of slope -1 down to 10 uHz, destriped in baselines of an hour, and modelled as such. What is simulated
and judged is kept in ``--folder``: with the same one a run that was killed goes on.
"""

import argparse
import json
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import healpy
import numpy as np
from scipy import stats

import mcsim
from mcsim import config
from mcsim.datavector.analysis import analysis_of, data_vectors
from mcsim.datavector.campaign import PER_TASK, Ask, asking, batch, seeded, with_effects
from mcsim.datavector.kept import Kept
from mcsim.datavector.nuisances import Regression
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.api import prepared
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.simulation import nuisance, simulate
from mcsim.simulation.survey import survey
from mcsim.stats.look_elsewhere import global_test

NSIDE, LMAX = 32, 64
PROPOSED = (
    "beam_ellipticity",
    "beam_width",
    "calibration",
    "dipole_modulation",
    "gain_drift",
    "noise_anisotropy",
    "noise_level",
    "pointing_offset",
)
EFFECTS: tuple[tuple[str, str, dict[str, float]], ...] = (
    ("beam_ellipticity", "W1", {}),
    ("beam_ellipticity", "V1", {"angle_deg": 60.0}),
    ("pointing_offset", "W1", {"angle_deg": 30.0}),
    ("gain_drift", "V1", {"phase_deg": 40.0}),
    ("noise_anisotropy", "W1", {}),
)


def model(template: Path, knee: float | None) -> mcsim.RunConfig:
    """Return the model, company declared; the foreground's morphology is written to ``template``."""
    draw = np.random.default_rng(1)
    galactic = np.array(healpy.Rotator(coord=["E", "G"])(np.array(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2)))))
    patches = healpy.smoothing(draw.standard_normal(12 * NSIDE**2), fwhm=np.deg2rad(10.0))
    plane = (1.0 + 0.5 * patches / patches.std()) / (1.0 + (galactic[2] / 0.15) ** 2)
    healpy.write_map(template, plane, coord="E", dtype=np.float64, overwrite=True)
    noise: dict[str, Any] = {"sigma0_uk": 150.0}
    if knee is not None:
        noise |= {"kind": "correlated", "f_knee_hz": knee, "f_min_hz": 1e-5, "alpha": 1.0}
        noise |= {"map_making": "destriped", "baseline_s": 3600.0}
    channels = [
        {
            "name": name,
            "frequency_ghz": frequency,
            "beam": {"kind": "gaussian", "fwhm_arcmin": 180.0},
            "noise": noise,
            "scan": {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 30.0, "line_of_sight": line},
        }
        for name, frequency, line in (("V1", 61.0, "A"), ("W1", 94.0, "B"))
    ]
    company = [
        {"effect": effect, "channel": channel["name"], "width": width}
        for channel in channels
        for effect, width in (("calibration", 0.003), ("beam_width", 0.005), ("noise_level", 0.03))
    ]
    foreground = {
        "effect": "foreground_residual",
        "width": 2.0,
        "parameters": {"template": str(template), "spectral_index": -3.0},
        "parameter_widths": {"spectral_index": 0.3},
    }
    return mcsim.load_config(
        {
            "name": "company",
            "sky": {"spectrum": "wmap7", "lmax": LMAX, "dipole_uk": 3364.5},
            "map": {"nside": NSIDE, "splits": ["half1", "half2"]},
            "biposh": {"L_max": 2},
            "channel": channels,
            "nuisance": [*company, foreground],
        }
    )


def learned(run: mcsim.RunConfig, ask: Ask) -> DiagnosisContext:
    """Return what data of a model are tested with."""
    without = [name for name in mcsim.effects() if name not in PROPOSED]
    return prepared(run, analysis_of(run, without, settings=DiagnosisSettings(including=PROPOSED)), ask)


def pvalue(known: DiagnosisContext, x: np.ndarray) -> float:
    """Return the global p-value of a data vector."""
    return global_test(known.null, x, known.always, known.calibration).pvalue


def summary(pvalues: Sequence[float]) -> dict[str, Any]:
    """Return the distribution of p-values that should be uniform."""
    low, high = stats.binom.interval(0.95, len(pvalues), 0.05)
    alarms = int(np.sum(np.array(pvalues) <= 0.05))
    ks = float(stats.kstest(pvalues, "uniform").pvalue)
    return {"number": len(pvalues), "ks_p_value": ks, "at_5_percent": alarms, "interval": [int(low), int(high)]}


def compressed(known: dict[str, DiagnosisContext], ask: Ask, draws: int, seed: int) -> dict[str, Any]:
    """Test data vectors of the declared company without an effect; compare the nuisances with what was drawn."""
    declared = known["declared"]
    job = replace(declared.analysis.job(seeded(declared.run, seed)), nuisances=True)
    rows = np.concatenate(ask([replace(job, first=r, count=min(20, draws - r)) for r in range(0, draws, 20)]))
    rows = rows + declared.ensemble.offset  # data are sampled; both models know it
    own, regression = declared.analysis.nuisances, Regression.of(declared.ensemble, declared.null)
    true = np.stack([nuisance.draws(own, seed, r)[0] for r in range(draws)])
    prior = np.concatenate([one.mean for one in own])
    found = [regression.posterior(x, prior) for x in rows]
    mean, sigma = (np.stack([one[place] for one in found]) for place in (0, 1))
    pulls = (mean - true) / sigma
    return {
        **{name: summary([pvalue(one, x) for x in rows]) for name, one in known.items()},
        "posterior": {
            one.effect.label(one.channel): {
                "sigma_over_width": float(np.mean(sigma[:, k]) / one.widths[0]),
                "pull_mean": float(np.mean(pulls[:, k])),
                "pull_width": float(np.std(pulls[:, k])),
            }
            for k, one in enumerate(own)
        },
    }


def cases(
    known: DiagnosisContext, numbers: range, strength: float, seed: int
) -> Iterator[tuple[str, Any, float, list[Any]]]:
    """Yield truth (name of effect and channel, None: no effect), amplitude and maps."""
    for number in numbers:
        run = seeded(replace(known.run, nuisances=()), seed + number)
        acting = nuisance.tables(known.run, seed, number)
        truth, amplitude = None, 0.0
        if number % 2:
            name, channel, parameters = EFFECTS[number // 2 % len(EFFECTS)]
            one = next(c for c in known.candidates if c.identity == (name, channel))
            at = one.effect(amplitude=1.0, **parameters).parametrization.coordinates(
                one.effect(amplitude=1.0, **parameters)
            )
            amplitude = strength / known.null.expected_snr(known.templates[:, list(one.columns)] @ at)
            truth = (name, channel)
            acting = [
                config.Effect(name=name, channel=channel, parameters={"amplitude": amplitude, **parameters}),
                *acting,
            ]
        yield f"case-{number:03d}", truth, amplitude, list(simulate.maps(survey(with_effects(run, acting)), 0))


def score(outcomes: list[dict[str, Any]], company: set[tuple[str, str | None]]) -> dict[str, Any]:
    """Count verdicts: on skies with an effect, and on skies without."""
    found: dict[str, Any] = {}
    for what, chosen in (
        ("with an effect", [o for o in outcomes if o["truth"]]),
        ("without", [o for o in outcomes if not o["truth"]]),
    ):
        counts: Counter[str] = Counter()
        for one in chosen:
            truth = {tuple(one["truth"])} if one["truth"] else set()
            named = set(map(tuple, one["named"]))
            counts["gap"] += one["verdict"] != "none"
            counts["right set first"] += bool(truth) and named == truth
            counts["the effect among those named"] += bool(truth) and truth <= named
            counts["unknown"] += one["verdict"] == "unknown"
            counts["one of the company named"] += bool(named & company - truth)
            counts["a wrong name"] += bool(named - company - truth)
        found[what] = {"skies": len(chosen), **counts}
    pulls = [(o["amplitude"] - o["true"]) / o["sigma"] for o in outcomes if o["truth"] and o.get("sigma")]
    found["pull of the effect's amplitude"] = {
        "number": len(pulls),
        "mean": float(np.mean(pulls)) if pulls else None,
        "width": float(np.std(pulls)) if pulls else None,
    }
    shrinks = [(o["achieved"], o["predicted"]) for o in outcomes if o.get("achieved") is not None]
    if shrinks:
        found["median reduction on held-out data, achieved and predicted"] = np.median(shrinks, axis=0).tolist()
    return found


def main() -> None:
    """Print the results, and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=600)
    parser.add_argument("--skies", type=int, default=120)
    parser.add_argument("--strength", type=float, default=8.0)
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--knee", type=float, metavar="HZ")
    parser.add_argument("--folder", type=Path)
    parser.add_argument("-o", "--output", type=Path)
    chosen = parser.parse_args()
    folder = chosen.folder or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    done = folder / "cases.json"
    run = model(folder / "template.fits", chosen.knee)
    kept = Kept.of(folder / "simulations", NSIDE, PER_TASK)
    company = {(one.effect, one.channel) for one in run.nuisances}
    with batch(chosen.workers) as call, asking(call, False, data_vectors, "simulations", kept) as ask:
        known = {"declared": learned(run, ask), "not declared": learned(replace(run, nuisances=()), ask)}
        result: dict[str, Any] = {
            "simulations": {name: len(one.ensemble.simulations) for name, one in known.items()},
            "elements": {name: one.null.dimension for name, one in known.items()},
            "compressed": compressed(known, ask, chosen.draws, chosen.seed),
        }
        print(json.dumps(result, indent=1), flush=True)
        outcomes: dict[str, list[dict[str, Any]]] = {name: [] for name in known}
        if done.exists():
            outcomes = json.loads(done.read_text())
        numbers = range(len(outcomes["declared"]), chosen.skies)
        for case, truth, amplitude, maps in cases(known["declared"], numbers, chosen.strength, chosen.seed + 10**6):
            for name, context in known.items():
                found = diagnose_data(ObservedMaps(context, maps, ask), case)
                one = {
                    "case": case,
                    "truth": truth,
                    "true": amplitude,
                    "verdict": found.kind,
                    "p_value": found.test.pvalue,
                    "named": [(effect.name, effect.channel) for effect in found.effects],
                }
                for effect in found.effects:
                    if (effect.name, effect.channel) == truth:
                        one |= {"amplitude": effect.amplitude, "sigma": effect.sigma}
                if found.held_out is not None and truth:
                    one |= {"achieved": found.held_out.achieved.value, "predicted": found.held_out.predicted.value}
                outcomes[name].append(one)
            done.write_text(json.dumps(outcomes))
            print(case, truth, {name: (o[-1]["verdict"], o[-1]["named"]) for name, o in outcomes.items()}, flush=True)
    result["full skies"] = {name: score(rows, company) for name, rows in outcomes.items()}
    print(json.dumps(result["full skies"], indent=1))
    if chosen.output is not None:
        chosen.output.write_text(json.dumps({**result, "cases": outcomes}, indent=1) + "\n")


if __name__ == "__main__":
    main()
