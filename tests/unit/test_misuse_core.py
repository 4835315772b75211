"""Wrong input of the science core: each ends in the right number or in an InputError, never in another number."""

from dataclasses import replace
from pathlib import Path

import healpy
import numpy as np
import pytest
from astropy.io import fits

from mcsim import bipolar
from mcsim.bipolar import theory
from mcsim.errors import InputError
from mcsim.instrument import beams, scan
from mcsim.instrument.scan.geometry import MapGrid
from mcsim.instrument.scan.limit import limit_moments
from mcsim.instrument.scan.model import LineOfSight, ScanModel
from mcsim.instrument.scan.pointing import pointing
from mcsim.instrument.scan.user_pointing import blocks_of_files
from mcsim.simulation import convolve, rings, skies, tod
from mcsim.sphere import alm as alm_
from mcsim.sphere import header, healpix, map_files, mask, rng, rotation, sky
from refusals import refused

LMAX, NSIDE = 16, 8
MODEL = ScanModel("toy", 129.3, -3600.0, 22.5, 31557600.0, 2.0, 0.2, (LineOfSight("A", 70.5),), ("A",))
PATH = Path("map.fits")


def drawn(lmax: int = LMAX) -> np.ndarray:
    return sky.gaussian_alm(np.ones(lmax + 1), np.random.default_rng(lmax))


def moments(nside: int = NSIDE, smax: int = 2) -> scan.Moments:
    return scan.Moments.parallel_transport(nside, 17.0, smax)


def centred(nside: int) -> scan.Moments:
    npix = 12 * nside**2
    return scan.Moments(nside, "ecliptic", np.ones(npix), np.zeros((1, npix), complex), np.zeros(npix), np.zeros(npix))


def at_pixels(nside: int):
    return tod.samples(MODEL, MODEL.lines_of_sight[0], MapGrid(nside))


ALM, BIGGER, SMALLER = drawn(), drawn(24), drawn(8)
REAL = np.ones(ALM.size)
HOLED = np.where(np.arange(ALM.size) == 7, np.nan, ALM)
MAP = np.random.default_rng(1).normal(size=12 * NSIDE**2)
UNSEEN = np.where(np.arange(MAP.size) == 5, healpy.UNSEEN, MAP)
CL = np.ones(LMAX + 1)
BEAM = beams.Beam.elliptical(600.0, 500.0, lmax=LMAX, mmax=2)
RESPONSE = convolve.response(BEAM, LMAX)
TABLES = bipolar.estimator(2, LMAX)
SCANNED = theory.ScannedBeam(BEAM.blm, theory.parallel_transport_harmonics(2, 2))
SPINS = convolve.spin_maps(ALM, RESPONSE, NSIDE)
MODES = [(2, 0, 0), (2, 0, 2)]

