"""Effects on beams and pointing against closed forms, rotations of all orders, and quadrature of their definitions."""

from dataclasses import replace

import ducc0
import numpy as np
import pytest
from scipy.special import sph_harm_y

from mcsim import systematics
from mcsim.instrument.beams import Beam
from mcsim.instrument.beams.gaussian import SIGMA_PER_FWHM
from mcsim.instrument.scan import ScanModel
from mcsim.instrument.scan.pointing import pointing
from mcsim.simulation import tod
from mcsim.sphere import alm as alm_
from mcsim.sphere.sky import gaussian_alm
from mcsim.sphere.spectra import load
from mcsim.systematics.shape import displaced, extended, shape, smeared, stretched
from refusals import refused

FWHM = 88.0


def site_of(beam: Beam) -> systematics.Site:
    model = ScanModel.load("wmap")
    pointing = systematics.Pointing(model, model.line_of_sight("A"))
    return systematics.Site(
        channel="W1", frequency_ghz=94.0, frame="ecliptic", nside=8, lmax=beam.lmax, beam=beam, pointing=pointing
    )


def same(found: Beam, expected: Beam, tolerance: float) -> None:
    """Coefficients within ``tolerance`` of the largest; an order that one of them lacks counts as zero."""
    orders = max(found.mmax, expected.mmax) + 1
    padded = [np.pad(beam.blm, ((0, orders - len(beam.blm)), (0, 0))) for beam in (found, expected)]
    np.testing.assert_allclose(*padded, rtol=0.0, atol=tolerance * np.abs(expected.blm).max())


# At lmax 192 the window is still 0.1: what lies beyond must not matter. At 512 it is all there.
@pytest.mark.parametrize("lmax", [48, 192, 512])
def test_a_round_gaussian_stretches_to_closed_forms(lmax):
    beam = Beam.gaussian(FWHM, lmax)
    ellipse = systematics.get("beam_ellipticity")(amplitude=0.1, angle_deg=20.0).beam(beam, site_of(beam))
    same(ellipse, Beam.elliptical(FWHM * 1.1**0.5, FWHM / 1.1**0.5, angle_deg=20.0, lmax=lmax, mmax=ellipse.mmax), 1e-9)
    turned = systematics.get("beam_ellipticity")(amplitude=-0.1, angle_deg=20.0).beam(beam, site_of(beam))
    same(turned, Beam.elliptical(FWHM * 1.1**0.5, FWHM / 1.1**0.5, angle_deg=110.0, lmax=lmax, mmax=turned.mmax), 1e-9)
    wide = systematics.get("beam_width")(amplitude=0.02).beam(beam, site_of(beam))
    same(wide, Beam.gaussian(FWHM * 1.02, lmax), 1e-9)


@pytest.mark.parametrize("lmax", [192, 512])
def test_an_elliptical_beam_stretches_further(lmax):
    """What continues an ellipse beyond lmax is no closed form: 3e-7 there, 1e-8 where there is little to continue."""
    beam = Beam.elliptical(FWHM * 1.1**0.5, FWHM / 1.1**0.5, angle_deg=20.0, lmax=lmax, mmax=8)
    found = systematics.get("beam_ellipticity")(amplitude=0.05, angle_deg=20.0).beam(beam, site_of(beam))
    ratio = 1.1 * 1.05
    expected = Beam.elliptical(FWHM * ratio**0.5, FWHM / ratio**0.5, angle_deg=20.0, lmax=lmax, mmax=found.mmax)
    same(found, expected, 1e-6 if lmax == 192 else 3e-8)


def test_a_beam_map_stretches_as_its_values():
    """A lopsided beam, by its values at the points that the stretch sends to each other."""
    lmax = 400
    beam = displaced(Beam.elliptical(150.0, 120.0, lmax=lmax, mmax=8), 0.4, np.deg2rad(0.5))
    found = stretched(beam, 1.1, 0.95, 0.3, 24, 12)
    rng = np.random.default_rng(1)
    x, y = np.deg2rad(rng.uniform(-2.0, 2.0, (2, 40)))
    along, across = np.cos(0.3) * x + np.sin(0.3) * y, np.cos(0.3) * y - np.sin(0.3) * x
    theta, origin = np.hypot(x, y), np.hypot(along / 1.1, across / 0.95)
    scale = np.sqrt(np.sinc(origin / np.pi) / np.sinc(theta / np.pi)) / (1.1 * 0.95)
    expected = scale * beam.values(origin, np.arctan2(across / 0.95, along / 1.1) + 0.3)
    values = found.values(theta, np.arctan2(y, x))
    # 1e-8 of the power is cut off with the highest orders: 1e-4 of its root.
    assert np.abs(values - expected).max() < 1e-4 * beam.values(np.zeros(1), np.zeros(1))[0]


