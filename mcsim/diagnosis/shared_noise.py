"""Tell noise that maps have in common: all effects of the library leave the noise of two maps independent.

Cross powers of residuals show it at all degrees alike. With n_a and n_b the noise of two maps, of correlation r, any
number that is quadratic in the maps changes on average by r times what the parts of n_a and n_b that are the same noise
make by their products. This response is simulated without a sky: the mean over signs of both of s t f(s n_a + t n_b).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, combinations_with_replacement, product

import healpy
import numpy as np
from scipy import stats

from mcsim.bipolar import by_degree
from mcsim.datavector.analysis import Analysis
from mcsim.datavector.wiener_filter import wiener_filter
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.sphere import rng
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.support.arrays import Map, Matrix, Vector
from mcsim.support.numbers import measured, p_equals

LEVEL = 1e-4  #: p-value up to which the noise of two maps, of all pairs, is correlated
NEARLY = 3.0  #: standard deviations of some power of residuals from which on correlations are fitted
FAINT = 2.0  #: standard errors of a correlation up to which it is taken for none
DRAWS = 2  #: least number of draws of noise over which a response is averaged


@dataclass(frozen=True)
class SharedNoise:
    """Describe the pairs of maps, by their numbers, whose noise is correlated, and how well that fits the data."""

    pairs: tuple[tuple[int, int], ...]
    correlations: Vector  # of each pair
    errors: Vector
    pvalue: float  # of what is left of the data vector

    def sentence(self, names: Sequence[str]) -> str:
        """Return what is found in maps of these names."""
        each = zip(self.pairs, self.correlations, self.errors, strict=True)
        found = [f"{names[a]} and {names[b]} (correlation {measured(float(r), float(s))})" for (a, b), r, s in each]
        return (
            f"The model fits ({p_equals(self.pvalue)}) with noise in common, or a signal as white as noise: "
            f"{', '.join(found)}."
        )


def shared_noise(context: DiagnosisContext, x: Vector, bipolar_scan: Vector) -> SharedNoise | None:
    """Return the noise in common that explains data vector and cross powers of residuals; None if none does.

    Correlations of all pairs of maps are fitted to the powers together, of which the simulations of the bipolar scan
    tell the scatter: those of the highest ranges of degrees, of so many as these suffice for. What of them is FAINT is
    left out of the fit to the data vector.
    """
    analysis, drawn, level = context.analysis, context.ensemble.bipolar_scan, context.settings.residual_level
    parts = range(len(analysis.model.parts))
    each = list(combinations_with_replacement(parts, 2))
    pairs = [pair for pair in combinations(parts, 2) if _white(analysis, pair)]
    found = [number for number, one in enumerate(analysis.bipolar_scan.elements) if one.kind == "cross"]
    ranges = min(len(found) // len(each), len(drawn) // (2 * len(each)))
    if not (ranges and pairs):
        return None
    rows = np.reshape(found, (len(each), -1))[:, -ranges:].ravel()
    null, y = SimulatedGaussian.from_simulations(drawn[:, rows]), bipolar_scan[rows]
    z = np.abs(y - null.mean) / drawn[:, rows].std(axis=0)
    if z.max() < NEARLY:
        return None
    ends = [analysis.bipolar_scan.elements[row].ell or (0, -1) for row in rows[:ranges]]
    fit = null.fit(y, _responses_of_powers(analysis, pairs, ends))
    size = np.abs(fit.amplitudes) / np.maximum(fit.errors, 1e-300)
    certain = 2.0 * stats.t.sf(size * np.sqrt(fit.dof / (fit.dof - 2.0)), fit.dof) * len(pairs) <= LEVEL
    if not certain.any() or fit.pvalue <= level:
        return None
    taken = np.flatnonzero(certain | (size > FAINT))
    t = np.stack([_response(analysis, pairs[number]) for number in taken], axis=1)
    whole = context.null.fit(x, t)
    if whole.pvalue <= level:
        return None
    both = np.array([[fit.amplitudes[taken], fit.errors[taken]], [whole.amplitudes, whole.errors]])
    better = both[np.argmin(both[:, 1], axis=0), :, np.arange(len(taken))][certain[taken]]
    told = tuple(pairs[number] for number in np.flatnonzero(certain))
    return SharedNoise(told, better[:, 0], better[:, 1], whole.pvalue)


def _white(analysis: Analysis, pair: tuple[int, int]) -> bool:
    """Return True if both maps have white noise, before any preparation."""
    maps = [analysis.model.survey.making.maps[number] for number in pair]
    return all(one.noise_uk is not None and one.drawn is None for one in maps)


def _responses_of_powers(
    analysis: Analysis, pairs: Sequence[tuple[int, int]], ranges: Sequence[tuple[int, int]]
) -> Matrix:
    """Return the response of all powers of residuals to the correlation of the noise of each pair, (powers, pairs)."""
    model, count = analysis.model, len(analysis.model.parts)
    found = np.zeros((count * (count + 1) // 2, len(ranges), len(pairs)))
    for unit in _units(analysis):
        # The residuals of all maps by the noise of one, which a preparation may add something to.
        up, down = ([wiener_filter(model, _noise(analysis, {a: sign}, unit)) for a in range(count)] for sign in (1, -1))
        own = [0.5 * (one.adjoint - other.adjoint) for one, other in zip(up, down, strict=True)]
        for (row, (i, j)), (column, (a, b)) in product(
            enumerate(combinations_with_replacement(range(count), 2)), enumerate(pairs)
        ):
            power = by_degree(own[a][i], own[b][j], model.lmax) + by_degree(own[b][i], own[a][j], model.lmax)
            found[row, :, column] += [power[low : high + 1].sum() for low, high in ranges]
    return found.reshape(-1, len(pairs)) / _draws(analysis)


def _response(analysis: Analysis, pair: tuple[int, int]) -> Vector:
    """Return the response of the data vector to the correlation of two maps' noise."""
    found = np.zeros(len(analysis.elements))
    for unit, one, other in product(_units(analysis), (1, -1), (1, -1)):
        found += one * other * analysis.data_vector(_noise(analysis, dict(zip(pair, (one, other), strict=True)), unit))
    return found / (4.0 * _draws(analysis))


def _draws(analysis: Analysis) -> int:
    """Return the number of draws of noise over which responses are averaged."""
    return max(DRAWS, -(-analysis.settings.response_modes // (analysis.model.lmax + 1) ** 2))


def _units(analysis: Analysis) -> Iterator[Map]:
    """Yield draws of noise of unit variance in the pixels in which maps are made."""
    survey = analysis.model.survey
    for draw in range(_draws(analysis)):
        noise = rng.generator(survey.config.ensemble.seed, draw, "noise in common")
        yield noise.standard_normal(12 * survey.making.nside**2)


def _noise(analysis: Analysis, factors: dict[int, int], unit: Map) -> list[Map]:
    """Return prepared maps of the same noise of unit variance, times these factors, and else of nothing."""
    found = []
    for number, one in enumerate(analysis.model.survey.making.maps):
        noise = np.zeros(unit.size) if one.noise_uk is None else factors.get(number, 0) * one.noise_uk * unit
        observed = np.where(one.moments.hits > 0, noise, healpy.UNSEEN)
        found.append(observed if one.preparation is None else one.preparation.apply(observed))
    return found
