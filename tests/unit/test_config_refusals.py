"""The configuration: one sentence for everything that it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from mcsim import config
from refusals import refused

from .conftest import DIFFERENCING, REMOVED, changed

BEAM = "channel.0.beam"
WRONG = [
    ("schema", 2, ("schema", 2, 1)),
    ("schema", True, ("schema", "true", 1)),
    ("schema", 1.0, ("schema", "1.0", 1)),
    ("name", "", ('name = ""',)),
    ("name", "a/b", ("name", "a/b")),
    ("name", REMOVED, ("name",)),
    ("nmae", "x", ("nmae", "name")),
    ("effect", [{"name": "gain_drift", "channel": "X"}], ("gain_drift", "channel", "'X'", "W1", "V1")),
    ("effect", [{"channel": "W1"}], ("effect[0].name",)),
    ("effect", [{"name": "gain_drift", "amplitude": float("nan")}], ("effect[gain_drift].amplitude",)),
    ("effect", [{"name": "gain_drift", "amplitude": {"a": 1}}], ("effect[gain_drift].amplitude",)),
    ("sky", REMOVED, ("sky",)),
    ("sky", 3, ("sky", 3)),
    ("sky.lmx", 3, ("sky.lmx", "lmax")),
    ("sky.lmax", "128", ("sky.lmax", '"128"')),
    ("sky.lmax", 128.0, ("sky.lmax", "128.0")),
    ("sky.lmax", 1, ("sky.lmax", 1, 2)),
    ("sky.lmax", 10**7, ("sky.lmax", 10**7, 32768)),
    (
        "sky.lmax",
        192,
        ("biposh.lmax", "sky.lmax", 192, "map.nside", 64, 191),
    ),
    ("sky.spectrum", REMOVED, ("sky", "spectrum", "alm", "map")),
    ("sky.spectrum", " ", ('sky.spectrum = " "',)),
    (
        "sky.spectrum",
        "wmap",
        ("sky.spectrum", "wmap", "planck2018", "wmap7"),
    ),
    ("sky", {"lmax": 8, "alm": "a", "map": "b"}, ("sky", "alm", "map")),
    ("sky.alm", "sky_{number}.fits", ("sky.alm", "sky_{number}.fits", "{realization}")),
    ("sky.alm", "sky_{realization!r}.fits", ("sky.alm", "{realization}")),
    ("sky.alm", "sky_{realization:>9}.fits", ("sky.alm", "{realization}")),
    ("sky.alm", "sky_{realization", ("sky.alm", "{realization}")),
    ("sky.alm", "sky_{}", ("sky.alm", "{realization}")),
    ("sky.alm", "sky_{realization:04d}.fits", ("sky.alm", "sky_0000.fits")),
    ("map.nside", 100, ("map.nside", 100, 64, 128)),
    ("map.nside", 0, ("map.nside", 0, 1)),
    ("map.nside", 16384, ("map.nside", 16384, 8192)),
    ("map.nside", True, ("map.nside", "true")),
    (
        "map.frame",
        "eclptic",
        ("map.frame", "eclptic", "ecliptic", "galactic", "equatorial"),
    ),
    (
        "map.mask",
        "${MCSIM_NO_SUCH_VARIABLE}/m.fits",
        ("map.mask", "MCSIM_NO_SUCH_VARIABLE"),
    ),
    ("map.mask", "none.fits", ("map.mask", "none.fits")),
    ("map.mask", "mask_{split}.fits", ("map.mask", "{split}", "map.splits")),
    ("map.mask", "mask_{realization}.fits", ("map.mask", "mask_{realization}.fits", "{channel}", "{split}")),
    ("map.mask", "a\0b", ("map.mask",)),
    ("map.mask", "m" * 5000, ("map.mask",)),
    ("map.mask", "${}", ("map.mask", "{channel}", "{split}")),
    ("map.splits", ["a", "a"], ("map.splits", '["a", "a"]')),
    ("map.splits", ["a:b"], ("map.splits[0]", "a:b")),
    ("map.splits", "ab", ("map.splits", '"ab"')),
    ("map.pixel_window", "compted", ("map.pixel_window", "compted")),
    ("channel", [], ("channel",)),
    ("channel", {}, ("channel", "{}")),
    ("channel.1.name", "W1", ("channel", "'W1'")),
    ("channel.0.name", "W1,V1", ("channel[W1,V1].name",)),
    ("channel.0.name", "W\n1", ("channel[0].name",)),
    ("channel.0.frequency_ghz", -94.0, ("channel[W1].frequency_ghz", -94.0, 0)),
    ("channel.0.noise.sigma0_uk", -1, ("channel[W1].noise.sigma0_uk", -1, 0)),
    ("channel.0.noise.sigma0_uk", float("nan"), ("channel[W1].noise.sigma0_uk", "NaN")),
    ("channel.0.noise.sigma0", 1.0, ("channel[W1].noise.sigma0", "sigma0_uk")),
    (BEAM, REMOVED, ("channel[W1].beam",)),
    (BEAM, 3, ("channel[W1].beam", 3)),
    (BEAM, {}, ("channel[W1].beam.kind",)),
    (
        f"{BEAM}.kind",
        "gausian",
        ("channel[W1].beam.kind", "gausian", "gaussian", "elliptical_gaussian"),
    ),
    (f"{BEAM}.fwhm_arcmin", 1.0, ("channel[W1].beam.fwhm_arcmin", "fwhm_minor_arcmin")),
    (f"{BEAM}.fwhm_minor_arcmin", REMOVED, ("channel[W1].beam.fwhm_minor_arcmin",)),
    (f"{BEAM}.fwhm_minor_arcmin", 0.0, ("channel[W1].beam.fwhm_minor_arcmin", "0.0")),
    (
        f"{BEAM}.fwhm_minor_arcmin",
        70.0,
        ("channel[W1].beam", "fwhm_major_arcmin", 60, "fwhm_minor_arcmin", 70),
    ),
    (f"{BEAM}.fwhm_major_arcmin", float("inf"), ("channel[W1].beam.fwhm_major_arcmin", "Infinity")),
    (f"{BEAM}.m_max", 129, ("channel[W1].beam.m_max", 129, "sky.lmax", 128)),
    (f"{BEAM}.m_max", -1, ("channel[W1].beam.m_max", -1, 0)),
    (
        BEAM,
        {"kind": "map", "path": "b.fits"},
        ("channel[W1].beam.path", "b.fits"),
    ),
    (
        BEAM,
        {"kind": "map", "path": "beam.fits", "pixel_deg": 0},
        ("channel[W1].beam.pixel_deg", 0),
    ),
    (
        BEAM,
        {"kind": "map", "path": "beam.fits", "map": 0},
        ("channel[W1].beam.map", "kind", "path", "pixel_deg", "cut_deg", "projection", "angle_deg", "m_max"),
    ),
    (BEAM, {"kind": "blm", "path": "{split}.fits"}, ("channel[W1].beam.path", "{split}.fits", "{channel}")),
    (
        "channel.0.scan.kind",
        "differncing",
        ("channel[W1].scan.kind", "differncing", "differencing", "parallel_transport"),
    ),
    ("channel.0.scan", {"kind": "differencing", "model": "wmap"}, ("channel[W1].scan.pair",)),
    ("channel.0.scan", DIFFERENCING | {"transmission_imbalance": 1}, ("channel[W1].scan.transmission_imbalance", 1)),
    ("channel.0.scan", DIFFERENCING | {"tolerance": 0.0}, ("channel[W1].scan.tolerance", "0.0", "1e-14")),
    ("channel.0.scan", DIFFERENCING | {"max_iterations": 0}, ("channel[W1].scan.max_iterations", 0, 1)),
    (
        "channel.0.scan",
        DIFFERENCING | {"model": "none.toml"},
        ("channel[W1].scan.model", "none.toml", "wmap_focal_plane"),
    ),
    (
        "channel.0.scan",
        DIFFERENCING | {"lines": 1},
        ("channel[W1].scan.lines", "kind", "model", "pair", "sample_period_s"),
    ),
    (
        "channel.0.beam_b",
        {"kind": "gaussian", "fwhm_arcmin": 30.0},
        ("channel[W1]", "beam_b", "parallel_transport", "differencing"),
    ),
    ("channel.0.beam_b", {"kind": "gaussian", "fwhm": 3.0}, ("channel[W1].beam_b.fwhm",)),
    ("map.mask_frame", "galactic", ("map", "mask_frame", "mask")),
    ("map.mask_apodisation_deg", 2.0, ("map", "mask_apodisation_deg", "mask")),
    ("map.mask_apodisation_deg", -1.0, ("map.mask_apodisation_deg", "-1.0")),
    ("channel.1.scan.model", "wmpa", ("channel[V1].scan.model", "wmpa", "wmap")),
    ("channel.1.scan.sample_period_s", 0, ("channel[V1].scan.sample_period_s", 0)),
    ("channel.0.scan.psi0_deg", "x", ("channel[W1].scan.psi0_deg", "x")),
    ("channel", {"name": "W1"}, ("channel", "[[channel]]")),
    ("sky", [{"spectrum": "wmap7", "lmax": 32}], ("sky", "[sky]")),
    ("biposh.L_max", -1, ("biposh.L_max", -1, 0)),
    ("biposh.L_max", 129, ("biposh.L_max", 129, "lmax", 128)),
    ("biposh.lmax", 129, ("biposh.lmax", 129, "sky.lmax", 128)),
    ("biposh.summary_bin", 0, ("biposh.summary_bin", 0)),
    ("biposh.weighting", "hit", ("biposh.weighting", "hit", "hits")),
    ("biposh.iterations", -1, ("biposh.iterations", -1)),
    ("biposh.pairs", "some", ("biposh.pairs", "some", "all", "auto")),
    ("ensemble.realizations", 0, ("ensemble.realizations", 0, 1)),
    ("ensemble.seed", -1, ("ensemble.seed", -1, 0)),
    ("ensemble.seed", 10**40, ("ensemble.seed", 10**40, 2**63 - 1)),
    ("ensemble.paired", 1, ("ensemble.paired", 1, "true", "false")),
    ("ensemble.paired", b"x", ("b'x'", "bytes")),
    ("compute.workers", 0, ("compute.workers", 0, 1)),
    ("compute.chunk", 12, ("compute.chunk", 12, 8, 16)),
    ("compute.thread", 1, ("compute.thread", "workers", "chunk")),
]


@pytest.mark.parametrize(
    ("key", "value", "named"), WRONG, ids=[f"{key}={str(value)[:20]!r}" for key, value, _ in WRONG]
)
def test_wrong_values_get_one_sentence(plain, folder, key, value, named):
    with refused(*named) as caught:
        config.load(changed(plain, key, value))
    sentence = str(caught.value)
    assert sentence.startswith("configuration")
    assert sentence.endswith(".")
    assert "\n" not in sentence


def test_unknown_key_is_named_before_the_missing_one_that_it_explains(plain, folder):
    wrong = changed(changed(plain, "ensemble.seed", REMOVED), "ensemble.sead", 1)
    with refused("ensemble.sead", "seed"):
        config.load(wrong)


@pytest.mark.parametrize(
    ("contents", "named"),
    [
        (b"schema = 1\nname = \n", ("run.toml", "TOML", "line 2")),
        (b"schema = 1\nschema = 1\n", ("run.toml", "TOML", "line 2")),
        (b"\xff\xfe", ("run.toml", "UTF-8")),
        (b"", ("run.toml", "name")),
        (b"name = 1979-05-27", ("run.toml", "1979-05-27", "date")),
        (b"schema = 7", ("run.toml", "schema", 7)),
    ],
)
def test_wrong_files(tmp_path, contents, named):
    path = tmp_path / "run.toml"
    path.write_bytes(contents)
    with refused(*named):
        config.load(path)


def test_missing_file_lists_the_packaged_workflows(tmp_path):
    with refused("none.toml", "quickstart"):
        config.load(tmp_path / "none.toml")


def test_skies_of_every_realization_are_looked_for(plain, folder):
    run = changed(plain, "sky", {"lmax": 128, "map": "sky_{realization:03d}.fits"})
    loaded = config.load(run)
    config.check_skies(loaded, range(2, 4))
    with refused("sky.map", "sky_004.fits"):
        config.load(changed(run, "ensemble.realizations", 5))
    with refused("sky.map", "sky_009.fits"):
        config.check_skies(loaded, range(9, 10))


def test_a_key_that_differs_in_case_alone_is_the_one_that_is_meant(plain, folder):
    with refused("biposh.l_max") as found:
        config.load(changed(plain, "biposh.l_max", 2))
    assert "(did you mean L_max?)" in str(found.value)


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda run: replace(run.map, nside=15), ("map.nside = 15", "16")),
        (lambda run: replace(run.ensemble, realizations=-4), ("ensemble.realizations = -4", "1")),
        (lambda run: config.Noise(sigma0_uk=-5.0), ("channel.noise.sigma0_uk = -5.0", "0")),
        (lambda run: config.Map(), ("map", "nside")),
        (lambda run: config.Effect(name="beam_width", chanel="V"), ("effect.chanel", "channel")),
        (lambda run: replace(run, biposh=replace(run.biposh, filter="inverse_covariance")), ("biposh.filter",)),
        (lambda run: replace(run, name=3), ("name = 3",)),
        (lambda run: config.ScanHitAveraged(modell="wmap"), ("channel.scan.modell", "model")),
        (lambda run: config.BeamGaussian(3.0), ("channel.beam", "3.0")),
        (lambda run: replace(run.ensemble, seed=np.int64(3)), ("ensemble.seed = 3",)),
    ],
)
def test_what_python_builds_is_refused_as_a_file_is(make, named):
    """It was an error of the library that checks, with a link to its pages."""
    with refused(*named):
        make(config.load("tiny"))
