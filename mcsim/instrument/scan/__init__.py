"""Scan models, pointing, orientation moments of the beam, and their exact long-time limit."""

from mcsim.instrument.scan.factors import limit_factors, scan_factors, summary
from mcsim.instrument.scan.files import read_moments, write_moments_fits
from mcsim.instrument.scan.geometry import MapGrid
from mcsim.instrument.scan.limit import has_limit, limit_moments
from mcsim.instrument.scan.model import LineOfSight, ScanModel, read_described
from mcsim.instrument.scan.moments import Moments, cached_moments, scan_key
from mcsim.instrument.scan.sampling import warn_of_aliases

__all__ = [
    "LineOfSight",
    "MapGrid",
    "Moments",
    "ScanModel",
    "cached_moments",
    "has_limit",
    "limit_factors",
    "limit_moments",
    "read_described",
    "read_moments",
    "scan_factors",
    "scan_key",
    "summary",
    "warn_of_aliases",
    "write_moments_fits",
]
