"""Templates of effects whose response to data is more bent than straight: those of a parabola where it fits best."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares

from mcsim.datavector.candidate import Candidate
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.support.arrays import Matrix, Vector
from mcsim.systematics import acts_through


def bent_templates(
    null: SimulatedGaussian, x: Vector, t: Matrix, curvature: Matrix, candidates: Sequence[Candidate]
) -> Matrix:
    """Return templates ``t``, shape (p, K), of which some are secants of parabolas, exact where these fit data best.

    ``curvature``, shape (p, K), has half the second derivatives in each coordinate. Secants are those of candidates
    whose bent part is larger than the straight one: where the straight response fits, or where the parabola does if it
    leaves less than half of chi^2 there. Elements that are squares of maps then hold most of what a strong effect does,
    and a straight fit to these says nothing of its amplitude. Parabolas hold for what changes maps in proportion to the
    coordinates, as additions and gains do and beams do not.
    """
    bent, y = t.copy(), null.whiten(x)
    for candidate in candidates:
        how = candidate.parametrization
        in_proportion = how.proportional or acts_through(candidate.effect, "sky", "signal", "gain", "steady_gain")
        if how.stochastic or candidate.nuisance or not in_proportion:
            continue
        columns = list(candidate.columns)
        straight, square = (null.whiten_templates(one[:, columns]) for one in (t, curvature))
        first = np.asarray(np.linalg.lstsq(straight, y, rcond=None)[0], dtype=np.float64)
        best = _fit(y, straight, square, first)
        if best is None or not (_more_bent(straight, square, first) or _halved(y, straight, square, first, best)):
            continue
        covariance = np.asarray(np.linalg.pinv(straight.T @ straight), dtype=np.float64)
        if not np.isfinite(candidate.beyond(best, covariance)):
            continue
        response = t[:, columns] @ best + curvature[:, columns] @ best**2
        bent[:, columns] += beyond(null, t[:, columns], best, response)
    return bent


def _more_bent(straight: Matrix, square: Matrix, at: Vector) -> bool:
    """Return True if the bent part of a response is larger than the straight one at coordinates."""
    return bool(np.linalg.norm(square @ at**2) > np.linalg.norm(straight @ at))


def _halved(y: Vector, straight: Matrix, square: Matrix, first: Vector, best: Vector) -> bool:
    """Return True if a parabola that is more bent than straight leaves less than half of what the straight fit does.

    The straight fit may lie far below: of data that are mostly squares it says nothing.
    """
    left = np.linalg.norm(y - straight @ best - square @ best**2)
    return _more_bent(straight, square, best) and bool(2.0 * left**2 < np.linalg.norm(y - straight @ first) ** 2)


def beyond(null: SimulatedGaussian, t: Matrix, at: Vector, response: Vector) -> Matrix:
    """Return what makes templates, shape (p, k), exact at coordinates: the response beyond their sum.

    It is shared in proportion to the squared white norms of the parts, so that a weakly constrained one, whatever
    its fitted coordinate, does not change.
    """
    parts = t * at
    weights = np.sum(null.whiten_templates(parts) ** 2, axis=0)
    shares = np.divide(weights, at * weights.sum(), out=np.zeros_like(at), where=weights > 0.0)
    return np.outer(response - parts.sum(axis=1), shares)


def _fit(y: Vector, straight: Matrix, square: Matrix, first: Vector) -> Vector | None:
    """Return the coordinates at which parabolas fit best; None if no better than the straight response.

    The descent starts at the straight fit, and at that of what the bent parts, with any size, leave of the data.
    """
    without = np.linalg.lstsq(np.hstack([straight, square]), y, rcond=None)[0][: first.size]
    found = [
        least_squares(lambda at: straight @ at + square @ at**2 - y, start, jac=lambda at: straight + 2.0 * square * at)
        for start in (first, without)
    ]
    best = min(found, key=lambda one: float(one.cost))
    better = 2.0 * best.cost < float(np.sum((y - straight @ first) ** 2))
    return np.asarray(best.x) if better else None
