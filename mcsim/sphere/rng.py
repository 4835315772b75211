"""Random generators from (seed, realization, stage), independent of workers, order and resumption."""

import zlib

import numpy as np

from mcsim.sphere.checks import check_whole


def generator(seed: int, realization: int, stage: str) -> np.random.Generator:
    """Return the generator of one ``stage`` of one realization, whose index is 0 or more, of a run with this seed.

    The stage is what is drawn, for example ``"sky"`` or ``"noise/W1/half1"``. Stages are named, not counted, so that a
    new channel does not change another channel's draw; the CRC-32 of the name is the second spawn key.
    """
    check_whole(seed, "seed")
    check_whole(realization, "realization")
    spawn_key = (realization, zlib.crc32(stage.encode()))
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=spawn_key))
