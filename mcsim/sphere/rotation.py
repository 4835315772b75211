"""Rotations of a_lm, maps and BipoSH between ecliptic, galactic and equatorial frames (J2000)."""

from collections.abc import Sequence
from functools import cache, lru_cache

import ducc0
import healpy as hp
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from mcsim.errors import InputError
from mcsim.sphere import healpix
from mcsim.sphere.checks import check_alm, check_map
from mcsim.support.arrays import Alm, Matrix, Vector

FRAMES = {"ecliptic": "E", "galactic": "G", "equatorial": "C"}


def rotation_matrix(frame_from: str, frame_to: str) -> Matrix:
    """Return R, shape (3, 3), with (components in ``frame_to``) = R (components in ``frame_from``).

    Raise InputError for a frame other than ecliptic, galactic or equatorial.
    """
    for frame in (frame_from, frame_to):
        if frame not in FRAMES:
            raise InputError(f"frame {frame!r} is not known; use one of {', '.join(FRAMES)}.")
    if frame_from == frame_to:
        return np.eye(3)
    return _between(frame_from, frame_to).copy()


@cache
def _between(frame_from: str, frame_to: str) -> Matrix:
    return np.array(hp.Rotator(coord=[FRAMES[frame_from], FRAMES[frame_to]]).mat)


def euler_angles(matrix: Matrix) -> tuple[float, float, float]:
    """Return (alpha, beta, gamma) in radians with matrix = R_z(alpha) R_y(beta) R_z(gamma)."""
    beta = float(np.arctan2(np.hypot(matrix[0, 2], matrix[1, 2]), matrix[2, 2]))
    if np.hypot(matrix[0, 2], matrix[1, 2]) < 1e-12:
        # At the pole only the sum or difference of alpha and gamma is defined.
        return float(np.arctan2(-matrix[0, 1], matrix[1, 1])), beta, 0.0
    return float(np.arctan2(matrix[1, 2], matrix[0, 2])), beta, float(np.arctan2(matrix[2, 1], -matrix[2, 0]))


def wigner_D(L: int, matrix: Matrix) -> NDArray[np.complex128]:
    """Return D^L_{MM'} of a rotation, with a'_{LM} = sum_M' D^L_{MM'} a_{LM'}; shape (2L + 1, 2L + 1).

    Notes
    -----
    M and M' run from -L to L. e^{-i M alpha} (e^{-i beta J_y})_{MM'} e^{-i M' gamma} by the matrix exponential, which
    suits the small L of BipoSH.
    """
    alpha, beta, gamma = euler_angles(matrix)
    orders = np.arange(-L, L + 1)
    ladder = np.diag(np.sqrt(L * (L + 1.0) - orders[:-1] * (orders[:-1] + 1.0)), -1)
    small = expm(-0.5 * beta * (ladder - ladder.T))
    return np.exp(-1j * alpha * orders)[:, None] * small * np.exp(-1j * gamma * orders)


@lru_cache(maxsize=64)
def _frame_D(L: int, frame_from: str, frame_to: str) -> NDArray[np.complex128]:
    return wigner_D(L, rotation_matrix(frame_from, frame_to))


def rotate_alm(alm: Alm, lmax: int, frame_from: str, frame_to: str, nthreads: int = 1) -> Alm:
    """Return the a_lm of a real field, shape (size(lmax),), in another frame; InputError for another shape."""
    check_alm(alm, lmax)
    matrix = rotation_matrix(frame_from, frame_to)
    return alm.copy() if frame_from == frame_to else turn_alm(alm, lmax, matrix, nthreads)


def turn_alm(alm: Alm, lmax: int, matrix: Matrix, nthreads: int = 1) -> Alm:
    """Return the a_lm of a real field whose directions are multiplied by a rotation matrix."""
    alpha, beta, gamma = euler_angles(matrix)
    return np.asarray(ducc0.sht.rotate_alm(alm, lmax, gamma, beta, alpha, nthreads=nthreads))


def rotate_pixels(values: NDArray, frame_from: str, frame_to: str) -> NDArray:
    """Return a HEALPix map (RING) in another frame, by the value at each pixel's centre: for masks and hits."""
    nside = check_map(values)
    return values[hp.vec2pix(nside, *(rotation_matrix(frame_to, frame_from) @ healpix.centres(nside)))]


def between_meridians(nside: int, frame: str, other: str) -> Vector:
    """Return the angle from south in a frame to south in another one, towards east, at pixel centres, radians, (npix,).

    An angle psi from the meridian of the frame is less by it from that of the other one.
    """
    n = healpix.centres(nside)
    pole = rotation_matrix(other, frame)[:, 2]
    # South in the other frame is along n (n.pole) - pole; its parts along e_phi and e_theta, both times sin(theta).
    east, south = n[1] * pole[0] - n[0] * pole[1], pole[2] - n[2] * (pole @ n)
    return np.arctan2(east, south)


def rotate_biposh(
    biposh: NDArray[np.complex128], modes: Sequence[tuple[int, int, int]], frame_from: str, frame_to: str
) -> NDArray[np.complex128]:
    """Return A^{LM}_{l1 l2} in another frame, the same modes in the same order.

    ``biposh``: shape (..., n_mode, lmax + 1), of one map or of an ordered pair, at ell = l2 with d = l2 - l1.
    ``modes``: (L, M, d) along the next-to-last axis: every M = 0..L of each (L, d), no M < 0; InputError if one is
    missing.

    Notes
    -----
    A^{LM} rotates like a_{LM}: sum_M' D^L_{MM'} A^{LM'}, with A^{L,-M} = (-1)^{l1+l2-L+M} conj(A^{LM}), which holds for
    pairs of maps too. Equal to rotating the sky first to round-off (tests/unit/test_rotation.py).
    """
    if biposh.ndim < 2 or biposh.shape[-2] != len(modes):
        raise InputError(f"biposh has shape {biposh.shape}, but {len(modes)} modes need (..., {len(modes)}, lmax + 1).")
    rows = {mode: i for i, mode in enumerate(modes)}
    rotated = np.empty_like(biposh)
    for L, d in sorted({(L, d) for L, _, d in modes}):
        missing = [M for M in range(L + 1) if (L, M, d) not in rows]
        if missing:
            raise InputError(
                f"rotation mixes all M of L={L}, d={d}, and M={missing[0]} is missing; give every M from 0 to {L}."
            )
        positive = [biposh[..., rows[L, M, d], :] for M in range(L + 1)]
        negative = [(-1) ** (d + L + M) * positive[M].conj() for M in range(L, 0, -1)]
        turned = np.einsum("mn,n...->m...", _frame_D(L, frame_from, frame_to)[L:], np.stack(negative + positive))
        for M in range(L + 1):
            rotated[..., rows[L, M, d], :] = turned[M]
    return rotated
