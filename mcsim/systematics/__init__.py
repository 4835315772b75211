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
    acts_through,
    described,
)
from mcsim.systematics.hooks import HookError, if_possible
from mcsim.systematics.parametrization import Parametrization
from mcsim.systematics.registry import Library, basis_of, build, called, catalogue, checked, effects, get, in_file
from mcsim.systematics.together import (
    adding,
    disturbing,
    looked_at,
    reach,
    rescaling,
    seen_through,
    shared_gain,
    spread_of,
    tried,
    variance_factor,
)

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
    "acts_through",
    "adding",
    "basis_of",
    "build",
    "called",
    "catalogue",
    "checked",
    "described",
    "disturbing",
    "effects",
    "get",
    "if_possible",
    "in_file",
    "looked_at",
    "reach",
    "rescaling",
    "seen_through",
    "shared_gain",
    "spread_of",
    "tried",
    "variance_factor",
]
