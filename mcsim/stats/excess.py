"""Excess chi^2 of data over what the simulations expect, and its reduction once an effect is in the simulator."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import helmert

from mcsim.stats.gaussian import SimulatedGaussian, orthonormal
from mcsim.support.arrays import Matrix, Vector


@dataclass(frozen=True)
class Measured:
    """Hold a number with its standard deviation."""

    value: float
    sigma: float


@dataclass(frozen=True)
class HeldOut:
    """Hold the excess chi^2 of data that were not fitted, before and after the effects are added to the simulator.

    ``predicted`` and ``achieved`` are fractional reductions; ``pvalue_after`` is that of what remains; ``data`` names
    the held-out data.
    """

    predicted: Measured
    achieved: Measured
    before: Measured
    after: Measured
    pvalue_after: float
    data: str

    def refutes(self, sigma: float, level: float) -> bool:
        """Return True if the effects are not what is missing, beyond ``sigma`` standard deviations.

        The excess grows, or falls by less than half of the prediction, or by less than half where what remains has a
        p-value up to ``level``. The last needs no prediction: a half of the data that asks for no effect predicts that
        nothing is removed. Of hardly any excess before no fraction is known, but that it grows is.
        """
        before, fraction, expected = self.before.value, self.achieved, self.predicted
        if self.pvalue_after <= level and fraction.value + sigma * fraction.sigma < 0.5:
            return True
        grows = fraction.value * before + sigma * fraction.sigma * abs(before) < 0.0
        if self.pvalue_after <= level:
            error = np.hypot(self.before.sigma, self.after.sigma)  # at most: both are of the same data
            grows = grows or self.after.value - before > sigma * error
        short = expected.value - fraction.value > sigma * np.hypot(expected.sigma, fraction.sigma)
        return bool(grows or (short and before > 0.0 and fraction.value < 0.5 * min(expected.value, 1.0)))

    def to_json(self) -> dict[str, Any]:
        """Return the reduction as ``verdict.json`` has it."""
        return {
            "predicted": self.predicted.value,
            "achieved": self.achieved.value,
            "sigma": self.achieved.sigma,
            "sigma_predicted": self.predicted.sigma,
            "gap_before": self.before.value,
            "sigma_before": self.before.sigma,
            "gap_after": self.after.value,
            "sigma_after": self.after.sigma,
            "p_value_after": self.pvalue_after,
            "data": self.data,
        }


def excess(null: SimulatedGaussian, x: Vector) -> Measured:
    """Return the excess chi^2 of data, shape (p_raw,); see :func:`excess_of`."""
    return excess_of(null.chi2(x), null.dimension, null.dof)


def excess_of(chi2: float, p: int, n: int) -> Measured:
    """Return the excess G of chi^2 in p dimensions over its expectation, for n degrees of freedom of the covariance.

    Notes
    -----
    G = (n - p - 1)/n chi^2 - p has as its mean the squared signal-to-noise ratio lambda of the departure, and the
    variance of a noncentral F, 2 ((p + lambda)^2 + (p + 2 lambda)(d - 2))/(d - 4), d = n - p + 1 (Johnson, Kotz &
    Balakrishnan, Continuous Univariate Distributions 2, ch. 30). sigma takes G for lambda.
    """
    value = (n - p - 1) / n * chi2 - p
    length, d = max(value, 0.0), n - p + 1
    return Measured(value, float(np.sqrt(2.0 * ((p + length) ** 2 + (p + 2.0 * length) * (d - 2)) / (d - 4))))


def scatter_chi2(null: SimulatedGaussian, t: Matrix, before: Matrix, after: Matrix) -> tuple[float, float]:
    """Return what effects add to chi^2 of a residual by their scatter, and to half of its variance beyond twice that.

    ``before`` and ``after`` are data vectors of the same skies without the effects and with them, shape (skies, p_raw),
    ``t`` the templates that are fitted, shape (p_raw, K).

    Notes
    -----
    With P the projection off the templates, in white coordinates, and D = P (C_after - C_before + C_change/skies) P,
    the last because the response is a mean of as many skies, chi^2 of the residual has the mean q + tr D, q = tr P, and
    the variance 2 (q + 2 tr D + tr D^2). Orthonormal contrasts of the skies (Helmert's) are independent, D_k each, and
    their common scatter cancels: tr D is the mean of tr D_k, and tr D^2 that of tr D_k D_l, k != l (Bai & Saranadasa,
    Statistica Sinica 6, 311, 1996), or (tr D)^2/q, the least that it can be. Half of the squared error of tr D is added
    to it. Tests: tests/statistical/test_elliptical.py.
    """
    change = after - before
    basis, _ = orthonormal(null.whiten_templates(t))
    contrasts = np.sqrt(null.hartlap_factor) * helmert(len(change))
    white = (contrasts @ null.whiten_templates(rows.T).T for rows in (after, before, change))
    parts = [
        (rows - rows @ basis @ basis.T, sign) for rows, sign in zip(white, (1.0, -1.0, 1 / len(change)), strict=True)
    ]
    product = sum(i * j * (x @ y.T) ** 2 for x, i in parts for y, j in parts)
    each, count = sum(i * np.sum(x**2, axis=1) for x, i in parts), len(change) - 1
    added, pairs = max(float(np.mean(each)), 0.0), count * (count - 1.0)
    square = (float(np.sum(product)) - float(np.trace(product))) / max(pairs, 1.0)
    square = max(square, added**2 / max(null.dimension - basis.shape[1], 1))
    square += 0.5 * float(np.sum((each - np.mean(each)) ** 2)) / max(pairs, 1.0)
    return added, square


def expected_fall(test: SimulatedGaussian, t: Matrix, amplitudes: Vector, covariance: Matrix) -> Measured:
    """Return the fall of chi^2 to expect on data that were not fitted, with null ``test`` and templates (p_test, K).

    ``amplitudes``, shape (K,), are frozen; ``covariance`` is that of their fit to other data.

    Notes
    -----
    Frozen at theta^ = theta + e, chi^2 of fresh data falls by 2 theta'F theta^ - theta^'F theta^ on average, whose
    unbiased estimate from the fit is theta^'F theta^ - 2 tr(F V); tr(F V) = K if both data are equally good. sigma is
    the error of this estimate: 2 sqrt(theta^'F V F theta^ + tr(F V F V)).
    """
    white = test.whiten_templates(t)
    fisher = test.hartlap_factor * white.T @ white
    product = fisher @ covariance
    delta_chi2 = float(amplitudes @ fisher @ amplitudes) - 2.0 * float(np.trace(product))
    variance = 4.0 * float(amplitudes @ product @ fisher @ amplitudes) + 4.0 * float(np.trace(product @ product))
    return Measured(delta_chi2, float(np.sqrt(variance)))


@dataclass(frozen=True)
class Frozen:
    """Hold what errors of a frozen change of the data vector add: their covariance V in a null distribution F.

    ``trace`` is tr(F V), ``square`` tr(F V F V), and ``along`` c'F V F c of the change c itself.
    """

    trace: float = 0.0
    square: float = 0.0
    along: float = 0.0

    @classmethod
    def of(cls, test: SimulatedGaussian, change: Vector, draws: Matrix) -> "Frozen":
        """Take it from independent draws of the errors, shape (p_test, n), n > 1, of a change of shape (p_test,)."""
        white, count = np.sqrt(test.hartlap_factor) * test.whiten_templates(draws), draws.shape[1]
        gram = white.T @ white
        sizes = np.diag(gram)
        square = (float(np.sum(gram**2)) - float(np.sum(sizes**2))) / (count * (count - 1.0))
        trace = float(np.mean(sizes))
        own = np.sqrt(test.hartlap_factor) * test.whiten_templates(change[:, None])[:, 0]
        return cls(trace, max(square, trace**2 / max(test.dimension, 1)), float(np.mean((own @ white) ** 2)))

    def less(self, fall: Measured) -> Measured:
        """Return the fall of chi^2 to expect of fresh data, less what the errors cost: twice, as in the estimate."""
        sigma = np.sqrt(fall.sigma**2 + 4.0 * self.along + 4.0 * self.square)
        return Measured(fall.value - 2.0 * self.trace, float(sigma))


def expected_fall_of_draw(
    wide: SimulatedGaussian, t: Matrix, covariance: Matrix, seen: Measured, shares: Vector
) -> Measured:
    """Return the fall of chi^2 to expect for a stochastic effect: all data see the same draw.

    ``wide`` is the null distribution of the data that judge, with the scatter of the effect, and ``t`` are its
    templates, shape (p_test, K); ``covariance`` is that of the frozen amplitudes from noise alone, and ``seen`` the
    excess chi^2 of the data that were fitted. ``shares``, shape (draws,), are ratios of the squared signal-to-noise
    ratio of draws of the response in the data that judge to that in those that were fitted.

    Notes
    -----
    The fall is the excess of the fitted data times the mean share, less tr(F V) for the error of the frozen amplitudes,
    F of the wide distribution. The scatter of the shares is part of its error: the brightness of a draw is in both
    squares.
    """
    share = float(np.mean(shares))
    white = wide.whiten_templates(t)
    lost = wide.hartlap_factor * float(np.trace(white.T @ white @ covariance))
    sigma = float(np.hypot(share * seen.sigma, seen.value * np.std(shares, ddof=1)))
    return Measured(share * seen.value - lost, sigma)


def held_out(
    before: SimulatedGaussian,
    after: SimulatedGaussian,
    x: Vector,
    expected: Measured,
    data: str,
    widened: tuple[float, float] = (0.0, 0.0),
) -> HeldOut:
    """Return the reduction of the excess chi^2 of data, shape (p_raw,), from one null distribution to another.

    ``expected`` is the fall of chi^2 that the fit to other data predicts. ``widened`` are the traces of a covariance,
    and of its square, that effects add to that of ``after`` in white coordinates: the p-value of what remains tolerates
    it, as :func:`mcsim.stats.gaussian.residual_pvalue` does.

    Notes
    -----
    A = 1 - G1/G0. Both excesses have the same noise e of the data: with d = true mean - mean before and D = mean after
    - mean before, dA = (2 (D - A d).e - A (e'e - p))/G0, hence var A = (4 |D - A d|^2 + 2 p A^2)/G0^2, to which the
    errors of the covariances add 2 ((p + G1)^2 + (1 - A)^2 (p + G0)^2)/(d2 - 4)/G0^2. Pulls: tests/statistical. A
    covariance that a few draws of the effects tell scales chi^2 afterwards (:mod:`mcsim.stats.few_draws`).
    """
    first, last = excess(before, x), excess(after, x)
    share = expected.value / first.value
    forecast = Measured(share, float(np.hypot(expected.sigma, share * first.sigma)) / abs(first.value))
    fraction = 1.0 - last.value / first.value
    p, d2 = before.dimension, before.dof - before.dimension + 1
    shift = before.whiten_templates((after.mean - before.mean)[:, None])[:, 0]
    distance, length = max(first.value, 0.0), max(last.value, 0.0)
    # The error of the two means adds to the square of their difference.
    moved = max(before.hartlap_factor * float(shift @ shift) - p * (1.0 / before.n_sims + 1.0 / after.n_sims), 0.0)
    along = before.hartlap_factor * float(shift @ before.whiten(x))
    mismatch = max(moved - 2.0 * fraction * along + fraction**2 * distance, 0.0)
    noise = (4.0 * mismatch + 2.0 * p * fraction**2) * (d2 - 2) / (d2 - 4)
    scatter = 2.0 * ((p + length) ** 2 + (1.0 - fraction) ** 2 * (p + distance) ** 2) / (d2 - 4)
    scaled = (after.scale_variance - before.scale_variance) * p * (p + 2)
    scatter, last = scatter + scaled, replace(last, sigma=float(np.hypot(last.sigma, np.sqrt(scaled))))
    sigma = float(np.sqrt(noise + scatter)) / abs(first.value)
    added, square = widened
    remains = float(after.residual_test(after.chi2(x), allowance=added, spread=square))
    return HeldOut(forecast, Measured(fraction, sigma), first, last, remains, data)
