"""What effects do to the samples of a survey, as means over the samples of every pixel."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mcsim.instrument.scan import MapGrid
from mcsim.simulation import tod
from mcsim.systematics import Effect, Pointing, Site, adding


def mean_gain(acting: tuple[Effect, ...], site: Site, share: tuple[float, float]) -> NDArray[np.float64] | None:
    """Return the mean relative error of the gain in every pixel, by a pass over the pointing of part of the survey."""
    drifting = [effect for effect in acting if effect.gain(np.zeros(1), site) is not None]
    if not drifting:
        return None

    def errors(chunk: tod.Samples) -> Iterator[NDArray[np.float64]]:
        return (g for effect in drifting if (g := effect.gain(chunk.time_s, site)) is not None)

    return _mean_of_samples(errors, site.pointed(drifting[0].name), site, share)


def mean_signal(acting: tuple[Effect, ...], site: Site, share: tuple[float, float]) -> NDArray[np.float64] | None:
    """Return the mean of what effects add to the samples of every pixel, uK, by a pass like that of the gain."""
    found = adding(acting)
    if not found:
        return None

    def signals(chunk: tod.Samples) -> Iterator[NDArray[np.float64]]:
        return (effect.signal(chunk.time_s, chunk.theta, chunk.phi, chunk.psi, site) for effect in found)

    return _mean_of_samples(signals, site.pointed(found[0].name), site, share)


def _mean_of_samples(
    terms: Callable[[tod.Samples], Iterator[NDArray[np.float64]]],
    pointing: Pointing,
    site: Site,
    share: tuple[float, float],
) -> NDArray[np.float64]:
    """Return the mean of a sum of terms over the samples of every pixel, zero in pixels without any."""

    def stream() -> Iterator[tod.Samples]:
        for chunk in tod.samples(pointing.model, pointing.line, MapGrid(site.nside, site.frame, share)):
            yield replace(chunk, signal_uk=sum(terms(chunk), start=chunk.signal_uk))

    mean, hits = tod.bin_samples(stream(), site.nside)
    return np.where(hits > 0, mean, 0.0)
