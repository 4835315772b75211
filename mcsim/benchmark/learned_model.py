"""What a worker holds for all cases of a challenge: the court of the model, learned once, and lesser ones."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.benchmark.out_of_library import introduced
from mcsim.benchmark.reduced import without
from mcsim.diagnosis.analysis import Job, analysis_of, data_vectors
from mcsim.diagnosis.api import prepared
from mcsim.diagnosis.inference import DiagnosisContext, context
from mcsim.errors import RunError

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class LearnedModel:
    """A court, and which entries of the full evidence it looks at."""

    context: DiagnosisContext
    rows: NDArray[np.int64]

    def ask(self, jobs: Sequence[Job]) -> list[Vector]:
        """Answers of jobs in this process."""
        return [data_vectors(replace(job, without=()))[:, self.rows] for job in jobs]


@lru_cache(maxsize=1)
def learned_model(model: str, simulations: int | None) -> LearnedModel:
    """Of a model, given as JSON, that has been learned before."""
    run = config.from_json(model)
    found = prepared(run, analysis_of(run), _refuse, simulations)
    return LearnedModel(found, np.arange(len(found.analysis.elements)))


@lru_cache(maxsize=2)
def without_effects(model: str, simulations: int | None, names: tuple[str, ...]) -> LearnedModel:
    """The same without some effects."""
    full = learned_model(model, simulations)
    if not names:
        return full
    fewer = without(full.context.analysis, full.context.known, names)
    return LearnedModel(context(full.context.run, fewer.analysis, fewer.known), fewer.rows)


def evidence_with(job: Job, out_of_library: str | None) -> Vector:
    """Task: evidence of simulations that may contain inventions."""
    with introduced(out_of_library):
        return data_vectors(job)


def _refuse(jobs: Sequence[Job]) -> list[Vector]:
    raise RunError("what the model's simulations teach is not in the cache of this worker; let all share one folder.")
