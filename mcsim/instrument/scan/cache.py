"""Moments on disk, computed once for all processes and runs that need them."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

from mcsim.instrument.scan.accumulate import stream_sums
from mcsim.instrument.scan.geometry import MapGrid
from mcsim.instrument.scan.model import ScanModel
from mcsim.instrument.scan.moments import Moments
from mcsim.support import folders
from mcsim.support.code import package_digest


def scan_key(model: ScanModel, grid: MapGrid, smax: int = 0) -> str:
    """Return the SHA-256 of all code and all numbers that the samples of a model's default lines of sight depend on.

    Names and citations are left out. ``smax``: largest s of what is computed from them.
    """
    lines = model.select()
    everything = {
        "code": package_digest(["mcsim.instrument.scan"], ["healpy", "numpy"]),
        "spin": [model.spin_period_s, model.spin_phase_deg],
        "precession": [model.precession_period_s, model.precession_angle_deg, model.precession_phase_deg],
        "orbit": [model.orbit_period_s, model.orbit_phase_deg],
        "duration_days": model.duration_days,
        "lines": [[line.boresight_angle_deg, line.azimuth_deg, model.period_of_samples(line)] for line in lines],
        "time_range": [float(edge) for edge in grid.time_range],
        "nside": grid.nside,
        "smax": smax,
        "frame": grid.frame,
    }
    return hashlib.sha256(json.dumps(everything, sort_keys=True).encode()).hexdigest()


def cached_moments(
    model: ScanModel,
    grid: MapGrid,
    smax: int,
    nthreads: int = 1,
    progress: Callable[[float], None] | None = None,
    cache_dir: str | Path | None = None,
) -> Path:
    """Return the folder, for :meth:`Moments.load`, with the moments of a survey's default lines of sight.

    They are streamed (:func:`mcsim.instrument.scan.accumulate.stream_sums`) if they are not in the cache yet: that of
    ``cache_dir``, or of :func:`mcsim.support.folders.default_cache_dir`. The folder appears complete or not at all;
    InputError if it cannot be written.
    """

    def fill(folder: Path) -> None:
        Moments.from_sums(stream_sums(model, grid, smax, nthreads, progress), grid.frame).save(folder)

    return folders.cached(f"moments-{scan_key(model, grid, smax)}", fill, cache_dir)
