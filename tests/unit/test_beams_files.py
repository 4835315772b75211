"""Beams from files of coefficients."""

from dataclasses import replace
from types import SimpleNamespace

import healpy
import numpy as np
import pytest
from astropy.io import fits

from mcsim.instrument.beams import Beam
from mcsim.sphere import alm as alm_
from refusals import refused


def write(path, beam: Beam, scale: float = 1.0):
    packed = np.zeros(healpy.Alm.getsize(beam.lmax, beam.mmax), dtype=complex)
    for m in range(beam.mmax + 1):
        start = alm_.start(beam.lmax, m)
        packed[start + m : start + beam.lmax + 1] = beam.blm[m, m:]
    healpy.write_alm(
        path,
        packed if scale == 1.0 else scale * packed,
        lmax=beam.lmax,
        mmax=beam.mmax,
        mmax_in=beam.mmax,
        out_dtype=np.float64,
    )
    return path


@pytest.fixture
def beam() -> Beam:
    return Beam.elliptical(60, 40, angle_deg=30, lmax=120, mmax=6)


def test_file_comes_back_normalised(tmp_path, beam) -> None:
    path = write(tmp_path / "beam.alm.fits", beam, scale=0.4945)
    read = Beam.from_blm(path, 120, 6)
    np.testing.assert_allclose(read.blm, beam.blm, rtol=0, atol=1e-15)
    assert read.integral == pytest.approx(0.4945, rel=1e-14)


def test_lower_lmax_and_chosen_mmax(tmp_path, beam) -> None:
    read = Beam.from_blm(write(tmp_path / "beam.alm.fits", beam), 80)
    expected = Beam.elliptical(60, 40, angle_deg=30, lmax=80)
    assert (read.lmax, read.mmax) == (80, expected.mmax)
    np.testing.assert_allclose(read.blm, expected.blm, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("lmax", "mmax", "named"),
    [
        (121, None, ("beam.alm.fits", "lmax", 120, 121)),
        (120, 7, ("beam.alm.fits", "mmax", 6, 7)),
        (5, 6, ("mmax", 6, "lmax", 5)),
        (0, None, ("lmax", 0)),
    ],
)
def test_more_than_the_file_holds_is_refused(tmp_path, beam, lmax, mmax, named) -> None:
    with refused(*named):
        Beam.from_blm(write(tmp_path / "beam.alm.fits", beam), lmax, mmax)


@pytest.mark.parametrize(
    ("index", "value", "named"),
    [
        ((0, 7), 0.5j, ("m = 0", "complex")),
        ((2, 9), complex(np.inf), ("finite",)),
        ((0, 0), complex(-1.0), ("positive",)),
        ((0, 0), 0j, ("positive",)),
        ((1, 100), complex(50.0), ("m = 0", "pole")),
    ],
)
def test_coefficients_that_are_no_beam_are_refused(tmp_path, beam, index, value, named) -> None:
    blm = beam.blm.copy()
    blm[index] = value
    path = write(tmp_path / "beam.alm.fits", SimpleNamespace(blm=blm, lmax=120, mmax=6))
    with refused(*named):
        Beam.from_blm(path, 120)


@pytest.mark.parametrize("power", [-0.5, 0.5])
def test_other_normalisation_in_l_is_refused(tmp_path, beam, power) -> None:
    path = write(tmp_path / "beam.alm.fits", Beam(beam.blm * (2.0 * np.arange(121) + 1.0) ** power))
    with refused("B_1", "B_0"):
        Beam.from_blm(path, 120)


def test_all_zero_file_is_refused(tmp_path, beam) -> None:
    with refused("m = 0", "pole"):
        Beam.from_blm(write(tmp_path / "beam.alm.fits", Beam(0 * beam.blm)), 120)


def test_a_saved_beam_that_is_not_normalised_is_refused(tmp_path, beam) -> None:
    replace(beam, blm=2.0 * beam.blm).save(tmp_path / "twice.npz")
    with refused("twice.npz", "b_00"):
        Beam.from_blm(tmp_path / "twice.npz")


