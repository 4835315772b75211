"""Fit and test where effects in the data scatter them: errors of amplitudes, and what is found beside these effects."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mcsim.stats.excess import scatter_chi2
from mcsim.stats.few_draws import scores_of_draws, without
from mcsim.stats.gaussian import COLLINEAR, Fit, SimulatedGaussian, Tolerated, orthonormal
from mcsim.support.arrays import Matrix, Rows, Vector, divided

FLAT = 0.5  #: derivative of a response over its secant, below which a parabola tells errors
FLATTEST = 1e-9  #: derivative of a response over its secant, below which it is none

GROWS = 0.5
"""Variance that effects add along their own responses, over that without them, from which on more skies tell it: a few
that are the same for all data can be wrong by a factor."""

Groups = Sequence[Sequence[int]]  #: columns of the templates of each candidate


@dataclass(frozen=True, eq=False)
class Acting:
    """Hold by how much an effect that acts at some amplitude scatters the data more than they are without it."""

    size: float  #: squared white norm of its response
    chi2: float  #: what its scatter adds to chi^2 of a residual
    spread: float  #: what it adds to half of the variance of that beyond twice as much
    #: excess, error: what it adds to the variance of the data along each of C groups of templates beside its own, over
    #: what that is without it, and the squared standard error of this; shape (C,)
    excess: Vector
    error: Vector
    own: float = 0.0  #: what it adds to the variance along its own response, over what that is without it
    #: data vectors of the same skies without the effect and with it, from which all this is known, (skies, p_raw) each
    pair: tuple[Matrix, Matrix] | None = None

    @classmethod
    def of(cls, null: SimulatedGaussian, t: Matrix, groups: Groups, own: int, pair: tuple[Matrix, Matrix]) -> "Acting":
        """Compare data vectors of the same skies without the effect and with it, shape (skies, p_raw) each.

        ``t`` are templates, shape (p_raw, K), and ``groups`` their columns; ``own`` is the number of the effect's.

        Notes
        -----
        The variance along a group is that of :func:`_growth`, with the mean of the changes as response.
        """
        before, after = (null.whiten_templates(rows.T).T for rows in pair)
        change = after - before
        basis, _ = orthonormal(null.whiten_templates(t[:, list(groups[own])]))
        mean = change.mean(axis=0)
        size = float(mean @ mean)
        x, c = (np.sqrt(null.hartlap_factor) * (rows - rows.mean(axis=0)) for rows in (before, change))
        excess, error = np.zeros((2, len(groups)))
        for number, columns in enumerate(groups):
            white = null.whiten_templates(t[:, list(columns)])
            beside, _ = orthonormal(white - basis @ (basis.T @ white))
            if number == own or not beside.shape[1]:
                continue
            excess[number], error[number] = _growth(x @ beside, c @ beside)
        along = divided(basis.T @ mean, np.linalg.norm(basis.T @ mean))
        growth, _ = _growth(x @ basis @ along[:, None], c @ basis @ along[:, None])
        return cls(size, *scatter_chi2(null, t[:, list(groups[own])], *pair), excess, error, growth, pair)


def _growth(x: Matrix, c: Matrix) -> tuple[float, float]:
    """Return by how much the variance of x grows if c is added to it, and the squared standard error of this.

    Both are deviations from their means, shape (skies, K), x of variance one.

    Notes
    -----
    With b the regression of c on x, and r the variance that it leaves, the variance of x + c is (1 + b)^2 + r, and
    (b^2 + r)/skies adds if the mean of c is taken for the response. Noise that grows alike everywhere has r = 0: few
    skies tell it exactly, whereas variances before and after have the error of few skies. With nu degrees of freedom
    the squared error of b is r/nu, by which b^2 is too large, that of r 2 r^2/nu.
    """
    skies, columns = x.shape
    nu = max((skies - 1.0) * columns, 1.0)
    b = float(np.sum(x * c) / max(np.sum(x**2), 1e-300))
    r = float(np.sum((c - b * x) ** 2)) / max(nu - 1.0, 1.0)
    varied = b**2 - r / nu + r
    growth = 2.0 * b + varied + varied / skies
    return growth, (4.0 * (1.0 + b) ** 2 * r + 2.0 * r**2) / nu


@dataclass(frozen=True)
class Beside:
    """Combine what C candidates that act add to the scatter of the data beside them."""

    #: size, chi2, spread: those of :class:`Acting`, infinite and 0 where none is known, shape (C,)
    size: Vector
    chi2: Vector
    spread: Vector
    #: excess, error: the same, a row for each candidate that acts, shape (C, C)
    excess: Matrix
    error: Matrix
    variance: Vector  #: along each candidate, by :func:`variance_beside` of those that draw their pattern, shape (C,)

    @classmethod
    def of(cls, acting: Sequence[Acting | None], variance: Vector | None) -> "Beside":
        """Take what is known of each candidate; without a variance none draws its pattern.

        Candidates that were added since one was simulated, behind all others, are not scattered by it.
        """
        count = len(acting)
        size, (chi2, spread) = np.full(count, np.inf), np.zeros((2, count))
        excess, error = np.zeros((2, count, count))
        for row, one in enumerate(acting):
            if one is not None:
                size[row], chi2[row], spread[row], known = one.size, one.chi2, one.spread, len(one.excess)
                excess[row, :known], error[row, :known] = one.excess, one.error
        return cls(size, chi2, spread, excess, error, np.ones(count) if variance is None else variance)

    def tolerated(self, allowance: Vector, members: Rows, parts: Matrix, others: Rows) -> Tolerated:
        """Return what tests of candidates ``others``, shape (M or 1, N), beside M sets tolerate, shape (M, N) each.

        ``allowance``, shape (M,), is that of :class:`~mcsim.stats.gaussian.Tolerated`, ``members`` are the sets, and
        ``parts`` the squared amplitudes of the members over those at which they were simulated, shape (M, size).
        """
        shape = (len(members), others.shape[1])
        variance, squared = np.broadcast_to(self.variance[others], shape).copy(), np.zeros(shape)
        for member, part in zip(members.T, parts.T, strict=True):
            variance += part[:, None] * self.excess[member[:, None], others]
            squared += part[:, None] ** 2 * self.error[member[:, None], others]
        variance = np.maximum(variance, 1.0)
        dof = 2.0 * variance**2 / np.maximum(squared, 1e-12)
        return Tolerated(np.broadcast_to(allowance[:, None], shape), variance, dof)


def with_scatter(null: SimulatedGaussian, t: Matrix, found: Fit, before: Matrix, after: Matrix) -> Fit:
    """Return a fit of templates, shape (p_raw, K), with the errors of its amplitudes with the effects in the data.

    ``before`` and ``after`` are data vectors of the same skies without the effects and with them at their amplitudes,
    shape (skies, p_raw).

    Notes
    -----
    A strong effect changes the scatter of the data. The fit is linear, so that it is applied to every sky: the variance
    of each amplitude grows by :func:`_growth`. Where it shrinks, as that of what a wider beam lets through, only the
    part of the variance does so that skies which the data constrain have: the sum over white elements, as few skies
    tell the variance along one direction badly. The error is the standard deviation of a Student t with the degrees of
    freedom from which the growth is known. Correlations stay.
    """
    basis, back = orthonormal(null.whiten_templates(t))
    own, weights = np.sqrt(np.diag(found.covariance)), back @ basis.T
    x, c = (null.whiten_templates((rows - rows.mean(axis=0)).T) for rows in (before, after - before))
    pairs = zip(*(divided(weights @ rows, own[:, None]) for rows in (x, c)), strict=True)
    growth, error = np.array([_growth(one[:, None], other[:, None]) for one, other in pairs]).T
    seen = null.hartlap_factor * np.sum(x**2, axis=1) / max(len(before) - 1, 1)
    share = np.minimum(divided(weights**2 @ seen, np.sum(weights**2, axis=1), 1.0), 1.0)
    variance = 1.0 + np.where(growth < 0.0, share, 1.0) * growth
    dof = 2.0 * variance**2 / np.maximum(error, 1e-12)
    factor = np.sqrt(variance * dof / np.maximum(dof - 2.0, 1.0))
    return replace(found, covariance=factor[:, None] * found.covariance * factor)


def with_tangents(null: SimulatedGaussian, t: Matrix, found: Fit, tangents: Sequence[Matrix | None]) -> Fit:
    """Return a fit of templates, shape (p_raw, K), with the errors of amplitudes at which responses are not straight.

    ``tangents`` are the derivatives of the response in each amplitude, shape (skies, p_raw); None of one that is
    straight.

    Notes
    -----
    Templates are straight lines T from zero that are exact at the fitted amplitudes: the fit solves
    T'C^-1 (x - R(theta)) = 0, and the data move it by the inverse of G = (T'C^-1 T)^-1 T'C^-1 dR/dtheta, which is one
    for straight responses. The covariance V of the lines becomes G^-1 V G'^-1. Each element of G - 1 is measured in
    few skies, d +- s, and of a normal prior of mean zero whose variance is estimated as d^2 - s^2 >= 0: its posterior
    mean is d (1 - s^2/d^2) (empirical Bayes; Efron & Morris, JASA 68, 117, 1973). Near a peak of the response errors
    are those of its parabola (:func:`_on_parabola`). Pulls: tests/unit/test_diagnosis_scattered.py.
    """
    basis, back = orthonormal(null.whiten_templates(t))
    slopes = np.eye(len(back))
    for k, rows in enumerate(tangents):
        if rows is not None:
            each = back @ basis.T @ null.whiten_templates(rows.T) - slopes[:, k, None]
            d = each.mean(axis=1)
            s = each.std(axis=1, ddof=1) / np.sqrt(len(rows)) if len(rows) > 1 else np.zeros(len(d))
            slopes[:, k] += d * np.maximum(1.0 - divided(s**2, d**2), 0.0)
    left, sizes, right = np.linalg.svd(slopes)
    move = right.T @ (left / np.maximum(sizes, FLATTEST)).T
    covariance = move @ found.covariance @ move.T
    errors = np.sqrt(np.diag(covariance))
    share = divided(_on_parabola(found.errors, errors, np.abs(found.amplitudes)), errors, 1.0)
    return replace(found, covariance=share[:, None] * covariance * share)


def _on_parabola(line: Vector, tangent: Vector, amplitude: Vector) -> Vector:
    """Return errors of amplitudes from those by their lines and tangents: of a parabola where tangents are flat.

    Notes
    -----
    With g the tangent over the line, the parabola through zero and the fit changes by g d + (1 - g) d^2/a, in units of
    the line, towards zero: that is the error of the line at the d returned, which is not taken to be less. At a peak a
    tangent tells no error.
    """
    g = divided(line, tangent, 1.0)
    bend = divided(1.0 - g, amplitude)
    d = divided(np.sqrt(g**2 + 4.0 * np.maximum(bend, 0.0) * line) - g, 2.0 * bend)
    return np.where(g < FLAT, np.maximum(d, line), tangent)


def with_drawn_scatter(
    null: SimulatedGaussian, t: Matrix, found: Fit, scatters: Sequence[Matrix], alone: Sequence[Matrix | None] = ()
) -> Fit:
    """Return a fit of templates, shape (p_raw, K), with the errors that patterns which are drawn give its amplitudes.

    ``null`` is the distribution without them; ``scatters``, with which it was widened for the fit, are deviations as of
    :meth:`SimulatedGaussian.with_extra_covariance`. ``alone`` are those of the data vectors of the same skies without
    the first ones, where these are correlated with what is drawn.

    Notes
    -----
    The weights of the fit avoid the scatter of the very draws that it is known from: these would make errors too small.
    Each draw is fitted with the scatter of all others, and the mean square of what it adds to the amplitudes stands in
    place of the scatter (leave-one-out cross-validation; Stone, JRSS B 36, 111, 1974). What is correlated with the data
    adds their product, too. Pulls: tests/statistical/test_drawn_scatter.py.
    """
    white, scale = np.linalg.pinv(null.whitening), (null.dof + found.chi2) / (found.dof - 2)

    def weights(extra: Sequence[Matrix]) -> Matrix:
        wide = null.with_extra_covariance(*extra)
        basis, back = orthonormal(wide.whiten_templates(t))
        return np.asarray(back @ basis.T @ wide.whitening / np.sqrt(1.0 + 1.0 / null.n_sims))

    own = weights(scatters) @ white * np.sqrt(1.0 + 1.0 / null.n_sims)
    covariance, crossed = scale * own @ own.T, np.zeros(found.covariance.shape)
    for place, draws in enumerate(scatters):
        data = alone[place] if place < len(alone) else None
        for k in range(draws.shape[1]):
            others = [*scatters[:place], without(draws, k), *scatters[place + 1 :]]
            each = weights(others)
            added = each @ draws[:, k]
            covariance += np.outer(added, added)
            crossed += 0.0 if data is None else np.outer(added, each @ data[:, k])
    both = covariance + crossed + crossed.T
    return replace(found, covariance=both if np.linalg.eigvalsh(both)[0] > 0.0 else covariance)


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
