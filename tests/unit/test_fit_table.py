"""Tables of measured spectra: what they may leave open, and what they may not."""

import warnings

import numpy as np
import pytest
from astropy.table import Table

from mcsim.beamfit import Selection, read_table
from mcsim.bipolar import Mode, bennett_factor
from refusals import refused

META = {"normalisation": "Bennett", "scaling": "l(l+1)/2pi", "frame": "ecliptic"}


def table(meta=META, unit="uK2", **columns):
    base = {
        "L": [2, 2, 2],
        "M": [0, 0, 0],
        "d": [0, 0, 2],
        "ell_min": [10, 20, 10],
        "ell_max": [19, 29, 19],
        "value": [1.0, 2.0, 3.0],
        "error": [0.1, 0.2, 0.3],
    }
    made = Table({name: column for name, column in (base | columns).items() if column is not None}, meta=meta)
    for name in made.colnames:
        if name.startswith(("value", "error")) and unit is not None:
            made[name].unit = unit
    return made


def read(tmp_path, made, **arguments):
    path = tmp_path / "table.ecsv"
    made.write(path, format="ascii.ecsv", overwrite=True)
    return read_table(path, "ecliptic", Selection(**arguments))


def test_rows_values_and_independent_errors(tmp_path):
    found = read(tmp_path, table())
    assert [(row.mode.name, row.ell_min, row.ell_max, row.imaginary) for row in found.rows] == [
        ("L2M0d0", 10, 19, False),
        ("L2M0d0", 20, 29, False),
        ("L2M0d2", 10, 19, False),
    ]
    np.testing.assert_array_equal(found.value, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(found.covariance, np.diag([0.01, 0.04, 0.09]))
    assert (found.simulations, found.kind, found.pair) == (None, "plain", None)


def test_the_header_says_where_the_maps_end(tmp_path):
    assert read(tmp_path, table()).highest is None
    assert read(tmp_path, table(META | {"lmax": 40})).highest == 40
    with refused("lmax", "40.5"):
        read(tmp_path, table(META | {"lmax": 40.5}))


def test_complex_values_are_refused(tmp_path):
    made = table(value=[1.0 + 1.0j, 2.0, 3.0])
    with warnings.catch_warnings(), refused("table.ecsv", "value", "value_imag"):
        warnings.simplefilter("ignore")  # astropy's: the format has no complex numbers
        read(tmp_path, made)


def test_errors_of_few_realizations_are_no_known_errors(tmp_path):
    """They scatter, and a table lacks their correlations: the pulls of a fit to 5 skies had an rms of 2."""
    with refused("table.ecsv", 5, 3, "--covariance"):
        read(tmp_path, table(META | {"realizations": 5}))
    with pytest.warns(UserWarning, match="6 realizations"):
        assert read(tmp_path, table(META | {"realizations": 6})).count == 6
    assert read(tmp_path, table(META | {"realizations": 5, "prediction": "leading order"})).count == 5
    assert read(tmp_path, table()).count == 1
    with refused("table.ecsv", "few"):
        read(tmp_path, table(META | {"realizations": "few"}))


def test_parts_have_their_own_errors_or_share_that_of_the_modulus(tmp_path):
    complex_ = {"M": [1, 1, 1], "value_imag": [0.1, 0.2, 0.3]}
    chosen = {"modes": ["L2M1d0"]}
    found = read(tmp_path, table(d=[0, 0, 0], ell_max=[19, 29, 9], ell_min=[10, 20, 0], **complex_), **chosen)
    np.testing.assert_allclose(np.diag(found.covariance), 0.5 * np.array([0.01, 0.04, 0.09] * 2))
    own = complex_ | {"error_real": [0.06, 0.1, 0.1], "error_imag": [0.08, 0.2, 0.3]}
    found = read(tmp_path, table(d=[0, 0, 0], ell_max=[19, 29, 9], ell_min=[10, 20, 0], **own), **chosen)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), [0.06, 0.1, 0.1, 0.08, 0.2, 0.3])


def test_units_are_converted(tmp_path):
    np.testing.assert_allclose(read(tmp_path, table(unit="mK2")).value, [1e6, 2e6, 3e6])


