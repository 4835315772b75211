"""Simulators that are not mcsim's as the model of a diagnosis: functions, classes, stored maps; and their refusals."""

import json
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import healpy
import numpy as np
import pytest
import xarray as xr
from scipy.stats import kstest

import mcsim
from mcsim import cli, config
from mcsim.datavector import campaign
from mcsim.diagnosis import api
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.ensemble.external import source_of
from mcsim.ensemble.external_maps import in_order, parts_of, stacked
from mcsim.ensemble.maps import write_map
from mcsim.errors import RunError
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.sphere import spectra
from pictures import quick_pictures
from refusals import refused

NSIDE, LMAX, FWHM, SIGMA = 16, 24, 500.0, 30.0
pytestmark = pytest.mark.usefixtures("here")
MODEL = {
    "schema": 1,
    "name": "small",
    "sky": {"spectrum": "wmap7", "lmax": LMAX},
    "map": {"nside": NSIDE, "splits": ["a", "b"]},
    "biposh": {"L_max": 1},
    "compute": {"workers": 1},
    "channel": [
        {
            "name": "V",
            "beam": {"kind": "gaussian", "fwhm_arcmin": FWHM},
            "noise": {"sigma0_uk": SIGMA},
            "scan": {"kind": "parallel_transport"},
        }
    ],
}
EXAMPLE = Path(__file__).parents[2] / "docs" / "howto" / "own_simulator.toml"
LIBRARY = {name: kind for name, kind in mcsim.effects().items() if name in ("beam_width", "noise_level")}
SMALL = {"beam_orders": 1, "split_beam_orders": 1, "sky_bins": 4, "scan_L_max": 1, "scan_bins": 1, "scan_sims": 20}
SMALL |= {"noisy_skies": 12, "constrained_skies": 4}
SETTINGS = mcsim.DiagnosisSettings(library=LIBRARY, **SMALL)

FEW = replace(SETTINGS, simulations=80)


@dataclass(frozen=True)
class Plain:
    """A simulator of somebody who has healpy, numpy, and never heard of mcsim's maps: Gaussian beam, white noise."""

    wider: float = 0.0  # of its own beam, unknown to the description
    effects: tuple[str, ...] = ()
    state = None

    def simulate(self, seed, effects=(), sky=None):
        rng = np.random.default_rng(seed)
        cl = spectra.load("wmap7", LMAX)
        ell, m = healpy.Alm.getlm(LMAX)
        alm = rng.normal(size=ell.size) + 1j * np.where(m > 0, rng.normal(size=ell.size), 0.0)
        alm *= np.sqrt(cl[ell] * np.where(m > 0, 0.5, 1.0))
        alm = alm if sky is None else sky
        noise = rng.normal(scale=SIGMA, size=(2, 12 * NSIDE**2))
        factor = 1.0 + self.wider
        for effect in effects:
            change = effect.parameters["amplitude"]
            if effect.name == "beam_width":
                factor *= 1.0 + change
            else:
                noise *= np.sqrt(1.0 + change)
        window = healpy.gauss_beam(np.deg2rad(FWHM * factor / 60.0), lmax=LMAX)
        map_uk = healpy.alm2map(healpy.almxfl(alm, window), NSIDE, lmax=LMAX)
        return {"V": {"a": map_uk + noise[0], "b": map_uk + noise[1]}}


def arrays_of(maps):
    return [maps["V"]["a"], maps["V"]["b"]]


def effect(name, amplitude):
    return config.Effect(name=name, channel="V", parameters={"amplitude": amplitude})


def native(seed, realizations):
    """Maps of mcsim's own default route, shape (realization, map, npix)."""
    run = config.load(MODEL)
    shared = survey(replace(run, ensemble=replace(run.ensemble, seed=seed)))
    return np.stack([simulate.maps(shared, r) for r in range(realizations)])