def quadrature(values, lmax: int, order: int, reach: float) -> np.ndarray:
    """int f conj(Y_lm) over the cap of radius ``reach``, for l = order .. lmax, with scipy's harmonics."""
    nodes, weights = np.polynomial.legendre.leggauss(200)
    theta = 0.5 * reach * (nodes + 1.0)
    phi = np.arange(32) * 2.0 * np.pi / 32
    weight = 0.5 * reach * weights * np.sin(theta) * 2.0 * np.pi / 32
    around = (values(theta[:, None], phi[None, :]) * np.exp(-1j * order * phi)).sum(axis=1)
    return np.array([np.sum(weight * around * sph_harm_y(ell, order, theta, 0.0)) for ell in range(order, lmax + 1)])


def test_coma_by_quadrature():
    lmax, angle = 128, np.deg2rad(35.0)
    beam, sigma = Beam.gaussian(FWHM, lmax), np.deg2rad(FWHM / 60.0) * SIGMA_PER_FWHM
    found = systematics.get("beam_coma")(amplitude=0.02, angle_deg=35.0).beam(beam, site_of(beam))
    assert found.mmax == 3

    def leaning(theta, phi):
        u = theta * np.cos(phi - angle) / sigma
        round_beam = np.exp(-0.5 * (theta / sigma) ** 2) * np.sqrt(theta / np.sin(theta)) / (2.0 * np.pi * sigma**2)
        return 0.02 * round_beam * (u**3 - 3.0 * u)

    for order in (1, 3):
        expected = quadrature(leaning, lmax, order, 10.0 * sigma)
        # Sigma from the solid angle is sigma (1 + sigma^2 / 12), 1e-5 too large here, and enters cubed.
        assert np.abs(found.blm[order, order:] - expected).max() < 5e-5 * np.abs(expected).max()
    np.testing.assert_array_equal(found.blm[0], beam.blm[0])


def test_sidelobe_by_quadrature():
    lmax = 128
    beam, sigma = Beam.gaussian(FWHM, lmax), np.deg2rad(FWHM / 60.0) * SIGMA_PER_FWHM
    kind = systematics.get("beam_sidelobe")
    found = kind(amplitude=0.01, quadrupole=0.5, radius_sigmas=4.0, width_sigmas=0.8).beam(beam, site_of(beam))
    assert shape(beam, 0).sigma == pytest.approx(sigma, rel=1e-4)

    def ring(theta, phi):
        ring = np.exp(-0.5 * ((theta / sigma - 4.0) / 0.8) ** 2) * (1.0 + 0.5 * np.cos(2.0 * phi))
        return -0.01 * ring / (2.0 * np.pi * sigma**2)

    for order in (0, 2):
        expected = quadrature(ring, lmax, order, 12.0 * sigma)
        change = found.blm[order, order:] - (beam.blm[0] if order == 0 else 0.0)
        # Sigma from the solid angle is sigma (1 + sigma^2 / 12).
        assert np.abs(change - expected).max() < 2e-4 * np.abs(expected).max()
    assert found.window[0] < 1.0
    calibrated = kind(amplitude=0.01, calibrated="dipole").beam(beam, site_of(beam))
    assert calibrated.window[1] == pytest.approx(beam.window[1], rel=1e-14)
    with refused("calibrated", "monopole", "none", "dipole"):
        kind(amplitude=0.01, calibrated="monopole").beam(beam, site_of(beam))


def every_order(beam: Beam) -> np.ndarray:
    full = np.zeros(alm_.size(beam.lmax), dtype=complex)
    full[: beam.packed().size] = beam.packed()
    return full


def orders(full: np.ndarray, lmax: int, mmax: int) -> np.ndarray:
    blm = np.zeros((mmax + 1, lmax + 1), dtype=complex)
    for m in range(mmax + 1):
        start = alm_.start(lmax, m)
        blm[m, m:] = full[start + m : start + lmax + 1]
    return blm


def test_displaced_beam_is_a_rotated_one():
    lmax = 192
    distance, angle = np.deg2rad(0.5), np.deg2rad(-130.0)
    round_beam = Beam.gaussian(FWHM, lmax)
    found = displaced(round_beam, angle, distance)
    ell = np.arange(1, lmax + 1)
    expected = np.sqrt(4 * np.pi / (2 * ell + 1)) * round_beam.blm[0, 1:] * sph_harm_y(ell, 1, distance, angle).conj()
    np.testing.assert_allclose(found.blm[1, 1:], expected, rtol=0.0, atol=1e-13)
    ellipse = Beam.elliptical(100.0, 80.0, angle_deg=20.0, lmax=lmax, mmax=4)
    found = displaced(ellipse, angle, distance)
    rotated = ducc0.sht.rotate_alm(every_order(ellipse), lmax, -angle, distance, angle)
    np.testing.assert_allclose(found.blm, orders(rotated, lmax, found.mmax), rtol=0.0, atol=1e-12)
    assert found.neglected_power <= 1e-8 + ellipse.neglected_power


