"""Several effects at once, in the order of their stages."""

from collections.abc import Iterable

from mcsim.beams import Beam
from mcsim.effects.base import Effect, Site


def seen_through(acting: Iterable[Effect], site: Site) -> Beam:
    """The beam about the believed line of sight: every effect on its shape first, then all that displaces it."""
    acting = tuple(acting)
    beam = site.beam
    for effect in acting:
        beam = effect.beam(beam, site)
    for effect in acting:
        beam = effect.pointing(beam, site)
    return beam
