"""Noise that a run gives for pixels: files in the layouts of WMAP and Planck, levels, refusals, identity."""

import json
from pathlib import Path

import healpy
import numpy as np
import pytest

from layouts import table
from mcsim import config
from mcsim.datavector.filter_model import model_of
from mcsim.datavector.map_checks import read_maps
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.instrument.scan import Moments
from mcsim.simulation import sampled, simulate
from mcsim.simulation.survey import survey
from mcsim.sphere import header, map_files
from mcsim.sphere.mask import read_mask
from refusals import refused

NSIDE = 16
NPIX = 12 * NSIDE**2
PIXEL = np.arange(NPIX)
HITS = 100.0 + PIXEL % 997
VARIANCE = 400.0 / HITS
FOUR_SIGMA = 4.0 * np.sqrt(2.0 / NPIX)
"""Of the relative error of a mean square over a map."""


@pytest.fixture
def wmap(tmp_path):
    """Temperature in mK and N_OBS, NESTED, Galactic, as WMAP's."""
    columns = {"TEMPERATURE": np.sin(PIXEL), "N_OBS": HITS}
    units = {"TEMPERATURE": "mK", "N_OBS": "counts"}
    return table(tmp_path / "wmap.fits", columns, units, ORDERING="NESTED", COORDSYS="G")


@pytest.fixture
def planck(tmp_path):
    """I, Q, U, hits and covariances in K, NESTED, Galactic, as Planck's."""
    columns = {
        "I_STOKES": np.sin(PIXEL),
        "Q_STOKES": PIXEL,
        "U_STOKES": PIXEL,
        "HITS": HITS,
        "II_COV": VARIANCE * 1e-12,
    }
    units = {"I_STOKES": "K_CMB", "II_COV": "K_CMB^2"}
    return table(tmp_path / "planck.fits", columns, units, ORDERING="NESTED", COORDSYS="GALACTIC")


def run_with(noise, seed=3, **changes):
    scan = {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 60.0, "line_of_sight": "A"}
    channel = {"name": "W", "beam": {"kind": "gaussian", "fwhm_arcmin": 300.0}, "scan": scan, "noise": noise}
    base = {
        "name": "noisy",
        "sky": {"spectrum": "wmap7", "lmax": 32},
        "map": {"nside": NSIDE, "frame": "galactic"},
        "channel": [channel],
        "ensemble": {"realizations": 2, "seed": seed},
    }
    return config.load(base | changes)


@pytest.mark.parametrize(("file", "unit", "to_uk"), [("wmap", "mK", 1e3), ("planck", "K_CMB", 1e6)])
def test_the_temperature_of_published_maps_is_read_in_its_frame_and_unit(file, unit, to_uk, request):
    path = Path(request.getfixturevalue(file))
    map_, frame, found = map_files.read_map(path)
    assert np.array_equal(map_, np.sin(PIXEL))
    assert (frame, found) == ("galactic", unit)
    assert header.to_uk(found, path) == to_uk


def test_the_temperature_need_not_be_the_first_column(tmp_path):
    path = table(tmp_path / "turned.fits", {"HITS": HITS, "I_STOKES": np.sin(PIXEL)}, {"I_STOKES": "uK", "HITS": "1"})
    map_, _, unit = map_files.read_map(Path(path))
    assert np.array_equal(map_, np.sin(PIXEL))
    assert unit == "uK"


