"""Pointing of a spin-precession-orbit survey: directions, orientations and HEALPix pixels of its samples."""

import math
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mcsim.instrument.scan.model import LineOfSight, ScanModel
from mcsim.sphere.checks import check_whole
from mcsim.sphere.rotation import rotation_matrix
from mcsim.support.compiled import njit

BLOCK = 512
"""Samples whose trigonometry is done together: the work arrays of a block stay in the processor's first caches."""

_TWO_PI = 2.0 * math.pi
_TAN_PI_8 = math.sqrt(2.0) - 1.0


def _arctangent_coefficients() -> NDArray[np.float64]:
    """Return the polynomial in t^2 of (2/pi) arctan(t)/t for 0 <= t <= tan(pi/8), to rounding."""
    chebyshev = np.polynomial.Chebyshev.interpolate(
        lambda v: np.arctan(np.sqrt(v)) / np.sqrt(v) * (2.0 / math.pi), 11, domain=[0.0, _TAN_PI_8**2]
    )
    return np.asarray(chebyshev.convert(kind=np.polynomial.Polynomial).coef, dtype=np.float64)


_ARCTANGENT = _arctangent_coefficients()


class PointingStream:
    """Everything that the compiled kernels need to know about one line of sight of a model.

    Notes
    -----
    The three angles of sample i are (angle at t = 0) + 2 pi i (sample period / period). Turns are reduced in exact
    rational arithmetic at the start of a chunk and advanced block by block; inside a block the sines and cosines
    follow from a table and the addition theorem. The phase error stays below 1e-11 rad over a chunk of 2^22
    samples anywhere in the survey (tests/unit/test_scan_pointing.py).
    """

    def __init__(self, model: ScanModel, line: LineOfSight, frame: str) -> None:
        step = Fraction(model.period_of_samples(line))
        periods = (model.spin_period_s, model.precession_period_s, model.orbit_period_s)
        self._turns = [step / Fraction(period) for period in periods]
        offsets_deg = (model.spin_phase_deg + line.azimuth_deg, model.precession_phase_deg, model.orbit_phase_deg)
        self._offsets = [Fraction(offset) / 360 for offset in offsets_deg]
        angles = _TWO_PI * np.array([_multiples(turn) for turn in self._turns])
        boresight, precession = math.radians(line.boresight_angle_deg), math.radians(model.precession_angle_deg)
        self._constant = (
            np.array([float(BLOCK * turn % 1) for turn in self._turns]),
            np.ascontiguousarray(np.stack([np.cos(angles), np.sin(angles)], axis=1)),
            np.array([math.cos(boresight), math.sin(boresight), math.cos(precession), math.sin(precession)]),
            np.ascontiguousarray(rotation_matrix("ecliptic", frame)),
        )

    def at(self, first: int) -> tuple[NDArray[np.float64], ...]:
        """Return where the samples from ``first`` on start, as :func:`fill_block` takes it.

        These are the turns of spin, precession and orbit at ``first`` and in a block, shape (3,), the table of cosines
        and sines in a block, shape (3, 2, BLOCK), those of boresight and precession angle, shape (4,), and the rotation
        to the frame of the maps, shape (3, 3).
        """
        turns = [float((o + first * t) % 1) for o, t in zip(self._offsets, self._turns, strict=True)]
        return np.array(turns), *self._constant


@lru_cache(maxsize=64)
def _multiples(turn: Fraction) -> list[float]:
    """Return k x turn modulo 1 for the samples k of a block, exact, then rounded once."""
    above, below = turn.numerator, turn.denominator
    return [k * above % below / below for k in range(BLOCK)]


def pointing(
    model: ScanModel, line: LineOfSight, first: int, count: int, frame: str = "ecliptic"
) -> tuple[NDArray[np.float64], ...]:
    """Return theta, phi in [0, 2 pi) and psi in (-pi, pi] of ``count`` samples from ``first`` on, radians."""
    check_whole(first, "first")
    check_whole(count, "count")
    angles = np.empty((3, count))
    fill_samples(PointingStream(model, line, frame).at(first), count, 1, angles, None)
    return tuple(angles)


@njit(nogil=True, error_model="numpy")
def fill_samples(start, count, nside, angles, pixels):  # type: ignore[no-untyped-def]
    """Fill in theta, phi and psi, shape (3, count), and RING pixels, shape (count,), of samples; None: leave it out."""
    work = np.empty((6, BLOCK))
    for first in range(0, count, BLOCK):
        size = min(BLOCK, count - first)
        fill_block(start, first, size, work)
        if pixels is not None:
            fill_pixels(nside, work, pixels[first : first + size])
        if angles is not None:
            for k in range(size):
                x, y = work[0, k], work[1, k]
                angles[0, first + k] = math.atan2(math.sqrt(x * x + y * y), work[2, k])
                angles[1, first + k] = work[5, k] * (0.5 * math.pi)
                angles[2, first + k] = math.atan2(work[4, k], work[3, k])


@njit(nogil=True, error_model="numpy")
def fill_pixels(nside, work, pixels):  # type: ignore[no-untyped-def]
    """Fill in the RING pixels of the first samples of a block that :func:`fill_block` left in ``work``."""
    for k in range(pixels.size):
        pixels[k] = ring_pixel(nside, work[5, k], work[0, k], work[1, k], work[2, k])