# Every one of these gave a number, or ended in an error of another library, before sizes were checked.
WRONG = {
    "estimate: alm of smaller lmax": lambda: bipolar.estimate(TABLES, SMALLER),
    "estimate: alm of larger lmax": lambda: bipolar.estimate(TABLES, BIGGER),
    "estimate: second alm of larger lmax": lambda: bipolar.estimate(TABLES, ALM, BIGGER),
    "estimate: real alm": lambda: bipolar.estimate(TABLES, REAL),
    "estimate: alm with NaN": lambda: bipolar.estimate(TABLES, HOLED),
    "estimate: a map": lambda: bipolar.estimate(TABLES, MAP),
    "estimate: a list": lambda: bipolar.estimate(TABLES, list(ALM)),
    "estimator: exchanged": lambda: bipolar.estimator(LMAX, 2),
    "estimator: lmax no int": lambda: bipolar.estimator(2, 16.5),
    "power_spectrum: another lmax": lambda: bipolar.power_spectrum(BIGGER, BIGGER, LMAX),
    "power_spectrum: two sizes": lambda: bipolar.power_spectrum(ALM, BIGGER, LMAX),
    "multiply: another lmax": lambda: alm_.multiply(BIGGER, CL, LMAX),
    "multiply: short factor": lambda: alm_.multiply(ALM, CL[:-1], LMAX),
    "multiply: one coefficient": lambda: alm_.multiply(ALM[:1], CL, LMAX),
    "resize: another lmax": lambda: alm_.resize(BIGGER, LMAX, 8),
    "synthesis: another lmax": lambda: healpix.synthesis(BIGGER[None], NSIDE, LMAX),
    "synthesis: real": lambda: healpix.synthesis(REAL[None], NSIDE, LMAX),
    "synthesis: one field of spin 2": lambda: healpix.synthesis(ALM[None], NSIDE, LMAX, spin=2),
    "synthesis: nside": lambda: healpix.synthesis(ALM[None], 12.0, LMAX),
    "synthesis: exchanged": lambda: healpix.synthesis(ALM[None], LMAX, NSIDE),
    "gradient: another lmax": lambda: healpix.gradient(BIGGER, NSIDE, LMAX),
    "analysis: UNSEEN": lambda: healpix.analysis(UNSEEN, LMAX),
    "analysis: NaN": lambda: healpix.analysis(np.where(UNSEEN < -1, np.nan, MAP), LMAX),
    "analysis: not all pixels": lambda: healpix.analysis(MAP[:-1], LMAX),
    "analysis: lmax beyond the pixels": lambda: healpix.analysis(MAP, 3 * NSIDE),
    "analysis: alm": lambda: healpix.analysis(ALM, LMAX),
    "analysis: two maps": lambda: healpix.analysis(np.stack([MAP, MAP]), LMAX),
    "pixel_window: nside": lambda: healpix.pixel_window(12, LMAX),
    "rotate_alm: another lmax": lambda: rotation.rotate_alm(BIGGER, LMAX, "galactic", "ecliptic"),
    "rotate_pixels: not all pixels": lambda: rotation.rotate_pixels(MAP[:-1], "galactic", "ecliptic"),
    "rotate_pixels: frame": lambda: rotation.rotate_pixels(MAP, "G", "ecliptic"),
    "rotate_biposh: modes": lambda: rotation.rotate_biposh(np.zeros((3, 9), complex), MODES, "galactic", "ecliptic"),
    "gaussian_alm: negative": lambda: sky.gaussian_alm(-CL, np.random.default_rng(1)),
    "gaussian_alm: NaN": lambda: sky.gaussian_alm(np.nan * CL, np.random.default_rng(1)),
    "gaussian_alm: two spectra": lambda: sky.gaussian_alm(np.stack([CL, CL]), np.random.default_rng(1)),
    "dipole_alm: an amplitude": lambda: sky.dipole_alm([3364.5], LMAX),
    "dipole_alm: NaN": lambda: sky.dipole_alm([0.0, np.nan, 1.0], LMAX),
    "rng: negative realization": lambda: rng.generator(1, -1, "sky"),
    "apodise: degrees": lambda: mask.apodise(np.ones(12), 5.0),
    "apodise: not all pixels": lambda: mask.apodise(np.ones(11), 0.1),
    "response: short beam": lambda: convolve.response(BEAM, LMAX + 1),
    "response: short window": lambda: convolve.response(BEAM, LMAX, CL[:-1]),
    "response: NaN in the window": lambda: convolve.response(BEAM, LMAX, np.nan * CL),
    "circular_alm: another lmax": lambda: convolve.circular_alm(BIGGER, RESPONSE),
    "circular_map: another lmax": lambda: convolve.circular_map(BIGGER, RESPONSE, NSIDE),
    "spin_maps: another lmax": lambda: convolve.spin_maps(BIGGER, RESPONSE, NSIDE),
    "spin_maps: real": lambda: convolve.spin_maps(REAL, RESPONSE, NSIDE),
    "noncircular_map: coarser moments": lambda: convolve.noncircular_map(SPINS, moments(NSIDE // 2)),
    "noncircular_map: finer moments": lambda: convolve.noncircular_map(SPINS, moments(2 * NSIDE)),
    "noncircular_map: too few orders": lambda: convolve.noncircular_map(SPINS, moments(smax=1)),
    "turned: coarser moments": lambda: convolve.turned([(MAP, moments(4))], 1),
    "centroid_map: none": lambda: convolve.centroid_map(np.zeros((2, MAP.size)), moments()),
    "centroid_map: coarser moments": lambda: convolve.centroid_map(np.zeros((2, MAP.size)), centred(4)),
    "rings: another lmax": lambda: rings.noncircular_alm(BIGGER, RESPONSE, (), LMAX),
    "rings: lmax above the response": lambda: rings.noncircular_alm(ALM, RESPONSE, (), LMAX + 1),
    "rings: degrees": lambda: rings.parallel_transport_rings(45.0, (2,), 32),
    "sky_signal: another lmax": lambda: tod.sky_signal(BIGGER, LMAX, BEAM),
    "sky_signal: real": lambda: tod.sky_signal(REAL, LMAX, BEAM),
    "white_noise: negative": lambda: tod.white_noise(-1.0, np.random.default_rng(1)),
    "white_noise: NaN": lambda: tod.white_noise(np.nan, np.random.default_rng(1)),
    "BeamMap: cut in degrees": lambda: beams.BeamMap(np.ones((9, 9)), 0.01, (4.0, 4.0), 3.5),
    "BeamMap: centre outside": lambda: beams.BeamMap(np.ones((9, 5)), 0.01, (4.0, 9.0), 0.03),
    "BeamMap: cube": lambda: beams.BeamMap(np.ones((4, 9, 9)), 0.01, (4.0, 4.0), 0.03),
    "BeamMap: complex": lambda: beams.BeamMap(np.ones((9, 9), complex), 0.01, (4.0, 4.0), 0.03),
    "BeamMap: NaN": lambda: beams.BeamMap(np.full((9, 9), np.nan), 0.01, (4.0, 4.0), 0.03),
    "bin_samples: another nside": lambda: tod.bin_samples(at_pixels(NSIDE), NSIDE // 2),
    "ScanModel: NaN": lambda: replace(MODEL, spin_period_s=np.nan),
    "ScanModel: year in days": lambda: replace(MODEL, orbit_period_s=365.25),
    "ScanModel: negative angle": lambda: replace(MODEL, precession_angle_deg=-22.5),
    "with_sampling: zero": lambda: MODEL.with_sampling(0.0),
    "rotated: degrees": lambda: BEAM.rotated(45.0),
    "pointing: negative": lambda: pointing(MODEL, MODEL.lines_of_sight[0], -1, 5),
    "parallel_transport: NaN": lambda: scan.Moments.parallel_transport(NSIDE, np.nan),
    "parallel_transport: exchanged": lambda: scan.Moments.parallel_transport(45.0, NSIDE),
    "limit_moments: degrees": lambda: limit_moments(MODEL, np.array([30.0, 90.0]), 2),
    "limit_on_pixels: nside": lambda: scan.Moments.limit(MODEL, 12, 2),
    "Moments: hits of another nside": lambda: scan.Moments(4, "ecliptic", np.ones(12), np.zeros((2, 192), complex)),
    "Moments: w of another nside": lambda: scan.Moments(4, "ecliptic", np.ones(192), np.zeros((2, 12), complex)),
    "Moments: w exchanged": lambda: scan.Moments(1, "ecliptic", np.ones(12), np.zeros((12, 2), complex)),
    "Moments: real w": lambda: scan.Moments(1, "ecliptic", np.ones(12), np.zeros((2, 12))),
    "Moments: frame": lambda: scan.Moments(1, "G", np.ones(12), np.zeros((2, 12), complex)),
    "Moments: dtheta alone": lambda: scan.Moments(1, "ecliptic", np.ones(12), np.zeros((1, 12), complex), np.zeros(12)),
    "Beam: exchanged axes": lambda: beams.Beam(BEAM.blm.T.copy()),
    "Beam: real": lambda: beams.Beam(BEAM.blm.real),
    "Beam: NaN": lambda: beams.Beam(np.nan * BEAM.blm),
    "Beam: l below m": lambda: beams.Beam(np.ones((3, 5), complex)),
    "Beam.values: degrees": lambda: BEAM.values(np.array([20.0]), np.array([0.0])),
    "gaussian: lmax no int": lambda: beams.Beam.gaussian(60.0, 16.5),
    "gaussian: exchanged": lambda: beams.Beam.gaussian(16, 0.5),
    "theory: beam below lmax": lambda: theory.cmb_biposh_leading(MODES, np.ones(30), 20, SCANNED),
    "theory, exact: beam below lmax": lambda: theory.cmb_biposh_exact(MODES, np.ones(30), 20, SCANNED),
    "theory: exchanged": lambda: theory.cmb_biposh_leading(MODES, CL, LMAX, theory.ScannedBeam(SCANNED.w, SCANNED.blm)),
    "theory: short spectrum": lambda: theory.cmb_biposh_leading(MODES, CL[:-1], LMAX, SCANNED),
    "theory: NaN in the spectrum": lambda: theory.cmb_biposh_exact(MODES, np.nan * CL, LMAX, SCANNED),
    "theory: columns of a table": lambda: theory.cmb_biposh_leading(MODES, np.ones((17, 2)), LMAX, SCANNED),
    "beam_biposh: shape of w": lambda: theory.beam_biposh(
        theory.ScannedBeam(BEAM.blm, SCANNED.w[:, :, :3]), (2, 0, 0), LMAX
    ),
    "noise_biposh: shape": lambda: theory.noise_biposh(MODES, np.zeros((3, 3), complex), LMAX),
    "isotropic_variance: two sizes": lambda: theory.isotropic_variance(MODES, theory.Spectra(CL, CL[:-1], CL)),
    "signal_to_noise: lmax": lambda: theory.signal_to_noise(np.zeros((2, 9), complex), MODES, theory.Spectra(CL)),
    "signal_to_noise: modes": lambda: theory.signal_to_noise(np.zeros((1, 17), complex), MODES, theory.Spectra(CL)),
    "fisher_information: maps": lambda: theory.fisher_information(
        np.zeros((1, 1, 2, 17), complex), MODES, np.ones((2, 2, 17))
    ),
    "orientation_harmonics: exchanged": lambda: theory.orientation_harmonics(np.zeros((12, 2), complex), 2),
    "orientation_harmonics: one map": lambda: theory.orientation_harmonics(np.zeros(12, complex), 2),
    "parallel_transport_harmonics: degrees": lambda: theory.parallel_transport_harmonics(2, 4, 45.0),
}


@pytest.mark.parametrize("misuse", WRONG)
def test_wrong_sizes_kinds_and_values_are_refused(misuse):
    with pytest.raises(InputError):
        WRONG[misuse]()


def test_what_the_checks_must_accept():
    """The same calls with the right sizes; read-only, single-precision and integer arrays count as right."""
    reference = bipolar.estimate(TABLES, ALM)
    found = bipolar.estimate(TABLES, ALM.astype(np.complex64))
    np.testing.assert_allclose(found[np.isfinite(found)], reference[np.isfinite(found)], atol=1e-4)
    counts = np.arange(12, dtype=np.int16)
    np.testing.assert_allclose(healpix.analysis(counts, 2), healpix.analysis(counts.astype(float), 2))
    # What a run on rings costs is estimated by a transform with about as many rings.
    assert healpix.synthesis(ALM[None], 15, LMAX).shape == (1, 2700)
    assert MODEL.select("A") == MODEL.lines_of_sight
    assert convolve.noncircular_map(SPINS, moments()).shape == MAP.shape
    assert tod.bin_samples(at_pixels(NSIDE), NSIDE)[1].sum() == MODEL.samples(MODEL.lines_of_sight[0])
    assert theory.cmb_biposh_exact(MODES, np.ones(30), LMAX, SCANNED).shape == (2, LMAX + 1)


# Antenna to CMB temperature, (e^x - 1)^2 / (x^2 e^x) with x = h nu / k T.
def antenna(frequency_ghz: float) -> float:
    x = 6.62607015e-34 * frequency_ghz * 1e9 / (1.380649e-23 * 2.7255)
    return np.expm1(x) ** 2 / (x**2 * np.exp(x))


@pytest.mark.parametrize(
    ("unit", "expected"),
    [(None, 1.0), ("", 1.0), ("unknown", 1.0)]
    + [(unit, 1.0) for unit in ("uK", "UK", "µK", "μK", "muK", "uKcmb", "uK_CMB", "uK (CMB)", "microK", "microKelvin")]
    + [(unit, 1e3) for unit in ("mK", "mK,thermodynamic", "mK thermodynamic", "mK_thermo", "mKcmb", "milliKelvin")]
    + [(unit, 1e6) for unit in ("K", "Kcmb", "K_CMB", "K_CMB ", "kelvin", "K (thermodynamic temperature)")]
    + [("nK_CMB", 1e-3)]
    + [(unit, antenna(94.0)) for unit in ("uK_RJ", "uK,antenna", "uKRJ", "uK_A", "muK_RJ")]
    + [(unit, 1e3 * antenna(94.0)) for unit in ("mK,antenna", "mK antenna temperature", "mK_ant")]
    + [(unit, 1e6 * antenna(94.0)) for unit in ("K_RJ", "K (Rayleigh-Jeans)")],
)
def test_units_of_temperature(unit, expected):
    assert header.to_uk(unit, PATH, 94.0) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("unit", ["MJy/sr", "MJy sr-1", "kJy/sr"])
def test_brightness_becomes_temperature(unit):
    # Planck's 143 and 353 GHz without bandpass: dB/dT at the nominal frequency, MJy/sr per K.
    for frequency in (143.0, 353.0):
        h, k, c, t = 6.62607015e-34, 1.380649e-23, 299792458.0, 2.7255
        nu = frequency * 1e9
        x = h * nu / (k * t)
        slope = 2.0 * h * nu**3 / c**2 * x * np.exp(x) / np.expm1(x) ** 2 / t  # W m^-2 Hz^-1 sr^-1 K^-1
        jansky = 1e-26 * (1e3 if unit.startswith("k") else 1e6)
        assert header.to_uk(unit, PATH, frequency) == pytest.approx(1e6 * jansky / slope, rel=1e-6)


@pytest.mark.parametrize("unit", ["uK_RJ", "K_RJ", "mK,antenna", "MJy/sr"])
def test_antenna_temperature_needs_a_frequency(unit):
    with refused("frequency_ghz"):
        header.to_uk(unit, PATH)


@pytest.mark.parametrize("unit", ["Jy", "uK^2", "V", "counts", "dT/T", "K/K", "m", "%", "y_SZ", "MK2", "Kcmx", "s"])
def test_units_of_something_else_are_refused(unit):
    with refused("map.fits"):
        header.to_uk(unit, PATH, 94.0)


@pytest.mark.parametrize(
    ("word", "frame"),
    [
        *((word, "ecliptic") for word in ("E", "ECLIPTIC")),
        *((word, "galactic") for word in ("G", "GALACTIC", "gal")),
        *((word, "equatorial") for word in ("C", "EQUATORIAL", "CELESTIAL", "ICRS")),
        *((word, None) for word in (None, "", "unknown")),
    ],
)
def test_frames_of_headers(word, frame):
    """EQUATORIAL starts with an E and is not ecliptic."""
    assert header.frame_named(word, "map.fits") == frame


def test_unknown_frame_is_refused():
    with refused("COORDSYS", "HELIO"):
        header.frame_named("HELIO", "map.fits")


def write_map(path: Path, values: np.ndarray = MAP, **keywords: object) -> Path:
    healpy.write_map(path, values, overwrite=True, dtype=np.float64, coord="E", column_units="uK")
    for key, value in keywords.items():
        if value is None:
            fits.delval(path, key, 1)
        else:
            fits.setval(path, key, value=value, ext=1)
    return path


def test_maps_of_both_orders_and_explicit_pixels(tmp_path):
    nested = tmp_path / "nested.fits"
    healpy.write_map(nested, healpy.reorder(MAP, r2n=True), nest=True, dtype=np.float64)
    np.testing.assert_array_equal(map_files.read_map(nested)[0], MAP)
    partial = tmp_path / "partial.fits"
    healpy.write_map(partial, UNSEEN, partial=True, dtype=np.float64, column_units="mK", coord="G")
    found, frame, unit = map_files.read_map(partial)
    np.testing.assert_array_equal(found, UNSEEN)
    assert (frame, unit) == ("galactic", "mK")


@pytest.mark.parametrize("keywords", [{"ORDERING": None}, {"ORDERING": "UPWARDS"}, {"COORDSYS": "X"}])
def test_maps_that_do_not_say_what_they_are(tmp_path, keywords):
    with refused(next(iter(keywords))):
        map_files.read_map(write_map(tmp_path / "map.fits", **keywords))


def test_a_frame_may_stand_in_the_primary_header(tmp_path):
    """It was passed over: a galactic map or pointing was taken for that of the run."""
    path = write_map(tmp_path / "map.fits", COORDSYS=None)
    fits.setval(path, "COORDSYS", value="G", ext=0)
    assert map_files.read_map(path)[1] == "galactic"
    with refused("galactic", "ecliptic"):
        map_files.read_map(path, frame="ecliptic")
    fits.setval(path, "COORDSYS", value="E", ext=1)
    with refused("galactic", "ecliptic", "primary"):
        map_files.read_map(path)
    alm, samples = tmp_path / "alm.fits", tmp_path / "samples.fits"
    healpy.write_alm(alm, ALM, out_dtype=np.float64)
    columns = [fits.Column(name=name, format="D", array=np.full(20, 0.5)) for name in ("theta", "phi", "psi")]
    fits.BinTableHDU.from_columns(columns).writeto(samples)
    for file in (alm, samples):
        fits.setval(file, "COORDSYS", value="G", ext=0)
    with refused("galactic", "ecliptic"):
        skies.read_alm(alm, LMAX, "ecliptic")
    with refused("galactic", "ecliptic"):
        list(blocks_of_files(samples, "ecliptic"))


def test_antenna_temperature_in_temptype(tmp_path):
    unit = map_files.read_map(write_map(tmp_path / "map.fits", TEMPTYPE="ANTENNA"))[2]
    assert header.to_uk(unit, PATH, 94.0) == pytest.approx(antenna(94.0), rel=1e-6)


def test_sky_maps(tmp_path):
    path = tmp_path / "sky.fits"
    expected = skies.read_map(write_map(path), LMAX, "ecliptic")
    found = skies.read_map(write_map(path, TUNIT1="K_RJ"), LMAX, "ecliptic", frequency_ghz=94.0)
    np.testing.assert_allclose(found, 1e6 * antenna(94.0) * expected, rtol=1e-6, atol=1e-9)
    for keywords, values, named in (
        ({"TUNIT1": "K_RJ"}, MAP, ("frequency_ghz",)),
        ({"COORDSYS": "G"}, MAP, ("galactic",)),
        ({"TUNIT1": None}, 1e-6 * MAP, (0.01, "TUNIT")),
        ({}, UNSEEN, ("unseen",)),
    ):
        with refused(*named):
            skies.read_map(write_map(path, values, **keywords), LMAX, "ecliptic")
    small = 0.5 / np.abs(MAP).max() * MAP
    with pytest.warns(UserWarning, match=r"0\.5 uK.*mK.*TUNIT"):
        skies.read_map(write_map(path, small, TUNIT1=None), LMAX, "ecliptic")
    skies.read_map(write_map(path, small, TUNIT1="uK"), LMAX, "ecliptic")  # says that it is


def test_sky_alm(tmp_path):
    path = tmp_path / "alm.fits"

    def written(alm: np.ndarray, **keywords: object) -> Path:
        healpy.write_alm(path, alm, overwrite=True, out_dtype=np.float64)
        for key, value in keywords.items():
            fits.setval(path, key, value=value, ext=1)
        return path

    np.testing.assert_array_equal(skies.read_alm(written(BIGGER), LMAX, "ecliptic"), alm_.resize(BIGGER, 24, LMAX))
    np.testing.assert_allclose(skies.read_alm(written(ALM, TUNIT2="mK"), LMAX, "ecliptic"), 1e3 * ALM)
    np.testing.assert_array_equal(skies.read_alm(written(0.0 * ALM), LMAX, "ecliptic"), 0.0 * ALM)
    antenna = skies.read_alm(written(ALM, TUNIT2="uK_RJ"), LMAX, "ecliptic", frequency_ghz=94.0)
    np.testing.assert_allclose(antenna, 1.25021 * ALM, rtol=1e-5)
    turned = np.where(np.arange(ALM.size) <= LMAX, 1j, 1.0) * ALM
    for alm, keywords, named in (
        (SMALLER, {}, ("l = 8", 16)),
        (HOLED, {}, ("finite",)),
        (1e-6 * ALM, {}, (0.01, "TUNIT")),
        (turned, {}, ("a_l0", "complex")),
        (ALM, {"COORDSYS": "G"}, ("galactic",)),
        (ALM, {"TUNIT2": "Jy"}, ("Jy",)),
    ):
        with refused("alm.fits", *named):
            skies.read_alm(written(alm, **keywords), LMAX, "ecliptic")


def test_masks(tmp_path):
    path = tmp_path / "mask.fits"
    half = (MAP > 0.0).astype(float)
    np.testing.assert_array_equal(mask.read_mask(write_map(path, half), NSIDE), half)
    nested = tmp_path / "nested.fits"
    healpy.write_map(nested, healpy.reorder(half, r2n=True), nest=True, dtype=np.float64, coord="E")
    np.testing.assert_array_equal(mask.read_mask(nested, NSIDE), half)
    for values, keywords, name in (
        (100.0 * half, {}, "0 ... 1"),
        (np.where(half > 0, 1.0, healpy.UNSEEN), {}, "0 ... 1"),
        (np.where(half > 0, 1.0, np.nan), {}, "0 ... 1"),
        (half, {"ORDERING": None}, "ORDERING"),
        (half, {"COORDSYS": "HORIZON"}, "HORIZON"),
    ):
        with refused("mask.fits", name):
            mask.read_mask(write_map(path, values, **keywords), NSIDE)
    with refused("nside", 12):
        mask.read_mask(write_map(path, half), 12)


def test_pixel_windows(tmp_path):
    path = tmp_path / "window.fits"

    def written(window: np.ndarray, nside: int | None = None) -> Path:
        table = fits.BinTableHDU.from_columns([fits.Column("TEMPERATURE", "D", array=window)])
        if nside is not None:
            table.header["NSIDE"] = nside
        table.writeto(path, overwrite=True)
        return path

    window = healpix.pixel_window(NSIDE, LMAX)
    for nside in (None, NSIDE):
        np.testing.assert_array_equal(healpix.read_pixel_window(written(window, nside), LMAX, NSIDE), window)
    for bad, nside in (
        (window, 2 * NSIDE),
        (window[2:], NSIDE),
        (window[:-1], NSIDE),
        (2.0 * window, NSIDE),
        (1.0 / window, NSIDE),
        (np.nan * window, NSIDE),
        (np.arange(LMAX + 1.0), NSIDE),
    ):
        with refused("window.fits"):
            healpix.read_pixel_window(written(bad, nside), LMAX, NSIDE)


def test_moments_that_no_memory_holds_are_refused() -> None:
    with refused("smax", 10**9, NSIDE, "nside", "GB"):
        scan.Moments.on_grid(MODEL, MapGrid(NSIDE), 10**9)
