"""Beams from tables of B_l, in the layouts of WMAP and Planck."""

import bz2
import gzip
import lzma

import healpy
import numpy as np
import pytest
from astropy.io import fits

import mcsim
from mcsim import config
from mcsim.instrument import scan
from mcsim.instrument.beams import read_window
from mcsim.plot.look import look_at_beams
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from refusals import refused

LMAX = 60
WINDOW = healpy.gauss_beam(np.deg2rad(3.0), LMAX)


def hdu(columns, name="", rows=True, **keywords):
    """Return a table of one value a row, or of one row of values."""
    made = [
        fits.Column(key, "D", array=values) if rows else fits.Column(key, f"{len(values)}D", array=values[None])
        for key, values in columns.items()
    ]
    found = fits.BinTableHDU.from_columns(made, name=name or None)
    found.header.update(keywords)
    return found


def written(path, *hdus):
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(path)
    return path


def wmap_text(folder):
    path, error = folder / "ampl_bl_W1.txt", np.full(LMAX + 1, 0.01)
    header = "WMAP beam amplitude transfer function as well as its error; not W_l = B_l^2\n l  B_l  fractional error"
    np.savetxt(path, np.stack([np.arange(LMAX + 1), WINDOW, error], axis=1), fmt=["%d", "%.17g", "%g"], header=header)
    return path


def hfi_windows(folder):
    return written(folder / "Bl_T_fullsky_143x143.fits", hdu({"TEMPERATURE": WINDOW}, "WINDOW FUNCTIONS"))


def cmb_map(folder):
    map_ = hdu({"I_STOKES": np.ones(12), "TEMPERATURE": np.ones(12)}, "COMP-MAP", PIXTYPE="HEALPIX")
    return written(folder / "cmb.fits", map_, hdu({"INT_BEAM": WINDOW, "POL_BEAM": 0 * WINDOW}))


def plain_text(folder):
    np.savetxt(folder / "window.txt", WINDOW)
    return folder / "window.txt"


@pytest.fixture
def lfi(tmp_path):
    """Instrument model with a window for each band."""
    bands = [hdu({"BL": WINDOW**power, "BL_ERR": 0 * WINDOW}, f"BEAMWF_{b}", rows=False) for power, b in
             ((2, "030X030"), (1, "070X070"))]  # fmt: skip
    return written(tmp_path / "RIMO.fits", hdu({"DETECTOR": np.ones(4)}, "CHANNEL_PARAMETERS"), *bands)


@pytest.mark.parametrize("write", [wmap_text, hfi_windows, cmb_map, plain_text])
def test_published_tables_are_read_as_they_are(write, tmp_path):
    beam = mcsim.Beam.from_window(write(tmp_path))
    assert beam.window == pytest.approx(WINDOW, rel=1e-12)
    assert beam.mmax == 0


def test_the_extension_chooses_a_band(lfi):
    assert mcsim.Beam.from_window(lfi, 20, extension="BEAMWF_070X070").window == pytest.approx(WINDOW[:21])
    assert mcsim.Beam.from_window(lfi, extension="beamwf_030x030", column="bl").window == pytest.approx(WINDOW**2)


def test_tables_of_one_name_are_told_apart_by_number(tmp_path):
    path = written(tmp_path / "bands.fits", hdu({"BL": WINDOW}, "BEAM"), hdu({"BL": WINDOW**2}, "BEAM"))
    for named in (None, "BEAM"):
        with refused(path, 1, 2):
            mcsim.Beam.from_window(path, extension=named)
    for number, power in (("1", 1), ("2", 2)):
        assert mcsim.Beam.from_window(path, extension=number).window == pytest.approx(WINDOW**power)


def run_with(beam):
    channel = {"name": "W", "beam": beam, "scan": {"kind": "parallel_transport"}}
    sky = {"spectrum": "wmap7", "lmax": 40}
    return config.load({"name": "windows", "sky": sky, "map": {"nside": 16}, "channel": [channel]})


def test_a_window_is_the_beam_of_a_channel(tmp_path):
    """The same maps as through the Gaussian whose window it is."""
    given = [{"kind": "window", "path": str(wmap_text(tmp_path))}, {"kind": "window", "path": WINDOW}]
    gaussian = simulate.maps(survey(run_with({"kind": "gaussian", "fwhm_arcmin": 180.0})), 0)
    for beam in given:
        assert simulate.maps(survey(run_with(beam)), 0) == pytest.approx(gaussian, abs=1e-9 * np.std(gaussian))


def test_its_contents_are_in_the_hash(tmp_path):
    path = tmp_path / "window.npy"
    np.save(path, WINDOW)
    before = config.digest(run_with({"kind": "window", "path": str(path)}))
    np.save(path, WINDOW**2)
    assert config.digest(run_with({"kind": "window", "path": str(path)})) != before


@pytest.mark.parametrize(
    "header", ["l  W_l (beam squared)", "l W_{ell}", "l B_l^2", "window function squared", "l, w_l", "window W(l)"]
)
@pytest.mark.parametrize("comments", ["# ", "  # "])
@pytest.mark.parametrize("name", ["wl.txt", "wl.txt.gz"])
def test_a_text_that_says_that_it_is_squared_is_refused(header, comments, name, tmp_path):
    """It looks like B_l of a wider beam, and was taken for it."""
    path, columns = tmp_path / name, np.stack([np.arange(LMAX + 1), WINDOW**2], axis=1)
    np.savetxt(path, columns, fmt=["%d", "%.17g"], header=header, comments=comments)
    with refused(path, "W_l", "B_l"):
        read_window(path)


