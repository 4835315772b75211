"""Where the spacecraft looks and moves: angles and directions that its signals depend on, and their words."""

import numpy as np
from numpy.typing import NDArray

from mcsim.instrument.scan import ScanModel
from mcsim.sphere.rotation import rotation_matrix
from mcsim.systematics.base import Pointing
from mcsim.systematics.parametrization import Vector

_NAMED_WITHIN_DEG = 5.0  #: of a direction that has a name


def spin_phase(pointing: Pointing, time_s: Vector) -> Vector:
    """Return the angle of the line of sight about the spin axis, from the half plane of the Sun, radians.

    Notes
    -----
    The spin axis precesses about the anti-Sun direction, and the spin is counted in the frame that precesses with it:
    the Sun stays at azimuth 0 about the axis.
    """
    model = pointing.model
    start_deg = model.spin_phase_deg + pointing.line.azimuth_deg
    return np.asarray(2.0 * np.pi * (time_s / model.spin_period_s % 1.0) + np.deg2rad(start_deg))


def line_of_sight(pointing: Pointing, time_s: Vector, frame: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return unit vectors along the line of sight and its motion at some times, shape (3, n) each.

    :class:`mcsim.instrument.scan.ScanModel` has the rotations.
    """
    model, line, spin = pointing.model, pointing.line, spin_phase(pointing, time_s)
    sin_b, cos_b = (f(np.deg2rad(line.boresight_angle_deg)) for f in (np.sin, np.cos))
    beam = np.stack([sin_b * np.cos(spin), sin_b * np.sin(spin), np.full(spin.shape, cos_b)])
    along = np.stack([-np.sin(spin), np.cos(spin), np.zeros(spin.shape)])
    precession = 2.0 * np.pi * time_s / model.precession_period_s + np.deg2rad(model.precession_phase_deg)
    orbit = 2.0 * np.pi * time_s / model.orbit_period_s + np.deg2rad(model.orbit_phase_deg)
    for plane, angle in (
        ((2, 0), np.deg2rad(model.precession_angle_deg)), ((0, 1), precession), ((2, 0), 0.5 * np.pi), ((0, 1), orbit)
    ):  # fmt: skip
        for one in (beam, along):
            a, b = one[plane[0]].copy(), one[plane[1]].copy()
            one[plane[0]], one[plane[1]] = np.cos(angle) * a - np.sin(angle) * b, np.sin(angle) * a + np.cos(angle) * b
    beam, along = (rotation_matrix("ecliptic", frame) @ one for one in (beam, along))
    return beam, along


def orientation(pointing: Pointing, time_s: Vector, frame: str) -> Vector:
    """Return psi of the beam at some times, radians."""
    beam, along = line_of_sight(pointing, time_s, frame)
    _, south, east = axes(np.arctan2(np.hypot(beam[0], beam[1]), beam[2]), np.arctan2(beam[1], beam[0]))
    return np.arctan2(np.sum(along * east, axis=0), np.sum(along * south, axis=0))


ECCENTRICITY, PERIHELION_DEG = 0.0167, 102.9
"""Of the Earth's orbit in this century, the ecliptic longitude as seen from the Sun."""


def heading(model: ScanModel, time_s: Vector, frame: str, phase: float = 0.0) -> NDArray[np.float64]:
    """Return the Earth's velocity over its mean, turned by ``phase`` radians towards the Sun, shape (3, n).

    Notes
    -----
    The anti-Sun direction of the scan, which moves uniformly, is the Earth's mean longitude. On an ellipse the velocity
    is one of constant size across the true longitude (the equation of the centre further on, to second order in the
    eccentricity e), plus e times that across the perihelion (Murray & Dermott, Solar System Dynamics, 2.4): 2 % faster
    and 2 degrees ahead at most. Those of the ephemeris of SOFA in 2026 are met to 1.5e-3 of the speed.
    """
    mean = 2.0 * np.pi * time_s / model.orbit_period_s + np.deg2rad(model.orbit_phase_deg)
    e, perihelion = ECCENTRICITY, np.deg2rad(PERIHELION_DEG)
    anomaly = mean - perihelion
    true = mean + 2.0 * e * np.sin(anomaly) + 1.25 * e**2 * np.sin(2.0 * anomaly) + phase
    steady = perihelion + phase
    ecliptic = np.stack([-np.sin(true) - e * np.sin(steady), np.cos(true) + e * np.cos(steady), np.zeros_like(true)])
    return np.asarray(rotation_matrix("ecliptic", frame) @ ecliptic)


def axes(theta: Vector, phi: Vector) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return unit vectors outward, south (e_theta) and east (e_phi) at directions, shape (3, n) each."""
    sin_t, cos_t, sin_p, cos_p = np.sin(theta), np.cos(theta), np.sin(phi), np.cos(phi)
    outward = np.stack([sin_t * cos_p, sin_t * sin_p, cos_t])
    return outward, np.stack([cos_t * cos_p, cos_t * sin_p, -sin_t]), np.stack([-sin_p, cos_p, np.zeros_like(phi)])


def scan_direction(angle_deg: float, period_deg: float = 360.0) -> str:
    """Return a direction in the frame of the beam, x along the scan, in words; y is at +90°."""
    angle = (angle_deg + period_deg / 2.0) % period_deg - period_deg / 2.0
    side = f" ({'+' if angle > 0.0 else '−'}90°)" if period_deg > 180.0 else ""
    for at, words in ((0.0, "along the scan"), (90.0, f"across the scan{side}"), (180.0, "against the scan")):
        if abs(abs(angle) - at) < _NAMED_WITHIN_DEG:
            return words
    return f"at {angle:.0f}° to the scan".replace("-", "−")
