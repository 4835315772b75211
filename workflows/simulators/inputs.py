"""What every simulator is given: the sky, the beams and the scans of a run, and folders for its maps."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any

import healpy
import numpy as np
from numpy.typing import NDArray

import mcsim
from mcsim.ensemble.maps import write_map
from mcsim.instrument.scan import LineOfSight
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.sphere.rotation import rotation_matrix

Vector = NDArray[np.float64]
Maps = dict[str, Vector]
"""Maps of a run by name (``channel`` or ``channel_split``), uK, UNSEEN where nothing was observed."""

BLOCK = 1 << 18
"""Samples that are simulated at once."""

CALLS: list[float] = []
"""Processor time of every call of a method that is :func:`timed`, seconds."""


def processor_seconds() -> float:
    """Return the processor time of this process and of its children that have ended, user and system."""
    return sum(os.times()[:4])


def timed(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method that adds the processor time of each of its calls to ``CALLS``."""

    @wraps(method)
    def own(*given: Any, **named: Any) -> Any:
        start = processor_seconds()
        found = method(*given, **named)
        _add(processor_seconds() - start)  # by name: a class of a script is copied with what its methods hold
        return found

    return own


def _add(seconds: float) -> None:
    CALLS.append(seconds)


@dataclass(frozen=True)
class Channel:
    """One detector: its beam, and the line of sight of a scan model."""

    name: str
    beam: mcsim.Beam
    model: mcsim.ScanModel
    line: LineOfSight


@dataclass(frozen=True)
class Inputs:
    """Sky (a_lm in uK, healpy's order, up to lmax), channels, and the maps' nside, frame and splits."""

    sky: NDArray[np.complex128]
    lmax: int
    channels: tuple[Channel, ...]
    nside: int
    frame: str
    splits: tuple[str, ...]


def of(source: str | Path | mcsim.RunConfig, realization: int = 0) -> Inputs:
    """Return the inputs of one realization of a run, whose scans must be of kind ``hit_averaged``."""
    run = source if isinstance(source, mcsim.RunConfig) else mcsim.load_config(source)
    whole = survey(run)
    sites = [channel.site for channel in whole.channels]
    channels = [Channel(s.channel, s.beam, s.pointing.model, s.pointing.line) for s in sites]
    sky = simulate.draw_sky(whole, realization)
    return Inputs(sky, run.sky.lmax, tuple(channels), run.map.nside, run.map.frame, run.map.splits)


def parts(inputs: Inputs, channel: Channel) -> Iterator[tuple[str, range]]:
    """Yield the name of each map of a channel and its samples."""
    number, splits = channel.model.samples(channel.line), inputs.splits or ("",)
    edges = [round(i * number / len(splits)) for i in range(len(splits) + 1)]
    for split, first, last in zip(splits, edges, edges[1:], strict=False):
        yield f"{channel.name}_{split}" if split else channel.name, range(first, last)


def blocks(samples: range) -> Iterator[range]:
    """Cut samples into blocks."""
    for first in range(samples.start, samples.stop, BLOCK):
        yield range(first, min(first + BLOCK, samples.stop))


def pointing(channel: Channel, samples: range, frame: str, late: float = 0.0) -> tuple[Vector, Vector, Vector]:
    """Return theta, phi and psi, radians, ``late`` samples after samples, from products of rotations in numpy alone."""
    model, line = channel.model, channel.line
    t = model.period_of_samples(line) * (np.arange(samples.start, samples.stop) + late)
    spin = 2 * np.pi * t / model.spin_period_s + np.deg2rad(model.spin_phase_deg + line.azimuth_deg)
    precession = 2 * np.pi * t / model.precession_period_s + np.deg2rad(model.precession_phase_deg)
    orbit = 2 * np.pi * t / model.orbit_period_s + np.deg2rad(model.orbit_phase_deg)
    boresight, tilt = np.deg2rad([line.boresight_angle_deg, model.precession_angle_deg])
    zero = np.zeros_like(t)
    n = np.stack([np.sin(boresight) * np.cos(spin), np.sin(boresight) * np.sin(spin), np.cos(boresight) + zero])
    x = np.stack([-np.sin(spin), np.cos(spin), zero])  # (spin axis) x (line of sight): along the scan
    n, x = (_about_z(_about_y(_about_z(_about_y(v, tilt), precession), np.pi / 2), orbit) for v in (n, x))
    turn = rotation_matrix("ecliptic", frame)
    n, x = turn @ n, turn @ x
    theta, phi = healpy.vec2ang(n.T)
    south = np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)])
    east = np.stack([-np.sin(phi), np.cos(phi), zero])
    return theta, phi, np.arctan2(np.sum(x * east, axis=0), np.sum(x * south, axis=0))


def _about_z(v: Vector, angle: Vector) -> Vector:
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]])


def _about_y(v: Vector, angle: float) -> Vector:
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * v[0] + s * v[2], v[1], c * v[2] - s * v[0]])


def binned(nside: int, samples: Iterator[tuple[NDArray[np.int64], Vector]]) -> Vector:
    """Return the mean of the samples, (pixel, uK) in blocks, of every pixel."""
    total, hits = np.zeros(12 * nside**2), np.zeros(12 * nside**2)
    for pixel, signal in samples:
        total += np.bincount(pixel, signal, total.size)
        hits += np.bincount(pixel, minlength=total.size)
    return np.divide(total, hits, out=np.full(total.size, healpy.UNSEEN), where=hits > 0)


def write(folder: str | Path, maps: Maps, frame: str) -> None:
    """Write maps as FITS files."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    for name, map_uk in maps.items():
        write_map(Path(folder) / f"{name}.fits", map_uk, frame)
