"""The configuration: what it accepts, the sentence for everything that it refuses, and what its hash covers."""

import copy
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from mcsim import config, resources
from mcsim.errors import InputError

REMOVED = object()


@pytest.fixture
def plain() -> dict:
    """A small valid run as TOML would give it."""
    return {
        "schema": 1,
        "name": "demo",
        "sky": {"spectrum": "wmap7", "lmax": 128},
        "map": {"nside": 64},
        "channel": [
            {
                "name": "W1",
                "frequency_ghz": 94.0,
                "beam": {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 60.0, "fwhm_minor_arcmin": 50},
                "noise": {"sigma0_uk": 0.0},
                "scan": {"kind": "parallel_transport"},
            },
            {
                "name": "V1",
                "beam": {"kind": "gaussian", "fwhm_arcmin": 30.0},
                "scan": {"kind": "hit_averaged", "model": "scan.toml"},
            },
        ],
        "biposh": {"L_max": 2},
        "ensemble": {"realizations": 4, "seed": 1},
    }


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Working folder with the files that the runs of this module name."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MCSIM_NO_SUCH_VARIABLE", raising=False)
    for name in ("scan.toml", "mask.fits", "mask_W1.fits", "mask_V1.fits", "beam.fits", "alm.fits", "win.fits"):
        Path(name).write_text(f"contents of {name}")
    for number in range(4):
        Path(f"sky_{number:03d}.fits").write_text(str(number))
    return tmp_path


def changed(plain: dict, key: str, value: object) -> dict:
    """Copy with the dotted key (numbers index lists) set, or removed."""
    result = copy.deepcopy(plain)
    *parents, last = [int(part) if part.isdigit() else part for part in key.split(".")]
    holder = result
    for part in parents:
        holder = holder.setdefault(part, {}) if isinstance(holder, dict) else holder[part]
    if value is REMOVED:
        del holder[last]
    else:
        holder[last] = value
    return result


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


def test_quickstart_is_packaged_and_documented_values_hold():
    run = config.load("quickstart")
    assert (run.map.nside, run.sky.lmax, run.biposh.L_max, run.ensemble.realizations) == (128, 256, 2, 64)
    assert run.ensemble.paired
    assert run.channels[0].scan.model == "wmap"


def test_names_of_maps_and_pixel_windows_with_splits(plain, folder):
    run = config.load(changed(changed(plain, "map.splits", ["half1", "half2"]), "map.pixel_window", "win.fits"))
    assert config.map_names(run) == ("W1:half1", "W1:half2", "V1:half1", "V1:half2")
    assert config.pixel_window(run, run.channels[0]) == str(folder / "win.fits")


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
    with pytest.raises(InputError, match=r"channel\[W1\]\.beam_b\.path names the file '.*none\.fits', which does not"):
        config.load(changed(two, "channel.0.beam_b", own | {"path": "none.fits"}))
    with pytest.raises(InputError, match=r"channel\[W1\]\.beam_b\.m_max = 129 is above sky\.lmax = 128; lower m_max"):
        config.load(changed(two, "channel.0.beam_b", own | {"m_max": 129}))


def test_python_values(plain, folder):
    """Numpy scalars, tuples and paths are what Python has in place of TOML's values."""
    run = changed(
        changed(changed(plain, "map.nside", np.int64(64)), "map.splits", ("a", "b")), "map.mask", Path("mask.fits")
    )
    assert config.load(run) == config.load(changed(changed(plain, "map.splits", ["a", "b"]), "map.mask", "mask.fits"))


def test_dataclasses_check_themselves():
    with pytest.raises(ValueError, match="realizations"):
        config.Ensemble(realizations=0, seed=1)
    with pytest.raises(AttributeError):
        config.Noise().sigma0_uk = 1.0


