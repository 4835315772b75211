"""Maps from the differences of two beams: pairs of pixels, right-hand sides, conjugate gradients."""

from mcsim.simulation.mapmaking.pairs import DifferencingScan, prepare
from mcsim.simulation.mapmaking.rhs import DifferenceNoise, Imbalance, SideMaps, rhs_from_maps, side_maps
from mcsim.simulation.mapmaking.solve import MapmakingReport, StoppingRule, diagonal, level_uk, rhs_of_map, solve

__all__ = [
    "DifferenceNoise",
    "DifferencingScan",
    "Imbalance",
    "MapmakingReport",
    "SideMaps",
    "StoppingRule",
    "diagonal",
    "level_uk",
    "prepare",
    "rhs_from_maps",
    "rhs_of_map",
    "side_maps",
    "solve",
]
