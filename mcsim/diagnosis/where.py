"""Where a gap lies: groups of the atlas that depart from the model, ranked, corrected for looking at all of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.summaries import Element
from mcsim.stats.look_elsewhere import scan_pvalues

SIGNIFICANT = 0.01
"""Probability, trials included, up to which a group is brought before others of a kind that is listed already."""


@dataclass(frozen=True)
class Place:
    """A group of numbers that belong together, and how far it departs.

    Attributes
    ----------
    entry
        The number of the group that departs most.
    z
        Normal deviate of the group.
    p
        Probability that the largest of all groups departs as far.
    peak
        Deviate of that number alone.
    """

    element: Element
    z: float
    p: float
    peak: float


def places(x: NDArray[np.float64], simulations: NDArray[np.float64], elements: Sequence[Element]) -> list[Place]:
    """Groups of entries, the one that departs most first, and of each kind one before the others of it.

    Parameters
    ----------
    x, simulations
        Shape (B,), (N, B).
    entries
        Where each number was heard; those that share statistic, channels, split, frame, L, M and parity are a group.

    Notes
    -----
    A kind is a frame, an L and a parity: one gap stands out in every channel and split that hears it, and a list of
    these would hide what else it says. Groups that are not significant stay in the order of their deviates.
    The cube root of a group's sum of squared deviates is nearly normal (Wilson & Hilferty 1931); it is compared with
    those of the simulations, each taken against the others.
    """
    count = len(simulations)
    mean, spread = simulations.mean(axis=0), simulations.std(axis=0, ddof=1)
    spread = np.where(spread > 0, spread, np.inf)
    deviates = (x - mean) / spread / np.sqrt(1.0 + 1.0 / count)
    others = (simulations - mean) / spread
    groups: dict[tuple[object, ...], list[int]] = {}
    for number, e in enumerate(elements):
        groups.setdefault((e.statistic, e.channels, e.split, e.frame, e.L, e.M, e.parity), []).append(number)
    rows = list(groups.values())
    found = np.array([np.mean(deviates[row] ** 2) for row in rows])
    drawn = np.stack([np.mean(others[:, row] ** 2, axis=1) for row in rows], axis=1)
    z, p = scan_pvalues(np.cbrt(found), np.cbrt(drawn))
    # Too quiet a group is no place of a gap.
    p = np.where(z > 0, p, 1.0)
    firsts: list[Place] = []
    others_of_kind: list[Place] = []
    seen: set[tuple[object, ...]] = set()
    for group in np.argsort(-z):
        row = rows[group]
        peak = row[int(np.argmax(np.abs(deviates[row])))]
        place = Place(elements[peak], float(z[group]), float(p[group]), float(deviates[peak]))
        kind = (place.element.frame, place.element.L, place.element.parity)
        new = kind not in seen and (place.p <= SIGNIFICANT or not seen)
        (firsts if new else others_of_kind).append(place)
        seen.add(kind)
    return firsts + others_of_kind