BEAM = "channel.0.beam"
DIFFERENCING = {"kind": "differencing", "model": "wmap_focal_plane", "pair": "W1"}
WRONG = [
    ("schema", 2, r"schema = 2 is not supported; this version of mcsim reads schema = 1"),
    ("schema", True, r"schema = true is not supported"),
    ("schema", 1.0, r"schema = 1\.0 is not supported"),
    ("name", "", r'name = "" is not a usable name'),
    ("name", "a/b", r'name = "a/b" is not a usable name: .* rename it'),
    ("name", REMOVED, r"the key name is missing; add it"),
    ("nmae", "x", r"the key nmae is unknown \(did you mean name\?\); remove it or correct it"),
    ("effect", [{"name": "gain_drift", "channel": "X"}], r"effect gain_drift: channel = 'X' is no channel of the run"),
    ("effect", [{"channel": "W1"}], r"name is missing"),
    ("sky", REMOVED, r"the key sky is missing; add it"),
    ("sky", 3, r"sky = 3 .* give a table of keys"),
    ("sky.lmx", 3, r"the key sky\.lmx is unknown \(did you mean lmax\?\)"),
    ("sky.lmax", "128", r'sky\.lmax = "128" has the wrong type or value; give a whole number'),
    ("sky.lmax", 128.0, r"sky\.lmax = 128\.0 .* give a whole number"),
    ("sky.lmax", 1, r"sky\.lmax = 1 is too small; give at least 2"),
    ("sky.lmax", 10**7, r"sky\.lmax = 10000000 is too large; give at most 32768"),
    (
        "sky.lmax",
        192,
        r"biposh\.lmax \(by default sky\.lmax\) = 192 is above 3 nside - 1 = 191 .* set biposh\.lmax to at most 191",
    ),
    ("sky.spectrum", REMOVED, r"sky: none of spectrum, alm, map is given; add one"),
    ("sky.spectrum", " ", r'sky\.spectrum = " " is empty; give a name or a path'),
    (
        "sky.spectrum",
        "wmap",
        r"sky\.spectrum names the file '.*wmap', which does not exist; .* packaged names planck2018, wmap7",
    ),
    ("sky", {"lmax": 8, "alm": "a", "map": "b"}, r"sky: both alm and map are given; keep one"),
    ("sky.alm", "sky_{number}.fits", r"sky\.alm = .* placeholder .* use \{realization\} only"),
    ("sky.alm", "sky_{realization!r}.fits", r"placeholder"),
    ("sky.alm", "sky_{realization:>9}.fits", r"placeholder"),
    ("sky.alm", "sky_{realization", r"placeholder"),
    ("sky.alm", "sky_{}", r"placeholder"),
    ("sky.alm", "sky_{realization:04d}.fits", r"sky_0000\.fits', which does not exist"),
    ("map.nside", 100, r"map\.nside = 100 is not a power of two; use 64 or 128"),
    ("map.nside", 0, r"map\.nside = 0 is too small; give at least 1"),
    ("map.nside", 16384, r"map\.nside = 16384 is too large; give at most 8192"),
    ("map.nside", True, r"map\.nside = true .* give a whole number"),
    (
        "map.frame",
        "eclptic",
        r"map\.frame = \"eclptic\" is unknown \(did you mean ecliptic\?\); use one of ecliptic, galactic, equatorial",
    ),
    (
        "map.mask",
        "${MCSIM_NO_SUCH_VARIABLE}/m.fits",
        r"map\.mask = .* environment variable MCSIM_NO_SUCH_VARIABLE, which is not set; set it",
    ),
    ("map.mask", "none.fits", r"map\.mask names the file '.*none\.fits', which does not exist"),
    ("map.mask", "mask_{split}.fits", r"contains \{split\}, but map\.splits is empty; name the splits"),
    ("map.mask", "mask_{realization}.fits", r"use \{channel\}, \{split\} only"),
    ("map.mask", "a\0b", r"which does not exist"),
    ("map.mask", "m" * 5000, r"which does not exist"),
    ("map.mask", "${}", r"placeholder"),
    ("map.splits", ["a", "a"], r"map\.splits = \[\"a\", \"a\"\] names 'a' twice"),
    ("map.splits", ["a:b"], r"map\.splits\[0\] = \"a:b\" is not a usable name"),
    ("map.splits", "ab", r"map\.splits = \"ab\" .* give a list"),
    ("map.pixel_window", "compted", r"map\.pixel_window names the file '.*compted', which does not exist"),
    ("channel", [], r"channel is empty; give at least one"),
    ("channel", {}, r"channel = \{\} .* give a list"),
    ("channel.1.name", "W1", r"channel names 'W1' twice"),
    ("channel.0.name", "W1,V1", r"is not a usable name"),
    ("channel.0.name", "W\n1", r"is not a usable name"),
    ("channel.0.frequency_ghz", -94.0, r"channel\[W1\]\.frequency_ghz = -94\.0 is too small; give above 0"),
    ("channel.0.noise.sigma0_uk", -1, r"channel\[W1\]\.noise\.sigma0_uk = -1 is too small; give at least 0"),
    ("channel.0.noise.sigma0_uk", float("nan"), r"sigma0_uk = NaN .* give a finite number"),
    ("channel.0.noise.sigma0", 1.0, r"channel\[W1\]\.noise\.sigma0 is unknown \(did you mean sigma0_uk\?\)"),
    (BEAM, REMOVED, r"the key channel\[W1\]\.beam is missing"),
    (BEAM, 3, r"channel\[W1\]\.beam = 3 .* give a table of keys"),
    (BEAM, {}, r"the key channel\[W1\]\.beam\.kind is missing"),
    (
        f"{BEAM}.kind",
        "gausian",
        r"beam\.kind = \"gausian\" is unknown \(did you mean gaussian\?\); use one of gaussian, ell",
    ),
    (f"{BEAM}.fwhm_arcmin", 1.0, r"beam\.fwhm_arcmin is unknown"),
    (f"{BEAM}.fwhm_minor_arcmin", REMOVED, r"the key channel\[W1\]\.beam\.fwhm_minor_arcmin is missing"),
    (f"{BEAM}.fwhm_minor_arcmin", 0.0, r"fwhm_minor_arcmin = 0\.0 is too small; give above 0"),
    (
        f"{BEAM}.fwhm_minor_arcmin",
        70.0,
        r"fwhm_major_arcmin = 60 is smaller than fwhm_minor_arcmin = 70; exchange them",
    ),
    (f"{BEAM}.fwhm_major_arcmin", float("inf"), r"fwhm_major_arcmin = Infinity .* give a finite number"),
    (f"{BEAM}.m_max", 129, r"channel\[W1\]\.beam\.m_max = 129 is above sky\.lmax = 128; lower m_max"),
    (f"{BEAM}.m_max", -1, r"beam\.m_max = -1 is too small; give at least 0"),
    (
        BEAM,
        {"kind": "map", "path": "b.fits"},
        r"channel\[W1\]\.beam\.path names the file '.*b\.fits', which does not exist",
    ),
    (
        BEAM,
        {"kind": "map", "path": "beam.fits", "pixel_deg": 0},
        r"channel\[W1\]\.beam\.pixel_deg = 0 is too small; give above 0",
    ),
    (
        BEAM,
        {"kind": "map", "path": "beam.fits", "map": 0},
        r"channel\[W1\]\.beam\.map is unknown.* kind, path, pixel_deg, cut_deg, .*, projection, angle_deg, m_max",
    ),
    (BEAM, {"kind": "blm", "path": "{split}.fits"}, r"use \{channel\} only"),
    (
        "channel.0.scan.kind",
        "differncing",
        r"scan\.kind = \"differncing\" is unknown \(did you mean differencing\?\); use one of parallel",
    ),
    ("channel.0.scan", {"kind": "differencing", "model": "wmap"}, r"the key channel\[W1\]\.scan\.pair is missing"),
    ("channel.0.scan", DIFFERENCING | {"transmission_imbalance": 1}, r"imbalance = 1 is too large; give below 1"),
    ("channel.0.scan", DIFFERENCING | {"tolerance": 0.0}, r"scan\.tolerance = 0\.0 is too small; give at least 1e-14"),
    ("channel.0.scan", DIFFERENCING | {"max_iterations": 0}, r"max_iterations = 0 is too small; give at least 1"),
    ("channel.0.scan", DIFFERENCING | {"model": "none.toml"}, r"scan\.model names the file '.*none\.toml', which does"),
    ("channel.0.scan", DIFFERENCING | {"lines": 1}, r"scan\.lines is unknown; .* kind, model, pair, sample_period_s"),
    (
        "channel.0.beam_b",
        {"kind": "gaussian", "fwhm_arcmin": 30.0},
        r'channel\[W1\]: beam_b is given, but a scan of kind "parallel_transport" has one beam; remove beam_b',
    ),
    ("channel.0.beam_b", {"kind": "gaussian", "fwhm": 3.0}, r"channel\[W1\]\.beam_b\.fwhm is unknown"),
    ("map.mask_frame", "galactic", r"map: mask_frame is given without a mask; add mask or remove mask_frame"),
    ("map.mask_apodisation_deg", 2.0, r"map: mask_apodisation_deg is given without a mask; add mask"),
    ("map.mask_apodisation_deg", -1.0, r"map\.mask_apodisation_deg = -1\.0 is too small; give at least 0"),
    ("channel.1.scan.model", "wmpa", r"channel\[V1\]\.scan\.model names the file .* packaged names .*wmap"),
    ("channel.1.scan.sample_period_s", 0, r"scan\.sample_period_s = 0 is too small; give above 0"),
    ("channel.0.scan.psi0_deg", "x", r"scan\.psi0_deg = \"x\" .* give a number"),
    ("biposh.L_max", -1, r"biposh\.L_max = -1 is too small; give at least 0"),
    ("biposh.L_max", 129, r"biposh\.L_max = 129 is above the lmax of the analysis, 128"),
    ("biposh.lmax", 129, r"biposh\.lmax = 129 is above sky\.lmax = 128; lower it or raise sky\.lmax"),
    ("biposh.summary_bin", 0, r"biposh\.summary_bin = 0 is too small"),
    ("biposh.weighting", "hit", r"biposh\.weighting = \"hit\" is unknown \(did you mean hits\?\)"),
    ("biposh.iterations", -1, r"biposh\.iterations = -1 is too small"),
    ("biposh.pairs", "some", r"biposh\.pairs = \"some\" is unknown; use one of all, auto"),
    ("ensemble.realizations", 0, r"ensemble\.realizations = 0 is too small; give at least 1"),
    ("ensemble.seed", -1, r"ensemble\.seed = -1 is too small; give at least 0"),
    ("ensemble.seed", 10**40, r"ensemble\.seed = 1000.* is too large; give at most 9223372036854775807"),
    ("ensemble.paired", 1, r"ensemble\.paired = 1 .* give true or false"),
    ("ensemble.paired", b"x", r"is a bytes; give a number, text, true or false"),
    ("compute.workers", 0, r"compute\.workers = 0 is too small; give at least 1"),
    ("compute.chunk", 12, r"compute\.chunk = 12 is not a power of two; use 8 or 16"),
    ("compute.thread", 1, r"compute\.thread is unknown; remove it or correct it to one of workers, chunk"),
]


