"""What a set of differences makes of the maps of side A, and how much it leaves of those of side B."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from mcsim.comparison.differences import Difference, State
from mcsim.comparison.pairs import ChannelPair
from mcsim.comparison.scene import Maps, PointingFiles, Scene
from mcsim.comparison.shown_sky import unshown
from mcsim.support.arrays import Alm, Vector
from mcsim.systematics.base import Pointing

Members = tuple[tuple[Difference, Vector], ...]  #: differences with their values
EXPLAINED = 0.8  #: share of a difference map's variance that a set must explain to be named, with orientation moments
EXPLAINED_BY_SAMPLES = 0.95  #: the same where single samples are simulated, or no simulation is needed
ENOUGH = 1e-3  #: share of the variance below which nothing further is looked for: templates are no better

SMALLEST = 0.1
"""Rms of what is left below which nothing further is looked for either, over that of maps that are called identical."""

TOLERATED = 1.5  #: a set that is named may leave so many times what noise is expected to hide from its prediction
UNSURE = 0.25  #: share of what noise is expected to hide by which that is uncertain
MOST_HIDDEN = 0.5  #: share of the variance that noise may hide at most from the prediction of a set that is named
PRECISION = 1e-6  #: share of the variance that no comparison resolves: single precision of maps with a dipole
STEP = 1e-3  #: change of a value over which responses are linear, over the value or its natural size
STEPS = 4  #: steps of a joint fit at most, and simulations of single samples beside which values are fitted again
NOTHING = 1e-8  #: share of the variance below which values are not fitted again
WORTHWHILE = 0.98  #: share of what was left before that a step must leave at most to be followed by another one


@dataclass(frozen=True, eq=False)
class Set:
    """Differences with their values."""

    members: Members  #: differences with their values
    left: float  #: share of the variance that they leave
    #: what single samples change in their prediction, uK, shape (split, npix); None: not measured
    correction: Maps | None = None

    @property
    def size(self) -> float:
        """Size of what is left over that in the larger unit of the two sides: in K for uK next to nothing is left."""
        return min((difference.size(value) for difference, value in self.members), default=1.0)

    @property
    def explains(self) -> float:
        """Share of the variance of the difference map, what is left being in the larger unit of the two sides."""
        return 1.0 - self.left / self.size**2

    @property
    def names(self) -> frozenset[str]:
        """Of the differences, in any order."""
        return frozenset(difference.name for difference, _ in self.members)

    @property
    def kind(self) -> frozenset[tuple[str, bytes]]:
        """The same, with the values of those that cannot be moved: coordinates of the sky, or of the pixels."""
        return frozenset((d.name, b"" if len(d.axes(value)) else value.tobytes()) for d, value in self.members)

    @property
    def key(self) -> tuple[tuple[int, bytes], ...]:
        """The differences and their values, to look the set up by."""
        return tuple((id(difference), value.tobytes()) for difference, value in self.members)

    @property
    def fitted(self) -> int:
        """Number of values that were fitted."""
        return sum(len(difference.axes(value)) for difference, value in self.members)

    def moved(self, index: int, by: Vector) -> Members:
        """Return the members with one value moved."""
        difference, value = self.members[index]
        return (*self.members[:index], (difference, value + by), *self.members[index + 1 :])


@dataclass(frozen=True, eq=False)
class Prediction:
    """One channel, and what sets of differences make of it.

    Sets are predicted with orientation moments; those that come first are simulated sample by sample as well, if the
    pointing is known and not too long, and what that changes is added to their predictions.
    """

    pair: ChannelPair  #: the channel on both sides
    others: Sequence[ChannelPair]  #: the other channels
    floor: float  #: rms in uK up to which maps are called identical
    _hidden: dict[tuple[tuple[int, bytes], ...], float] = field(default_factory=dict, repr=False, kw_only=True)
    _exact: dict[tuple[tuple[int, bytes], ...], Set] = field(default_factory=dict, repr=False, kw_only=True)

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
        return min(ENOUGH, max(smallest, PRECISION)) if smallest > 0.0 else ENOUGH

    def _squares(self, maps: Maps) -> float:
        return float(np.sum((self.pair.b - maps)[self.pair.seen] ** 2))

    def state(self, members: Members, correction: Maps | None = None) -> State:
        """Return the prediction of a set: scenes first, then maps, each in the order of the set."""
        scene, maps = self.scene(members), self.pair.a
        if scene is not None and self._bare is not None and scene is not self.pair.scene:
            maps = maps + (scene.maps() - self._bare)
        if correction is not None:
            maps = maps + correction
        state = State(self.pair, scene, maps, self.others, self.floor)
        for difference, value in members:
            state = replace(state, maps=difference.maps(state.maps, value, state))
        return state

    def scene(self, members: Members) -> Scene | None:
        """Return the scene of side B."""
        scene = self.pair.scene
        for difference, value in members:
            scene = None if scene is None else difference.scene(scene, value, self.pair)
        return scene

    def of(self, found: Set) -> State:
        """Return the prediction of a set, single samples included where they were measured."""
        return self.state(found.members, found.correction)

    def left(self, members: Members, correction: Maps | None = None) -> float:
        """Return the share of the variance that a set leaves."""
        return self._squares(self.state(members, correction).maps) / self.total

    def hidden(self, found: Set) -> float:
        """Return the share of the variance that noise is expected to hide from the prediction of a set.

        That is what the set makes of a draw of the sky that the maps do not show.
        """
        return 0.0 if self.pair.doubt is None else self.share_hidden(found, self.pair.doubt)

    def out_of_sight(self, found: Set) -> float:
        """Return the share of the variance that noise, or if there is none what holes hide, is expected to make."""
        if self.pair.doubt is None and self._in_holes is not None:
            return self.share_hidden(found, self._in_holes)
        return self.hidden(found)

    def share_hidden(self, found: Set, doubt: Alm) -> float:
        """Return the share of the variance that a set makes of a draw of the sky that the maps do not show."""
        if self.pair.scene is None or not found.members:
            return 0.0
        if found.key not in self._hidden:
            self._hidden[found.key] = self._squares_hidden(found.members, self.pair.scene, doubt)
        return self._hidden[found.key]

    @cached_property
    def _in_holes(self) -> Alm | None:
        return unshown(self.pair)

    def _squares_hidden(self, members: Members, scene: Scene, doubt: Alm) -> float:
        made = []
        for sky in (doubt, np.zeros_like(doubt)):
            own = replace(self.pair, a=np.zeros_like(self.pair.a), scene=replace(scene, sky=sky))
            alone = replace(self, pair=own)
            made.append(alone.state(members).maps + alone._of_effects(members))
        return float(np.sum((made[0] - made[1])[self.pair.seen] ** 2)) / self.total

    def _of_effects(self, members: Members) -> Maps | float:
        """Return what effects, whose templates are of the sky that is known, make of the scene's own sky."""
        scene = self.scene(members)
        made = [d.response(v, scene, self.pair) for d, v in members] if scene is not None else []
        return sum((one for one in made if one is not None), 0.0)

    def moved(self, found: Set) -> float:
        """Return the share of the variance that single samples change in a set, and may change in larger ones."""
        return 0.0 if found.correction is None else float(np.sum(found.correction[self.pair.seen] ** 2)) / self.total

    def needed(self) -> float:
        """Return the share of the variance that a set must explain to be named."""
        simple = self.pair.scene is None or self.pair.by_moments or self._pointing is not None
        return EXPLAINED_BY_SAMPLES if simple else EXPLAINED

    def excess(self, found: Set) -> float:
        """Return the share of the variance that a set leaves beyond what noise hides, or the uncertainty of that."""
        hidden = self.hidden(found)
        return max(found.left - hidden, UNSURE * hidden)

    def unexplained(self, found: Set) -> float:
        """Return the share of the variance that a set leaves beyond what noise may hide."""
        return max(found.left - (1.0 + UNSURE) * self.hidden(found), 0.0)

    def suffices(self, found: Set) -> bool:
        """Return True if a set explains enough to be named, and its maps share half of their variance with side B."""
        if 2.0 * found.left * self.total > float(np.sum(self.pair.b[self.pair.seen] ** 2)):
            return False  # side A alone is large, as with a pixel gone wrong: any factor explains the difference
        needed = min([self.needed(), *(difference.enough for difference, _ in found.members)])
        if found.explains >= needed:
            return True
        hidden = self.out_of_sight(found) if found.explains >= EXPLAINED else self.hidden(found)
        return hidden <= MOST_HIDDEN and found.explains + TOLERATED * hidden >= needed

    def complete(self, found: Set) -> bool:
        """Return True if what a set leaves is too little to look for anything in it."""
        linear = any(difference.linear for difference, _ in found.members)
        enough = ENOUGH if linear else self.enough
        return found.left < enough

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

    def tangents(self, found: Set) -> tuple[list[tuple[int, Vector]], list[Maps]]:
        """Return the ways in which the values of a set may be moved, and what each changes in its prediction."""
        ways = [
            (index, axis)
            for index, (difference, value) in enumerate(found.members)
            for axis in STEP * max(float(np.abs(value).max()), difference.natural) * difference.axes(value)
        ]
        if not ways:
            return [], []
        here = self.of(found).maps
        return ways, [self.state(found.moved(*way), found.correction).maps - here for way in ways]

    def fitted(self, found: Set) -> Set:
        """Return a set with all values that may be moved fitted together, by Gauss-Newton steps."""
        found = replace(found, left=self.left(found.members, found.correction))
        for _ in range(STEPS):
            ways, tangents = self.tangents(found)
            if not ways:
                break
            step = self.of(found).fit(tangents)
            better = found
            for share in (1.0, 0.3):
                members = found.members
                for (index, axis), size in zip(ways, step, strict=True):
                    members = Set(members, 0.0).moved(index, share * size * axis)
                members = tuple((difference, difference.within(value)) for difference, value in members)
                better = Set(members, self.left(members, found.correction), found.correction)
                if better.left < found.left:
                    break
            if better.left >= found.left:
                break
            worthwhile = better.left < WORTHWHILE * found.left
            found = better
            if not worthwhile:
                break
        return found

    def corrected(self, found: Set) -> Set:
        """Return a set with its share measured sample by sample, and its values fitted again beside that.

        Without samples the responses of effects are simulated at their values, and are no longer linear.
        """
        simulated = any(type(difference).response is not Difference.response for difference, _ in found.members)
        if self.pair.scene is None or (self._pointing is None and not simulated):
            return found
        if found.key not in self._exact:
            self._exact[found.key] = self._refined(found)
        return self._exact[found.key]

    def _refined(self, found: Set) -> Set:
        """Return a set measured and fitted in turn: what its own values still take up must not be left to others."""
        found = self._measured(found)
        for _ in range(STEPS):
            if not found.fitted or found.left < NOTHING:
                break
            moved = self.fitted(found)
            if moved.left >= WORTHWHILE * found.left:
                break
            better = self._measured(moved)
            if better.left >= found.left:
                break
            found = better
            if self.complete(found):
                break
        return found

    def _measured(self, found: Set) -> Set:
        base, pointing = self.pair.scene, self._pointing
        if base is None or self._bare is None:
            return found
        scene, correction = self.scene(found.members), np.zeros_like(self.pair.a)
        assert scene is not None
        if scene is not base and pointing is not None:
            correction += scene.sampled(pointing, base.window) - self._sampled - (scene.maps() - self._bare)
        state = replace(self.state(()), scene=scene)
        for difference, value in found.members:
            way = difference.response if pointing is None else difference.sampled
            exact = way(value, scene, self.pair)
            if exact is not None:
                correction += exact - (difference.maps(self.pair.a, value, state) - self.pair.a)
        if not correction.any():
            return found
        correction = np.where(self.pair.seen, correction, 0.0)
        return Set(found.members, self.left(found.members, correction), correction)
