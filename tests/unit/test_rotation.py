"""Rotations between frames against astropy, healpy and a sky that was rotated first."""

from math import sqrt

import healpy as hp
import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from wignernj import wigner3j

from mcsim.sphere import alm as alm_
from mcsim.sphere import rotation
from mcsim.sphere.rotation import (
    between_meridians,
    euler_angles,
    rotate_alm,
    rotate_biposh,
    rotate_pixels,
    rotation_matrix,
    wigner_D,
)
from refusals import refused

PAIRS = [
    ("ecliptic", "galactic"),
    ("galactic", "ecliptic"),
    ("galactic", "equatorial"),
    ("equatorial", "ecliptic"),
    ("ecliptic", "ecliptic"),
]


def random_alm(rng, lmax):
    alm = rng.standard_normal(alm_.size(lmax)) + 1j * rng.standard_normal(alm_.size(lmax))
    alm[: lmax + 1] = alm[: lmax + 1].real
    return alm


def all_orders(alm, lmax, ell):
    positive = np.array([alm[alm_.start(lmax, m) + ell] for m in range(ell + 1)])
    return np.concatenate([((-1.0) ** np.arange(ell + 1) * positive.conj())[:0:-1], positive])


@pytest.mark.parametrize(("frame_from", "frame_to"), PAIRS)
def test_directions_are_astropys(frame_from, frame_to):
    """The galactic centre and two more directions; healpy and astropy differ by the arcsecond of their J2000 poles."""
    names = {"ecliptic": "barycentricmeanecliptic", "galactic": "galactic", "equatorial": "icrs"}
    for longitude, latitude in [(0.0, 0.0), (120.0, 40.0), (250.0, -70.0)]:
        point = SkyCoord(longitude * units.deg, latitude * units.deg, frame=names[frame_from])
        expected = point.transform_to(names[frame_to]).cartesian.xyz.value
        start = point.cartesian.xyz.value
        np.testing.assert_allclose(rotation_matrix(frame_from, frame_to) @ start, expected, atol=2e-5)


@pytest.mark.parametrize(("frame_from", "frame_to"), PAIRS)
def test_alm_are_healpys_and_wigner_ds(frame_from, frame_to):
    lmax = 16
    alm = random_alm(np.random.default_rng(1), lmax)
    got = rotate_alm(alm, lmax, frame_from, frame_to)
    codes = {"ecliptic": "E", "galactic": "G", "equatorial": "C"}
    if frame_from != frame_to:
        expected = hp.Rotator(coord=[codes[frame_from], codes[frame_to]]).rotate_alm(alm)
        np.testing.assert_allclose(got, expected, atol=1e-12)
    for ell in (0, 1, 2, 9):
        turned = wigner_D(ell, rotation_matrix(frame_from, frame_to)) @ all_orders(alm, lmax, ell)
        np.testing.assert_allclose(turned, all_orders(got, lmax, ell), atol=1e-12)


@pytest.mark.parametrize("angles", [(0.3, 1.1, -2.0), (2.0, 0.0, 0.0), (0.5, np.pi, 0.0)])
def test_euler_angles(angles):
    def around_z(angle):
        return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])

    def around_y(angle):
        return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])

    np.testing.assert_allclose(
        euler_angles(around_z(angles[0]) @ around_y(angles[1]) @ around_z(angles[2])), angles, atol=1e-14
    )


def test_pixels_follow_their_directions():
    nside, axis = 64, np.array([0.0, 0.6, 0.8])
    centres = np.array(hp.pix2vec(nside, np.arange(12 * nside**2)))
    mask = axis @ centres > 0.5
    turned = rotation_matrix("galactic", "equatorial") @ axis
    got = rotate_pixels(mask, "galactic", "equatorial")
    # Only pixels that the edge crosses can differ.
    differing = np.abs(turned @ centres - 0.5)[got != (turned @ centres > 0.5)]
    assert got.dtype == bool
    assert differing.max() < hp.max_pixrad(nside)


def biposh_of(first, second, lmax, modes):
    """Explicit sum a_{l1 m1} a*_{l2 m2} (-1)^{m2} C^{LM}_{l1 m1 l2 -m2} at l2."""
    result = np.full((len(modes), lmax + 1), np.nan, dtype=complex)
    for row, (L, M, d) in zip(result, modes, strict=True):
        for l2 in range(lmax + 1):
            l1 = l2 - d
            if not (0 <= l1 <= lmax and abs(d) <= L <= l1 + l2):
                continue
            left, right = all_orders(first, lmax, l1), all_orders(second, lmax, l2)
            row[l2] = sum(
                left[m1 + l1]
                * np.conj(right[m1 - M + l2])
                * (-1) ** (m1 - M + l1 - l2 + M)
                * sqrt(2 * L + 1)
                * wigner3j(l1, l2, L, m1, M - m1, -M)
                for m1 in range(max(-l1, M - l2), min(l1, M + l2) + 1)
            )
    return result


@pytest.mark.parametrize("pair", [False, True])
def test_biposh_of_the_rotated_sky(pair):
    """Both parities, both orders of a pair; round-off."""
    lmax, rng = 6, np.random.default_rng(3)
    first = random_alm(rng, lmax)
    second = random_alm(rng, lmax) if pair else first
    modes = [(L, M, d) for L in (1, 2, 3) for d in range(-L, L + 1) for M in range(L + 1)]
    stored = biposh_of(first, second, lmax, modes)
    turned = (rotate_alm(alm, lmax, "ecliptic", "galactic") for alm in (first, second))
    expected = biposh_of(*turned, lmax, modes)
    np.testing.assert_allclose(rotate_biposh(stored, modes, "ecliptic", "galactic"), expected, atol=1e-12)
    stack = np.stack([stored, 2 * stored])
    np.testing.assert_allclose(
        rotate_biposh(stack, modes, "ecliptic", "galactic"), np.stack([expected, 2 * expected]), atol=1e-11
    )


def test_user_errors():
    with refused("frame", "super"):
        rotation_matrix("super", "galactic")
    with refused("L=2", "d=0", "M=1"):
        rotate_biposh(np.zeros((2, 4), dtype=complex), [(2, 0, 0), (2, 2, 0)], "ecliptic", "galactic")


@pytest.mark.parametrize(("frame", "other"), PAIRS)
def test_meridians_of_two_frames_are_at_the_angle_of_healpy(frame, other):
    turn = between_meridians(8, frame, other)
    if frame == other:
        np.testing.assert_array_equal(turn, 0.0)
        return
    back = hp.Rotator(coord=[rotation.FRAMES[frame], rotation.FRAMES[other]])
    expected = -back.angle_ref(*hp.pix2ang(8, np.arange(768)))
    np.testing.assert_allclose(np.exp(1j * turn), np.exp(1j * expected), atol=1e-12)
