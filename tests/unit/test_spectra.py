"""Power spectra: the three sources, and every way in which a table can be wrong."""

import gzip

import healpy
import numpy as np
import pytest
from astropy.io import fits

from mcsim.errors import InputError
from mcsim.sphere import spectra
from refusals import refused

CL = np.array([0.0, 0.0, 1200.0, 557.0, 310.5])


def write_fits(path, unit=None, name="TT", cl=CL):
    column = fits.Column(name=name, format="D", array=cl, unit=unit)
    fits.BinTableHDU.from_columns([column]).writeto(path)
    return path


@pytest.mark.parametrize(
    ("name", "quadrupole", "peak"),
    # D_2 and the first peak (height in uK^2, degree) of the tables that WMAP and Planck distribute. 1 % is the aim for
    # the published parameters (they are rounded); degree within 1, for the top is flat.
    [("wmap7", 1146.2, (5778.0, 220)), ("planck2018", 1017.0, (5729.0, 221))],
)
def test_packaged_tables_have_the_published_quadrupole_and_peak(name, quadrupole, peak):
    cl = spectra.load(name, 4096)
    ell = np.arange(4097)
    d_l = ell * (ell + 1) * cl / (2 * np.pi)
    assert cl[0] == cl[1] == 0.0
    assert d_l[2] == pytest.approx(quadrupole, rel=0.01)
    assert d_l[:400].max() == pytest.approx(peak[0], rel=0.01)
    assert abs(int(d_l[:400].argmax()) - peak[1]) <= 1
    # The damping tail: smooth, positive and falling, so that no row is lost or doubled.
    assert np.all(cl[2:] > 0.0)
    assert np.all(np.diff(cl[1500:]) < 0.0)


def test_text_table_in_any_order_with_comments_commas_and_no_monopole(tmp_path):
    path = tmp_path / "cl.dat"
    path.write_text("# ell, C_ell [uK^2]\n\n4, 310.5\n2, 1200\n3, 557\n")
    np.testing.assert_array_equal(spectra.load(path, 4), CL)
    np.testing.assert_array_equal(spectra.load(str(path), 2), CL[:3])


def test_text_table_with_monopole_and_dipole(tmp_path):
    path = tmp_path / "cl.txt"
    path.write_text("0 7\n1 8\n2 9\n")
    np.testing.assert_array_equal(spectra.load(path, 2), [7.0, 8.0, 9.0])


def test_text_with_a_mark_of_its_encoding(tmp_path):
    path = tmp_path / "cl.txt"
    path.write_text("2 1200\n3 557\n4 310.5\n", encoding="utf-8-sig")
    np.testing.assert_array_equal(spectra.load(path, 4), CL)


def test_compressed_text_table(tmp_path):
    path = tmp_path / "cl.txt.gz"
    path.write_bytes(gzip.compress(b"2 1200\n3 557\n4 310.5\n"))
    np.testing.assert_array_equal(spectra.load(path, 4), CL)


@pytest.mark.parametrize("name", ["cl.fits", "CL.FITS"])
def test_fits_as_healpy_reads_it(name, tmp_path):
    path = tmp_path / name
    healpy.write_cl(path, [CL, CL / 50, CL / 500, CL / 9], dtype=np.float64)
    np.testing.assert_array_equal(spectra.load(path, 4), healpy.read_cl(path)[0])


@pytest.mark.parametrize(
    ("unit", "factor"),
    [(None, 1.0), ("uK^2", 1.0), ("muK2", 1.0), ("uK_CMB^2", 1.0), ("uK**2", 1.0), ("mK^2", 1e6), ("K_CMB^2", 1e12)],
)
@pytest.mark.filterwarnings("ignore::astropy.units.UnitsWarning")  # FITS knows neither muK nor K_CMB
def test_fits_units(tmp_path, unit, factor):
    np.testing.assert_allclose(spectra.load(write_fits(tmp_path / "cl.fits", unit, cl=CL / factor), 4), CL, rtol=1e-15)


