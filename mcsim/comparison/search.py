"""Find the smallest set of differences that turns the maps of side A into those of side B."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, permutations, zip_longest

import healpy
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from mcsim.comparison.differences import Difference, State
from mcsim.comparison.pairs import ChannelPair
from mcsim.comparison.prediction import ENOUGH, EXPLAINED, PRECISION, TOLERATED, UNSURE, Prediction, Set
from mcsim.support.arrays import Vector

FURTHER = 0.7  #: share of what is left that a further difference must explain to be added
FURTHER_BEYOND = 0.85  #: the same where what there is explains enough to be named

VISIBLE, VISIBLE_IN_HOLES = 0.1, 1.0
"""Share of what noise hides, or holes do, that a further difference must explain beside it to be added.

What holes hide is no white noise: others are like it by chance.
"""

CHANCE = 100.0  #: the same for each of its values, over the share of one pixel
SLIGHT = 0.1  #: share that a difference must explain to be fitted further
LARGE = 0.3  #: share that a difference must explain by itself to have others tried beside it

PROMISING = 0.6
"""The same of two together: share that they may leave, each times a factor, of what the best one leaves."""

NEARLY = 0.1  #: share that a set may leave at most to have its values fitted beside one more without a value
LARGEST = 3  #: differences that act together
MEASURED, MEASURED_LARGER = 4, 6  #: differences, and sets of each larger size, that are simulated sample by sample

WORTH, WORTH_IN_NOISE = 0.5, 0.9
"""Share of the variance that a set may leave at most to be simulated sample by sample.

Once one is found that leaves nothing, it is what moments alone may leave of the others.
"""

KEPT = 3  #: sets of every size from which larger ones are built: the best, and as many that do best beside another
TRIED = 8  #: larger sets whose values are fitted together

HARDER = 4.0
"""Share of the variance that an exchange may leave at most by itself, if what was there before it is looked for."""

SOONER = 0.8  #: times what it leaves of side B that a difference may leave of side A to have the sides exchanged
SCREENED = 200_000  #: pixels on which pairs are compared at most
ALIKE = 2.0  #: sets that leave at most so many times what the best one leaves are alternatives
UNFITTED = 10.0  #: the same of sets with fewer fitted values, which explain as much as they do without them
EQUAL = 1.1  #: the same for sets of which the one with the fewest fitted values is named, and of what noise hides

INTERPOLATED = 0.02
"""Share of the variance of an interpolation's error that a width of the beam, or another value, leaves at least."""

INTERPOLATING = frozenset({"beam_width", "interpolation"})
"""What the interpolation of a sky does too: not named below the accuracy at which maps are called identical."""


