"""What of a library is heard in a gap that it does not explain."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.candidate import Candidate, allowed
from mcsim.diagnosis.gaussian import Fit, Null, fit, score_probability
from mcsim.diagnosis.trials import Calibration

LEVEL = 0.005
"""Probability, trials included, up to which a further effect is heard."""

MOST = 6

BENT = 0.5
"""Second order of a response over its first, from which on a fitted amplitude says nothing."""


@dataclass(frozen=True)
class Closest:
    """Effects that are heard in a gap without being all of it.

    Attributes
    ----------
    members
        Indices of the candidates, in the order in which they were found.
    fit
        Amplitudes of the members' columns, one member after the other.
    left
        Share of the gap that they leave.
    """

    members: tuple[int, ...]
    fit: Fit
    left: float


def closest(
    null: Null,
    x: NDArray[np.float64],
    t: NDArray[np.float64],
    curvature: NDArray[np.float64],
    candidates: Sequence[Candidate],
    calibration: Calibration,
) -> Closest | None:
    """Add the most significant candidate beside those that are heard already, as long as one is significant.

    Parameters
    ----------
    null, x
        Null and evidence, shape (p_raw,).
    t, curvature
        Templates per unit amplitude, and half the second derivatives of the responses, shape (p_raw, K).
    candidates, calibration
        Candidates on those templates, and their calibration.

    Returns
    -------
    Closest
        None where nothing is significant. Each member was significant beside those before it; of two that are alike
        the one that is not there may be the first. What would have to be so strong that its response is no straight
        line any more is passed over.
    """
    members: tuple[int, ...] = ()
    columns: list[int] = []
    before = fit(null, x, t[:, :0])
    total = before.chi2
    while len(members) < MOST:
        taken = {candidates[member].identity for member in members}
        smallest, best, chosen = 1.0, before, -1
        for index, candidate in enumerate(candidates):
            if candidate.identity in taken:
                continue
            after = fit(null, x, t[:, [*columns, *candidate.columns]])
            if not allowed(candidates, (*members, index), after):
                continue
            if not _within_reach(null, t, curvature, [*columns, *candidate.columns], after.amplitudes):
                continue
            rank = before.dimension - after.dimension
            score = float(score_probability(before.chi2 - after.chi2, before.chi2, rank, before.dimension, null.dof))
            if score < smallest or chosen < 0:
                smallest, best, chosen = score, after, index
        if chosen < 0 or float(calibration.trials(smallest)) > LEVEL:
            break
        members, columns, before = (*members, chosen), [*columns, *candidates[chosen].columns], best
    if not members:
        return None
    gap = null.unbiased * total - null.dimension
    left = null.unbiased * before.chi2 - before.dimension
    return Closest(members, before, min(max(left / gap, 0.0), 1.0) if gap > 0.0 else 1.0)


def _within_reach(
    null: Null,
    t: NDArray[np.float64],
    curvature: NDArray[np.float64],
    columns: Sequence[int],
    amplitudes: NDArray[np.float64],
) -> bool:
    """Whether the second order of every column is less than BENT times the first."""
    used = list(columns)
    first = null.templates(t[:, used] * amplitudes)
    second = null.templates(curvature[:, used] * amplitudes**2)
    return bool(np.all(np.linalg.norm(second, axis=0) <= BENT * np.linalg.norm(first, axis=0)))
