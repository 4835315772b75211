"""The configuration: what it accepts, defaults, paths, and the forms that it can be written in."""

import json
import re
import tomllib
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mcsim import config
from refusals import refused, unnamed

from .conftest import DIFFERENCING, changed


def test_defaults(plain, folder):
    run = config.load(plain)
    assert run.schema_version == 1
    assert run.map == config.Map(nside=64, frame="ecliptic", mask=None, splits=(), pixel_window=None)
    assert run.biposh == config.Biposh(
        L_max=2, lmax=None, summary_bin=50, weighting="uniform", iterations=0, pairs="all"
    )
    assert run.ensemble == config.Ensemble(realizations=4, seed=1, paired=True, keep_maps=False)
    assert run.compute == config.Compute(workers=2, chunk=None)
    assert run.channels[1].noise == config.Noise(sigma0_uk=0.0)
    assert config.analysis_lmax(run) == 128
    assert [config.pixel_window(run, channel) for channel in run.channels] == ["none", "computed"]
    assert config.map_names(run) == ("W1", "V1")
    assert run.channels[1].scan.model == str(folder / "scan.toml")


def test_a_complete_run_has_every_key_and_loads_as_the_same():
    run = config.load("tiny")
    found, schema = config.complete(run), config.json_schema()
    assert found.keys() == schema["properties"].keys()
    for table, name in (("sky", "Sky"), ("map", "Map"), ("biposh", "Biposh"), ("ensemble", "Ensemble")):
        assert found[table].keys() == schema["$defs"][name]["properties"].keys()
    assert found["map"]["offset_order"] == 1
    assert config.complete(config.load(found)) == found
    assert config.digest(config.load(found)) == config.digest(run)
    without = replace(run, map=replace(run.map, pixel_window="none", offset_order=0))
    assert config.complete(without)["map"]["offset_order"] == 0


@pytest.mark.parametrize("base", ["scans", "scans of {2026}"])
def test_the_description_of_a_scan_is_found_where_the_folder_names_its_channel(plain, folder, base):
    (folder / base / "V1").mkdir(parents=True)
    for name in ("scan.toml", "moments.npz"):
        (folder / base / "V1" / name).write_text("contents")
    plain["channel"] = [plain["channel"][1] | {"scan": {"kind": "moments", "path": "{channel}/moments.npz"}}]
    model = config.load(plain, base=folder / base).channels[0].scan.model
    assert config.channel_path(model, "V1") == folder / base / "V1/scan.toml"


def test_the_file_of_a_nuisance_is_found_beside_the_configuration(plain, folder, monkeypatch):
    (folder / "mine.py").write_text("contents")
    plain["nuisance"] = [{"effect": "mine.py", "width": 0.1}]
    (folder / "run.json").write_text(json.dumps(plain))
    run = config.load(plain)
    assert run.nuisances[0].effect == str(folder / "mine.py")
    before = config.science(run, "nuisance")
    (folder / "mine.py").write_text("other contents")
    assert config.science(run, "nuisance") != before


def test_quickstart_is_packaged_and_documented_values_hold():
    run = config.load("quickstart")
    assert (run.map.nside, run.sky.lmax, run.biposh.L_max, run.ensemble.realizations) == (128, 256, 2, 64)
    assert run.ensemble.paired
    assert run.channels[0].scan.model == "wmap"


def test_names_of_maps_and_pixel_windows_with_splits(plain, folder):
    run = config.load(changed(changed(plain, "map.splits", ["half1", "half2"]), "map.pixel_window", "win.fits"))
    assert config.map_names(run) == ("W1:half1", "W1:half2", "V1:half1", "V1:half2")
    assert config.pixel_window(run, run.channels[0]) == str(folder / "win.fits")


def test_channels_keep_what_acts_in_them():
    def acting(key, *channels):
        return [{key: "gain_drift", "channel": name} for name in channels] + [{key: "boost"}]

    table = {
        "name": "two",
        "sky": {"spectrum": "wmap7", "lmax": 8},
        "map": {"nside": 4},
        "channel": [
            {"name": n, "beam": {"kind": "gaussian", "fwhm_arcmin": 900.0}, "scan": {"kind": "parallel_transport"}}
            for n in ("V", "W")
        ],
        "effect": acting("name", "V", "W"),
        "nuisance": [one | {"width": 0.1} for one in acting("effect", "W")],
        "preparation": [{"kind": "subtract_dipole", "channels": n} for n in (["V"], ["V", "W"], [])],
    }
    run = config.load(table)
    only = run.of_channels("V")
    assert [channel.name for channel in only.channels] == ["V"]
    assert [one.channel for one in only.effects] == ["V", None]
    assert [one.channel for one in only.nuisances] == [None]
    assert [step.channels for step in only.preparation] == [("V",), ("V",), ()]
    assert [step.channels for step in run.of_channels("W").preparation] == [("W",), ()]
    assert run.of_channels("V", "W") == run


def test_sky_may_exceed_what_the_pixels_can_analyse(plain, folder):
    run = config.load(changed(changed(plain, "sky.lmax", 1000), "biposh.lmax", 191))
    assert config.analysis_lmax(run) == 191


