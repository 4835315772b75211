"""What the effects that act in a channel do together."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.sphere import alm as alm_
from mcsim.sphere import rng
from mcsim.support.arrays import Vector
from mcsim.systematics.base import Alm, Effect, Map, Site, acts_through
from mcsim.systematics.hooks import HookError

ABSENT, SMOOTH = 1e-6, 0.01
"""What an effect of amplitude 0 may change by rounding; and a factor of variances, whose pattern may be smoothed."""

UNIFORM = 1e-9  #: relative departure of a beam from a multiple of another one that is round-off


def seen_through(acting: Sequence[Effect], site: Site, displacing: Sequence[Effect] | None = None) -> Beam:
    """Return the beam about the fiducial line of sight: every effect on its shape first, then all that displaces it.

    ``displacing``: the effects that displace the line of sight; default: all.

    Notes
    -----
    Effects on the shape act by rank, those of one rank in their order. Of those on the pointing what turns with the
    beam comes first, then what moves samples, and the memory of earlier ones last, as in the sample-by-sample route.
    """
    beam = site.beam
    for effect in sorted(acting, key=lambda one: one.rank):
        beam = effect.beam(beam, site) if effect.amplitude != 0.0 else beam
    for effect in sorted(acting if displacing is None else displacing, key=reach):
        beam = effect.pointing(beam, site) if effect.amplitude != 0.0 else beam
    return beam


def reach(effect: Effect) -> int:
    """Return 2 for an effect that mixes in signals of earlier samples, 1 for one that moves samples, 0 for others."""
    if effect.lags() is not None:
        return 2
    return 0 if effect.moved(*np.zeros((3, 1))) is None else 1


def rescaling(acting: Iterable[Effect], site: Site) -> float:
    """Return the factor by which effects rescale all signal of a channel, of those that do nothing else to its beam."""
    found, before = 1.0, site.beam.blm
    for effect in acting:
        after = effect.beam(site.beam, site).blm if effect.amplitude != 0.0 else before
        if after is not before and after.shape == before.shape:
            factor = float(np.vdot(before, after).real / np.vdot(before, before).real)
            alike = np.linalg.norm(after - factor * before) <= UNIFORM * np.linalg.norm(after)
            found *= factor if alike and factor > 0.0 else 1.0
    return found


def spread_of(acting: Iterable[Effect]) -> float:
    """Return the factor by which the samples' offsets from the centre of their pixel shrink."""
    return float(np.prod([effect.spread() for effect in acting]))


def variance_factor(acting: Iterable[Effect], site: Site) -> Map | None:
    """Return the factor of the variance of every pixel's samples, shape (npix,), >= 0; None: one."""
    factors = [own for effect in acting if (own := effect.noise(site)) is not None]
    return np.clip(np.prod(factors, axis=0), 0.0, None) if factors else None


def shared_gain(acting: Iterable[Effect], site: Site) -> float:
    """Return the relative error of the gain that all samples of ``site.split`` share."""
    return float(sum(effect.steady_gain(site) for effect in acting))


def adding(acting: Iterable[Effect]) -> list[Effect]:
    """Return the effects that add a signal to samples."""
    return [one for one in acting if one.amplitude != 0.0 and acts_through(one, "signal")]


def disturbing(acting: Iterable[Effect]) -> list[tuple[Effect, str]]:
    """Return the effects that add noise of their own to samples, with the names of their :func:`streams`."""
    return [(one, own) for one, own in streams(acting) if one.amplitude != 0.0 and acts_through(one, "excess")]


def tried(acting: Sequence[Effect], site: Site) -> Beam:
    """Return the beam that effects make; raise InputError for one that cannot act here, or does so at amplitude 0."""
    once = np.zeros(1)
    looked_at(acting, np.zeros(alm_.size(site.lmax), dtype=np.complex128), site, 0, 0)
    for effect in acting:
        effect.gain(once, site)
        shared_gain((effect,), site)
        effect.noise(site)
        effect.knee(1.0)
        effect.differencing(0.0, 0)
        _refuse_if_always_there(replace(effect, amplitude=0.0), site, once)
    for effect in adding(acting):
        site.pointed(effect.name)
        effect.signal(once, once, once, once, site)
    for effect, _ in disturbing(acting):
        effect.excess(once, rng.generator(0, 0, "tried"))
    return seen_through(acting, site)


def _refuse_if_always_there(none: Effect, site: Site, time_s: Vector) -> None:
    """Raise HookError for an effect of amplitude zero that changes something; one that is not defined there may be."""
    hooks: dict[str, tuple[Callable[[], object], float]] = {
        "gain": (lambda: none.gain(time_s, site), 0.0),
        "steady_gain": (lambda: none.steady_gain(site), 0.0),
        "noise": (lambda: none.noise(site), 1.0),
        "knee": (lambda: none.knee(1.0), 1.0),
        "spread": (none.spread, 1.0),
        "differencing": (lambda: none.differencing(0.0, 0), 0.0),
    }
    for hook, (call, nothing) in hooks.items():
        try:
            value = call()
        except InputError:
            continue
        change = 0.0 if value is None else float(np.max(np.abs(np.asarray(value) - nothing)))
        if change > (SMOOTH if hook == "noise" else ABSENT):
            raise HookError(
                f"effect {none.name}: its {hook} changes the simulation at amplitude = 0, by {change:.2g}; let it "
                f"return {nothing:g} there, or None."
            )


def looked_at(acting: Iterable[Effect], sky: Alm, site: Site, seed: int, realization: int) -> Alm:
    """Return the sky that a channel looks at, uK: common effects come first, and draw alike in every channel."""
    for effect, own in sorted(streams(acting), key=lambda one: one[0].scope == "channel"):
        if effect.amplitude == 0.0:
            continue

        def draw(stage: str, own: str = own) -> np.random.Generator:
            return rng.generator(seed, realization, f"{own}/{stage}")

        sky = effect.sky(sky, site, draw)
    return sky


def streams(acting: Iterable[Effect]) -> Iterator[tuple[Effect, str]]:
    """Yield effects with the names of their random streams: the second one of a name draws anew."""
    met: dict[str, int] = {}
    for effect in acting:
        number = met[effect.name] = met.get(effect.name, 0) + 1
        yield effect, f"effect/{effect.name}" if number == 1 else f"effect/{effect.name}/{number}"
