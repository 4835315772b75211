"""Beam maps: known beams drawn into FITS images come back as their known coefficients."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from harmonics import legendre
from mcsim import config
from mcsim.instrument.beams import Beam, BeamMap, blm_of_map, find_centre, read_map
from mcsim.plot.look import look_at_beams
from mcsim.simulation.channels import load_beam, load_beam_map
from refusals import refused

PIXEL_DEG = 0.04
PIXEL = np.radians(PIXEL_DEG)
SIGMA_PER_FWHM = 1 / np.sqrt(8 * np.log(2))


def spherical_harmonics(lmax: int, m: int, theta: float, phi: float) -> np.ndarray:
    """Y_lm(theta, phi) for l = 0..lmax."""
    return legendre(lmax, m, np.array([theta]))[:, 0] * np.exp(1j * m * phi)


def directions(size: int, centre: tuple[float, float], projection: str = "equidistant"):
    """Theta and phi of the pixels of a square map about a centre (column, row)."""
    x = (np.arange(size) - centre[0])[None, :] * PIXEL
    y = (np.arange(size) - centre[1])[:, None] * PIXEL
    radius = np.hypot(x, y)
    theta = {"equidistant": radius, "orthographic": np.arcsin(radius), "equal_area": 2 * np.arcsin(radius / 2)}
    return theta[projection], np.arctan2(y, x)


def ellipse(theta, phi, major=13.9, minor=12.7, angle_deg=25.0):
    """The beam that :func:`elliptical_gaussian` is the transform of."""
    sigma_major, sigma_minor = np.radians(np.array([major, minor]) / 60) * SIGMA_PER_FWHM
    phi = phi - np.radians(angle_deg)
    exponent = (theta * np.cos(phi) / sigma_major) ** 2 + (theta * np.sin(phi) / sigma_minor) ** 2
    return np.exp(-exponent / 2) / np.sqrt(np.sinc(theta / np.pi))


def lobe(theta, phi, fwhm, at_theta=0.0, at_phi=0.0):
    """A Gaussian with B_l = exp(-l(l+1) sigma^2 / 2) and unit integral, centred anywhere on the sphere."""
    sigma = np.radians(fwhm / 60) * SIGMA_PER_FWHM
    # Half the chord, not the cosine: no digits are lost at small separations.
    square = np.sin((theta - at_theta) / 2) ** 2 + np.sin(theta) * np.sin(at_theta) * np.sin((phi - at_phi) / 2) ** 2
    separation = 2 * np.arcsin(np.sqrt(square))
    beam = np.exp(-(separation**2) / (2 * sigma**2)) / np.sqrt(np.sinc(separation / np.pi))
    # sigma^2/8 from kappa^2 = l(l+1) + 1/3 - m^2/3 at l = m = 0: exp(-sigma^2/6) is the integral over 2 pi sigma^2.
    return beam / (2 * np.pi * sigma**2 * np.exp(-(sigma**2) / 6))


def lobe_blm(lmax, mmax, fwhm, at_theta=0.0, at_phi=0.0):
    ell = np.arange(lmax + 1)
    window = np.exp(-ell * (ell + 1) * (np.radians(fwhm / 60) * SIGMA_PER_FWHM) ** 2 / 2)
    return window * np.array([spherical_harmonics(lmax, m, at_theta, at_phi).conj() for m in range(mmax + 1)])


def write(path, image, pixel_deg=PIXEL_DEG, **header):
    hdu = fits.PrimaryHDU(image)
    if pixel_deg is not None:
        hdu.header["CDELT1"] = hdu.header["CDELT2"] = pixel_deg
    for key, value in header.items():
        hdu.header[key] = value
    hdu.writeto(path)
    return path


def relative(blm, expected):
    """Largest difference over the largest coefficient of the beam."""
    return np.abs(blm - expected).max() / np.abs(expected).max()


@pytest.mark.parametrize("projection", ["equidistant", "orthographic", "equal_area"])
def test_elliptical_gaussian_map_gives_the_closed_form(tmp_path, projection) -> None:
    theta, phi = directions(200, (98.3, 101.6), projection)
    path = write(tmp_path / "beam.fits", ellipse(theta, phi))
    beam = Beam.from_map(read_map(path, projection=projection, centre=(98.3, 101.6)), 1024, 6)
    expected = Beam.elliptical(13.9, 12.7, angle_deg=25.0, lmax=1024, mmax=6)
    # What is left is the closed form's error, 2e-11 of the order; no pixel effect at 5 pixels per FWHM.
    assert relative(beam.blm, expected.blm) < 1e-10
    for m in (2, 4):
        assert relative(beam.blm[m], expected.blm[m]) < 1e-9


def test_centre_is_column_and_row(tmp_path) -> None:
    # A circular beam at column 50, row 25 of a map that is wider than it is high.
    x, y = (np.arange(81) - 50)[None, :] * PIXEL, (np.arange(61) - 25)[:, None] * PIXEL
    theta, phi = np.hypot(x, y), np.arctan2(y, x)
    path = write(tmp_path / "beam.fits", ellipse(theta, phi, 10, 10))
    found = read_map(path)
    assert found.centre == pytest.approx((50, 25), abs=1e-4)
    given = Beam.from_map(path, 200, 2, centre=(50, 25))
    assert np.abs(given.blm[1, 20]) < 1e-10 * given.blm[0, 20].real
    # So in a run's configuration, whose key is centre_pixel.
    channel = {"kind": "map", "path": str(path), "centre_pixel": (50.0, 25.0)}
    np.testing.assert_array_equal(load_beam_map("W1", config.BeamMap(**channel)).centre, (50, 25))
    with refused("(column, row)"):
        read_map(path, centre=(25, 50))
    with refused("(column, row)"):
        read_map(path, centre=(25, 70))


def test_wrong_projection_is_seen_in_a_wide_beam(tmp_path) -> None:
    theta, phi = directions(240, (120, 120))
    path = write(tmp_path / "beam.fits", ellipse(theta, phi, 120, 90))
    expected = Beam.elliptical(120, 90, angle_deg=25.0, lmax=200, mmax=2).blm
    assert relative(Beam.from_map(path, 200, 2, cut_deg=4.5).blm, expected) < 1e-6
    assert relative(Beam.from_map(read_map(path, cut_deg=4.5, projection="orthographic"), 200, 2).blm, expected) > 1e-4


def test_comatic_beam_has_its_odd_orders_and_imaginary_parts(tmp_path) -> None:
    # A main lobe, a positive lobe at 0.5 deg and a negative one at 0.7 deg elsewhere: every order, complex.
    first, second = (np.radians(0.5), 0.7), (np.radians(0.7), -2.0)
    theta, phi = directions(220, (109.25, 110.5))
    image = lobe(theta, phi, 14) + 0.2 * lobe(theta, phi, 20, *first) - 0.05 * lobe(theta, phi, 16, *second)
    blm = lobe_blm(1024, 8, 14) + 0.2 * lobe_blm(1024, 8, 20, *first) - 0.05 * lobe_blm(1024, 8, 16, *second)
    path = write(tmp_path / "beam.fits", 3.0 * image)
    beam = Beam.from_map(path, 1024, 8, centre=(109.25, 110.5))
    assert beam.integral == pytest.approx(3.0 * 1.15, rel=1e-9)
    for m in range(9):
        assert np.abs(beam.blm[m].imag).max() > (1e-3 if m else -1)
        # The lobes' own closed form holds to 1e-11.
        assert np.abs(beam.blm[m] * 1.15 - blm[m]).max() < 1e-9 * np.abs(blm).max()


def test_sum_over_pixels_is_the_sum_of_harmonics() -> None:
    rng = np.random.default_rng(11)
    image = rng.standard_normal((12, 15))
    pixel, centre, lmax, mmax = np.radians(1.0), (5.2, 7.7), 40, 5
    blm = blm_of_map(BeamMap(image, pixel, centre, np.radians(5.0)), lmax, mmax)
    expected = np.zeros((mmax + 1, lmax + 1), dtype=complex)
    for row in range(12):
        for column in range(15):
            x, y = (column - centre[0]) * pixel, (row - centre[1]) * pixel
            radius = np.hypot(x, y)
            if radius <= np.radians(5.0):
                area = pixel**2 * np.sin(radius) / radius
                for m in range(mmax + 1):
                    harmonic = spherical_harmonics(lmax, m, radius, np.arctan2(y, x))
                    expected[m] += image[row, column] * area * harmonic.conj()
    # epsilon of the transform is 1e-12 of the largest.
    np.testing.assert_allclose(blm, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("width", "centre"),
    [
        # A peak that the 15 pixels of the centroid hold whole: the centre is found.
        (7.0, None),
        # With wings beyond them a centroid over a square depends on how the beam lies in it: the centre is given.
        (16.0, (119.5, 121.3)),
    ],
)
def test_rotated_map_turns_the_phases(tmp_path, width, centre) -> None:
    # Asymmetric, with a negative lobe, drawn once upright and once turned from x towards y by 37 deg.
    angle = np.radians(37.0)
    beams = []
    for turn in (0.0, angle):
        theta, phi = directions(240, (119.5, 121.3))
        phi = phi - turn
        image = ellipse(theta, phi, width, 0.7 * width, 20)
        for strength, at_theta, at_phi in ((6e-7, 0.02, 2.0), (-8e-7, 0.025, -1.0)):
            image += strength * lobe(theta, phi, 15, at_theta, at_phi)
        beams.append(Beam.from_map(write(tmp_path / f"beam{turn:.2f}.fits", image), 1024, 8, centre=centre))
    upright, turned = beams
    for m in range(9):
        largest = np.abs(upright.blm[m]).max()
        assert largest > 1e-4
        expected = upright.blm[m] * np.exp(-1j * m * angle)
        np.testing.assert_allclose(turned.blm[m], expected, rtol=0, atol=1e-3 * largest)


@pytest.mark.parametrize("shift", [(0, 0), (-13, 21), (0.5, 0.25)])
def test_beam_does_not_depend_on_where_it_lies_in_the_map(tmp_path, shift) -> None:
    # 15 pixels hold this peak whole, so that the centroid is exact; at 2.3 pixels per FWHM the sum over pixels has the
    # alias exp(-(2 pi / pixel - lmax)^2 sigma^2 / 2) = 3e-7.
    theta, phi = directions(200, (99 + shift[0], 98 + shift[1]))
    path = write(tmp_path / "beam.fits", ellipse(theta, phi, 6, 5.5))
    beam_map = read_map(path, cut_deg=2.0)
    assert beam_map.centre == pytest.approx((99 + shift[0], 98 + shift[1]), abs=1e-6)
    expected = Beam.elliptical(6, 5.5, angle_deg=25, lmax=1024, mmax=4)
    assert relative(Beam.from_map(beam_map, 1024, 4).blm, expected.blm) < 3e-7


def test_centroid_is_over_fifteen_pixels() -> None:
    image = np.zeros((41, 41))
    image[20, 20] = 1.0
    image[20, 27] = 0.5
    image[28, 20] = 0.5
    assert find_centre(image) == pytest.approx((20 + 7 / 3, 20))


def test_negative_sidelobes_are_kept_and_the_cut_is_applied(tmp_path) -> None:
    image = np.zeros((101, 101))
    image[50, 50], image[50, 75], image[90, 50] = 1.0, -0.25, 9.0e-3
    path = write(tmp_path / "beam.fits", image)
    wide, narrow = (
        Beam.from_map(path, 50, 2, cut_deg=1.2, centre=(50, 50)),
        Beam.from_map(path, 50, 2, cut_deg=0.9, centre=(50, 50)),
    )
    assert wide.integral == pytest.approx(0.75 * PIXEL**2, rel=1e-4)
    assert narrow.integral == pytest.approx(PIXEL**2, rel=1e-12)


def test_pixel_means_are_restored(tmp_path) -> None:
    # Means over the pixels by 6 x 6 Gauss-Legendre points; without the correction 4 % of B_l is missing at l = 1024.
    node, weight = np.polynomial.legendre.leggauss(6)
    mean = 0.0
    for y, weight_y in zip(node / 2, weight / 2, strict=True):
        for x, weight_x in zip(node / 2, weight / 2, strict=True):
            theta, phi = directions(160, (79.3 - x, 80.1 - y))
            mean = mean + weight_y * weight_x * ellipse(theta, phi)
    path = write(tmp_path / "beam.fits", mean)
    expected = Beam.elliptical(13.9, 12.7, angle_deg=25.0, lmax=1024, mmax=4).blm
    restored = read_map(path, centre=(79.3, 80.1)).without_pixel_window()
    assert relative(Beam.from_map(restored, 1024, 4).blm, expected) < 1e-6
    assert relative(Beam.from_map(path, 1024, 4, centre=(79.3, 80.1)).blm, expected) > 1e-3


def test_mmax_is_chosen_and_the_rest_reported(tmp_path) -> None:
    theta, phi = directions(160, (80, 80))
    path = write(tmp_path / "beam.fits", ellipse(theta, phi, 20, 12))
    closed = Beam.elliptical(20, 12, angle_deg=25, lmax=1024)
    beam = Beam.from_map(path, 1024)
    assert beam.mmax == closed.mmax == 4
    assert beam.neglected_power == pytest.approx(closed.neglected_power, rel=1e-6)


def test_a_coarse_map_has_as_many_degrees_as_its_pixels_resolve() -> None:
    """Half a degree: a wave of two pixels is l = 360."""
    theta, phi = directions(61, (30, 30))
    assert Beam.from_map(ellipse(theta, phi), pixel_deg=0.5).lmax == 360


def test_plane_of_a_cube_and_given_pixel(tmp_path) -> None:
    theta, phi = directions(100, (50, 50))
    cube = np.stack([ellipse(theta, phi), np.ones_like(theta), ellipse(theta, phi, 20, 12)])
    path = write(tmp_path / "cube.fits", cube, pixel_deg=None)
    beam = Beam.from_map(read_map(path, pixel_deg=PIXEL_DEG, plane=2), 500, 2)
    assert relative(beam.blm, Beam.elliptical(20, 12, angle_deg=25, lmax=500, mmax=2).blm) < 1e-6


def test_logarithmic_map_is_refused(tmp_path) -> None:
    theta, phi = directions(100, (50, 50))
    path = write(tmp_path / "beam.fits", 60.0 + 10.0 * np.log10(ellipse(theta, phi) + 1e-6))
    fits.setval(path, "BUNIT", value="dBi")
    with refused("beam.fits", "dBi"):
        read_map(path)


def small_image() -> np.ndarray:
    theta, phi = directions(40, (20, 20))
    return ellipse(theta, phi)


@pytest.mark.parametrize(
    ("change", "options", "named"),
    [
        ("none", {"lmax": 100, "mmax": 101}, ("mmax", 101)),
        ("none", {"lmax": 5000}, ("lmax", 5000, 4500)),
        ("none", {"cut_deg": 0.0}, ("cut_deg", 0.0)),
        ("none", {"cut_deg": 0.05}, ("cut_deg", 0.05)),
        ("none", {"cut_deg": 120.0}, ("cut_deg", 120.0, 90)),
        ("none", {"projection": "mercator"}, ("projection", "mercator")),
        ("none", {"centre": (50.0, 20.0)}, ("centre", "(50.0, 20.0)")),
        ("none", {"pixel_deg": -0.04}, ("pixel", -0.04)),
        ("nan", {}, ("beam.fits", 1, "finite")),
        ("zero", {}, ("beam.fits", "positive")),
        ("negative", {}, ("beam.fits", "positive")),
        ("negative total", {}, ("positive",)),
        ("edge", {}, ("beam.fits", 8, "(24, 40)")),
        ("empty inside", {"centre": (3.0, 3.0), "cut_deg": 0.1}, ("zero", 0.1)),
    ],
)
def test_unusable_map_is_refused(tmp_path, change, options, named) -> None:
    image, options = small_image(), dict(options)
    if change == "nan":
        image[3, 3] = np.nan
    elif change == "zero":
        image *= 0
    elif change == "negative":
        image *= -1
    elif change == "negative total":
        image[0, :] = -100
    elif change == "edge":
        image = image[16:]
    elif change == "empty inside":
        image[:10, :10] = 0
    path = write(tmp_path / "beam.fits", image)
    degrees = {key: options.pop(key) for key in ("lmax", "mmax") if key in options}
    with refused(*named):
        Beam.from_map(read_map(path, **options), **{"lmax": 100, **degrees})


@pytest.mark.parametrize("share", [0.9, 1.0])
def test_a_map_whose_negative_response_cancels_the_positive_is_refused(share) -> None:
    offset = 0.1 * (np.arange(81) - 40)
    image = np.exp(-np.add.outer(offset**2, offset**2) / 2)
    inside = np.hypot(*np.meshgrid(offset, offset)) < 3.5
    image[inside] -= share * image[inside].mean()
    with refused("B_l", "l = ", 2.0):
        Beam.from_map(image, 64, pixel_deg=0.1)


def test_a_map_with_as_much_negative_response_as_wmap_s_is_kept() -> None:
    offset = 0.1 * (np.arange(81) - 40)
    image = np.exp(-np.add.outer(offset**2, offset**2) / 2)
    inside = np.hypot(*np.meshgrid(offset, offset)) < 3.5
    image[inside] -= 0.1 * image[inside].mean()
    assert np.abs(Beam.from_map(image, 64, pixel_deg=0.1).window).max() == pytest.approx(1.0)


def test_steps_in_a_matrix_are_those_of_the_pixels(tmp_path) -> None:
    """astropy writes a matrix CD as PC beside CDELT = 1, which made pixels of a degree of any."""
    wcs = WCS(naxis=2)
    wcs.wcs.cd, wcs.wcs.cunit = np.diag([0.04, 0.04]), ["deg", "deg"]
    written = wcs.to_header()
    assert (written["CDELT1"], written["PC1_1"]) == (1.0, 0.04)
    for name, header in [
        ("plain.fits", {"CDELT1": 0.04, "CDELT2": 0.04}),
        ("pc.fits", dict(written)),
        ("cd.fits", {"CD1_1": 0.04, "CD2_2": 0.04}),
        ("both.fits", {"CDELT1": 1.0, "CDELT2": 1.0, "CD1_1": 0.04, "CD2_2": 0.04}),
    ]:
        found = read_map(write(tmp_path / name, small_image(), pixel_deg=None, **header))
        assert found.pixel_rad == pytest.approx(np.radians(0.04), rel=1e-12)


def test_unusable_headers_are_refused(tmp_path) -> None:
    image = small_image()
    bare = write(tmp_path / "bare.fits", image, pixel_deg=None)
    oblong = write(tmp_path / "oblong.fits", image, CDELT2=0.05)
    mirrored = write(tmp_path / "mirrored.fits", image, CDELT1=-0.04)
    radians = write(tmp_path / "radians.fits", image, CUNIT1="rad")
    turned = write(tmp_path / "turned.fits", image, CROTA2=30.0)
    matrix = write(tmp_path / "matrix.fits", image, PC1_2=-0.5, PC2_1=0.5)
    flipped = write(tmp_path / "flipped.fits", image, PC1_1=-1.0)
    cube = write(tmp_path / "cube.fits", np.stack([image, image]))
    line = write(tmp_path / "line.fits", image[20])
    for path, named in [
        (bare, ("bare.fits", "CDELT1", "CDELT2", "pixel_deg")),
        (oblong, ("oblong.fits", 0.04, 0.05)),
        (mirrored, ("mirrored.fits", -0.04, 0.04)),
        (radians, ("radians.fits", "CUNIT1", "rad")),
        (turned, ("turned.fits", "CROTA2", 30.0, "pixel_deg")),
        (matrix, ("matrix.fits", "PC1_2", -0.5, "pixel_deg")),
        (flipped, ("flipped.fits", -0.04, 0.04)),
        (line, ("line.fits", 1)),
        (tmp_path / "absent.fits", ("absent.fits",)),
    ]:
        with refused(*named):
            Beam.from_map(path, 100)
    with refused("cube.fits", "plane", 2, 0, 1):
        read_map(cube, plane=2)
    np.save(tmp_path / "single.npy", image)
    for single in (write(tmp_path / "single.fits", image), tmp_path / "single.npy"):
        with refused(single, "plane", 2, 0):
            read_map(single, plane=2, pixel_deg=0.05)


def test_steps_in_radians_without_a_unit_are_asked_about(tmp_path) -> None:
    """Read as degrees they made a beam of 30' one of half an arcmin."""
    step = np.radians(0.04)
    with refused("steps.fits", f"{step:g}", "CUNIT1", "pixel_deg", 0.04):
        read_map(write(tmp_path / "steps.fits", small_image(), pixel_deg=step))
    assert read_map(write(tmp_path / "said.fits", small_image(), pixel_deg=step, CUNIT1="deg")).pixel_rad < 1e-4
    assert read_map(tmp_path / "steps.fits", pixel_deg=0.04).pixel_rad == pytest.approx(step)


