"""Candidates: effects that may be in the data, and what a joint fit says of each."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.errors import InputError
from mcsim.stats.gaussian import Fit
from mcsim.systematics import Effect, basis_of

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Candidate:
    """Describe one effect in one channel, or in all of them, with fixed settings.

    Attributes
    ----------
    effect
        Class of the effect.
    channel
        Name of the channel; None: all.
    columns
        Its columns in the matrix of templates, one for each of its linear components.
    settings
        Parameters that are not fitted.
    prior
        Weight relative to the other candidates.
    shape_error
        Relative error of its templates in white norm; None: that of the settings.
    scatter
        Deviations of its response from the mean one if it is stochastic, for
        :meth:`~mcsim.stats.gaussian.SimulatedGaussian.with_extra_covariance`; None if they are not known.
    """

    effect: type[Effect]
    channel: str | None
    columns: tuple[int, ...]
    settings: Mapping[str, Any] = field(default_factory=dict)
    prior: float = 1.0
    shape_error: float | None = None
    scatter: NDArray[np.float64] | None = field(default=None, compare=False)

    @property
    def name(self) -> str:
        """Return the name of the effect."""
        return self.effect.name

    @property
    def unit(self) -> str:
        """Return the unit of the amplitude."""
        return self.effect.unit

    @property
    def identity(self) -> tuple[str, str | None]:
        """Return name and channel: candidates that share them differ only in settings and exclude each other."""
        return self.name, self.channel

    @property
    def label(self) -> str:
        """Return name, channel and settings as text."""
        settings = ", ".join(f"{key} = {value}" for key, value in self.settings.items())
        return f"{self.name} ({self.channel or 'all'}{', ' + settings if settings else ''})"

    @property
    def title(self) -> str:
        """Return the effect in words, with channel and settings."""
        settings = (f"{key} = {value}" for key, value in self.settings.items())
        return ", ".join((self.effect.label(self.channel), *settings))

    @property
    def basis(self) -> tuple[Effect, ...]:
        """Return the effects whose responses span it, one for each column."""
        return basis_of(self.effect, self.settings)

    @property
    def random_response(self) -> bool:
        """Return True if its templates are measured from random draws, not from an effect that is taken away."""
        return self.effect.parametrization.stochastic and self.effect.parametrization.sign >= 0

    def with_coordinates(self, coordinates: Vector, precision: NDArray[np.float64]) -> Effect:
        """Return the effect nearest to coordinates in the metric ``precision``."""
        return self.effect(**{**self.effect.parametrization.nearest(coordinates, precision), **self.settings})

    def fitted(self, coordinates: Vector, covariance: NDArray[np.float64]) -> Effect:
        """Return the effect nearest to fitted coordinates, as far as the data constrain them."""
        precision: NDArray[np.float64] = np.asarray(np.linalg.pinv(covariance), dtype=np.float64)
        return self.with_coordinates(self.effect.parametrization.constrained(coordinates, precision), precision)

    def detected(self, coordinates: Vector, covariance: NDArray[np.float64]) -> Effect:
        """Return :meth:`fitted`; raise InputError if the data do not constrain the effect at all."""
        effect = self.fitted(coordinates, covariance)
        if effect.amplitude == 0.0:
            raise InputError(f"the data do not constrain {self.label} by itself; leave it out of what is added.")
        return effect

    def table(self, effect: Effect) -> config.Effect:
        """Return the effect as an ``[[effect]]`` of a run."""
        return config.Effect(
            name=effect.name, channel=self.channel, parameters={"amplitude": effect.amplitude, **effect.parameters()}
        )

    def allows(self, amplitudes: Vector) -> bool:
        """Return True if the amplitudes have the sign, and at most the size, that the effect can have."""
        if self.effect.parametrization.sign and bool(np.any(amplitudes < 0.0)):
            return False
        return float(np.linalg.norm(amplitudes)) <= self.effect.parametrization.max_amplitude


def numbered(candidates: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Return the candidates with consecutive columns."""
    edges = np.cumsum([0, *(len(candidate.columns) for candidate in candidates)])
    return tuple(
        replace(candidate, columns=tuple(range(int(start), int(start) + len(candidate.columns))))
        for candidate, start in zip(candidates, edges[:-1], strict=True)
    )


def columns_of(candidates: Sequence[Candidate], members: Sequence[int]) -> list[int]:
    """Return the columns of some candidates, one after the other."""
    return [column for member in members for column in candidates[member].columns]


def parts_of(
    candidates: Sequence[Candidate], members: Sequence[int], found: Fit
) -> Iterator[tuple[int, NDArray[np.float64], NDArray[np.float64]]]:
    """Yield each member of a fit of :func:`columns_of`, its amplitudes and their covariance."""
    start = 0
    for member in members:
        own = slice(start, start + len(candidates[member].columns))
        yield member, found.amplitudes[own], found.covariance[own, own]
        start = own.stop


def within_bounds(candidates: Sequence[Candidate], members: Sequence[int], found: Fit) -> bool:
    """Return True if every fitted amplitude is within its bounds."""
    return all(candidates[member].allows(amplitudes) for member, amplitudes, _ in parts_of(candidates, members, found))


def effects_at(candidates: Sequence[Candidate], members: Sequence[int], found: Fit) -> list[Effect]:
    """Return the effects nearest to a fit; raise InputError if one cannot have its amplitude."""
    return [
        candidates[member].detected(amplitudes, covariance)
        for member, amplitudes, covariance in parts_of(candidates, members, found)
    ]


def tables_at(candidates: Sequence[Candidate], members: Sequence[int], found: Fit) -> list[config.Effect]:
    """Return :func:`effects_at` as ``[[effect]]`` of a run."""
    effects = effects_at(candidates, members, found)
    return [candidates[member].table(effect) for member, effect in zip(members, effects, strict=True)]
