"""Files of observed maps: what is read as it was meant, and what is refused, before anything is simulated."""

import shutil
from dataclasses import replace

import healpy
import numpy as np
import pytest
import xarray as xr

import mcsim
from instruments import data_of, two_channels
from mcsim import config, systematics
from mcsim.datavector.analysis import Analysis, analysis_of
from mcsim.datavector.filter_model import model_of
from mcsim.datavector.map_checks import read_maps
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis import api
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from refusals import refused


@pytest.fixture(scope="module")
def small() -> Analysis:
    return analysis_of(config.load(two_channels("small")))


@pytest.fixture
def folder(small, tmp_path):
    for part, map_uk in zip(small.model.parts, simulate.maps(data_of(small.run), 0), strict=True):
        write(tmp_path, part.name, map_uk)
    return tmp_path


def write(folder, name, map_uk, **options):
    path = folder / f"{name.replace(':', '_')}.fits"
    healpy.write_map(path, map_uk, overwrite=True, dtype=np.float64, column_units=options.pop("unit", "uK"), **options)


def test_the_cost_of_a_diagnosis_is_said_of_data_that_can_be_used(small, folder):
    settings = DiagnosisSettings(simulations=400, without=tuple(n for n in systematics.catalogue() if n != "boost"))
    said = [api.describe(small.run, settings, *data).splitlines()[0] for data in ((), (folder,))]
    assert said[0] == said[1]
    write(folder, "W1:half2", np.ones(12 * 8**2))
    with refused("W1_half2.fits", "nside 8", 16):
        api.describe(small.run, settings, folder)
    (folder / "00000").mkdir()
    for path in list(folder.glob("*.fits")):
        path.rename(folder / "00000" / path.name)
    with refused("V1_half1.fits", folder / "00000"):
        api.describe(small.run, settings, folder)


def test_no_data_are_refused_before_the_model_is_read(tmp_path):
    """They ended in a traceback once the model was simulated."""
    with refused(None):
        mcsim.diagnose(tmp_path / "nosuch.toml", None)


def test_data_that_cannot_be_read_are_refused_before_the_survey_is_prepared(small, folder, monkeypatch):
    monkeypatch.setattr(api, "analysis_of", None)
    cut = folder / "cut"
    shutil.copytree(folder, cut)
    (cut / "V1_half2.fits").write_bytes((folder / "V1_half2.fits").read_bytes()[:4000])
    write(folder, "W1:half2", np.ones(12 * 8**2))
    for data, named in (
        (folder / "nosuch", (folder / "nosuch", "V1_half1.fits")),
        (cut, (cut / "V1_half2.fits",)),
        (folder, ("W1_half2.fits", "nside 8", 16)),
        ({"V1:half1": np.zeros(3072)}, ("V1:half2",)),
    ):
        with refused(*named):
            mcsim.diagnose(small.run, data)
    with refused(folder / "nosuch"):
        api.describe(small.run, DiagnosisSettings(), folder / "nosuch")


def test_what_cannot_be_done_is_said_before_anything_is_learned(small, folder):
    (folder / "file").write_text("")
    for changes, named in (
        ({"output": folder / "file"}, (folder / "file",)),
        ({"settings": DiagnosisSettings(without=("beam_elipticity",))}, ("beam_elipticity", "beam_ellipticity")),
        ({"data": [np.zeros(3072)]}, ("1 maps", 4)),
        ({"data": [np.zeros(48)] * 4}, ("V1:half1", "nside 2", 16)),
        ({"settings": DiagnosisSettings(simulations=20)}, ("20 simulations", 173, 1730)),
    ):
        with refused(*named):
            mcsim.diagnose(**({"model": small.run, "data": folder, "output": folder / "new" / "verdict"} | changes))
    assert not (folder / "new").exists()


def test_a_model_without_noise_is_told_before_anything_is_learned(small, folder):
    """Real data have some, and end in a gap of which nothing can be said."""
    quiet = replace(small.run, channels=tuple(one.without_noise() for one in small.run.channels))
    with pytest.warns(UserWarning, match="V1:half1.*noise.sigma0_uk"):
        api.describe(quiet, DiagnosisSettings(), folder)


def test_maps_are_read_as_they_were_written(small, folder):
    maps = read_maps(small.model, folder)
    expected = simulate.maps(data_of(small.run), 0)
    assert all(np.array_equal(a, b) for a, b in zip(maps, expected, strict=True))


def test_a_nested_map_with_an_honest_header_is_read(small, folder):
    expected = simulate.maps(data_of(small.run), 0)[0]
    write(folder, "V1:half1", healpy.reorder(expected, r2n=True), nest=True)
    assert np.array_equal(read_maps(small.model, folder)[0], expected)


