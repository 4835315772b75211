"""Responses at the amplitudes that were found, and at which amplitudes these were simulated."""

from dataclasses import dataclass, field

import numpy as np

from mcsim.datavector.candidate import Candidate
from mcsim.diagnosis.crossed import Crossings
from mcsim.support.arrays import Matrix, Vector

STEEPEST = 9.0  #: a response is never taken to grow with more than the tenth power of its amplitude


@dataclass(frozen=True)
class Responses:
    """Hold linear templates, those at the amplitudes that were simulated, candidates, and these amplitudes.

    They are the nearest possible ones to those ``asked`` for. ``last`` has where a candidate was simulated before, and
    the amplitudes that the data had by the templates of there.
    """

    linear: Matrix
    t: Matrix
    candidates: list[Candidate]
    done: dict[int, Vector | None] = field(default_factory=dict)
    asked: dict[int, Vector] = field(default_factory=dict)
    last: dict[int, tuple[Vector, Vector]] = field(default_factory=dict)
    crossed: Crossings = field(default_factory=dict)

    def copy(self) -> "Responses":
        """Return another one to which nothing of what is simulated from now on is added."""
        done, asked, last, crossed = self.done.copy(), self.asked.copy(), self.last.copy(), self.crossed.copy()
        return Responses(self.linear, self.t.copy(), self.candidates.copy(), done, asked, last, crossed)


def steepness(before: tuple[Vector, Vector], now: tuple[Vector, Vector], covariance: Matrix) -> float:
    """Return by how much fitted coordinates fall as those rise that templates are simulated at, 0 to STEEPEST.

    Both are given of two simulations. It is n - 1 of a response that grows with the n-th power of its amplitude.
    """
    precision = np.linalg.pinv(covariance)
    moved, fitted = now[0] - before[0], now[1] - before[1]
    size = float(moved @ precision @ moved)
    return float(np.clip(-(moved @ precision @ fitted) / size, 0.0, STEEPEST)) if size > 0.0 else 0.0