@pytest.mark.parametrize("bad", [-999.9, 0.0, "-1e20", healpy.UNSEEN])
def test_pixels_of_the_value_that_a_header_calls_bad_are_not_observed(bad, tmp_path):
    seen = PIXEL % 7 > 0
    columns = {
        "TEMPERATURE": np.where(seen, 2.0 + np.sin(PIXEL), float(bad)),
        "N_OBS": np.where(seen, HITS, float(bad)),
    }
    path = Path(table(tmp_path / "some.fits", columns, {"TEMPERATURE": "mK"}, COORDSYS="G", BAD_DATA=bad))
    expected = np.where(seen, 1e3 * columns["TEMPERATURE"], healpy.UNSEEN)
    assert map_files.read_uk(path, "galactic", None) == pytest.approx(expected)
    [m] = survey(run_with({"sigma0_uk": 300.0, "hits": str(path)})).maps
    assert np.array_equal(m.moments.hits > 0, seen)
    weights = table(tmp_path / "mask.fits", {"MASK": np.where(seen, 0.5, float(bad))}, COORDSYS="G", BAD_DATA=bad)
    assert np.array_equal(read_mask(Path(weights), NSIDE, "galactic"), 0.5 * seen)
    with refused("BAD_DATA", "'none'", "number"):
        map_files.read_map(Path(table(tmp_path / "none.fits", columns, BAD_DATA="none")))


def test_part_of_the_sky_is_read_by_its_pixels(tmp_path):
    columns, units = {"TEMPERATURE": np.sin(PIXEL), "N_OBS": HITS}, {"TEMPERATURE": "mK", "N_OBS": "counts"}
    nested = np.arange(100)
    path = Path(table(tmp_path / "part.fits", columns, units, pixels=nested, ORDERING="NESTED", OBJECT="PARTIAL"))
    seen = healpy.nest2ring(NSIDE, nested)
    for names, expected, expected_unit in (((), np.sin(PIXEL), "mK"), (map_files.HITS, HITS, "counts")):
        map_, _, unit = map_files.read_map(path, names)
        assert np.array_equal(np.flatnonzero(map_ != healpy.UNSEEN), np.sort(seen))
        assert np.array_equal(map_[seen], expected[seen])
        assert unit == expected_unit


def test_a_diagnosis_reads_published_maps_as_they_are(tmp_path):
    """In mK, NESTED, Galactic, with the hits beside, which are the model's too."""
    path = tmp_path / "W.fits"
    np.save(tmp_path / "hits.npy", HITS)
    model = model_of(survey(run_with({"sigma0_uk": 50.0, "hits": str(tmp_path / "hits.npy")})), DiagnosisSettings())
    made = simulate.maps(model.survey, 1)[0]
    units = {"TEMPERATURE": "mK", "N_OBS": "counts"}
    table(path, {"TEMPERATURE": made / 1e3, "N_OBS": HITS}, units, ORDERING="NESTED", COORDSYS="G")
    assert read_maps(model, tmp_path)[0] == pytest.approx(made, rel=1e-12)
    path.unlink()
    table(path, {"TEMPERATURE": made / 1e3}, units, COORDSYS="C")
    with refused(path, "equatorial", "galactic", "map.frame"):
        read_maps(model, tmp_path)
    path.unlink()
    table(path, {"TEMPERATURE": made / 1e3}, COORDSYS="G")  # no unit: uK
    with refused(path, "TUNIT1"):
        read_maps(model, tmp_path)


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        (None, 1.0),
        ("K_CMB^2", 1e12),
        ("(K_CMB)^2", 1e12),
        ("Kcmb^2", 1e12),
        ("mK**2", 1e6),
        ("uK2", 1.0),
        ("uK^(2)", 1.0),
    ],
)
def test_units_of_variances(unit, factor):
    assert header.to_uk2(unit, Path("x")) == pytest.approx(factor)


def test_variances_of_antenna_temperature_take_the_square_of_its_factor():
    """At 217 GHz a kelvin of antenna temperature is 3 of the CMB's."""
    factor = header.to_uk("K_RJ", Path("x"), 217.0)
    assert 2.5e6 < factor < 3.5e6
    assert header.to_uk2("K_RJ^2", Path("x"), 217.0) == pytest.approx(factor**2)
    assert header.to_uk2("(MJy/sr)^2", Path("x"), 217.0) == pytest.approx(header.to_uk("MJy/sr", Path("x"), 217.0) ** 2)


