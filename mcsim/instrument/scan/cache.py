"""Moments on disk, computed once for all processes and runs that need them."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

from mcsim.instrument.scan.accumulate import means, stream_sums
from mcsim.instrument.scan.geometry import MapGrid
from mcsim.instrument.scan.model import ScanModel
from mcsim.instrument.scan.moments import Moments
from mcsim.support import folders
from mcsim.support.code import package_digest


def moments_key(
    model: ScanModel,
    nside: int,
    smax: int,
    frame: str,
    lines_of_sight: list[str] | tuple[str, ...] | None = None,
    time_range: tuple[float, float] = (0.0, 1.0),
) -> str:
    """Return the SHA-256 of all numbers and all code that the moments depend on, names and citations left out."""
    lines = [
        [line.boresight_angle_deg, line.azimuth_deg, model.period_of_samples(line)]
        for line in model.select(lines_of_sight)
    ]
    everything = {
        "code": package_digest(["mcsim.instrument.scan"], ["healpy", "numpy"]),
        "spin": [model.spin_period_s, model.spin_phase_deg],
        "precession": [model.precession_period_s, model.precession_angle_deg, model.precession_phase_deg],
        "orbit": [model.orbit_period_s, model.orbit_phase_deg],
        "duration_days": model.duration_days,
        "lines_of_sight": lines,
        "time_range": [float(edge) for edge in time_range],
        "nside": nside,
        "smax": smax,
        "frame": frame,
    }
    return hashlib.sha256(json.dumps(everything, sort_keys=True).encode()).hexdigest()


def cached_moments(
    model: ScanModel,
    nside: int,
    smax: int,
    frame: str = "ecliptic",
    lines_of_sight: list[str] | tuple[str, ...] | None = None,
    time_range: tuple[float, float] = (0.0, 1.0),
    nthreads: int = 1,
    progress: Callable[[float], None] | None = None,
    cache_dir: str | Path | None = None,
) -> Path:
    """Return the folder with the streamed moments of a survey, computed if it is not there yet.

    Parameters
    ----------
    model, smax, nthreads, progress
        As in :func:`mcsim.instrument.scan.accumulate.stream_sums`.
    nside, frame, time_range
        As in :class:`mcsim.instrument.scan.geometry.MapGrid`.
    lines_of_sight
        Names of the lines of sight to add up; None: the model's default ones.
    cache_dir
        Where to keep it; None: :func:`mcsim.support.folders.default_cache_dir`.

    Returns
    -------
    Path
        Folder for :meth:`mcsim.instrument.scan.moments.Moments.load`. It appears complete or not at all: it is written
        under another name and renamed.

    Raises
    ------
    InputError
        If the cache folder cannot be written, or as in ``MapGrid`` and ``stream_sums``.
    """

    def fill(folder: Path) -> None:
        chosen = model if lines_of_sight is None else model.with_lines_of_sight(*lines_of_sight)
        sums = stream_sums(chosen, MapGrid(nside, frame, time_range), smax, nthreads, progress)
        Moments(nside, frame, **means(sums, nside, smax)).save(folder)

    name = f"moments-{moments_key(model, nside, smax, frame, lines_of_sight, time_range)}"
    return folders.cached(name, fill, cache_dir)
