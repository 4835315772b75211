"""Tell splits of a channel whose noise is not alike over that of the model: effects on noise act on all of them."""

from collections.abc import Iterator

import numpy as np
from scipy import stats

from mcsim.diagnosis.shared_noise import LEVEL, NEARLY, CrossPowers
from mcsim.support.arrays import Vector
from mcsim.support.numbers import measured, p_equals


def noise_of_splits(powers: CrossPowers, level: float, bipolar_scan: Vector) -> list[str]:
    """Return a sentence for each channel whose splits have other noise than the model by different factors.

    The noise of every map is fitted to all powers of residuals, by which these have a p-value above ``level``.
    """
    model, maps = powers.analysis.model, powers.white
    channels = [model.parts[number].channel for number in maps]
    several = [channel for channel in dict.fromkeys(channels) if channels.count(channel) > 1]
    if not (powers.rows.size and several):
        return []
    x, drawn = bipolar_scan[powers.rows.ravel()], powers.drawn[:, powers.rows.ravel()]
    if np.max(np.abs(x - powers.null.mean) / drawn.std(axis=0)) < NEARLY:
        return []
    fit = powers.null.fit(x, powers.levels)
    if fit.pvalue <= level:
        return []

    def sentences() -> Iterator[str]:
        for channel in several:
            own = [k for k, one in enumerate(channels) if one == channel]
            contrast = np.diff(np.eye(len(own)), axis=0)
            apart = contrast @ fit.amplitudes[own]
            square = apart @ np.linalg.pinv(contrast @ fit.covariance[np.ix_(own, own)] @ contrast.T) @ apart
            p = float(stats.f.sf(square * fit.dof / (fit.dof - 2.0) / len(apart), len(apart), fit.dof))
            if p * len(several) > LEVEL:
                continue
            # An amplitude is half of the change of the variance.
            factors = np.sqrt(np.maximum(1.0 + 2.0 * fit.amplitudes[own], 0.0))
            told = [
                f"{measured(float(factor), float(error))} in {model.parts[maps[k]].split}"
                for k, factor, error in zip(own, factors, fit.errors[own], strict=True)
            ]
            yield (
                f"The splits of {model.channels[channel]} do not have the model's noise alike ({p_equals(p)}): its "
                f"standard deviation is {', '.join(told)} times that of the model. An effect on the noise of the "
                "channel is the mean of its splits; split_noise gives each split of a model noise of its own."
            )

    return list(sentences())
