"""Describe one case of a challenge: what it is drawn from, what acts in it, and what was answered."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from mcsim.errors import InputError
from mcsim.support.arrays import Vector
from mcsim.systematics.signatures import Place

Kind = Literal["none", "one", "two", "left_out", "invented"]
Identity = tuple[str, str | None]  #: name of an effect and of its channel; None: all channels
Answer = frozenset[Identity]  #: effects that act together; the empty set: no effect

KINDS: tuple[Kind, ...] = get_args(Kind)
LARGEST = 1e100  #: share or expected S/N whose square is a number, too
IN_LIBRARY = ("none", "one", "two")  #: kinds of cases whose effects the diagnosis can name


@dataclass(frozen=True)
class Prior:
    """Shares of the kinds of cases, on any scale, and the range of the expected S/N, uniform in its logarithm.

    Names of effects are equally probable, then channels, then settings. The direction of an effect with several
    parameters is isotropic in whitened coordinates, as far as its parameters reach.
    """

    none: float = 0.20
    one: float = 0.45
    two: float = 0.15
    left_out: float = 0.12
    invented: float = 0.08
    weakest: float = 3.0
    strongest: float = 20.0

    def __post_init__(self) -> None:
        """Raise InputError for strengths or shares that cannot be drawn."""
        for name, value in vars(self).items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
                raise InputError(f"{name} is {value!r}, but it must be a number of at most {LARGEST:g}; give one.")
        if not 0.0 < self.weakest < self.strongest:
            raise InputError(
                f"an expected S/N from {self.weakest:g} to {self.strongest:g} is no range; give two numbers above 0, "
                "the smaller one first."
            )
        if min(self.shares(True)) < 0.0 or sum(self.shares(False)) <= 0.0:
            raise InputError("shares of the kinds of cases must not be negative, nor all be zero; correct them.")

    def shares(self, out_of_library: bool) -> Vector:
        """Return the probabilities of :data:`KINDS`, without out-of-library effects if there are none."""
        values = np.array([getattr(self, kind) for kind in KINDS])
        if not out_of_library:
            values[KINDS.index("invented")] = 0.0
        return values / max(float(values.sum()), 1e-300)

    def strength(self, draw: np.random.Generator) -> float:
        """Draw an expected S/N."""
        return float(np.exp(draw.uniform(np.log(self.weakest), np.log(self.strongest))))


@dataclass(frozen=True)
class Member:
    """One effect that acts in a case.

    Name, channel and parameters are those of ``[[effect]]`` of a run, amplitude included; the coordinates are the
    effect's linear components. The strength is the expected S/N: the whitened norm of the response in the data vector
    of this very sky, or of the mean response if the effect is stochastic. ``candidate`` is an index among those of the
    full library; None: an effect that no library has, whose response of the data vector is kept instead.
    """

    name: str
    channel: str | None
    parameters: Mapping[str, Any]
    coordinates: tuple[float, ...]
    strength: float
    candidate: int | None = None
    response: tuple[float, ...] = ()

    @property
    def identity(self) -> Identity:
        """Return name and channel."""
        return self.name, self.channel


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """Effects that act in a case, and names of those that the diagnosis must not propose.

    The kind is "none", "one" or "two" effects of the library; "left_out": one that is taken out of the library before
    the case is diagnosed; "invented": one that no library has.
    """

    kind: Kind
    members: tuple[Member, ...] = ()
    without: tuple[str, ...] = ()

    @property
    def identities(self) -> Answer:
        """Return names and channels of the effects that act."""
        return frozenset(member.identity for member in self.members)


@dataclass(frozen=True, kw_only=True)
class Truth(Drawn):
    """Content of a key: name of the case, seed of the data, whether the maps were made sample by sample.

    The nonce is 256 random bits, in hexadecimal: without them a short list of possible keys could be tried against the
    seal.
    """

    case: str
    seed: int
    sampled: bool
    nonce: str = ""


@dataclass(frozen=True, kw_only=True)
class Record:
    """One case after its key is opened; the names are keys of ``score.json``."""

    #: case, kind, truth: name and kind of the case, and the effects that act
    case: str
    kind: Kind
    truth: Answer
    #: strength, columns: expected S/N of all effects together, and number of linear components of a single one
    strength: float
    columns: int
    #: weakest, rival, distances: smallest expected S/N of an effect alone, the largest cosine of the response of one
    #: alone with any other candidate, and the S/N that the best one, two and three candidates, none of them acting,
    #: leave of the response
    weakest: float
    rival: float
    distances: tuple[float, ...]
    #: p_value, maximum, verdict, answers: p-value of the global test, and of the most significant candidate alone,
    #: look-elsewhere effect included; the verdict, and the accepted sets of effects, the best first
    p_value: float
    maximum: float
    verdict: str
    answers: tuple[Answer, ...]
    #: bayes, bayes_right: most probable set of the Bayes-optimal classifier, and the probability that this gives it;
    #: None and NaN where the truth is none of its hypotheses
    bayes: Answer | None = None
    bayes_right: float = np.nan
    #: pulls, fitted: fitted less true components over their errors, where the only effect was named; and named or not
    pulls: tuple[float, ...] = ()
    fitted: tuple[float, ...] = ()
    #: predicted, achieved, sigma: fractional reduction of the excess chi^2 on held-out data, and the error of the
    #: measured one; None: not measured
    predicted: float | None = None
    achieved: float | None = None
    sigma: float | None = None
    #: gaps, absent: excess chi^2 of held-out data before and after the named effects are added; after one that does not
    #: act
    gaps: tuple[float, float] | None = None
    absent: tuple[float, float] | None = None
    #: places, sampled: (frame, L, parity) of the three most significant places, None: not looked for; True if the maps
    #: were made sample by sample
    places: tuple[Place, ...] | None = None
    sampled: bool = False

    @property
    def best(self) -> Answer | None:
        """Return the set of effects that is named first."""
        return self.answers[0] if self.answers else None

    @property
    def in_library(self) -> bool:
        """Return True if the library has all effects that act."""
        return self.kind in IN_LIBRARY

    @property
    def right(self) -> bool:
        """Return True if the truth is named first, or called unknown where the library does not have it."""
        if not self.in_library:
            return self.verdict == "unknown"
        return self.verdict == "none" if not self.truth else self.best == self.truth

    @property
    def wrong_name(self) -> bool:
        """Return True if one effect is named, without an alternative, that does not act."""
        return self.verdict == "effect" and self.best is not None and not self.best <= self.truth