def test_a_text_with_a_byte_order_mark_is_read(tmp_path):
    path = tmp_path / "window.txt"
    np.savetxt(path, WINDOW, header="B_l", encoding="utf-8-sig")
    np.testing.assert_array_equal(read_window(path), WINDOW)


@pytest.mark.parametrize("ending", [".gz", ".bz2", ".xz"])
def test_a_packed_text_is_read(ending, tmp_path):
    path = tmp_path / f"window.txt{ending}"
    np.savetxt(tmp_path / "window.txt", WINDOW, header="B_l")
    packed = {".gz": gzip.compress, ".bz2": bz2.compress, ".xz": lzma.compress}[ending]
    path.write_bytes(packed((tmp_path / "window.txt").read_bytes()))
    np.testing.assert_array_equal(read_window(path), WINDOW)


def test_a_negative_degree_is_refused():
    with refused("lmax", -1):
        read_window(WINDOW, -1)


def test_a_text_of_a_window_is_shown(tmp_path):
    path = wmap_text(tmp_path)
    [look] = look_at_beams(path)
    assert "ampl_bl_W1.txt" in look.text
    assert [one.text for one in look_at_beams(path, LMAX, m_max=0)] == [look.text]
    for asked, named in (
        ({"lmax": LMAX + 1}, (LMAX, LMAX + 1)),
        ({"m_max": 2}, ("--m-max",)),
        ({"pixel_deg": 0.1}, ("--pixel-deg",)),
    ):
        with refused(path, *named):
            list(look_at_beams(path, **asked))


def test_beams_of_a_run_are_shown_as_far_as_their_files_reach(tmp_path):
    wmap_text(tmp_path)
    y, x = np.mgrid[-12:13, -12:13] * 1.0
    fits.writeto(tmp_path / "map.fits", np.exp(-(x**2 + y**2) / 4))
    beams = (
        'kind = "window", path = "ampl_bl_W1.txt"',
        'kind = "map", path = "map.fits", pixel_deg = 1.0, cut_deg = 8.0',
    )
    for number, beam in enumerate(beams):
        text = f'name = "W"\nsky = {{ spectrum = "wmap7", lmax = {LMAX} }}\nmap = {{ nside = 32 }}\n[[channel]]\n'
        path = tmp_path / f"run{number}.toml"
        path.write_text(f'{text}name = "W"\nscan = {{ kind = "parallel_transport" }}\nbeam = {{ {beam} }}\n')
        [look] = look_at_beams(path)
        assert f" {(LMAX, 180)[number]}, " in look.text.partition("lmax, mmax")[2]


@pytest.mark.parametrize(
    ("values", "named"),
    [
        (WINDOW[:30], (29, 40, "longer")),
        (WINDOW**0.5 * 1.5, (1.5,)),
        (0.9 * WINDOW, (0.9,)),
        (-WINDOW, (-1, "sign")),
        (1.03 * WINDOW, (1.03,)),
        (np.append(WINDOW, np.nan), ()),
        (np.append(WINDOW, 2.0), (2.0,)),
    ],
)
def test_numbers_that_are_no_window_are_refused(values, named):
    with refused(*named):
        survey(run_with({"kind": "window", "path": values}))


def test_tables_that_leave_a_choice_are_refused(lfi, tmp_path):
    with refused(lfi, 2, "BEAMWF_030X030", "BEAMWF_070X070", "extension", "column"):
        mcsim.Beam.from_window(lfi)
    with refused(lfi, "'X'", "BEAMWF_030X030"):
        mcsim.Beam.from_window(lfi, extension="X")
    squared = written(tmp_path / "Wl.fits", hdu({"TT_2_TT": WINDOW**2}, "TT"))
    with refused(squared, "TT_2_TT"):
        mcsim.Beam.from_window(squared)
    from_two = tmp_path / "two.txt"
    np.savetxt(from_two, np.stack([np.arange(2, 10), np.ones(8)], axis=1))
    with refused(from_two, "ell"):
        mcsim.Beam.from_window(from_two)
    columns = {"ELL": np.arange(2, 10), "BL": WINDOW[2:10]}  # B_2 differs from 1 by less than B_0 may
    table = written(tmp_path / "two.fits", hdu(columns, "BEAM"))
    with refused(table, "ELL", "BEAM"):
        mcsim.Beam.from_window(table)
    with refused(from_two, "extension"):
        mcsim.Beam.from_window(from_two, extension="X")
    image = tmp_path / "image.fits"
    fits.PrimaryHDU(np.ones((8, 8))).writeto(image)
    with refused(image, "B_l", "kind"):
        mcsim.Beam.from_window(image)
    with refused(tmp_path / "none.fits", by=mcsim.InputError):
        mcsim.Beam.from_window(tmp_path / "none.fits")


def test_maps_of_a_file_of_moments_are_prepared(tmp_path):
    """Its orders do not count for a circular beam, which sees what it sees under parallel transport."""
    path, npix = tmp_path / "moments.fits", 12 * 32**2
    scan.write_moments_fits(path, mcsim.Moments(32, "ecliptic", np.full(npix, 10.0), np.full((2, npix), 0.3 + 0.4j)))
    run = {
        "name": "prepared",
        "sky": {"spectrum": "wmap7", "lmax": 40},
        "map": {"nside": 32, "pixel_window": "none"},
        "preparation": [{"kind": "rotate", "frame": "galactic"}, {"kind": "degrade", "nside": 16}],
    }
    channel = {"name": "W", "beam": {"kind": "window", "path": WINDOW}}
    found, wanted = (
        simulate.realize(survey(config.load(run | {"channel": [channel | {"scan": each}]})), 0)
        for each in ({"kind": "moments", "path": str(path)}, {"kind": "parallel_transport"})
    )
    assert all(np.array_equal(found[name], wanted[name], equal_nan=True) for name in wanted)