@njit(nogil=True, error_model="numpy")
def quarter_turns(x, y):  # type: ignore[no-untyped-def]
    """Return the longitude of (x, y) in quarter turns, in [0, 4): atan2 without branches, for vector instructions."""
    width, height = abs(x), abs(y)
    large, small = max(width, height), min(width, height)
    steep = small > _TAN_PI_8 * large
    # arctan(t) = pi/4 + arctan((t - 1)/(t + 1)) above tan(pi/8).
    ratio = (small - large if steep else small) / max(small + large if steep else large, 1e-300)
    square = ratio * ratio
    turns = _ARCTANGENT[11]
    for power in range(10, -1, -1):
        turns = turns * square + _ARCTANGENT[power]
    turns = turns * ratio + (0.5 if steep else 0.0)
    turns = 1.0 - turns if height > width else turns
    turns = 2.0 - turns if x < 0.0 else turns
    turns = 4.0 - turns if y < 0.0 else turns
    return 0.0 if turns >= 4.0 else turns


@njit(nogil=True, error_model="numpy")
def fill_block(start, first, count, work):  # type: ignore[no-untyped-def]
    """Fill ``work`` with directions and orientations of ``count`` <= BLOCK samples: the one loop that all scans share.

    ``start`` is that of :meth:`PointingStream.at`; ``first`` counts from there and is a multiple of BLOCK. ``work``,
    shape (6, BLOCK), takes n_x, n_y, n_z of the line of sight in the frame of the maps, cos psi and sin psi of the
    beam's x axis, and the longitude in quarter turns. Only elementwise arithmetic, so that the compiler uses vector
    instructions.
    """
    turns, block_turns, tables, geometry, to_frame = start
    block = first // BLOCK
    spin = _TWO_PI * ((turns[0] + block * block_turns[0]) % 1.0)
    precession = _TWO_PI * ((turns[1] + block * block_turns[1]) % 1.0)
    orbit = _TWO_PI * ((turns[2] + block * block_turns[2]) % 1.0)
    cos_a, sin_a = math.cos(spin), math.sin(spin)
    cos_p, sin_p = math.cos(precession), math.sin(precession)
    cos_o, sin_o = math.cos(orbit), math.sin(orbit)
    cos_b, sin_b, cos_t, sin_t = geometry[0], geometry[1], geometry[2], geometry[3]
    f00, f01, f02 = to_frame[0, 0], to_frame[0, 1], to_frame[0, 2]
    f10, f11, f12 = to_frame[1, 0], to_frame[1, 1], to_frame[1, 2]
    f20, f21, f22 = to_frame[2, 0], to_frame[2, 1], to_frame[2, 2]
    for k in range(count):
        ca = cos_a * tables[0, 0, k] - sin_a * tables[0, 1, k]
        sa = sin_a * tables[0, 0, k] + cos_a * tables[0, 1, k]
        cp = cos_p * tables[1, 0, k] - sin_p * tables[1, 1, k]
        sp = sin_p * tables[1, 0, k] + cos_p * tables[1, 1, k]
        co = cos_o * tables[2, 0, k] - sin_o * tables[2, 1, k]
        so = sin_o * tables[2, 0, k] + cos_o * tables[2, 1, k]
        # Line of sight n and beam axis x = (spin axis) x n / sin(boresight) in the spin frame, then tilted.
        nx, ny, nz = sin_b * ca * cos_t + cos_b * sin_t, sin_b * sa, cos_b * cos_t - sin_b * ca * sin_t
        xx, xy, xz = -sa * cos_t, ca, sa * sin_t
        nx, ny = nx * cp - ny * sp, nx * sp + ny * cp
        xx, xy = xx * cp - xy * sp, xx * sp + xy * cp
        # R_y(90 deg) sends (x, y, z) to (z, y, -x); then R_z(orbit).
        nx, ny, nz = nz * co - ny * so, nz * so + ny * co, -nx
        xx, xy, xz = xz * co - xy * so, xz * so + xy * co, -xx
        vx, vy, vz = f00 * nx + f01 * ny + f02 * nz, f10 * nx + f11 * ny + f12 * nz, f20 * nx + f21 * ny + f22 * nz
        ux, uy, uz = f00 * xx + f01 * xy + f02 * xz, f10 * xx + f11 * xy + f12 * xz, f20 * xx + f21 * xy + f22 * xz
        # x . e_theta = -u_z / sin(theta) because x is orthogonal to n; x . e_phi = (n_x u_y - n_y u_x) / sin(theta).
        scale = 1.0 / math.sqrt(vx * vx + vy * vy + 1e-300)
        work[0, k] = vx
        work[1, k] = vy
        work[2, k] = vz
        work[3, k] = -uz * scale
        work[4, k] = (vx * uy - vy * ux) * scale
        work[5, k] = quarter_turns(vx, vy)


@njit(nogil=True, error_model="numpy")
def ring_pixel(nside, turns, x, y, z):  # type: ignore[no-untyped-def]
    """Return the RING pixel of a unit vector at longitude ``turns`` in quarter turns (Gorski et al. 2005, sect. 5)."""
    height = abs(z)
    if height <= 2.0 / 3.0:
        base, slope = nside * (0.5 + turns), nside * z * 0.75
        ascending, descending = int(base - slope), int(base + slope)
        ring = nside + 1 + ascending - descending
        shift = 1 - (ring & 1)
        column = ((ascending + descending - nside + shift + 1) >> 1) & (4 * nside - 1)
        return 2 * nside * (nside - 1) + (ring - 1) * 4 * nside + column
    fraction = turns - int(turns)
    # sin(theta) from x and y: 1 - |z| loses digits near the poles.
    radius = nside * math.sqrt((x * x + y * y) * 3.0 / (1.0 + height))
    ring = min(int(fraction * radius) + int((1.0 - fraction) * radius) + 1, nside)
    column = min(int(turns * ring), 4 * ring - 1)
    if z > 0.0:
        return 2 * ring * (ring - 1) + column
    return 12 * nside * nside - 2 * ring * (ring + 1) + column