def noise_of(noise, **changes):
    """Return a map of a survey, and its noise in a realization: the difference with and without."""
    run = run_with(noise, **changes)
    shared, quiet = survey(run), survey(run_with({"sigma0_uk": 0.0}, **changes))
    sky = simulate.draw_sky(quiet, 0)
    drawn = simulate.maps(shared, 0, sky=sky)[0] - simulate.maps(quiet, 0, sky=sky)[0]
    m = shared.channels[0].maps[0]
    return m, np.where(m.moments.hits > 0, drawn, 0.0)


@pytest.mark.parametrize(
    ("key", "file", "expected"),
    [
        ("hits", "wmap", 50.0**2 / HITS),
        ("hits", "planck", 50.0**2 / HITS),
        ("variance", "planck", VARIANCE),
    ],
)
def test_noise_has_the_variance_of_a_published_map(key, file, expected, request):
    path = request.getfixturevalue(file)
    given = {"sigma0_uk": 50.0, "hits": path} if key == "hits" else {"kind": "variance", "variance": path}
    m, drawn = noise_of(given)
    assert m.noise_uk**2 == pytest.approx(expected, rel=1e-12)
    if key == "hits":
        assert m.moments.hits == pytest.approx(HITS)
    assert np.mean(drawn**2 / expected) == pytest.approx(1.0, abs=FOUR_SIGMA)


def test_depth_is_noise_per_arcmin():
    m, drawn = noise_of({"kind": "depth", "depth_uk_arcmin": 600.0})
    expected = 600.0**2 / (healpy.nside2pixarea(NSIDE, degrees=True) * 3600.0)
    assert m.noise_uk**2 == pytest.approx(np.full(NPIX, expected), rel=1e-12)
    assert np.mean(drawn**2) == pytest.approx(expected, abs=FOUR_SIGMA * expected)
    # The spectrum of white noise is depth^2 in radians.
    assert expected * healpy.nside2pixarea(NSIDE) == pytest.approx(np.deg2rad(600.0 / 60.0) ** 2)


def test_a_depth_of_zero_is_no_noise():
    """Effects on noise were candidates, and what weights by the noise divided by zero."""
    m, _ = noise_of({"kind": "depth", "depth_uk_arcmin": 0.0})
    assert m.noise_uk is None


@pytest.mark.parametrize("kind", ["hits", "variance"])
def test_what_is_not_observed_in_the_file_is_not_observed(kind, tmp_path):
    south = PIXEL >= NPIX // 2
    values = np.where(south, 0.0 if kind == "hits" else healpy.UNSEEN, 4.0)
    path = table(tmp_path / "part.fits", {"N_OBS" if kind == "hits" else "II_COV": values})
    noise = {"sigma0_uk": 1.0, "hits": path} if kind == "hits" else {"kind": "variance", "variance": path}
    shared = survey(run_with(noise))
    assert np.array_equal(shared.channels[0].maps[0].moments.hits > 0, ~south)
    assert np.array_equal(shared.channels[0].maps[0].weight > 0, ~south)
    for made in (simulate.maps(shared, 0)[0], sampled.maps(shared, 0, epsilon=1e-3)[0][1]):
        assert np.array_equal(made == healpy.UNSEEN, south)


def test_a_map_of_hits_adds_none_where_the_scan_does_not_go():
    """The file is of a whole survey, the scan of its northern half: the south was in no sample of it."""
    north = PIXEL < NPIX // 2
    scan = Moments(NSIDE, "galactic", np.where(north, 3.0, 0.0), np.zeros((1, NPIX), dtype=np.complex128))
    channel = {"name": "W", "beam": {"kind": "gaussian", "fwhm_arcmin": 300.0}, "scan": scan}
    shared = survey(run_with(None, channel=[channel | {"noise": {"sigma0_uk": 20.0, "hits": HITS}}]))
    [made] = shared.channels[0].maps
    assert np.array_equal(made.moments.hits, np.where(north, HITS, 0.0))
    assert made.noise_uk == pytest.approx(np.where(north, 20.0 / np.sqrt(HITS), 0.0))
    assert np.array_equal(simulate.maps(shared, 0)[0] == healpy.UNSEEN, ~north)