def test_paths_start_from_the_file_that_names_them_with_variables_expanded(plain, folder, monkeypatch, tmp_path):
    monkeypatch.setenv("MCSIM_TEST_DATA", str(folder))
    run = changed(plain, "map.mask", "${MCSIM_TEST_DATA}/mask.fits")
    assert config.load(run).map.mask == str(folder / "mask.fits")
    (folder / "deep").mkdir()
    toml = folder / "deep" / "run.toml"
    toml.write_text(
        """
        schema = 1
        name = "x"
        sky = { lmax = 8, alm = "../sky_{realization:03d}.fits" }
        map = { nside = 4, mask = "../mask_{channel}.fits" }
        ensemble = { realizations = 4, seed = 0 }
        [[channel]]
        name = "W1"
        beam = { kind = "map", path = "../beam.fits" }
        scan = { kind = "parallel_transport" }
        """
    )
    run = config.load(toml)
    assert config.channel_path(run.map.mask, "W1") == folder / "mask_W1.fits"
    assert config.sky_path(run.sky.alm, 3) == folder / "sky_003.fits"
    assert config.load(tomllib.loads(toml.read_text()), base=toml.parent) == run


def test_folder_with_braces(plain, folder):
    odd = folder / "a{b}"
    odd.mkdir()
    for name in ("mask_W1.fits", "mask_V1.fits", "scan.toml"):
        (odd / name).write_text("")
    run = config.load(changed(plain, "map.mask", "mask_{channel}.fits"), base=odd)
    assert config.channel_path(run.map.mask, "V1") == odd / "mask_V1.fits"


def test_two_beams(plain, folder):
    two = changed(plain, "channel.0.scan", DIFFERENCING)
    run = config.load(two)
    assert run.channels[0].beam_b is None
    assert run.channels[0].scan == config.ScanDifferencing(
        model="wmap_focal_plane", pair="W1", transmission_imbalance=0.0, tolerance=1e-8, max_iterations=500
    )
    assert config.pixel_window(run, run.channels[0]) == "computed"
    own = {"kind": "map", "path": "beam.fits", "angle_deg": 140.0}
    run = config.load(changed(two, "channel.0.beam_b", own))
    assert run.channels[0].beam_b == config.BeamMap(path=str(folder / "beam.fits"), angle_deg=140.0)
    with refused("channel[W1].beam_b.path", "none.fits"):
        config.load(changed(two, "channel.0.beam_b", own | {"path": "none.fits"}))
    with refused("channel[W1].beam_b.m_max", 129, "sky.lmax", 128):
        config.load(changed(two, "channel.0.beam_b", own | {"m_max": 129}))


def test_python_values(plain, folder):
    """Numpy scalars, tuples and paths are what Python has in place of TOML's values."""
    run = changed(
        changed(changed(plain, "map.nside", np.int64(64)), "map.splits", ("a", "b")), "map.mask", Path("mask.fits")
    )
    assert config.load(run) == config.load(changed(changed(plain, "map.splits", ["a", "b"]), "map.mask", "mask.fits"))


def test_dataclasses_check_themselves():
    with refused("ensemble.realizations", 1):
        config.Ensemble(realizations=0, seed=1)
    with pytest.raises(AttributeError):
        config.Noise().sigma0_uk = 1.0


def test_json_round_trip_needs_no_files(plain, folder):
    run = config.load(plain)
    (folder / "scan.toml").unlink()
    assert config.from_json(config.to_json(run)) == run


def test_resolved_writes_the_defaults_out_and_loads_as_the_same_run(plain, folder):
    run = config.load(plain)
    resolved = config.resolved(run)
    assert json.loads(json.dumps(resolved, allow_nan=False)) == resolved
    assert resolved["biposh"]["lmax"] == 128
    assert resolved["map"]["pixel_window"] is None
    del plain["channel"][0]
    assert config.resolved(config.load(plain))["map"]["pixel_window"] == "computed"
    assert config.digest(config.load(resolved)) == config.digest(run)


def test_json_schema_names_every_table(plain):
    schema = config.json_schema()
    tables = {"schema", "name", "sky", "map", "channel", "effect", "preparation", "nuisance", "biposh", "ensemble"}
    assert set(schema["properties"]) == tables | {"simulator", "compute"}
    assert schema["additionalProperties"] is False


def test_json_schema_has_parameters_beside_the_name_of_an_effect():
    """As in workflows/demo-truth.toml: an editor that validates a file must take what a run takes."""
    effect = config.json_schema()["$defs"]["Effect"]
    assert set(effect["properties"]) == {"name", "channel"}
    kinds = [one["type"] for one in effect["additionalProperties"]["anyOf"]]
    assert kinds == ["number", "string", "array"]
    assert effect["additionalProperties"]["anyOf"][2]["items"] == {"type": "number"}


def test_widths_that_may_be_in_radians_are_told(plain, folder):
    for width, warned in ((0.01, True), (1.0, False)):
        plain["channel"][1]["beam"]["fwhm_arcmin"] = width
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            config.load(plain)
        texts = [str(each.message) for each in told]
        assert [unnamed(text, "channel[V1].beam.fwhm_arcmin", width, "arcmin", "rad") for text in texts] == [
            []
        ] * warned


def test_the_pages_on_configurations_name_every_key() -> None:
    pages = Path(__file__).parents[2] / "docs" / "howto"
    text = "".join((pages / f"{page}.md").read_text("utf-8") for page in ("configuration", "survey", "real-maps"))
    schema = config.json_schema()
    tables = [schema, *schema["$defs"].values()]
    missing = [key for table in tables for key in table.get("properties", {}) if not re.search(rf"\b{key}\b", text)]
    assert missing == []
