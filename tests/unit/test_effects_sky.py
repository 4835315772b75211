"""Effects on the sky, the noise, the gain and the moments, against their definitions at points and in counts."""

from dataclasses import replace

import ducc0
import healpy
import numpy as np
import pytest

from mcsim import systematics
from mcsim.datavector.candidate import Candidate
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import Moments, ScanModel
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, map_files
from mcsim.sphere.rotation import rotate_alm, rotate_pixels
from mcsim.sphere.sky import dipole_alm, gaussian_alm
from mcsim.sphere.spectra import load
from mcsim.systematics import noise
from mcsim.systematics import sky as effects_on_sky
from refusals import refused

LMAX, NSIDE = 64, 16
TOWARDS = {"lon_deg": 200.0, "lat_deg": 30.0}
AXIS = healpy.ang2vec(200.0, 30.0, lonlat=True)


@pytest.fixture(scope="module")
def site() -> systematics.Site:
    model = ScanModel.load("wmap").with_sampling(600.0)
    return systematics.Site(
        channel="W1",
        frequency_ghz=94.0,
        frame="ecliptic",
        nside=NSIDE,
        lmax=LMAX,
        beam=Beam.gaussian(300.0, LMAX),
        pointing=systematics.Pointing(model, model.line_of_sight("A")),
    )


@pytest.fixture(scope="module")
def sky() -> np.ndarray:
    """Without power in the last two degrees, so that products keep within lmax."""
    return alm_.resize(gaussian_alm(load("wmap7", LMAX - 2), np.random.default_rng(1)), LMAX - 2, LMAX)


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    """(theta, phi) of 50 directions."""
    rng = np.random.default_rng(2)
    return np.stack([np.arccos(rng.uniform(-1, 1, 50)), rng.uniform(0, 2 * np.pi, 50)], axis=1)


def draw(stage: str) -> np.random.Generator:
    return np.random.default_rng([7, *stage.encode()])


