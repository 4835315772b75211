"""Fit and test where effects in the data scatter them: errors of amplitudes, and what is found beside these effects."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mcsim.stats.excess import scatter_chi2
from mcsim.stats.few_draws import scores_of_draws, without
from mcsim.stats.gaussian import COLLINEAR, Fit, SimulatedGaussian, orthonormal
from mcsim.support.arrays import Matrix, Vector, divided

Groups = Sequence[Sequence[int]]
"""Columns of the templates of each candidate."""


@dataclass(frozen=True)
class Acting:
    """Hold by how much an effect that acts at some amplitude scatters the data more than they are without it.

    Attributes
    ----------
    size
        Squared white norm of its response.
    chi2
        What its scatter adds to chi^2 of a residual.
    excess, error
        What it adds to the variance of the data along each of C groups of templates beside its own, over what that is
        without it, and the squared standard error of this; shape (C,).
    """

    size: float
    chi2: float
    excess: Vector
    error: Vector

    @classmethod
    def of(cls, null: SimulatedGaussian, t: Matrix, groups: Groups, own: int, pair: tuple[Matrix, Matrix]) -> "Acting":
        """Compare data vectors of the same skies without the effect and with it, shape (skies, p_raw) each.

        ``t`` are templates, shape (p_raw, K), and ``groups`` their columns; ``own`` is the number of the effect's.

        Notes
        -----
        Along a direction the data are x without the effect and x + c with it, and x has the variance one. With b the
        regression of c on x, and r the variance that it leaves, the variance becomes v = (1 + b)^2 + r; (b^2 + r)/skies
        are due to the response, which is a mean of as many skies. Noise that grows alike in all skies has r = 0, and
        few skies tell it exactly. The error of b is r/nu, that of r 2 r^2/nu, nu the skies less one.
        """
        before, after = (null.whiten_templates(rows.T).T for rows in pair)
        change = after - before
        basis, _ = orthonormal(null.whiten_templates(t[:, list(groups[own])]))
        size, skies = float(np.sum(change.mean(axis=0) ** 2)), len(change)
        x, c = (np.sqrt(null.hartlap_factor) * (rows - rows.mean(axis=0)) for rows in (before, change))
        excess, error = np.zeros((2, len(groups)))
        for number, columns in enumerate(groups):
            white = null.whiten_templates(t[:, list(columns)])
            beside, _ = orthonormal(white - basis @ (basis.T @ white))
            if number == own or not beside.shape[1]:
                continue
            along, moved, nu = x @ beside, c @ beside, (skies - 1.0) * beside.shape[1]
            b = float(np.sum(along * moved) / max(np.sum(along**2), 1e-300))
            r = float(np.sum((moved - b * along) ** 2)) / max(nu - 1.0, 1.0)
            excess[number] = (1.0 + b) ** 2 + r + (b**2 + r) / skies - 1.0
            error[number] = (4.0 * (1.0 + b) ** 2 * r + 2.0 * r**2) / nu
        return cls(size, scatter_chi2(null, t[:, list(groups[own])], *pair) * size, excess, error)


def with_scatter(null: SimulatedGaussian, t: Matrix, found: Fit, before: Matrix, after: Matrix) -> Fit:
    """Return a fit of templates, shape (p_raw, K), with the errors of its amplitudes with the effects in the data.

    ``before`` and ``after`` are data vectors of the same skies without the effects and with them at their amplitudes,
    shape (skies, p_raw).

    Notes
    -----
    A strong effect changes the scatter of the data. The fit is linear, so that it is applied to every sky. The variance
    of each amplitude grows by its excess among the skies with the effects over that without them: the same skies, whose
    common scatter cancels. The response that is fitted is a mean of as many skies: the variance of the amplitudes that
    the changes of single skies have, over their number, adds. Correlations stay; errors are not made smaller.
    """
    basis, back = orthonormal(null.whiten_templates(t))
    without, acting, change = (
        np.var(back @ basis.T @ null.whiten_templates(rows.T), axis=1, ddof=1)
        for rows in (before, after, after - before)
    )
    own, added = np.diag(found.covariance), np.maximum(acting - without + change / len(before), 0.0)
    factor = np.sqrt(1.0 + divided(added, own))
    return replace(found, covariance=factor[:, None] * found.covariance * factor)


def with_drawn_scatter(null: SimulatedGaussian, t: Matrix, found: Fit, scatters: Sequence[Matrix]) -> Fit:
    """Return a fit of templates, shape (p_raw, K), with the errors that patterns which are drawn give its amplitudes.

    ``null`` is the distribution without them; ``scatters``, with which it was widened for the fit, are deviations as of
    :meth:`SimulatedGaussian.with_extra_covariance`.

    Notes
    -----
    The weights of the fit avoid the scatter of the very draws that it is known from: these would make errors too small.
    Each draw is fitted with the scatter of all others, and the mean square of what it adds to the amplitudes stands in
    place of the scatter (leave-one-out cross-validation; Stone, JRSS B 36, 111, 1974). Pulls:
    tests/statistical/test_drawn_scatter.py.
    """
    white, scale = np.linalg.pinv(null.whitening), (null.dof + found.chi2) / (found.dof - 2)

    def weights(extra: Sequence[Matrix]) -> Matrix:
        wide = null.with_extra_covariance(*extra)
        basis, back = orthonormal(wide.whiten_templates(t))
        return np.asarray(back @ basis.T @ wide.whitening / np.sqrt(1.0 + 1.0 / null.n_sims))

    own = weights(scatters) @ white * np.sqrt(1.0 + 1.0 / null.n_sims)
    covariance = scale * own @ own.T
    for place, draws in enumerate(scatters):
        for k in range(draws.shape[1]):
            others = [*scatters[:place], without(draws, k), *scatters[place + 1 :]]
            added = weights(others) @ draws[:, k]
            covariance += np.outer(added, added)
    return replace(found, covariance=covariance)


def variance_beside(
    null: SimulatedGaussian, t: Matrix, groups: Groups, members: Sequence[int], scatters: Sequence[Matrix]
) -> Vector:
    """Return by how much the fall of chi^2 by each group of templates is above its expectation, shape (groups,), >= 1.

    ``t`` are templates, shape (p_raw, K), and ``groups`` their columns. Those of the ``members`` are fitted before.
    ``scatters``, with which the null distribution is widened, are those of :func:`with_drawn_scatter`.

    Notes
    -----
    A covariance that a few draws tell is too small by factors in single directions. Each draw, with noise, is fitted
    with the weights that follow from all others. The excesses of several scatters add up. Levels that are met:
    tests/statistical/test_drawn_scatter.py.
    """
    found = np.ones(len(groups))
    fitted = [column for member in members for column in groups[member]]
    for place, draws in enumerate(scatters):
        wide = null.with_extra_covariance(*scatters[:place], *scatters[place + 1 :])
        white, scale = wide.whiten_templates(t), np.sqrt(wide.hartlap_factor)
        white *= divided(1.0, np.linalg.norm(white, axis=0))
        gram, covariance = scores_of_draws(scale * wide.whiten_templates(draws), white)
        beside = np.linalg.pinv(gram[np.ix_(fitted, fitted)], COLLINEAR) @ gram[fitted]
        # Of t'(1 + R)^-1 x less what the members explain: the normal matrix, and the covariance of held-out draws.
        left = np.eye(len(gram))
        left[:, fitted] -= beside.T
        normal, held_out = left @ gram @ left.T, left @ covariance @ left.T
        for number, columns in enumerate(groups):
            own = np.ix_(columns, columns)
            values, vectors = np.linalg.eigh(normal[own])
            kept = values > COLLINEAR
            if kept.any() and number not in members:
                share = np.diag(vectors.T @ held_out[own] @ vectors)[kept] / values[kept]
                found[number] += share.mean() - 1.0
    return np.maximum(found, 1.0)
