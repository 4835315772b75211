"""Several effects at once, in the order of their stages."""

from collections.abc import Iterable

import numpy as np

from mcsim.instrument.beams import Beam
from mcsim.sphere import rng
from mcsim.systematics.base import Alm, Effect, Site


def seen_through(acting: Iterable[Effect], site: Site) -> Beam:
    """Return the beam about the fiducial line of sight: every effect on its shape first, then all that displaces it."""
    acting = tuple(acting)
    beam = site.beam
    for effect in acting:
        beam = effect.beam(beam, site)
    for effect in acting:
        beam = effect.pointing(beam, site)
    return beam


def spread_of(acting: Iterable[Effect]) -> float:
    """By what factor the samples' offsets from the centre of their pixel shrink."""
    return float(np.prod([effect.spread() for effect in acting]))


def looked_at(acting: Iterable[Effect], sky: Alm, site: Site, seed: int, realization: int) -> Alm:
    """Return the sky that a channel looks at, uK; what an effect draws depends on its own name, not on the channel."""
    for effect in acting:

        def draw(stage: str, name: str = effect.name) -> np.random.Generator:
            return rng.generator(seed, realization, f"effect/{name}/{stage}")

        sky = effect.sky(sky, site, draw)
    return sky