def at(alm: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Values of a sky at directions (theta, phi)."""
    return ducc0.sht.synthesis_general(alm=alm[None], lmax=LMAX, spin=0, loc=points, epsilon=1e-12)[0]


def test_modulations_multiply_the_sky(site, sky, points):
    x, y, z = healpy.ang2vec(*points.T).T
    found = systematics.get("dipole_modulation")(amplitude=0.1, **TOWARDS).sky(sky, site, draw)
    along = AXIS @ np.stack([x, y, z])
    np.testing.assert_allclose(at(found, points), at(sky, points) * (1.0 + 0.1 * along), atol=1e-8)
    basis = [(3 * z**2 - 1) / 2, 3**0.5 * x * z, 3**0.5 * y * z, 3**0.5 / 2 * (x**2 - y**2), 3**0.5 * x * y]
    for effect, factor in zip(systematics.basis_of(systematics.get("quadrupole_modulation")), basis, strict=True):
        found = effect.sky(sky, site, draw)
        np.testing.assert_allclose(at(found, points), at(sky, points) * (1.0 + effect.amplitude * factor), atol=1e-8)
    with refused("components", "zero"):
        systematics.get("quadrupole_modulation")(amplitude=0.1, components=(0.0,) * 5).sky(sky, site, draw)


def test_boost_is_what_a_moving_observer_sees(site, sky, points):
    """T(n) / (gamma (1 - beta . n')) at n', where cos = (cos' - beta) / (1 - beta cos'): to all orders."""
    beta, smooth = 0.2, alm_.multiply(sky, (np.arange(LMAX + 1) <= LMAX // 3).astype(float), LMAX)
    found = systematics.get("boost")(amplitude=beta, **TOWARDS).sky(smooth, site, draw)
    seen = healpy.ang2vec(*points.T)
    along = seen @ AXIS
    assert np.ptp(along) > 1.0
    aberrated = (along - beta) / (1.0 - beta * along)
    sideways = seen - along[:, None] * AXIS
    sideways *= np.sqrt(1.0 - aberrated**2)[:, None] / np.linalg.norm(sideways, axis=1, keepdims=True)
    theta, phi = healpy.vec2ang(aberrated[:, None] * AXIS + sideways)
    expected = at(smooth, np.stack([theta, phi], axis=1)) * np.sqrt(1.0 - beta**2) / (1.0 - beta * along)
    np.testing.assert_allclose(at(found, points), expected, atol=1e-6 * np.std(expected))


def test_boost_keeps_the_power_and_is_undone_by_the_opposite_one(site, sky):
    kind, weight = systematics.get("boost"), np.where(alm_.orders(LMAX) == 0, 1.0, 2.0)
    found = kind(amplitude=0.3, **TOWARDS).sky(sky, site, draw)
    assert np.sum(weight * np.abs(found) ** 2) == pytest.approx(np.sum(weight * np.abs(sky) ** 2), rel=1e-12)
    again = kind(amplitude=-0.3, **TOWARDS).sky(found, site, draw)
    np.testing.assert_allclose(again, sky, atol=1e-10 * np.abs(sky).max())
    with refused("boost", "amplitude", 1):
        kind(amplitude=1.0, **TOWARDS).sky(sky, site, draw)


def test_lensing_reads_the_sky_at_the_ends_of_arcs(site, sky, points):
    """A potential a AXIS . n draws every direction towards the axis, by a times the sine of their distance."""
    smooth = alm_.multiply(sky, (np.arange(LMAX + 1) <= LMAX // 3).astype(float), LMAX)
    found = effects_on_sky.remapped(smooth, dipole_alm(0.2 * AXIS, LMAX), LMAX)
    seen = healpy.ang2vec(*points.T)
    distance = np.arccos(seen @ AXIS)
    across = AXIS - np.cos(distance)[:, None] * seen
    towards = across / np.linalg.norm(across, axis=1, keepdims=True)
    reach = (0.2 * np.sin(distance))[:, None]
    theta, phi = healpy.vec2ang(np.cos(reach) * seen + np.sin(reach) * towards)
    expected = at(smooth, np.stack([theta, phi], axis=1))
    assert np.std(expected - at(smooth, points)) > 1.0
    np.testing.assert_allclose(at(found, points), expected, atol=1e-4 * np.std(expected))


def test_lensing_has_the_deflections_of_the_fiducial_power(site, sky):
    ell = np.arange(2001.0)
    power = effects_on_sky.potential(2000)
    assert power[100] == pytest.approx(2.0 * np.pi * 1.0145e-7 / (100.0 * 101.0) ** 2, rel=0.01)
    deflection = np.sqrt(np.sum((2.0 * ell + 1.0) * ell * (ell + 1.0) * power) / (4.0 * np.pi))
    assert 60.0 * np.rad2deg(deflection) == pytest.approx(2.4, abs=0.06)
    kind = systematics.get("lensing")
    weak, strong = (kind(amplitude=amplitude).sky(sky, site, draw) - sky for amplitude in (0.01, 0.04))
    # Of first order in the deflection, whose power is the amplitude: twice as far.
    np.testing.assert_allclose(strong, 2.0 * weak, atol=0.05 * np.abs(strong).max())
    with refused("lensing", -1):
        kind(amplitude=-1.0).sky(sky, site, draw)


def test_dipole_residual_adds_a_vector(site, sky, points):
    found = systematics.get("dipole_residual")(amplitude=5.0, **TOWARDS).sky(sky, site, draw)
    expected = 5.0 * healpy.ang2vec(*points.T) @ AXIS
    np.testing.assert_allclose(at(found - sky, points), expected, atol=1e-9)


def test_spectrum_rescales_its_bands(site, sky):
    """The first one begins at l = 2: monopole and dipole stay."""
    effect, sky = systematics.get("spectrum")(amplitude=0.7, bands=(2.0, 3.0, 6.0, 0.0, 0.0, 0.0)), sky + 1.0
    found, ell = effect.sky(sky, site, draw), alm_.degrees(LMAX)
    edges = [2 + i * (LMAX - 1) // 6 for i in range(7)]
    assert edges[-1] == LMAX + 1
    factor = np.ones(LMAX + 1)
    for band, power in enumerate((1.2, 1.3, 1.6)):
        factor[edges[band] : edges[band + 1]] = np.sqrt(power)
    np.testing.assert_allclose(found, sky * factor[ell], rtol=1e-14)
    with refused("spectrum", -2):
        systematics.get("spectrum")(amplitude=2.0, bands=(-1.0, 0.0, 0.0, 0.0, 0.0, 0.0)).sky(sky, site, draw)


@pytest.mark.parametrize(
    ("bands", "said"),
    [
        ((0.0, -2.0, 0.0, 0.0, 0.0, 0.0), "less, in band 2 of 6"),
        ((0.5, 0.0, 0.0, 0.0, 0.0, 0.0), "more, in band 1 of 6"),
    ],
)
def test_spectrum_says_which_band_alone_changes(bands, said):
    assert systematics.get("spectrum")(amplitude=0.08, bands=bands).describe(0.04) == f"8 % ± 4 % of C_ℓ {said}"


def test_spectrum_of_several_bands_has_the_norm_of_their_changes():
    assert systematics.get("spectrum")(amplitude=0.08).describe(0.04) == "8 % ± 4 % of C_ℓ (norm over bands)"


def test_spectrum_nearest_to_less_than_no_power_leaves_some():
    """Of two correlated bands the other one makes up for what the first cannot be."""
    kind = systematics.get("spectrum")
    fit, precision = kind.parametrization, np.eye(6)
    precision[0, 1] = precision[1, 0] = 0.5
    wanted = np.array([-1.49, 0.3, 0.1, 0.0, 0.0, 0.0])
    found = fit.coordinates(kind(**fit.nearest(wanted, precision)))
    # The first is short by 0.5: the second is moved by - 0.5 * 0.5 / 1.
    np.testing.assert_allclose(found, [-0.99, 0.05, 0.1, 0.0, 0.0, 0.0], atol=1e-8)
    again = fit.coordinates(kind(**fit.nearest(0.5 * wanted, precision)))
    np.testing.assert_allclose(again, 0.5 * wanted, rtol=1e-12)


def test_bands_that_no_data_tell_stay_as_believed():
    fit = systematics.get("spectrum").parametrization
    errors = np.array([0.05, 0.02, 0.01, 0.02, 0.4, 7.0])
    correlation = np.eye(6)
    correlation[3, 4] = correlation[4, 3] = 0.5
    precision = np.linalg.inv(errors[:, None] * correlation * errors)
    fitted = np.array([0.3, -0.01, 0.0, 0.1, 0.6, -12.0])
    # The fourth is what it is given that the fifth has not changed.
    given = [0.3, -0.01, 0.0, 0.1 - 0.5 * 0.02 * 0.6 / 0.4, 0.0, 0.0]
    np.testing.assert_allclose(fit.constrained(fitted, precision), given, atol=1e-9)
    fitted[4] = 1.5
    np.testing.assert_allclose(fit.constrained(fitted, precision), [0.3, -0.01, 0.0, 0.1, 1.5, 0.0], atol=1e-9)
    fitted[4] = -1.5  # less power is as well detected as more
    np.testing.assert_allclose(fit.constrained(fitted, precision), [0.3, -0.01, 0.0, 0.1, -1.5, 0.0], atol=1e-9)
    np.testing.assert_array_equal(
        systematics.get("beam_ellipticity").parametrization.constrained(fitted[:2], precision[:2, :2]), fitted[:2]
    )


def test_point_sources_are_a_flat_sky_of_their_own(site, sky):
    kind = systematics.get("point_sources")
    drawn = kind(amplitude=0.01).sky(sky, site, draw) - sky
    weight = np.where(np.arange(drawn.size) <= LMAX, 1.0, 2.0)
    modes = (LMAX + 1) ** 2
    # The mean square of modes is 0.01 with a relative scatter of sqrt(2 / modes): 4 sigma.
    assert np.sum(weight * np.abs(drawn) ** 2) / modes == pytest.approx(0.01, rel=4 * np.sqrt(2 / modes))
    again = kind(amplitude=0.04).sky(sky, replace(site, channel="V1", frequency_ghz=61.0), draw) - sky
    np.testing.assert_allclose(again, 2.0 * drawn, atol=1e-10)


def test_fewer_point_sources_take_power_away(site):
    """On a sky of C_l = 1 a negative amplitude leaves 1 + amplitude of the power, band by band."""
    sky = gaussian_alm(np.ones(LMAX + 1), np.random.default_rng(3))
    found = systematics.get("point_sources")(amplitude=-0.1).sky(sky, site, draw)
    power, before = (np.bincount(alm_.degrees(LMAX), np.abs(alm) ** 2) for alm in (found, sky))
    # What is divided by is the power of 11 degrees around: 2 % of scatter at l = 30, and it enters times 0.1.
    np.testing.assert_allclose((power / before)[20:], 0.9, atol=0.012)


def test_the_power_that_sources_take_is_a_share_of_that_around_them(site):
    """Of 5 degrees on either side, or a tenth of l; a monopole and a dipole are none of it."""
    lmax = 90
    sky, ell = gaussian_alm(1.0 / np.arange(2.0, lmax + 3.0) ** 2, np.random.default_rng(4)), np.arange(lmax + 1)
    sky[0], sky[1] = 1e3, 30.0
    found = systematics.get("point_sources")(amplitude=-1e-5).sky(sky, replace(site, lmax=lmax), draw)
    total = np.bincount(alm_.degrees(lmax), np.where(alm_.orders(lmax) > 0, 2.0, 1.0) * np.abs(sky) ** 2)
    for degree in (2, 6, 30, 59, 60, 85, lmax):
        reach = max(5, degree // 10)
        near = (ell >= max(degree - reach, 2)) & (ell <= degree + reach)
        around = total[near].sum() / np.sum(2.0 * ell[near] + 1.0)
        changed = alm_.degrees(lmax) == degree
        np.testing.assert_allclose(found[changed], np.sqrt(1.0 - 1e-5 / around) * sky[changed], rtol=1e-9)


def test_glitches_add_up_as_their_number_does():
    """The variance is the mean number of hits times one's; 4 sigma of 40000 sums of half a hit on average."""
    drawn = systematics.get("excess_noise")(amplitude=0.005, glitch_uk=200.0).excess(
        np.full(40000, 100.0), np.random.default_rng(8)
    )
    # The relative variance of a square is kurtosis - 1 = 2 + 3 / 0.5.
    assert np.mean(drawn**2) == pytest.approx(0.5 * 200.0**2, rel=4.0 * np.sqrt(8.0 / 40000))
    assert np.mean(drawn == 0.0) == pytest.approx(np.exp(-0.5), abs=0.01)


def test_foregrounds_are_fixed_to_the_galaxy_and_grow_with_frequency(site, sky):
    kind = systematics.get("foreground_residual")
    drawn = kind(amplitude=3.0).sky(sky, site, draw) - sky
    values = healpix.synthesis(rotate_alm(drawn, LMAX, "ecliptic", "galactic")[None], NSIDE, LMAX)[0]
    assert np.sqrt(np.mean(values**2)) == pytest.approx(3.0, rel=0.01)
    latitude = np.abs(healpy.pix2ang(NSIDE, np.arange(values.size), lonlat=True)[1])
    assert np.sqrt(np.mean(values[latitude < 10] ** 2)) > 10 * np.sqrt(np.mean(values[latitude > 40] ** 2))
    assert values[latitude < 10].mean() > 0.0
    low = kind(amplitude=3.0, spectral_index=1.0).sky(sky, replace(site, frequency_ghz=47.0), draw) - sky
    np.testing.assert_allclose(low, 0.5 * drawn, atol=1e-12)
    with refused("W1", "frequency_ghz"):
        kind(amplitude=3.0).sky(sky, replace(site, frequency_ghz=None), draw)
    assert kind(amplitude=3.0).sky(sky, replace(site, frequency_ghz=None, foregrounds=False), draw) is sky


def test_an_index_is_fitted_where_two_differences_of_channels_tell_it():
    plain = systematics.get("foreground_residual").parametrization
    for seen in ((94.0,), (94.0, None), (61.0, 94.0), (61.0, 94.0, 94.0)):
        assert plain.seen_at(seen) == plain
        assert (plain.basis(), plain.measured) == (({},), ())
    for seen, columns in (((61.0, 94.0, None), 2), ((41.0, 61.0, 94.0), 3), ((23.0, 41.0, 61.0, 94.0), 3)):
        assert plain.seen_at(seen).measured == ("spectral_index",)
        assert len(plain.seen_at(seen).basis()) == columns


@pytest.mark.parametrize("seen", [(61.0, 94.0, None), (30.0, 44.0, 70.0), (23.0, 33.0, 41.0, 61.0, 94.0)])
def test_amplitude_and_index_are_those_of_their_coordinates(seen):
    kind = systematics.get("foreground_residual")
    fit = kind.parametrization.seen_at(seen)
    metric = np.array([[2.0, 0.9, 0.3], [0.9, 1.0, 0.1], [0.3, 0.1, 1.5]])[: len(fit.basis()), : len(fit.basis())]
    for amplitude, index in ((3.0, 2.0), (3.0, -2.0), (-5.0, 0.4), (2.0, -3.1), (40.0, 3.9)):
        effect = kind(amplitude=amplitude, spectral_index=index)
        found = fit.nearest(fit.coordinates(effect), metric)
        assert found == pytest.approx({"amplitude": amplitude, "spectral_index": index}, rel=1e-4, abs=1e-4)
        assert fit.coordinates(effect.scaled(2.0)) == pytest.approx(2.0 * fit.coordinates(effect))
    ends = [fit.coordinates(kind(amplitude=1.0, **parameters)) for parameters in fit.basis()]
    np.testing.assert_allclose(ends, np.eye(len(ends)), atol=1e-11)


@pytest.mark.parametrize("seen", [(61.0, 94.0, None), (28.4, 44.1, 70.4)])
def test_coordinates_at_two_and_three_frequencies_are_exact(seen):
    """c_1 x^2 + c_2 x^-2 is x^index at either of two, and with c_3 more at each of three."""
    kind, x = systematics.get("foreground_residual"), np.array([one for one in seen if one is not None]) / 94.0
    fit = kind.parametrization.seen_at(seen)
    powers = np.stack([x ** parameters["spectral_index"] for parameters in fit.basis()])
    for index in (-3.0, 0.4, 1.5):
        c = fit.coordinates(kind(amplitude=1.0, spectral_index=index))
        np.testing.assert_allclose(c @ powers, x**index, rtol=1e-10)


def test_an_amplitude_is_detectable_at_the_index_of_the_effect():
    """At 94 GHz it is a hundred times larger for dust than for synchrotron at 28 GHz: their mean says nothing."""
    kind = systematics.get("foreground_residual")
    fit = kind.parametrization.seen_at((28.4, 44.1, 70.4))
    np.testing.assert_allclose(fit.typical(kind()), [[1.0], [0.0], [0.0]], atol=1e-11)
    one = Candidate(kind, None, (0, 1, 2), fit=fit)
    assert (one.fixed, one.typical.shape) == ({"spectral_index": 2.0}, (3, 1))
    plain = Candidate(kind, None, (0,))
    assert (plain.fixed, plain.typical.tolist()) == ({}, [[1.0]])


def test_signals_of_two_signs_have_the_steepest_index():
    """No power law is negative at 61 and positive at 94 GHz; the nearest has nothing at 61."""
    kind = systematics.get("foreground_residual")
    fit = kind.parametrization.seen_at((61.0, 94.0, None))
    x = np.array([61.0, 94.0]) / 94.0
    matrix = np.stack([x**2, x**-2.0], axis=1)
    found = fit.nearest(np.linalg.solve(matrix, [-0.05, 1.0]), matrix.T @ matrix)
    assert found["spectral_index"] > 10.0
    assert found["amplitude"] == pytest.approx(1.0, abs=0.01)


def test_an_index_is_printed_with_its_error_or_as_not_fitted():
    effect = systematics.get("foreground_residual")(amplitude=48.2, spectral_index=0.4)
    assert effect.describe(5.1, {"spectral_index": 0.03}).endswith("rms at 94 GHz, index 0.400 ± 0.030")
    assert effect.describe(5.1).endswith("rms at 94 GHz, index 0.4 (not fitted)")


def test_noise_after_a_template(site, tmp_path):
    path = str(tmp_path / "pattern.fits")
    pattern = healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[0]
    healpy.write_map(path, pattern, coord="E", dtype=np.float64)
    kind = systematics.get("noise_anisotropy")
    np.testing.assert_allclose(kind(amplitude=0.3, template=path).noise(site), 1.0 + 0.3 * pattern)
    galactic = kind(amplitude=0.3, template=path).noise(replace(site, frame="galactic"))
    # A pixel's centre in the other frame is up to 0.055 rad off, half a diagonal.
    np.testing.assert_allclose(galactic, rotate_pixels(1.0 + 0.3 * pattern, "ecliptic", "galactic"), atol=0.034)
    with refused("noise_anisotropy", "amplitude", -1.1):
        kind(amplitude=-1.1, template=path).noise(site)


def test_noise_of_a_pixel_has_the_mean_of_a_finer_template(site, tmp_path, monkeypatch):
    """It had the value at the centre, one of 64 for a template of eight times the nside; which is read once."""
    monkeypatch.setattr(noise, "AT_ONCE", 1000)
    path = str(tmp_path / "fine.fits")
    pattern = np.random.default_rng(8).uniform(-1.0, 1.0, 12 * (8 * NSIDE) ** 2)
    healpy.write_map(path, pattern, dtype=np.float64)
    kind = systematics.get("noise_anisotropy")
    found = kind(amplitude=0.5, template=path).noise(site)
    np.testing.assert_allclose(found, 1.0 + 0.5 * healpy.ud_grade(pattern, NSIDE), rtol=1e-12)
    monkeypatch.setattr(map_files, "read_map", None)
    np.testing.assert_allclose(kind(amplitude=1.0, template=path).noise(site) - 1.0, 2.0 * (found - 1.0), atol=1e-12)


def test_foregrounds_after_a_template(site, sky, tmp_path):
    template = healpix.synthesis(gaussian_alm(load("wmap7", 32), np.random.default_rng(4))[None], NSIDE, 32)[0]
    path = str(tmp_path / "template.fits")
    healpy.write_map(path, template, coord="E", dtype=np.float64)
    found = systematics.get("foreground_residual")(amplitude=2.0, template=path).sky(sky, site, draw) - sky
    values = healpix.synthesis(found[None], NSIDE, LMAX)[0]
    np.testing.assert_allclose(values, 2.0 * template / np.sqrt(np.mean(template**2)), rtol=0.0, atol=5e-3)
    healpy.write_map(path.replace("template", "zero"), 0.0 * template, dtype=np.float64)
    with refused("zero.fits"):
        systematics.get("foreground_residual")(amplitude=2.0, template=path.replace("template", "zero")).sky(
            sky, site, draw
        )


def test_noise_is_strongest_at_the_ecliptic_poles_in_every_frame(site):
    effect = systematics.get("noise_anisotropy")(amplitude=0.2)
    latitude = np.deg2rad(healpy.pix2ang(NSIDE, np.arange(12 * NSIDE**2), lonlat=True)[1])
    factor = effect.noise(site)
    np.testing.assert_allclose(factor, 1.0 + 0.2 * (3.0 * np.sin(latitude) ** 2 - 1.0))
    assert factor.mean() == pytest.approx(1.0, abs=1e-3)
    galactic = effect.noise(replace(site, frame="galactic"))
    # A pixel's centre in the other frame is up to 0.055 rad off, half a diagonal, times a slope of 0.6.
    np.testing.assert_allclose(galactic, rotate_pixels(factor, "ecliptic", "galactic"), atol=0.034)
    assert np.ptp(galactic - factor) > 0.3
    np.testing.assert_array_equal(
        systematics.get("noise_level")(amplitude=0.1).noise(site), np.full(12 * NSIDE**2, 1.1**2)
    )
    for name, amplitude in (("noise_anisotropy", 1.5), ("noise_anisotropy", -0.6), ("noise_level", -1.0)):
        with refused(name):
            systematics.get(name)(amplitude=amplitude).noise(site)


def test_gain_follows_the_year(site):
    effect = systematics.get("gain_drift")(amplitude=0.01, phase_deg=90.0)
    year = site.pointing.model.orbit_period_s
    np.testing.assert_allclose(effect.gain(year * np.array([0.0, 0.25, 0.75]), site), [0.0, 0.01, -0.01], atol=1e-15)
    with refused("gain_drift", "W1", "scan.model"):
        effect.gain(np.zeros(1), replace(site, pointing=None))


def test_orientations_are_mixed_with_those_of_the_scan(site):
    believed = Moments.parallel_transport(NSIDE, np.rad2deg(0.3), 2)
    effect = systematics.get("orientation_averaging")(amplitude=0.25)
    real = Moments.from_model(site.pointing.model.with_lines_of_sight("A"), NSIDE, 2)
    seen = real.hits > 0
    assert seen.mean() > 0.5
    found = effect.orientations(believed, site)
    np.testing.assert_allclose(found.w[:, seen], (0.75 * believed.w + 0.25 * real.w)[:, seen])
    np.testing.assert_array_equal(found.w[:, ~seen], believed.w[:, ~seen])
    with refused("orientation_averaging", "W1", "scan.model"):
        effect.orientations(believed, replace(site, pointing=None))
    circular = replace(believed, w=believed.w[:0])  # what is read of a file for a circular beam
    assert effect.orientations(circular, site).w.shape == (0, believed.npix)


def test_a_differencing_scan_is_less_balanced_and_solved_for_less():
    assert systematics.get("transmission_imbalance")(amplitude=0.002).differencing(0.001, 3) == (0.003, 3)
    assert systematics.get("mapmaking_convergence")(amplitude=4.0).differencing(0.001, 3) == (0.001, 7)
    assert systematics.get("pixelization")(amplitude=0.3).spread() == pytest.approx(0.7)


def test_a_map_making_cannot_be_more_than_converged(site):
    early = systematics.get("mapmaking_convergence")(amplitude=-5.0)
    for act in (lambda: early.differencing(0.001, 3), lambda: systematics.tried([early], site)):
        with refused("mapmaking_convergence", -5, 0, "scan.tolerance"):
            act()
