"""Find the smallest set of differences that turns the maps of side A into those of side B."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import healpy
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from mcsim.comparison.differences import Difference, State
from mcsim.comparison.pairs import ChannelPair
from mcsim.comparison.scene import Maps, PointingFiles, Scene, sky_in
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.systematics.base import Pointing

Vector = NDArray[np.float64]

EXPLAINED = 0.8
"""Share of a difference map's variance that a set must explain to be named, with orientation moments or noisy maps."""

EXPLAINED_BY_SAMPLES = 0.95
"""The same where single samples are simulated, or no simulation is needed."""

FURTHER = 0.7
"""Share of what is left that a further difference must explain to be added."""

FURTHER_BEYOND = 0.85
"""The same where what there is explains enough to be named."""

SLIGHT = 0.1
"""Share that a difference must explain to be fitted further, or to be one of several."""

LARGEST = 3
"""Differences that act together."""

DOUBTFUL = 0.01
"""Share of what a set that is named may leave, beyond which slow differences are tried all the same."""

MEASURED = 4
"""Sets of every size that are simulated sample by sample."""

WORTH = 0.9
"""Share of the variance that a set may leave at most to be simulated sample by sample."""

KEPT = 3
"""Sets of every size from which larger ones are built."""

ALIKE = 2.0
"""Sets that leave at most so many times what the best one leaves are alternatives."""

ENOUGH = 1e-3
"""Share of the variance below which nothing further is looked for: templates are no better."""

SMALLEST = 0.1
"""Rms of what is left below which nothing further is looked for either, over that of maps that are called identical."""

INTERPOLATING = frozenset({"beam_width", "interpolation"})
"""What the interpolation of a sky does too: not named below the accuracy at which maps are called identical."""

NOISY = 0.02
"""Noise over the sky from which on it is filtered out of the sky that maps show."""

NEAR = 5
"""Degrees over which the power of noise is averaged."""

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

    @property
    def names(self) -> frozenset[str]:
        """Of the differences, in any order."""
        return frozenset(difference.name for difference, _ in self.members)


