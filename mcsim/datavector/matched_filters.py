"""Matched filters: the derivative of the log-likelihood of filtered maps in the amplitude of each effect.

The formula follows from the hooks that an effect defines, so that a user's effect is treated like a built-in one. A
stochastic effect has no matched filter: it shows in the spectra.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from mcsim import systematics
from mcsim.bipolar import by_degree
from mcsim.datavector.filter_model import Model, smoothing
from mcsim.datavector.wiener_filter import FilteredMaps
from mcsim.simulation import differencing, windows
from mcsim.simulation.pixel_means import Part, drifts, gain_of, signal_of
from mcsim.simulation.survey import Channel, SurveyMap
from mcsim.sphere import healpix
from mcsim.sphere.sky import dipole_alm
from mcsim.support.arrays import Map
from mcsim.systematics import Effect, acts_through

MatchedFilter = Callable[[FilteredMaps], float]


def matched_filter(model: Model, effect: Effect, channel: int | None) -> MatchedFilter | None:
    """Return the matched filter of an effect at the amplitude of a step, in the channel of an index (None: in all).

    None if there is no such filter.
    """
    owner = model.survey.channels[channel or 0]
    if not effect.parametrization.matched_filter:
        return None
    if acts_through(effect, "sky"):
        return _sky_filter(model, effect, channel)
    if channel is None:
        return None
    if acts_through(effect, "beam", "pointing", "spread"):
        return _beam_filter(model, effect, channel)
    if acts_through(effect, "signal"):
        return _signal_filter(model, effect, channel)
    factor = model.noise_factor(effect, channel)
    if factor is not None:
        change = np.asarray(factor) - 1.0
        return lambda filtered: float(np.dot(filtered.squares[channel], change))
    erring = drifts(effect, owner.site) or acts_through(effect, "steady_gain")
    return _gain_filter(model, effect, channel) if erring else None


def _sky_filter(model: Model, effect: Effect, channel: int | None) -> MatchedFilter:
    """Correlate residuals with the change of the sky that one channel sees, or (None) that all see."""
    lmax = model.lmax
    site = replace(model.survey.channels[channel or 0].site, lmax=lmax)

    def value(filtered: FilteredMaps) -> float:
        change = effect.sky(filtered.sky, site, _no_draws) - filtered.sky
        if channel is None:
            # What all maps together say, sum_i P_i^t r_i, is S^-1 s^.
            return float(np.dot(model.inverse_cl, by_degree(filtered.sky, change, lmax)))
        own = [by_degree(change, filtered.adjoint[i], lmax) for i in model.of(channel)]
        return float(sum(np.dot(model.response[channel], power) for power in own))

    return value


def _no_draws(stage: str) -> np.random.Generator:
    raise TypeError(f"a stochastic effect ({stage}) has no matched filter; set matched_filter = False.")


def _beam_filter(model: Model, effect: Effect, channel: int) -> MatchedFilter | None:
    """Sum Re[conj(db_ls) D_s(l)] over the channel's maps, db_ls the change of the beam, smoothed as the maps are."""
    owner, parts = model.survey.making.channels[channel], model.of(channel)
    lmax, top = model.lmax, model.settings.beam_orders
    changed, before = systematics.seen_through((effect,), owner.site), owner.site.beam
    change = np.zeros((top + 1, lmax + 1), dtype=np.complex128)
    for beam, sign in ((changed, 1.0), (before, -1.0)):
        rows = min(beam.mmax, top) + 1
        change[:rows] += sign * beam.blm[:rows, : lmax + 1]
    spread = effect.spread()
    if spread != 1.0:
        # Samples that stand closer change the window of their pixels, not that of a preparation.
        rows, own = min(before.mmax, top) + 1, np.maximum(owner.window, np.finfo(float).tiny)
        factor = windows.stretched(owner.window, owner.site.nside, spread) / own
        change[:rows] += before.blm[:rows, : lmax + 1] * (factor[: lmax + 1] - 1.0)
    if not change.any():
        return None  # samples at the centres of their pixels, with no pixel window, cannot come closer
    change *= smoothing(owner, lmax)

    def value(filtered: FilteredMaps) -> float:
        total = sum(filtered.orders[i] for i in parts)
        return float(np.sum(change.real * np.real(total) + change.imag * np.imag(total)))

    return value


def _gain_filter(model: Model, effect: Effect, channel: int) -> MatchedFilter:
    """Correlate residuals with sky and dipole times the mean gain error of every pixel."""
    site, parts, lmax = model.survey.channels[channel].site, model.of(channel), max(model.lmax, 1)
    # Of as many orders as the simulations need: one pass over the pointing for both.
    orders, run = model.survey.channels[channel].beam.mmax, model.survey.config
    errors = []
    for part in (Part.of(run, n) for n in range(len(parts))):
        steady = effect.steady_gain(replace(site, split=part.split))
        errors.append(steady + (gain_of(effect, site, part, orders)[0].real if drifts(effect, site) else 0.0))
    dipole = healpix.synthesis(dipole_alm(site.dipole_uk, lmax)[None], model.nside, lmax)[0]

    def value(filtered: FilteredMaps) -> float:
        signals = (error * (filtered.expected[i] + dipole) for i, error in zip(parts, errors, strict=True))
        return float(sum(np.dot(filtered.residual[i], signal) for i, signal in zip(parts, signals, strict=True)))

    return value


def _signal_filter(model: Model, effect: Effect, channel: int) -> MatchedFilter:
    """Correlate residuals with the mean of what is added to the samples of every pixel."""
    site, parts = model.survey.channels[channel].site, model.of(channel)
    signals = [signal_of(effect, site, Part.of(model.survey.config, n)) for n in range(len(parts))]
    return lambda filtered: sum(_along(i, signal, filtered) for i, signal in zip(parts, signals, strict=True))


def differencing_filters(model: Model, effect: Effect, channel: int) -> list[MatchedFilter]:
    """Correlate each map's residual with what an effect on differencing does to it.

    That is what map-making leaves of the dipole, or does not reach of the sky that is expected. No filters if there is
    no dipole, or for maps whose pixels are no longer those of the map-making.
    """
    owner, parts = model.survey.making.channels[channel], model.of(channel)
    assert owner.side_b is not None  # only such channels have these candidates
    imbalance, short = effect.differencing(owner.side_b.imbalance, owner.side_b.iterations_short)
    if model.survey.source is not None:
        return []
    if short > owner.side_b.iterations_short:
        return [partial(_unreached, owner, m, i) for i, m in zip(parts, owner.maps, strict=True)]
    if not owner.site.dipole_uk.any():
        return []
    left = differencing.of_dipole(owner, imbalance)
    return [partial(_along, i, map_uk) for i, map_uk in zip(parts, left, strict=True)]


def _along(part: int, map_uk: Map, filtered: FilteredMaps) -> float:
    return float(np.dot(filtered.residual[part], map_uk))


def _unreached(owner: Channel, m: SurveyMap, part: int, filtered: FilteredMaps) -> float:
    return _along(part, differencing.not_converged(owner, m, filtered.expected[part]), filtered)
