"""Tell noise that maps have in common: all effects of the library leave the noise of two maps independent.

Cross powers of residuals show it at all degrees alike. With n_a and n_b the noise of two maps, of correlation r, any
number that is quadratic in the maps changes on average by r times what the parts of n_a and n_b that are the same noise
make by their products. This response is simulated without a sky: the mean over signs of both of s t f(s n_a + t n_b).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, combinations_with_replacement, compress, product

import healpy
import numpy as np
from scipy import stats

from mcsim.bipolar import by_degree
from mcsim.datavector.analysis import Analysis
from mcsim.datavector.wiener_filter import wiener_filter
from mcsim.sphere import rng
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.support.arrays import Map, Matrix, Rows, Vector
from mcsim.support.numbers import measured, p_equals

LEVEL = 1e-4  #: p-value up to which the noise of two maps, of all pairs, is correlated
NEARLY = 3.0  #: standard deviations of some power of residuals from which on correlations are fitted
FAINT = 2.0  #: standard errors of a correlation up to which it is taken for none
DRAWS = 2  #: least number of draws of noise over which a response is averaged


@dataclass(frozen=True, eq=False)
class CrossPowers:
    """Hold what correlations of the noise of maps do to the cross powers of residuals, for all data of a model.

    ``drawn``, shape (simulations, numbers), are its simulations of the bipolar scan.
    """

    analysis: Analysis
    drawn: Matrix

    @cached_property
    def white(self) -> list[int]:
        """Return the maps, by number, that have white noise, before any preparation."""
        maps = enumerate(self.analysis.model.survey.making.maps)
        return [number for number, one in maps if one.noise_uk is not None and one.drawn is None]

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """Return the pairs of these maps."""
        return list(combinations(self.white, 2))

    @cached_property
    def rows(self) -> Rows:
        """Return the numbers of the scan that are powers of residuals, shape (map by map, ranges of degrees).

        They are the highest ranges, of so many as the simulations suffice for.
        """
        each = len(list(combinations_with_replacement(self.analysis.model.parts, 2)))
        powers = [number for number, one in enumerate(self.analysis.bipolar_scan.elements) if one.kind == "cross"]
        found = np.array(powers, dtype=np.int64).reshape(each, -1)
        ranges = min(found.shape[1], len(self.drawn) // (2 * each))
        return found[:, found.shape[1] - ranges :]

    @cached_property
    def null(self) -> SimulatedGaussian:
        """Return the distribution of these powers."""
        return SimulatedGaussian.from_simulations(self.simulations)

    @cached_property
    def simulations(self) -> Matrix:
        """Return these powers of the simulations, shape (simulations, powers)."""
        return self.drawn[:, self.rows.ravel()]

    def depart(self, powers: Vector) -> bool:
        """Return True if some power is so far from the simulations that noise is worth fitting."""
        return bool(np.max(np.abs(powers - self.null.mean) / self.simulations.std(axis=0)) >= NEARLY)

    @cached_property
    def responses(self) -> Matrix:
        """Return their responses to the correlation of each pair, shape (powers, pairs)."""
        return self._responses(self.pairs)

    @cached_property
    def levels(self) -> Matrix:
        """Return their responses to half the change of the variance of each map's noise, shape (powers, maps)."""
        return self._responses([(number, number) for number in self.white])

    def _responses(self, pairs: Sequence[tuple[int, int]]) -> Matrix:
        elements = self.analysis.bipolar_scan.elements
        return _responses_of_powers(self.analysis, pairs, [elements[row].ell or (0, -1) for row in self.rows[0]])


def shared_noise(
    powers: CrossPowers, null: SimulatedGaussian, level: float, x: Vector, bipolar_scan: Vector
) -> str | None:
    """Return a sentence on noise in common that explains data vector and cross powers of residuals; None if none does.

    Correlations of all pairs of maps are fitted to the powers together. What of them is FAINT is left out of the fit to
    the data vector, of the distribution ``null``. Fits have a p-value above ``level``.
    """
    if not (powers.rows.size and powers.pairs):
        return None
    y = bipolar_scan[powers.rows.ravel()]
    if not powers.depart(y):
        return None
    fit = powers.null.fit(y, powers.responses)
    size = np.abs(fit.amplitudes) / np.maximum(fit.errors, 1e-300)
    p = 2.0 * stats.t.sf(size * np.sqrt(fit.dof / (fit.dof - 2.0)), fit.dof)
    certain = p * len(powers.pairs) <= LEVEL
    if not certain.any() or fit.pvalue <= level:
        return None
    taken = np.flatnonzero(certain | (size > FAINT))
    t = np.stack([_response(powers.analysis, powers.pairs[number]) for number in taken], axis=1)
    whole = null.fit(x, t)
    if whole.pvalue <= level:
        return None
    both = np.array([[fit.amplitudes[taken], fit.errors[taken]], [whole.amplitudes, whole.errors]])
    better = both[np.argmin(both[:, 1], axis=0), :, np.arange(len(taken))][certain[taken]]
    names = [part.name for part in powers.analysis.model.parts]
    found = [
        f"{names[a]} and {names[b]} (correlation {measured(float(r), float(sigma))})"
        for (a, b), (r, sigma) in zip(compress(powers.pairs, certain), better, strict=True)
    ]
    fits = f"The model fits ({p_equals(whole.pvalue)}) with noise in common, or a signal as white as noise"
    return f"{fits}: {', '.join(found)}."


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
        yield noise.standard_normal(survey.making.maps[0].moments.npix)


def _noise(analysis: Analysis, factors: dict[int, int], unit: Map) -> list[Map]:
    """Return prepared maps of the same noise of unit variance, times these factors, and else of nothing."""
    found = []
    for number, one in enumerate(analysis.model.survey.making.maps):
        noise = np.zeros(unit.size) if one.noise_uk is None else factors.get(number, 0) * one.noise_uk * unit
        observed = np.where(one.moments.hits > 0, noise, healpy.UNSEEN)
        found.append(observed if one.preparation is None else one.preparation.apply(observed))
    return found
