"""What a challenge draws: how many effects, which, how strong, and in which direction."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from mcsim.benchmark.truth import Identity, Kind, Member
from mcsim.diagnosis.analysis import Proposal
from mcsim.errors import InputError
from mcsim.sphere import rng
from mcsim.systematics import Effect

Vector = NDArray[np.float64]
WhiteLength = Callable[[Vector], float]
"""Of a change of the evidence, in standard deviations."""

KINDS: tuple[Kind, ...] = ("none", "one", "two", "left_out", "invented")


@dataclass(frozen=True)
class Prior:
    """Shares of the kinds of cases, any scale, and the range of strengths, within which the logarithm is uniform.

    Names are equally probable, then channels, then settings; a strength is the white length of the response in the
    evidence, and its direction isotropic there, as far as the effect's parameters reach.
    """

    none: float = 0.20
    one: float = 0.45
    two: float = 0.15
    left_out: float = 0.12
    invented: float = 0.08
    weakest: float = 3.0
    strongest: float = 20.0

    def __post_init__(self) -> None:
        if not 0.0 < self.weakest < self.strongest:
            raise InputError(
                f"strengths from {self.weakest:g} to {self.strongest:g} are no range; give two numbers above 0."
            )
        if min(self.shares(True)) < 0.0 or sum(self.shares(False)) <= 0.0:
            raise InputError("shares of a challenge must not be negative, nor all zero; correct them.")

    def shares(self, out_of_library: bool) -> Vector:
        """Probabilities of the kinds; nothing is invented where there are no inventions."""
        values = np.array([getattr(self, kind) for kind in KINDS])
        if not out_of_library:
            values[KINDS.index("invented")] = 0.0
        return values / max(float(values.sum()), 1e-300)

    def strength(self, draw: np.random.Generator) -> float:
        """One strength."""
        return float(np.exp(draw.uniform(np.log(self.weakest), np.log(self.strongest))))

    def plain(self) -> dict[str, float]:
        """For JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Drawn:
    """Kind of a case, what acts in it, and what is taken out of the library."""

    kind: Kind
    members: tuple[Member, ...]
    without: tuple[str, ...]


@dataclass(frozen=True)
class OutOfLibrary:
    """An effect that no library has, in one channel, and the response of the evidence to one unit of its amplitude."""

    kind: type[Effect]
    channel: str | None
    response: Vector


