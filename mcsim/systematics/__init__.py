"""The library of effects: one file each, found by name; other packages add theirs by entry points."""

from mcsim.systematics.base import Alm, Draw, Effect, Map, Pointing, Site, Wording
from mcsim.systematics.compose import looked_at, seen_through, spread_of
from mcsim.systematics.registry import Library, build, catalogue, describe, get

__all__ = [
    "Alm",
    "Draw",
    "Effect",
    "Library",
    "Map",
    "Pointing",
    "Site",
    "Wording",
    "build",
    "catalogue",
    "describe",
    "get",
    "looked_at",
    "seen_through",
    "spread_of",
]
