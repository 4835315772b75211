"""Refuse realizations of an external simulator that repeat others, or are none of it: a covariance counts each."""

import numpy as np
from scipy.spatial import KDTree

from mcsim.ensemble.external_maps import Source
from mcsim.errors import InputError
from mcsim.support.arrays import Matrix, Vector, divided

REPEATS = 1e-6
"""Rms difference over the rms up to which two maps or data vectors are the same: threads add numbers in any order."""

ALONE = 0.8
"""Share of the variance of an element that one realization may make: it then is 2 sqrt(N) standard deviations of the N
others away. The tails of products of sky and noise make 0.5 of 60 realizations at most, and 0.1 of 600.
"""


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
    """Raise InputError if one of the data vectors, shape (N, p), makes the scatter of an element almost by itself.

    One with a map of another sky does. In the covariance of such a sample nothing departs from the model any more.
    """
    squares = (rows - rows.mean(axis=0)) ** 2
    shares = divided(squares, squares.sum(axis=0)).max(axis=1)
    worst = int(shares.argmax())
    if shares[worst] > ALONE:
        raise InputError(
            f"{source.words(seed, worst)} is none like the others: it makes {100.0 * shares[worst]:.3g} % of the "
            f"variance of what is measured in {len(rows)} of them, and {100.0 * ALONE:g} % are the most that one may; "
            "see if its maps are of one sky and of this survey, or leave it out."
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
