"""Effects of the library as differences between two simulations: side B has one that side A lacks."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import healpy
import numpy as np

from mcsim import config
from mcsim.comparison.description import STAGES, quiet
from mcsim.comparison.differences import Difference, State
from mcsim.comparison.pairs import ChannelPair
from mcsim.comparison.scene import Maps, Scene
from mcsim.instrument.beams import Beam
from mcsim.simulation import sampled, simulate
from mcsim.simulation.channels import table_of
from mcsim.simulation.survey import Survey, survey
from mcsim.sphere import alm as alm_
from mcsim.support.arrays import Alm, Vector
from mcsim.systematics import Effect, acts_through, described, if_possible
from mcsim.systematics.registry import basis_of, catalogue

REDUNDANT = ("monopole_residual", "pixelization", "spectrum")
"""monopole and pixel_centres are differences already; two sides have a sky, and its power, in common."""

GAIN = "calibration"
"""A factor of all that samples see, exact at any size: a difference already, but for a dipole that maps lack."""

ROUNDING = 1e-9
"""Largest response to a step over the rms of the maps that rounding makes; those of the library are above 1e-4."""

BEAM_STAGES = ("beam", "pointing", "spread", "orientations")  #: where an effect acts on how the sky is seen


class EffectDifference(Difference):
    """An effect of the library, linear in its coordinates.

    The response of one that acts on beam or pointing is not larger than the sky and the dipole that it changes:
    templates are those of small amplitudes. Others, and a gain, are bounded as in a diagnosis.
    """

    proportional = True
    natural = 1e-9
    stage = 1

    def __init__(
        self, kind: type[Effect], templates: Maps, run: config.RunConfig, sky: Alm, dipole_uk: float = 0.0
    ) -> None:
        self.kind, self.templates, self.run, self.sky = kind, templates, run, sky
        self.name, self.unit, self.met = kind.name, kind.unit, kind.cause
        self.linear = kind.name != GAIN
        self._there: dict[tuple[Any, ...], Maps] = {}  # by what the templates depend on
        self._products = np.tensordot(templates, templates, ((1, 2), (1, 2))) / templates[0].size
        power = healpy.alm2cl(sky)
        self._largest = float((2 * np.arange(power.size) + 1) @ power) / (4.0 * np.pi) + dipole_uk**2 / 3.0

    def starts(self, state: State) -> list[Vector]:
        return [self.within(state.fit(list(self.templates)))]

    def within(self, value: Vector) -> Vector:
        """Return the coordinates, or smaller ones in proportion whose response is possible."""
        size = float(value @ self._products @ value) / max(self._largest, 1e-300)
        if not self.linear or not acts_through(self.kind, *BEAM_STAGES):
            highest = min([np.inf, *(max(-b.low, b.high) for b in self.kind.bounds if b.parameter == "amplitude")])
            size = (self.amplitude(value) / highest) ** 2
        return value / max(1.0, float(np.sqrt(size)))

    def inverse(self, value: Vector) -> Vector:
        return self.kind.parametrization.coordinates(self._effect(value).inverse())

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return maps + np.tensordot(value, self._templates_in(state), 1)

    def _templates_in(self, state: State) -> Maps:
        """Return the templates of one sky, those of samples that are late, or move otherwise, if the scene has them."""
        scene, pair = state.scene, state.pair
        if scene is None or not (scene.late or scene.motion):
            return self.templates
        # A few per cent of a shift or a turn do not matter.
        late, turn = (float(f"{value:.2g}") for value in (scene.late, scene.psi[1]))
        scene = replace(scene.turned(turn - scene.psi[1]), late=late, sky=self.sky)
        periods = None if scene.motion is None else (scene.motion.spin_period_s, scene.motion.precession_period_s)
        key = scene.beam.blm.tobytes(), scene.window.tobytes(), (late, turn, scene.psi[0], scene.centred), periods
        if key not in self._there:
            basis = basis_of(self.kind)
            made = self.templates
            with if_possible():  # it may need more orders than moments of another motion have
                made = np.stack([self._response(effect, scene, pair) / _scale(self.kind, effect) for effect in basis])
            self._there[key] = np.where(pair.seen, made, 0.0)
        return self._there[key]

    def response(self, value: Vector, scene: Scene, pair: ChannelPair) -> Maps | None:
        """Return the effect's response on a scene; None if it cannot be so large."""
        with if_possible():
            return self._response(self._effect(value), scene, pair)
        return None

    def _response(self, effect: Effect, scene: Scene, pair: ChannelPair) -> Maps:
        beam = scene.displaced_beam
        if beam is not scene.beam:  # which the effect may displace further
            beam = beam.truncated(min(beam.mmax, scene.moments[0].smax - 1))
        bare, acting = (
            simulate.maps(_with_moments_of(scene, _survey(run, scene)), 0, scene.nthreads, self._sky(scene, pair))
            for run in self._runs(effect, scene, pair, beam)
        )
        return acting - bare

    def sampled(self, value: Vector, scene: Scene, pair: ChannelPair) -> Maps | None:
        """Return the response of the time-ordered reference; None if the effect does not act on samples."""
        pointing = pair.pointing()
        assert pair.scene is not None
        assert pointing is not None
        sky: Any = scene.sky_of_samples(pair.scene.window)  # an array stands for a file

        def made(run: config.RunConfig) -> Maps:
            run = replace(run, sky=replace(run.sky, spectrum=None, map=None, alm=sky))
            whole = _with_samples_of(scene, _survey(run, scene))
            return np.stack([m for _, m in sampled.maps(whole, 0, scene.nthreads)])

        alone, acting = self._runs(self._effect(value), scene, pair, scene.beam)
        more = None
        with if_possible():
            more = made(acting)
        if more is None:
            return None
        if alone.sky.dipole_uk:  # which a scene has not, and late samples see elsewhere
            return more - made(alone)
        bare = scene if scene.added is None else replace(scene, added=None)
        return more - bare.sampled(pointing, pair.scene.window)

    def _sky(self, scene: Scene, pair: ChannelPair) -> Alm:
        """Return the sky of a scene, with what its pixel window has more than the samples' spread makes."""
        assert pair.scene is not None
        factor = np.ones_like(scene.window) if scene.centred else scene.window / pair.scene.window
        return alm_.multiply(scene.sky, factor, scene.lmax)

    def _runs(
        self, effect: Effect, scene: Scene, pair: ChannelPair, beam: Beam
    ) -> tuple[config.RunConfig, config.RunConfig]:
        """Return the run through a beam turned as in a scene, without the effect and with it."""
        assert pair.channel is not None
        [channel] = self.run.channels
        if beam is not pair.channel.site.beam or scene.psi[1]:
            turn = np.exp(-1j * np.arange(beam.mmax + 1) * scene.psi[1])
            table: Any = replace(beam, blm=turn[:, None] * beam.blm)
            channel = replace(channel, beam=table)
        alone = replace(self.run, channels=(channel,))
        return alone, replace(alone, effects=(table_of(effect, pair.name if effect.scope == "channel" else None),))

    def _effect(self, value: Vector) -> Effect:
        return self.kind(**self.kind.parametrization.nearest(value, np.eye(value.size)))

    def amplitude(self, value: Vector) -> float:
        return float(self._effect(value).amplitude)

    def said(self, value: Vector) -> str:
        """Return the words of an effect whose negative amplitude has words of its own."""
        amplitude, wording = self.amplitude(value), self.kind.wording
        own = wording is not None and wording.negative is not None and amplitude < 0.0
        return self.kind.format_amplitude(amplitude) if own else ""

    def found(self, value: Vector) -> str:
        """Return the effect of side A, which only some effects of side B take back exactly."""
        return f"in side A: {described(self._effect(value), self.run.map.frame)}"

    def parameters(self, value: Vector) -> dict[str, float | str]:
        return {k: v for k, v in self._effect(value).parameters().items() if isinstance(v, float | str)}


