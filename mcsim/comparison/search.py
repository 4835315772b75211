"""Find the smallest set of differences that turns the maps of side A into those of side B."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from mcsim.comparison.differences import Difference, State
from mcsim.comparison.pairs import ChannelPair
from mcsim.comparison.scene import Maps, Scene, sky_in
from mcsim.systematics.base import Pointing

Vector = NDArray[np.float64]

EXPLAINED = 0.8
"""Share of a difference map's variance that a set must explain to be named, with orientation moments."""

EXPLAINED_BY_SAMPLES = 0.95
"""The same where single samples are simulated, or no simulation is needed."""

FURTHER = 0.7
"""Share of what is left that a further difference must explain to be added."""

LARGEST = 3
"""Differences that act together."""

MEASURED = 4
"""Sets of every size that are simulated sample by sample."""

SAMPLES = 100_000_000
"""Samples of the longest survey of which that is done."""

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

    Sets are searched with orientation moments; those that come first are simulated sample by sample as well, if the
    pointing is known and no longer than :data:`SAMPLES`, and what that changes is added to their predictions.

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
    _corrections: dict[tuple[int, bytes], Maps] = field(default_factory=dict, repr=False)

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
        for difference, value in members:
            maps = maps + self._corrections.get((id(difference), value.tobytes()), 0.0)
        state = State(self.pair, scene, maps, self.others)
        for difference, value in members:
            state = replace(state, maps=difference.maps(state.maps, value, state))
        return state

    def left(self, members: Sequence[tuple[Difference, Vector]]) -> float:
        """Return the share of the variance that a set leaves."""
        return self._squares(self.state(members).maps) / self.total

    @property
    def needed(self) -> float:
        """Share of the variance that a set must explain to be named."""
        simple = self._pointing is not None or self.pair.scene is None
        return EXPLAINED_BY_SAMPLES if simple else EXPLAINED

    @property
    def _pointing(self) -> Pointing | None:
        return pointing_of(self.pair)

    @cached_property
    def _sampled(self) -> Maps:
        assert self.pair.scene is not None
        assert self._pointing is not None
        return self.pair.scene.sampled(self._pointing, self.pair.scene.window)

    def corrected(self, found: Set) -> Set:
        """Return a set with its share measured sample by sample; what is smooth takes one more step."""
        if self._pointing is None or self.pair.scene is None:
            return found
        for difference, value in found.members:
            self._correct(difference, value)
        found = replace(found, left=self.left(found.members))
        for index, (difference, value) in enumerate(found.members):
            if not difference.smooth:
                continue
            step = 1e-3 * max(float(np.abs(value).max()), 1.0)
            ways = [self._moved(found, index, axis) for axis in step * np.eye(value.size)]
            state = self.state(found.members)
            moved = value + step * state.fit([self.state(way).maps - state.maps for way in ways])
            self._correct(difference, moved)
            members = (*found.members[:index], (difference, moved), *found.members[index + 1 :])
            found = min(found, Set(members, self.left(members)), key=lambda one: one.left)
        return found

    def _moved(self, found: Set, index: int, by: Vector) -> tuple[tuple[Difference, Vector], ...]:
        """Return a set's members with one value moved, and the same correction as before."""
        difference, value = found.members[index]
        moved = value + by
        self._corrections[id(difference), moved.tobytes()] = self._corrections.get(
            (id(difference), value.tobytes()), np.zeros_like(self.pair.a)
        )
        return (*found.members[:index], (difference, moved), *found.members[index + 1 :])

    def _correct(self, difference: Difference, value: Vector) -> None:
        """Keep what single samples change in the response to a difference."""
        key, base = (id(difference), value.tobytes()), self.pair.scene
        if key in self._corrections or base is None or self._bare is None or self._pointing is None:
            return
        scene = difference.scene(base, value, self.pair)
        if scene is not base:
            exact: Maps | None = scene.sampled(self._pointing, base.window) - self._sampled
            fast = scene.maps() - self._bare
        else:
            exact = difference.sampled(value, self.pair, self._pointing)
            fast = difference.maps(self.pair.a, value, self.state(())) - self.pair.a
        if exact is not None:
            self._corrections[key] = np.where(self.pair.seen, exact - fast, 0.0)

    def best(self, slow: bool = False) -> list[Set]:
        """Return sets of the smallest size that explains the difference, the best first; or of the best size tried.

        A larger set is taken only if its last member explains :data:`FURTHER` of what the smaller one leaves.
        """
        library = [d for d in self.library if slow or not d.slow]
        found = self._sorted(self._extended((), library))
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

    def _sorted(self, sets: Iterable[Set]) -> list[Set]:
        """Return sets with the best one first, the first ones measured sample by sample."""
        ranked = sorted(sets, key=lambda one: one.left)
        promising = [one for one in ranked if one.left < 0.5][:MEASURED]
        ranked[: len(promising)] = map(self.corrected, promising)
        return sorted(ranked, key=lambda one: one.left)

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


def pointing_of(pair: ChannelPair) -> Pointing | None:
    """Return the pointing of a channel, where its single samples can be simulated."""
    pointing = None if pair.channel is None else pair.channel.site.pointing
    return None if pointing is None or pointing.model.samples(pointing.line) > SAMPLES else pointing


def with_sharper_sky(pair: ChannelPair, iterations: int = 2) -> ChannelPair:
    """Return a pair whose sky, which is taken from side A, makes its maps sample by sample too."""
    scene, pointing = pair.scene, pointing_of(pair)
    if scene is None or pointing is None:
        return pair
    for _ in range(iterations):
        missing = np.where(pair.seen, pair.a - scene.sampled(pointing, scene.window), 0.0)
        empty = replace(scene, sky=np.zeros_like(scene.sky))
        scene = replace(scene, sky=scene.sky + sky_in(missing, pair.seen, empty, 2))
    return replace(pair, scene=scene)


def alternatives(sets: Sequence[Set], needed: float) -> list[Set]:
    """Return the other sets that explain a difference as well as the best one does."""
    limit = min(ALIKE * sets[0].left + PRECISION, 1.0 - needed)
    return [one for one in sets[1:] if one.left <= limit]
