"""Scan models, pointing, orientation moments of the beam, and their exact long-time limit."""

from mcsim.instrument.scan.accumulate import stream_moments
from mcsim.instrument.scan.cache import cached_moments
from mcsim.instrument.scan.described import Described, read_described
from mcsim.instrument.scan.factors import limit_factors, scan_factors, summary
from mcsim.instrument.scan.limit import limit_moments, limit_on_pixels
from mcsim.instrument.scan.model import LineOfSight, ScanModel, load_model
from mcsim.instrument.scan.moments import Moments, parallel_transport, read_moments_fits, write_moments_fits
from mcsim.instrument.scan.user_pointing import pointing_moments

__all__ = [
    "Described",
    "LineOfSight",
    "Moments",
    "ScanModel",
    "cached_moments",
    "limit_factors",
    "limit_moments",
    "limit_on_pixels",
    "load_model",
    "parallel_transport",
    "pointing_moments",
    "read_described",
    "read_moments_fits",
    "scan_factors",
    "stream_moments",
    "summary",
    "write_moments_fits",
]
