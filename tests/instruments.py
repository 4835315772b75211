"""The small instrument of many tests of a diagnosis: two channels in two halves of a year."""

from dataclasses import replace
from typing import Any

from mcsim import config
from mcsim.datavector.campaign import with_effects
from mcsim.simulation.survey import Survey, survey


def two_channels(
    name: str,
    *,
    lmax: int = 40,
    nside: int = 16,
    fwhm_arcmin: float = 350.0,
    sigma0_uk: float = 30.0,
    period_s: float = 61.0,
) -> dict[str, Any]:
    """Return the table of a run: V1 and W1 on either side of WMAP, with the dipole and white noise."""
    scan = {"kind": "hit_averaged", "model": "wmap", "sample_period_s": period_s}
    return {
        "schema": 1,
        "name": name,
        "sky": {"spectrum": "wmap7", "lmax": lmax, "dipole_uk": 3364.5},
        "map": {"nside": nside, "splits": ["half1", "half2"]},
        "biposh": {"L_max": 2},
        "channel": [
            {
                "name": channel,
                "frequency_ghz": frequency,
                "beam": {"kind": "gaussian", "fwhm_arcmin": fwhm_arcmin},
                "noise": {"sigma0_uk": sigma0_uk},
                "scan": {**scan, "line_of_sight": line},
            }
            for channel, frequency, line in (("V1", 61.0, "A"), ("W1", 94.0, "B"))
        ],
    }


def data_of(
    run: config.RunConfig, name: str | None = None, channel: str | None = None, seed: int = 77, **parameters: float
) -> Survey:
    """Return the survey of data of a run with another seed, and with an effect that the run lacks."""
    found = () if name is None else (config.Effect(name=name, channel=channel, parameters=parameters),)
    return survey(with_effects(replace(run, ensemble=replace(run.ensemble, seed=seed)), found))
