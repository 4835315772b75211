"""Refuse external simulators that do not draw everything from the seed that they are given."""

from dataclasses import dataclass

import numpy as np

from mcsim.datavector.analysis import Job, external_maps
from mcsim.datavector.campaign import Task
from mcsim.datavector.repeats import REPEATS
from mcsim.ensemble.external import SEEDS
from mcsim.errors import InputError
from mcsim.support.arrays import Map, Matrix


@dataclass(frozen=True)
class Checked:
    """A task that tests the seeds of an external simulator before the first of its simulations."""

    task: Task

    def __call__(self, job: Job) -> Matrix:
        """Return the data vectors of a job."""
        if job.source is not None and job.first == 0 and job.source.count is None:
            _check_seeds(job)
        return self.task(job)


def _check_seeds(job: Job) -> None:
    """Raise InputError unless one seed gives the same maps twice, and another seed others."""
    one, other, again = (np.stack(external_maps(job, SEEDS - number)) for number in (1, 2, 1))
    assert job.source is not None
    if not _same(one, again):
        raise InputError(
            f"{job.source.label} gives other maps when it is called with the same seed again; draw every random number "
            "from a generator that is made with the seed."
        )
    if _same(one, other):
        raise InputError(f"{job.source.label} gives the same maps for every seed; draw sky and noise from the seed.")


def _same(one: Map, other: Map) -> bool:
    return bool(np.linalg.norm(one - other) <= REPEATS * np.linalg.norm(one))
