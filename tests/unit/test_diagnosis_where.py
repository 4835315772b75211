"""The ranked list of places: what departs most first, and of each kind one before the others."""

import numpy as np

from mcsim.diagnosis.localisation import places
from mcsim.diagnosis.summaries import Element

KINDS = [("V1", "ecliptic", 2), ("W1", "ecliptic", 2), ("W2", "ecliptic", 2), ("V1", "galactic", 1), ("W1", None, 0)]


def elements() -> list[Element]:
    return [
        Element(f"{channel}/{frame}/{L}", "biposh", (channel,), frame=frame, L=L, M=0, parity="even")
        for channel, frame, L in KINDS
    ]


def ranked(x: list[float]) -> list[tuple[str, int | None]]:
    simulations = np.random.default_rng(1).normal(size=(400, len(KINDS)))
    return [(place.element.channels[0], place.element.L) for place in places(np.array(x), simulations, elements())]


def test_each_kind_comes_before_more_of_the_same():
    assert ranked([9.0, 12.0, 10.0, 7.0, 0.1])[:4] == [("W1", 2), ("V1", 1), ("W2", 2), ("V1", 2)]


def test_what_is_not_significant_is_brought_before_nothing():
    assert ranked([9.0, 12.0, 10.0, 1.0, 0.1])[:3] == [("W1", 2), ("W2", 2), ("V1", 2)]
