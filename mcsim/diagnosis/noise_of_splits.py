"""Tell splits of a channel whose noise is not alike over that of the model: effects on noise act on all of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from scipy import stats

from mcsim.diagnosis.consistency import Comparison
from mcsim.diagnosis.shared_noise import LEVEL, CrossPowers
from mcsim.stats.gaussian import Fit, SimulatedGaussian
from mcsim.support.arrays import Vector
from mcsim.support.numbers import measured, p_equals

LEAST = 0.1  #: factor of the noise below which the scatter of powers is not followed


@dataclass(frozen=True)
class NoiseOfSplits:
    """Hold the standard deviation of the noise of each split of a channel over that of the model.

    ``pvalue`` is the probability that they are so different if all have the same factor.
    """

    channel: str
    splits: tuple[str, ...]
    factors: Vector
    errors: Vector
    pvalue: float

    @property
    def sentence(self) -> str:
        """Return the factors in words."""
        each = zip(self.splits, self.factors, self.errors, strict=True)
        told = ", ".join(f"{measured(float(factor), float(error))} in {split}" for split, factor, error in each)
        return (
            f"The splits of {self.channel} do not have the model's noise alike ({p_equals(self.pvalue)}): its standard "
            f"deviation is {told} times that of the model. An effect on the noise of a channel is the mean of its "
            "splits; split_noise gives each split of a model noise of its own."
        )

    def compared(self, factor: float) -> Comparison:
        """Return the comparison of an effect that multiplies the noise of all splits by a factor, other than one."""
        size = factor - 1.0
        amplitudes, errors = (self.factors - 1.0) / size, self.errors / abs(size)
        return Comparison("splits", self.splits, tuple(amplitudes.tolist()), tuple(errors.tolist()), self.pvalue)


def noise_of_splits(powers: CrossPowers, bipolar_scan: Vector) -> list[NoiseOfSplits]:
    """Return the noise of the splits of each channel that has several, where some power of residuals departs.

    The noise of every map is fitted to all these powers, twice: powers of two maps scatter as the noise of both does,
    and with the noise of the first fit the second has a residual and errors. Nothing is returned unless the residual
    has a p-value above ``residual_level``; ``consistency_error`` of every change of a variance is tolerated.
    """
    model, maps = powers.analysis.model, powers.white
    channels = [model.parts[number].channel for number in maps]
    several = [channel for channel in dict.fromkeys(channels) if channels.count(channel) > 1]
    if not (powers.rows.size and several):
        return []
    x = bipolar_scan[powers.rows.ravel()]
    if not powers.depart(x):
        return []
    first = _factors(powers.null.fit(x, powers.levels))
    of_map = np.ones(len(model.parts))
    of_map[maps] = np.maximum(first, LEAST)
    pairs = np.array([of_map[i] * of_map[j] for i, j in combinations_with_replacement(range(len(of_map)), 2)])
    scattered = powers.null.mean + (powers.simulations - powers.null.mean) * np.repeat(pairs, powers.rows.shape[1])
    fit = SimulatedGaussian.from_simulations(scattered).fit(x, powers.levels)
    if fit.pvalue <= powers.analysis.settings.residual_level:
        return []
    covariance = fit.covariance + np.diag((powers.analysis.settings.consistency_error * fit.amplitudes) ** 2)
    factors, found = _factors(fit), []
    errors = np.sqrt(np.diag(covariance)) / np.maximum(factors, LEAST)
    for channel in several:
        own = [k for k, one in enumerate(channels) if one == channel]
        contrast = np.diff(np.eye(len(own)), axis=0)
        apart = contrast @ fit.amplitudes[own]
        square = apart @ np.linalg.pinv(contrast @ covariance[np.ix_(own, own)] @ contrast.T) @ apart
        p = float(stats.f.sf(square * fit.dof / (fit.dof - 2.0) / len(apart), len(apart), fit.dof))
        splits = tuple(str(model.parts[maps[k]].split) for k in own)
        found.append(NoiseOfSplits(model.channels[channel], splits, factors[own], errors[own], p))
    return found


def _factors(fit: Fit) -> Vector:
    """Return the factors of the standard deviations; an amplitude is half of the change of the variance."""
    return np.sqrt(np.maximum(1.0 + 2.0 * fit.amplitudes, 0.0))


def certain(found: Sequence[NoiseOfSplits]) -> list[str]:
    """Return a sentence for each channel whose splits are certain not to have the model's noise alike."""
    return [one.sentence for one in found if one.pvalue * len(found) <= LEVEL]