def test_ascii_table_of_fits(tmp_path):
    path = tmp_path / "cl.fits"
    column = fits.Column(name="TEMPERATURE", format="E24.15", array=CL, unit="uK^2", ascii=True)
    fits.TableHDU.from_columns([column]).writeto(path)
    np.testing.assert_allclose(spectra.load(path, 4), CL, rtol=1e-14)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", ("cl.txt", "rows")),
        ("# only a header\n", ("cl.txt", "rows")),
        ("2 1\n3 1\n5 1\n", ("ell = 4",)),
        ("3 1\n4 1\n5 1\n", ("ell = 2",)),
        ("2 1\n999999999999 1\n", ("ell = 3",)),
        ("2 1\n3 nan\n4 1\n", ("C_l", "nan", "l = 3")),
        ("2 1\n3 inf\n4 1\n", ("C_l", "inf", "l = 3")),
        ("2 1\n3 1\n4 -2.5\n", ("C_l", -2.5, "l = 4")),
        ("2 1\n3 1\n", ("l = 3", "lmax", 4)),
        ("2 1\n2 1\n3 1\n4 1\n", ("line 2", "'2 1'")),
        ("2 1\n2.5 1\n", ("line 2", "'2.5 1'")),
        ("-2 1\n", ("line 1", "'-2 1'")),
        ("nan 1\n", ("line 1", "'nan 1'")),
        ("inf 1\n", ("line 1", "'inf 1'")),
        ("ell cl\n2 1\n", ("line 1", "ell")),
        ("2 1000 3 4 5\n", ("line 1", "'2 1000 3 4 5'")),
        ("# ell D_ell\n2 1\n", ("D_l",)),
        ("# l Dl [uK^2]\n2 1\n", ("D_l",)),
        ("# l, l(l+1)C_l/2pi\n2 1\n", ("D_l",)),
    ],
)
def test_wrong_text_tables(tmp_path, text, named):
    path = tmp_path / "cl.txt"
    path.write_text(text)
    with refused(*named):
        spectra.load(path, 4)


def test_binary_rubbish_and_broken_compression(tmp_path):
    for name, contents in (
        ("cl.txt", b"\xff\xfe\x00"),
        ("cl.txt.gz", b"no gzip"),
        ("cl2.txt.gz", gzip.compress(b"2 1\n")[:-9]),
    ):
        path = tmp_path / name
        path.write_bytes(contents)
        with refused(path):
            spectra.load(path, 2)


@pytest.mark.parametrize("kept", [0, 100, 2880, 5000, 5760])
def test_truncated_fits(tmp_path, kept):
    path = write_fits(tmp_path / "cl.fits", "uK^2", cl=np.ones(4000))
    path.write_bytes(path.read_bytes()[:kept])
    with refused("cl.fits"):
        spectra.load(path, 4)


@pytest.mark.parametrize(
    ("unit", "name", "named"),
    [
        ("Jy^2", "TT", ("'Jy^2'", "uK^2")),
        ("uK", "TT", ("'uK'", "uK^2")),
        ("uK^2", "D_ELL", ("D_l",)),
        ("uK^2", "EE", ("EE", "TT")),
        ("uK^2", "GRADIENT", ("GRADIENT", "TT")),
    ],
)
def test_wrong_fits_columns(tmp_path, unit, name, named):
    with refused(*named):
        spectra.load(write_fits(tmp_path / "cl.fits", unit, name), 4)


ELL = np.arange(601)
LCDM = spectra.load("wmap7", 600)
D_L = ELL * (ELL + 1) * LCDM / (2 * np.pi)


def write_text(path, cl, header="", first=2):
    np.savetxt(path, np.column_stack([ELL[first : len(cl)], cl[first:]]), fmt=["%d", "%.9e"], header=header)
    return path


@pytest.mark.parametrize(
    ("header", "factor"),
    [
        ("", 1.0),
        ("ell C_ell", 1.0),
        ("ell C_ell [uK^2]", 1.0),
        ("ell TT, the first of TT TE EE BB", 1.0),
        ("l, C_l (uK_CMB^2)", 1.0),
        ("l, C_l (uK_{CMB}^2)", 1.0),
        ("l, C_l in uK thermodynamic**2", 1.0),
        ("l C_l / µK²", 1.0),
        ("l C_l [\\mu K^2]", 1.0),
        ("ell C_ell [mK^2]", 1e6),
        ("ell, C_ell in K**2", 1e12),
    ],
)
def test_units_of_text_tables(tmp_path, header, factor):
    found = spectra.load(write_text(tmp_path / "cl.txt", LCDM / factor, header), 600)
    np.testing.assert_allclose(found, LCDM, rtol=1e-8)


@pytest.mark.parametrize(
    ("table", "header", "named"),
    [
        (1e-12 * LCDM, "", ("uK^2", "TUNIT1")),
        (1e-12 * LCDM, "ell C_ell [uK^2]", ("uK^2", "TUNIT1")),
        (1e-6 * LCDM, "", ("uK^2", "TUNIT1")),
        (1e6 * LCDM, "", ("uK^2", "TUNIT1")),
        (LCDM, "ell C_ell [K^2]", ("uK^2", "TUNIT1")),
        (D_L, "", ("D_l",)),
        (D_L[:31], "", ("D_l",)),
        (1e-6 * D_L, "", ("D_l", "mK^2")),
        (LCDM, "l EE [uK^2]", ("EE", "TT")),
        (LCDM, "ell C_ell^TE", ("TE", "TT")),
        (LCDM, "l C_l^{EE} [uK^2]", ("EE", "TT")),
        (LCDM, "l C_l (TE)", ("TE", "TT")),
        (1e-12 * D_L, "", ("uK^2", "TUNIT1")),
        (LCDM, "l DlTT", ("D_l",)),
        (LCDM, "l D_l_TT", ("D_l",)),
        (LCDM, "l TT, dimensionless", ("dimensionless",)),
        (LCDM, "C_l in uK^2, was K^2", ("units",)),
        (LCDM, "C_l in uK_RJ^2", ("unit", "uK^2")),
        (LCDM, "C_l in mK antenna ^2", ("unit", "uK^2")),
    ],
)
def test_tables_in_other_units_or_of_d_l(tmp_path, table, header, named):
    path = write_text(tmp_path / "cl.txt", table, header)
    with refused(*named):
        spectra.load(path, 20)
    with pytest.raises(InputError):
        spectra.load(write_fits(tmp_path / "cl.fits", cl=table) if not header else path, 20)


