"""The public library: its names, their documentation and examples, and that sizes are checked."""

import dataclasses
import doctest
import importlib
import inspect
import re
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from pydoc import plain, render_doc

import ducc0
import healpy
import numpy as np
import pytest
from distributed import Client, LocalCluster

import mcsim
from datasets import undescribed
from mcsim import config
from mcsim.bipolar import estimate, estimator
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.ensemble import plan
from mcsim.ensemble.runner import cluster
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import Moments, ScanModel
from mcsim.plot.look import look_at_beams
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.sphere import alm as alm_
from mcsim.sphere.sky import gaussian_alm
from refusals import refused

NAMES = [
    "Beam",
    "DiagnosisSettings",
    "Effect",
    "ExternalModel",
    "InputError",
    "LimitSettings",
    "Moments",
    "RunConfig",
    "RunError",
    "ScanModel",
    "__version__",
    "biposh",
    "compare",
    "diagnose",
    "effects",
    "fit",
    "limit",
    "load_config",
    "merge",
    "observe",
    "open_ensemble",
    "open_summary",
    "predict",
    "prepare",
    "run",
    "write_maps",
]
OBJECTS = [name for name in NAMES if name != "__version__"]

WITHOUT_EXAMPLE = {"diagnose"}
"""Its example is a tutorial: nothing that it can be shown on takes a second."""

CONSTRUCTORS = [
    *(getattr(Beam, name) for name in ("gaussian", "elliptical", "from_map", "from_blm")),
    *(getattr(Moments, name) for name in ("from_model", "from_pointing", "parallel_transport", "limit")),
    ScanModel.load,
]


def test_names_are_pinned() -> None:
    assert mcsim.__all__ == NAMES
    assert all(hasattr(mcsim, name) for name in NAMES)
    assert set(NAMES) <= set(dir(mcsim))
    assert not {"Any", "import_module", "TYPE_CHECKING"} & set(dir(mcsim))
    with refused("biposch", by=AttributeError):
        mcsim.biposch  # noqa: B018


def test_version_is_that_of_the_package() -> None:
    from importlib.metadata import version

    assert mcsim.__version__ == version("mcsim")


def test_types_are_shipped() -> None:
    assert importlib.resources.files("mcsim").joinpath("py.typed").is_file()


def test_import_is_cheap() -> None:
    """Nothing but the standard library is loaded, and every name says so to type checkers."""
    code = "import sys; before = set(sys.modules); import mcsim; print(sorted(set(sys.modules) - before))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert not any(name in loaded for name in ("numpy", "xarray", "healpy", "mcsim.", "importlib.metadata"))


def test_help_shows_every_name() -> None:
    text = plain(render_doc(mcsim))
    for name in OBJECTS:
        assert name in text


def documented() -> list:
    return [pytest.param(getattr(mcsim, name), id=name) for name in OBJECTS] + [
        pytest.param(one, id=one.__qualname__) for one in CONSTRUCTORS
    ]


@pytest.mark.parametrize("one", documented())
def test_documentation_is_complete(one) -> None:
    text = inspect.getdoc(one) or ""
    assert text.splitlines()[0].endswith((".", ","))
    if inspect.isclass(one):
        if dataclasses.is_dataclass(one):
            own = [field.name for field in dataclasses.fields(one)]
            assert all(name in text for name in own), [name for name in own if name not in text]
        return
    signature = inspect.signature(one)
    for name in signature.parameters:
        assert name in text.partition("Parameters\n")[2].partition("\nReturns\n")[0], name
    assert "\nRaises\n" in text
    assert one.__name__ in WITHOUT_EXAMPLE or "\nExamples\n" in text
    own_constructor = inspect.ismethod(one)  # its summary says what it returns
    assert own_constructor or "\nReturns\n" in text


@contextmanager
def in_this_process(workers):
    """Stand in for the cluster of processes, whose start takes seconds."""
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0") as cluster,
        Client(cluster) as client,
    ):
        yield client


@pytest.fixture(scope="session")
def example_folder(tmp_path_factory):
    return tmp_path_factory.mktemp("examples")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow) if name in ("fit", "merge") else name  # of whole ensembles
        for name in OBJECTS
        if name not in WITHOUT_EXAMPLE
    ],
)
def test_examples_run(name, example_folder, monkeypatch) -> None:
    """Each alone and in any order: what one leaves in the folder another may find, as a user's would."""
    monkeypatch.chdir(example_folder)
    monkeypatch.setattr(cluster, "local_client", in_this_process)
    one = getattr(mcsim, name)
    module = importlib.import_module(one.__module__)
    tests = [test for test in doctest.DocTestFinder().find(one, name, module=module, globs={}) if test.examples]
    assert any(test.name == name for test in tests), "it has no example of its own"
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    for test in tests:
        told: list[str] = []
        runner.run(test, out=told.append)
        assert not told, "".join(told)


NSIDE, LMAX = 8, 24


@pytest.fixture(scope="module")
def sky() -> np.ndarray:
    return gaussian_alm(1.0 / (1.0 + np.arange(LMAX + 1)) ** 2, np.random.default_rng(1))


