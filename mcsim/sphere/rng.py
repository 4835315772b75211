"""From (seed, realization, stage) to a random generator, independent of workers, order and resumption."""

import zlib

import numpy as np

from mcsim.sphere.checks import check_whole


def generator(seed: int, realization: int, stage: str) -> np.random.Generator:
    """Generator of one stage of one realization.

    Parameters
    ----------
    seed
        The run's seed.
    realization
        Index of the realization, >= 0.
    stage
        What is drawn, for example ``"sky"`` or ``"noise/W1/half1"``. Stages are named, not counted, so that a
        further channel changes no other channel's draw; the CRC-32 of the name is the second spawn key.
    """
    check_whole(seed, "seed")
    check_whole(realization, "realization")
    spawn_key = (realization, zlib.crc32(stage.encode()))
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=spawn_key))
