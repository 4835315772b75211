"""Controls: data drawn from the model at higher fidelity than it simulates with, and diagnosed as the data are.

They hold what the fast route of a model leaves out: sky power above ``sky.lmax``, structure within the pixels that are
made, directions of the samples within a pixel.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from mcsim import config
from mcsim.config.noise import AnyNoise
from mcsim.datavector.analysis import Analysis, Kinds, check_files
from mcsim.datavector.campaign import Batch, asking, seeded
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.diagnosis.control_result import Control, Controls
from mcsim.diagnosis.inference import diagnose_data
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.ensemble.plan import cost
from mcsim.errors import InputError, RunError
from mcsim.simulation import power, sampled, simulate
from mcsim.simulation.nuisance import DisturbedSurvey
from mcsim.simulation.survey import Survey
from mcsim.simulation.survey import survey as survey_
from mcsim.support import folders
from mcsim.support.code import package_digest
from mcsim.support.npy import read_npy, write_npy
from mcsim.support.numbers import duration
from mcsim.support.progress import reporting

SEED = 0x6D63 * 1_000 + 3  #: seed of the controls; the simulations that a diagnosis learns with have two others

FINER, FINEST = (4, 2), 2048
"""Factors by which the pixels that are made are refined before they are degraded, the first that is possible; and the
largest nside."""

REST = 0.01  #: standard deviations by which sky power that controls lack may move the variance of the pixels of a map
SAMPLE_S = 1e-6  #: seconds that one sample takes on one core, for estimates


def check(count: int, of_maps: bool, external: bool = False) -> None:
    """Raise InputError for a number of controls that cannot be drawn for these data and this simulator."""
    if count < 0:
        raise InputError(f"controls = {count} is no number of data sets; give 0 or more, better 20.")
    if count and not of_maps:
        raise InputError(f"controls = {count}, but they are maps and the data a table; give controls = 0.")
    if count and external:
        raise InputError(
            f"controls = {count}, but mcsim draws them, and the model is simulated by another program; give "
            "controls = 0: the result says if mcsim agrees with that program."
        )


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
        try:
            return Fidelity(survey_(_refined(run, finer, lmax), nthreads, library=known), by_sample)
        except InputError:  # a file that does not fit
            continue
    return Fidelity(survey_(run, nthreads, library=known), by_sample)


def _sampled(own: Survey) -> bool:
    """Return True if all channels can be simulated sample by sample."""
    try:
        for channel in own.making.channels:
            sampled.check(channel)
    except InputError:
        return False
    return True


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


def diagnose_controls(known: DiagnosisContext, key: str, count: int, call: Batch, quiet: bool = True) -> Controls:
    """Draw and diagnose controls, each once: their verdicts are kept in the cache.

    ``key`` is the hash of all that ``known``, what the data are tested with, follows from. More controls than before go
    on where those ended. ``call`` runs the draws, and the simulations of effects that are fitted to controls. RunError
    if workers have another cache than this process.
    """
    with reporting("orientation moments of the controls", 1.0, "", quiet) as report:
        drawn = fidelity(known.analysis, os.cpu_count() or 1)
        report(1.0)
    code = package_digest(["mcsim.diagnosis"])
    text = json.dumps([key, config.science(drawn.run), drawn.sample_by_sample, code], sort_keys=True)
    folder = folders.default_cache_dir().absolute() / "controls" / hashlib.sha256(text.encode()).hexdigest()[:32]
    verdicts = {number: one for number in range(count) if (one := _read(folder, number)) is not None}
    missing = [number for number in range(count) if number not in verdicts]
    absent = [number for number in missing if not _maps(folder, number).is_dir()]
    fixed = (
        config.to_json(drawn.run),
        config.digest(drawn.run, "nuisance"),
        known.analysis.library,
        drawn.sample_by_sample,
    )
    done = count - len(missing)
    with reporting("controls", float(count), "controls", quiet) as report, asking(call, quiet=True) as ask:

        def finish(number: int) -> None:
            """Diagnose a control that is drawn, unless another process has; its maps are not needed again."""
            nonlocal done
            path = _maps(folder, number) / "maps.npy"
            present, control = path.is_file(), _read(folder, number)
            if control is None:
                if not present:
                    raise RunError(f"A worker drew {path}, and it is not there; let all workers share one cache.")
                maps = read_npy(path, "f", (2,))
                found = diagnose_data(ObservedMaps(known, list(maps), ask), f"control {number}")
                control = Control(found.test.pvalue, found.kind, tuple(effect.label for effect in found.effects))
                folders.write_whole(_verdict(folder, number), json.dumps(asdict(control)) + "\n")
            verdicts[number] = control
            shutil.rmtree(path.parent, ignore_errors=True)
            done += 1
            report(float(done))

        report(float(done))
        for number in missing:
            if number not in absent:
                finish(number)
        for index, _ in call(draw, ((*fixed, number, str(_maps(folder, number))) for number in absent)):
            finish(absent[index])
    members = tuple(verdicts[number] for number in range(count))
    return Controls(members, drawn.words, known.settings.alpha, known.null.n_sims)


def _maps(folder: Path, number: int) -> Path:
    return folder / f"{number:05d}"


def _verdict(folder: Path, number: int) -> Path:
    return folder / f"{number:05d}.json"


def _read(folder: Path, number: int) -> Control | None:
    """Return the verdict on a control; None if there is none, or a computer stopped as it was written."""
    try:
        plain = json.loads(_verdict(folder, number).read_text())
    except (FileNotFoundError, ValueError):
        return None
    return Control(**plain | {"effects": tuple(plain["effects"])})


def describe(analysis: Analysis, count: int, workers: int) -> list[str]:
    """Return lines on the cost of controls: how they are drawn, memory, time, and disk for a moment."""
    drawn = fidelity(analysis, os.cpu_count() or 1)
    found, dense = cost(drawn.run), f", {drawn.samples:.2g} samples each" if drawn.samples else ""
    each_s, size = found.each_s + SAMPLE_S * drawn.samples, 96.0 * drawn.survey.nside**2 * len(drawn.survey.map_names)
    return [
        f"  control {count} data sets with {drawn.words}{dense}; {found.memory / 1e9:.2f} GB per worker,"
        f" {duration(each_s)} each, {duration(each_s * count / workers)} on {workers} core{'s' if workers > 1 else ''},"
        f" {size / 1e6:.2f} MB of disk for each in work; those that depart from the model cost a diagnosis each",
    ]
