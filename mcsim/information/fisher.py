r"""Fisher information of maps that share an unknown Gaussian sky, from random probes.

With d = P s + n and C = P S P^t + N, let an effect change P by dP, the variance of the noise by dN and the mean by dmu.
For x = C^-1 d and s^ = S P^t x let

    b_i = dP_i s^ + dN_i x / 2,     so that     d' C^-1 dC_i C^-1 d / 2 = x' b_i.

b_i = B_i x is linear in x, and dC_i = B_i + B_i^t. If x and y are made of independent data of the model, their
covariance is C^-1, and

    1/2 Tr[C^-1 dC_i C^-1 dC_j] = 1/2 E[(x'b_i(y) + y'b_i(x)) (x'b_j(y) + y'b_j(x))],

for x'b_i(y) + y'b_i(x) = x' dC_i y. All pairs of a set of probes are averaged: one solution of C^-1 for each, and the
error falls as one over their number. No adjoint of dP is needed, so that the simulator itself is the operator. To this
dmu_i' C^-1 dmu_j is added, without probes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mcsim.information.derivatives import Derivative
from mcsim.simulation.inverse_covariance import InverseCovariance, product
from mcsim.sphere import alm as alm_
from mcsim.support.arrays import Alm, Cl, Maps, Matrix, divided
from mcsim.support.progress import Reporter

PAIRED_BYTES = 1 << 30  #: memory for probes that are paired with each other; more probes are done in groups

TOGETHER = 16
"""Responses that are multiplied with all probes at once: the products of one alone take as long as it does."""


@dataclass(frozen=True)
class Information:
    """Hold a Fisher matrix, shape (K, K), per unit of each coordinate, and what tells its error."""

    fisher: Matrix
    #: for each group of n probes x' dC_i y of its pairs, shape (K, n, n), 0 on the diagonal; empty: no probes
    pairs: tuple[NDArray[np.float64], ...] = ()


@dataclass(frozen=True)
class Probes:
    """Say how many random probes are drawn, and with which seed."""

    number: int
    seed: int = 0


def group_of(probes: Probes, filtered: InverseCovariance) -> int:
    """Return how many probes are paired with each other at once."""
    return max(3, min(probes.number, PAIRED_BYTES // (8 * filtered.precision.size)))


def stochastic(
    filtered: InverseCovariance, derivatives: Sequence[Derivative], cl: Cl, probes: Probes, report: Reporter
) -> Information:
    """Estimate the Fisher information by random probes; ``report`` counts the applications of a derivative.

    ``cl`` is the spectrum of the sky that effects act on, uK^2, shape (lmax + 1,), at most that of the inverse
    covariance.

    Notes
    -----
    The relative error of the diagonal is about 2/number, and of several groups the root of 2 over the number of pairs.
    """
    K, group, done = len(derivatives), group_of(probes, filtered), 0.0
    found: list[Matrix] = []
    pairs = []
    for first in range(0, probes.number, group):
        members = range(first, min(first + group, probes.number))
        if len(members) < 3 and found:
            break
        data = np.empty((len(members), *filtered.precision.shape))  # x_k
        skies = [_draw(filtered, cl, probes.seed, number, x) for number, x in zip(members, data, strict=True)]
        table = np.zeros((K, len(members), len(members)))  # x_k . b_i(x_l)
        for row, derivative in enumerate(derivatives):
            own = data[:, derivative.maps].reshape(len(members), -1)
            for start in range(0, len(members), TOGETHER):
                part = slice(start, start + TOGETHER)
                responses = [_response(derivative, *each) for each in zip(data[part], skies[part], strict=True)]
                table[row, :, part] = own @ np.reshape(responses, (len(responses), -1)).T
                done += len(responses)
                report(done)
        both = (table + np.swapaxes(table, 1, 2)) * (1.0 - np.eye(len(members)))
        each = 0.5 * np.swapaxes(both, 0, 1) @ np.moveaxis(both, 0, 2)  # of the pairs of each probe
        found.append(each.sum(axis=0))
        pairs.append(both)
    first_half, second_half = zip(*(means(filtered, derivative) for derivative in derivatives), strict=True)
    total = np.sum(found, axis=0) / sum(map(ordered_pairs, pairs))  # all pairs count the same, in whatever group
    total += _filtered_products(filtered, derivatives, first_half, second_half)
    total = (total + total.T) / 2.0
    return Information(total, tuple(pairs))


def ordered_pairs(group: NDArray[np.float64]) -> int:
    """Return how many pairs the probes of a group make, each in both orders; ``group`` as in Information, (K, n, n)."""
    return group.shape[1] * (group.shape[1] - 1)


def variance_of_mean(pairs: Matrix) -> float:
    """Return the variance of the mean over pairs of n independent draws, from h of each pair, shape (n, n), n >= 3.

    h is symmetric, and its diagonal is not used.

    Notes
    -----
    With h_kl = m + g_k + g_l + w_kl of uncorrelated parts (Hoeffding 1948, Ann. Math. Stat. 19, 293) it is 4 <g^2>/n +
    2 <w^2>/(n (n - 1)). Let s^2 be the variance of the means over the pairs of each draw: ((n - 1)/(n - 2))^2 s^2 is
    <g^2> + <w^2>/(n - 2), and the squares that these means leave sum up to <w^2> n (n - 3)/2. The jackknife, which is
    the former times 4/n, has twice the second part (Efron & Stein 1981, Ann. Stat. 9, 586). This is without bias, but
    for a least value of half the second part; of three draws, which leave nothing, it is the jackknife.
    tests/unit/test_information_error.py compares it with many sets of draws.
    """
    n, others = len(pairs), ~np.eye(len(pairs), dtype=bool)
    mean = float(pairs[others].mean())
    single = (np.sum(pairs, axis=1, where=others) / (n - 1) - mean) * (n - 1) / (n - 2)  # g_k
    left = (pairs - mean - single[:, None] - single)[others]
    second = float(np.sum(left**2)) / (n * (n - 3)) if n > 3 else 0.0
    first = float(np.sum(single**2)) / (n - 1) - second / (n - 2)
    return max(4.0 * first / n + 2.0 * second / (n * (n - 1)), second / (n * (n - 1)))


def means(filtered: InverseCovariance, derivative: Derivative) -> tuple[Maps, Maps]:
    """Return both estimates of the derivative of the mean, without what templates of the maps explain of it."""
    own = filtered.maps[derivative.maps]
    first, second = (
        np.stack([one.unexplained(row) for one, row in zip(own, maps, strict=True)]) for maps in derivative.mean
    )
    return first, second


def _draw(filtered: InverseCovariance, cl: Cl, seed: int, number: int, x: Maps) -> Alm:
    """Return s^ of the sky of spectrum ``cl`` from data that the model makes, and fill x = C^-1 d."""
    data = filtered.draw("information", number, seed)
    found = filtered.wiener(data)
    x[:] = filtered.apply(data, found)
    return alm_.multiply(found, divided(cl, filtered.cl), filtered.lmax)


def _response(derivative: Derivative, x: Maps, sky: Alm) -> Maps:
    """Return b = dP s^ + dN x / 2 of the derivative's own maps."""
    if derivative.noise is None:
        return derivative.of_sky(sky)
    return derivative.of_sky(sky) + 0.5 * derivative.noise * x[derivative.maps]


def _filtered_products(
    filtered: InverseCovariance, derivatives: Sequence[Derivative], left: Sequence[Maps], right: Sequence[Maps]
) -> Matrix:
    """Return a_i' C^-1 b_j = a_i' N^-1 b_j - (P^t N^-1 a_i)' (S^-1 + P^t N^-1 P)^-1 (P^t N^-1 b_j) of :func:`means`."""
    own = [derivative.maps for derivative in derivatives]
    found = np.zeros((len(own), len(own)))
    seen = [filtered.of_own(maps, part) for maps, part in zip(left, own, strict=True)]
    others = [filtered.of_own(maps, part) for maps, part in zip(right, own, strict=True)]
    for j, (maps, part) in enumerate(zip(right, own, strict=True)):
        if not maps.any():
            continue
        sky = filtered.solve(others[j])
        for i in range(len(own)):
            low, high = max(part.start, own[i].start), min(part.stop, own[i].stop)
            if low < high:
                a = left[i][low - own[i].start : high - own[i].start]
                b = maps[low - part.start : high - part.start]
                found[i, j] = np.sum(a * filtered.precision[low:high] * b)
            found[i, j] -= product(seen[i], sky, filtered.lmax)
    return found
