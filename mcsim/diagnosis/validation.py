"""Predict and measure how far chi^2 falls on held-out data once a fitted effect is in the simulator."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.null_ensemble import NullEnsemble
from mcsim.stats.gaussian import Fit, SimulatedGaussian

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """Hold a number with its standard deviation."""

    value: float
    sigma: float


@dataclass(frozen=True)
class Shrink:
    """Hold the excess chi^2 before and after, its fractional reduction, and the p-value of what is left."""

    before: Measured
    after: Measured
    fraction: Measured
    probability_after: float


@dataclass(frozen=True)
class Prediction:
    """Hold the expected fall of chi^2, and the fraction of the excess that this is."""

    delta_chi2: Measured
    fraction: Measured


@dataclass(frozen=True)
class Halves:
    """Split the data vector into two parts with independent noise: one is fitted, the other one judges.

    Attributes
    ----------
    x
        Data, shape (p,).
    used, fresh
        Null distributions of the elements of fold 0, which are fitted, and of fold 1.
    first, second
        These elements.
    """

    x: Vector
    used: SimulatedGaussian
    fresh: SimulatedGaussian
    first: NDArray[np.int64]
    second: NDArray[np.int64]

    @classmethod
    def of(cls, ensemble: NullEnsemble, x: Vector) -> "Halves | None":
        """Split by the folds of the elements; None if one has no element."""
        folds = np.array([-1 if element.fold is None else element.fold for element in ensemble.elements])
        first, second = np.flatnonzero(folds == 0), np.flatnonzero(folds == 1)
        if not len(first) or not len(second):
            return None
        return cls(x, ensemble.restrict(first).gaussian, ensemble.restrict(second).gaussian, first, second)

    def expected_snr(self, change: Vector) -> float:
        """Return the smaller one of the signal-to-noise ratios of a change in the two parts."""
        return min(self.used.expected_snr(change[self.first]), self.fresh.expected_snr(change[self.second]))

    def reduction(
        self, t: Matrix, respond: Callable[[Fit], Vector], scatters: Sequence[Matrix] = ()
    ) -> tuple[Prediction, Shrink]:
        """Fit templates to one part, freeze the amplitudes, and measure the reduction of the excess in the other.

        Parameters
        ----------
        t
            Templates, shape (p, K).
        respond
            Returns the response of the data vector to the frozen fit, shape (p,).
        scatters
            Deviations of stochastic responses from their mean, shape (p, draws) each.
        """
        t_used, t_fresh = t[self.first], t[self.second]
        x_used, x_fresh = self.x[self.first], self.x[self.second]
        frozen = self.used.with_extra_covariance(*(one[self.first] for one in scatters)).fit(x_used, t_used)
        after = self.fresh.shift(self.fresh.mean + respond(frozen)[self.second])
        after = after.with_extra_covariance(*(one[self.second] for one in scatters))
        if scatters:
            response = t @ frozen.amplitudes
            shared = SharedDraw(
                excess(self.used, x_used),
                _squares(self.fresh, response, scatters, self.second),
                _squares(self.used, response, scatters, self.first),
            )
            expected = carried(self.fresh, after, x_fresh, t_fresh, self.used.fit(x_used, t_used).covariance, shared)
        else:
            expected = predicted(self.fresh, x_fresh, t_fresh, frozen.amplitudes, frozen.covariance)
        return expected, achieved(self.fresh, after, x_fresh)


def _squares(null: SimulatedGaussian, response: Vector, scatters: Sequence[Matrix], rows: NDArray[np.int64]) -> Vector:
    """Return the squared signal-to-noise ratios of the draws of a response."""
    deviations = np.sum([np.sqrt(scatter.shape[1]) * scatter for scatter in scatters], axis=0)
    return np.array([null.expected_snr(draw) ** 2 for draw in (response + deviations.T)[:, rows]])


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


def predicted(test: SimulatedGaussian, x: Vector, t: Matrix, amplitudes: Vector, covariance: Matrix) -> Prediction:
    """Return the fall of chi^2 to expect on data that were not fitted.

    Parameters
    ----------
    test, x
        Null distribution and data that judge, shape (p_test,).
    t
        Templates of the frozen amplitudes in these data, shape (p_test, K).
    amplitudes, covariance
        From the fit to other data, shape (K,), (K, K).

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
    return _of_excess(Measured(delta_chi2, float(np.sqrt(variance))), excess(test, x))