def test_a_beam_is_displaced_far_at_once():
    """By a quarter of a circle at many degrees, where turning it little by little would take hours."""
    lmax, distance, angle = 512, np.deg2rad(90.0), np.deg2rad(-130.0)
    beam = Beam.gaussian(60.0, lmax)
    found = displaced(beam, angle, distance)
    ell, m = np.arange(lmax + 1)[None, :], np.arange(found.mmax + 1)[:, None]
    harmonics = np.where(m <= ell, sph_harm_y(ell, m, distance, angle), 0.0)
    expected = np.sqrt(4 * np.pi / (2 * ell + 1)) * beam.blm[0] * harmonics.conj()
    np.testing.assert_allclose(found.blm, expected, rtol=0.0, atol=1e-12)
    assert found.neglected_power <= 1e-8


def test_smeared_beam_is_filtered_in_the_spin_frame():
    """e_phi is the direction of motion, beam x: from the pole to the circle by R_y(boresight) R_z(90 deg)."""
    lmax, boresight, lag = 192, np.deg2rad(70.5), 0.004
    beam = Beam.elliptical(100.0, 80.0, angle_deg=20.0, lmax=lmax, mmax=4)
    for signed in (lag, -lag):
        found = smeared(beam, boresight, signed)
        spin = ducc0.sht.rotate_alm(every_order(beam), lmax, np.pi / 2, boresight, 0.0)
        m = np.concatenate([np.full(lmax + 1 - order, order) for order in range(lmax + 1)])
        back = ducc0.sht.rotate_alm(spin / (1.0 - 1j * m * signed), lmax, 0.0, -boresight, -np.pi / 2)
        np.testing.assert_allclose(found.blm, orders(back, lmax, found.mmax), rtol=0.0, atol=1e-12)
        # The centroid, at -sqrt(8 pi / 3) b_11, trails: it lies behind by the lag's arc.
        offset = -np.sqrt(8.0 * np.pi / 3.0) * (found.blm[1, 1] - beam.blm[1, 1])
        assert offset.real == pytest.approx(-signed * np.sin(boresight), rel=1e-3)


def test_time_constant_is_the_mean_of_the_past():
    """Quadrature over earlier positions of the beam on its circle, node by node, against the filter."""
    lmax = 96
    beam = Beam.elliptical(200.0, 150.0, angle_deg=20.0, lmax=lmax, mmax=4)
    effect = systematics.get("time_constant")(amplitude=0.1)
    site = site_of(beam)
    found = effect.pointing(beam, site)
    # The rate of WMAP's spin, 129.3 s, and the part along it of a precession of -3600 s at 22.5 degrees.
    rate = 2.0 * np.pi * (1.0 / 129.3 - np.cos(np.deg2rad(22.5)) / 3600.0)
    spin = ducc0.sht.rotate_alm(every_order(beam), lmax, np.pi / 2, np.deg2rad(70.5), 0.0)
    m = np.concatenate([np.full(lmax + 1 - order, order) for order in range(lmax + 1)])
    lags = effect.lags()
    assert sum(weight for weight, _ in lags) == pytest.approx(1.0)
    assert sum(weight * delay for weight, delay in lags) == pytest.approx(0.1)
    past = sum(weight * np.exp(1j * m * rate * delay) * spin for weight, delay in lags)
    back = ducc0.sht.rotate_alm(past, lmax, 0.0, -np.deg2rad(70.5), -np.pi / 2)
    same(found, Beam(orders(back, lmax, found.mmax)), 1e-9)


