"""What effects do to the samples of a survey, as means over the samples of every pixel."""

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mcsim.instrument.scan import MapGrid, scan_key
from mcsim.simulation import tod
from mcsim.support import folders
from mcsim.support.arrays import Map
from mcsim.support.code import class_digest, package_digest
from mcsim.systematics import Effect, Pointing, Site, adding

_TIMES = 4096  #: at which a gain or a signal is evaluated for the key


def mean_gain(acting: tuple[Effect, ...], site: Site, share: tuple[float, float]) -> Map | None:
    """Return the mean relative error of the gain in every pixel, by a pass over the pointing of part of the survey."""
    drifting = [effect for effect in acting if effect.gain(np.zeros(1), site) is not None]
    if not drifting:
        return None

    def errors(chunk: tod.Samples) -> Iterator[Map]:
        return (g for effect in drifting if (g := effect.gain(chunk.time_s, site)) is not None)

    return _mean_of_samples(errors, site.pointed(drifting[0].name), site, share, angles=False)


def mean_signal(acting: tuple[Effect, ...], site: Site, share: tuple[float, float]) -> Map | None:
    """Return the mean of what effects add to the samples of every pixel, uK, by a pass like that of the gain."""
    found = adding(acting)
    if not found:
        return None

    def signals(chunk: tod.Samples) -> Iterator[Map]:
        return (effect.signal(chunk.time_s, chunk.theta, chunk.phi, chunk.psi, site) for effect in found)

    return _mean_of_samples(signals, site.pointed(found[0].name), site, share)


def _mean_of_samples(
    terms: Callable[[tod.Samples], Iterator[Map]],
    pointing: Pointing,
    site: Site,
    share: tuple[float, float],
    angles: bool = True,
) -> Map:
    """Return the mean of a sum of terms over the samples of every pixel, zero in pixels without any.

    ``angles`` False: the terms take times alone.
    """
    samples = tod.samples(pointing.model, pointing.line, MapGrid(site.nside, site.frame, share), angles=angles)
    summed = tod.with_signal(lambda chunk: sum(terms(chunk), start=chunk.signal_uk))
    mean, hits = tod.bin_samples(summed(samples), site.nside)
    return np.where(hits > 0, mean, 0.0)


def gain_of(effect: Effect, site: Site, share: tuple[float, float]) -> Map:
    """Return the mean error of the gain in every pixel, kept on disk: each process of each diagnosis needs it."""
    times = _times(effect, site, share)
    return _kept("gain", (effect, site, share), np.asarray(effect.gain(times, site)), mean_gain)


def signal_of(effect: Effect, site: Site, share: tuple[float, float]) -> Map:
    """Return the mean of what an effect adds to the samples of every pixel, uK, kept on disk too."""
    times, turns = _times(effect, site, share), np.linspace(0.0, 1.0, _TIMES)
    angles = np.pi * turns, 2.0 * np.pi * (7.0 * turns % 1.0), 2.0 * np.pi * (31.0 * turns % 1.0)
    return _kept("signal", (effect, site, share), effect.signal(times, *angles, site), mean_signal)


def _times(effect: Effect, site: Site, share: tuple[float, float]) -> Map:
    pointing = site.pointed(effect.name)
    grid = MapGrid(site.nside, site.frame, share)
    period = pointing.model.period_of_samples(pointing.line)
    return np.asarray(period * np.linspace(*grid.sample_range(pointing.model, pointing.line), _TIMES))


def _kept(what: str, where: tuple[Effect, Site, tuple[float, float]], values: Map, mean: Callable[..., Any]) -> Map:
    """Return a mean over the samples of pixels, from the disk if it is there.

    The key has the effect, its code, and its values at a few thousand times: what an effect takes from elsewhere shows
    in these.
    """
    effect, site, share = where
    pointing = site.pointed(effect.name)
    grid = MapGrid(site.nside, site.frame, share)
    scan = scan_key(pointing.model.with_lines_of_sight(pointing.line.name), grid)
    code = class_digest(type(effect)) + package_digest(["mcsim.systematics", "mcsim.simulation"])
    text = f"{effect!r} {pointing.line!r} {code}".encode()
    own = hashlib.sha256(text + values.tobytes()).hexdigest()

    def fill(folder: Path) -> None:
        np.save(folder / f"{what}.npy", np.asarray(mean((effect,), site, share), dtype=np.float64))

    # Mapped, so that all processes share it.
    return np.asarray(np.load(folders.cached(f"{what}-{scan[:32]}-{own[:32]}", fill) / f"{what}.npy", mmap_mode="r"))