@pytest.mark.parametrize("name", ["l(l+1)/2pi", "l(l+1)/(2π)", "ell(ell+1) / 2 pi A, mean over bins", "none"])
@pytest.mark.parametrize("normalisation", ["Bennett", "WMAP", "Hajian-Souradeep"])
def test_scalings(tmp_path, name, normalisation):
    scaling = read(tmp_path, table(META | {"scaling": name, "normalisation": normalisation})).scaling
    mode, ell = Mode(2, 0, 0), np.arange(31.0)
    expected = np.ones(31) if name == "none" else ell * (ell + 1.0) / (2.0 * np.pi)
    if normalisation != "Hajian-Souradeep":
        expected = expected * bennett_factor(mode, 30)
    np.testing.assert_allclose(scaling.factor(mode, 30), expected)


def test_choice_of_modes_range_kind_and_pair(tmp_path):
    made = table(value_difference=[4.0, 5.0, 6.0], error_difference=[0.4, 0.5, 0.6], pair=["W1,W1", "W1,W1", "V1,V1"])
    assert read(tmp_path, made).value.tolist() == [4.0, 5.0]
    assert read(tmp_path, made, kind="plain", ell_range=(15, 40)).value.tolist() == [2.0]
    assert read(tmp_path, made, pair="V1,V1", modes=["L2M0d2"]).value.tolist() == [6.0]


def test_a_table_without_pairs_is_of_the_pair_that_is_named(tmp_path):
    found = read(tmp_path, table(), pair="V1,W1")
    assert (found.pair, len(found.value)) == ("V1,W1", 3)


def test_parts_of_complex_modes_share_the_variance(tmp_path):
    made = table(M=[1, 0, 0], value_imag=[7.0, 0.0, 0.0])
    found = read(tmp_path, made, modes=["L2M1d0"])
    assert found.value.tolist() == [1.0, 7.0]
    assert [row.imaginary for row in found.rows] == [False, True]
    np.testing.assert_allclose(np.diag(found.covariance), 0.5 * 0.1**2)


@pytest.mark.parametrize(
    ("made", "arguments", "named"),
    [
        (table(META | {"normalisation": ""}), {}, ("normalisation", "Bennett")),
        (table(META | {"normalisation": "unity"}), {}, ("unity", "Bennett")),
        (table(META | {"scaling": "l^2"}), {}, ("scaling", "'l^2'")),
        (table(META | {"scaling": "l(l+1)/2pi * 1e12"}), {}, ("scaling", "l(l+1)/2pi * 1e12")),
        (table(META | {"scaling": "l(l+1)/2pi/sqrt(2L+1)"}), {}, ("scaling", "l(l+1)/2pi/sqrt(2l+1)")),
        (table({"normalisation": "Bennett"}), {}, ("scaling ''",)),
        (table(META | {"frame": "galactic"}), {}, ("galactic", "ecliptic")),
        (table(unit=None), {}, ("value", "unit", "uK2")),
        (table(unit="K"), {}, ("value", "K", "uK2")),
        (table(ell_min=None), {}, ("table.ecsv", "ell_min", "ell_max", "error")),
        (table(error=None), {}, ("table.ecsv", "error")),
        (table(error=[0.1, 0.0, 0.1]), {}, ("L2M0d0", "20-29", 2, 0)),
        (table(value=[np.nan, 0.0, 0.1]), {}, ("L2M0d0", "10-19", "nan")),
        (table(ell_min=[10, 10, 10], ell_max=[19, 19, 19]), {}, ("twice",)),
        (table(ell_min=[10, 40, 10]), {}, ("ell_min", 40, "ell_max", 29)),
        (table(), {"modes": ["L1M0d1"]}, ("L1M0d1",)),
        (table(), {"modes": ["L2M3d0"]}, ("L2M3d0",)),
        (table(), {"modes": ["quadrupole"]}, ("quadrupole", "L2M0d0")),
        (table(), {"kind": "difference"}, ("value_difference",)),
        (table(pair=["a,a", "a,a", "b,b"]), {"pair": "c,c"}, ("c,c", "a,a", "b,b")),
        (table(value_imag=[0.0, 0.0, 0.0], d=[1, 0, 0]), {"modes": ["L2M0d1"]}, ("L2M0d1", "parity", "Bennett")),
        (table(M=[1, 0, 0]), {"modes": ["L2M1d0"]}, ("value_imag",)),
        (table(ell_min=[10.5, 20.0, 10.0]), {}, ("ell_min", "integers")),
        (table(ell_max=[np.nan, 29.0, 19.0]), {}, ("ell_max", "integers")),
        (table(L=["two", "2", "2"]), {}, ("L", "integers")),
        (table(L=np.ma.array([2, 2, 2], mask=[True, False, False])), {}, ("L", "integers")),
        (table(ell_min=[-5, 20, 10]), {}, ("ell_min", -5, "ell_max", 19)),
        (table(value=[0.1, 0.2, 0.3], error=[-1.0, -2.0, -3.0]), {}, ("L2M0d0", "10-19", -1)),
        (table(error=[np.inf, 0.2, 0.3]), {}, ("L2M0d0", "10-19", "inf")),
        (table(value=np.ma.array([1.0, 2.0, 3.0], mask=[True, False, False])), {}, ("L2M0d0", "10-19", "nan")),
        (table(value=["1.5", "b", "c"]), {}, ("value", "'b'", "row 2", "number", "uK2")),
        (table(error=["0.1", "0.2", "0.3 uK2"]), {}, ("error", "'0.3 uK2'", "row 3", "number")),
        (table(unit="uK"), {}, ("value", "uK", "uK2")),
        (table(unit="uK_RJ2"), {}, ("value", "uK_RJ2", "uK2")),
        (table(), {"modes": ["L2M0d0", "L4M0d0"]}, ("L4M0d0",)),
        (table(d=[2, 2, -2]), {"modes": ["L2M0d2", "L2M0d-2"]}, ("L2M0d-2", "d", 2)),
        (table(d=[2, 2, -2], pair=["a,a"] * 3), {"modes": ["L2M0d2", "L2M0d-2"]}, ("L2M0d-2", 2)),
    ],
)
def test_refusals(tmp_path, made, arguments, named):
    with refused(*named):
        read(tmp_path, made, **arguments)


