"""Effects that follow spin, orbit, dipole and far lobes: against geometry and convolutions of other makings."""

from dataclasses import replace

import ducc0
import erfa
import healpy
import numpy as np
import pytest
from scipy.special import sph_harm_y

from mcsim import systematics
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import LineOfSight, MapGrid, ScanModel
from mcsim.instrument.scan.pointing import pointing
from mcsim.simulation import tod
from mcsim.simulation.pixel_means import Part, mean_signal
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.sky import dipole_alm, gaussian_alm
from mcsim.sphere.spectra import load
from mcsim.systematics.shape import displaced
from mcsim.systematics.spacecraft import heading, spin_phase
from refusals import refused

LMAX, NSIDE = 32, 16
COUNT = 400
DIPOLE_UK = np.array([-3200.0, 900.0, 500.0])


@pytest.fixture(scope="module")
def site() -> systematics.Site:
    """A year of WMAP's scan with phases of its own, in the Galactic frame."""
    model = replace(ScanModel.load("wmap").with_sampling(611.0), spin_phase_deg=20.0, orbit_phase_deg=70.0)
    return systematics.Site(
        channel="W1",
        frequency_ghz=94.0,
        frame="galactic",
        nside=NSIDE,
        lmax=LMAX,
        beam=Beam.gaussian(400.0, LMAX),
        pointing=systematics.Pointing(model, replace(model.line_of_sight("A"), azimuth_deg=15.0)),
        dipole_uk=DIPOLE_UK,
    )


def samples(site, frame="galactic", boresight_deg=None):
    """Return times and pointing of samples, of a line of sight at another angle from the spin axis on request."""
    model, line = site.pointing.model, site.pointing.line
    if boresight_deg is not None:
        line = LineOfSight("other", boresight_deg, line.azimuth_deg)
    first = 3000
    return model.period_of_samples(line) * np.arange(first, first + COUNT), *pointing(model, line, first, COUNT, frame)


def draw(stage: str) -> np.random.Generator:
    return np.random.default_rng([7, *stage.encode()])


def at(alm, theta, phi, lmax):
    """Values of a sky at directions."""
    where = np.stack([theta, phi], axis=1)
    return ducc0.sht.synthesis_general(alm=alm[None], lmax=lmax, spin=0, loc=where, epsilon=1e-12)[0]


def test_spin_phase_is_the_angle_from_the_sun_about_the_axis(site):
    time_s, theta, phi, _ = samples(site, "ecliptic")
    _, *along_axis = samples(site, "ecliptic", 1e-6)
    line, axis = (healpy.ang2vec(t, p) for t, p in ((theta, phi), along_axis[:2]))
    orbit = 2.0 * np.pi * time_s / site.pointing.model.orbit_period_s + np.deg2rad(70.0)
    sun = -np.stack([np.cos(orbit), np.sin(orbit), np.zeros(COUNT)], axis=1)
    # In the plane across the axis: how far the line of sight has turned from the Sun, in the sense of the spin.
    turned = np.arctan2(np.sum(np.cross(sun, line) * axis, axis=1), np.sum(sun * line, axis=1) - proj(sun, line, axis))
    expected = np.exp(1j * turned)
    np.testing.assert_allclose(np.exp(1j * spin_phase(site.pointing, time_s)), expected, atol=1e-6)
    wave = systematics.get("gain_spin")(amplitude=0.01, phase_deg=30.0).gain(time_s, site)
    np.testing.assert_allclose(wave, 0.01 * np.real(expected * np.exp(-1j * np.pi / 6)), atol=1e-8)
    added = systematics.get("spin_synchronous_offset")(amplitude=2.0, phase_deg=30.0)
    np.testing.assert_allclose(added.signal(time_s, theta, phi, phi, site), 200.0 * wave)


def proj(a, b, axis):
    return np.sum(a * axis, axis=1) * np.sum(b * axis, axis=1)