@dataclass(frozen=True, eq=False)
class Problem(Prediction):
    """One channel, and what may differ in it."""

    library: Sequence[Difference] = ()  #: differences of implementation and effects
    _tried: dict[tuple[tuple[int, bytes], ...], list[Set]] = field(default_factory=dict, repr=False)

    def best(self, stage: int = 0) -> list[Set]:
        """Return sets of the smallest size that explains the difference, the best first; or of the best size tried.

        A larger set is taken only if its last member explains :data:`FURTHER` of what the smaller one leaves.
        """
        library = [d for d in self.library if d.stage <= stage]
        alone = sorted(self._extended(Set((), 1.0), library), key=lambda one: one.left)
        found = self._measured_first(alone, MEASURED)
        chosen = found
        for _ in range(LARGEST - 1):
            if not found or self.complete(found[0]):
                break
            hidden = self.out_of_sight(found[0]) if self.suffices(found[0]) else self.hidden(found[0])
            most = found[0].left - self._visible * hidden if hidden > 0.0 else 0.0
            larger = [
                [
                    one
                    for one in self._extended(smaller, further)
                    if one.left
                    < max(most, (1.0 - FURTHER) * max(smaller.left, found[0].left), self.unsure(one, smaller))
                ]
                for smaller, further in self._bases(found, library)
            ]
            found = self._measured_first([self.fitted(one) for one in _in_turn(larger, TRIED)], MEASURED_LARGER)
            if not found or not self.adds(found[0], chosen[0]):
                break
            chosen = found
        return chosen

    def adds(self, larger: Set, found: Set) -> bool:
        """Return True if a larger set explains so much of what a set leaves that it is worth its further members.

        What noise or holes hide is left by both, but no template is like it: a part that it would not make by chance
        will do.
        """
        hidden = self.out_of_sight(larger) if self.suffices(found) else self.hidden(larger)
        values = max(larger.fitted - found.fitted, 1)
        chance = hidden * max(self._visible, CHANCE * values / healpy.nside2npix(self.pair.nside))
        if larger.left < self.enough + TOLERATED * hidden and found.left - larger.left > chance > 0.0:
            return True
        share = FURTHER_BEYOND if self.suffices(found) else FURTHER
        return self.excess(larger) < (1.0 - share) * self.excess(found)

    @property
    def _visible(self) -> float:
        return VISIBLE_IN_HOLES if self.pair.doubt is None else VISIBLE

    def unsure(self, larger: Set, base: Set) -> float:
        """Return the share that a larger set may leave because single samples were not simulated, as of its base."""
        return 0.0 if larger.correction is not None else ALIKE * self.moved(base)

    def _measured_first(self, sets: Sequence[Set], most: int) -> list[Set]:
        """Return sets with the best one first, the first ones of those that are given measured sample by sample."""
        ranked = list(sets)
        worth = WORTH if self.pair.doubt is None else WORTH_IN_NOISE
        # Beside noise those that are measured already say what others are worth.
        known = [one for one in ranked if self.pair.doubt is not None and one.key in self._exact]
        for one in (*known, *(other for other in ranked[:most] if other not in known)):
            if one.left < worth:
                ranked[ranked.index(one)] = measured = self.corrected(one)
                if self.complete(measured):
                    worth = 1.0 - EXPLAINED
                elif self.unexplained(measured) == 0.0:
                    # Noise leaves the rest. What single samples change of other sets counts if it does of this one.
                    worth = min(worth, ALIKE * measured.left if one.left > EQUAL * measured.left else 0.0)
        return sorted(ranked, key=lambda one: one.left)

    def _bases(self, found: Sequence[Set], library: Sequence[Difference]) -> list[tuple[Set, Sequence[Difference]]]:
        """Return the sets from which larger ones are built, with what is tried beside them.

        They are the best, those that do best in pairs, exchanges, and turns beside other turns; beside noise that hides
        all that the best one leaves, that one alone.
        """
        if self.pair.doubt is not None and self.suffices(found[0]) and self.unexplained(found[0]) == 0.0:
            return [(self.preferred(found)[0], library)]
        bases = [one for one in found[:KEPT] if one.explains > LARGE]
        if len(found[0].members) > 1:
            return [(one, library) for one in bases]
        lefts = self._left_by_two(found)
        pairs = sorted(
            (lefts[i, j], i)
            for i, j in permutations(range(len(found)), 2)
            if lefts[i, j] < PROMISING * min(found[0].left, 1.0)
        )
        for _, first in pairs:
            if len(bases) == 2 * KEPT:
                break
            if found[first] not in bases:
                bases.append(found[first])
        bases += [one for one in found if one not in bases and one.members[0][0].exchanges]
        turns = [difference for difference in library if difference.turns]
        turning = [one for one in found if one not in bases and one.members[0][0].turns]
        return [*((one, library) for one in bases), *((one, turns) for one in turning)]

    def _left_by_two(self, found: Sequence[Set]) -> NDArray[np.float64]:
        """Return the share that the responses of every two sets leave together, factors free where values are."""
        seen = np.flatnonzero(self.pair.seen)
        some = seen[:: max(1, seen.size // SCREENED)]
        rest = (self.pair.b - self.pair.a).ravel()[some]
        made = np.stack([(self.of(one).maps - self.pair.a).ravel()[some] for one in found])
        products, shares, squares = made @ made.T, made @ rest, float(rest @ rest)
        free = np.array([one.fitted > 0 for one in found])
        left = np.ones(products.shape)
        for i, j in combinations(range(len(found)), 2):
            fixed, moved = ([k for k in (i, j) if free[k] == one] for one in (False, True))
            own = shares[moved] - products[np.ix_(moved, fixed)].sum(axis=1)
            kept = squares - 2.0 * shares[fixed].sum() + products[np.ix_(fixed, fixed)].sum()
            factors = np.linalg.lstsq(products[np.ix_(moved, moved)], own, rcond=1e-12)[0] if moved else own
            left[i, j] = left[j, i] = (kept - own @ factors) / squares
        return left

    def _extended(self, base: Set, library: Sequence[Difference]) -> list[Set]:
        """Return a set with each further difference of the library, at its best value.

        What the values of the set may change is fitted besides, and so is not left.
        """
        present, state, found = {difference.name for difference, _ in base.members}, None, list[Set]()
        small = bool(base.members) and base.left * self.total <= self.floor**2 * self.pair.seen.sum()
        for difference in library:
            if difference.name in present or (difference.name in INTERPOLATING and small):
                continue
            key = (*base.key, (id(difference), b""))
            if key not in self._tried:
                state = state or self._freed(base)
                self._tried[key] = self._with(difference, base, state)
            found += self._tried[key]
        return found

    def _freed(self, base: Set) -> State:
        """Return the prediction of a set, with what its values may change to be fitted besides."""
        state, (_, tangents) = self.of(base), self.tangents(base)
        if not tangents:
            return state
        changes = np.stack([one[self.pair.seen] for one in tangents])
        return replace(state, free=np.linalg.qr(changes.T / np.linalg.norm(changes, axis=1).clip(1e-300))[0].T)

    def _with(self, difference: Difference, base: Set, state: State) -> list[Set]:
        """Return a set with one more difference, at its best value; others too that are as good and cannot be moved.

        A difference without a value may reverse the sense of those that were fitted without it.
        """
        if difference.needs_scene and state.scene is None:
            return []

        def rest(value: Vector) -> Vector:
            return state.rest(self.state((*base.members, (difference, value)), base.correction).maps)

        def set_of(value: Vector) -> Set:
            left = float(np.sum(rest(value) ** 2)) / self.total
            return Set((*base.members, (difference, value)), left, base.correction)

        sets = [set_of(value) for value in difference.starts(state)]
        for one in sets if base.fitted else ():
            if one.fitted == base.fitted and one.left < NEARLY:
                sets = [*sets, self.fitted(one)]
            elif one.fitted == base.fitted:
                members = (*((d, -v if d.smooth else v) for d, v in base.members), one.members[-1])
                sets = [*sets, Set(members, self.left(members))]
        best = min(sets, key=lambda one: one.left, default=None)
        if best is None:
            return []
        if not difference.smooth or best.left > (1.0 - SLIGHT) * base.left:
            alike = [one for one in sets if one is not best and one.left < min(ALIKE * best.left, LARGE)]
            return [best, *(() if base.members or difference.smooth else alike)]
        first = best.members[-1][1]
        scale = np.maximum(np.abs(first), 0.1 * difference.natural)
        fit = least_squares(rest, first, x_scale=scale, diff_step=1e-3, max_nfev=8, xtol=1e-7)
        return [min(best, set_of(difference.within(np.asarray(fit.x))), key=lambda one: one.left)]

    def of_pair(self, pair: ChannelPair, others: Sequence[ChannelPair]) -> "Problem":
        """Return the problem of another pair."""
        return replace(self, pair=pair, others=others, _tried={}, _hidden={}, _exact={})

    def worse_alone_than(self, other: "Problem") -> bool:
        """Return True if a difference of the first stages leaves less of the other problem by itself."""
        library = [d for d in self.library if d.stage < 2 and not d.linear]
        own, there = ({one.names: one.left for one in p._extended(Set((), 1.0), library)} for p in (self, other))
        return any(left < SOONER * own.get(names, 1.0) for names, left in there.items())

    def undone(self, difference: Difference, value: Vector) -> "Problem | None":
        """Return the problem that is left when side B is freed of a difference; None if that cannot be taken back."""
        b = difference.undone(self.pair.b, value)
        if b is None:
            return None
        known = (self.pair.a != healpy.UNSEEN) & (b != healpy.UNSEEN) & np.any(self.pair.seen, axis=1, keepdims=True)
        seen = known if self.pair.usable is None else known & self.pair.usable
        if not seen.any():
            return None
        return self.of_pair(replace(self.pair, b=b, seen=seen), self.others)

    def behind(self) -> list[Set]:
        """Return sets of differences that were there before pixels or files were exchanged, the best first."""
        found = []
        for difference in self.library:
            for value in difference.starts(self.state(())) if difference.exchanges else ():
                problem = self.undone(difference, value)
                if problem is None or self.left(((difference, value),)) > HARDER:
                    continue
                if problem.total <= problem.floor**2 * problem.pair.seen.sum():
                    sets = [Set((), 0.0)]
                else:
                    sets = problem.best()
                    if not sets or not problem.suffices(sets[0]):
                        sets = sorted([*sets, *problem.best(2)], key=lambda one: one.left)
                for one in sets[:KEPT]:
                    if difference.name in one.names or not problem.suffices(one):
                        continue
                    members = (*one.members, (difference, value))
                    found.append(Set(members, self.left(members, one.correction), one.correction))
        return sorted(found, key=lambda one: one.left)

    def pruned(self, found: Set) -> Set:
        """Return a set without members that add nothing to the others, which may have come before these."""
        for index in range(len(found.members) if len(found.members) > 2 else 0):
            rest = (*found.members[:index], *found.members[index + 1 :])
            fewer = self.fitted(Set(rest, 1.0, found.correction))
            if self.suffices(fewer) and not self.adds(found, fewer):
                return self.pruned(self.corrected(fewer))
        return found

    def preferred(self, sets: Sequence[Set]) -> list[Set]:
        """Return sets with the best first; of those that are as good, the one with the fewest fitted values.

        As good are sets of one size too that leave no more than an interpolation, of which a fitted value may take in
        all but :data:`INTERPOLATED`.
        """
        limit = EQUAL * sets[0].left + UNSURE * self.hidden(sets[0]) + PRECISION
        little, size = min(ENOUGH, self.floor**2 * self.pair.seen.sum() / self.total), len(sets[0].members)
        little = min(little, sets[0].left / INTERPOLATED)
        close = [one for one in sets if one.left <= (max(limit, little) if len(one.members) == size else limit)]
        equal = [one for one in close if self.suffices(one)]
        first = min(equal, key=lambda one: (len(one.members), one.fitted), default=sets[0])
        return [first, *(one for one in sets if one is not first)]

    def alternatives(self, sets: Sequence[Set]) -> list[Set]:
        """Return the other sets that explain a difference as well as the best one does."""
        hidden = min(EQUAL * self.hidden(sets[0]), sets[0].left)
        limit = max(ALIKE * (sets[0].left - hidden) + hidden, EQUAL * sets[0].left) + PRECISION
        found = {sets[0].names: sets[0]}
        for one in sets[1:]:
            most = max(limit, UNFITTED * sets[0].left) if one.fitted < sets[0].fitted else limit
            if one.left <= most and self.suffices(one) and not one.names > sets[0].names:
                found.setdefault(one.names, one)
        return list(found.values())[1:]


def _in_turn(sets: Sequence[Sequence[Set]], most: int) -> list[Set]:
    """Return the best sets of each base, then the second ones, ...: one for all orders of the same differences.

    Moments alone do not say which of two bases is the better one.
    """
    ranked = zip_longest(*(sorted(own, key=lambda one: one.left) for own in sets))
    found: dict[frozenset[tuple[str, bytes]], Set] = {}
    for one in (one for each in ranked for one in each if one is not None):
        found.setdefault(one.kind, one)
    return list(found.values())[:most]
