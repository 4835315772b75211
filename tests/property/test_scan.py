import healpy
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numba import njit

from mcsim.instrument.scan import Moments
from mcsim.instrument.scan.limit import caustics, limit_moments
from mcsim.instrument.scan.model import LineOfSight, ScanModel
from mcsim.instrument.scan.pointing import pointing, quarter_turns, ring_pixel

# Scans that miss phases of the spin are drawn, too.
pytestmark = pytest.mark.filterwarnings("ignore:samples of A every")
SETTINGS = settings(derandomize=True, deadline=None, max_examples=60)


@st.composite
def models(draw):
    precession = draw(st.floats(0.0, 90.0))
    line = LineOfSight("A", draw(st.floats(1.0, 179.0)), draw(st.floats(-360.0, 360.0)))
    return ScanModel(
        "any",
        draw(st.floats(10.0, 1e4)),
        draw(st.sampled_from([-1.0, 1.0])) * draw(st.floats(1e3, 1e5)),
        precession,
        31557600.0,
        draw(st.floats(0.01, 10.0)),
        draw(st.floats(0.01, 0.02)),
        (line,),
        ("A",),
    )


@njit
def pixel_of(nside, x, y, z):
    return ring_pixel(nside, quarter_turns(x, y), x, y, z)


@SETTINGS
@given(st.integers(0, 13), st.floats(-1.0, 1.0), st.floats(0.0, 6.2831853))
def test_any_direction_has_healpy_s_pixel(order, z, phi):
    x, y = np.sqrt(1.0 - z * z) * np.cos(phi), np.sqrt(1.0 - z * z) * np.sin(phi)
    ours, theirs = pixel_of(2**order, x, y, z), healpy.vec2pix(2**order, x, y, z)
    if ours != theirs:
        # Only on an edge, where rounding decides: then both hold the same direction up to rounding.
        nudged = healpy.vec2pix(
            2**order,
            *(np.array([x, y, z])[:, np.newaxis] + 1e-15 * np.array(np.mgrid[-1:2, -1:2, -1:2]).reshape(3, -1)),
        )
        assert ours in nudged


@SETTINGS
@given(models(), st.sampled_from(["ecliptic", "galactic", "equatorial"]))
def test_beam_axis_is_spin_axis_times_line_of_sight(model, frame):
    line = model.lines_of_sight[0]
    theta, phi, psi = pointing(model, line, 0, 700, frame)
    assume(np.sin(theta).min() > 1e-3)
    sight = healpy.ang2vec(theta, phi)
    e_theta = np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)], axis=1)
    e_phi = np.stack([-np.sin(phi), np.cos(phi), 0.0 * phi], axis=1)
    beam_x = e_theta * np.cos(psi)[:, np.newaxis] + e_phi * np.sin(psi)[:, np.newaxis]
    beam_y = np.cross(sight, beam_x)
    # Spin axis = cos(boresight) n + sin(boresight) y: a unit vector at the precession angle from the anti-Sun.
    boresight = np.radians(line.boresight_angle_deg)
    axis = np.cos(boresight) * sight + np.sin(boresight) * beam_y
    time = np.arange(700) * model.sample_period_s
    longitude = 2.0 * np.pi * time / model.orbit_period_s
    anti_sun = np.stack([np.cos(longitude), np.sin(longitude), 0.0 * time])
    if frame != "ecliptic":
        anti_sun = healpy.Rotator(coord=["E", {"galactic": "G", "equatorial": "C"}[frame]])(anti_sun)
    cosine = np.sum(axis * anti_sun.T, axis=1)
    # Rounding of psi near the poles, 1e-16 / 1e-3.
    assert np.abs(cosine - np.cos(np.radians(model.precession_angle_deg))).max() < 1e-11


@SETTINGS
@given(models())
def test_limit_is_a_symmetric_mean_of_unit_numbers(model):
    theta = np.linspace(0.013, np.pi - 0.013, 41)
    density, w = limit_moments(model, theta, 4)
    assert np.isfinite(density).all()
    assert (density >= 0.0).all()
    assert (np.abs(w) <= 1.0 + 1e-12).all()
    assert (w[:, density == 0.0] == 0.0).all()
    # North and south: psi -> -psi. On a caustic itself everything hangs on the logarithm of a rounding error.
    singular = np.concatenate([caustics(model), [0.0]])
    away = np.abs(theta[:, np.newaxis] - singular).min(axis=1) > 1e-6
    away &= away[::-1]
    np.testing.assert_allclose(density[away], density[::-1][away], rtol=1e-6)
    assert np.abs(w - np.conj(w)[:, ::-1])[:, away].max(initial=0.0) < 1e-6


@SETTINGS
@given(models(), st.integers(1, 3))
def test_moments_are_bounded_and_count_every_sample(model, smax):
    moments = Moments.from_model(model, 4, smax)
    assert moments.hits.sum() == model.samples(model.lines_of_sight[0])
    assert (np.abs(moments.w) <= 1.0 + 1e-12).all()
    # No point of a pixel of nside 4 is farther than 15 degrees from its centre.
    assert np.hypot(moments.dtheta, moments.dphi).max() <= healpy.max_pixrad(4)
