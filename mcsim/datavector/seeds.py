"""Refuse external simulators that draw other things than the seed says, or do not add the effects that they declare."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import healpy
import numpy as np

from mcsim import config
from mcsim.datavector.analysis import Analysis, Job, analysis_for, external_maps
from mcsim.datavector.campaign import Task, is_of_the_model, with_effects
from mcsim.datavector.candidate import Candidate
from mcsim.datavector.repeats import REPEATS
from mcsim.ensemble.external import SEEDS
from mcsim.errors import InputError
from mcsim.support.arrays import Map, Matrix
from mcsim.systematics import Effect

FAINT = 1e-4  #: of the step at which a response is measured: the change of a map falls with it, or with its root

DRAWN = 0.1
"""Share of the change by a step that a faint one, of the same seed, makes at most. A power changes a map by its root,
0.01; other sky or noise as much as at any step."""


@dataclass(frozen=True)
class Checked:
    """A task that tests the seeds of an external simulator before the first of its simulations."""

    task: Task

    def __call__(self, job: Job) -> Matrix:
        """Return the data vectors of a job."""
        if job.source is not None and job.first == 0 and job.source.count is None and is_of_the_model(job):
            _check_seeds(job)
            _check_effects(job)
        return self.task(job)


def _check_seeds(job: Job) -> None:
    """Raise InputError unless one seed gives the same maps twice, and another seed others."""
    one, other, again = (_maps(job, number) for number in (1, 2, 1))
    assert job.source is not None
    if not _same(one, again):
        raise InputError(
            f"{job.source.label} gives other maps when it is called with the same seed again; draw every random number "
            "from a generator that is made with the seed."
        )
    if _same(one, other):
        raise InputError(f"{job.source.label} gives the same maps for every seed; draw sky and noise from the seed.")


def _check_effects(job: Job) -> None:
    """Raise InputError unless each declared effect changes the maps of a seed, and hardly does where it is faint.

    Responses are differences of maps of one seed. Other sky or noise, drawn when there are effects, would hide them.
    """
    assert job.source is not None
    analysis, label = analysis_for(job), job.source.label
    for name in job.source.effects:
        steps = list(_steps(analysis, name))
        if not steps:
            continue
        plain = _maps(job, 1)
        whole, faint = (_maps(_with(job, steps, share), 1) - plain for share in (1.0, FAINT))
        for candidate, _ in steps:
            channels = analysis.model.channels
            own = [candidate.channel in (None, channels[part.channel]) for part in analysis.model.parts]
            if _is_small(whole[own], plain[own]):
                where = "" if candidate.channel is None else f" of {candidate.channel}"
                raise InputError(
                    f"{label} ignores the effect {name}{where} that it declares: the maps of a seed are the same with "
                    f"it; add it where effects name it, or take it out of {label}.effects."
                )
        if np.linalg.norm(faint) > DRAWN * np.linalg.norm(whole) and not _is_small(faint, plain):
            share = np.linalg.norm(faint) / np.linalg.norm(whole)
            raise InputError(
                f"{label} draws other random numbers when it is given effects: {name} at {FAINT:g} of its step changes "
                f"the maps by {share:.2g} of what the step does; draw the same sky and noise from a seed, whatever "
                "the effects."
            )


def _steps(analysis: Analysis, name: str) -> Iterator[tuple[Candidate, Effect]]:
    """Yield the first step of the candidates of a name: one for each channel."""
    found = {one.channel: one for one in reversed(analysis.candidates) if one.name == name}
    for candidate in found.values():
        yield candidate, candidate.basis[0].scaled(candidate.parametrization.sign or 1)


def _with(job: Job, steps: Sequence[tuple[Candidate, Effect]], share: float) -> Job:
    tables = [candidate.table(effect.scaled(share)) for candidate, effect in steps]
    return replace(job, simulated=config.to_json(with_effects(config.from_json(job.simulated), tables)))


def _maps(job: Job, number: int) -> Map:
    """Return the maps of a seed that nothing else is drawn with, shape (map, npix), 0 where they are not observed."""
    found = np.stack(external_maps(job, SEEDS - number))
    return np.where(found == healpy.UNSEEN, 0.0, found)


def _same(one: Map, other: Map) -> bool:
    return _is_small(one - other, one)


def _is_small(difference: Map, one: Map) -> bool:
    return bool(np.linalg.norm(difference) <= REPEATS * np.linalg.norm(one))
