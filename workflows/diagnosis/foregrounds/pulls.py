"""Foregrounds whose patterns are drawn: what they are called, and the pulls of amplitude and index.

    python workflows/diagnosis/foregrounds/pulls.py [--amplitude 3] [--index 0.4] [--skies 60] [--workers 2] [-o FILE]

Three channels of a small survey (nside 8), V1 and W1 with a residual foreground and a map without (``foregrounds =
false``). Every sky, noise and pattern is drawn anew; the p-value of what the foreground leaves must be uniform.
"""

import argparse
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

import mcsim
from mcsim import config
from mcsim.datavector.analysis import analysis_of, data_vectors
from mcsim.datavector.campaign import asking, batch, with_effects
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.api import kept, prepared
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey

NAME = "foreground_residual"
PROPOSED = (NAME, "noise_level", "dipole_residual", "calibration")
SEED = 77


def model() -> mcsim.RunConfig:
    """Return the model."""
    channels: list[dict[str, Any]] = [
        {
            "name": name,
            "frequency_ghz": frequency,
            "foregrounds": name != "CMB",
            "beam": {"kind": "gaussian", "fwhm_arcmin": 700.0},
            "noise": {"sigma0_uk": 30.0},
            "scan": {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 61.0, "line_of_sight": line},
        }
        for name, frequency, line in (("V1", 61.0, "A"), ("W1", 94.0, "B"), ("CMB", 143.0, "A"))
    ]
    return mcsim.load_config(
        {
            "name": "foregrounds",
            "sky": {"spectrum": "wmap7", "lmax": 20, "dipole_uk": 3364.5},
            "map": {"nside": 8, "frame": "galactic"},
            "biposh": {"L_max": 2},
            "channel": channels,
        }
    )


def main() -> None:
    """Print the names and the pulls, and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--amplitude", type=float, default=3.0)
    parser.add_argument("--index", type=float, default=0.4)
    parser.add_argument("--skies", type=int, default=60)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("-o", "--output", type=Path)
    chosen = parser.parse_args()
    run = model()
    without = [name for name in mcsim.effects() if name not in PROPOSED]
    analysis = analysis_of(run, without, settings=DiagnosisSettings(including=PROPOSED))
    there = config.Effect(name=NAME, parameters={"amplitude": chosen.amplitude, "spectral_index": chosen.index})
    data = survey(with_effects(replace(run, ensemble=replace(run.ensemble, seed=SEED)), [there]))
    rows: list[dict[str, Any]] = []
    with (
        batch(chosen.workers) as call,
        asking(call, False, data_vectors, "simulations", kept(run, analysis)) as ask,
    ):
        known = prepared(run, analysis, ask)
        for number in range(chosen.skies):
            found = diagnose_data(ObservedMaps(known, list(simulate.maps(data, number)), ask), str(number))
            row: dict[str, Any] = {"verdict": found.kind, "named": [one.name for one in found.effects]}
            if row["named"] == [NAME]:
                (own,) = found.verdict["effects"]
                index, error = own["parameters"]["spectral_index"], own["errors"]["spectral_index"]
                row |= {
                    "amplitude": [own["amplitude"], own["sigma"], (own["amplitude"] - chosen.amplitude) / own["sigma"]],
                    "index": [index, error, (index - chosen.index) / error],
                    "left": found.sets[0].pvalue,
                }
            rows.append(row)
            print(number, row, flush=True)
    result: dict[str, Any] = {
        "simulations": len(known.ensemble.simulations),
        "elements": known.null.dimension,
        "verdicts": dict(Counter(f"{row['verdict']}: {' + '.join(row['named'])}" for row in rows)),
    }
    named = [row for row in rows if "left" in row]
    for what in ("amplitude", "index"):
        pulls = np.array([row[what][2] for row in named])
        result[f"pulls of the {what}: number, mean, rms"] = [len(pulls), pulls.mean(), np.sqrt(np.mean(pulls**2))]
    left = [row["left"] for row in named]
    result["what is left: KS p, mean p"] = [float(stats.kstest(left, "uniform").pvalue), float(np.mean(left))]
    print(json.dumps(result, indent=1))
    if chosen.output is not None:
        chosen.output.write_text(json.dumps({**result, "skies": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