@pytest.mark.parametrize(
    ("key", "value", "message"), WRONG, ids=[f"{key}={str(value)[:20]!r}" for key, value, _ in WRONG]
)
def test_wrong_values_get_one_sentence(plain, folder, key, value, message):
    with pytest.raises(InputError, match=message) as refused:
        config.load(changed(plain, key, value))
    sentence = str(refused.value)
    assert sentence.startswith("configuration")
    assert sentence.endswith(".")
    assert "\n" not in sentence


def test_unknown_key_is_named_before_the_missing_one_that_it_explains(plain, folder):
    wrong = changed(changed(plain, "ensemble.seed", REMOVED), "ensemble.sead", 1)
    with pytest.raises(InputError, match=r"ensemble\.sead is unknown \(did you mean seed\?\)"):
        config.load(wrong)


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        (b"schema = 1\nname = \n", r"run\.toml is not valid TOML: .*line 2.*; correct it there"),
        (b"schema = 1\nschema = 1\n", r"run\.toml is not valid TOML: .*line 2"),
        (b"\xff\xfe", r"run\.toml is not text in UTF-8; give a TOML file"),
        (b"", r"run\.toml: the key name is missing; add it"),
        (b"name = 1979-05-27", r"run\.toml: the value \"1979-05-27\" is a date"),
        (b"schema = 7", r"run\.toml: (schema = 7|the key name)"),
    ],
)
def test_wrong_files(tmp_path, contents, message):
    path = tmp_path / "run.toml"
    path.write_bytes(contents)
    with pytest.raises(InputError, match=message):
        config.load(path)


