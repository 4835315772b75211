"""Turned and mirrored beams, against their values on the sphere and against reflected pointing."""

import numpy as np
import pytest

from mcsim.instrument.beams import Beam

LMAX = 40


@pytest.fixture(scope="module")
def beam() -> Beam:
    """A beam with every order, odd and imaginary ones included, that no turn or mirror leaves alone."""
    rng = np.random.default_rng(3)
    blm = Beam.elliptical(700.0, 500.0, angle_deg=20.0, lmax=LMAX, mmax=4).blm.copy()
    blm[1:] += 0.02 * (rng.standard_normal(blm[1:].shape) + 1j * rng.standard_normal(blm[1:].shape))
    blm[np.arange(5)[:, None] > np.arange(LMAX + 1)] = 0.0
    return Beam(blm)


THETA, PHI = (angles.ravel() for angles in np.meshgrid(np.linspace(0.01, 0.4, 7), np.linspace(0.0, 6.0, 11)))


def test_rotated_turns_from_x_towards_y(beam):
    np.testing.assert_allclose(beam.rotated(0.7).values(THETA, PHI + 0.7), beam.values(THETA, PHI), rtol=1e-10)
    ellipse = Beam.elliptical(700.0, 500.0, lmax=LMAX, mmax=4)
    turned = Beam.elliptical(700.0, 500.0, angle_deg=30.0, lmax=LMAX, mmax=4)
    np.testing.assert_allclose(ellipse.rotated(np.deg2rad(30.0)).blm, turned.blm, atol=1e-12)


def test_mirrored_exchanges_x_and_minus_x(beam):
    np.testing.assert_allclose(beam.mirrored().values(THETA, np.pi - PHI), beam.values(THETA, PHI), rtol=1e-10)
    np.testing.assert_allclose(beam.mirrored().mirrored().blm, beam.blm, rtol=1e-15)


def test_mirrored_is_the_other_side_of_a_mirror_through_the_spin_axis(beam):
    """Vectors in the spin frame, spin axis z: what side A sees in a direction, side B sees in the reflected one."""
    boresight, azimuth = np.deg2rad(70.0), np.deg2rad(-0.6)
    mirror = np.diag([-1.0, 1.0, 1.0])

    def angles(direction: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angles of a direction in the frame of a beam at n, whose x axis is (spin axis) x n."""
        x = np.cross([0.0, 0.0, 1.0], n) / np.sin(boresight)
        y = np.cross(n, x)
        return np.array([np.arccos(direction @ n)]), np.array([np.arctan2(direction @ y, direction @ x)])

    side_a = np.array([np.sin(boresight) * np.cos(azimuth), np.sin(boresight) * np.sin(azimuth), np.cos(boresight)])
    direction = side_a + np.array([0.05, 0.2, -0.1])
    direction /= np.linalg.norm(direction)
    seen = beam.values(*angles(direction, side_a))
    np.testing.assert_allclose(beam.mirrored().values(*angles(mirror @ direction, mirror @ side_a)), seen, rtol=1e-10)
    assert abs(beam.values(*angles(mirror @ direction, mirror @ side_a)) / seen - 1.0) > 0.01