def test_samples_and_pixels_have_the_same_noise(wmap):
    """The time-ordered route adds the noise of pixels to the map."""
    noisy, quiet = (
        sampled.maps(survey(run_with(noise)), 0, epsilon=1e-3)[0][1]
        for noise in ({"sigma0_uk": 50.0, "hits": wmap}, {"sigma0_uk": 0.0, "hits": wmap})
    )
    assert np.mean((noisy - quiet) ** 2 * HITS) / 50.0**2 == pytest.approx(1.0, abs=FOUR_SIGMA)


def test_splits_have_their_own_files(tmp_path):
    for split, level in (("year1", 1.0), ("year2", 9.0)):
        table(tmp_path / f"{split}.fits", {"II_COV": np.full(NPIX, level)})
    split = {"nside": NSIDE, "frame": "galactic", "splits": ["year1", "year2"]}
    run = run_with({"kind": "variance", "variance": str(tmp_path / "{split}.fits")}, map=split)
    assert [m.noise_uk.max() for m in survey(run).channels[0].maps] == [1.0, 3.0]


@pytest.mark.parametrize(
    ("noise", "key"),
    [
        ({"sigma0_uk": 50.0, "hits": HITS}, "hits"),
        ({"kind": "variance", "variance": VARIANCE}, "variance"),
    ],
)
def test_splits_do_not_share_hits_or_variances(noise, key):
    """Hits of a whole survey as those of its halves made their noise too small by the root of two."""
    split = {"nside": NSIDE, "frame": "galactic", "splits": ["year1", "year2"]}
    with refused(f"channel[W].noise.{key}", "year1, year2", "{split}", "split_noise"):
        run_with(noise, map=split)
    channel = config.to_dict(run_with(noise))["channel"][0]
    own = {"noise": {"sigma0_uk": 1.0}, "split_noise": dict.fromkeys(("year1", "year2"), channel["noise"])}
    made = survey(run_with({}, map=split, channel=[channel | own])).channels[0].maps
    np.testing.assert_array_equal(made[0].noise_uk, made[1].noise_uk)


def test_stores_of_runs_that_are_refused_now_are_still_read():
    split = {"nside": NSIDE, "frame": "galactic", "splits": ["year1", "year2"]}
    stored = config.to_dict(run_with({"sigma0_uk": 50.0, "hits": HITS})) | {"map": split}
    assert config.from_json(json.dumps(stored)).map.splits == ("year1", "year2")


@pytest.mark.parametrize("unit", ["uK^-2", "K_CMB**-2", "uK^(-2)", "uK-2", "1/uK^2", "uK^−2"])
def test_inverse_variances_are_no_variances(unit):
    with refused("ivar.fits", unit, "variances"):
        header.to_uk2(unit, Path("ivar.fits"))


@pytest.mark.parametrize("unit", ["mK^2", "mK**2", "mK2", "(mK)^2", "mK_CMB^2", "(mK)**(2)", "mK ^ 2"])
def test_squares_are_variances(unit):
    assert header.to_uk2(unit, Path("var.fits")) == 1e6


def test_arrays_stand_for_files_and_make_the_same_run(wmap):
    of_array = run_with({"sigma0_uk": 50.0, "hits": HITS})
    assert survey(of_array).channels[0].maps[0].moments.hits == pytest.approx(HITS)
    again = run_with({"sigma0_uk": 50.0, "hits": HITS.copy()})
    assert config.digest(of_array) == config.digest(again) != config.digest(run_with({"sigma0_uk": 50.0, "hits": wmap}))


def test_white_noise_keeps_its_hash():
    plain = config.science(run_with({"sigma0_uk": 2.0}))
    assert plain["channel"][0]["noise"] == {"sigma0_uk": 2.0}
    assert config.digest(run_with({"sigma0_uk": 2.0})) == config.digest(run_with({"kind": "white", "sigma0_uk": 2.0}))


@pytest.mark.parametrize("noise", [{"kind": "depth", "depth_uk_arcmin": 3.0}, {"sigma0_uk": 1.0, "hits": HITS}])
def test_runs_are_read_again(noise):
    run = run_with(noise)
    assert config.load(config.to_dict(run)) == config.from_json(config.to_json(run)) == run