@pytest.fixture(scope="module")
def beam() -> Beam:
    blm = Beam.elliptical(900.0, 600.0, angle_deg=30.0, lmax=LMAX, mmax=4).blm
    return Beam(blm + 0.1j * np.triu(np.abs(blm)) * (np.arange(5) > 0)[:, None])


def test_observed_map_is_the_mean_of_its_samples(sky, beam) -> None:
    """Against ducc0.totalconvolve, sample by sample, at the centres of the pixels."""
    psi = np.random.default_rng(2).uniform(0.0, 2 * np.pi, (3, 12 * NSIDE**2))
    theta, phi = healpy.pix2ang(NSIDE, np.arange(psi.shape[1]))
    packed = beam.packed()
    interpolator = ducc0.totalconvolve.Interpolator(
        sky[None], packed[None], separate=False, lmax=LMAX, kmax=beam.mmax, epsilon=1e-13, nthreads=1
    )
    samples = [interpolator.interpol(np.stack([theta, phi, angle], axis=1))[0] for angle in psi]
    moments = Moments.from_pointing(*(np.tile(angle, 3) for angle in (theta, phi)), psi.ravel(), NSIDE, beam.mmax)
    bare = dataclasses.replace(moments, dtheta=None, dphi=None)
    found = mcsim.observe(sky, beam, bare)
    assert np.std(found - np.mean(samples, axis=0)) < 1e-12 * np.std(found)


def test_observed_map_is_that_of_a_run_bit_for_bit(sky) -> None:
    """Pixel window and centroids included."""
    beam = Beam.elliptical(900.0, 600.0, angle_deg=30.0, lmax=LMAX)
    moments = Moments.from_model(ScanModel.load("wmap").with_sampling(600.0), NSIDE, beam.mmax)
    channel = {"name": "W1", "beam": beam, "scan": moments}
    table = {"name": "test", "sky": {"alm": sky, "lmax": LMAX}, "map": {"nside": NSIDE}, "channel": [channel]}
    table |= {"biposh": {"lmax": 3 * NSIDE - 1}}
    expected = simulate.maps(survey(config.load(table)), 0)[0]
    np.testing.assert_array_equal(mcsim.observe(sky, beam, moments), expected)
    assert not np.array_equal(mcsim.observe(sky, beam, moments, pixel_window=False), expected)


def test_pixels_without_hits_are_unseen(sky, beam) -> None:
    moments = Moments.from_pointing([1.0], [1.0], [0.5], NSIDE, beam.mmax)
    found = mcsim.observe(sky, beam, moments)
    assert np.count_nonzero(found != healpy.UNSEEN) == 1


def test_a_monopole_is_the_same_in_every_pixel() -> None:
    moments = mcsim.Moments.from_model(mcsim.ScanModel.load("wmap").with_sampling(60.0), nside=8)
    for window in (None, False):
        found = mcsim.observe([10.0 + 0.0j], mcsim.Beam.elliptical(600.0, 400.0, lmax=8), moments, pixel_window=window)
        np.testing.assert_allclose(found[moments.hits > 0], 10.0 / np.sqrt(4.0 * np.pi), rtol=1e-12)


@pytest.mark.parametrize("wrong", ["short", "nan", "two", "beam", "moments"])
def test_observe_checks_its_input(sky, beam, wrong) -> None:
    alm, moments = sky.copy(), Moments.parallel_transport(NSIDE, smax=beam.mmax)
    if wrong == "short":
        alm = alm[:-1]
    elif wrong == "nan":
        alm[3] = np.nan
    elif wrong == "two":
        alm = np.stack([alm, alm])
    elif wrong == "beam":
        beam = Beam.gaussian(900.0, LMAX - 1)
    else:
        moments = Moments.parallel_transport(NSIDE, smax=beam.mmax - 1)
    with pytest.raises(mcsim.InputError):
        mcsim.observe(alm, beam, moments)


@pytest.mark.parametrize("pair", [False, True])
def test_biposh_is_the_estimator_with_labels(sky, pair) -> None:
    other = np.roll(sky.conj(), 1)
    other[: LMAX + 1] = other[: LMAX + 1].real
    found = mcsim.biposh(sky, other if pair else None, L_max=3)
    tables = estimator(3, LMAX, both_orders=pair)
    np.testing.assert_array_equal(found.biposh, estimate(tables, sky, other if pair else None))
    assert [str(name) for name in found.mode.values] == [mode.name for mode in tables.modes]
    for name in ("L", "M", "d", "parity"):
        assert found[name].values.tolist() == [getattr(mode, name) for mode in tables.modes]
    second = other if pair else sky
    np.testing.assert_allclose(found.cl, healpy.alm2cl(sky, second), rtol=1e-12, atol=1e-12)
    assert found.biposh.attrs["units"] == "uK^2"
    assert found.attrs["normalisation"] == plan.CONVENTIONS["normalisation"]


def test_biposh_selects_as_plain_xarray_does(sky) -> None:
    found = mcsim.biposh(sky)
    assert undescribed(found) == []
    quadrupole = found.where(found.L == 2, drop=True)
    assert set(quadrupole.L.values) == {2}
    assert found.sel(mode="L2M0d0").biposh.shape == (LMAX + 1,)


