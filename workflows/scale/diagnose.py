"""A diagnosis of six channels and two halves to its end: what it takes and what it finds.

    python workflows/scale/diagnose.py FOLDER [--nside 512] [--period 0.0512] [--channels 6] [--width 0.95]
        [--default | --quick] [--workers 2] [--simulations-only 4]

The model is ``six-channels.toml`` beside this file; at another nside its beams are as wide in pixels, and it has the
same noise in a solid angle. The data are one realization of another seed in which the beam of the last channel, W3, is
narrower (``--width`` times that of the model), made by the default route. The widths of all beams are the candidates,
bins are few and wide, and the covariance is that of some 240 simulations. With ``--default`` it is a diagnosis as
``mcsim diagnose`` makes it: all effects, bins and simulations; with ``--quick`` the same as there. With
``--simulations-only`` so many simulations are timed, with this data vector and with that of a default diagnosis of the
same candidates. A run that was killed goes on with the same cache.
"""

import argparse
import json
import resource
import time
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import healpy
import numpy as np

import mcsim
from mcsim import config
from mcsim.datavector.analysis import analysis_of
from mcsim.diagnosis.api import diagnose
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey

FEW: dict[str, Any] = {
    "simulations": 240,
    "channel_skies": 2,
    "typical_skies": 2,
    "common_skies": 2,
    "noisy_skies": 4,
    "constrained_skies": 2,
    "scatter_skies": 4,
    "response_modes": 1,
    "time_ordered_skies": 0,
    "scan_sims": 40,
}
COARSE: dict[str, Any] = {
    "sky_bins": 4,
    "beam_bins": (2, 1),
    "beam_orders": 1,
    "split_beam_orders": 0,
    "latitude_edges": (0.0, 0.6, 1.0),
    "scan_L_max": 2,
    "scan_bins": 2,
}
CANDIDATES = ("beam_width",)


def model(nside: int, period: float, channels: int) -> config.RunConfig:
    """Return the model at another resolution, or with its first channels alone."""
    found = tomllib.loads((Path(__file__).parent / "six-channels.toml").read_text())
    found["map"]["nside"], found["sky"]["lmax"] = nside, 2 * nside
    found["channel"] = found["channel"][-channels:]
    for channel in found["channel"]:
        channel["scan"]["sample_period_s"] = period
        channel["noise"]["sigma0_uk"] *= (0.0512 / period) ** 0.5
        for axis in ("fwhm_major_arcmin", "fwhm_minor_arcmin"):
            channel["beam"][axis] *= 512 / nside
    return mcsim.load_config(found)


def data(run: config.RunConfig, width: float, folder: Path) -> None:
    """Write the maps of one realization in which W3 has another beam."""
    if (folder / "W3_half2.fits").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    effect = config.Effect(name="beam_width", channel="W3", parameters={"amplitude": width - 1.0})
    true = replace(run, ensemble=replace(run.ensemble, seed=77), effects=(effect,))
    own = survey(true)
    for one, map_uk in zip(own.maps, simulate.maps(own, 0), strict=True):
        path = folder / f"{one.name.replace(':', '_')}.fits"
        healpy.write_map(path, map_uk, coord="E", column_units="uK", dtype=np.float64, overwrite=True)


def main() -> None:
    """Make the data and diagnose them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--nside", type=int, default=512)
    parser.add_argument("--period", type=float, default=0.0512, help="seconds")
    parser.add_argument("--channels", type=int, default=6)
    parser.add_argument("--width", type=float, default=0.95)
    parser.add_argument("--default", action="store_true")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--simulations-only", type=int, default=0)
    arguments = parser.parse_args()
    run = model(arguments.nside, arguments.period, arguments.channels)
    library = {name: kind for name, kind in mcsim.effects().items() if name in CANDIDATES}
    settings = mcsim.DiagnosisSettings(library=library, **FEW, **COARSE)
    if arguments.simulations_only:
        for setting in (settings, replace(settings, **{k: getattr(mcsim.DiagnosisSettings(), k) for k in COARSE})):
            analysis = analysis_of(run, settings=setting)
            each = []
            for realization in range(arguments.simulations_only):
                start = time.process_time()
                maps = list(simulate.maps(analysis.model.survey, realization))
                middle = time.process_time()
                analysis.data_vector(maps, slices=True)
                each.append((middle - start, time.process_time() - middle))
            print(json.dumps({"elements": len(analysis.elements), "maps_s, data_vector_s": np.min(each, 0).tolist()}))
        return
    started = time.monotonic()
    data(run, arguments.width, arguments.folder / "data")
    made = time.process_time()
    if arguments.default or arguments.quick:
        settings = mcsim.DiagnosisSettings.quick() if arguments.quick else mcsim.DiagnosisSettings()
    where, workers = (arguments.folder / name for name in ("data", "out")), arguments.workers
    result = diagnose(run, *where, settings=settings, quiet=False, workers=workers)
    used = resource.getrusage(resource.RUSAGE_SELF)
    sets = [[str(effect) for effect in one.effects] for one in result.sets]
    print(json.dumps({"verdict": result.kind, "p_value": result.test.pvalue, "sets": sets}))
    print(json.dumps({"wall_s": time.monotonic() - started, "simulations": result.simulations}))
    if not workers:  # what workers take is theirs
        print(
            json.dumps({"data_s": made, "processor_s": used.ru_utime + used.ru_stime, "peak_gb": used.ru_maxrss / 1e6})
        )


if __name__ == "__main__":
    main()
