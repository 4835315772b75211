"""How far a gap shrinks once an effect with a frozen amplitude is in the simulator: expected and measured."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mcsim.stats.gaussian import SimulatedGaussian


@dataclass(frozen=True)
class Measured:
    """A number with its standard deviation."""

    value: float
    sigma: float


@dataclass(frozen=True)
class Shrink:
    """Gap before and after, the attributable fraction, and the probability of what is left."""

    before: Measured
    after: Measured
    fraction: Measured
    probability_after: float


@dataclass(frozen=True)
class Prediction:
    """Expected fall of the gap, and the fraction of the gap that this is."""

    delta_chi2: Measured
    fraction: Measured


def excess(null: SimulatedGaussian, x: NDArray[np.float64]) -> Measured:
    """Gap G of evidence, shape (p_raw,): its white square above expectation; see :func:`excess_of`."""
    return excess_of(null.chi2(x), null.dimension, null.dof)


def excess_of(chi2: float, p: int, n: int) -> Measured:
    """Gap G of a white square in p dimensions, whitened by a scatter of n degrees of freedom.

    Notes
    -----
    (n - p - 1)/n chi2 - p, whose mean is the true squared distance lambda of the means, and whose variance that of a
    noncentral F: 2 ((p + lambda)^2 + (p + 2 lambda)(d - 2))/(d - 4), d = n - p + 1. sigma takes G for lambda.
    """
    value = (n - p - 1) / n * chi2 - p
    length, d = max(value, 0.0), n - p + 1
    return Measured(value, float(np.sqrt(2.0 * ((p + length) ** 2 + (p + 2.0 * length) * (d - 2)) / (d - 4))))


def predicted(
    test: SimulatedGaussian,
    x: NDArray[np.float64],
    t: NDArray[np.float64],
    amplitudes: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> Prediction:
    """Shrink to expect on data that the fit did not use.

    Parameters
    ----------
    test, x
        Null and evidence that measure the shrink, shape (p_test,).
    t
        Templates of the frozen parameters in that evidence, shape (p_test, K).
    amplitudes, covariance
        From the fit to other data, shape (K,), (K, K).

    Notes
    -----
    Frozen at theta^ = theta + e, the drop on fresh data is 2 theta'F theta^ - theta^'F theta^ on average, whose
    unbiased estimate from the fit is theta^'F theta^ - 2 tr(F V); tr(F V) = K where both data are equally good. sigma
    of the drop is its error as a forecast of the mean drop on fresh data: 2 sqrt(theta^'F V F theta^ + tr(F V F V)).
    """
    white = test.whiten_templates(t)
    fisher = test.unbiased * white.T @ white
    product = fisher @ covariance
    delta_chi2 = float(amplitudes @ fisher @ amplitudes) - 2.0 * float(np.trace(product))
    variance = 4.0 * float(amplitudes @ product @ fisher @ amplitudes) + 4.0 * float(np.trace(product @ product))
    return _of_gap(Measured(delta_chi2, float(np.sqrt(variance))), excess(test, x))


def carried(
    test: SimulatedGaussian,
    wide: SimulatedGaussian,
    x: NDArray[np.float64],
    t: NDArray[np.float64],
    covariance: NDArray[np.float64],
    seen: Measured,
    here: NDArray[np.float64],
    there: NDArray[np.float64],
) -> Prediction:
    """Shrink to expect where what acts draws at random: all data see the same draw, whatever the mean response.

    Parameters
    ----------
    test, x, t
        As in :func:`predicted`.
    wide
        Null of the same data with the scatter of what is drawn.
    covariance
        Of the frozen parameters, from noise alone, shape (K, K).
    seen
        Gap of the data that were fitted.
    here, there
        White squares of draws of the response in the data that measure the shrink, and in those that were fitted,
        shape (draws,).

    Notes
    -----
    The drop is the gap of the fitted data times the ratio of the mean squares, less tr(F V) for the error of the frozen
    parameters, F in the wide null that measures what is left. How closely the squares of a draw keep to that ratio is
    part of its error.
    """
    share = float(np.mean(here) / np.mean(there))
    white = wide.whiten_templates(t)
    lost = wide.unbiased * float(np.trace(white.T @ white @ covariance))
    sigma = float(np.hypot(share * seen.sigma, np.std(here - share * there, ddof=1)))
    return _of_gap(Measured(share * seen.value - lost, sigma), excess(test, x))


def _of_gap(delta_chi2: Measured, before: Measured) -> Prediction:
    fraction = delta_chi2.value / before.value
    sigma = float(np.hypot(delta_chi2.sigma, fraction * before.sigma)) / abs(before.value)
    return Prediction(delta_chi2, Measured(fraction, sigma))


def achieved(before: SimulatedGaussian, after: SimulatedGaussian, x: NDArray[np.float64]) -> Shrink:
    """Shrink of the gap of evidence, shape (p_raw,), between two ensembles of independent simulations.

    Notes
    -----
    A = 1 - G1/G0. Both gaps have the same noise e of the data: with d = true mean - mean before and D = mean after -
    mean before, dA = (2 (D - A d).e - A (e'e - p))/G0, hence var A = (4 |D - A d|^2 + 2 p A^2)/G0^2, to which the
    scatters add 2 ((p + G1)^2 + (1 - A)^2 (p + G0)^2)/(d2 - 4)/G0^2. Pulls: tests/statistical.
    """
    first, last = excess(before, x), excess(after, x)
    fraction = 1.0 - last.value / first.value
    p, d2 = before.dimension, before.dof - before.dimension + 1
    shift = before.whiten_templates((after.mean - before.mean)[:, None])[:, 0]
    distance, length = max(first.value, 0.0), max(last.value, 0.0)
    # The error of the two means adds to the square of their difference.
    moved = max(before.unbiased * float(shift @ shift) - p * (1.0 / before.count + 1.0 / after.count), 0.0)
    along = before.unbiased * float(shift @ before.whiten(x))
    mismatch = max(moved - 2.0 * fraction * along + fraction**2 * distance, 0.0)
    data = (4.0 * mismatch + 2.0 * p * fraction**2) * (d2 - 2) / (d2 - 4)
    scatter = 2.0 * ((p + length) ** 2 + (1.0 - fraction) ** 2 * (p + distance) ** 2) / (d2 - 4)
    sigma = float(np.sqrt(data + scatter)) / abs(first.value)
    return Shrink(first, last, Measured(fraction, sigma), after.pvalue(x))