@pytest.mark.parametrize(
    ("table", "header"),
    [
        (np.zeros(601), ""),
        (np.ones(601), ""),
        (100.0 + 0.0 * ELL, "ell C_ell [uK^2]"),
        (1e-4 + 0.0 * ELL, ""),
        (1e-3 * LCDM, "ell C_ell [uK^2]"),
        (10.0 * LCDM, ""),
        (LCDM * np.maximum(ELL, 1.0) ** 0.4, ""),
        (LCDM * np.maximum(ELL, 1.0) ** -1.0, ""),
        (1e5 * np.maximum(ELL, 1.0) ** -2.5, ""),
        (LCDM[:6], ""),
        (3e-6 * LCDM, "ell C_ell [uK^2]"),
        (1e-3 * np.maximum(ELL, 1.0) ** -0.5, "ell C_ell [uK^2]"),
    ],
)
def test_other_skies_are_accepted(tmp_path, table, header):
    found = spectra.load(write_text(tmp_path / "cl.txt", table, header), 5)
    np.testing.assert_allclose(found[2:], table[2:6], rtol=1e-8)


@pytest.mark.parametrize("table", [3e-6 * LCDM, 1e-3 * np.maximum(ELL, 1.0) ** -0.5], ids=["faint", "as D_l in mK^2"])
def test_what_states_its_unit_may_be_small(tmp_path, table):
    """Without a unit the first may be in mK^2 or K^2, and the second has the size of D_l in mK^2."""
    found = spectra.load(write_fits(tmp_path / "stated.fits", "uK^2", "C_ell", table), 20)
    np.testing.assert_allclose(found, table[:21])
    with refused(tmp_path / "silent.fits"):
        spectra.load(write_fits(tmp_path / "silent.fits", None, "TT", table), 20)


@pytest.mark.parametrize(("table", "header"), [(100.0 + 0.0 * ELL, ""), (D_L, "ell C_ell [uK^2]")])
def test_a_table_that_may_be_d_l_is_taken_with_a_warning(tmp_path, table, header):
    path = write_text(tmp_path / "cl.txt", table, header)
    with pytest.warns(UserWarning, match="D_l"):
        found = spectra.load(path, 5)
    np.testing.assert_allclose(found[2:], table[2:6], rtol=1e-8)


def test_fits_with_a_column_of_ell(tmp_path):
    for first in (0, 2):
        path = tmp_path / f"cl{first}.fits"
        columns = [
            fits.Column(name="ELL", format="J", array=ELL[first:]),
            fits.Column(name="TT", format="D", array=LCDM[first:] / 1e6, unit="mK^2"),
        ]
        fits.BinTableHDU.from_columns(columns).writeto(path)
        np.testing.assert_allclose(spectra.load(path, 600), LCDM, rtol=1e-12)


@pytest.mark.parametrize("rows", [[0, *range(2, 40)], range(39, -1, -1), range(2, 40, 2)], ids=["gap", "down", "even"])
def test_a_column_of_ell_is_not_taken_for_the_spectrum(tmp_path, rows):
    path = tmp_path / "cl.fits"
    columns = [
        fits.Column(name=name, format="D", array=values[list(rows)]) for name, values in (("Ell", ELL), ("TT", LCDM))
    ]
    fits.BinTableHDU.from_columns(columns).writeto(path)
    with refused("cl.fits", "Ell"):
        spectra.load(path, 15)


def test_fits_that_starts_at_the_quadrupole(tmp_path):
    with refused("ell = 2"):
        spectra.load(write_fits(tmp_path / "cl.fits", "uK^2", cl=LCDM[2:]), 20)


def test_lmax_is_whole():
    for lmax in (-3, 2.5):
        with refused("lmax"):
            spectra.load("wmap7", lmax)


def test_missing_file_lists_the_packaged_names(tmp_path):
    with refused("none.txt", "planck2018", "wmap7"):
        spectra.load(tmp_path / "none.txt", 4)
