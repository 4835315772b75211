"""What effects do to the samples of a survey, as means over the samples of every pixel."""

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.instrument.scan import MapGrid, scan_key
from mcsim.simulation import tod
from mcsim.support import folders
from mcsim.support.arrays import Map, divided
from mcsim.support.code import class_digest, package_digest
from mcsim.support.compiled import njit
from mcsim.systematics import Effect, Pointing, Site, adding

_TIMES = 4096  #: at which a gain or a signal is evaluated for the key


@dataclass(frozen=True)
class Part:
    """The samples of one map: a ``share`` of the survey's time, of it every n-th ring from one on; None: all rings."""

    share: tuple[float, float]
    rings: tuple[int, int] | None = None

    @classmethod
    def of(cls, run: config.RunConfig, index: int) -> Self:
        """Return the samples of a split of a run."""
        return cls(run.map.span(index), run.map.rings(index))


def mean_gain(acting: tuple[Effect, ...], site: Site, part: Part, orders: int = 0) -> NDArray[np.complex128] | None:
    """Return the means of g e^{-i s psi} over the samples of every pixel, g the relative error of the gain.

    By a pass over the pointing of part of the survey: shape (orders + 1, npix), the error itself at s = 0. None: no
    error. A pixel that none of a part's rings crosses has the mean of all rings.
    """
    drifting = [effect for effect in acting if effect.gain(np.zeros(1), site) is not None]
    if not drifting:
        return None

    def error(chunk: tod.Samples) -> Map:
        terms = (g for effect in drifting if (g := effect.gain(chunk.time_s, site)) is not None)
        return sum(terms, start=chunk.signal_uk)

    return _mean_of_samples(error, site.pointed(drifting[0].name), site, part, orders, angles=orders > 0)


def mean_signal(acting: tuple[Effect, ...], site: Site, part: Part) -> Map | None:
    """Return the mean of what effects add to the samples of every pixel, uK, by a pass like that of the gain."""
    found = adding(acting)
    if not found:
        return None

    def signal(chunk: tod.Samples) -> Map:
        terms = (effect.signal(chunk.time_s, chunk.theta, chunk.phi, chunk.psi, site) for effect in found)
        return sum(terms, start=chunk.signal_uk)

    return np.ascontiguousarray(_mean_of_samples(signal, site.pointed(found[0].name), site, part)[0].real)


def _mean_of_samples(
    values: Callable[[tod.Samples], Map],
    pointing: Pointing,
    site: Site,
    part: Part,
    orders: int = 0,
    angles: bool = True,
) -> NDArray[np.complex128]:
    """Return the means of values times e^{-i s psi} over the samples of every pixel, zero in pixels without any.

    Shape (orders + 1, npix). ``angles`` False: the values take times alone.
    """
    grid = MapGrid(site.nside, site.frame, part.share)
    sums = np.zeros((1 if part.rings is None else 2, grid.npix, 2 + 2 * orders))  # of one pixel side by side
    for chunk in tod.samples(pointing.model, pointing.line, grid, angles=angles):
        found = values(chunk)
        _add(chunk.pixel, found, chunk.psi, orders, sums[-1])
        if part.rings is not None:
            own = tod.on_ring(chunk.time_s, pointing.model.spin_period_s, *part.rings)
            _add(chunk.pixel[own], found[own], chunk.psi[own] if angles else chunk.psi, orders, sums[0])
    chosen = np.where(sums[0, :, :1] > 0.0, sums[0], sums[-1])
    mean = np.zeros((orders + 1, grid.npix), dtype=np.complex128)
    mean.real = divided(chosen[:, 1::2].T, chosen[:, 0])
    mean[1:].imag = divided(chosen[:, 2::2].T, chosen[:, 0])
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


def gain_of(effect: Effect, site: Site, part: Part, orders: int = 0) -> NDArray[np.complex128]:
    """Return :func:`mean_gain` of one effect, kept on disk: each process of each diagnosis needs it."""
    times = _times(effect, site, part)
    mean = partial(mean_gain, orders=orders)
    return _kept(f"gain-{orders}", (effect, site, part), np.asarray(effect.gain(times, site)), mean)


def signal_of(effect: Effect, site: Site, part: Part) -> Map:
    """Return the mean of what an effect adds to the samples of every pixel, uK, kept on disk too."""
    times, turns = _times(effect, site, part), np.linspace(0.0, 1.0, _TIMES)
    angles = np.pi * turns, 2.0 * np.pi * (7.0 * turns % 1.0), 2.0 * np.pi * (31.0 * turns % 1.0)
    return _kept("signal", (effect, site, part), effect.signal(times, *angles, site), mean_signal)


def _times(effect: Effect, site: Site, part: Part) -> Map:
    pointing = site.pointed(effect.name)
    grid = MapGrid(site.nside, site.frame, part.share)
    period = pointing.model.period_of_samples(pointing.line)
    return np.asarray(period * np.linspace(*grid.sample_range(pointing.model, pointing.line), _TIMES))


def _kept(what: str, where: tuple[Effect, Site, Part], values: Map, mean: Callable[..., Any]) -> NDArray:
    """Return a mean over the samples of pixels, from the disk if it is there.

    The key has the effect, its code, and its values at a few thousand times: what an effect takes from elsewhere shows
    in these.
    """
    effect, site, part = where
    pointing = site.pointed(effect.name)
    grid = MapGrid(site.nside, site.frame, part.share)
    scan = scan_key(pointing.model.with_lines_of_sight(pointing.line.name), grid)
    code = class_digest(type(effect)) + package_digest(["mcsim.systematics", "mcsim.simulation"])
    text = f"{effect!r} {pointing.line!r} {part.rings} {code}".encode()
    own = hashlib.sha256(text + values.tobytes()).hexdigest()

    def fill(folder: Path) -> None:
        np.save(folder / f"{what}.npy", mean((effect,), site, part))

    # Mapped, so that all processes share it.
    return np.asarray(np.load(folders.cached(f"{what}-{scan[:32]}-{own[:32]}", fill) / f"{what}.npy", mmap_mode="r"))
