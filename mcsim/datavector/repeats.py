"""Refuse realizations of an external simulator that repeat others, or are none of it: a covariance counts each."""

import numpy as np
from scipy.spatial import KDTree

from mcsim.ensemble.external_maps import Source
from mcsim.errors import InputError
from mcsim.support.arrays import Matrix, Vector, divided

REPEATS = 1e-6
"""Rms difference over the rms up to which two maps or data vectors are the same: threads add numbers in any order."""

FAR = 40.0
"""Largest distance of a realization from the median of an element, in its scatter by the median distance. Models of
ours have 15 at most, of 300: the tails of products of sky and noise. A map of another sky in one to ten makes 200.
"""

ALONE = 0.8  #: share of the variance that one may make, of an element that is the same in half of the realizations

SIGMA = 1.4826  #: standard deviation over the median distance from the median, of a Gaussian


def check_distinct(rows: Matrix, source: Source, seed: int) -> None:
    """Raise InputError if two data vectors, shape (N, p), of the realizations of a stream of seeds are the same.

    Those of two skies differ by about their scatter in every element.
    """
    scaled = divided(rows, np.sqrt(np.mean(rows**2, axis=0)))
    pairs = KDTree(scaled).query_pairs(REPEATS * np.sqrt(rows.shape[1]), output_type="ndarray")
    if not len(pairs):
        return
    pairs = np.sort(pairs, axis=1)
    distinct = len(rows) - len(np.unique(pairs[:, 1]))
    first, again = (int(one) for one in pairs[np.lexsort((pairs[:, 0], pairs[:, 1]))[0]])
    remedy = "draw sky and noise of each from its whole seed" if source.count is None else "store each realization once"
    raise InputError(
        f"{source.words(seed, first)} and {source.words(seed, again)} are the same, and of the first {len(rows)} "
        f"{distinct} are different; {remedy}."
    )


def check_alike(rows: Matrix, source: Source, seed: int) -> None:
    """Raise InputError if data vectors, shape (N, p), are none like the others: those with a map of another sky.

    In the covariance of a sample with some of them nothing departs from the model any more.
    """
    distances = np.abs(rows - np.median(rows, axis=0))
    scatter, squares = SIGMA * np.median(distances, axis=0), (rows - rows.mean(axis=0)) ** 2
    same = np.where(divided(squares, squares.sum(axis=0)) > ALONE, np.inf, 0.0)
    far = np.where(scatter > 0.0, divided(distances, scatter), same).max(axis=1)
    worst, others = int(far.argmax()), int(np.sum(far > FAR)) - 1
    if far[worst] > FAR:
        beside, them = (f" and {others} more are", "their") if others else (" is", "its")
        raise InputError(
            f"{source.words(seed, worst)}{beside} none like the others of {len(rows)}: up to {far[worst]:.3g} times "
            f"the scatter of what is measured away from their median, where {FAR:g} are the most; see if {them} "
            f"maps are of one sky and of this survey, or leave {'them' if others else 'it'} out."
        )


def check_fresh(x: Vector, rows: Matrix, source: Source, seed: int) -> None:
    """Raise InputError for data, shape (p,), that are one of the realizations, (N, p), that they are tested with.

    They are near the mean of a sample that they are in: of 150 simulations of 82 elements all have p-values above 0.9.
    """
    spread = np.sqrt(np.mean(rows**2, axis=0))
    apart = np.sqrt(np.mean(divided(rows - x, spread) ** 2, axis=1))
    if apart.min() <= REPEATS:
        raise InputError(
            f"the data are {source.words(seed, int(apart.argmin()))}, one of those that they are tested with, and the "
            "p-value would be too large; give other data, or leave it out of the realizations."
        )