def test_the_same_maps_stored_elsewhere_give_the_verdict_of_the_run(tmp_path):
    """mcsim's own null simulations, as FITS files, Zarr store and xarray object, make the numbers of the run."""
    data = list(native(5, 1)[0])
    expected = mcsim.diagnose(MODEL, data, settings=FEW)
    stack = native(campaign._COVARIANCE, expected.simulations)
    # FITS have mcsim's names or others; the store has labelled dimensions, the first one another order.
    for r, maps in enumerate(stack):
        for split, map_uk in zip("ab", maps, strict=True):
            (tmp_path / "maps" / split).mkdir(parents=True, exist_ok=True)
            write_map(tmp_path / "maps" / split / f"V-{r + 7:04d}.fits", map_uk, "ecliptic")
    labelled = xr.DataArray(
        stack[:, None, ::-1],
        dims=("realization", "channel", "split", "pixel"),
        coords={"channel": np.array(["V"], dtype=object), "split": np.array(["b", "a"], dtype=object)},
        attrs={"units": "uK"},
    )
    labelled.to_dataset(name="maps").to_zarr(tmp_path / "maps.zarr", consolidated=False)
    template = "{split}/{channel}-{realization:04d}.fits"
    told = dict(MODEL, ensemble={"maps": str(tmp_path / "maps" / template)})
    given = [
        told,
        mcsim.ExternalModel(MODEL, tmp_path / "maps.zarr"),
        mcsim.ExternalModel(MODEL, labelled),
    ]
    for model in given:
        found = mcsim.diagnose(model, data, settings=FEW)
        assert found.simulations == expected.simulations
        np.testing.assert_allclose(
            found.mean / expected.standard_deviation, expected.mean / expected.standard_deviation, atol=1e-9
        )
        np.testing.assert_allclose(found.standard_deviation, expected.standard_deviation, rtol=1e-9)
        np.testing.assert_allclose(found.templates, expected.templates, rtol=1e-9)
        assert found.test.pvalue == pytest.approx(expected.test.pvalue, rel=1e-6)
        assert found.kind == expected.kind
        assert found.agreement.agrees
        assert found.agreement.effects == ()


def test_a_store_that_is_not_finished_is_no_model(tmp_path: Path) -> None:
    stack = xr.Dataset(
        {"observed_map": (("realization", "map_name", "pixel"), np.ones((4, 2, 12 * 8**2), dtype=np.float32))},
        coords={"map_name": np.array(["V:a", "V:b"], dtype=object)},
    )
    run = config.load(MODEL)
    for done in ([True] * 4, [True, True, False, True]):
        own = stack.assign(done=("realization", done))
        own.to_zarr(tmp_path / f"{sum(done)}.zarr", consolidated=False)
        if all(done):
            assert source_of(run, tmp_path / "4.zarr").count == source_of(run, own).count == 4
            continue
        with refused(tmp_path / "3.zarr", 1, 2):
            assert source_of(run, tmp_path / "3.zarr").count
        with refused(1, 2):
            source_of(run, own)


def test_the_default_route_as_a_function_gives_the_statistics_of_the_run():
    """Other seeds, so other skies: mean, scatter and test agree within their errors."""
    run = config.load(MODEL)

    def own(seed):
        shared = survey(replace(run, ensemble=replace(run.ensemble, seed=seed)))
        return dict(zip(("V:a", "V:b"), simulate.maps(shared, 0), strict=True))

    data = list(native(5, 1)[0])
    expected = mcsim.diagnose(MODEL, data, settings=FEW)
    found = mcsim.diagnose(mcsim.ExternalModel(MODEL, own), data, settings=FEW)
    pulls = (found.mean - expected.mean) / np.hypot(found.standard_deviation, expected.standard_deviation) * np.sqrt(80)
    assert np.abs(pulls).max() < 5.0
    ratio = np.log(found.standard_deviation / expected.standard_deviation)
    assert np.abs(ratio).max() < 5.0 * np.sqrt(2.0 / 80)  # of variances that are not quite Gaussian
    np.testing.assert_array_equal(found.templates, expected.templates)
    assert found.agreement.agrees
    assert found.kind == expected.kind == "none"


@pytest.fixture(scope="module")
def learned():
    """The plain simulator that can widen its beam, learned once."""
    run = config.load(MODEL)
    source = source_of(run, Plain(effects=("beam_width",)))
    analysis = api.analysis_of(run, library=LIBRARY, settings=replace(SETTINGS, library=None), source=source)
    return api.context(analysis, *campaign.learned(analysis, lambda jobs: [api.data_vectors(job) for job in jobs]))


