"""Templates: the response of the data vector to each candidate."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.diagnosis.candidate import Candidate
from mcsim.diagnosis.settings import DiagnosisSettings
from mcsim.errors import InputError

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]
Respond = Callable[[Sequence[config.Effect], int], Matrix]
"""Return the changes of the data vector by effects in a number of simulated skies, shape (skies, p)."""


@dataclass(frozen=True)
class TemplateBank:
    """Hold the responses of the data vector to all linear components of all candidates.

    Attributes
    ----------
    matrix
        Response per unit of each coordinate, shape (p, K).
    error
        Standard error of the matrix, shape (p, K).
    curvature
        Half the second derivative, shape (p, K).
    """

    matrix: Matrix
    error: Matrix
    curvature: Matrix

    def subset(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> "TemplateBank":
        """Return some elements and some columns."""
        cut = np.ix_(rows, columns)
        return TemplateBank(self.matrix[cut], self.error[cut], self.curvature[cut])

    def significant(self, spread: Vector, settings: DiagnosisSettings) -> Matrix:
        """Return the matrix; noisy columns without the elements that are only noise.

        ``spread`` is the standard deviation of the data vector, shape (p,).
        """
        scale = spread[:, None]
        noise = np.sum((self.error / scale) ** 2, axis=0)
        noisy = noise > settings.noisy_share * np.sum((self.matrix / scale) ** 2, axis=0)
        clear = np.abs(self.matrix) > settings.clean_sigma * self.error
        return np.where(noisy & ~clear, 0.0, self.matrix)

    def sky_scatter(self, spread: Vector, candidates: Sequence[Candidate], skies: Sequence[int]) -> Vector:
        """Return the rms scatter of the response among skies over the mean response, shape (candidates,).

        Norms are of elements over their standard deviation ``spread``, all columns of a candidate together; ``skies``
        is the number of skies of each candidate's response. Infinite if all columns are noise.
        """
        scale = spread[:, None]
        noise = np.sum((self.error / scale) ** 2, axis=0)
        size = np.sum((self.matrix / scale) ** 2, axis=0)
        found = []
        for candidate, number in zip(candidates, skies, strict=True):
            rows = list(candidate.columns)
            # A column of nothing but noise says nothing of the others.
            clear = size[rows] > 2.0 * noise[rows]
            ratio = number * noise[rows] / np.maximum(size[rows] - noise[rows], 1e-300)
            found.append(float(np.sqrt(np.mean(ratio[clear]))) if clear.any() else np.inf)
        return np.array(found)

    def on_sky(
        self, t: Matrix, candidates: Sequence[Candidate], which: Collection[int], respond: Respond, skies: int
    ) -> Matrix:
        """Return the templates ``t`` with those of the candidates ``which`` measured on the observed sky."""
        result = t.copy()
        for index in which:
            candidate = candidates[index]
            for place, (column, basis) in enumerate(zip(candidate.columns, candidate.basis, strict=True)):
                try:
                    response = respond([candidate.table(basis)], skies).mean(axis=0)
                except InputError:
                    continue
                step = basis.parametrization.coordinates(basis)[place]
                result[:, column] = response / step - self.curvature[:, column] * step
        return result
