"""What effects do to the samples of a survey, as means over the samples of every pixel."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.instrument.scan import MapGrid, scan_key
from mcsim.instrument.scan.accumulate import add_weighted_samples
from mcsim.instrument.scan.pointing import PointingStream
from mcsim.simulation import tod
from mcsim.support import folders
from mcsim.support.arrays import Map, divided
from mcsim.support.code import class_digest, package_digest
from mcsim.support.npy import write_npy
from mcsim.systematics import Effect, Site, adding, basis_of, spread_of

_TIMES = 4096  #: at which a gain or a signal is evaluated for the key

LINEAR = 1e-9  #: part of its largest gain or signal by which a linear effect may miss the sum of those of its basis
ROUND_OFF = 1e-12  #: factor, relative to the largest, of an effect of the basis that is there only by round-off

Terms = list[tuple[float, Effect]]  #: effects, each with a factor


@dataclass(frozen=True)
class Part:
    """The samples of one map: a ``share`` of the survey's time, of it every n-th ring from one on; None: all rings.

    ``split``: the name of the split; None: of a survey that has none.
    """

    share: tuple[float, float]
    rings: tuple[int, int] | None = None
    split: str | None = None

    @classmethod
    def of(cls, run: config.RunConfig, index: int) -> Self:
        """Return the samples of a split of a run."""
        return cls(run.map.span(index), run.map.rings(index), run.map.each_split[index])


def mean_gain(acting: tuple[Effect, ...], site: Site, part: Part, orders: int = 0) -> NDArray[np.complex128] | None:
    """Return the means of g, g (dtheta + i dphi) and g e^{-i s psi} over the samples of every pixel.

    By a pass over the pointing of part of the survey: shape (orders + 2, npix), s from 1 to ``orders``. g is the
    relative error of the gain, d the offset from the pixel's centre as :class:`mcsim.instrument.scan.Moments` has it.
    None: no error. A pixel that none of a part's rings crosses has the means of all rings.
    """
    drifting = [effect for effect in acting if drifts(effect, site)]
    if not drifting:
        return None

    pointing = site.pointed(drifting[0].name)
    model, line, grid = pointing.model, pointing.line, MapGrid(site.nside, site.frame, part.share)
    stream, period = PointingStream(model, line, grid.frame), model.period_of_samples(line)
    own, whole = np.zeros((2, grid.npix, 5 + 2 * orders))
    for low, high in tod.chunks(*grid.sample_range(model, line)):
        time_s = period * np.arange(low, high, dtype=np.float64)
        terms = (np.asarray(g) for effect in drifting if (g := effect.gain(time_s, site)) is not None)
        gain = sum(terms, start=np.zeros(time_s.size))
        add_weighted_samples(stream.at(low), grid.nside, orders, gain, np.ones(time_s.size, dtype=np.bool_), whole)
        if part.rings is not None:
            chosen = tod.on_rings(time_s, model.spin_period_s, *part.rings)
            add_weighted_samples(stream.at(low), grid.nside, orders, gain, chosen, own)
    means = _means(own, whole)
    theta, phi = healpy.pix2ang(site.nside, np.arange(means.shape[1]))
    x, y, z = means[1:4]
    found = np.empty((orders + 2, means.shape[1]), dtype=np.complex128)
    found[0] = means[0]
    found[1].real = np.cos(theta) * (x * np.cos(phi) + y * np.sin(phi)) - np.sin(theta) * z
    found[1].imag = y * np.cos(phi) - x * np.sin(phi)
    found[2:] = means[4::2] + 1j * means[5::2]
    return found


def mean_signal(acting: tuple[Effect, ...], site: Site, part: Part) -> Map | None:
    """Return the mean of what effects add to the samples of every pixel, uK, by a pass like that of the gain.

    Where an effect shrinks the samples' offsets from the pixels' centres, what is added is that of where they are then.
    """
    found, spread = adding(acting), spread_of(acting)
    if not found:
        return None

    pointing = site.pointed(found[0].name)
    grid = MapGrid(site.nside, site.frame, part.share)
    own, whole = np.zeros((2, grid.npix, 2))
    for chunk in tod.samples(pointing.model, pointing.line, grid):
        chunk = tod.shrunk(chunk, site.nside, spread)
        terms = (effect.signal(chunk.time_s, chunk.theta, chunk.phi, chunk.psi, site) for effect in found)
        chunk = replace(chunk, signal_uk=sum(terms, start=chunk.signal_uk))
        tod.add_samples(chunk.pixel, chunk.signal_uk, whole)
        if part.rings is not None:
            for ring in tod.every_ring(pointing.model.spin_period_s, *part.rings)([chunk]):
                tod.add_samples(ring.pixel, ring.signal_uk, own)
    return np.ascontiguousarray(_means(own, whole)[0])


def _means(own: NDArray[np.float64], whole: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return means, shape (number, npix), from hits and as many sums, shape (npix, 1 + number): zero without hits.

    Where a part of the rings has no hits they are those of all rings.
    """
    chosen = np.where(own[:, :1] > 0.0, own, whole)
    return divided(chosen[:, 1:].T, chosen[:, 0])


