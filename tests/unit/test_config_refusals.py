"""The configuration: one sentence for everything that it refuses."""

import pytest

from mcsim import config
from mcsim.errors import InputError

from .conftest import DIFFERENCING, REMOVED, changed

BEAM = "channel.0.beam"
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