def test_wide_beams_with_steps_in_radians_without_a_unit_are_told_of(tmp_path) -> None:
    """One of 2.6 degrees was one of 2.7 arcmin, without a word; whether it may be is known by the maps alone."""
    step = 12.0 * np.radians(0.04)
    bare, said = (write(tmp_path / f"{name}.fits", small_image(), pixel_deg=step, **unit)
                  for name, unit in (("bare", {}), ("said", {"CUNIT1": "deg"})))  # fmt: skip
    spec = config.BeamMap(path=str(bare))
    with pytest.warns(UserWarning, match="CUNIT1.*lmax = 200.*pixel_deg"):
        load_beam_map("W1", spec, 200)
    for unambiguous in (spec, replace(spec, pixel_deg=0.48), replace(spec, path=str(said))):
        load_beam_map("W1", unambiguous, 900 if unambiguous is spec else 200)


def test_a_beam_that_is_cut_where_it_is_not_over_is_told_of(tmp_path) -> None:
    """One of 4 degrees lost an eighth of its solid angle by the default of cut_deg, without a word."""
    theta, phi = directions(261, (130.0, 130.0))
    path = write(tmp_path / "wide.fits", lobe(theta, phi, 120.0), pixel_deg=0.08, CUNIT1="deg")
    channel = config.load("tiny").channels[0]
    said = pytest.warns(UserWarning, match=r"channel\[demo\].*cut_deg = 3.5")
    for cut_deg, told in ((3.5, said), (9.0, nullcontext())):
        with told:
            load_beam(replace(channel, beam=config.BeamMap(path=str(path), cut_deg=cut_deg)), 40)


def test_truncated_empty_and_foreign_files_are_refused(tmp_path) -> None:
    whole = write(tmp_path / "whole.fits", small_image()).read_bytes()
    (tmp_path / "truncated.fits").write_bytes(whole[:6000])
    (tmp_path / "text.fits").write_text("not a beam")
    fits.HDUList([fits.PrimaryHDU()]).writeto(tmp_path / "empty.fits")
    for name in ("truncated", "text", "empty"):
        with refused(f"{name}.fits"):
            Beam.from_map(tmp_path / f"{name}.fits", 100)
    with refused("text.fits", ".npy") as foreign:
        Beam.from_map(tmp_path / "text.fits", 100)
    assert "(it is no FITS file)" in str(foreign.value)
    with refused("text.fits", ".txt"):
        list(look_at_beams(tmp_path / "text.fits"))
