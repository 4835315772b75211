"""Matched filters: the derivative of the log-likelihood of filtered maps in the amplitude of each effect.

The formula follows from the hooks that an effect defines, so that a user's effect is treated like a built-in one. A
stochastic effect has no matched filter: it shows in the spectra.
"""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcsim import systematics
from mcsim.diagnosis.wiener_filter import FilteredMaps, Model, by_degree
from mcsim.instrument.scan.cache import moments_key
from mcsim.simulation import tod
from mcsim.simulation.survey import mean_gain
from mcsim.sphere import healpix
from mcsim.sphere.sky import dipole_alm
from mcsim.support import folders
from mcsim.support.code import class_digest, package_digest
from mcsim.systematics import Effect

Map = NDArray[np.float64]


@dataclass(frozen=True)
class BeamFilter:
    """Change the beam: sum of Re[conj(db_ls) D_s(l)] over the channel's maps."""

    parts: tuple[int, ...]
    change: NDArray[np.complex128]

    def __call__(self, model: Model, filtered: FilteredMaps) -> float:
        """Return the matched filter of filtered maps."""
        total = sum(filtered.orders[i] for i in self.parts)
        return float(np.sum(self.change.real * np.real(total) + self.change.imag * np.imag(total)))


@dataclass(frozen=True)
class GainFilter:
    """Change the gain: correlate residuals with sky and dipole times the mean gain error of every pixel."""

    parts: tuple[int, ...]
    errors: tuple[Map, ...]
    dipole: Map

    def __call__(self, model: Model, filtered: FilteredMaps) -> float:
        """Return the matched filter of filtered maps."""
        return float(
            sum(
                np.dot(filtered.residual[i], error * (filtered.expected[i] + self.dipole))
                for i, error in zip(self.parts, self.errors, strict=True)
            )
        )


@dataclass(frozen=True)
class SkyFilter:
    """Change the sky that one channel sees, or (``common``) that all see."""

    effect: Effect
    site: systematics.Site
    parts: tuple[int, ...]
    common: bool

    def __call__(self, model: Model, filtered: FilteredMaps) -> float:
        """Return the matched filter of filtered maps."""
        lmax = model.lmax
        site = replace(self.site, lmax=lmax)
        change = self.effect.sky(filtered.sky, site, _no_draws) - filtered.sky
        if self.common:
            # What all maps together say, sum_i P_i^t r_i, is S^-1 s^.
            inverse = np.divide(1.0, model.cl, out=np.zeros(lmax + 1), where=model.cl > 0)
            return float(np.dot(inverse, by_degree(filtered.sky, change, lmax)))
        return float(
            sum(
                np.dot(model.response[model.parts[i].channel], by_degree(change, filtered.adjoint[i], lmax))
                for i in self.parts
            )
        )


@dataclass(frozen=True)
class NoiseFilter:
    """Change the noise variance: correlate it with the squared difference of a channel's maps, or the only residual."""

    parts: tuple[int, ...]
    change: Map

    def __call__(self, model: Model, filtered: FilteredMaps) -> float:
        """Return the matched filter of filtered maps."""
        return float(np.dot(normalised_difference(model, filtered, self.parts), self.change))


MatchedFilter = BeamFilter | GainFilter | SkyFilter | NoiseFilter


def normalised_difference(model: Model, filtered: FilteredMaps, parts: tuple[int, ...]) -> Map:
    """Return u^2 - 1 of every pixel seen by a channel's first two maps, u their difference over its noise; else 0."""
    # Residuals are zero where nothing was seen, and come times their precision: (r/a - s/b)^2 / (1/a + 1/b).
    first, a = filtered.residual[parts[0]], model.parts[parts[0]].precision
    seen = first != 0.0
    if len(parts) == 1:
        square, scale = first**2, a
    else:
        second, b = filtered.residual[parts[1]], model.parts[parts[1]].precision
        seen &= second != 0.0
        square, scale = (first * b - second * a) ** 2, a * b * (a + b)
    found = np.divide(square, scale, out=np.zeros_like(square), where=seen)
    return found - seen