def test_moved_samples_see_what_a_displaced_beam_sees():
    """Both hooks of the offset, by interpolated convolution at 200 directions and orientations."""
    lmax, rng = 96, np.random.default_rng(3)
    beam = Beam.elliptical(200.0, 150.0, angle_deg=20.0, lmax=lmax, mmax=6)
    sky = gaussian_alm(load("wmap7", lmax), rng)
    theta, phi, psi = np.arccos(rng.uniform(-1, 1, 200)), rng.uniform(0, 2 * np.pi, 200), rng.uniform(-3, 3, 200)
    effect = systematics.get("pointing_offset")(amplitude=40.0, angle_deg=65.0)

    def seen(beam, theta, phi, psi):
        nothing = np.zeros(200)
        chunk = tod.Samples(nothing, theta, phi, psi, nothing.astype(int), nothing)
        return next(tod.sky_signal(sky, lmax, beam)([chunk])).signal_uk

    moved = effect.moved(theta, phi, psi)
    expected = seen(beam, *moved)
    # All orders are kept here: what is cut off by default is 1e-8 of the power.
    whole = displaced(replace(beam, blm=np.pad(beam.blm, ((0, 12), (0, 0)))), np.deg2rad(65.0), np.deg2rad(40.0 / 60))
    found = seen(whole, theta, phi, psi)
    assert np.abs(found - expected).max() < 1e-6 * np.std(expected)
    cut = seen(effect.pointing(beam, site_of(beam)), theta, phi, psi)
    assert np.abs(cut - expected).max() < 1e-3 * np.std(expected)
    # The true direction lies where the offset is, as seen from the believed one.
    along = np.cos(psi) * (moved[0] - theta) + np.sin(psi) * np.sin(theta) * (moved[1] - phi)
    near_equator = (np.abs(theta - np.pi / 2) < 0.6) & (np.abs(moved[1] - phi) < 0.1)
    expected_along = np.deg2rad(40.0 / 60) * np.cos(np.deg2rad(65.0))
    np.testing.assert_allclose(along[near_equator], expected_along, atol=2e-4)


def test_orders_that_were_left_out_come_back():
    """Beside what other effects have made of the orders that were kept, and of orders that were not there."""
    whole = Beam.elliptical(FWHM * 1.1**0.5, FWHM / 1.1**0.5, angle_deg=20.0, lmax=64, mmax=6)
    believed = whole.truncated(2)
    site = replace(site_of(believed), whole=lambda: whole)
    kind = systematics.get("beam_noncircularity")
    same(kind(amplitude=1.0).beam(believed, site), whole, 1e-15)
    shifted = displaced(believed, 0.4, np.deg2rad(0.1))
    found = kind(amplitude=0.3).beam(shifted, site)
    expected = np.zeros((max(len(shifted.blm), 7), 65), dtype=complex)
    expected[: len(shifted.blm)] = shifted.blm
    expected[3:7] += 0.3 * whole.blm[3:]
    np.testing.assert_array_equal(found.blm, expected)
    assert found.neglected_power == whole.neglected_power
    for kept in (site_of(believed), replace(site_of(whole), whole=lambda: whole)):
        with refused("beam_noncircularity", "W1", "m_max"):
            kind(amplitude=1.0).beam(kept.beam, kept)


@pytest.mark.parametrize(
    "name", ["beam_ellipticity", "beam_coma", "beam_sidelobe", "beam_width", "pointing_offset", "time_constant"]
)
def test_responses_are_linear_at_the_step(name):
    """Half the step changes the beam half as much, to 2 %, in every component."""
    beam = Beam.gaussian(44.0, 384)
    site = site_of(beam)

    def change(effect):
        changed = systematics.seen_through([effect], site).blm[:4]
        return np.pad(changed, ((0, 4 - len(changed)), (0, 0))) - np.pad(beam.blm, ((0, 3), (0, 0)))

    for effect in systematics.basis_of(systematics.get(name)):
        whole, half, opposite = (change(effect.scaled(factor)) for factor in (1.0, 0.5, -1.0))
        assert np.linalg.norm(whole - 2.0 * half) < 0.02 * np.linalg.norm(whole)
        assert np.linalg.norm(whole + opposite) < 0.04 * np.linalg.norm(whole)


def test_a_narrow_beam_is_continued_to_its_end():
    """In the plane u^3 - 3u of a Gaussian has 3/8 and 1/8 of k (l sigma)^3 at the orders 1 and 3."""
    lmax, k, fwhm = 1024, 0.02, 1.4
    beam = Beam.gaussian(fwhm, lmax)
    ell = np.array([256, 1024])
    cube = k * (ell * np.deg2rad(fwhm / 60.0) / np.sqrt(8.0 * np.log(2.0))) ** 3
    coma = systematics.get("beam_coma")(amplitude=k).beam(beam, site_of(beam)).blm[:, ell]
    np.testing.assert_allclose(np.abs(coma[[1, 3]] / coma[0]), [3.0 / 8.0 * cube, cube / 8.0], rtol=0.02)
    wide = systematics.get("beam_width")(amplitude=0.1).beam(beam, site_of(beam))
    np.testing.assert_allclose(wide.window, Beam.gaussian(1.1 * fwhm, lmax).window, rtol=0.0, atol=1e-10)
    narrower = Beam.gaussian(0.5, lmax)
    with refused(str(lmax), "sky.lmax"):
        systematics.get("beam_coma")(amplitude=k).beam(narrower, site_of(narrower))


