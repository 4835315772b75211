"""One structure of the grammar: what it says, and with which scores it is measured."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mcsim.reconstruction.scores import HARMONICS, SUN
from mcsim.reconstruction.time_functions import HISTORIES
from mcsim.support.arrays import Matrix, Vector

ALIKE, OPPOSITE = "alike", "opposite"

FREE = 5  #: coordinates of a pattern on the sky whose responses are simulated one by one, at most

MOTION = "motion"  #: kind of a rotation that turns with the Sun, as aberration by the Earth's velocity does

MEANS = ("monopole", "constant", "level")  #: kinds that are the mean of others: in time, on the sky, of noise

IN_MAPS = ("beam", "elsewhere", "noise", "square", "cube", "rotation")
"""Stages that no effect of the simulator has in one split: simulated by that of all splits, in some maps."""

ANY = f"1-{HARMONICS}"  #: of a wave in any way: a constant and all harmonics

OFFSET = "square with a constant"  #: kind of a square whose zero is elsewhere than that of the maps

LINE = "line "  #: begins the kind of what is along the line of sight of a channel, whose name follows


@dataclass(frozen=True, eq=False)
class Structure:
    """One structure of the grammar."""

    #: "added", "gain", "elsewhere", "beam", "square", "cube", "rotation", "noise", "power" or "modulation"
    stage: str
    acts_on: str  #: what it multiplies: "sky", "dipole", "sky and dipole", or "" if nothing
    frame: str  #: "sky", "scan", "spacecraft", "time", "Sun", or "" for noise and for the sky's own power
    #: what varies: "monopole", "degrees 0-2", "latitude ecliptic", "order 2", "year", "spin 1", "constant", ...
    kind: str
    channel: str | None  #: name; None: all of them
    split: str  #: "alike", "opposite", or the name of the only split that has it
    index: float | None  #: power of the frequency with which channels share it; None: it is not scaled
    #: rows, weights: places of the scores, shape (K, maps), and the factor of each map, shape (maps,): a score of the
    #: structure is their weighted sum over maps
    rows: NDArray[np.int64] = field(repr=False)
    weights: Vector = field(repr=False)
    #: matrix from these sums to the coordinates, shape (coordinates, K); None: they are the coordinates
    mix: Matrix | None = field(default=None, repr=False)
    views: tuple[int, ...] = field(default=(), repr=False)  #: indices of the maps
    tried: float = 1.0  #: number of such structures among which the data have chosen it

    @property
    def size(self) -> int:
        """Return the number of coordinates."""
        return len(self.rows) if self.mix is None else len(self.mix)

    @property
    def says(self) -> tuple[str, str, str, str, str | None, str, float | None]:
        """Return all that it says, without its scores."""
        return self.stage, self.acts_on, self.frame, self.kind, self.channel, self.split, self.index

    def like(self, other: "Structure") -> bool:
        """Return True if another says the same, but for a profile, the highest degree or the power of the frequency."""
        mine, theirs = ((*one.says[:3], *_briefly(one.kind), *one.says[4:6]) for one in (self, other))
        return mine == theirs

    def extends(self, other: "Structure") -> bool:
        """Return True for what has more than its mean, in time or on the sky, if that is the other one."""
        longer = self.kind in ("elongation", "Galaxy", OFFSET) or self.kind.startswith(("degrees", "latitude", "step"))
        if not longer and not self.in_any_way:
            return False
        stage = {"added": ("added", "power"), "square": ("added",)}.get(self.stage, (self.stage,))
        same = ("" if self.stage == "square" else self.acts_on, self.channel, self.split, self.index)
        mean = {"gain": "constant", "noise": "level"}.get(self.stage, "monopole")
        alike = (other.acts_on, other.channel, other.split, other.index) == same
        return other.stage in stage and other.kind == mean and alike

    def beside(self, other: "Structure") -> bool:
        """Return True if another varies with the same in the same maps, whatever it multiplies and how often."""
        mine, theirs = ((one.stage, one.frame, one.kind.split()[0], *one.says[4:]) for one in (self, other))
        return mine == theirs

    @property
    def in_any_way(self) -> bool:
        """Return True for a constant and all harmonics of a wave."""
        return self.kind.endswith(ANY) and not self.kind.startswith(LINE)

    @property
    def choice(self) -> tuple[str | None, ...]:
        """Return what is the same of structures among which the data choose; nothing for others."""
        return (*self.says[:3], self.kind.split()[0], *self.says[4:6]) if self.tried > 1.0 else ()

    @property
    def order(self) -> int:
        """Return the order of a change of the beam."""
        return 1 if self.kind == MOTION else int(self.kind.split()[1])

    @property
    def moving(self) -> str:
        """Return the wave that a beam follows, or the Sun, or nothing."""
        if self.kind == MOTION:
            return SUN
        rest = self.kind.split(maxsplit=2)[2:] if self.stage == "beam" else []
        return rest[0] if rest and rest[0].startswith(("spin", "year")) else ""

    @property
    def by_map(self) -> bool:
        """Return True if, where it differs between splits, it is that of all splits in some maps."""
        patterned = self.stage == "gain" and self.frame == "sky"
        return patterned or self.kind.startswith("source") or self.stage in IN_MAPS

    @property
    def by_coordinate(self) -> bool:
        """Return True for a pattern of few coordinates that multiplies the sky: each has a response of its own."""
        return self.frame == "sky" and bool(self.acts_on) and self.size <= FREE

    @property
    def of_variances(self) -> bool:
        """Return True for noise and powers, whose scores are variances themselves."""
        return self.stage == "noise" or self.kind == "power"

    @property
    def of_a_foreground(self) -> bool:
        """Return True for the power of a pattern that channels share by their frequencies."""
        return self.kind == "power" and self.index is not None

    @property
    def is_light(self) -> bool:
        """Return True for light that is fixed to the sky, and the same in all splits."""
        return (self.stage, self.frame, self.split) == ("added", "sky", ALIKE)

    @property
    def leaves_low(self) -> bool:
        """Return True if the scores leave out monopoles and dipoles that the structure makes."""
        return self.stage == "modulation" or (self.stage, self.acts_on) == ("gain", "sky")

    def elsewhere(self, other: "Structure") -> bool:
        """Return True if another is the same in another channel or split, or in all channels by their frequency."""
        return self.says[:4] == other.says[:4] and (self.channel == other.channel) != (self.split == other.split)

    def of(self, scores: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the scores of the structure, shape (..., size), from all, shape (..., P)."""
        found = (scores[..., self.rows] * self.weights).sum(axis=-1)
        return found if self.mix is None else found @ self.mix.T

    def within(self, fold: int, folds: Sequence[int]) -> "Structure":
        """Return the same, measured in the maps of one fold; ``folds`` are those of all maps."""
        kept = [k for k, view in enumerate(self.views) if folds[view] == fold]
        views = tuple(self.views[k] for k in kept)
        return replace(self, rows=self.rows[:, kept], weights=self.weights[kept], views=views)


def _briefly(kind: str) -> list[str]:
    if kind.startswith(LINE):
        return [kind]
    if kind.startswith(HISTORIES):
        return [HISTORIES[0]]
    return kind.split()[: 1 if kind.startswith(("degrees", "crossing", "source", "square")) else 2]
