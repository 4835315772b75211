"""Maps from the differences of two beams: pairs of pixels, right-hand sides, conjugate gradients."""

from mcsim.mapmaking.pairs import DifferencingScan, prepare
from mcsim.mapmaking.rhs import SideMaps, rhs_from_maps, rhs_from_samples, side_maps
from mcsim.mapmaking.solve import MapmakingReport, diagonal, solve

__all__ = [
    "DifferencingScan",
    "MapmakingReport",
    "SideMaps",
    "diagonal",
    "prepare",
    "rhs_from_maps",
    "rhs_from_samples",
    "side_maps",
    "solve",
]