def test_heading_is_that_of_the_earth(site):
    """By the ephemeris of SOFA through a year: the Moon and the planets move the Earth by less than 1e-3."""
    days = np.linspace(0.0, 365.25, 50)
    earth = erfa.epv00(2461041.5, days)[0]  # 2026, about the Sun
    obliquity = np.deg2rad(23.4393)
    to_ecliptic = np.array(
        [
            [1.0, 0.0, 0.0],
            [0.0, np.cos(obliquity), np.sin(obliquity)],
            [0.0, -np.sin(obliquity), np.cos(obliquity)],
        ]
    )
    away, velocity = to_ecliptic @ earth["p"].T, to_ecliptic @ earth["v"].T
    # Mean longitude of date (Simon et al. 1994), less the precession that axes of 2000 do not have.
    start = 100.46646 + 0.98560910 * (2461041.5 - 2451545.0)
    model = replace(site.pointing.model, orbit_phase_deg=start, orbit_period_s=365.2564 * 86400.0)
    found = heading(model, days * 86400.0, "ecliptic")
    speed_uk = velocity * 149597870.7 / 86400.0 / 299792.458 * 2.7255e6
    np.testing.assert_allclose(270.7 * found, speed_uk, atol=1.5e-3 * 270.7)
    towards_sun = heading(model, days * 86400.0, "ecliptic", np.pi / 2)
    assert np.sum(towards_sun * -away / np.linalg.norm(away, axis=0), axis=0).min() > 0.98
    effect, aside = (
        systematics.get("orbital_dipole")(amplitude=1.0),
        heading(site.pointing.model, np.zeros(1), "galactic"),
    )
    theta, phi = healpy.vec2ang(aside[:, 0])
    assert effect.signal(np.zeros(1), theta, phi, phi, site)[0] == pytest.approx(270.7 * np.linalg.norm(aside))


@pytest.mark.parametrize("phase_deg", [90.0, -35.0, 180.0])
def test_a_dipole_beside_the_motion_is_that_along_it_turned_about_the_pole(site, phase_deg):
    """All of it: the uniform motion about the Sun, and what the ellipse adds to it."""
    time_s = np.linspace(0.0, site.pointing.model.orbit_period_s, 20)
    along, turned = (heading(site.pointing.model, time_s, "ecliptic", np.deg2rad(phase)) for phase in (0.0, phase_deg))
    cos, sin = np.cos(np.deg2rad(phase_deg)), np.sin(np.deg2rad(phase_deg))
    expected = np.stack([cos * along[0] - sin * along[1], sin * along[0] + cos * along[1], along[2]])
    np.testing.assert_allclose(turned, expected, atol=1e-12)


def test_a_far_lobe_is_a_beam_with_all_of_its_orders(site, tmp_path):
    """Against a total convolution with a Gaussian turned to the lobe's place, of the dipole and of a given Galaxy."""
    time_s, theta, phi, psi = samples(site)
    lmax, sigma = 24, np.deg2rad(30.0) / np.sqrt(8.0 * np.log(2.0))
    galaxy = alm_.resize(gaussian_alm(np.full(7, 1e5), np.random.default_rng(3)), 6, lmax)
    healpy.write_map(tmp_path / "g.fits", healpix.synthesis(galaxy[None], 32, lmax)[0], coord="G", dtype=np.float64)
    effect = systematics.get("sidelobe_pickup")(
        amplitude=0.01, angle_deg=60.0, towards_deg=70.0, width_deg=30.0, template=str(tmp_path / "g.fits")
    )
    ell = np.arange(lmax + 1)
    blm = np.zeros((lmax + 1, lmax + 1), dtype=complex)
    for m in range(lmax + 1):
        blm[m] = np.conj(sph_harm_y(ell, m, np.deg2rad(60.0), np.deg2rad(70.0)))
    blm *= 0.01 * np.exp(-0.5 * ell * (ell + 1) * sigma**2)
    lobe = Beam(np.where(ell >= ell[:, None], blm, 0.0))
    chunk = tod.Samples(time_s, theta, phi, psi, np.zeros(COUNT, dtype=int), np.zeros(COUNT))
    (seen,) = tod.sky_signal(galaxy + dipole_alm(DIPOLE_UK, lmax), lmax, lobe)([chunk])
    found = effect.signal(time_s, theta, phi, psi, site)
    assert np.std(seen.signal_uk) > 5.0
    # Read from the nearest of the pixels, 0.1 degrees wide, in single precision.
    np.testing.assert_allclose(found, seen.signal_uk, atol=0.01 * np.std(seen.signal_uk))
    assert np.std(found - seen.signal_uk) < 3e-3 * np.std(seen.signal_uk)
    with refused("width_deg", 1.0, 3):
        replace(effect, width_deg=1.0).signal(time_s, theta, phi, psi, site)