def test_null_skies_of_a_simulator_of_somebody_else_are_uniform(learned):
    skies = [arrays_of(Plain().simulate(seed)) for seed in range(60)]
    p = [learned.null.pvalue(learned.analysis.data_vector(maps)) for maps in skies]
    assert kstest(p, "uniform").pvalue > 1e-3
    assert np.sum(np.array(p) < 0.05) < 10  # of 60; 10 or more once in 1000 cases


def test_its_effect_is_named_with_the_amplitude_that_was_put_in(learned):
    truth = 0.25
    maps = arrays_of(Plain().simulate(3, effects=[effect("beam_width", truth)]))
    data = api.ObservedMaps(learned, maps, lambda jobs: [api.data_vectors(job) for job in jobs])
    found = diagnose_data(data, "wide")
    assert found.kind == "effect"
    assert found.effects[0].name == "beam_width"
    assert abs(found.effects[0].amplitude - truth) < 4 * found.effects[0].sigma
    # In 200 skies fitted amplitudes scatter by 0.077, with errors of 0.077 in the mean: larger for larger amplitudes.
    assert 0.05 < found.effects[0].sigma < found.effects[0].amplitude / 3


def test_responses_come_from_who_can_add_the_effect(learned):
    """Both are measured; the simulator's has its own noise draws, mcsim's has mcsim's."""
    jobs = campaign.plan(learned.analysis)
    for purpose, job in jobs.items():
        own = purpose.kind in ("null", "external reference")
        if purpose.kind == "response":
            own = learned.bank.labels[purpose.number].effect == "beam_width"
        assert (job.source is not None) == own, purpose
    reference = learned.ensemble.extended.reference
    assert learned.ensemble.external_reference.shape == reference.shape
    assert not np.allclose(learned.ensemble.external_reference, reference)
    # Of the same instrument, so that the templates agree to the scatter of responses.
    own = replace(learned.analysis, source=None)
    _, bank = campaign.learned(own, lambda jobs: [api.data_vectors(job) for job in jobs], 200)
    error = np.hypot(bank.error, learned.bank.error)
    moved = error > 0.0
    pulls = (bank.matrix - learned.bank.matrix)[moved] / error[moved]
    assert np.mean(pulls**2) < 2.0


def test_agreement_of_a_right_description_is_no_rare_event(learned):
    assert api.agreement(learned).pvalue > 1e-3
    assert api.agreement(learned).effects == ("beam_width",)


def test_a_description_of_another_beam_is_said_first(tmp_path):
    data, settings = arrays_of(Plain(wider=0.1).simulate(3)), replace(FEW, noisy_skies=24)
    with quick_pictures(empty=True):
        found = mcsim.diagnose(mcsim.ExternalModel(MODEL, Plain(wider=0.1)), data, tmp_path / "out", settings=settings)
    assert found.agreement.pvalue < 1e-4
    assert not found.agreement.agrees
    assert "beam" in found.agreement.nearest
    assert found.warnings[0].startswith("mcsim's own simulation of the description does not agree with Plain")
    assert "approximate" in found.warnings[0]
    assert found.verdict["simulator"]["agrees"] is False
    again = mcsim.diagnosis.result.DiagnosisResult.open(tmp_path / "out")
    assert again.agreement == found.agreement
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.index("does not agree with Plain") < page.index("<h1>")
    # The data are the simulator's own: they are none the worse for the description.
    assert found.test.pvalue > 1e-3


SIMULATOR = """
import healpy
import numpy as np
from pathlib import Path

class Noisy:
    def __init__(self, run):
        self.sigma = run.channels[0].noise.sigma0_uk
        self.size = 12 * run.map.nside**2

    def simulate(self, seed, effects=()):
        with (Path(__file__).parent / "calls").open("a") as calls:
            print(seed, file=calls)
        if (Path(__file__).parent / "stop").exists() and len(self.calls()) > 40:
            raise OSError("the disk is full")
        draw = np.random.default_rng(seed)
        sky = healpy.smoothing(draw.normal(scale=300.0, size=self.size), fwhm=0.3, lmax=24)
        return {f"V:{split}": sky + draw.normal(scale=self.sigma, size=self.size) for split in "ab"}

    def calls(self):
        return (Path(__file__).parent / "calls").read_text().split()
"""


