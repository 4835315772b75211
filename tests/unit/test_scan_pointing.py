from fractions import Fraction

import healpy
import numpy as np
import pytest
from numba import njit
from scipy.spatial.transform import Rotation

from mcsim.instrument.scan import Moments
from mcsim.instrument.scan.geometry import MapGrid
from mcsim.instrument.scan.model import LineOfSight, ScanModel
from mcsim.instrument.scan.pointing import pointing, quarter_turns, ring_pixel
from mcsim.sphere.checks import check_nside, nside_of
from refusals import refused

LINE = LineOfSight("A", 70.5, 12.0)
MODEL = ScanModel("toy", 129.3, -3600.0, 22.5, 31557600.0, 0.0512, 365.25, (LINE,), ("A",), {}, 33.0, 44.0, 55.0)


def exact_angle(first, count, period, offset_deg):
    """Angle in radians of each sample, its turns reduced in rational arithmetic."""
    turns = [
        (i * Fraction(MODEL.sample_period_s) / Fraction(period) + Fraction(offset_deg) / 360) % 1
        for i in range(first, first + count)
    ]
    return 2.0 * np.pi * np.array([float(turn) for turn in turns])


def axes(theta, phi):
    """e_theta and e_phi, each of shape (n, 3)."""
    zero = np.zeros_like(theta)
    e_theta = np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)], axis=1)
    return e_theta, np.stack([-np.sin(phi), np.cos(phi), zero], axis=1)


def expected_vectors(first, count):
    """Line of sight and spin axis x line of sight from scipy's rotations, in the order of the definition."""
    spin, precession, orbit = (
        exact_angle(first, count, period, offset)
        for period, offset in ((129.3, 33.0 + 12.0), (-3600.0, 44.0), (31557600.0, 55.0))
    )
    boresight = np.radians(70.5)
    inside = np.stack(
        [np.sin(boresight) * np.cos(spin), np.sin(boresight) * np.sin(spin), np.full(count, np.cos(boresight))], axis=1
    )
    turn = (
        Rotation.from_rotvec(np.outer(orbit, [0.0, 0.0, 1.0]))
        * Rotation.from_rotvec([0.0, np.pi / 2.0, 0.0])
        * Rotation.from_rotvec(np.outer(precession, [0.0, 0.0, 1.0]))
        * Rotation.from_rotvec([0.0, np.radians(22.5), 0.0])
    )
    sight, spin_axis = turn.apply(inside), turn.apply([0.0, 0.0, 1.0])
    across = np.cross(spin_axis, sight)
    return sight, across / np.linalg.norm(across, axis=1, keepdims=True)


@pytest.mark.parametrize("first", [0, 616_000_000])
@pytest.mark.parametrize("frame", ["ecliptic", "galactic", "equatorial"])
def test_pointing_against_rotations(first, frame):
    count = 1500  # three blocks, the last one not full
    theta, phi, psi = pointing(MODEL, LINE, first, count, frame)
    sight, across = expected_vectors(first, count)
    if frame != "ecliptic":
        rotator = healpy.Rotator(coord=["E", {"galactic": "G", "equatorial": "C"}[frame]])
        sight, across = rotator(sight.T).T, rotator(across.T).T
    e_theta, e_phi = axes(theta, phi)
    beam_x = e_theta * np.cos(psi)[:, np.newaxis] + e_phi * np.sin(psi)[:, np.newaxis]
    # Rounding of the block's phases, at most 3 steps of 1e-16 turns, and of some ten products.
    assert np.abs(healpy.ang2vec(theta, phi) - sight).max() < 1e-14
    assert np.abs(beam_x - across).max() < 1e-13
    assert phi.min() >= 0.0
    assert phi.max() < 2.0 * np.pi


