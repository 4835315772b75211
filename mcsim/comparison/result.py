"""What a comparison found, in types, in JSON and in words."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mcsim.support.arrays import Maps
from mcsim.support.numbers import number

UNMADE = 0.2
"""Share of the rms of a difference that the model leaves of its own side at least where it is said not to make it."""

Verdict = Literal["identical", "difference", "mixture", "degenerate", "unknown"]


@dataclass(frozen=True)
class DifferenceResult:
    """One difference: name, channel, amplitude with unit, share of the variance that it explains, what else is known.

    ``explains`` is the share that the set loses without it; ``said`` the amplitude in words where its sign misleads.
    """

    name: str
    channel: str
    amplitude: float
    unit: str
    explains: float
    parameters: dict[str, float | str]
    met: str
    said: str = ""

    @property
    def words(self) -> str:
        """Name and amplitude, or what an amplitude of 1 means where it can be nothing else."""
        meaning = self.unit.removeprefix("1 = ")
        alone = meaning != self.unit and abs(self.amplitude) == 1.0
        meaning += " in side A" if self.amplitude < 0.0 else ""
        also = f" ({self.said})" if self.said else ""
        return f"{self.name} ({meaning})" if alone else f"{self.name} = {number(self.amplitude)} {self.unit}{also}"

    def to_dict(self) -> dict[str, Any]:
        """Return it as in ``compare.json``."""
        own = {key: getattr(self, key) for key in ("name", "channel", "amplitude", "unit", "explains")}
        return own | ({"parameters": self.parameters} if self.parameters else {})


@dataclass(frozen=True)
class NotCompared:
    """A map that was not compared: name, and what lacks it of "a", "b" and "model"."""

    map: str
    missing_on: tuple[str, ...]

    @property
    def words(self) -> str:
        """Name, and what lacks it."""
        where = " and ".join("the model" if side == "model" else f"side {side.upper()}" for side in self.missing_on)
        return f"{self.map}, which {where} {'lacks' if len(self.missing_on) == 1 else 'lack'}"

    def to_dict(self) -> dict[str, Any]:
        """Return it as in ``compare.json``."""
        return {"map": self.map, "missing_on": list(self.missing_on)}


@dataclass(frozen=True, eq=False)
class ChannelResult:
    """The comparison of one channel."""

    #: name, splits: of the channel and of its maps
    name: str
    splits: tuple[str, ...]
    #: "identical", "difference" (one), "mixture" (several), "degenerate" (several sets do), or "unknown"
    verdict: Verdict
    #: differences, alternatives, nearest: the best set that is accepted, the other ones, and the best set whatever it
    #: explains
    differences: tuple[DifferenceResult, ...]
    alternatives: tuple[tuple[DifferenceResult, ...], ...]
    nearest: tuple[DifferenceResult, ...]
    nearest_explains: float  #: share of the variance that this set explains
    #: rms_uk, sky_rms_uk, noncircular_rms_uk, noise_rms_uk, left_rms_uk: of the difference; of the sky without monopole
    #: and dipole; of what the beam's shape adds; of the noise that the model has; and of what is left. NaN where no
    #: model says it.
    rms_uk: float
    sky_rms_uk: float
    noncircular_rms_uk: float
    noise_rms_uk: float
    left_rms_uk: float
    looks: tuple[str, ...]  #: what is left looks like, in words, if nothing is named
    #: of what the simulation of the side that the model describes leaves of its maps, if the verdict is "unknown"; 0
    unmade_rms_uk: float
    #: a, b, explained, seen: maps, uK, shape (split, npix), ``explained`` the part of b - a that the set makes
    a: Maps
    b: Maps
    explained: Maps
    seen: NDArray[np.bool_]
    one_sided: int  #: number of pixels that one side alone observed, and that are left out
    hits: Maps | None  #: samples per pixel, of the model; None without one
    #: differing, absent: names of the maps that differ at all, of which the rest is said, and of those that one side
    #: lacks
    differing: tuple[str, ...] = ()
    absent: tuple[str, ...] = ()
    #: of what single samples change in the side that the model describes, if that was made from orientation moments; it
    #: is taken off first
    spread_rms_uk: float = 0.0
    #: True if the model describes side B, and the differences were found in side A; they say B relative to A
    reversed: bool = False

    @property
    def described(self) -> str:
        """Side that the model describes, in words."""
        return "side B" if self.reversed else "side A"

    @property
    def accuracy(self) -> float:
        """Rms of the difference over that of the sky."""
        return self.rms_uk / self.sky_rms_uk

    @property
    def left(self) -> float:
        """Share of the variance of the difference that is left."""
        return (self.left_rms_uk / self.rms_uk) ** 2 if self.rms_uk > 0.0 else 0.0

    @property
    def partly(self) -> bool:
        """True if some maps are identical, and others are not."""
        return len(self.differing) + len(self.absent) < len(self.splits)

    def sentence(self) -> str:
        """Say what was found in this channel."""
        many = ("one pixel", "is") if self.one_sided == 1 else (f"{self.one_sided} pixels", "are")
        more = " {} that one side alone observed {} left out.".format(*many) if self.one_sided else ""
        if self.spread_rms_uk:
            spread = number(self.spread_rms_uk)
            more += f" What single samples change in {self.described}, {spread} uK rms, is taken off first."
        if self.partly:
            more += f" That is {', '.join(self.differing)}; the other maps are identical."
        return self._found() + more

    def _found(self) -> str:
        size = f"{number(self.rms_uk)} uK rms, {number(self.accuracy)} of the sky"
        if self.verdict == "identical" and self.rms_uk == 0.0:
            return f"{self.name}: identical in every pixel."
        if self.verdict == "identical":
            return f"{self.name}: identical to an accuracy of {number(self.accuracy)} ({number(self.rms_uk)} uK rms)."
        if self.verdict == "unknown":
            near, share = " and ".join(d.name for d in self.nearest), self.nearest_explains
            part = f"{100 * share:.0f}" if share < 0.99 else f"{100 * min(share, 0.9999):.2f}"
            hint = f"; nearest is {near}, which explains {part} %" if near and share >= 0.01 else ""
            if self.unmade_rms_uk > UNMADE * self.rms_uk:
                hint += (
                    f". The model makes {self.described} itself to {number(self.unmade_rms_uk)} uK rms only: "
                    "check it, or give it the sky (sky.alm), which maps with noise or many holes do not show"
                )
            if np.isnan(self.noncircular_rms_uk):
                hint += ". Without a model only differences of the maps themselves are tried: give one"
            looks = f" What is left is {'; '.join(self.looks)}." if self.looks else ""
            return (
                f"{self.name}: different by {size}, in a way that no difference of the library explains in full{hint}."
                f"{looks}"
            )
        named = " and ".join(d.words for d in self.differences)
        others = [" and ".join(d.words for d in one) for one in self.alternatives]
        also = f"; {' or '.join(others)} would do as well" if others else ""
        also += "; the model describes side B" if self.reversed else ""
        return (
            f"{self.name}: different by {size}, by {named}, which explains {100 * (1 - self.left):.2f} % and leaves "
            f"{number(self.left_rms_uk)} uK{also}."
        )


@dataclass(frozen=True, eq=False)
class ComparisonResult:
    """The comparison of two sides; ``str`` of it says what was found.

    Attributes
    ----------
    case
        Name.
    channels
        One result for every channel.
    not_compared
        Maps that one side, or the model, lacks.
    frame
        Frame of the maps, "ecliptic", "galactic" or "equatorial"; None if neither a model nor headers say one alone.
    sides
        Paths of A and B; empty for arrays.

    Examples
    --------
    >>> import mcsim
    >>> run = mcsim.load_config("tiny")
    >>> [here] = mcsim.write_maps(run, "compare-same", realizations=0)
    >>> found = mcsim.compare(here, here, run)
    >>> found.verdict, found.accuracy, len(found.channels)
    ('identical', 0.0, 1)
    """

    case: str
    channels: tuple[ChannelResult, ...]
    not_compared: tuple[NotCompared, ...] = ()
    frame: str | None = None
    sides: tuple[str, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """Of all channels together."""
        kinds = {channel.verdict for channel in self.channels}
        for kind in ("unknown", "mixture", "degenerate"):
            if kind in kinds:
                return kind
        names = {d.name for channel in self.channels for d in channel.differences}
        if not names:
            return "identical"
        return "mixture" if len(names) > 1 else "difference"

    @property
    def accuracy(self) -> float:
        """Rms of the difference over that of the sky, of all maps together that differ."""
        return self._rms("rms_uk") / self._rms("sky_rms_uk")

    def _rms(self, name: str) -> float:
        sizes = [channel.seen.sum() for channel in self.channels]
        return float(np.sqrt(np.average([getattr(c, name) ** 2 for c in self.channels], weights=sizes)))

    def to_dict(self) -> dict[str, Any]:
        """Return the content of ``compare.json``, schema 1."""
        rms, left = self._rms("rms_uk"), self._rms("left_rms_uk")
        return {
            "schema": 1,
            "case": self.case,
            "sides": list(self.sides),
            "verdict": self.verdict,
            "frame": self.frame,
            "accuracy": self.accuracy,
            "difference": {
                "rms_uk": rms,
                "of_sky": self.accuracy,
                "of_noncircular": _ratio(rms, self._rms("noncircular_rms_uk")),
                "of_noise": _ratio(rms, self._rms("noise_rms_uk")),
            },
            "model_describes": {c.name: "b" for c in self.channels if c.reversed},
            "differences": [d.to_dict() for c in self.channels for d in c.differences],
            "alternatives": [[d.to_dict() for d in one] for c in self.channels for one in c.alternatives],
            "nearest": [d.to_dict() for c in self.channels if c.verdict == "unknown" for d in c.nearest],
            "left": {
                "rms_uk": left,
                "fraction": (left / rms) ** 2 if rms > 0.0 else 0.0,
                "one_sided_pixels": sum(c.one_sided for c in self.channels),
                "looks": {c.name: list(c.looks) for c in self.channels if c.looks},
                "single_samples_uk": {c.name: c.spread_rms_uk for c in self.channels if c.spread_rms_uk},
            },
            "maps": {c.name: list(c.differing) for c in self.channels if c.partly},
            "not_compared": [one.to_dict() for one in self.not_compared],
        }

    def __str__(self) -> str:
        """Say what was found, channel by channel."""
        return "\n".join([f"{self.case}: {self.verdict}", *self.sentences()])

    def sentences(self) -> list[str]:
        """Return a sentence for every channel, and one about what was not compared."""
        rest = "; ".join(one.words for one in self.not_compared)
        return [*(channel.sentence() for channel in self.channels), *([f"Not compared: {rest}."] if rest else [])]


def _ratio(value: float, unit: float) -> float | None:
    return value / unit if np.isfinite(unit) and unit > 0.0 else None
