"""Numbers with their intervals: shares, means, widths, powers, slopes."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import brentq, minimize

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Figure:
    """A measured figure.

    Attributes
    ----------
    name, value, low, high, count
        What it is, its value, its 95 % interval, and of how many cases; not a number where there are none.
    target
        What is to be reached, in words; "" where nothing is.
    met
        Whether it is; None where that cannot be said: nothing is asked, or no case.
    """

    name: str
    value: float
    low: float
    high: float
    count: int
    target: str = ""
    met: bool | None = None

    def judged(self, met: bool) -> "Figure":
        """With the target met or not; where there is no value, that cannot be said."""
        return replace(self, met=bool(met) if np.isfinite(self.value) else None)

    def plain(self) -> dict[str, Any]:
        """For JSON, None in place of what is no number."""
        return {
            key: None if isinstance(value, float) and not np.isfinite(value) else value
            for key, value in asdict(self).items()
        }


def share(
    name: str, hits: Sequence[bool], target: str = "", least: float | None = None, max_amplitude: float | None = None
) -> Figure:
    """Share of cases, with the interval of Clopper & Pearson (Biometrika 26, 404, 1934)."""
    k, n = int(sum(hits)), len(hits)
    low, high = binomial(k, n)
    value = k / n if n else np.nan
    met = None
    if n and (least is not None or max_amplitude is not None):
        met = bool((least is None or value >= least) and (max_amplitude is None or value <= max_amplitude))
    return Figure(name, value, low, high, n, target, met)


def nominal(name: str, hits: Sequence[bool], value: float, target: str) -> Figure:
    """Share of cases, which is met where ``value`` is within its interval."""
    found = share(name, hits)
    met = bool(found.low <= value <= found.high) if found.count else None
    return Figure(found.name, found.value, found.low, found.high, found.count, target, met)


def binomial(k: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """Interval of Clopper & Pearson for k of n."""
    tail = (1.0 - level) / 2.0
    low = float(stats.beta.ppf(tail, k, n - k + 1)) if k > 0 else 0.0
    high = float(stats.beta.ppf(1.0 - tail, k + 1, n - k)) if k < n else 1.0
    return low, high


def mean(name: str, values: Sequence[float], target: str = "", max_amplitude: float | None = None) -> Figure:
    """Mean, with its Student interval; met where its size is at most ``most``."""
    n = len(values)
    if n < 2:
        return Figure(name, np.nan, np.nan, np.nan, n, target)
    value = float(np.mean(values))
    half = float(stats.t.ppf(0.975, n - 1) * np.std(values, ddof=1) / np.sqrt(n))
    return Figure(
        name,
        value,
        value - half,
        value + half,
        n,
        target,
        None if max_amplitude is None else abs(value) <= max_amplitude,
    )


def width(name: str, values: Sequence[float], target: str = "", within: tuple[float, float] | None = None) -> Figure:
    """Standard deviation, with its interval from resampled cases; met where it lies ``within``."""
    n = len(values)
    if n < 3:
        return Figure(name, np.nan, np.nan, np.nan, n, target)
    value = float(np.std(values, ddof=1))
    resampled = np.random.default_rng(0).choice(np.asarray(values), (1000, n))
    low, high = np.quantile(resampled.std(axis=1, ddof=1), (0.025, 0.975))
    met = None if within is None else bool(within[0] <= value <= within[1])
    return Figure(name, value, float(low), float(high), n, target, met)


def slope(name: str, x: Vector, y: Vector, target: str, least: float, max_amplitude: float) -> Figure:
    """Slope of y = k x where both are noisy about their means: sum y/sum x, with its interval from resampled cases.

    Least squares would not do: the noise of x flattens its slope.
    """
    n = len(x)
    if n < 3:
        return Figure(name, np.nan, np.nan, np.nan, n, target)
    value = float(y.sum() / x.sum())
    rows = np.random.default_rng(0).integers(0, n, (1000, n))
    low, high = np.quantile(y[rows].sum(axis=1) / x[rows].sum(axis=1), (0.025, 0.975))
    return Figure(name, value, float(low), float(high), n, target, bool(least <= value <= max_amplitude))


def removed(name: str, gaps: Sequence[tuple[float, float]], target: str) -> Figure:
    """Share of the gaps, shape (n, 2), before and after, that is gone: 1 - sum after/sum before.

    Of the sums, with the interval of resampled cases: a gap in fresh data can be compatible with zero, and the mean of
    such ratios does not exist.
    """
    n = len(gaps)
    if n < 3:
        return Figure(name, np.nan, np.nan, np.nan, n, target)
    values = np.array(gaps)
    rows = np.random.default_rng(0).integers(0, n, (1000, n))
    drawn = values[rows].sum(axis=1)
    low, high = np.quantile(1.0 - drawn[:, 1] / drawn[:, 0], (0.025, 0.975))
    before, after = values.sum(axis=0)
    return Figure(name, float(1.0 - after / before), float(low), float(high), n, target)


def strength_at(strengths: Vector, found: NDArray[np.bool_], power: float = 0.9) -> tuple[float, float, float]:
    """Strength at which effects are found with a power, and its 95 % interval: a probit of the strength by likelihood.

    Not a number where all or none are found.
    """
    if len(strengths) < 20 or found.all() or not found.any():
        return np.nan, np.nan, np.nan

    def solved(rows: NDArray[np.int64]) -> float:
        s, hit = strengths[rows], found[rows]
        sign = np.where(hit, 1.0, -1.0)

        def loss(parameters: Vector) -> float:
            return -float(np.sum(stats.norm.logcdf(sign * (np.exp(parameters[1]) * (s - parameters[0])))))

        best = minimize(loss, np.array([np.median(s[~hit]) + 1.0, 0.0]), method="Nelder-Mead").x
        return float(best[0] + stats.norm.ppf(power) * np.exp(-best[1]))

    n = len(strengths)
    value = solved(np.arange(n))
    generator = np.random.default_rng(0)
    again = []
    for _ in range(100):
        rows = generator.integers(0, n, n)
        if found[rows].any() and not found[rows].all():
            again.append(solved(rows))
    low, high = np.quantile(again, (0.025, 0.975)) if again else (np.nan, np.nan)
    return value, float(low), float(high)


def strength_of(powers: Vector, strengths: Vector, power: float = 0.9) -> float:
    """Strength at which a rising curve of powers, shape (S,), reaches a power; not a number where it does not."""
    if powers[0] >= power or powers[-1] <= power:
        return float("nan")
    return float(brentq(lambda s: np.interp(s, strengths, powers) - power, strengths[0], strengths[-1]))