def matched_filter(model: Model, effect: Effect, channel: int | None) -> MatchedFilter | None:
    """Return the matched filter of a small effect in a channel (None: in all); None if it has none.

    Parameters
    ----------
    model
        Fiducial model.
    effect
        At the amplitude of a step: the filter is that of this change.
    channel
        Index.
    """
    kind = type(effect)
    where = 0 if channel is None else channel
    owner = model.survey.channels[where]
    parts = tuple(range(len(model.parts))) if channel is None else model.of(channel)
    if not kind.parametrization.matched_filter:
        return None
    if kind.sky is not Effect.sky:
        return SkyFilter(effect, owner.site, parts, channel is None)
    if channel is None:
        return None
    if kind.beam is not Effect.beam or kind.pointing is not Effect.pointing or kind.spread is not Effect.spread:
        return _beam_filter(model, effect, channel, parts)
    factor = effect.noise(owner.site)
    if factor is not None:
        return NoiseFilter(parts, np.asarray(factor) - 1.0)
    if effect.gain(np.zeros(1), owner.site) is not None:
        splits = len(parts)
        errors = tuple(gain_of(effect, owner.site, (n / splits, (n + 1) / splits)) for n in range(splits))
        lmax = max(model.lmax, 1)
        dipole = healpix.synthesis(dipole_alm(owner.site.dipole_uk, lmax)[None], model.nside, lmax)[0]
        return GainFilter(parts, errors, dipole)
    return None


def gain_of(effect: Effect, site: systematics.Site, share: tuple[float, float]) -> Map:
    """Return the mean error of the gain in every pixel, kept on disk: each process of each diagnosis needs it.

    The key has the effect, its code, and its gain at a few thousand times: what an effect takes from elsewhere shows
    in these.
    """
    pointing = site.pointed(effect.name)
    where = moments_key(pointing.model, site.nside, 0, site.frame, [pointing.line.name], share)
    period = pointing.model.period_of_samples(pointing.line)
    times = period * np.linspace(*tod.sample_range(pointing.model, pointing.line, share), _TIMES)
    code = class_digest(type(effect)) + package_digest(["mcsim.systematics", "mcsim.simulation"])
    text = f"{effect!r} {pointing.line!r} {code}".encode()
    what = hashlib.sha256(text + np.asarray(effect.gain(times, site)).tobytes()).hexdigest()

    def fill(folder: Path) -> None:
        np.save(folder / "gain.npy", np.asarray(mean_gain((effect,), site, share), dtype=np.float64))

    found: Map = np.load(folders.cached(f"gain-{where[:32]}-{what[:32]}", fill) / "gain.npy")
    return found


_TIMES = 4096
"""At which a gain is evaluated for the key."""


def _beam_filter(model: Model, effect: Effect, channel: int, parts: tuple[int, ...]) -> BeamFilter | None:
    owner = model.survey.channels[channel]
    lmax, top = model.lmax, model.settings.beam_orders
    changed, before = systematics.seen_through((effect,), owner.site), owner.site.beam
    change = np.zeros((top + 1, lmax + 1), dtype=np.complex128)
    for beam, sign in ((changed, 1.0), (before, -1.0)):
        rows = min(beam.mmax, top) + 1
        change[:rows] += sign * beam.blm[:rows, : lmax + 1]
    spread = effect.spread()
    if spread != 1.0:
        window = np.maximum(owner.window[: lmax + 1], np.finfo(float).tiny)
        rows = min(before.mmax, top) + 1
        change[:rows] += before.blm[:rows, : lmax + 1] * (window ** (spread * spread - 1.0) - 1.0)
    # Samples at the centres of their pixels, with no pixel window, cannot come closer.
    return BeamFilter(parts, change) if change.any() else None


def _no_draws(stage: str) -> np.random.Generator:
    raise TypeError(f"a stochastic effect ({stage}) has no matched filter; set matched_filter = False.")


def sky_of(model: Model, filtered: FilteredMaps) -> NDArray[np.float64]:
    """Return the spectrum of s^ over its expectation, minus one, shape (lmax + 1,); 0 if none is expected."""
    lmax = model.lmax
    found = by_degree(filtered.sky, filtered.sky, lmax) / (2 * np.arange(lmax + 1) + 1)
    expected = model.cl * model.sky_power
    return np.divide(found, expected, out=np.ones(lmax + 1), where=expected > 0) - 1.0