def test_a_far_lobe_sees_the_galaxy_that_it_is_given(site, tmp_path):
    rng = np.random.default_rng(4)
    theta, phi = np.arccos(rng.uniform(-1, 1, 2000)), rng.uniform(0, 2 * np.pi, 2000)
    time_s = psi = np.zeros(2000)
    galaxy = 100.0 * healpy.pix2vec(32, np.arange(12 * 32**2))[0] ** 2
    healpy.write_map(tmp_path / "galaxy.fits", galaxy, coord="G", dtype=np.float64)
    straight = {"amplitude": 1.0, "angle_deg": 0.0, "width_deg": 3.0}
    given = systematics.get("sidelobe_pickup")(**straight, template=str(tmp_path / "galaxy.fits"))
    no_dipole = replace(site, dipole_uk=np.zeros(3))
    x = np.sin(theta) * np.cos(phi)
    np.testing.assert_allclose(given.signal(time_s, theta, phi, psi, no_dipole), 100.0 * x**2, atol=0.5)
    model = systematics.get("sidelobe_pickup")(**straight)
    seen = model.signal(time_s, theta, phi, psi, no_dipole)
    plane = np.abs(np.cos(theta)) < 0.03
    assert seen[plane & (x > 0.5)].mean() > 5.0 * seen[np.abs(np.cos(theta)) > 0.5].mean() > 0.0
    # 1 + x: twice the mean towards the centre of the Galaxy, nothing behind us.
    assert seen[plane & (x > 0.9)].mean() > 10.0 * np.abs(seen[plane & (x < -0.9)]).mean()


def test_a_far_lobe_reads_its_map_in_the_unit_of_the_header_and_again_when_it_changes(site, tmp_path):
    file, nowhere = tmp_path / "galaxy.fits", np.ones(1)
    effect = systematics.get("sidelobe_pickup")(amplitude=1.0, width_deg=30.0, template=str(file))
    no_dipole = replace(site, dipole_uk=np.zeros(3), frequency_ghz=None)
    for constant, unit, factor in ((100.0, "uK", 1.0), (300.0, "uK", 1.0), (0.5, "mK_CMB", 1e3), (2e-4, "K_CMB", 1e6)):
        healpy.write_map(file, np.full(192, constant), coord="G", column_units=unit, dtype=np.float64, overwrite=True)
        seen = effect.signal(nowhere, nowhere, nowhere, nowhere, no_dipole)
        np.testing.assert_allclose(seen, factor * constant, rtol=1e-6)
    healpy.write_map(file, np.ones(192), coord="G", column_units="MJy/sr", dtype=np.float64, overwrite=True)
    with refused(str(file), "MJy/sr", "frequency_ghz"):
        effect.signal(nowhere, nowhere, nowhere, nowhere, no_dipole)