def test_a_batch_that_was_interrupted_goes_on_with_the_same_maps(tmp_path, monkeypatch):
    """A class named in the TOML; what was finished is not simulated again, and other code is."""
    monkeypatch.setenv("MCSIM_CACHE", str(tmp_path / "cache"))
    (tmp_path / "sim.py").write_text(SIMULATOR)
    (tmp_path / "stop").touch()
    model = dict(MODEL, simulator="sim.py:Noisy")
    run = config.load(model, base=tmp_path)
    assert run.simulator == str(tmp_path / "sim.py:Noisy")
    data = list(native(5, 1)[0])
    with refused("sim.py:Noisy", "OSError", by=RunError):
        mcsim.diagnose(run, data, settings=FEW)
    first = (tmp_path / "calls").read_text().split()
    (tmp_path / "stop").unlink()
    found = mcsim.diagnose(replace(run, compute=replace(run.compute, workers=7)), data, settings=FEW)
    calls = (tmp_path / "calls").read_text().split()
    again = set(first) & set(calls[len(first) :])
    assert len(again) <= 10  # those of the task that was interrupted
    assert len(set(calls)) == found.simulations + 2  # and two that the seeds were tested with
    assert mcsim.diagnose(run, data, settings=FEW).test.pvalue == found.test.pvalue
    assert (tmp_path / "calls").read_text().split() == calls
    assert not list((tmp_path / "cache").glob("diagnose/*.parts"))
    (tmp_path / "sim.py").write_text(SIMULATOR.replace("scale=300.0", "scale=320.0"))
    other = mcsim.diagnose(run, data, settings=FEW)
    assert len((tmp_path / "calls").read_text().split()) == len(calls) + other.simulations + 3
    assert other.test.pvalue != found.test.pvalue


def test_a_large_simulator_is_a_file_of_the_cache():
    """Its content is a part of its identity; what it holds is loaded once per process."""
    run = config.load(MODEL)
    held = [np.zeros(20000), np.ones(20000)]
    sources = [source_of(run, partial(Plain.simulate, Plain(), sky=one)) for one in (*held, held[0])]
    assert all(len(source.made) < 1000 for source in sources)
    assert sources[0].identity() != sources[1].identity()
    assert sources[0].content == sources[2].content


class Told:
    """A simulator that is made with the description."""

    def __init__(self, run):
        self.sigma = run.channels[0].noise.sigma0_uk

    def simulate(self, seed):
        return {"V": {split: np.full(3072, self.sigma) for split in "ab"}}


def test_a_class_is_made_with_the_description():
    source = source_of(config.load(MODEL), Told)
    assert [maps[0] for maps in source.maps(0, 0)] == [SIGMA, SIGMA]
    busier = replace(config.load(MODEL), compute=config.Compute(workers=5))
    assert source_of(busier, Told).content == source.content


def diagnosed(simulator, **changes):
    return mcsim.diagnose(mcsim.ExternalModel(MODEL, simulator), list(native(5, 1)[0]), settings=SETTINGS)


def changed(how):
    def simulate(seed):
        maps = dict(zip(("V:a", "V:b"), arrays_of(Plain().simulate(seed)), strict=True))
        return how(maps)

    return simulate


@pytest.mark.parametrize(
    ("how", "words"),
    [
        (lambda maps: {"V:a": maps["V:a"]}, ("V:b", "V:a", "lacks")),
        (lambda maps: maps | {"V:b": np.full(3072, np.nan)}, ("V:b", "3072", "finite", "UNSEEN")),
        (lambda maps: maps | {"V:a": maps["V:a"][:768]}, ("V:a", "8", "16", "nside")),
        (lambda maps: {name: 1e-6 * one for name, one in maps.items()}, ("V:a", "rms", "unit", "uK")),
        (lambda maps: maps | {"V:a": "V.fits"}, ("V:a", "array")),
        (
            lambda maps: {name: np.random.default_rng().normal(scale=90.0, size=3072) for name in maps},
            ("simulate", "again"),
        ),
        (lambda maps: dict(zip(maps, arrays_of(Plain().simulate(1)), strict=True)), ("simulate", "every")),
        (lambda maps: maps | {"V:b": maps["V:a"]}, ("simulate", "V:b", "V:a", "same")),
    ],
    ids=["missing", "nan", "nside", "unit", "text", "other", "every", "same"],
)
def test_what_a_simulator_cannot_return(how, words):
    with refused(*words):
        diagnosed(changed(how))


