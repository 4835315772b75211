"""Scan models, pointing, orientation moments of the beam, and their exact long-time limit."""

from mcsim.instrument.scan.cache import cached_moments
from mcsim.instrument.scan.described import Described, read_described
from mcsim.instrument.scan.factors import limit_factors, scan_factors, summary
from mcsim.instrument.scan.given import read_moments
from mcsim.instrument.scan.limit import limit_moments
from mcsim.instrument.scan.model import LineOfSight, ScanModel
from mcsim.instrument.scan.moments import Moments, read_moments_fits, write_moments_fits

__all__ = [
    "Described",
    "LineOfSight",
    "Moments",
    "ScanModel",
    "cached_moments",
    "limit_factors",
    "limit_moments",
    "read_described",
    "read_moments",
    "read_moments_fits",
    "scan_factors",
    "summary",
    "write_moments_fits",
]