def effects_of(pair: ChannelPair, run: config.RunConfig) -> Iterator[EffectDifference]:
    """Yield the effects to which the noise-free maps of a channel respond, with their templates per coordinate."""
    if pair.scene is None or pair.channel is None:
        return
    dipole_uk = float(np.linalg.norm(pair.channel.site.dipole_uk))
    alone = quiet(run.of_channels(pair.name))
    scene = pair.scene

    def made(acting: config.RunConfig) -> Maps:
        return simulate.maps(_survey(acting, scene), 0, scene.nthreads, scene.sky)

    bare = made(alone)
    for name, kind in catalogue().items():
        redundant = name in REDUNDANT or (name == GAIN and not run.sky.dipole_uk)
        if kind.parametrization.stochastic or redundant or not kind.proposed or not acts_through(kind, *STAGES):
            continue
        templates, channel = None, pair.name if kind.scope == "channel" else None
        with if_possible():  # it may depend on what the model does not say: a frequency, a pointing
            acting = [replace(alone, effects=(table_of(effect, channel),)) for effect in basis_of(kind)]
            changes = [(made(one) - bare) / _scale(kind, of) for one, of in zip(acting, basis_of(kind), strict=True)]
            templates = [np.where(pair.seen, change, 0.0) for change in changes]
        if templates is None:
            continue
        # Orientations of the scan itself, say, respond by rounding alone, which an amplitude of 1e11 would fit.
        changes = [np.abs(t).max() * _scale(kind, effect) for t, effect in zip(templates, basis_of(kind), strict=True)]
        if max(changes) > ROUNDING * np.std(bare[pair.seen]):
            yield EffectDifference(kind, np.stack(templates), alone, scene.sky, dipole_uk)