def test_what_cannot_be_a_simulator(tmp_path, monkeypatch):
    run = config.load(MODEL)
    no_seed, cannot = (lambda: None), (lambda seed: None)
    cannot.effects = ("beam_width",)

    class Code:
        def __init__(self, name):
            self.name = name

    for name in ("one1.fits", "a1.fits", "mine.py"):
        (tmp_path / name).touch()
    for given, words in (
        ("no_such_module:thing", ("no_such_module", "ModuleNotFoundError")),
        (str(tmp_path / "none.py") + ":Thing", (str(tmp_path / "none.py"),)),
        ("math:pi", ("3.141592653589793",)),
        (Code("its own"), ("Code",)),
        ("only_a_name", ("package.module:name", "only_a_name")),
        (str(tmp_path / "mine.py"), (str(tmp_path / "mine.py") + ":NAME",)),
        (str(tmp_path / "{realization}.fits"), ("{realization}", tmp_path)),
        (str(tmp_path / "{realisation}.fits"), ("{realisation}", "{realization}")),
        (str(tmp_path / "one{realization}.fits"), ("{channel}", "{split}")),
        (str(tmp_path / "{split}{realization}.fits"), (str(tmp_path / "b1.fits"), "V:b", "1")),
        (str(tmp_path / "none.zarr"), (str(tmp_path / "none.zarr"),)),
        (no_seed, ("seed",)),
        (cannot, ("effects",)),
        (np.zeros((3, 5, 3072)), ("5", "V:a, V:b")),
        (xr.DataArray(np.zeros((2, 3072)), dims=("r", "pixel")), ("r, pixel", "realization")),
    ):
        with refused(*words):
            source_of(run, given)
    with refused("beam_wdth", "beam_width"):
        diagnosed(Plain(effects=("beam_wdth",)))


def test_small_ensembles_are_refused_with_the_number_that_is_needed(tmp_path):
    stack = native(1, 60)
    with refused("60", "63", "3", "--without"):
        mcsim.diagnose(mcsim.ExternalModel(MODEL, stack), list(stack[0]), settings=SETTINGS)
    with refused("200", "60"):
        few = replace(SETTINGS, simulations=200)
        mcsim.diagnose(mcsim.ExternalModel(MODEL, stack), list(stack[0]), settings=few)


def test_noise_of_a_simulator_need_not_be_described():
    """Splits of the description are the same map then, and those of the simulator are not."""
    quiet = MODEL | {"channel": [{key: own for key, own in MODEL["channel"][0].items() if key != "noise"}]}
    with refused("V:a", "V:b", "noise"):
        api.describe(config.load(quiet), SETTINGS)
    assert "simulations" in api.describe(mcsim.ExternalModel(quiet, Plain()), SETTINGS)