@dataclass(frozen=True, eq=False)
class Problem:
    """One channel, and what may differ in it.

    Sets are searched with orientation moments; those that come first are simulated sample by sample as well, if the
    pointing is known and not too long, and what that changes is added to their predictions.

    Attributes
    ----------
    pair
        The channel on both sides.
    library
        Differences of implementation and effects.
    others
        The other channels.
    floor
        Rms in uK up to which maps are called identical.
    """

    pair: ChannelPair
    library: Sequence[Difference]
    others: Sequence[ChannelPair]
    floor: float = 0.0
    _corrections: dict[tuple[int, bytes], Maps] = field(default_factory=dict, repr=False)
    _tried: dict[tuple[tuple[int, bytes], ...], Set | None] = field(default_factory=dict, repr=False)

    @cached_property
    def _bare(self) -> Maps | None:
        return None if self.pair.scene is None else self.pair.scene.maps()

    @cached_property
    def total(self) -> float:
        """Sum of squares of the difference over the pixels that are seen."""
        return self._squares(self.pair.a)

    @cached_property
    def enough(self) -> float:
        """Share of the variance below which nothing further is looked for."""
        smallest = (SMALLEST * self.floor) ** 2 * float(self.pair.seen.sum()) / self.total
        return min(ENOUGH, smallest) if smallest > 0.0 else ENOUGH

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
        simple = self.pair.scene is None or (self._pointing is not None and not self.pair.noisy)
        return EXPLAINED_BY_SAMPLES if simple else EXPLAINED

    def suffices(self, found: Set) -> bool:
        """Return True if a set explains enough to be named."""
        return found.explains >= min([self.needed, *(difference.enough for difference, _ in found.members)])

    def complete(self, found: Set) -> bool:
        """Return True if what a set leaves is too little to look for anything in it."""
        linear = any(difference.linear for difference, _ in found.members)
        return found.left < (ENOUGH if linear else self.enough)

    def further(self, found: Set) -> float:
        """Return the share of what a set leaves that a further difference must explain."""
        return FURTHER_BEYOND if self.suffices(found) else FURTHER

    @property
    def _pointing(self) -> Pointing | PointingFiles | None:
        return self.pair.pointing()

    @cached_property
    def _sampled(self) -> Maps:
        assert self.pair.scene is not None
        assert self._pointing is not None
        return self.pair.scene.sampled(self._pointing, self.pair.scene.window)

    @cached_property
    def unmade(self) -> float:
        """Rms in uK of what the simulation of side A, with the sky that its maps show, leaves of them."""
        if self.pair.scene is None or self._bare is None:
            return 0.0
        made = self._bare if self._pointing is None else self._sampled
        return float(np.sqrt(np.mean((self.pair.a - made)[self.pair.seen] ** 2)))

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
            if not found or self.complete(found[0]):
                break
            bases = [one for one in found[:KEPT] if one.explains > SLIGHT]
            bases += [one for one in found[KEPT:] if len(one.members) == 1 and one.members[0][0].exchanges]
            larger = [
                one
                for smaller in bases
                for one in self._extended(smaller.members, library)
                if one.left < (1.0 - FURTHER) * smaller.left
            ]
            best = sorted(larger, key=lambda one: one.left)[:KEPT]
            found = sorted((self.corrected(self.polished(one)) for one in best), key=lambda one: one.left)
            if not found or found[0].left > (1.0 - self.further(chosen[0])) * chosen[0].left:
                break
            chosen = found
        return chosen

    def _sorted(self, sets: Iterable[Set]) -> list[Set]:
        """Return sets with the best one first, the first ones measured sample by sample."""
        ranked = sorted(sets, key=lambda one: one.left)
        promising = [one for one in ranked if one.left < WORTH][:MEASURED]
        ranked[: len(promising)] = map(self.corrected, promising)
        return sorted(ranked, key=lambda one: one.left)

    def _extended(self, members: tuple[tuple[Difference, Vector], ...], library: Sequence[Difference]) -> Iterator[Set]:
        """Yield a set with each further difference of the library, at its best value."""
        present = {difference.name for difference, _ in members}
        state: State | None = None
        for difference in library:
            key = (*((id(d), v.tobytes()) for d, v in members), (id(difference), b""))
            if difference.name in present or (difference.name in INTERPOLATING and self._is_small(members)):
                continue
            if key not in self._tried:
                state = state or self.state(members)
                self._tried[key] = self._with(difference, members, state)
            found = self._tried.get(key)
            if found is not None:
                yield found

    def _is_small(self, members: tuple[tuple[Difference, Vector], ...]) -> bool:
        """Return True if what a set leaves is no larger than what the interpolation of a sky makes."""
        return bool(members) and self.left(members) * self.total <= self.floor**2 * self.pair.seen.sum()

    def undone(self, difference: Difference, value: Vector) -> "Problem | None":
        """Return the problem that is left when side B is freed of a difference; None if that cannot be taken back."""
        b = difference.undone(self.pair.b, value)
        if b is None:
            return None
        known = (self.pair.a != healpy.UNSEEN) & (b != healpy.UNSEEN)
        seen = known if self.pair.hits is None else known & (self.pair.hits > 0)
        if not seen.any(axis=1).all():
            return None
        return replace(self, pair=replace(self.pair, b=b, seen=seen), _tried={})

    def behind(self) -> list[Set]:
        """Return sets of differences that were there before pixels or files were exchanged, the best first."""
        found = []
        for difference in self.library:
            if not difference.exchanges:
                continue
            for value in difference.starts(self.state(())):
                problem = self.undone(difference, value)
                if problem is None:
                    continue
                if problem.total <= problem.floor**2 * problem.pair.seen.sum():
                    found.append(self._set(((difference, value),)))
                    continue
                sets = problem.best()
                if not sets or not problem.suffices(sets[0]):
                    sets = sorted([*sets, *problem.best(slow=True)], key=lambda one: one.left)
                found += [self._set((*one.members, (difference, value))) for one in sets[:KEPT]]
        return sorted(found, key=lambda one: one.left)

    def _with(self, difference: Difference, members: tuple[tuple[Difference, Vector], ...], state: State) -> Set | None:
        """Return a set with one more difference, at its best value; None if it has no value."""
        if difference.needs_scene and state.scene is None:
            return None
        sets = [self._set((*members, (difference, value))) for value in difference.starts(state)]
        best = min(sets, key=lambda one: one.left, default=None)
        return self._refined(best, len(members)) if best is not None and difference.smooth else best

    def _set(self, members: tuple[tuple[Difference, Vector], ...]) -> Set:
        return Set(members, self.left(members))

    def _refined(self, start: Set, index: int) -> Set:
        """Return a set with the value of one smooth member fitted; of equal ones the first start stays."""
        members = list(start.members)
        difference, first = members[index]

        def residual(value: Vector) -> Vector:
            maps = self.state([*members[:index], (difference, value), *members[index + 1 :]]).maps
            return np.asarray((self.pair.b - maps)[self.pair.seen])

        without = self.left([*members[:index], *members[index + 1 :]])
        if start.left > (1.0 - SLIGHT) * without:
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
        sets = [
            self._set((*rest[:index], (difference, value), *rest[index:]))
            for value in difference.starts(self.state(rest))
        ]
        best = min(sets, key=lambda one: one.left, default=None)
        return self._refined(best, index) if best is not None and difference.smooth else best


