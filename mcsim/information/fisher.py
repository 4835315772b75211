r"""Fisher information of maps that share an unknown Gaussian sky, from random probes.

With d = P s + n and C = P S P^t + N, let an effect change P by dP, the variance of the noise by dN and the mean by dmu.
For x = C^-1 d and s^ = S P^t x let

    b_i = dP_i s^ + dN_i x / 2,     so that     d' C^-1 dC_i C^-1 d / 2 = x' b_i.

b_i = B_i x is linear in x, and dC_i = B_i + B_i^t. If x and y are made of independent data of the model, their
covariance is C^-1, and

    F_ij = 1/2 Tr[C^-1 dC_i C^-1 dC_j] + dmu_i' C^-1 dmu_j
         = E[(x'b_i(y)) (y'b_j(x))] + E[b_i(x)' C^-1 b_j(x)] + dmu_i' C^-1 dmu_j.

The first mean, over pairs of probes, takes one solution of C^-1 for each probe. The second takes one for each effect as
well, but is a trace of many modes: few probes are enough. No adjoint of dP is needed, so that the simulator itself is
the operator.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mcsim.information.derivatives import Derivative
from mcsim.simulation.inverse_covariance import InverseCovariance, product
from mcsim.sphere import alm as alm_
from mcsim.sphere import rng
from mcsim.sphere.sky import gaussian_alm
from mcsim.support.arrays import Alm, Cl, Matrix
from mcsim.support.progress import Reporter

Maps = NDArray[np.float64]

PAIRED_BYTES = 1 << 30
"""Memory for probes that are paired with each other; more probes are done in groups."""


@dataclass(frozen=True)
class Information:
    """Hold a Fisher matrix, shape (K, K), per unit of each coordinate, and the relative error of its diagonal, (K,)."""

    fisher: Matrix
    error: NDArray[np.float64]


@dataclass(frozen=True)
class Probes:
    """Say how many random probes are drawn: of pairs, and of those whose responses are filtered as well; and a seed."""

    pairs: int
    filtered: int
    seed: int = 0


def group_of(probes: Probes, filtered: InverseCovariance) -> int:
    """Return how many probes are paired with each other at once."""
    return max(2, min(probes.pairs, PAIRED_BYTES // (8 * filtered.precision.size)))


def stochastic(
    filtered: InverseCovariance, derivatives: Sequence[Derivative], cl: Cl, probes: Probes, report: Reporter
) -> Information:
    """Estimate the Fisher information by random probes; ``report`` counts the applications of a derivative or of C^-1.

    ``cl`` is the spectrum of the sky that effects act on, uK^2, shape (lmax + 1,), at most that of the inverse
    covariance.

    Notes
    -----
    The relative error of the diagonal is that of both means together, by jackknife over the probes: about 1/pairs for a
    single mode of each, whatever the size of the maps.
    """
    K, group, done = len(derivatives), group_of(probes, filtered), 0.0
    crossed, jackknife, each = [], [], []
    for first in range(0, probes.pairs, group):
        members = range(first, min(first + group, probes.pairs))
        if len(members) < 2:
            break
        drawn = [_draw(filtered, cl, probes.seed, number) for number in members]
        table = np.zeros((K, len(members), len(members)))  # x_k . b_i(x_l)
        for column, (x, sky) in enumerate(drawn):
            number = members[column]
            responses = []
            for row, derivative in enumerate(derivatives):
                found = _response(derivative, x, sky)
                table[row, :, column] = [np.vdot(other[derivative.maps], found) for other, _ in drawn]
                if number < probes.filtered:
                    responses.append(found)
                done += 1.0
                report(done)
            if responses:
                each.append(_filtered_products(filtered, derivatives, responses, responses))
                done += K
                report(done)
        pairs = len(members) * (len(members) - 1)
        inside = np.einsum("ikk->ik", table)
        swapped = np.swapaxes(table, 1, 2)
        crossed.append((np.einsum("ikl,jkl->ij", table, swapped) - inside @ inside.T) / pairs)
        jackknife.append(_left_out(table * swapped))
    T1, T2 = np.mean(crossed, axis=0), np.mean(each, axis=0)
    first_half, second_half = zip(*(derivative.mean for derivative in derivatives), strict=True)
    total = T1 + T2 + _filtered_products(filtered, derivatives, first_half, second_half)
    total = (total + total.T) / 2.0
    diagonal = np.einsum("nii->ni", np.array(each))
    variance = np.mean(jackknife, axis=0) / len(jackknife)
    variance = variance + diagonal.var(axis=0, ddof=1) / len(diagonal)
    size = np.diag(total)
    return Information(total, np.divide(np.sqrt(variance), size, out=np.zeros(K), where=size > 0.0))


def _draw(filtered: InverseCovariance, cl: Cl, seed: int, number: int) -> tuple[Maps, Alm]:
    """Return x = C^-1 d of data that the model makes, and s^ of the sky of spectrum ``cl``."""
    sky = gaussian_alm(filtered.cl, rng.generator(seed, number, "information/sky"))
    noise = rng.generator(seed, number, "information/noise").standard_normal(filtered.precision.shape)
    seen = filtered.precision > 0.0
    scale = np.divide(1.0, np.sqrt(filtered.precision), out=np.zeros_like(noise), where=seen)
    data = np.where(seen, filtered.observe(sky) + scale * noise, 0.0)
    found = filtered.wiener(data)
    share = np.divide(cl, filtered.cl, out=np.zeros_like(cl), where=filtered.cl > 0.0)
    return filtered.apply(data, found), alm_.multiply(found, share, filtered.lmax)


def _response(derivative: Derivative, x: Maps, sky: Alm) -> Maps:
    """Return b = dP s^ + dN x / 2 of the derivative's own maps."""
    if derivative.noise is None:
        return derivative.of_sky(sky)
    return derivative.of_sky(sky) + 0.5 * derivative.noise * x[derivative.maps]


def _filtered_products(
    filtered: InverseCovariance, derivatives: Sequence[Derivative], left: Sequence[Maps], right: Sequence[Maps]
) -> Matrix:
    """Return a_i' C^-1 b_j = a_i' N^-1 b_j - (P^t N^-1 a_i)' (S^-1 + P^t N^-1 P)^-1 (P^t N^-1 b_j)."""
    own = [derivative.maps for derivative in derivatives]
    same = left is right
    found = np.zeros((len(own), len(own)))
    seen = [filtered.of_own(maps, part) for maps, part in zip(left, own, strict=True)]
    others = seen if same else [filtered.of_own(maps, part) for maps, part in zip(right, own, strict=True)]
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


def _left_out(products: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the jackknife variance of the mean over pairs of different probes, (K, n, n) to (K,)."""
    n = products.shape[1]
    if n < 3:
        return np.zeros(len(products))
    inside = np.einsum("ikk->ik", products)
    total = products.sum(axis=(1, 2)) - inside.sum(axis=1)
    each = products.sum(axis=2) + products.sum(axis=1) - 2.0 * inside
    without = (total[:, None] - each) / ((n - 1) * (n - 2))
    return np.asarray((n - 1) * without.var(axis=1))