def test_phase_error_over_a_chunk_is_below_a_hundred_picoradians():
    # The streaming kernels start anew every 2^21 samples: compare the end of a longer run with a fresh start.
    count = (1 << 22) + 5
    late = pointing(MODEL, LINE, 0, count)
    fresh = pointing(MODEL, LINE, count - 5, 5)
    for run, start in zip(late, fresh, strict=True):
        assert np.abs(run[-5:] - start).max() < 1e-11


def test_a_survey_that_is_ahead_sees_what_the_other_sees_later():
    ahead = pointing(MODEL.ahead(1000 * MODEL.sample_period_s), LINE, 0, 50)
    np.testing.assert_allclose(
        healpy.ang2vec(*ahead[:2]), healpy.ang2vec(*pointing(MODEL, LINE, 1000, 50)[:2]), atol=1e-9
    )
    assert MODEL.ahead(0.0) == MODEL


def test_in_scan_direction_is_that_of_the_spin_alone():
    # Without precession and with a slow orbit successive pointings differ along the beam's x axis.
    line = LineOfSight("A", 60.0)
    model = ScanModel("spin", 100.0, 1.0e30, 0.0, 1.0e30, 1e-3, 1.0, (line,), ("A",))
    theta, phi, psi = pointing(model, line, 12345, 2)
    step = np.diff(healpy.ang2vec(theta, phi), axis=0)[0]
    e_theta, e_phi = axes(theta, phi)
    # The chord leaves the tangent at half its angle, 3e-5 rad.
    assert np.arctan2(step @ e_phi[0], step @ e_theta[0]) == pytest.approx(psi[0], abs=1e-4)


@njit
def pixels_of(nside, vectors):
    out = np.empty(len(vectors), dtype=np.int64)
    for i in range(len(vectors)):
        x, y, z = vectors[i]
        out[i] = ring_pixel(nside, quarter_turns(x, y), x, y, z)
    return out


@pytest.mark.parametrize("nside", [1, 2, 32, 1024, 8192])
def test_ring_pixels_are_healpy_s(nside):
    rng = np.random.default_rng(nside)
    vectors = rng.standard_normal((40_000, 3))
    vectors[:4000, :2] *= 1e-5  # near the poles
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    np.testing.assert_array_equal(pixels_of(nside, vectors), healpy.vec2pix(nside, *vectors.T))
    centres = rng.integers(0, 12 * nside * nside, 20_000)
    np.testing.assert_array_equal(pixels_of(nside, np.array(healpy.pix2vec(nside, centres)).T), centres)


@pytest.mark.parametrize(
    "vector", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (1.0, -1e-20, 0.0), (0.0, -1.0, 0.0)]
)
def test_ring_pixels_on_axes(vector):
    assert pixels_of(64, np.array([vector]))[0] == healpy.vec2pix(64, *vector)


def test_longitude_is_arctangent_to_rounding():
    rng = np.random.default_rng(3)
    x, y = rng.standard_normal((2, 50_000)) * 10.0 ** rng.integers(-6, 1, (2, 50_000))
    turns = np.array([quarter_turns(a, b) for a, b in zip(x, y, strict=True)])
    expected = np.arctan2(y, x) % (2.0 * np.pi) * (2.0 / np.pi)
    assert np.abs(turns - expected).max() < 1e-15


def test_frames_and_resolutions_are_checked():
    with refused("frame", "lunar"):
        MapGrid(16, "lunar")
    for nside in (0, 3, -4, 16384):
        with refused("nside", nside):
            check_nside(nside)
    assert nside_of(12 * 64**2, "map") == 64
    for npix in (0, 13, 12 * 9):
        with refused("map", npix):
            nside_of(npix, "map")


def test_user_pointing_may_tell_of_latitudes_beside_the_names_of_its_columns(tmp_path):
    np.savetxt(tmp_path / "p.txt", np.full((3, 3), 0.1), header="made at elevation 40, any azimuth\ntheta phi psi")
    assert Moments.from_pointing_files(tmp_path / "p.txt", 8, 1).hits.sum() == 3.0
