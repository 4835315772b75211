"""Draw data from a model at higher fidelity than it simulates with.

They hold what the fast route of a model leaves out: sky power above ``sky.lmax``, structure within the pixels that are
made, directions of the samples within a pixel.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from mcsim import config
from mcsim.config.noise import AnyNoise
from mcsim.datavector.analysis import Analysis, Kinds, check_files
from mcsim.datavector.campaign import seeded
from mcsim.errors import InputError
from mcsim.simulation import power, sampled, simulate
from mcsim.simulation.nuisance import DisturbedSurvey
from mcsim.simulation.survey import Survey
from mcsim.simulation.survey import survey as survey_
from mcsim.support import folders
from mcsim.support.npy import write_npy
from mcsim.systematics import if_possible

SEED = 0x6D63 * 1_000 + 3  #: seed of the controls; the simulations that a diagnosis learns with have two others

FINER, FINEST = (4, 2), 2048
"""Factors by which the pixels that are made are refined before they are degraded, the first that is possible; and the
largest nside."""

REST = 0.01  #: standard deviations by which sky power that controls lack may move the variance of the pixels of a map


@dataclass(frozen=True)
class Fidelity:
    """How controls are drawn: a survey with more of the sky, in finer pixels or sample by sample."""

    survey: Survey
    sample_by_sample: bool

    @property
    def run(self) -> config.RunConfig:
        """Return the configuration."""
        return self.survey.config

    @property
    def words(self) -> str:
        """Return how controls are drawn."""
        how = "sample by sample" if self.sample_by_sample else "by the default route"
        return f"sky.lmax = {self.run.sky.lmax} and map.nside = {self.run.map.nside}, {how}"

    @property
    def samples(self) -> int:
        """Return the number of samples of a control, 0 if it is not drawn sample by sample."""
        hits = [m.moments.hits.sum() for m in self.survey.making.maps]
        return int(sum(hits)) if self.sample_by_sample else 0


def fidelity(analysis: Analysis, nthreads: int = 1) -> Fidelity:
    """Return the highest fidelity at which the data of a model can be drawn.

    The sky reaches up to where its power no longer matters. Where the scan is known, every sample sees it in its own
    direction, so that finer pixels would change nothing. Maps of parallel transport that are degraded are made in up to
    four times finer pixels, with the same noise in coarse ones. A beam that ends, and files of one resolution, keep
    their own.
    """
    own, known = analysis.model.survey, dict(analysis.library)
    run, by_sample = seeded(own.config, SEED), _sampled(own)
    reach = max(run.sky.lmax, power.reach(own, REST))
    for finer, lmax in _tried(run, reach, by_sample):
        with if_possible():  # a file may not fit
            return Fidelity(survey_(_refined(run, finer, lmax), nthreads, library=known), by_sample)
    return Fidelity(survey_(run, nthreads, library=known), by_sample)


def _sampled(own: Survey) -> bool:
    """Return True if all channels can be simulated sample by sample."""
    with if_possible():
        for channel in own.making.channels:
            sampled.check(channel)
        return True
    return False


def _tried(run: config.RunConfig, reach: int, by_sample: bool) -> Iterator[tuple[int, int]]:
    """Yield factors of nside and values of sky.lmax, the most faithful first."""
    degraded = any(isinstance(step, config.preparation.Degrade) for step in run.preparation)
    centres = all(isinstance(spec.scan, config.ScanParallelTransport) for spec in run.channels)
    factors = FINER if degraded and centres and not by_sample else ()
    for lmax in dict.fromkeys((reach, run.sky.lmax)):
        for finer in (*(one for one in factors if one * run.map.resolution <= FINEST), 1):
            yield finer, lmax


def _refined(run: config.RunConfig, finer: int, lmax: int) -> config.RunConfig:
    """Return a run with finer pixels and more of the sky; a coarse pixel has as much noise, in more samples."""

    def noisier(noise: AnyNoise) -> AnyNoise:
        if finer > 1 and not isinstance(noise, config.Noise):
            raise InputError("noise that is not of samples is of the pixels that are made; keep map.nside.")
        return replace(noise, sigma0_uk=finer * noise.sigma0_uk) if isinstance(noise, config.Noise) else noise

    channels = tuple(
        replace(spec, noise=noisier(spec.noise), split_noise={k: noisier(one) for k, one in spec.split_noise.items()})
        for spec in run.channels
    )
    sky, biposh = replace(run.sky, lmax=lmax), replace(run.biposh, lmax=config.analysis_lmax(run))
    pixels = replace(run.map, nside=finer * run.map.resolution)
    return replace(run, sky=sky, map=pixels, channels=channels, biposh=biposh)


def draw(run: str, content: str, library: Kinds, sample_by_sample: bool, realization: int, folder: str) -> None:
    """Draw the maps of a control into a folder that appears complete or not at all; the task of a worker.

    ``content``: hash of the run and of its files, which may have changed since the worker read them.
    """
    with folders.appearing(Path(folder)) as scratch:
        shared = _survey(run, content, library).at(realization)
        every = sampled.maps(shared, realization) if sample_by_sample else enumerate(simulate.maps(shared, realization))
        write_npy(scratch / "maps.npy", np.stack([map_uk for _, map_uk in every]))


@lru_cache(maxsize=1)
def _survey(run: str, content: str, library: Kinds) -> DisturbedSurvey:
    """Keep the survey of the last controls; each draws its own nuisances."""
    check_files(run, content)
    return DisturbedSurvey.of(config.from_json(run), dict(library))