@dataclass(frozen=True)
class CaseSampler:
    """Draws cases.

    Attributes
    ----------
    prior
        What is drawn.
    proposals, columns
        Of the full library.
    templates
        Response per unit coordinate, shape (p, K).
    white_length
        Of a change of the evidence.
    inventions
        By name, channel by channel.
    """

    prior: Prior
    proposals: Sequence[Proposal]
    columns: Sequence[tuple[int, ...]]
    templates: NDArray[np.float64]
    white_length: WhiteLength
    out_of_library: Mapping[str, Sequence[OutOfLibrary]]

    def draw(self, kinds: Sequence[Kind], seed: int, case: int) -> Drawn:
        """Case number ``case`` of a challenge with these :meth:`kinds`."""
        kind = kinds[case]
        draw = rng.generator(seed, case, "challenge/effects")
        turn = sum(other == kind for other in kinds[:case])
        if kind == "none":
            return Drawn(kind, (), ())
        if kind == "invented":
            names = sorted(self.out_of_library)
            return Drawn(kind, (self._invented(draw, names[turn % len(names)]),), ())
        if kind == "left_out":
            names = self.names()
            order = rng.generator(seed, 0, "challenge/rotation").permutation(len(names))
            name = names[order[turn % len(names)]]
            return Drawn(kind, (self._member(draw, name),), (name,))
        members: list[Member] = []
        while len(members) < (2 if kind == "two" else 1):
            names = self.names()
            found = self._member(draw, names[int(draw.integers(len(names)))])
            if found.identity not in [member.identity for member in members]:
                members.append(found)
        return Drawn(kind, tuple(members), ())

    def kinds(self, seed: int, count: int, out_of_library: bool) -> list[Kind]:
        """Kinds of the first cases of a challenge; a case's does not depend on how many there are."""
        edges = np.cumsum(self.prior.shares(out_of_library))
        drawn = rng.generator(seed, 0, "challenge/kinds").random(count)
        return [KINDS[min(int(np.searchsorted(edges, value, side="right")), len(KINDS) - 1)] for value in drawn]

    def names(self) -> list[str]:
        """Effects that can be there and are heard, no larger than nature has them."""
        return list(
            dict.fromkeys(self.proposals[index].kind.name for index in range(len(self.proposals)) if self._heard(index))
        )

    def weights(self) -> Vector:
        """Prior probability of every proposal as the only effect."""
        total = np.zeros(len(self.proposals))
        for name in self.names():
            for group in self._channels(name):
                total[group] = 1.0 / len(self.names()) / len(self._channels(name)) / len(group)
        return total

    def _heard(self, index: int) -> bool:
        best = max(self.white_length(self.templates[:, column]) for column in self.columns[index])
        max_amplitude = self.proposals[index].kind.max_amplitude
        return best > 0.0 if np.isinf(max_amplitude) else max_amplitude * best >= self.prior.weakest

    def _channels(self, name: str) -> list[list[int]]:
        """Proposals of an effect, channel by channel."""
        groups: dict[Identity, list[int]] = {}
        for index, proposal in enumerate(self.proposals):
            if proposal.kind.name == name and self._heard(index):
                groups.setdefault((name, proposal.channel), []).append(index)
        return list(groups.values())

    def _member(self, draw: np.random.Generator, name: str) -> Member:
        groups = self._channels(name)
        group = groups[int(draw.integers(len(groups)))]
        index = group[int(draw.integers(len(group)))]
        proposal, t = self.proposals[index], self.templates[:, list(self.columns[index])]
        strength = self.prior.strength(draw)
        gram = np.array([[self._product(t[:, i], t[:, j]) for j in range(t.shape[1])] for i in range(t.shape[1])])
        values, vectors = np.linalg.eigh(gram)
        filtered = values > 1e-9 * values[-1]
        direction = draw.standard_normal(len(values))
        theta = vectors[:, filtered] @ (direction[filtered] / np.sqrt(values[filtered]))
        if proposal.kind.sign:
            theta = np.abs(theta)
        effect = proposal.with_parameters(theta, gram)
        # The parameters reach only some directions, and coordinates need not be linear in the amplitude.
        for _ in range(30):
            length = self.white_length(t @ effect.coordinates())
            powers = np.log(self.white_length(t @ effect.scaled(1.01).coordinates()) / length) / np.log(1.01)
            effect = effect.scaled((strength / length) ** (1.0 / powers))
            if abs(length / strength - 1.0) < 1e-9:
                break
        return Member(
            name,
            proposal.channel,
            {"amplitude": effect.amplitude, **effect.parameters()},
            tuple(float(value) for value in effect.coordinates()),
            self.white_length(t @ effect.coordinates()),
            index,
        )

    def _product(self, a: Vector, b: Vector) -> float:
        return 0.25 * (self.white_length(a + b) ** 2 - self.white_length(a - b) ** 2)

    def _invented(self, draw: np.random.Generator, name: str) -> Member:
        group = self.out_of_library[name]
        invention = group[int(draw.integers(len(group)))]
        strength = self.prior.strength(draw)
        amplitude = strength / self.white_length(invention.response)
        effect = invention.kind(amplitude=amplitude)
        return Member(
            name,
            invention.channel,
            {"amplitude": effect.amplitude, **effect.parameters()},
            (amplitude,),
            strength,
            response=tuple(float(value) for value in amplitude * invention.response),
        )
