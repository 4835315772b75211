"""Streaming means, standard deviations and covariances, merged by a fixed tree.

A reduction is chunk -> combine -> finalise. Leaves are single realizations; the tree over them is the binary tree of
their indices, so the result is the same bit for bit whatever the chunks, workers and order of arrival, and a missing
realization leaves the shape of the tree unchanged.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.complex128] | NDArray[np.float64]


@dataclass(frozen=True)
class Sums:
    """Sufficient statistics of ``count`` realizations."""

    count: int  #: number of realizations
    mean: dict[str, Array]  #: mean of each variable
    square: dict[str, NDArray[np.float64]]  #: sum of |x - mean|^2 of each variable, real
    #: sum of (x - mean) conj(x - mean)^T over the last axis of the variables for which it was asked
    comoment: dict[str, Array]


def leaf(values: dict[str, Array], covariance_of: tuple[str, ...] = ()) -> Sums:
    """Return the statistics of one realization."""
    square = {name: np.zeros(np.shape(x)) for name, x in values.items()}
    comoment = {
        name: np.zeros((*values[name].shape, values[name].shape[-1]), values[name].dtype) for name in covariance_of
    }
    return Sums(1, dict(values), square, comoment)


def combine(a: Sums | None, b: Sums | None) -> Sums | None:
    """Return the statistics of two disjoint sets together (Chan, Golub & LeVeque 1983); ``None`` is the empty set."""
    if a is None or b is None:
        return b if a is None else a
    count = a.count + b.count
    share, weight = b.count / count, a.count * b.count / count
    mean, square, comoment = {}, {}, {}
    for name in a.mean:
        delta = b.mean[name] - a.mean[name]
        mean[name] = a.mean[name] + share * delta
        square[name] = a.square[name] + b.square[name] + weight * (delta.real**2 + delta.imag**2)
        if name in a.comoment:
            outer = delta[..., :, None] * np.conj(delta[..., None, :])
            comoment[name] = a.comoment[name] + b.comoment[name] + weight * outer
    return Sums(count, mean, square, comoment)


def tree(node: Callable[[int], Sums | None], nodes: int) -> Sums | None:
    """Combine nodes 0 ... nodes - 1 of one level of the binary tree.

    ``node`` gives the statistics of one of them, ``None`` if it is empty; each is asked for once, in order.

    Notes
    -----
    Node k of the next level joins nodes 2k and 2k + 1 of this one. At most log2(nodes) + 1 partial results are held.
    """
    stack: list[tuple[int, Sums | None]] = []
    for index in range(nodes):
        level, sums = 0, node(index)
        while stack and stack[-1][0] == level:
            sums = combine(stack.pop()[1], sums)
            level += 1
        stack.append((level, sums))
    result: Sums | None = None
    while stack:
        result = combine(stack.pop()[1], result)
    return result


def standard_deviation(sums: Sums, name: str) -> NDArray[np.float64]:
    """Return the standard deviation over realizations, of |x - mean| for complex x; NaN for fewer than two."""
    if sums.count < 2:
        return np.full(sums.square[name].shape, np.nan)
    return np.sqrt(sums.square[name] / (sums.count - 1))


def covariance(sums: Sums, name: str) -> Array:
    """Return the covariance E (x - mean) conj(x - mean)^T over the last axis; NaN for fewer than two realizations."""
    if sums.count < 2:
        return np.full(sums.comoment[name].shape, np.nan)
    result: Array = sums.comoment[name] / (sums.count - 1)
    return result


def jackknife(
    statistic: Callable[..., NDArray[np.float64]], *samples: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a statistic of means over realizations, and its error by leaving out one realization after the other.

    ``statistic`` is a function of the mean of each sample; samples have the shape (realization, ...).
    """
    number = len(samples[0])
    left_out = np.array([statistic(*(np.delete(s, r, axis=0).mean(axis=0) for s in samples)) for r in range(number)])
    value = np.asarray(statistic(*(s.mean(axis=0) for s in samples)))
    return value, np.sqrt((number - 1.0) * np.mean((left_out - left_out.mean(axis=0)) ** 2, axis=0))
