"""Derivatives of a survey's maps with respect to effects: of the response to the sky, of the mean, of the noise."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mcsim.datavector.analysis import Analysis
from mcsim.datavector.campaign import with_effects
from mcsim.datavector.candidate import Candidate
from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.simulation import convolve, simulate
from mcsim.simulation.survey import Channel, Survey, survey
from mcsim.sphere import alm as alm_
from mcsim.sphere.sky import dipole_alm
from mcsim.support.arrays import Alm, Maps, Vector, divided
from mcsim.systematics import Effect, acts_through, looked_at

Orders = NDArray[np.complex128]  #: of a beam, shape (mmax + 1, lmax + 1)
Observe = Callable[[Alm], Maps]  #: return the maps of all channels, shape (map, npix), of a sky
DRAWS = 64  #: realizations that the mean of an effect of random shape is estimated from, in two halves
STEP = 0.1  #: share of an effect's ``step``: an ellipticity of either sign bends the response by half of itself
NEGLIGIBLE = 1e-12  #: orders whose derivative is below this share of the largest are rounding

_HOOKS = (
    *("sky", "beam", "pointing", "gain", "steady_gain", "signal", "noise", "excess"),
    *("spread", "orientations", "differencing"),
)


@dataclass(frozen=True, eq=False)
class Derivative:
    """Hold the derivative of maps with respect to one coordinate of an effect."""

    maps: slice  #: which maps of the survey change
    #: plus, minus, width: surveys of these maps alone, without noise, and the difference of the coordinate between
    #: them; ``minus`` None: ``plus`` is linear in the sky and is the derivative itself
    plus: Survey
    minus: Survey | None
    width: float
    #: maps of all channels from a sky, for an effect on the sky alone: the response of the inverse covariance, of which
    #: what such an effect changes must be no more and no less; None: the simulator's
    observe: Observe | None
    factor: Vector | None  #: what the sky is multiplied with at first, shape (lmax + 1,); None: nothing
    dipole: Alm  #: coefficients of the dipole that the survey sees besides, uK
    #: derivative of the variance of every pixel, uK^2, shape (own maps, npix); None: it does not change
    noise: Maps | None
    stochastic: bool  #: True if the shape of what is added is random

    def of_sky(self, sky: Alm) -> Maps:
        """Return the derivative of the maps of a sky, without what does not depend on it, uK per unit."""
        return np.asarray(self._changes(sky) - self._constant)

    @cached_property
    def mean(self) -> tuple[Maps, Maps]:
        """Return the derivative of the mean of the maps, uK per unit; two independent estimates if it is random."""
        empty = np.zeros_like(self.dipole)
        if self.minus is None:
            found = self._changes(self.dipole) if self.factor is None else np.zeros_like(self._constant)
            return found, found
        if not self.stochastic:
            found = self._changes(empty, with_dipole=True)
            return found, found
        drawn = [self._changes(empty, realization, with_dipole=True) for realization in range(DRAWS)]
        return np.mean(drawn[::2], axis=0), np.mean(drawn[1::2], axis=0)

    @cached_property
    def _constant(self) -> Maps:
        """What changes in the maps of the first realization whatever the sky, uK per unit, shape (maps, npix)."""
        return self._changes(np.zeros_like(self.dipole))

    def _changes(self, sky: Alm, realization: int = 0, with_dipole: bool = False) -> Maps:
        lmax = self.plus.config.sky.lmax
        seen = sky if self.factor is None else alm_.multiply(sky, self.factor, lmax)
        if self.observe is not None:
            return self._through(self.observe, seen, realization)
        found = _maps(self.plus, seen, realization, with_dipole)
        if self.minus is None:
            return found
        return np.asarray((found - _maps(self.minus, seen, realization, with_dipole)) / self.width)

    def _through(self, observe: Observe, sky: Alm, realization: int) -> Maps:
        """Return what changes in the maps if the sky alone does; channels that see the same share the transforms."""
        found: list[Maps] = []
        last, maps, first = None, np.zeros((0, 0)), self.maps.start
        for number, channel in enumerate(self.plus.channels):
            change = sky
            if self.minus is not None:
                other = self.minus.channels[number]
                upper, lower = (looked_at(one.effects, sky, one.site, 0, realization) for one in (channel, other))
                change = (upper - lower) / self.width
            if last is None or not np.array_equal(change, last):
                last, maps = change, observe(change)
            found.append(maps[first : first + len(channel.maps)])
            first += len(channel.maps)
        return np.concatenate(found)


def _maps(shared: Survey, sky: Alm, realization: int, with_dipole: bool) -> Maps:
    still = (replace(channel, site=replace(channel.site, dipole_uk=np.zeros(3))) for channel in shared.channels)
    seen = shared if with_dipole else replace(shared, channels=tuple(still))
    hit = np.stack([m.moments.hits > 0 for m in shared.maps])
    return np.where(hit, simulate.maps(seen, realization, sky=sky), 0.0)


def derivatives(
    analysis: Analysis, candidates: Sequence[Candidate], observe: Observe, nthreads: int = 1
) -> Iterator[Derivative]:
    """Yield the derivative with respect to every coordinate of candidates, in the order of their columns.

    ``observe`` is the response of the inverse covariance. The effects are those of the simulator, what a run with
    ``[[effect]]`` makes at plus and minus a small amplitude.
    """
    for candidate in candidates:
        for basis in candidate.basis:
            yield _derivative(analysis, candidate, basis.scaled(STEP), observe, nthreads)


def _derivative(analysis: Analysis, candidate: Candidate, basis: Effect, observe: Observe, nthreads: int) -> Derivative:
    fiducial = analysis.model.survey
    run, kind = fiducial.config, type(basis)
    own, first = [], 0
    for channel in fiducial.channels:
        if candidate.channel in (None, channel.name):
            own.append(slice(first, first + len(channel.maps)))
        first += len(channel.maps)
    maps = slice(own[0].start, own[-1].stop)
    only = run if candidate.channel is None else run.of_channels(candidate.channel)
    dipole = dipole_alm(fiducial.channels[0].site.dipole_uk, run.sky.lmax)
    fit = kind.parametrization
    known = dict(analysis.library)

    def at(sign: int) -> Survey:
        changed = with_effects(only, [candidate.table(basis.scaled(sign))]) if sign else only
        return survey(changed, nthreads=nthreads, library=known)

    step = float(np.linalg.norm(fit.coordinates(basis)))
    signs = (1, -1) if fit.sign == 0 else (fit.sign, 0)
    upper, lower = (at(sign) for sign in signs)
    width = step * (signs[0] - signs[1])
    noise = _noise_change(upper, lower, width)
    plus, minus = upper.without_noise, lower.without_noise
    if fit.stochastic and fit.sign < 0:
        # What is drawn is a Gaussian sky of its own with a power proportional to the amplitude.
        own_survey = survey(only, nthreads=nthreads, library=known).without_noise
        factor = _power_factor(own_survey, replace(basis, amplitude=abs(basis.amplitude)), fit.coordinates(basis))
        return Derivative(maps, own_survey, None, 1.0, observe, factor, np.zeros_like(dipole), noise, True)
    changed = [name for name in _HOOKS if acts_through(kind, name)]
    if not run.effects and not set(changed) - {"beam", "pointing"}:
        channels = tuple(_difference(a, b, width) for a, b in zip(plus.channels, minus.channels, strict=True))
        return Derivative(maps, replace(plus, channels=channels), None, 1.0, None, None, dipole, noise, False)
    through = observe if changed == ["sky"] and not fit.stochastic else None
    return Derivative(maps, plus, minus, width, through, None, dipole, noise, fit.stochastic)


def _difference(plus: Channel, minus: Channel, width: float) -> Channel:
    """Return a channel that sees the sky through the derivative of the beams of two, which differ in nothing else."""
    beam = Beam(_slope(plus.beam.blm, minus.beam.blm, width))
    response = convolve.Response(_slope(plus.response.factors, minus.response.factors, width))
    wide = plus if plus.response.mmax >= minus.response.mmax else minus
    return replace(wide, beam=beam, response=response, effects=())


def _slope(a: Orders, b: Orders, width: float) -> Orders:
    """Return (a - b) / width of the orders of two beams, without orders that are rounding alone."""
    change = np.zeros((max(len(a), len(b)), a.shape[1]), dtype=np.complex128)
    change[: len(a)] += a
    change[: len(b)] -= b
    size = np.abs(change).max(axis=1)
    change[size < NEGLIGIBLE * np.abs(a).max()] = 0.0
    return change / width


def _noise_change(plus: Survey, minus: Survey, width: float) -> Maps | None:
    """Return the derivative of the variance of every pixel, None if there is none."""
    ends = []
    for shared in (plus, minus):
        rows = [m.noise_uk for m in shared.maps]
        ends.append(np.stack([np.zeros(12 * shared.nside**2) if row is None else row**2 for row in rows]))
    change = np.asarray((ends[0] - ends[1]) / width)
    return change if change.any() else None


def _power_factor(own: Survey, effect: Effect, coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Q_l / 2 C_l for an effect that adds a random sky of spectrum Q_l times its coordinate, in all channels.

    The covariance changes by P Q P^t, as it does by P F S P^t + P S F P^t with F this factor.
    """
    assert own.cl is not None  # a model of the analysis has one
    lmax, power = own.config.sky.lmax, np.zeros(own.config.sky.lmax + 1)

    def drawn(channel: Channel, realization: int) -> Alm:
        empty = np.zeros(alm_.size(lmax), dtype=np.complex128)
        return looked_at((effect,), empty, channel.site, own.config.ensemble.seed, realization)

    first, *others = own.channels
    if not all(np.allclose(drawn(channel, 0), drawn(first, 0)) for channel in others):
        raise InputError(
            f"effect {effect.name} has sign = -1, so that the power it draws is one for all channels, but it draws "
            'another sky in every one; give it scope = "channel", or leave it out.'
        )
    for realization in range(DRAWS):
        power += alm_.power(drawn(first, realization), lmax)
    power /= DRAWS * (2.0 * np.arange(lmax + 1) + 1.0) * float(np.linalg.norm(coordinates))
    return divided(power, 2.0 * own.cl)