def with_sharper_sky(pair: ChannelPair, iterations: int = 2) -> ChannelPair:
    """Return a pair whose sky, which is taken from side A, makes its maps sample by sample too.

    Where single samples are not known, it makes them with all powers of their offsets.
    """
    scene, pointing = pair.scene, pair.pointing()
    if scene is None or (pointing is None and scene.offset_order < 2):
        return pair
    for _ in range(iterations):
        made = scene.maps() if pointing is None else scene.sampled(pointing, scene.window)
        missing = np.where(pair.seen, pair.a - made, 0.0)
        empty = replace(scene.up_to_offsets(1), sky=np.zeros_like(scene.sky))
        scene = replace(scene, sky=scene.sky + sky_in(missing, pair.seen, empty, 1e-2))
    return replace(pair, scene=scene)


def without_noise(pair: ChannelPair) -> ChannelPair:
    """Return a pair with the noise filtered out of its sky, if it has two splits, and noise in them.

    A Wiener filter; the power of the noise is that of half the difference of two splits, less what the scan makes.
    """
    scene, pointing = pair.scene, pair.pointing()
    if scene is None or not pair.sky_of_maps or len(pair.a) < 2:
        return pair
    made = scene.maps() if pointing is None else scene.sampled(pointing, scene.window)
    seen, lmax = pair.seen[0] & pair.seen[1], min(scene.lmax, 3 * pair.nside - 1)
    half = np.where(seen, 0.5 * ((pair.a - made)[0] - (pair.a - made)[1]), 0.0)
    mean = np.where(seen, 0.5 * (pair.a[0] + pair.a[1]), 0.0)
    if not seen.any() or half[seen].std() < NOISY * mean[seen].std():
        return pair
    noise, both = (healpy.alm2cl(healpix.analysis(map_, lmax, nthreads=scene.nthreads)) for map_ in (half, mean))
    near = np.ones(NEAR) / NEAR
    share = np.convolve(noise, near, "same") / np.maximum(np.convolve(both, near, "same"), 1e-300)
    kept = np.pad(np.clip(1.0 - share, 0.0, 1.0), (0, scene.lmax - lmax))
    return replace(pair, scene=replace(scene, sky=alm_.multiply(scene.sky, kept, scene.lmax)), noisy=True)


def alternatives(sets: Sequence[Set], problem: Problem) -> list[Set]:
    """Return the other sets that explain a difference as well as the best one does."""
    limit = ALIKE * sets[0].left + PRECISION
    found = {sets[0].names: sets[0]}
    for one in sets[1:]:
        if one.left <= limit and problem.suffices(one):
            found.setdefault(one.names, one)
    return list(found.values())[1:]
