"""Nuisances: effects of unknown size with a prior, which every simulation of a model draws anew."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim import config, systematics
from mcsim.config.messages import standing
from mcsim.errors import InputError
from mcsim.simulation import convolve
from mcsim.simulation.channels import check_scope, refuse_misplaced, site_of, table_of
from mcsim.simulation.pixel_means import (
    Part,
    drifts,
    gain_of,
    gain_of_all,
    is_linear,
    mean_gain,
    mean_signal,
    signal_of,
)
from mcsim.simulation.survey import Channel, Survey, survey, with_effects
from mcsim.sphere import rng
from mcsim.support.arrays import Vector
from mcsim.systematics import Effect, Library, acts_through, basis_of, seen_through, shared_gain, spread_of, tried

_OF_BEAMS = ("beam", "pointing", "spread")

REACH = 4.0  #: largest draw in prior widths; a nuisance must be possible up to there


@dataclass(frozen=True)
class Nuisance:
    """What is known of an effect before the data: its linear coordinates are independent, normal about zero.

    An effect of one sign is half-normal: the absolute value is drawn.
    """

    effect: type[Effect]
    channel: str | None  # None: acts in all
    widths: tuple[float, ...]  # prior standard deviation of each coordinate, in the unit of the amplitude
    settings: Mapping[str, Any] = field(default_factory=dict)  # parameters that are not drawn, or the centre of those
    parameter_widths: Mapping[str, float] = field(default_factory=dict)

    @property
    def centre(self) -> Effect:
        """Return the effect with the parameters that are given, or its own, which its coordinates do not change."""
        return self.effect(**self.settings)

    @property
    def title(self) -> str:
        """Return the effect in words, with channel and settings."""
        drawn = [f"{key} ± {width:g}" for key, width in self.parameter_widths.items()]
        return ", ".join((self.effect.label(self.channel, self.settings), *drawn))

    @property
    def mean(self) -> Vector:
        """Return the prior mean of the coordinates, shape (k,)."""
        return np.array(self.widths) * (np.sqrt(2.0 / np.pi) if self._one_sided else 0.0)

    @property
    def sigma(self) -> Vector:
        """Return the prior standard deviation of the coordinates, shape (k,)."""
        return np.array(self.widths) * (np.sqrt(1.0 - 2.0 / np.pi) if self._one_sided else 1.0)

    @property
    def lines(self) -> tuple[str, ...]:
        """Return the prior of each component in words."""
        said = [self.effect.format_amplitude(float(m), float(s)) for m, s in zip(self.mean, self.sigma, strict=True)]
        if len(set(said)) == 1:
            return (f"{self.title}: {said[0]}" + (f" in each of {len(said)} components" if len(said) > 1 else ""),)
        return tuple(f"{self.title}, component {k}: {words}" for k, words in enumerate(said, 1))

    @property
    def _one_sided(self) -> bool:
        return self.effect.parametrization.sign != 0

    @property
    def subtractable(self) -> bool:
        """Return True if maps can be rid of it: it is linear, of either sign, and nothing of it is random."""
        how = self.effect.parametrization
        random = how.stochastic or how.noise_alone or acts_through(self.effect, "noise")
        return not (random or how.mean_response or how.nonlinear or how.sign or self.parameter_widths)

    def at(self, coordinates: Vector, **parameters: float) -> Effect:
        """Return the effect at coordinates, shape (k,)."""
        own = self.effect.parametrization.nearest(coordinates, np.eye(len(coordinates)))
        return self.effect(**{**own, **self.settings, **parameters})

    def draw(self, generator: np.random.Generator) -> tuple[Vector, Effect]:
        """Draw coordinates, shape (k,), and the effect there."""
        k, names = len(self.widths), list(self.parameter_widths)
        normal = np.clip(generator.standard_normal(k + len(names)), -REACH, REACH)
        coordinates = np.array(self.widths) * (np.abs(normal[:k]) if self._one_sided else normal[:k])
        own = {
            name: self._centre(name) + self.parameter_widths[name] * z
            for name, z in zip(names, normal[k:], strict=True)
        }
        return coordinates, self.at(coordinates, **own)

    def extremes(self) -> Iterator[Effect]:
        """Yield the effect at its largest draws, component by component, and with each parameter at either end."""
        for row, sign in ((row, sign) for row in REACH * np.diag(self.widths) for sign in (1.0, -1.0)):
            if sign > 0.0 or not self._one_sided:
                effect = self.at(sign * row)
                if not np.allclose(self.effect.parametrization.coordinates(effect), sign * row):
                    raise InputError(f"effect {effect.name} can have no component of {sign * row.max():g}.")
                yield effect
        for name, width in self.parameter_widths.items():
            for sign in (REACH, -REACH):
                yield self.at(np.array(self.widths), **{name: self._centre(name) + sign * width})

    def _centre(self, name: str) -> float:
        return float(self.settings.get(name, getattr(self.effect(), name)))


Drawn = tuple[tuple[Nuisance, Effect], ...]  #: nuisances with the effects that are drawn from them


def nuisances_of(run: config.RunConfig, library: Library | None = None) -> tuple[Nuisance, ...]:
    """Return the nuisances of a run, in its order.

    ``library``: default: the catalogue. Raise InputError for an effect or a parameter that is not known, a channel that
    is missing or superfluous, another number of widths than the effect has components, and a second table of one.
    """
    found: list[Nuisance] = []
    for number, entry in enumerate(run.nuisances):
        with standing(run, f"nuisance[{number}]"):
            one = _nuisance(run, entry, library)
            if any((one.channel, one.centre) == (e.channel, e.centre) for e in found):
                where = "" if one.channel is None else f" of {one.channel}"
                raise InputError(
                    f"nuisance {one.effect.name}{where} is declared twice; keep one table, with its own width."
                )
        found.append(one)
    return tuple(found)


def _nuisance(run: config.RunConfig, entry: config.Nuisance, library: Library | None) -> Nuisance:
    kind = systematics.get(entry.effect, library)
    check_scope(f"nuisance {kind.name}", kind, entry.channel, run)
    k = len(kind.parametrization.basis())
    if len(entry.width) not in (1, k):
        numbers = "1 number" if k == 1 else f"1 or {k} numbers"
        raise InputError(f"nuisance {kind.name}: width has {len(entry.width)} numbers; give {numbers}.")
    widths = entry.width if len(entry.width) == k else entry.width * k
    fitted = {"amplitude", *kind.parametrization.nearest(np.ones(k), np.eye(k))}
    free = [f.name for f in fields(kind) if f.name not in fitted]
    for name in (*entry.parameters, *entry.parameter_widths):
        if name not in free:
            remedy = f"it has {', '.join(free)}" if free else "it has none"
            raise InputError(f"nuisance {kind.name} has no parameter {name!r} beside what its width is of; {remedy}.")
    built = systematics.build(kind, dict(entry.parameters))
    settings = {name: getattr(built, name) for name in entry.parameters}
    for name in entry.parameter_widths:
        if not isinstance(getattr(built, name), float):
            raise InputError(f"nuisance {kind.name}: {name} is no number; remove it from parameter_widths.")
    return Nuisance(kind, entry.channel, widths, settings, dict(entry.parameter_widths))


def check_nuisances(run: config.RunConfig, library: Library | None = None) -> int:
    """Return the highest order of the beams that nuisances can make.

    Raise InputError for one that is not known or acts on what its channel does not have, or that four prior widths make
    impossible.
    """
    orders = 0
    for number, one in enumerate(nuisances_of(run, library)):
        with standing(run, f"nuisance[{number}]"):
            orders = max(orders, _orders_at_most(run, one))
    return orders


def _orders_at_most(run: config.RunConfig, one: Nuisance) -> int:
    orders = 0
    channels = [spec for spec in run.channels if one.channel in (None, spec.name)]
    for spec in channels:
        refuse_misplaced(run, spec, (one.at(np.array(one.widths)),))
    try:
        for effect, spec in product(one.extremes(), channels):
            refuse_misplaced(run, spec, (effect,))
            orders = max(orders, tried((effect,), site_of(run, spec)).mmax)
    except InputError as error:
        text = str(error).rstrip(".")
        raise InputError(
            f"nuisance {one.effect.name}: draws reach {REACH:g} prior widths, and there {text}; lower the width or "
            "remove the nuisance."
        ) from None
    return orders


def draws(nuisances: Sequence[Nuisance], seed: int, realization: int) -> tuple[Vector, Drawn]:
    """Draw all nuisances of one realization: their coordinates, one after the other, and their effects.

    A nuisance that is added does not change those before it; another width changes only the scale.
    """
    found = [one.draw(rng.generator(seed, realization, f"nuisance/{number}")) for number, one in enumerate(nuisances)]
    coordinates = [values for values, _ in found]
    effects = tuple((one, effect) for one, (_, effect) in zip(nuisances, found, strict=True))
    return np.concatenate(coordinates) if coordinates else np.zeros(0), effects


def tables(run: config.RunConfig, seed: int, realization: int, library: Library | None = None) -> list[config.Effect]:
    """Return one draw of the nuisances of a run as its ``[[effect]]``, to simulate data with."""
    drawn = draws(nuisances_of(run, library), seed, realization)[1]
    return [table_of(effect, one.channel) for one, effect in drawn]


@dataclass(frozen=True, eq=False)
class DisturbedSurvey:
    """Make the survey of every realization, with the nuisances that it draws; what they leave alone is shared."""

    survey: Survey
    nuisances: tuple[Nuisance, ...]
    library: Library | None = None

    @classmethod
    def of(cls, run: config.RunConfig, library: Library | None = None) -> "DisturbedSurvey":
        """Prepare a run; InputError as of :func:`check_nuisances`."""
        orders = check_nuisances(run, library)
        return cls(survey(run, orders=orders, library=library), nuisances_of(run, library), library)

    def at(self, realization: int) -> Survey:
        """Return the survey of one realization."""
        shared = self.survey
        _, drawn = draws(self.nuisances, shared.config.ensemble.seed, realization)
        if any(channel.side_b is not None for channel in shared.channels):
            run = shared.config
            acting = (*run.effects, *tables(run, run.ensemble.seed, realization, self.library))
            return survey(replace(run, effects=acting), library=self.library)
        channels = tuple(self._disturbed(channel, drawn) for channel in shared.making.channels)
        if shared.source is None:
            return replace(shared, channels=channels)
        return replace(shared, source=replace(shared.source, channels=channels))

    def _disturbed(self, channel: Channel, drawn: Drawn) -> Channel:
        """Return a channel with the effects that are drawn for it after its own."""
        more = tuple(effect for one, effect in drawn if one.channel in (None, channel.name))
        site = channel.site
        acting = (*channel.effects, *more)
        beam, response = channel.beam, channel.response
        if any(acts_through(effect, *_OF_BEAMS) for effect in more):
            beam = seen_through(acting, site)
            beam = beam.truncated(min(beam.mmax, *(m.moments.smax for m in channel.maps)))
            response = convolve.response(beam, site.lmax, replace(channel, effects=acting).seen_window)
        moved = spread_of(acting) != 1.0  # signals of a direction are then not linear in coordinates
        bent = tuple(
            effect
            for number, (one, effect) in enumerate(drawn)
            if number in self._bent and one.channel in (None, channel.name)
        )
        maps = []
        for place, m in enumerate(channel.maps):
            part = Part.of(self.survey.config, place)
            gains = [self._own_gains[channel.name][place], mean_gain(bent, site, part, self._orders(channel))]
            signals = [mean_signal(acting, site, part)] if moved else [m.signal_uk, mean_signal(bent, site, part)]
            for (number, name, key), basis in self._means.items():
                if name == channel.name and not (moved and key == "signal"):
                    coordinates = drawn[number][1].parametrization.coordinates(drawn[number][1])
                    (gains if key == "gain" else signals).append(np.tensordot(coordinates, basis[place], 1))
            own, steady = with_effects(m, more, site), shared_gain(acting, replace(site, split=part.split))
            maps.append(replace(own, gain=_sum(gains), steady_gain=steady, signal_uk=_sum(signals)))
        return replace(channel, beam=beam, response=response, maps=tuple(maps), effects=acting)

    def _orders(self, channel: Channel) -> int:
        """Return the highest order that the beam of a channel can have in a realization."""
        turned = any(acts_through(one.effect, *_OF_BEAMS) for one in self.nuisances)
        return max(m.moments.smax for m in channel.maps) if turned else channel.beam.mmax

    @cached_property
    def _own_gains(self) -> dict[str, list[NDArray[np.complex128] | None]]:
        """Return the errors of the gain that the run has itself, for all orders that beams can have, by channel."""
        found: dict[str, list[NDArray[np.complex128] | None]] = {}
        for channel in self.survey.making.channels:
            rows = self._orders(channel) + 2
            found[channel.name] = [
                m.gain[:rows]
                if m.gain is not None and len(m.gain) >= rows
                else gain_of_all(channel.effects, channel.site, Part.of(self.survey.config, place), rows - 2)
                for place, m in enumerate(channel.maps)
            ]
        return found

    @cached_property
    def _bent(self) -> frozenset[int]:
        """Return the nuisances whose gain or signal is not linear in what is drawn: they take a pass for every draw."""
        part = Part.of(self.survey.config, 0)
        sites = [channel.site for channel in self.survey.making.channels]
        return frozenset(
            number
            for number, one in enumerate(self.nuisances)
            if one.parameter_widths
            or not all(
                is_linear(one.at(np.array(one.widths)), site, part)
                for site in sites
                if one.channel in (None, site.channel)
            )
        )

    @cached_property
    def _means(self) -> dict[tuple[int, str, str], list[NDArray]]:
        """Return the mean errors of the gain, and signals, per coordinate: linear in these, they take a pass each.

        By nuisance, channel, and name in a map: one array for each map of the channel, shape (k, npix), of the gain
        (k, orders + 2, npix).
        """
        found = {}
        linear = [(number, one) for number, one in enumerate(self.nuisances) if number not in self._bent]
        for (number, one), channel in product(linear, self.survey.making.channels):
            of_orders = partial(gain_of, orders=self._orders(channel))
            for hook, mean in (("gain", of_orders), ("signal", signal_of)):
                if not acts_through(one.effect, hook) or one.channel not in (None, channel.name):
                    continue
                basis = basis_of(one.effect, one.settings)
                if hook == "gain" and not any(drifts(effect, channel.site) for effect in basis):
                    continue
                parts = [Part.of(self.survey.config, n) for n in range(len(channel.maps))]
                found[number, channel.name, hook] = [
                    np.stack([mean(effect, channel.site, part) / effect.amplitude for effect in basis])
                    for part in parts
                ]
        return found


def _sum(terms: Sequence[NDArray | None]) -> NDArray | None:
    """Return the sum of arrays of maps, None for no map."""
    maps = [term for term in terms if term is not None]
    return sum(maps[1:], start=maps[0]) if maps else None
