"""The library of effects, found by name, in files by what they act on; other packages add theirs by entry points."""

from mcsim.systematics.base import (
    Alm,
    Bound,
    Draw,
    Effect,
    Map,
    Pointing,
    Site,
    Wording,
    adding,
    disturbing,
    looked_at,
    reach,
    rescaling,
    seen_through,
    spread_of,
    tried,
    variance_factor,
)
from mcsim.systematics.hooks import HookError
from mcsim.systematics.parametrization import Parametrization
from mcsim.systematics.registry import Library, basis_of, build, catalogue, checked, effects, get, in_file

__all__ = [
    "Alm",
    "Bound",
    "Draw",
    "Effect",
    "HookError",
    "Library",
    "Map",
    "Parametrization",
    "Pointing",
    "Site",
    "Wording",
    "adding",
    "basis_of",
    "build",
    "catalogue",
    "checked",
    "disturbing",
    "effects",
    "get",
    "in_file",
    "looked_at",
    "reach",
    "rescaling",
    "seen_through",
    "spread_of",
    "tried",
    "variance_factor",
]
