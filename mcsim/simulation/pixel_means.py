"""What effects do to the samples of a survey, as means over the samples of every pixel."""

import hashlib
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim.instrument.scan import MapGrid, scan_key
from mcsim.simulation import tod
from mcsim.support import folders
from mcsim.support.arrays import Map, divided
from mcsim.support.code import class_digest, package_digest
from mcsim.support.compiled import njit
from mcsim.systematics import Effect, Pointing, Site, adding

_TIMES = 4096  #: at which a gain or a signal is evaluated for the key


def mean_gain(
    acting: tuple[Effect, ...], site: Site, share: tuple[float, float], orders: int = 0
) -> NDArray[np.complex128] | None:
    """Return the means of g e^{-i s psi} over the samples of every pixel, g the relative error of the gain.

    By a pass over the pointing of part of the survey: shape (orders + 1, npix), the error itself at s = 0. None: no
    error.
    """
    drifting = [effect for effect in acting if effect.gain(np.zeros(1), site) is not None]
    if not drifting:
        return None

    def error(chunk: tod.Samples) -> Map:
        terms = (g for effect in drifting if (g := effect.gain(chunk.time_s, site)) is not None)
        return sum(terms, start=chunk.signal_uk)

    return _mean_of_samples(error, site.pointed(drifting[0].name), site, share, orders, angles=orders > 0)


def mean_signal(acting: tuple[Effect, ...], site: Site, share: tuple[float, float]) -> Map | None:
    """Return the mean of what effects add to the samples of every pixel, uK, by a pass like that of the gain."""
    found = adding(acting)
    if not found:
        return None

    def signal(chunk: tod.Samples) -> Map:
        terms = (effect.signal(chunk.time_s, chunk.theta, chunk.phi, chunk.psi, site) for effect in found)
        return sum(terms, start=chunk.signal_uk)

    return np.ascontiguousarray(_mean_of_samples(signal, site.pointed(found[0].name), site, share)[0].real)


def _mean_of_samples(
    values: Callable[[tod.Samples], Map],
    pointing: Pointing,
    site: Site,
    share: tuple[float, float],
    orders: int = 0,
    angles: bool = True,
) -> NDArray[np.complex128]:
    """Return the means of values times e^{-i s psi} over the samples of every pixel, zero in pixels without any.

    Shape (orders + 1, npix). ``angles`` False: the values take times alone.
    """
    grid = MapGrid(site.nside, site.frame, share)
    sums = np.zeros((grid.npix, 2 + 2 * orders))  # of one pixel side by side
    for chunk in tod.samples(pointing.model, pointing.line, grid, angles=angles):
        _add(chunk.pixel, values(chunk), chunk.psi, orders, sums)
    mean = np.zeros((orders + 1, grid.npix), dtype=np.complex128)
    mean.real = divided(sums[:, 1::2].T, sums[:, 0])
    mean[1:].imag = divided(sums[:, 2::2].T, sums[:, 0])
    return mean


@njit(nogil=True)
def _add(pixel, value, psi, orders, sums):  # type: ignore[no-untyped-def]
    """Add samples to hits and sums of values times e^{-i s psi}, powers of it by multiplication."""
    for k in range(pixel.size):
        own = sums[pixel[k]]
        own[0] += 1.0
        own[1] += value[k]
        if orders > 0:
            cosine, sine = math.cos(psi[k]), math.sin(psi[k])
            real, imag = value[k], 0.0
            for s in range(1, orders + 1):
                real, imag = real * cosine + imag * sine, imag * cosine - real * sine
                own[2 * s] += imag
                own[2 * s + 1] += real


def gain_of(effect: Effect, site: Site, share: tuple[float, float], orders: int = 0) -> NDArray[np.complex128]:
    """Return :func:`mean_gain` of one effect, kept on disk: each process of each diagnosis needs it."""
    times = _times(effect, site, share)
    mean = partial(mean_gain, orders=orders)
    return _kept(f"gain-{orders}", (effect, site, share), np.asarray(effect.gain(times, site)), mean)


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


def _kept(what: str, where: tuple[Effect, Site, tuple[float, float]], values: Map, mean: Callable[..., Any]) -> NDArray:
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
        np.save(folder / f"{what}.npy", mean((effect,), site, share))

    # Mapped, so that all processes share it.
    return np.asarray(np.load(folders.cached(f"{what}-{scan[:32]}-{own[:32]}", fill) / f"{what}.npy", mmap_mode="r"))
