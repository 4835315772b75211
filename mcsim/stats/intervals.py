"""Estimate shares, means, widths and ratios with 95 % intervals, and compare them with targets."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special, stats
from scipy.optimize import minimize

from mcsim.support.arrays import Vector

POWER = 0.9  #: share of the cases of an S/N that are found where it counts as reached


@dataclass(frozen=True)
class Metric:
    """A measured number with its 95 % interval, and a target.

    ``count`` is the number of cases; value and ends of the interval are NaN where that is too small. The target is
    in words, "" if there is none; ``met`` is None if there is none, or too few cases. ``near`` is True if the interval
    reaches a target that the value does not meet.
    """

    name: str
    count: int
    value: float = np.nan
    low: float = np.nan
    high: float = np.nan
    target: str = ""
    met: bool | None = None
    near: bool = False

    def against(self, target: str, met: bool) -> "Metric":
        """Return the metric with a target and whether it is met, which is not known where there is no value."""
        return replace(self, target=target, met=bool(met) if np.isfinite(self.value) else None)

    def within(self, target: str, low: float = -np.inf, high: float = np.inf) -> "Metric":
        """Return the metric with a target that is met if the value is in a range."""
        found = self.against(target, low <= self.value <= high)
        return replace(found, near=found.met is False and self.low <= high and self.high >= low)


def binomial_interval(k: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of Clopper & Pearson (Biometrika 26, 404, 1934) for k of n cases."""
    if n == 0:
        return 0.0, 1.0
    found = stats.binomtest(k, n).proportion_ci(0.95, method="exact")
    return float(found.low), float(found.high)


def share(name: str, hits: Sequence[bool] | NDArray[np.bool_]) -> Metric:
    """Return the share of cases that are hits, with its exact binomial interval."""
    k, n = int(np.sum(hits)), len(hits)
    return Metric(name, n, k / n if n else np.nan, *binomial_interval(k, n))


def pulls(fitted: ArrayLike, true: ArrayLike, errors: ArrayLike) -> tuple[float, ...]:
    """Return fitted less true components over their errors, without components that the data do not constrain."""
    difference, sigma = np.asarray(fitted) - np.asarray(true), np.asarray(errors)
    return tuple(float(value) for value in difference[sigma > 0.0] / sigma[sigma > 0.0])


def mean(name: str, values: Sequence[float] | Vector) -> Metric:
    """Return the mean of at least two values, with its Student interval of at least three: of two it says nothing."""
    n = len(values)
    if n < 2:
        return Metric(name, n)
    value = float(np.mean(values))
    if n < 3:
        return Metric(name, n, value)
    low, high = value + stats.sem(values) * stats.t.ppf((0.025, 0.975), n - 1)
    return Metric(name, n, value, float(low), float(high))


def width(name: str, values: Sequence[float] | Vector) -> Metric:
    """Return the standard deviation of at least three values, with its bootstrap interval."""
    return _bootstrapped(name, lambda x, axis=-1: np.std(x, ddof=1, axis=axis), values)


def ratio(name: str, x: Sequence[float] | Vector, y: Sequence[float] | Vector) -> Metric:
    """Return sum y/sum x of at least three cases, with its bootstrap interval.

    It is the slope of y = k x where both are noisy: the noise of x would flatten that of least squares, and the mean of
    single ratios does not exist where x can be compatible with zero.
    """
    return _bootstrapped(name, lambda x, y, axis=-1: np.sum(y, axis=axis) / np.sum(x, axis=axis), x, y)


def removed(name: str, before_after: Sequence[tuple[float, float]]) -> Metric:
    """Return the share of an excess, before and after, that is gone: 1 - sum after/sum before."""
    found = ratio(name, *np.reshape(before_after, (-1, 2)).T)
    return replace(found, value=1.0 - found.value, low=1.0 - found.high, high=1.0 - found.low)


def _bootstrapped(name: str, statistic: Callable[..., Any], *samples: ArrayLike, resampled: int = 1000) -> Metric:
    """Return a statistic of at least three cases, with its percentile interval over resampled cases."""
    arrays = [np.asarray(sample, dtype=float) for sample in samples]
    n, draw = len(arrays[0]), np.random.default_rng(0)
    if n < 3:
        return Metric(name, n)
    low, high = stats.bootstrap(
        arrays, statistic, n_resamples=resampled, paired=True, method="percentile", random_state=draw
    ).confidence_interval
    return Metric(name, n, float(statistic(*arrays)), float(low), float(high))


def snr_at_power(name: str, strengths: Vector, found: NDArray[np.bool_], unit: float = 1.0) -> Metric:
    """Return the S/N, over ``unit``, at which effects are found with POWER: probit regression on the S/N.

    With its bootstrap interval; NaN where there are fewer than 20 cases, or all or none are found.
    """
    if len(strengths) < 20 or found.all() or not found.any():
        return Metric(name, len(strengths))

    def solved(s: Vector, hit: Vector) -> float:
        if hit.all() or not hit.any():  # of resampled cases: the S/N is outside the drawn ones
            return float(s.min() if hit.all() else s.max()) / unit
        sign = np.where(hit, 1.0, -1.0)

        def loss(parameters: Vector) -> float:
            return -float(np.sum(special.log_ndtr(sign * (np.exp(parameters[1]) * (s - parameters[0])))))

        best = minimize(loss, np.array([np.median(s[hit == 0]) + 1.0, 0.0]), method="Nelder-Mead").x
        return float(best[0] + special.ndtri(POWER) * np.exp(-best[1])) / unit

    return _bootstrapped(name, solved, strengths, found, resampled=100)