@dataclass(frozen=True)
class SharedDraw:
    """Hold what data that were fitted say of a random response that other data share.

    Attributes
    ----------
    seen
        Excess chi^2 of the data that were fitted.
    here, there
        Squared signal-to-noise ratios of draws of the response in the data that judge, and in those that were fitted,
        shape (draws,).
    """

    seen: Measured
    here: Vector
    there: Vector


def carried(
    test: SimulatedGaussian, wide: SimulatedGaussian, x: Vector, t: Matrix, covariance: Matrix, shared: SharedDraw
) -> Prediction:
    """Return the fall of chi^2 to expect for a stochastic effect: all data see the same draw.

    Parameters
    ----------
    test, x, t
        As in :func:`predicted`.
    wide
        Null distribution of the same data with the scatter of the effect.
    covariance
        Of the frozen amplitudes, from noise alone, shape (K, K).
    shared
        What the fitted data say of the draw.

    Notes
    -----
    The fall is the excess of the fitted data times the ratio of the mean squares, less tr(F V) for the error of the
    frozen amplitudes, F of the wide distribution. How closely the squares of a draw keep to that ratio is part of its
    error.
    """
    share = float(np.mean(shared.here) / np.mean(shared.there))
    white = wide.whiten_templates(t)
    lost = wide.hartlap_factor * float(np.trace(white.T @ white @ covariance))
    sigma = float(np.hypot(share * shared.seen.sigma, np.std(shared.here - share * shared.there, ddof=1)))
    return _of_excess(Measured(share * shared.seen.value - lost, sigma), excess(test, x))


def _of_excess(delta_chi2: Measured, before: Measured) -> Prediction:
    fraction = delta_chi2.value / before.value
    sigma = float(np.hypot(delta_chi2.sigma, fraction * before.sigma)) / abs(before.value)
    return Prediction(delta_chi2, Measured(fraction, sigma))


def achieved(before: SimulatedGaussian, after: SimulatedGaussian, x: NDArray[np.float64]) -> Shrink:
    """Return the reduction of the excess chi^2 of data, shape (p_raw,), from one null distribution to another.

    Notes
    -----
    A = 1 - G1/G0. Both excesses have the same noise e of the data: with d = true mean - mean before and D = mean after
    - mean before, dA = (2 (D - A d).e - A (e'e - p))/G0, hence var A = (4 |D - A d|^2 + 2 p A^2)/G0^2, to which the
    errors of the covariances add 2 ((p + G1)^2 + (1 - A)^2 (p + G0)^2)/(d2 - 4)/G0^2. Pulls: tests/statistical.
    """
    first, last = excess(before, x), excess(after, x)
    fraction = 1.0 - last.value / first.value
    p, d2 = before.dimension, before.dof - before.dimension + 1
    shift = before.whiten_templates((after.mean - before.mean)[:, None])[:, 0]
    distance, length = max(first.value, 0.0), max(last.value, 0.0)
    # The error of the two means adds to the square of their difference.
    moved = max(before.hartlap_factor * float(shift @ shift) - p * (1.0 / before.n_sims + 1.0 / after.n_sims), 0.0)
    along = before.hartlap_factor * float(shift @ before.whiten(x))
    mismatch = max(moved - 2.0 * fraction * along + fraction**2 * distance, 0.0)
    data = (4.0 * mismatch + 2.0 * p * fraction**2) * (d2 - 2) / (d2 - 4)
    scatter = 2.0 * ((p + length) ** 2 + (1.0 - fraction) ** 2 * (p + distance) ** 2) / (d2 - 4)
    sigma = float(np.sqrt(data + scatter)) / abs(first.value)
    return Shrink(first, last, Measured(fraction, sigma), after.pvalue(x))