@pytest.mark.parametrize(
    ("change", "options", "named"),
    [
        (lambda m: np.where(m == healpy.UNSEEN, m, m / 1000.0), {"unit": ""}, ("0.0443 uK", "45 uK", "TUNIT1")),
        (lambda m: np.full_like(m, 3.0), {}, ("V1_half1.fits", "constant")),
        (lambda m: np.where(np.arange(m.size) == 5, np.nan, m), {}, ("1 pixels", "finite", "UNSEEN")),
        (lambda m: np.where(np.arange(m.size) < m.size // 2, healpy.UNSEEN, m), {}, ("50 %", "1 %", "map.mask")),
        (lambda m: m, {"coord": "G"}, ("galactic", "ecliptic")),
        (lambda m: healpy.ud_grade(m, 8), {}, ("nside 8", 16)),
        (
            lambda m: np.where(np.arange(m.size) < 900, 0.0, m),
            {},
            ("V1_half1.fits", "900 pixels", "UNSEEN"),
        ),
    ],
)
def test_hostile_data_end_in_a_sentence(small, folder, change, options, named):
    map_uk = simulate.maps(data_of(small.run), 0)[0]
    write(folder, "V1:half1", change(map_uk), **options)
    with refused(*named):
        read_maps(small.model, folder)


def test_maps_that_are_still_to_be_prepared_are_told_how(small, folder):
    coarse = {"preparation": [{"kind": "degrade", "nside": 8}], "biposh": {"L_max": 2, "lmax": 20}}
    model = model_of(survey(config.load(two_channels("small") | coarse)), DiagnosisSettings())
    with refused("V1_half1.fits", "nside 16", 8, "prepare"):
        read_maps(model, folder)


def test_one_map_under_two_names_is_refused(small, folder):
    """Unless the model has no noise, by which alone halves need differ."""
    shutil.copy(folder / "V1_half1.fits", folder / "V1_half2.fits")
    with refused("V1_half1.fits", "V1_half2.fits"):
        read_maps(small.model, folder)
    quiet = replace(small.run, channels=tuple(channel.without_noise() for channel in small.run.channels))
    assert len(read_maps(model_of(survey(quiet), DiagnosisSettings()), folder)) == 4


def test_data_in_mk_with_a_header_are_read(small, folder):
    expected = simulate.maps(data_of(small.run), 0)[0]
    write(folder, "V1:half1", np.where(expected == healpy.UNSEEN, expected, expected / 1000.0), unit="mK")
    assert np.allclose(read_maps(small.model, folder)[0], expected, rtol=1e-12)


def test_data_in_antenna_temperature_are_read(small, folder):
    expected = simulate.maps(data_of(small.run), 0)[0]
    frequency = small.run.channels[0].frequency_ghz
    assert frequency is not None
    x = 6.62607015e-34 * frequency * 1e9 / (1.380649e-23 * 2.7255)
    factor = np.expm1(x) ** 2 / (x**2 * np.exp(x))
    write(folder, "V1:half1", np.where(expected == healpy.UNSEEN, expected, expected / factor), unit="uK_RJ")
    assert np.allclose(read_maps(small.model, folder)[0], expected, rtol=1e-6)
    write(folder, "V1:half1", expected, unit="V")
    with refused("V1_half1.fits", "'V'", "uK"):
        read_maps(small.model, folder)


def test_a_missing_file_is_named(small, folder):
    (folder / "W1_half2.fits").rename(folder / "w1_half2.fits")
    with refused("W1_half2.fits", "W1:half2", "w1_half2.fits"):
        read_maps(small.model, folder)


def test_a_map_that_the_model_has_not_is_told(small, folder):
    shutil.copy(folder / "V1_half1.fits", folder / "W7_half1.fits")
    with pytest.warns(UserWarning, match="W7_half1.fits"):
        maps = read_maps(small.model, folder)
    named = dict(zip((part.name for part in small.model.parts), maps, strict=True))
    with pytest.warns(UserWarning, match="W7:half1"):
        assert len(read_maps(small.model, named | {"W7:half1": maps[0]})) == len(maps)


def test_given_maps_are_in_the_units_and_the_frame_that_their_attributes_say(small: Analysis) -> None:
    """Rows of a store say both: a map of another frame was taken as it was, and a unit refused by the size."""
    maps, own, other = simulate.maps(data_of(small.run), 0), small.model.frame, "equatorial"
    said = [
        xr.DataArray(np.where(m == healpy.UNSEEN, m, m / 1000.0), dims="pixel", attrs={"units": "mK", "frame": own})
        for m in maps
    ]
    for found, expected in zip(read_maps(small.model, said), maps, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12)
    with refused(other, own):
        read_maps(small.model, [one.assign_attrs(frame=other) for one in said])