def test_missing_file_lists_the_packaged_workflows(tmp_path):
    with pytest.raises(InputError, match=r"run configuration '.*none\.toml' is neither a file .*one of: .*quickstart"):
        config.load(tmp_path / "none.toml")


def test_skies_of_every_realization_are_looked_for(plain, folder):
    run = changed(plain, "sky", {"lmax": 128, "map": "sky_{realization:03d}.fits"})
    loaded = config.load(run)
    config.check_skies(loaded, range(2, 4))
    with pytest.raises(InputError, match=r"sky_004\.fits', which does not exist"):
        config.load(changed(run, "ensemble.realizations", 5))
    with pytest.raises(InputError, match=r"sky_009\.fits', which does not exist"):
        config.check_skies(loaded, range(9, 10))


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
    tables = {"schema", "name", "sky", "map", "channel", "effect", "biposh", "ensemble", "compute"}
    assert set(schema["properties"]) == tables
    assert schema["additionalProperties"] is False


UNIMPORTANT = [
    ("name", "other"),
    ("ensemble.realizations", 3),
    ("ensemble.keep_maps", True),
    ("compute.workers", 9),
    ("compute.chunk", 8),
    ("schema", 1),
    ("biposh.lmax", 128),
    ("map.frame", "ecliptic"),
    ("channel.0.beam.angle_deg", 0.0),
    ("channel.0.beam.fwhm_major_arcmin", 60),
]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("channel.0.scan.max_iterations", 9),
        ("map.mask_frame", None),
        ("map.mask_apodisation_deg", 0.0),
        ("channel.1.beam.angle_deg", 0.0),
    ],
)
def test_neither_do_these_of_two_beams_and_a_mask(plain, folder, key, value):
    run = with_two_beams_and_mask(plain)
    assert config.digest(config.load(changed(run, key, value))) == config.digest(config.load(run))


