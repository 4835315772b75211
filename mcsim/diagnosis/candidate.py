"""What might explain a gap, and what a fit of several says of each."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mcsim.stats.gaussian import Fit


@dataclass(frozen=True)
class Candidate:
    """One effect on one channel, or common to all (``channel=None``), with fixed settings.

    Attributes
    ----------
    name, channel, settings, unit
        Of the effect.
    columns
        Of its linear components in the template matrix.
    prior
        Weight relative to the other candidates.
    shape_error
        Relative error of its templates in white length; ``None``: that of the search.
    positive
        Whether an amplitude below zero is none: a set that asks for one explains nothing.
    most
        Length of the coordinates beyond which they are none either.
    scatter
        Deviations of its response from the mean one, where it draws: :meth:`~mcsim.stats.gaussian.Null.widened` by
        them is what a set that has it is judged with. ``None``: no scatter is known.
    """

    name: str
    channel: str | None
    columns: tuple[int, ...]
    settings: Mapping[str, object] = field(default_factory=dict)
    unit: str = ""
    prior: float = 1.0
    shape_error: float | None = None
    positive: bool = False
    max_amplitude: float = np.inf
    scatter: NDArray[np.float64] | None = field(default=None, compare=False)

    @property
    def identity(self) -> tuple[str, str | None]:
        """Name and channel: candidates that share them differ only in settings and exclude each other."""
        return self.name, self.channel


def columns_of(candidates: Sequence[Candidate], members: Sequence[int]) -> list[int]:
    """Columns of some candidates, one after the other."""
    return [column for member in members for column in candidates[member].columns]


def parts_of(
    candidates: Sequence[Candidate], members: Sequence[int], found: Fit
) -> Iterator[tuple[int, NDArray[np.float64], NDArray[np.float64]]]:
    """Of a fit of :func:`columns_of` members: each member, its amplitudes, and their covariance."""
    start = 0
    for member in members:
        own = slice(start, start + len(candidates[member].columns))
        yield member, found.amplitudes[own], found.covariance[own, own]
        start = own.stop


def allowed(candidates: Sequence[Candidate], members: Sequence[int], found: Fit) -> bool:
    """Whether a fit of members asks for no amplitude that one of them cannot have."""
    for member, amplitudes, _ in parts_of(candidates, members, found):
        candidate = candidates[member]
        if (candidate.positive and np.any(amplitudes < 0.0)) or np.linalg.norm(amplitudes) > candidate.max_amplitude:
            return False
    return True
