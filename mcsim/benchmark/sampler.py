"""Draw cases: how many effects act, which, how strong, and in which direction."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from mcsim.benchmark.case import KINDS, Drawn, Kind, Member, Prior
from mcsim.benchmark.models import EffectsLibrary
from mcsim.datavector.out_of_library import OutOfLibrary
from mcsim.errors import InputError
from mcsim.sphere import rng
from mcsim.support.arrays import Vector


@dataclass(frozen=True)
class CaseSampler:
    """Draw cases from a prior: effects of a library, and effects that no library has, by name, channel by channel."""

    prior: Prior
    effects_library: EffectsLibrary
    out_of_library: Mapping[str, Sequence[OutOfLibrary]] = field(default_factory=dict)

    def draw(self, kinds: Sequence[Kind], seed: int, case: int) -> Drawn:
        """Draw case number ``case`` of a challenge with these :meth:`kinds`."""
        kind = kinds[case]
        draw = rng.generator(seed, case, "challenge/effects")
        turn = sum(other == kind for other in kinds[:case])
        if kind == "invented":
            names = sorted(self.out_of_library)
            return Drawn(kind=kind, members=(self._out_of_library(draw, names[turn % len(names)]),))
        if kind == "left_out":
            self._check(1)
            order = rng.generator(seed, 0, "challenge/rotation").permutation(len(self.names))
            name = self.names[order[turn % len(order)]]
            return Drawn(kind=kind, members=(self._member(draw, name),), without=(name,))
        return Drawn(kind=kind, members=self.members(draw, {"none": 0, "one": 1, "two": 2}[kind]))

    def members(self, draw: np.random.Generator, wanted: int) -> tuple[Member, ...]:
        """Draw effects that act together, each with a strength of its own."""
        self._check(wanted)
        members: dict[tuple[str, str | None], Member] = {}
        while len(members) < wanted:
            found = self._member(draw, self.names[int(draw.integers(len(self.names)))])
            members.setdefault(found.identity, found)
        return tuple(members.values())

    def _check(self, wanted: int) -> None:
        """Raise InputError if fewer effects than a case needs can be drawn."""
        known = sum(map(len, self._groups.values()))
        if known < wanted:
            raise InputError(
                f"a case with {wanted} effect{'s' * (wanted > 1)} needs as many that reach a signal-to-noise ratio of "
                f"{self.prior.weakest:g} at a possible amplitude, but the model has {known}; give it less noise or "
                "more effects, or draw no such case."
            )

    def kinds(self, seed: int, count: int, out_of_library: bool = False) -> list[Kind]:
        """Draw the kinds of the first cases of a challenge; that of a case does not depend on their number."""
        edges = np.cumsum(self.prior.shares(out_of_library))
        drawn = rng.generator(seed, 0, "challenge/kinds").random(count)
        return [KINDS[min(int(np.searchsorted(edges, value, side="right")), len(KINDS) - 1)] for value in drawn]

    @property
    def names(self) -> list[str]:
        """Effects that can reach the smallest expected S/N at an amplitude that is possible."""
        return list(self._groups)

    @cached_property
    def weights(self) -> Vector:
        """Prior probability of each candidate as the only effect, shape (candidates,)."""
        total = np.zeros(len(self.effects_library.candidates))
        for channels in self._groups.values():
            for group in channels:
                total[group] = 1.0 / len(self._groups) / len(channels) / len(group)
        return total

    @cached_property
    def _groups(self) -> dict[str, list[list[int]]]:
        """Candidates that can be drawn: name by name, channel by channel."""
        found: dict[str, dict[str | None, list[int]]] = {}
        for index, candidate in enumerate(self.effects_library.candidates):
            largest = float(np.max(np.linalg.norm(self._white(index), axis=0)))
            # Of an effect without response and without a limit the product is NaN, which is not larger.
            if candidate.largest * largest >= self.prior.weakest:
                found.setdefault(candidate.name, {}).setdefault(candidate.channel, []).append(index)
        return {name: list(channels.values()) for name, channels in found.items()}

    def _white(self, index: int) -> Vector:
        """Return the templates of a candidate in units of their standard deviations, shape (p, k)."""
        null = self.effects_library.null
        t = self.effects_library.templates[:, list(self.effects_library.candidates[index].columns)]
        return np.sqrt(null.hartlap_factor) * null.whiten_templates(t)

    def _member(self, draw: np.random.Generator, name: str) -> Member:
        """Draw channel, settings, strength and direction of an effect of the library."""
        channels = self._groups[name]
        group = channels[int(draw.integers(len(channels)))]
        index = group[int(draw.integers(len(group)))]
        candidate, white = self.effects_library.candidates[index], self._white(index)
        strength = self.prior.strength(draw)
        effect = candidate.of_strength(strength, white, draw.standard_normal(len(candidate.columns)))
        coordinates = candidate.parametrization.coordinates(effect)
        parameters = {"amplitude": effect.amplitude, **effect.parameters()}
        reached = float(np.linalg.norm(white @ coordinates))
        return Member(name, candidate.channel, parameters, tuple(map(float, coordinates)), reached, index)

    def _out_of_library(self, draw: np.random.Generator, name: str) -> Member:
        """Draw channel and strength of an effect that no library has."""
        group = self.out_of_library[name]
        one = group[int(draw.integers(len(group)))]
        strength = self.prior.strength(draw)
        amplitude = strength / self.effects_library.null.expected_snr(one.response)
        effect = one.kind(amplitude=amplitude)
        parameters = {"amplitude": effect.amplitude, **effect.parameters()}
        response = tuple(map(float, amplitude * one.response))
        return Member(name, one.channel, parameters, (amplitude,), strength, response=response)
