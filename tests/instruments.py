"""The small instrument of many tests of a diagnosis: two channels in two halves of a year."""

from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from typing import Any

from mcsim import config, systematics
from mcsim.datavector import campaign
from mcsim.datavector.analysis import Job, analysis_of, data_vectors
from mcsim.datavector.campaign import with_effects
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.context import DiagnosisContext, context
from mcsim.reconstruction import simulated_scores
from mcsim.simulation.survey import Survey, survey
from mcsim.support.arrays import Matrix

PROPOSED = ("beam_ellipticity", "pointing_offset", "noise_level", "dipole_modulation")


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


def ask(jobs: Iterable[Job]) -> list[Matrix]:
    """Simulate data vectors in this process."""
    return [data_vectors(job) for job in jobs]


def scored(jobs: Iterable[Job]) -> list[Matrix]:
    """Simulate scores in this process."""
    return [simulated_scores.scores(job) for job in jobs]


def learned(
    table: dict[str, Any], *more: str, simulations: int = 260, proposed: tuple[str, ...] = PROPOSED
) -> DiagnosisContext:
    """Return what is learned of a run, with ``proposed`` effects and ``more`` alone."""
    without = [name for name in systematics.catalogue() if name not in (*proposed, *more)]
    analysis = analysis_of(config.load(table), without=without, settings=DiagnosisSettings(beam_orders=2))
    return context(analysis, *campaign.learned(analysis, ask, simulations, time_ordered=False))


@lru_cache(maxsize=1)
def learned_small() -> DiagnosisContext:
    """Return what is learned of the small instrument, with PROPOSED effects alone."""
    return learned(two_channels("small"))
