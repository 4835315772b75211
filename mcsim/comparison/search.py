"""Find the smallest set of differences that turns the maps of side A into those of side B."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from mcsim.comparison.differences import Difference, State
from mcsim.comparison.pairs import ChannelPair
from mcsim.comparison.scene import Maps, Scene

Vector = NDArray[np.float64]

EXPLAINED = 0.8
"""Share of a difference map's variance that a set must explain to be named."""

FURTHER = 0.7
"""Share of what is left that a further difference must explain to be added."""

LARGEST = 3
"""Differences that act together."""

KEPT = 3
"""Sets of every size from which larger ones are built."""

ALIKE = 2.0
"""Sets that leave at most so many times what the best one leaves are alternatives."""

ENOUGH = 1e-3
"""Share of the variance below which nothing further is looked for: templates are no better."""

PRECISION = 1e-6
"""Share of the variance that no comparison resolves: single precision of maps with a dipole."""


@dataclass(frozen=True, eq=False)
class Set:
    """Differences with their values, and the share of the variance that they leave."""

    members: tuple[tuple[Difference, Vector], ...]
    left: float

    @property
    def explains(self) -> float:
        """Share of the variance of the difference map."""
        return 1.0 - self.left


@dataclass(frozen=True, eq=False)
class Problem:
    """One channel, and what may differ in it.

    Attributes
    ----------
    pair
        The channel on both sides.
    library
        Differences of implementation and effects.
    others
        Side A's maps of the other channels.
    """

    pair: ChannelPair
    library: Sequence[Difference]
    others: dict[str, Maps]

    @cached_property
    def _bare(self) -> Maps | None:
        return None if self.pair.scene is None else self.pair.scene.maps()

    @cached_property
    def total(self) -> float:
        """Sum of squares of the difference over the pixels that are seen."""
        return self._squares(self.pair.a)

    def _squares(self, maps: Maps) -> float:
        return float(np.sum((self.pair.b - maps)[self.pair.seen] ** 2))

    def state(self, members: Sequence[tuple[Difference, Vector]]) -> State:
        """Return the prediction of a set: scenes first, then maps, each in the order of the set."""
        scene: Scene | None = self.pair.scene
        maps = self.pair.a
        if scene is not None and self._bare is not None:
            for difference, value in members:
                scene = difference.scene(scene, value, self.pair)
            if scene is not self.pair.scene:
                maps = maps + (scene.maps() - self._bare)
        state = State(self.pair, scene, maps, self.others)
        for difference, value in members:
            state = replace(state, maps=difference.maps(state.maps, value, state))
        return state

    def left(self, members: Sequence[tuple[Difference, Vector]]) -> float:
        """Return the share of the variance that a set leaves."""
        return self._squares(self.state(members).maps) / self.total

    def best(self, slow: bool = False) -> list[Set]:
        """Return sets of the smallest size that explains the difference, the best first; or of the best size tried.

        A larger set is taken only if its last member explains :data:`FURTHER` of what the smaller one leaves.
        """
        library = [d for d in self.library if slow or not d.slow]
        found = sorted(self._extended((), library), key=lambda one: one.left)
        chosen = found
        for _ in range(LARGEST - 1):
            if not found or found[0].left < ENOUGH:
                break
            larger = [
                one
                for smaller in found[:KEPT]
                for one in self._extended(smaller.members, library)
                if one.left < (1.0 - FURTHER) * smaller.left
            ]
            found = sorted(
                map(self.polished, sorted(larger, key=lambda one: one.left)[:KEPT]), key=lambda one: one.left
            )
            if not found or found[0].left > (1.0 - FURTHER) * chosen[0].left:
                break
            chosen = found
        return chosen

    def _extended(self, members: tuple[tuple[Difference, Vector], ...], library: Sequence[Difference]) -> Iterator[Set]:
        """Yield a set with each further difference of the library, at its best value."""
        state = self.state(members)
        present = {difference.name for difference, _ in members}
        for difference in library:
            if difference.name in present or (difference.needs_scene and state.scene is None):
                continue
            tried = [(*members, (difference, value)) for value in difference.starts(state)]
            if not tried:
                continue
            sets = sorted((Set(one, self.left(one)) for one in tried), key=lambda one: one.left)
            yield self._refined(sets[0], len(members)) if difference.smooth else sets[0]

    def _refined(self, start: Set, index: int) -> Set:
        """Return a set with the value of one smooth member fitted; of equal ones the first start stays."""
        members = list(start.members)
        difference, first = members[index]

        def residual(value: Vector) -> Vector:
            maps = self.state([*members[:index], (difference, value), *members[index + 1 :]]).maps
            return np.asarray((self.pair.b - maps)[self.pair.seen])

        if start.left >= 1.0 and not first.any():
            return start
        scale = np.maximum(np.abs(first), 0.1)
        fit = least_squares(residual, first, x_scale=scale, diff_step=1e-3, max_nfev=8, xtol=1e-7)
        members[index] = (difference, np.asarray(fit.x))
        found = Set(tuple(members), 2.0 * float(fit.cost) / self.total)
        return found if found.left < start.left else start

    def polished(self, found: Set) -> Set:
        """Return a set whose members' values are fitted again, one after the other, beside the others."""
        for _ in range(2):
            for index, (difference, _value) in enumerate(found.members):
                rest = (*found.members[:index], *found.members[index + 1 :])
                again = self._again(difference, rest, index)
                if again is not None and again.left < found.left:
                    found = again
        return found

    def _again(self, difference: Difference, rest: tuple[tuple[Difference, Vector], ...], index: int) -> Set | None:
        tried = [(*rest[:index], (difference, value), *rest[index:]) for value in difference.starts(self.state(rest))]
        sets = sorted((Set(one, self.left(one)) for one in tried), key=lambda one: one.left)
        if not sets:
            return None
        return self._refined(sets[0], index) if difference.smooth else sets[0]


def alternatives(sets: Sequence[Set]) -> list[Set]:
    """Return the other sets that explain a difference as well as the best one does."""
    limit = ALIKE * sets[0].left + PRECISION
    return [one for one in sets[1:] if one.left <= min(limit, 1.0 - EXPLAINED)]