def test_a_range_without_an_end_is_said_with_that_of_the_data(tmp_path):
    with refused("L2M0d0", 5000, 29) as caught:
        read(tmp_path, table(), ell_range=(5000, 1 << 30))
    assert str(1 << 30) not in str(caught.value)


def test_both_orders_of_a_pair_of_maps_are_read(tmp_path):
    found = read(tmp_path, table(d=[2, 2, -2], pair=["a,b"] * 3), modes=["L2M0d2", "L2M0d-2"])
    assert [row.mode.d for row in found.rows] == [2, 2, -2]


def test_a_file_that_is_no_table(tmp_path):
    (tmp_path / "x.ecsv").write_text("not a table\n1 2 3\n")
    with refused("x.ecsv", "ECSV"):
        read_table(tmp_path / "x.ecsv", "ecliptic")
    with refused("none.ecsv", "ECSV") as absent:
        read_table(tmp_path / "none.ecsv", "ecliptic")
    assert "does not exist" in str(absent.value)
    (tmp_path / "map.fits").write_bytes(b"SIMPLE  = \xd7")
    with refused("map.fits", "folder", "diagnose"):
        read_table(tmp_path / "map.fits", "ecliptic")


def test_bins_that_overlap_are_not_independent(tmp_path):
    made = table(ell_min=[10, 19, 10])
    with pytest.warns(UserWarning, match="L2M0d0 at ell = 10-19 and 19-29 overlap"):
        read(tmp_path, made)
    read_table(tmp_path / "table.ecsv", "ecliptic", errors=False)


def test_rows_without_an_error_are_refused_with_an_option_that_leaves_them_out(tmp_path):
    """On a full sky without noise the lowest degrees are predicted without scatter, and differences without errors."""
    ends = {"ell_min": [2, 3, 4], "ell_max": [2, 3, 4], "d": [0, 0, 0], "error": [0.0, 0.0, 0.3]}
    more = {"value_difference": [1.0, 2.0, 3.0], "error_difference": [np.nan] * 3}
    with refused("L2M0d0", "2-2", "--ell-min 4"):
        read(tmp_path, table(**ends))
    assert len(read(tmp_path, table(**ends), ell_range=(4, 4)).rows) == 1
    with refused("L2M0d0", "2-2", "--kind", "--covariance") as caught:
        read(tmp_path, table(**ends, **more))
    assert "--ell-min" not in str(caught.value)
    assert len(read(tmp_path, table(**ends, **more), ell_range=(4, 4), kind="plain").rows) == 1
    with refused("4-4") as caught:
        read(tmp_path, table(**ends | {"error": [0.1, 0.2, 0.0]}))
    assert "--ell-min" not in str(caught.value)


def test_errors_that_do_not_count_may_be_missing(tmp_path):
    made = table(error=[np.nan, 0.0, 0.3])
    with refused("L2M0d0", "error"):
        read(tmp_path, made)
    np.testing.assert_array_equal(read_table(tmp_path / "table.ecsv", "ecliptic", errors=False).value, [1.0, 2.0, 3.0])