def test_unreadable_files_are_refused(tmp_path, beam) -> None:
    whole = write(tmp_path / "beam.alm.fits", beam).read_bytes()
    (tmp_path / "truncated.fits").write_bytes(whole[:9000])
    (tmp_path / "text.fits").write_text("not a beam")
    fits.PrimaryHDU(np.ones((3, 3))).writeto(tmp_path / "image.fits")
    for name in ("truncated", "text", "image"):
        with refused(f"{name}.fits"):
            Beam.from_blm(tmp_path / f"{name}.fits", 100)
    with refused("absent.fits"):
        Beam.from_blm(tmp_path / "absent.fits", 100)


@pytest.mark.parametrize("columns", [0, 1, 2, 3])
def test_tables_that_hold_no_coefficients_say_what_they_lack(tmp_path, columns) -> None:
    """Maps and spectra have fewer columns, a polarised map as many."""
    path = tmp_path / "map.fits"
    healpy.write_map(path, np.ones((max(columns, 1), 12 * 4**2)), dtype=float)
    if not columns:
        fits.PrimaryHDU().writeto(path, overwrite=True)
    with refused("map.fits", "index", "real", "imaginary") as refusal:
        Beam.from_blm(path, 5)
    assert "list index" not in str(refusal.value)
    assert ({1: "1 of 3", 2: "2 of 3"}.get(columns, "")) in str(refusal.value)


@pytest.mark.parametrize("polarised", [0.0, 1.0])
def test_coefficients_of_a_polarised_beam_are_no_orders_of_one(polarised) -> None:
    """Three rows of healpy's order have the shape of [m, l] for m up to 2, and gave a circular beam."""
    lmax = 40
    own = Beam.elliptical(900.0, 600.0, lmax=lmax, mmax=4)
    temperature = np.zeros(healpy.Alm.getsize(lmax), dtype=complex)
    ell, m = healpy.Alm.getlm(lmax)
    inside = m <= own.mmax
    temperature[inside] = own.blm[m[inside], ell[inside]]
    other = polarised * np.where((ell < 2) | (m == 1), 0.0, temperature)
    with refused("3, 861", "l = 40"):
        Beam.from_blm(np.stack([temperature, other, -1j * other]))
    assert Beam.from_blm(temperature).mmax == own.mmax


@pytest.mark.parametrize("lmax", [14, 35, 299])
def test_orders_of_a_round_beam_are_no_polarised_one(lmax) -> None:
    """Up to a degree for which healpy's order would have as many places."""
    own = Beam.gaussian(600.0, lmax)
    padded = np.concatenate([own.blm, np.zeros((2, lmax + 1))])
    np.testing.assert_allclose(Beam.from_blm(padded).blm[0], own.blm[0], rtol=1e-12)


@pytest.mark.parametrize(
    ("rows", "named"),
    [(slice(None, -7), (819, 826)), (slice(120, None), (706, 826)), (np.r_[0:826, 5], (827, 826))],
)
def test_a_file_that_lacks_rows_or_has_some_twice(tmp_path, beam, rows, named) -> None:
    """Without the last seven coefficients it was read as of lmax = 119, every order above the first out of place."""
    path = write(tmp_path / "beam.alm.fits", beam)
    with fits.open(path) as hdus:
        data = hdus[1].data[rows].copy()
    fits.BinTableHDU(data).writeto(path, overwrite=True)
    with refused(path, *named):
        Beam.from_blm(path)


def test_coefficients_that_count_from_zero_are_refused_by_it(tmp_path, beam) -> None:
    path = write(tmp_path / "beam.alm.fits", beam)
    with fits.open(path) as hdus:
        data = hdus[1].data.copy()
    data["index"] -= 1
    fits.BinTableHDU(data).writeto(path, overwrite=True)
    with refused(path, "index", 0):
        Beam.from_blm(path)
