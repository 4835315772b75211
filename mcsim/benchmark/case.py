"""Describe one case of a challenge: the effects that act in it, and the prior that they are drawn from."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.errors import InputError

Vector = NDArray[np.float64]
Kind = Literal["none", "one", "two", "left_out", "invented"]
Identity = tuple[str, str | None]
"""Name of an effect and of its channel; None: all channels."""
Answer = frozenset[Identity]
"""Effects that act together; the empty set: no effect."""

KINDS: tuple[Kind, ...] = ("none", "one", "two", "left_out", "invented")
IN_LIBRARY = ("none", "one", "two")
"""Kinds of cases whose effects the diagnosis can name."""


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

    Attributes
    ----------
    name, channel, parameters
        As in ``[[effect]]`` of a run, amplitude included.
    coordinates
        Linear components of the effect.
    strength
        Expected S/N: whitened norm of its response in the data vector of this very sky; of a stochastic effect, of its
        mean response.
    candidate
        Index among the candidates of the full library; None: an out-of-library effect.
    response
        Response of the data vector to an out-of-library effect, which has no template.
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

    def table(self) -> config.Effect:
        """Return the effect as ``[[effect]]`` of a run."""
        return config.Effect(name=self.name, channel=self.channel, parameters=dict(self.parameters))


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """What was drawn for a case.

    Attributes
    ----------
    kind
        "none", "one" or "two" effects of the library; "left_out": one that is taken out of the library before the case
        is diagnosed; "invented": one that no library has.
    members
        Effects that act.
    without
        Effects that the diagnosis must not propose.
    """

    kind: Kind
    members: tuple[Member, ...] = ()
    without: tuple[str, ...] = ()

    @property
    def identities(self) -> Answer:
        """Return names and channels of the effects that act."""
        return frozenset(member.identity for member in self.members)

    @property
    def in_library(self) -> bool:
        """Return True if the diagnosis can name all effects that act."""
        return self.kind in IN_LIBRARY


@dataclass(frozen=True, kw_only=True)
class Truth(Drawn):
    """Content of a key.

    Attributes
    ----------
    case
        Name of the case.
    seed
        Seed of the simulated data.
    sampled
        True if the maps were made sample by sample.
    nonce
        256 random bits, in hexadecimal: without them a short list of possible keys could be tried against the seal.
    """

    case: str
    seed: int
    sampled: bool
    nonce: str = ""