def test_what_is_added_to_samples_is_averaged_in_pixels_of_each_half(site):
    effect = systematics.get("orbital_dipole")(amplitude=0.1)
    first, second = (mean_signal((effect,), site, Part(share)) for share in ((0.0, 0.5), (0.5, 1.0)))
    # A dipole that turns through the year has the opposite sign in the other half.
    assert np.corrcoef(first, second)[0, 1] < -0.7
    model, line = site.pointing.model, site.pointing.line
    chunks = list(tod.samples(model, line, MapGrid(NSIDE, "galactic", (0.0, 0.5))))
    time_s, theta, phi, psi, pixel = (
        np.concatenate([getattr(chunk, key) for chunk in chunks]) for key in ("time_s", "theta", "phi", "psi", "pixel")
    )
    chosen = np.bincount(pixel, minlength=first.size).argmax()
    each = effect.signal(time_s, theta, phi, psi, site)[pixel == chosen]
    assert first[chosen] == pytest.approx(each.mean(), rel=1e-10)
    assert mean_signal((replace(effect, amplitude=0.0),), site, Part((0.0, 0.5))) is None
    with refused("orbital_dipole", "W1"):
        systematics.tried((effect,), replace(site, pointing=None))


def test_nonlinearity_is_a_gain_that_follows_the_dipole(site):
    sky = alm_.resize(gaussian_alm(load("wmap7", LMAX - 1), np.random.default_rng(1)), LMAX - 1, LMAX)
    rng = np.random.default_rng(2)
    theta, phi = np.arccos(rng.uniform(-1, 1, 50)), rng.uniform(0, 2 * np.pi, 50)
    kind = systematics.get("nonlinearity")
    found = at(kind(amplitude=0.02).sky(sky, site, draw) - sky, theta, phi, LMAX)
    cosine = healpy.ang2vec(theta, phi) @ DIPOLE_UK / np.linalg.norm(DIPOLE_UK)
    signal = at(sky, theta, phi, LMAX) + np.linalg.norm(DIPOLE_UK) * cosine
    np.testing.assert_allclose(found, 0.02 * cosine * signal, atol=1e-8)
    with refused("nonlinearity", "W1", "sky.dipole_uk"):
        kind(amplitude=0.02).sky(sky, replace(site, dipole_uk=np.zeros(3)), draw)


def test_bandpass_mismatch_has_its_rms_and_its_template(site, tmp_path):
    kind = systematics.get("bandpass_mismatch")
    drawn = kind(amplitude=3.0).sky(np.zeros(alm_.size(LMAX), complex), site, draw)
    assert healpy.alm2cl(drawn) @ (2 * np.arange(LMAX + 1) + 1) / (4 * np.pi) == pytest.approx(9.0)
    galaxy = healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2] ** 2
    healpy.write_map(tmp_path / "g.fits", galaxy, coord="G", dtype=np.float64)
    given = kind(amplitude=3.0, template=str(tmp_path / "g.fits")).sky(0.0 * drawn, site, draw)
    rms = 5.0**-0.5
    np.testing.assert_allclose(at(given, np.array([0.3]), np.zeros(1), LMAX), 3.0 * np.cos(0.3) ** 2 / rms, rtol=1e-3)


@pytest.mark.parametrize("beam", [Beam.gaussian(400.0, LMAX), Beam.elliptical(500.0, 350.0, angle_deg=20.0, lmax=LMAX)])
def test_jitter_is_the_mean_of_displaced_beams(beam, site):
    """Gauss-Hermite over both axes, nine displacements by the effect on pointing."""
    rms = np.deg2rad(1.0)
    found = systematics.get("pointing_jitter")(amplitude=3600.0).beam(beam, site)
    nodes, weights = np.polynomial.hermite_e.hermegauss(5)
    weights = weights / weights.sum()
    mean = np.zeros_like(beam.blm)
    for x, a in zip(nodes, weights, strict=True):
        for y, b in zip(nodes, weights, strict=True):
            moved = displaced(beam, float(np.arctan2(y, x)), rms * float(np.hypot(x, y)))
            mean += a * b * moved.blm[: beam.mmax + 1]
    change = np.abs(found.blm - beam.blm).max()
    # The product of two displacements is one and a small turn: of second order in the variance.
    np.testing.assert_allclose(found.blm, mean, atol=5e-3 * change)
    with refused("pointing_jitter", "sharpens"):
        systematics.get("pointing_jitter")(amplitude=-1e5).beam(beam, site)