def with_two_beams_and_mask(plain: dict) -> dict:
    run = changed(
        changed(plain, "channel.0.scan", DIFFERENCING), "channel.1.beam", {"kind": "blm", "path": "beam.fits"}
    )
    return changed(run, "map.mask", "mask.fits")


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("channel.0.scan.pair", "W2", 'channel[W1].scan.pair: "W1" -> "W2"'),
        ("channel.0.scan.tolerance", 1e-6, "channel[W1].scan.tolerance: 1e-08 -> 1e-06"),
        ("channel.0.scan.transmission_imbalance", 0.01, "channel[W1].scan.transmission_imbalance: 0.0 -> 0.01"),
        ("channel.0.scan.model", "scan.toml", "channel[W1].scan.model: contents sha256:"),
        ("channel.1.beam.angle_deg", 5.0, "channel[V1].beam.angle_deg: absent -> 5.0"),
        ("map.mask_frame", "galactic", 'map.mask_frame: absent -> "galactic"'),
        ("map.mask_apodisation_deg", 3.0, "map.mask_apodisation_deg: absent -> 3.0"),
    ],
)
def test_but_these_of_two_beams_and_a_mask_do(plain, folder, key, value, expected):
    run = with_two_beams_and_mask(plain)
    old, new = config.science(config.load(run)), config.science(config.load(changed(run, key, value)))
    (found,) = config.differences(old, new)
    assert found.startswith(expected)


@pytest.mark.parametrize(("key", "value"), UNIMPORTANT)
def test_what_does_not_change_a_result_does_not_change_the_hash(plain, folder, key, value):
    assert config.digest(config.load(changed(plain, key, value))) == config.digest(config.load(plain))


IMPORTANT = [
    ("sky.lmax", 100, ["biposh.lmax: 128 -> 100", "sky.lmax: 128 -> 100"]),
    ("sky.spectrum", "planck2018", [r"sky.spectrum: contents sha256:"]),
    ("map.nside", 128, ["map.nside: 64 -> 128"]),
    ("map.frame", "galactic", ['map.frame: "ecliptic" -> "galactic"']),
    ("map.mask", "mask.fits", ["map.mask: null -> contents sha256:"]),
    ("map.splits", ["a"], ["map.splits: [] -> "]),
    ("map.pixel_window", "none", ['channel[V1].pixel_window: "computed" -> "none"']),
    ("channel.0.beam.angle_deg", 1.0, ["channel[W1].beam.angle_deg: 0.0 -> 1.0"]),
    ("channel.0.noise.sigma0_uk", 2.0, ["channel[W1].noise.sigma0_uk: 0.0 -> 2.0"]),
    ("channel.1.scan.model", "mask.fits", ["channel[V1].scan.model: contents sha256:"]),
    ("biposh.L_max", 3, ["biposh.L_max: 2 -> 3"]),
    ("biposh.summary_bin", 10, ["biposh.summary_bin: 50 -> 10"]),
    ("biposh.weighting", "hits", ['biposh.weighting: "uniform" -> "hits"']),
    ("ensemble.seed", 2, ["ensemble.seed: 1 -> 2"]),
    ("ensemble.paired", False, ["ensemble.paired: true -> false"]),
]


