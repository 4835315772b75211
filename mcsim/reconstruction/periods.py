"""Periods that nobody named: a periodogram of residuals along the scan, its largest peak, and what the choice costs.

A wave in the time line of a channel is a mean over the samples of every pixel in its maps, and its score is the sum of
residuals times these means. For all frequencies at once that is the Fourier transform of the residuals as the scan
meets them, each over the number of samples of its pixel, summed over short spans of time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import next_fast_len, rfft
from scipy.sparse import csr_matrix

from mcsim.reconstruction.choices import Choice
from mcsim.support.arrays import Map, Vector

SHORTEST_S = 900.0  #: period; the phases of a spin, which are faster, have words of their own
FEWEST = 5  #: cycles in the survey; slower waves have words of their own
SPANS = 3  #: spans of time of the shortest period, at least
PADDING = 2  #: frequencies of the periodogram for each independent one, at least
DRAWS = 200  #: of white noise, from which the variance at every frequency is known to 7 %


@dataclass(frozen=True, eq=False)
class TimeLine:
    """Describe when the maps of a channel are observed."""

    #: share of the samples of each pixel that each span of time has, shape (spans, npix), of every map
    visits: tuple[csr_matrix, ...]
    span_s: float
    variance: Mapping[str, Vector]  #: of noise in the periodogram of what is added and of gains, by what they act on

    @classmethod
    def of(cls, visits: tuple[csr_matrix, ...], span_s: float, weights: Mapping[str, Sequence[Map]]) -> "TimeLine":
        """Return the time line of maps; ``weights``: variance of the products of every map, by what waves act on."""
        bare, draw = cls(visits, span_s, {}), np.random.default_rng(0x6D63)
        variance = {}
        for on, each in weights.items():
            noise = ([np.sqrt(one) * draw.normal(size=one.size) for one in each] for _ in range(DRAWS))
            variance[on] = np.mean([bare.power(one) for one in noise], axis=0)
        return cls(visits, span_s, variance)

    @property
    def duration_s(self) -> float:
        """Return the duration of the survey, seconds, in whole spans."""
        return self.visits[0].shape[0] * self.span_s

    @property
    def tried(self) -> float:
        """Return the number of independent frequencies among which a peak is chosen."""
        return self.duration_s / (SPANS * self.span_s) - FEWEST

    @property
    def _padded(self) -> int:
        return int(next_fast_len(PADDING * self.visits[0].shape[0], real=True))

    def power(self, products: Sequence[Map]) -> Vector:
        """Return the power of products of residuals, shape (npix,) each, at frequencies k / (padded duration)."""
        line = sum(visit @ one for visit, one in zip(self.visits, products, strict=True))
        return np.asarray(np.abs(rfft(line, self._padded)) ** 2)

    def history(self, split: int, product: Map, parts: int) -> Vector:
        """Return the score of a constant in each of so many equal parts of the survey's time, of one map, (parts,)."""
        line = self.visits[split] @ product
        starts = np.linspace(0, len(line), parts, endpoint=False).astype(int)
        spans = np.diff(starts, append=len(line))  # a part of fewer than one has nothing, and not that of the next
        return np.where(spans > 0, np.add.reduceat(line, starts), 0.0)

    def peak(self, on: str, products: Sequence[Map]) -> Choice:
        """Return the period of the largest peak between FEWEST cycles in the survey and the shortest period.

        The fall of chi^2 is twice the power over its mean in noise.
        Its place between frequencies is the top of a parabola through the logarithm of three of them.
        """
        step = 1.0 / (self._padded * self.span_s)
        first, last = (round(f / step) for f in (FEWEST / self.duration_s, 1.0 / (SPANS * self.span_s)))
        power = self.power(products)
        ratio = power[first : last + 1] / self.variance[on][first : last + 1]
        best = first + int(np.argmax(ratio))
        before, here, after = np.log(power[best - 1 : best + 2])
        curved = before - 2.0 * here + after
        between = 0.5 * (before - after) / curved if curved < 0.0 else 0.0
        place = best + float(np.clip(between, -0.5, 0.5))
        return Choice(f"period {float(1.0 / (step * place))!r}", float(2.0 * ratio[best - first]))