@pytest.mark.parametrize("wrong", ["short", "nan", "other", "L_max", "negative"])
def test_biposh_checks_its_input(sky, wrong) -> None:
    bad = sky.copy()
    bad[3] = np.nan
    arguments = {
        "short": (sky[:-1],),
        "nan": (bad,),
        "other": (sky, sky[: alm_.size(LMAX - 1)]),
        "L_max": (sky, None, LMAX + 1),
        "negative": (sky, None, -1),
    }
    with pytest.raises(mcsim.InputError):
        mcsim.biposh(*arguments[wrong])


def test_effects_are_a_copy_that_reads_well() -> None:
    library = mcsim.effects()
    text = repr(library)
    for name, kind in library.items():
        assert issubclass(kind, mcsim.Effect)
        assert name in text
        assert kind.cause in text
    library.clear()
    assert mcsim.effects()


@pytest.mark.parametrize(
    "make",
    [
        lambda: Beam.gaussian(60.0, 0),
        lambda: Beam.elliptical(50.0, 60.0),
        lambda: Beam.from_map(np.ones((40, 40))),
        lambda: Beam.from_map(np.ones(40), pixel_deg=0.1),
        lambda: Beam.from_map(np.full((40, 40), np.nan), pixel_deg=0.1),
        lambda: Beam.from_blm(np.ones(5)),
        lambda: Beam.from_blm(np.zeros(alm_.size(10))),
        lambda: Beam.from_blm(np.ones((4, 3))),
        lambda: Moments.parallel_transport(7),
        lambda: Moments.parallel_transport(8, smax=0),
        lambda: Moments.from_model("no such model", 8),
        lambda: Moments.limit("wmap", 7),
        lambda: Moments.from_pointing([1.0], [1.0, 2.0], [0.0], 8),
        lambda: ScanModel.load("no such model"),
    ],
)
def test_constructors_check_their_input(make) -> None:
    with pytest.raises(mcsim.InputError):
        make()


def test_samples_that_are_none_are_said_to_be_none() -> None:
    with refused("theta", "phi", "psi", "sample"):
        Moments.from_pointing([], [], [], 8)


def test_saved_beams_and_coefficients_of_another_kind_are_refused(tmp_path) -> None:
    beam = Beam.elliptical(900.0, 600.0, lmax=LMAX, mmax=4)
    beam.save(tmp_path / "beam.npz")
    np.savez(tmp_path / "other.npz", blm=beam.blm)
    polarised = np.zeros((3, alm_.size(LMAX)))
    polarised[0, : LMAX + 1] = np.sqrt((2 * np.arange(LMAX + 1) + 1) / (4 * np.pi))
    for make, named in (
        (lambda: Beam.from_blm(tmp_path / "other.npz"), ("other.npz", "neglected_power", "Beam.save")),
        (lambda: Beam.from_blm(tmp_path / "beam.npz", mmax=5), ("beam.npz", 4, 5)),
        (lambda: Beam.from_blm(tmp_path / "beam.npz", LMAX + 1), ("beam.npz", LMAX, LMAX + 1)),
        (lambda: Beam.from_blm(np.ones((4, 3))), ((4, 3), "mmax", "lmax")),
        (lambda: Beam.from_blm(polarised), (polarised.shape, "T", "E", "B", LMAX)),
        (lambda: beam.save(tmp_path / "beam.fits"), ("beam.fits", ".npz")),
    ):
        with refused(*named):
            make()


def test_beam_of_an_array_is_that_of_its_file(tmp_path) -> None:
    whole = np.zeros((LMAX + 1, LMAX + 1), complex)
    whole[:5] = Beam.elliptical(900.0, 600.0, angle_deg=30.0, lmax=LMAX, mmax=4).blm
    packed = np.concatenate([whole[m, m:] for m in range(LMAX + 1)])
    healpy.write_alm(tmp_path / "blm.fits", packed, out_dtype=float)
    for given in (packed, whole):
        found, read = Beam.from_blm(given), Beam.from_blm(tmp_path / "blm.fits")
        np.testing.assert_array_equal(found.blm, read.blm)
    found.save(tmp_path / "beam.npz")
    assert Beam.from_blm(tmp_path / "beam.npz").blm.tobytes() == found.blm.tobytes()
    [look] = look_at_beams(tmp_path / "beam.npz")
    assert "beam.npz" in look.text
    dataclasses.replace(found, blm=2.0 * found.blm).save(tmp_path / "double.npz")
    with refused("double.npz", "b_00"):
        Beam.from_blm(tmp_path / "double.npz")


def test_the_page_on_a_diagnosis_names_the_keys_of_its_verdict() -> None:
    page = (Path(__file__).parents[2] / "docs" / "science" / "diagnosis.md").read_text("utf-8")
    keys = re.findall(r'"(\w+)":', inspect.getsource(DiagnosisResult.to_json))
    assert {"gap", "heard", "simulator"} < set(keys)
    assert [key for key in keys if f"`{key}`" not in page and f"gap.{key}`" not in page] == []
