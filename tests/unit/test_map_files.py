"""FITS tables of maps as other programs write them: orders, pixel numbers and missing values."""

from pathlib import Path

import healpy
import numpy as np
import pytest
from astropy.io import fits

from mcsim.sphere import map_files
from refusals import refused

NSIDE = 4
MAP = np.arange(192.0) ** 1.5
SOME = np.arange(20, 90)


def written(path, *columns, primary=(), **keywords) -> Path:
    """Write columns (name, format, array, further keywords) with a header that has no more than these keywords."""
    made = [fits.Column(name, form, array=array, **more) for name, form, array, more in columns]
    hdu = fits.BinTableHDU.from_columns(made)
    hdu.header.update({"ORDERING": "RING", "NSIDE": NSIDE, **keywords})
    fits.HDUList([fits.PrimaryHDU(header=fits.Header(dict(primary))), hdu]).writeto(path)
    return Path(path)


@pytest.mark.parametrize("order", ["NESTED", "nested", "Nested", "NEST"])
def test_the_order_is_read_in_any_case(tmp_path, order: str) -> None:
    nested = healpy.reorder(MAP, r2n=True)
    path = written(tmp_path / "nested.fits", ("TEMPERATURE", "D", nested, {}), ORDERING=order)
    np.testing.assert_array_equal(map_files.read_map(path)[0], MAP)


@pytest.mark.parametrize("stated", [{"INDXSCHM": "explicit"}, {"OBJECT": "PARTIAL"}, {"INDXSCHM": "IMPLICIT"}, {}])
@pytest.mark.parametrize("reverse", [False, True])
def test_pixel_numbers_are_no_temperatures(tmp_path, stated: dict, reverse: bool) -> None:
    columns = [("PIXEL", "J", SOME, {}), ("SIGNAL", "E", MAP[SOME], {"unit": "mK"}), ("Q", "E", SOME, {"unit": "K"})]
    made = [columns[1], columns[0], columns[2]] if reverse else columns
    found, _, unit = map_files.read_map(written(tmp_path / "some.fits", *made, **stated))
    expected = np.full(MAP.size, healpy.UNSEEN)
    expected[SOME] = MAP[SOME].astype(np.float32)
    np.testing.assert_array_equal(found, expected)
    assert unit == "mK"


@pytest.mark.parametrize(
    ("pixels", "named"),
    [
        (np.append(SOME[:-1], -1), (191, -1, 88)),
        (np.append(SOME[:-1], 192), (191, 20, 192)),
        (np.append(SOME[:-1], 20), (20,)),
    ],
)
def test_pixel_numbers_that_are_none(tmp_path, pixels: np.ndarray, named: tuple) -> None:
    path = written(tmp_path / "some.fits", ("PIXEL", "J", pixels, {}), ("SIGNAL", "D", MAP[SOME], {}))
    with refused(path, *named):
        map_files.read_map(path)


def test_a_null_of_integers_is_not_observed(tmp_path) -> None:
    counts, expected = np.arange(192) % 7, np.arange(192.0) % 7
    counts[5], expected[5] = -99, healpy.UNSEEN
    path = written(tmp_path / "null.fits", ("N_OBS", "J", counts, {"null": -99}))
    np.testing.assert_array_equal(map_files.read_map(path)[0], expected)


def test_bad_data_of_the_primary_header(tmp_path) -> None:
    path = written(tmp_path / "bad.fits", ("TEMPERATURE", "D", MAP, {}), primary={"BAD_DATA": MAP[7]})
    found = map_files.read_map(path)[0]
    assert found[7] == healpy.UNSEEN
    np.testing.assert_array_equal(np.delete(found, 7), np.delete(MAP, 7))


def test_a_table_of_other_pixels_than_its_header_says(tmp_path) -> None:
    path = written(tmp_path / "few.fits", ("TEMPERATURE", "D", MAP[:100], {}))
    with refused(path, "NSIDE", 4, 192, 100):
        map_files.read_map(path)
    path = written(tmp_path / "complex.fits", ("TEMPERATURE", "M", MAP + 1j, {}))
    with refused(path, "TEMPERATURE"):
        map_files.read_map(path)


@pytest.mark.parametrize("keyword", ["BUNIT", "UNITS"])
def test_a_unit_of_the_whole_table_is_that_of_temperatures(tmp_path, keyword: str) -> None:
    for silent in ({}, {"unit": "unknown"}):
        columns = ("TEMPERATURE", "D", MAP, silent), ("N_OBS", "D", MAP, {})
        path = written(tmp_path / f"{len(silent)}.fits", *columns, **{keyword: "mK"})
        np.testing.assert_allclose(map_files.read_uk(path, "ecliptic", None), 1e3 * MAP)
        assert map_files.read_map(path, map_files.HITS)[2] is None


def test_a_lack_of_memory_is_not_a_broken_file(tmp_path, monkeypatch) -> None:
    def lacking(*given: object) -> None:
        raise MemoryError

    path = written(tmp_path / "map.fits", ("TEMPERATURE", "D", MAP, {}))
    monkeypatch.setattr(map_files, "_in_ring_order", lacking)
    with pytest.raises(MemoryError):
        map_files.read_map(path)