def test_beams_without_a_falling_window_are_left_alone():
    beam = Beam.gaussian(FWHM, 192)
    blm = beam.blm.copy()
    blm[0, 150:] *= -1.0
    lopsided = replace(beam, blm=blm)
    assert extended(lopsided) is lopsided
    rising = beam.blm.copy()
    rising[0] *= np.exp(1e-4 * np.arange(193.0) ** 2)
    assert extended(replace(beam, blm=rising)).lmax == 192


def test_a_beam_of_few_degrees_is_continued_where_its_orders_exist():
    beam = Beam.elliptical(1200.0, 900.0, lmax=7, mmax=2)
    known = Beam.elliptical(1200.0, 900.0, lmax=16, mmax=2).blm
    found = extended(beam).blm
    assert np.all(np.isfinite(found))
    np.testing.assert_allclose(found[:, :9], known[:, :9], atol=0.02 * abs(known[:, 8]).max())


def test_what_is_no_beam_is_refused():
    beam = Beam.gaussian(FWHM, 48)
    site = site_of(beam)
    for name, amplitude in (("beam_ellipticity", 2.5), ("beam_width", -0.95)):
        with refused(name, "amplitude", amplitude):
            systematics.get(name)(amplitude=amplitude).beam(beam, site)
    with refused("width_sigmas", 0.1):
        systematics.get("beam_sidelobe")(amplitude=0.1, width_sigmas=0.1).beam(beam, site)
    with refused("time_constant", "W1", "scan.model"):
        systematics.get("time_constant")(amplitude=0.1).pointing(beam, replace(site, pointing=None))


@pytest.mark.parametrize("name", ["beam_coma", "beam_sidelobe"])
def test_a_beam_that_is_not_positive_at_its_centre_has_no_width(name):
    """A ring about a dip: the coefficients of the effect were not finite, and the beam had to be repaired."""
    ell = np.arange(33)
    window = np.exp(-0.5 * ell * (ell + 1.0) * 0.06**2) * (1.0 - 0.006 * ell * (ell + 1.0))
    beam = Beam((np.sqrt((2 * ell + 1) / (4.0 * np.pi)) * window).astype(complex)[None])
    with refused("-47.9", "0"):
        systematics.get(name)(amplitude=0.05).beam(beam, site_of(beam))


@pytest.mark.parametrize(("angle_deg", "said", "nearer_deg"), [(90.0, "+90°", 1.0), (-90.0, "−90°", -1.0)])
def test_what_lies_across_the_scan_is_said_with_its_side(angle_deg, said, nearer_deg):
    """+90° is towards the spin axis, which starts at longitude 0 of the ecliptic in a scan without precession."""
    model = replace(ScanModel.load("wmap"), precession_angle_deg=0.0)
    line = model.line_of_sight("A")
    effect = systematics.get("pointing_offset")(amplitude=60.0, angle_deg=angle_deg)
    theta, phi, _ = effect.moved(*pointing(model, line, 0, 50))
    distance_deg = np.rad2deg(np.arccos(np.sin(theta) * np.cos(phi)))
    np.testing.assert_allclose(distance_deg, line.boresight_angle_deg - nearer_deg, atol=1e-3)
    assert effect.describe().endswith(f"across the scan ({said})")


def test_a_negative_ellipticity_is_said_as_the_beam_that_it_makes():
    """Stretching across by 1.25 is no axis ratio of 0.75, nor of 1 / 1.25 = 0.8, along."""
    beam = Beam.gaussian(600.0, lmax=40)
    turned, same_beam = (
        systematics.get("beam_ellipticity")(amplitude=a, angle_deg=b) for a, b in ((-0.25, 0), (0.25, 90))
    )
    same(turned.beam(beam, site_of(beam)), same_beam.beam(beam, site_of(beam)), 1e-12)
    assert same_beam.describe() == "axis ratio 1.25 with the major axis across the scan"
    assert turned.describe() == "axis ratio 1.25 (turned by 90°) with the major axis across the scan"


def test_a_detectable_ring_is_the_one_that_the_effect_is_by_default():
    ring = systematics.catalogue()["beam_sidelobe"]
    fit = ring.parametrization
    np.testing.assert_array_equal(fit.typical(ring())[:, 0], fit.coordinates(ring(amplitude=1.0)))
    assert fit.typical(ring()).shape == (len(fit.basis()), 1)