@dataclass(frozen=True, kw_only=True)
class _Seen(Effect):
    """Samples as a scene has them: late by ``late_s`` seconds, orientations of a ``sign``, at the centres of pixels."""

    name = "seen"
    scope = "channel"
    unit = ""
    cause = signature = "Another implementation."
    step = 1.0

    late_s: float
    sign: int
    centred: bool

    def lags(self) -> tuple[tuple[float, float], ...]:
        """Return the one delay."""
        return ((1.0, -self.late_s),)

    def moved(self, theta: Vector, phi: Vector, psi: Vector) -> tuple[Vector, Vector, Vector]:
        """Return samples with their orientation of this sign."""
        return theta, phi, self.sign * psi

    def spread(self) -> float:
        """Return the factor of the samples' offsets from their pixels' centres."""
        return 0.0 if self.centred else 1.0


def _scale(kind: type[Effect], effect: Effect) -> float:
    """Return the size of the coordinates of an effect."""
    return float(np.max(np.abs(kind.parametrization.coordinates(effect))))


def _with_moments_of(scene: Scene, whole: Survey) -> Survey:
    """Return the survey of one channel with the moments of the motion of a scene, orientations counted as they were."""
    if scene.motion is None or whole.source is not None:
        return whole
    own = scene.turned(-scene.psi[1])
    own = own if scene.psi[0] > 0 else own.reversed()
    [channel] = whole.channels
    maps = tuple(replace(m, moments=moments) for m, moments in zip(channel.maps, own.moments, strict=True))
    return replace(whole, channels=(replace(channel, maps=maps),))


def _with_samples_of(scene: Scene, whole: Survey) -> Survey:
    """Return the survey of one channel with the samples of a scene, beside its offset of psi, which its beam has."""
    [channel], late = whole.making.channels, 0.0
    site, known = channel.site, channel.site.pointing
    if known is not None:
        late = scene.late * known.model.period_of_samples(known.line)
        site = replace(site, pointing=replace(known, model=scene.motion or known.model))
    otherwise = bool(late) or scene.psi[0] < 0 or scene.centred
    seen = (_Seen(late_s=late, sign=scene.psi[0], centred=scene.centred),) if otherwise else ()
    return replace(whole.making, channels=(replace(channel, site=site, effects=(*seen, *channel.effects)),))


def _survey(run: config.RunConfig, scene: Scene) -> Survey:
    """Return the survey of a run with all orders of the moments of a scene, which are known."""
    return survey(run, scene.nthreads, orders=scene.moments[0].smax)