def test_a_configuration_with_a_simulator_is_printed(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["mcsim", "config", str(EXAMPLE)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 0
    assert json.loads(capsys.readouterr().out)["simulator"] == f"{EXAMPLE.with_name('own_simulator.py')}:HealpySurvey"


def test_only_a_diagnosis_takes_a_simulator(tmp_path):
    told = config.load(dict(MODEL, simulator="math:pi"))
    with refused("simulator", "math:pi"):
        mcsim.run(told, tmp_path / "run.zarr")
    with refused("simulator", "ensemble.maps"):
        config.load(dict(MODEL, simulator="math:pi", ensemble={"maps": "x.zarr"}))
    assert "simulator" not in config.to_dict(config.load(MODEL))
    assert "maps" not in config.to_dict(config.load(MODEL))["ensemble"]


def test_the_command_line_says_what_a_simulator_is_asked_for(monkeypatch, capsys, tmp_path):
    run, draw = config.load(EXAMPLE), np.random.default_rng(1)
    for split in run.map.splits:
        name = tmp_path / f"{run.channels[0].name}_{split}.fits"
        write_map(name, 60.0 * draw.standard_normal(12 * run.map.nside**2), run.map.frame)
    monkeypatch.setattr(sys, "argv", ["mcsim", "diagnose", str(EXAMPLE), str(tmp_path), "-o", "out", "--dry-run"])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 0
    assert "own_simulator.py:HealpySurvey" in capsys.readouterr().out


def test_the_example_of_the_documentation_runs_on_workers(monkeypatch):
    """With its own effect in the data."""
    monkeypatch.undo()
    run = config.load(EXAMPLE)
    maps = source_of(replace(run, simulator=None), run.simulator).maps(0, 0, [effect("beam_width", -0.3)])
    found = mcsim.diagnose(replace(run, compute=replace(run.compute, workers=1)), maps, settings=FEW)
    assert found.verdict["gap"]["p_value"] < 0.01
    assert found.verdict["nearest"]["name"] == "beam_width"
    assert found.verdict["simulator"]["effects"] == ("beam_width",)
    assert found.verdict["simulator"]["agrees"]


SMOOTHED = """
import healpy
import numpy as np

def simulate(seed, effects=(), sky=None):
    window = healpy.gauss_beam(np.deg2rad(500.0 / 60.0), lmax=24)
    return {"V": 1.02 * healpy.alm2map(healpy.almxfl(sky, window), 16)}
"""


def test_a_comparison_takes_the_same_simulators(tmp_path):
    """On the sky of mcsim's own side; its calibration is 2 % off."""
    (tmp_path / "smoothed.py").write_text(SMOOTHED)
    description = EXAMPLE.read_text()
    plain = description.replace('splits = ["a", "b"]', "").replace('"own_simulator_cl.txt"', '"wmap7"')
    plain = plain.replace("sigma0_uk = 30.0", "sigma0_uk = 0.0")
    (tmp_path / "a.toml").write_text(plain.replace('simulator = "own_simulator.py:HealpySurvey"', ""))
    (tmp_path / "b.toml").write_text(plain.replace("own_simulator.py:HealpySurvey", "smoothed.py:simulate"))
    found = mcsim.compare(tmp_path / "a.toml", tmp_path / "b.toml", tmp_path / "a.toml")
    [only] = found.channels
    assert only.differences[0].name == "calibration"
    assert only.differences[0].amplitude == pytest.approx(0.02, rel=1e-3)
    (tmp_path / "smoothed.py").with_name("other.py").write_text("def simulate(seed): ...")
    (tmp_path / "c.toml").write_text(plain.replace("own_simulator.py:HealpySurvey", "other.py:simulate"))
    with refused("other.py:simulate", "sky"):
        mcsim.compare(tmp_path / "a.toml", tmp_path / "c.toml", tmp_path / "a.toml")


def test_names_and_units_of_maps(tmp_path):
    parts = tuple(parts_of(config.load(MODEL)))
    a, b = np.arange(12.0), np.ones(12)
    milli = xr.DataArray(a * 1e-3, dims="pixel", attrs={"units": "mK"})
    for given in (
        {"V/a": a, "V/b": b},
        {"V_a": a, "V_b": b},
        {"V": {"b": b, "a": milli}},
        xr.Dataset({"V_b": ("p", b), "V_a": ("p", a)}),
    ):
        found = in_order(given, parts, "here")
        np.testing.assert_allclose(found, [a, b])
    whole = xr.DataArray([a, b], dims=("map_name", "pixel"), coords={"map_name": ["V:a", "V:b"]})
    beams = xr.DataArray([30.0], dims="channel", coords={"channel": ["V"]})
    found = in_order(xr.Dataset({"fwhm": beams, "maps": whole}), parts, "here")
    np.testing.assert_allclose(found, [a, b])
    with refused("maps", "noise"):
        in_order(xr.Dataset({"noise": 0.1 * whole, "maps": whole}), parts, "here")
    with refused("realization"):
        stacked(np.zeros((0, 2, 12)), parts)