@pytest.mark.parametrize(
    ("columns", "keywords", "named"),
    [
        ({"II_COV": HITS}, {"COORDSYS": "C"}, ("equatorial", "galactic", "map.frame")),
        ({"A": HITS, "B": HITS}, {}, ("A", "B", "II_COV")),
        ({"II_COV": -HITS}, {}, (-HITS.max(),)),
        ({"II_COV": 0 * HITS}, {}, ("UNSEEN",)),
        ({"II_COV": HITS}, {"TUNIT1": "K_CMB"}, ("'K_CMB'", "K^2")),
    ],
)
def test_files_that_do_not_fit_are_refused(columns, keywords, named, tmp_path):
    path = table(tmp_path / "bad.fits", columns, **keywords)
    with refused(path, *named):
        survey(run_with({"kind": "variance", "variance": path}))


@pytest.mark.parametrize(
    ("noise", "columns", "units", "named"),
    [
        ("variance", {"N_OBS": HITS}, {}, ("N_OBS", "II_COV")),
        ("hits", {"II_COV": VARIANCE}, {}, ("II_COV", "N_OBS")),
        ("hits", {"Q_STOKES": HITS}, {}, ("Q_STOKES", "N_OBS")),
        ("variance", {"INV_VAR": 1.0 / VARIANCE}, {}, ("INV_VAR", "II_COV")),
        ("variance", {"WEIGHT": 1.0 / VARIANCE}, {}, ("WEIGHT", "II_COV")),
        ("variance", {"SIGMA": VARIANCE**0.5}, {}, ("SIGMA", "II_COV")),
        ("hits", {"SIGMA": VARIANCE**0.5}, {}, ("SIGMA", "N_OBS")),
        ("hits", {"TEMPERATURE": HITS}, {"TEMPERATURE": "mK"}, ("mK", "observations")),
        ("hits", {"TEMPERATURE": HITS}, {"TEMPERATURE": "K_CMB^2"}, ("K_CMB^2", "observations")),
    ],
)
def test_a_lone_column_that_is_called_something_else_is_refused(noise, columns, units, named, tmp_path):
    path = table(tmp_path / "bad.fits", columns, units)
    given = {"sigma0_uk": 1.0, "hits": path} if noise == "hits" else {"kind": "variance", "variance": path}
    with refused(path, *named):
        survey(run_with(given))


@pytest.mark.parametrize("name", ["HITS", "II_COV", "Q_POLARISATION", "INV_VAR", "SIGMA"])
def test_what_is_no_temperature_is_no_map(name, tmp_path):
    path = Path(table(tmp_path / "bad.fits", {name: HITS}))
    with refused(path, name, "TEMPERATURE"):
        map_files.read_uk(path, "galactic", None)


def test_another_nside_is_refused():
    run = run_with({"sigma0_uk": 1.0, "hits": np.ones(12 * 8**2)})
    with refused(8, NSIDE, "map.nside"):
        survey(run)


@pytest.mark.parametrize(
    ("noise", "named"),
    [
        ({"kind": "whit"}, ("whit", "white", "depth", "variance")),
        ({"kind": "depth"}, ("channel[W].noise.depth_uk_arcmin",)),
        ({"kind": "depth", "depth_uk_arcmin": -1.0}, ("channel[W].noise.depth_uk_arcmin", -1.0, 0)),
        ({"kind": "depth", "depth": 1.0}, ("channel[W].noise.depth", "depth_uk_arcmin")),
        ({"kind": "variance", "variance": "none.fits"}, ("channel[W].noise.variance", "none.fits")),
        ({"kind": "variance", "variance": "n_{realization}.fits"}, ("channel[W].noise.variance", "{split}")),
        ({"sigma0": 1.0}, ("channel[W].noise.sigma0", "sigma0_uk")),
    ],
)
def test_noise_that_cannot_be_is_refused(noise, named):
    with refused(*named):
        run_with(noise)