def gain_of(effect: Effect, site: Site, part: Part, orders: int = 0) -> NDArray[np.complex128]:
    """Return :func:`mean_gain` of one effect, kept on disk: each process of each diagnosis needs it."""
    mean = partial(mean_gain, orders=orders)
    return _kept(f"gain-{orders}", (effect, site, part), _gains(effect, site, part), mean)


def signal_of(effect: Effect, site: Site, part: Part) -> Map:
    """Return the mean of what an effect adds to the samples of every pixel, uK, kept on disk too."""
    return _kept("signal", (effect, site, part), _signals(effect, site, part), mean_signal)


def gain_of_all(acting: tuple[Effect, ...], site: Site, part: Part, orders: int = 0) -> NDArray[np.complex128] | None:
    """Return :func:`mean_gain`, of effects that are linear in their coordinates from those of their bases.

    These are kept on disk: a diagnosis has the same effect at many amplitudes, and a pass can take minutes.
    """
    drifting = [effect for effect in acting if drifts(effect, site)]
    linear, others = _along_bases(drifting, partial(_gains, site=site, part=part))
    return _total(mean_gain(others, site, part, orders), linear, partial(gain_of, site=site, part=part, orders=orders))


def signal_of_all(acting: tuple[Effect, ...], site: Site, part: Part) -> Map | None:
    """Return :func:`mean_signal` in the same way, but where offsets shrink: signals are not linear there."""
    if spread_of(acting) != 1.0:
        return mean_signal(acting, site, part)
    linear, others = _along_bases(adding(acting), partial(_signals, site=site, part=part))
    return _total(mean_signal(others, site, part), linear, partial(signal_of, site=site, part=part))


def is_linear(effect: Effect, site: Site, part: Part) -> bool:
    """Return True if gain and signal of an effect are the sums of those of its basis, at some samples."""
    for acts, values in ((drifts(effect, site), _gains), (bool(adding([effect])), _signals)):
        seen = partial(values, site=site, part=part)
        if acts and seen(effect).any() and _along_bases([effect], seen)[1]:
            return False
    return True


def drifts(effect: Effect, site: Site) -> bool:
    """Return True if an effect makes the gain err."""
    return effect.gain(np.zeros(1), site) is not None


def _total(found: NDArray | None, terms: Terms, mean: Callable[[Effect], NDArray]) -> NDArray | None:
    """Return the sum of what is ``found``, if anything, and of means times their factors."""
    for factor, effect in terms:
        own = factor * mean(effect)
        found = own if found is None else found + own
    return found


def _along_bases(acting: Sequence[Effect], values: Callable[[Effect], Map]) -> tuple[Terms, tuple[Effect, ...]]:
    """Return the effects of bases whose sum some effects are, by their values at some samples, and the others.

    Those that do nothing at these samples are among the others.
    """
    terms, others = Terms(), []
    for effect in acting:
        own, wanted = _along_basis(effect), values(effect)
        missed = wanted - np.sum([factor * values(one) for factor, one in own], axis=0)
        if wanted.any() and float(np.abs(missed).max()) <= LINEAR * float(np.abs(wanted).max()):
            terms += own
        else:
            others.append(effect)
    return terms, tuple(others)


def _along_basis(effect: Effect) -> Terms:
    """Return the effects of the basis, with the factors of which an effect is the sum if it is linear."""
    fit = effect.parametrization
    fitted = set().union(*fit.basis())
    settings = {name: value for name, value in effect.parameters().items() if name not in fitted}
    basis = basis_of(type(effect), settings)
    factors = [float(c) / one.amplitude for c, one in zip(fit.coordinates(effect), basis, strict=True)]
    largest = max(map(abs, factors))
    return [(factor, one) for factor, one in zip(factors, basis, strict=True) if abs(factor) > ROUND_OFF * largest]


def _gains(effect: Effect, site: Site, part: Part) -> Map:
    """Return the error of the gain at some times."""
    return np.asarray(effect.gain(_times(effect, site, part), site))


def _signals(effect: Effect, site: Site, part: Part) -> Map:
    """Return what an effect adds to some samples, uK."""
    times, turns = _times(effect, site, part), np.linspace(0.0, 1.0, _TIMES)
    angles = np.pi * turns, 2.0 * np.pi * (7.0 * turns % 1.0), 2.0 * np.pi * (31.0 * turns % 1.0)
    return effect.signal(times, *angles, site)


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
        write_npy(folder / f"{what}.npy", mean((effect,), site, part))

    # Mapped, so that all processes share it.
    return np.asarray(np.load(folders.cached(f"{what}-{scan[:32]}-{own[:32]}", fill) / f"{what}.npy", mmap_mode="r"))
