"""What a worker holds for all cases of a challenge: the court of the model, learned once, and lesser ones."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.benchmark.inventions import introduced
from mcsim.benchmark.reduced import without
from mcsim.diagnosis.case import Court, court
from mcsim.diagnosis.evidence import Job, evidence_of, questions
from mcsim.diagnosis.session import prepared
from mcsim.errors import RunError

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Sitting:
    """A court, and which entries of the full evidence it looks at."""

    court: Court
    rows: NDArray[np.int64]

    def ask(self, jobs: Sequence[Job]) -> list[Vector]:
        """Answers of jobs in this process."""
        return [evidence_of(replace(job, without=()))[:, self.rows] for job in jobs]


@lru_cache(maxsize=1)
def sitting(model: str, simulations: int | None) -> Sitting:
    """Of a model, given as JSON, that has been learned before."""
    run = config.from_json(model)
    found = prepared(run, questions(run), _refuse, simulations)
    return Sitting(found, np.arange(len(found.asked.entries)))


@lru_cache(maxsize=2)
def lesser(model: str, simulations: int | None, names: tuple[str, ...]) -> Sitting:
    """The same without some effects."""
    full = sitting(model, simulations)
    if not names:
        return full
    fewer = without(full.court.asked, full.court.known, names)
    return Sitting(court(full.court.run, fewer.asked, fewer.known), fewer.rows)


def evidence_with(job: Job, inventions: str | None) -> Vector:
    """Task: evidence of simulations that may contain inventions."""
    with introduced(inventions):
        return evidence_of(job)


def _refuse(jobs: Sequence[Job]) -> list[Vector]:
    raise RunError("what the model's simulations teach is not in the cache of this worker; let all share one folder.")