@pytest.mark.parametrize(("key", "value", "expected"), IMPORTANT)
def test_what_changes_a_result_changes_the_hash_and_is_named(plain, folder, key, value, expected):
    old, new = config.load(plain), config.load(changed(plain, key, value))
    assert config.digest(old) != config.digest(new)
    found = config.differences(config.science(old), config.science(new))
    assert len(found) == len(expected)
    for sentence, start in zip(found, expected, strict=True):
        assert sentence.startswith(start)
    assert config.differences(config.science(old), config.science(old)) == []


def test_order_and_number_of_channels(plain, folder):
    old = config.science(config.load(plain))
    plain["channel"].reverse()
    assert config.differences(old, config.science(config.load(plain))) == ["channel (order): W1, V1 -> V1, W1"]
    del plain["channel"][0]
    found = config.differences(old, config.science(config.load(plain)))
    assert found[0] == "channel (order): W1, V1 -> W1"
    assert 'channel[V1].beam.kind: "gaussian" -> absent' in found


def test_hash_covers_contents_of_files_and_not_their_place(plain, folder):
    digest = config.digest(config.load(plain))
    moved = folder / "elsewhere" / "renamed.toml"
    moved.parent.mkdir()
    moved.write_bytes(Path("scan.toml").read_bytes())
    assert config.digest(config.load(changed(plain, "channel.1.scan.model", str(moved)))) == digest
    copied = folder / "cl.txt"
    copied.write_bytes(resources.spectrum("wmap7").read_bytes())
    assert config.digest(config.load(changed(plain, "sky.spectrum", "cl.txt"))) == digest
    Path("scan.toml").write_text("other contents")
    assert config.digest(config.load(plain)) != digest


def test_hash_covers_every_file_of_a_template(plain, folder):
    run = config.load(changed(plain, "map.mask", "mask_{channel}.fits"))
    before = config.science(run)
    assert set(before["map"]["mask"]) == {"W1", "V1"}
    Path("mask_V1.fits").write_text("other contents")
    (difference,) = config.differences(before, config.science(run))
    assert difference.startswith("map.mask.V1: contents sha256:")


def test_given_skies_are_hashed_by_template_and_first_file(plain, folder):
    run = config.load(changed(plain, "sky", {"lmax": 128, "map": "sky_{realization:03d}.fits"}))
    before = config.science(run)
    assert before["sky"]["map"]["template"] == "sky_{realization:03d}.fits"
    Path("sky_003.fits").write_text("not read")
    assert config.science(run) == before
    Path("sky_000.fits").write_text("read")
    assert config.science(run) != before


def test_given_skies_may_be_moved(plain, folder):
    """Only the part of the template with the placeholder counts, whatever the folders above it are called."""
    digests = set()
    for name in ("here", "a{b}", "deep/there"):
        (folder / name / "sims").mkdir(parents=True)
        for number in range(4):
            (folder / name / "sims" / f"{number}.fits").write_text(str(number))
        run = changed(plain, "sky", {"lmax": 128, "alm": "sims/{realization}.fits"})
        digests.add(
            config.digest(
                config.load(changed(run, "channel.1.scan", {"kind": "parallel_transport"}), base=folder / name)
            )
        )
    assert len(digests) == 1


def test_what_the_hash_covers():
    """Whatever changes here refuses to continue every store of earlier versions: it must be meant."""
    run = config.RunConfig(
        name="x",
        sky=config.Sky(spectrum="wmap7", lmax=8),
        map=config.Map(nside=4),
        channels=(
            config.Channel(name="A", beam=config.BeamGaussian(fwhm_arcmin=600.0), scan=config.ScanParallelTransport()),
        ),
        ensemble=config.Ensemble(realizations=1, seed=0),
    )
    science = config.science(run)
    science["sky"]["spectrum"] = "sha256:0"
    assert science == {
        "schema": 1,
        "sky": {"spectrum": "sha256:0", "lmax": 8, "alm": None, "map": None},
        "map": {"nside": 4, "frame": "ecliptic", "mask": None, "splits": []},
        "channel": [
            {
                "name": "A",
                "frequency_ghz": None,
                "beam": {"kind": "gaussian", "fwhm_arcmin": 600.0},
                "noise": {"sigma0_uk": 0.0},
                "scan": {"kind": "parallel_transport", "psi0_deg": 0.0},
                "pixel_window": "none",
            }
        ],
        "biposh": {"L_max": 2, "lmax": 8, "summary_bin": 50, "weighting": "uniform", "iterations": 0, "pairs": "all"},
        "ensemble": {"seed": 0, "paired": True},
    }
