"""What of a library is heard in a gap that no set of it explains."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.candidate import Candidate, allowed, columns_of
from mcsim.stats.gaussian import Fit, SimulatedGaussian, fit, nested_pvalue
from mcsim.stats.look_elsewhere import Calibration

Exact = Callable[[NDArray[np.float64], tuple[int, ...], Fit], NDArray[np.float64] | None]
"""From templates, members and their fit to templates that hold for these together at about these amplitudes."""

LEVEL = 0.005
"""Probability, trials included, up to which a further effect is heard."""

MOST = 6
REFUSED = 6
"""Candidates that seem to be heard and then are not, before nothing more is tried."""


@dataclass(frozen=True)
class PartialExplanation:
    """Effects that are heard in a gap without being all of it.

    Attributes
    ----------
    members
        Indices of the candidates, in the order in which they were found.
    fit
        Amplitudes of the members' columns, one member after the other.
    left
        Share of the gap that they leave.
    templates
        That hold for the members together, shape (p_raw, K).
    """

    members: tuple[int, ...]
    fit: Fit
    left: float
    templates: NDArray[np.float64]


def partial_explanation(
    null: SimulatedGaussian,
    x: NDArray[np.float64],
    t: NDArray[np.float64],
    candidates: Sequence[Candidate],
    calibration: Calibration,
    exact: Exact,
) -> PartialExplanation | None:
    """Add the most significant candidate beside those that are heard already, as long as one is significant.

    Parameters
    ----------
    null, x
        Null and evidence, shape (p_raw,).
    t
        Templates per unit amplitude, shape (p_raw, K).
    candidates, calibration
        Candidates on those templates, and their calibration.
    exact
        What members are brought to their amplitudes with; None from it says that they cannot have them.

    Returns
    -------
    Closest
        None where nothing is significant. Each member was significant beside those before it, both before and after it
        was brought to its amplitude; of two that are alike the one that is not there may be the first.
    """
    members: tuple[int, ...] = ()
    refused: set[int] = set()
    before = fit(null, x, t[:, :0])
    total = before.chi2

    def matched_filter(after: Fit) -> float:
        rank = before.dimension - after.dimension
        return float(nested_pvalue(before.chi2 - after.chi2, before.chi2, rank, before.dimension, null.dof))

    while len(members) < MOST and len(refused) < REFUSED:
        smallest, chosen = 1.0, -1
        taken = {candidates[member].identity for member in members}
        for index, candidate in enumerate(candidates):
            if candidate.identity not in taken and index not in refused:
                after = fit(null, x, t[:, columns_of(candidates, (*members, index))])
                score = matched_filter(after)
                if allowed(candidates, (*members, index), after) and (score < smallest or chosen < 0):
                    smallest, best, chosen = score, after, index
        if chosen < 0 or float(calibration.global_pvalue(smallest)) > LEVEL:
            break
        together = (*members, chosen)
        straight = exact(t, together, best)
        if straight is not None:
            after = fit(null, x, straight[:, columns_of(candidates, together)])
            if (
                allowed(candidates, together, after)
                and float(calibration.global_pvalue(matched_filter(after))) <= LEVEL
            ):
                members, t, before = together, straight, after
                continue
        refused.add(chosen)
    if not members:
        return None
    gap = null.unbiased * total - null.dimension
    left = null.unbiased * before.chi2 - before.dimension
    return PartialExplanation(members, before, min(max(left / gap, 0.0), 1.0) if gap > 0.0 else 1.0, t)
