"""Responses of the data vector to steps of effects: over how many skies they are averaged, and what they are."""

import math
from collections.abc import Iterator

import numpy as np
from scipy.stats import chi2

from mcsim.datavector.analysis import Analysis
from mcsim.datavector.candidate import Candidate
from mcsim.support.arrays import Matrix
from mcsim.systematics import Effect

MODES = 1 << 16
"""Modes of the sky that maps show, up to which responses are averaged over the least numbers of skies that settings
have; of more modes over fewer, as each sky tells as much more."""

FEWEST = 2  #: skies over which any response is averaged: their scatter is its error


def steps(analysis: Analysis) -> Iterator[tuple[Candidate, int, int, Effect]]:
    """Yield candidate, column, sign and effect of every response that is simulated."""
    for candidate in analysis.candidates:
        for column, effect in zip(candidate.columns, candidate.basis, strict=True):
            for sign in (1, -1):
                if candidate.parametrization.sign in (0, sign):
                    yield candidate, column, sign, effect.scaled(sign)


def skies(analysis: Analysis, candidate: Candidate, sign: int = 1) -> int:
    """Return the number of skies over which the response to a candidate is averaged, or those of one sign."""
    settings = analysis.settings
    if not analysis.of_maps:
        return min(settings.table_skies, settings.noisy_skies)
    if candidate.random_response:
        return settings.noisy_skies
    fewest = settings.channel_skies
    if candidate.channel is None:
        fewest = settings.typical_skies if candidate.parametrization.mean_response else settings.common_skies
    fewest = max(FEWEST, scaled(analysis, fewest))
    count = min(max(fewest, -(-settings.response_modes // analysis.model.lmax**2)), settings.noisy_skies)
    opposite = sign < 0 and candidate.parametrization.sign == 0
    return math.ceil(settings.opposite_share * count) if opposite else count


def scaled(analysis: Analysis, skies: int) -> int:
    """Return as many skies as tell of maps with more modes what so many tell of maps with MODES of them."""
    model = analysis.model
    shown = float((2.0 * np.arange(model.lmax + 1) + 1.0) @ model.sky_power)
    return math.ceil(skies * min(1.0, MODES / shown))


def responses(step: float, here: Matrix, opposite: Matrix | None, same: Matrix) -> tuple[Matrix, Matrix]:
    """Return the linear response in each sky, shape (skies, p), and the curvature of the mean, shape (p,).

    Data vectors with a step and without are those of the same skies, those with the opposite step of the first of them.
    They give [x(+step) - x(-step)]/(2 step); in the other skies, and of an effect of one sign, the response is
    [x(step) - x(0)]/step less step times the curvature, which is zero if nothing tells it.
    """
    each = (here - same) / step
    if opposite is None:
        return each, np.zeros(here.shape[1])
    both = len(opposite)
    curvature = np.mean(here[:both] + opposite - 2.0 * same[:both], axis=0) / (2.0 * step**2)
    each -= step * curvature
    each[:both] = (here[:both] - opposite) / (2.0 * step)
    return each, curvature


def size_error(each: Matrix, whitening: Matrix) -> float:
    """Return the relative error of the size of a mean response that the scatter of its skies leaves possible.

    ``each``: responses in single skies, shape (skies, p). The size is the component along their mean in the metric of
    the covariance of the data vector, whose ``whitening`` has shape (q, p). The error is an upper limit (90 %), for a
    few skies do not tell their scatter well: that of a gain behind a mask is a third where a few bright modes at low
    degrees tell it.
    """
    white = each @ whitening.T
    mean = white.mean(axis=0)
    square, free = float(mean @ mean), len(each) - 1.0
    if square == 0.0:
        return 0.0
    return float(np.std(white @ mean / square, ddof=1) * np.sqrt(free / chi2.ppf(0.1, free) / len(each)))
