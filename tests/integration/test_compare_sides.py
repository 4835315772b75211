"""Comparisons of maps as people have them: files, holes, noise, prepared, made from moments, or of another kind."""

import json
from dataclasses import replace

import healpy
import numpy as np
import pytest
from typer.testing import CliRunner

import mcsim
from comparisons import (
    CASES,
    LMAX,
    MODEL,
    NSIDE,
    ODD,
    PEAR,
    SMALL,
    Maps,
    Simulator,
    mcsim_window,
    names,
    noise_of,
    scaled,
    small,
)
from mcsim import config
from mcsim.cli import app
from mcsim.comparison import pairs, report
from mcsim.comparison.prediction import Prediction, Set
from mcsim.comparison.scene import Scene
from mcsim.comparison.scene_differences import PsiSign, SpinSign, TimeShift
from mcsim.comparison.shown_sky import with_shown_sky
from mcsim.comparison.time_differences import Interpolation
from mcsim.ensemble.maps import write_map
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from pictures import quick_pictures
from refusals import refused


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator()


@pytest.fixture(scope="module")
def side_a(simulator: Simulator) -> Maps:
    return simulator()


def test_what_no_library_has_is_unknown(simulator, side_a):
    side_b = [np.where(m > -1e20, m + 1e-4 * m**2, m) for m in side_a]
    found = mcsim.compare(side_a, side_b, simulator.run)
    assert found.verdict == "unknown"
    assert names(found) == []


def test_single_precision_and_interpolation_are_no_difference(simulator, side_a):
    single = [m.astype(np.float32).astype(np.float64) for m in side_a]
    assert mcsim.compare(side_a, single, simulator.run).verdict == "identical"
    draw = np.random.default_rng(1)
    coarse = [np.where(m > -1e20, m + 0.02 * draw.standard_normal(m.size), m) for m in side_a]
    found = mcsim.compare(side_a, coarse, simulator.run)
    assert found.verdict == "identical"
    assert found.accuracy == pytest.approx(0.02 / found.channels[0].sky_rms_uk, rel=0.02)


def test_a_unit_of_one_split_alone_is_named(simulator, side_a):
    found = mcsim.compare(side_a, [side_a[0], *scaled(side_a[1:], 1e-6)], simulator.run)
    assert names(found) == ["unit"]
    assert found.to_dict()["maps"] == {"W1": ["W1:half2"]}
    assert "W1:half2; the other maps are identical" in str(found)


@pytest.mark.parametrize(("factor", "behind"), [(-1.0, []), (-1e-6, []), (-1.0, ["psi_offset"])])
def test_maps_of_the_other_sign_are_a_unit(factor, behind, simulator, side_a):
    side_b = simulator(psi=lambda p: p + np.deg2rad(30.0)) if behind else side_a
    for sides in ((side_a, scaled(side_b, factor)), (scaled(side_a, factor), side_b)):
        found = mcsim.compare(*sides, simulator.run)
        assert sorted(names(found)) == [*behind, "unit"]
        unit = found.channels[0].differences[-1]
        assert unit.amplitude == pytest.approx(factor if sides[0] is side_a else 1.0 / factor, rel=1e-9)
        assert "the other sign" in str(found)


@pytest.mark.parametrize("masked", [False, True])
def test_behind_a_unit_the_same_pixels_and_splits_are_compared(tmp_path, masked, simulator, side_a):
    """Of a split alone, and of masked maps whose side B has something else behind the mask."""
    outside = np.abs(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2]) > 0.3
    run, side_b = MODEL, [side_a[0], *scaled(simulator(psi=lambda p: p + np.deg2rad(30.0))[1:], 1e-6)]
    if masked:
        healpy.write_map(tmp_path / "mask.fits", outside.astype(float), dtype=float)
        run = MODEL | {"map": MODEL["map"] | {"mask": str(tmp_path / "mask.fits")}}
        side_b = [np.where(outside | (m < -1e20), m, m + 1e-3) for m in side_b]
    assert sorted(names(mcsim.compare(side_a, side_b, run))) == ["psi_offset", "unit"]


def test_zeros_that_stand_for_holes_hide_nothing(simulator, side_a):
    hole = np.abs(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2]) < 0.3
    filled = [[np.where(hole, 0.0, m) for m in side] for side in (side_a, CASES["pixel_window"][0](simulator, side_a))]
    assert names(mcsim.compare(*filled, simulator.run)) == ["pixel_window"]


def test_a_degree_at_which_the_sky_ends_is_named_beside_holes():
    """What holes hide of the sky was cut as well, and that reaches into the pixels that are seen."""
    simulator = Simulator(small("litebird", period_s=181.0))
    factor, cut = simulator.site.beam.window * mcsim_window(), np.arange(LMAX + 1) <= 25
    hole = np.abs(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2]) < 0.3
    sides = [healpy.alm2map(healpy.almxfl(simulator.sky, f), NSIDE, lmax=LMAX) for f in (factor, cut * factor)]
    found = mcsim.compare(*([np.where(hole, 0.0, side)] * 2 for side in sides), simulator.run)
    assert names(found) == ["lmax_cut"]
    assert found.channels[0].left < 0.05


def test_a_mask_of_side_b_hides_nothing_of_the_sky_of_side_a():
    simulator = Simulator(small("litebird", period_s=181.0))
    side_a, side_b = simulator(), simulator(psi=lambda psi: psi + np.deg2rad(0.5))
    hole = np.abs(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2]) < 0.35
    found = mcsim.compare(side_a, [np.where(hole, healpy.UNSEEN, map_) for map_ in side_b], simulator.run)
    assert names(found) == ["psi_offset"]
    assert found.channels[0].left < 1e-4


@pytest.mark.slow
def test_two_differences_are_named_beside_holes():
    """Samples move at the edges of holes: what is hidden there must be as small as the sky that is seen."""
    simulator = Simulator(small("litebird", period_s=181.0))
    hole = np.abs(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2]) < 0.3
    moved = simulator(psi=lambda psi: psi + np.deg2rad(45.0), centred=True)
    sides = ([np.where(hole, healpy.UNSEEN, map_) for map_ in side] for side in (simulator(), moved))
    found = mcsim.compare(*sides, simulator.run)
    assert sorted(names(found)) == ["pixel_centres", "psi_offset"]
    assert found.channels[0].left < 0.01


@pytest.mark.parametrize("both", [False, True])
def test_a_side_that_was_made_from_orientation_moments_is_recognised(both, simulator, side_a):
    """What single samples change in such maps is a per cent of the sky, and larger than this width."""
    window = np.exp(-0.5 * np.arange(LMAX + 1) * np.arange(1, LMAX + 2) * np.deg2rad(0.35) ** 2)
    narrow, wide = simulator.sky, healpy.almxfl(simulator.sky, window)
    of_moments = [simulate.maps(survey(simulator.run), 0, sky=sky) for sky in (narrow, wide)]
    side_b = list(of_moments[1]) if both else simulator(sky=wide)
    found = mcsim.compare(list(of_moments[0]), side_b, simulator.run)
    assert names(found) == ["beam_width"]
    assert found.channels[0].left < 1e-4
    assert (found.channels[0].spread_rms_uk > 0.0) == (not both)
    if not both:
        assert mcsim.compare(list(of_moments[0]), side_a, simulator.run).accuracy < 1e-5


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_large_monopole_is_not_taken_for_what_single_samples_change(sign, simulator):
    """Their mean is not zero, so that a monopole is like them to the rms of the difference."""
    side_a = simulate.maps(survey(simulator.run), 0, sky=simulator.sky)
    found = mcsim.compare(list(side_a), [m + sign * 1000.0 for m in side_a], simulator.run)
    assert names(found) == ["monopole"]
    assert found.channels[0].left_rms_uk < 1e-9
    assert found.channels[0].spread_rms_uk == 0.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_single_samples_change_is_seen_beside_a_large_monopole(sign, simulator, side_a):
    of_moments = simulate.maps(survey(simulator.run), 0, sky=simulator.sky)
    side_b = [np.where(m > -1e20, m + sign * 1000.0, m) for m in side_a]
    found = mcsim.compare(list(of_moments), side_b, simulator.run)
    assert names(found) == ["monopole"]
    assert found.channels[0].left_rms_uk < 1e-3
    assert found.channels[0].spread_rms_uk > 0.1


def test_maps_at_the_centres_of_pixels_are_recognised(simulator):
    """Maps of a pipeline without a scan: one through the pixel window, one without it."""
    run = replace(simulator.run, map=replace(simulator.run.map, splits=()))
    smooth = healpy.almxfl(simulator.sky, simulator.site.beam.window)
    without = healpy.alm2map(smooth, NSIDE, lmax=LMAX)
    found = mcsim.compare([healpy.alm2map(healpy.almxfl(smooth, mcsim_window()), NSIDE, lmax=LMAX)], [without], run)
    assert names(found) == ["pixel_window"]
    assert found.channels[0].differences[0].amplitude == -1.0
    assert found.channels[0].left < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(("windowed", "factor"), [(False, 1.0), (False, 1.01), (True, 1.0)])
def test_a_map_that_ud_grade_made_of_a_finer_one_is_recognised(windowed, factor, simulator):
    """Its pixels are means of 16, whose window changes over the sky as the shapes of the pixels do."""
    run = replace(simulator.run, map=replace(simulator.run.map, splits=()))
    smooth = healpy.almxfl(simulator.sky, simulator.site.beam.window)
    window = mcsim_window() if windowed else np.ones(LMAX + 1)
    here = healpy.alm2map(healpy.almxfl(smooth, window), NSIDE, lmax=LMAX)
    degraded = factor * healpy.ud_grade(healpy.alm2map(smooth, 4 * NSIDE, lmax=LMAX), NSIDE)
    (found,) = mcsim.compare([here], [degraded], run).channels
    assert {d.name for d in found.differences} == {"pixel_window"} | ({"calibration"} if factor > 1.0 else set())
    window = next(d for d in found.differences if d.name == "pixel_window")
    assert window.amplitude == 1.0
    assert window.parameters["by"].startswith("the mean of 16 sub-pixels")
    assert ("in place of" in window.parameters["by"]) == windowed
    assert found.left < 1e-6
    if factor == 1.0:
        (found,) = mcsim.compare([degraded], [here], run).channels
        assert [(d.name, d.amplitude) for d in found.differences] == [("pixel_window", -1.0)]
        assert found.left < 0.02


def test_files_are_compared_from_the_command_line(tmp_path, simulator, side_a):
    sides = {"a": side_a, "b": scaled(side_a, 1.01)}
    for side, maps in sides.items():
        # Side b as mcsim maps writes several realizations, of which the first is compared.
        folder = tmp_path / side / ("00000" if side == "b" else "")
        folder.mkdir(parents=True)
        for split, map_ in zip(("half1", "half2"), maps, strict=True):
            write_map(folder / f"W1_{split}.fits", map_, "ecliptic")
    a, b, out = (str(tmp_path / name) for name in ("a", "b", "out"))
    with quick_pictures():
        found = CliRunner().invoke(app, ["compare", a, b, "-o", out, "--fail-above", "0.1"])
    assert found.exit_code == 0, found.output
    said = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert said["schema"] == 1
    assert [(d["name"], d["channel"]) for d in said["differences"]] == [
        ("calibration", "W1_half1"),
        ("calibration", "W1_half2"),
    ]
    assert said["differences"][0]["amplitude"] == pytest.approx(0.01)
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000
    with quick_pictures(empty=True):
        assert CliRunner().invoke(app, ["compare", a, b, "-o", out, "--fail-above", "1e-4"]).exit_code == 1


@pytest.mark.parametrize("of", ["a", "b"])
def test_maps_that_one_side_alone_has_are_said(tmp_path, of, side_a):
    """The split that both have is compared, and one that is missing was not exchanged for it."""
    for side, maps in (("a", side_a), ("b", scaled(side_a, 1.01))):
        (tmp_path / side).mkdir()
        for split, map_ in zip(("half1", "half2")[: 1 if side == of else 2], maps, strict=False):
            write_map(tmp_path / side / f"W1_{split}.fits", map_, "ecliptic")
    write_map(tmp_path / "b" / "X1.fits", side_a[0], "ecliptic")
    with pytest.warns(UserWarning, match="W1:half2, which side . lacks; X1, which the model lacks"):
        found = mcsim.compare(tmp_path / "a", tmp_path / "b", MODEL)
    assert names(found) == ["calibration"]
    assert found.to_dict()["maps"] == {}
    assert found.to_dict()["not_compared"] == [
        {"map": "W1:half2", "missing_on": [of]},
        {"map": "X1", "missing_on": ["model"]},
    ]
    assert "Not compared: W1:half2" in str(found)
    with quick_pictures():
        assert "W1:half2, which side" in report.page(found)
    with pytest.warns(UserWarning, match=f"W1_half2, which side {of.upper()} lacks"):
        mcsim.compare(tmp_path / "a", tmp_path / "b")


@pytest.mark.parametrize(
    ("a", "b", "model"),
    [([np.zeros(12)], [np.ones(12)], None), ([np.zeros(12)] * 2, [np.ones(12)] * 2, MODEL), ("nowhere", "x", None)],
)
def test_what_cannot_be_compared_is_refused(a, b, model):
    with pytest.raises(mcsim.InputError):
        mcsim.compare(a, b, model)


def test_a_model_without_pixels_is_refused():
    channel = {**MODEL["channel"][0], "scan": {"kind": "parallel_transport"}}
    run = config.load({**MODEL, "map": {"grid": "gl"}, "channel": [channel]})
    with refused("map.grid", "gl", "healpix"):
        mcsim.compare([np.zeros(12)], [np.ones(12)], run)


def test_a_run_is_simulated_sample_by_sample_where_the_other_side_is(tmp_path):
    """Samples spread over their pixels: the moments of the default simulation miss a few per cent of the sky."""
    simulator = Simulator(small("litebird", mcsim.Beam.gaussian(380.0, 32), period_s=631.0))
    for split, map_ in zip(("half1", "half2"), simulator(), strict=True):
        write_map(tmp_path / f"W1_{split}.fits", map_.astype(np.float32), "ecliptic")
    model = tmp_path / "run.toml"
    model.write_text(
        'schema = 1\nname = "pair"\nsky = { spectrum = "wmap7", lmax = 32 }\nensemble = { seed = 3 }\n'
        'map = { nside = 16, splits = ["half1", "half2"] }\n'
        '[[channel]]\nname = "W1"\nbeam = { kind = "gaussian", fwhm_arcmin = 380.0 }\n'
        'scan = { kind = "hit_averaged", model = "litebird", sample_period_s = 631.0 }\n'
    )
    found = mcsim.compare(model, tmp_path)
    assert found.verdict == "identical"
    assert found.accuracy < 1e-5


def test_sloppy_maps_are_read(tmp_path, simulator, side_a):
    """NaN, masked arrays, single precision with its own UNSEEN, zeros, and pixels that one side alone observed."""
    rough = [m.astype(np.float32) for m in side_a]
    rough[0][:100] = np.float32(healpy.UNSEEN)
    rough[1] = np.ma.masked_where(np.arange(side_a[1].size) < 50, side_a[1])
    given = [m.copy() for m in side_a]
    given[0][200:250] = np.nan
    given[1][300:320] = 0.0
    found = mcsim.compare(given, rough, simulator.run)
    assert found.verdict == "identical"
    assert found.to_dict()["left"]["one_sided_pixels"] == 220
    assert "220 pixels" in str(found)
    with refused(100):
        mcsim.compare([np.zeros(100)] * 2, side_a, simulator.run)


@pytest.mark.parametrize("value", [np.inf, -np.inf])
def test_infinite_pixels_are_refused(tmp_path, value, simulator, side_a):
    broken = side_a[1].copy()
    broken[[7, 30]] = value
    with refused("W1:half2", "B", "2 pixels", "UNSEEN"):
        mcsim.compare(side_a, [side_a[0], broken], simulator.run)
    healpy.write_map(tmp_path / "W1_half1.fits", side_a[0], dtype=np.float64, column_units="uK")
    healpy.write_map(tmp_path / "W1_half2.fits", broken, dtype=np.float64, column_units="uK")
    with refused("W1_half2", "A", "2 pixels", "UNSEEN"):
        mcsim.compare(tmp_path, tmp_path)


def test_maps_with_holes_show_enough_of_the_sky():
    """Many pixels without a sample: psi of the other sign, and fewer orders, with no sky in the model."""
    simulator = Simulator(small("wmap", period_s=2503.0))
    side_a = simulator()
    holes = np.mean([m == healpy.UNSEEN for m in side_a])
    assert 0.05 < holes < 0.4
    for made, name in ((simulator(psi=lambda p: -p), "psi_sign"), (ODD["mmax_cut"](simulator), "mmax_cut")):
        assert names(mcsim.compare(side_a, made, simulator.run)) == [name]


def test_prepared_maps_are_compared():
    """Both sides degraded, their dipoles taken off, turned: what side B does otherwise is still named."""
    steps = [{"kind": "subtract_dipole"}, {"kind": "degrade", "nside": 16}, {"kind": "rotate", "frame": "galactic"}]
    simulator = Simulator(small("litebird", period_s=181.0, preparation=steps, map={"nside": 32}))
    whole = survey(simulator.run)

    def prepared(maps: Maps) -> Maps:
        return [m.preparation.apply(made) for m, made in zip(whole.making.channels[0].maps, maps, strict=True)]

    side_a = prepared(simulator())
    assert names(mcsim.compare(side_a, prepared(simulator(psi=lambda p: p + 1.0)), simulator.run)) == ["psi_offset"]
    assert mcsim.compare(side_a, side_a, simulator.run).verdict == "identical"


def test_what_has_no_name_is_described():
    simulator = Simulator(small(beam=mcsim.Beam.gaussian(380.0, 32)))
    side_a = simulator()
    draw = np.random.default_rng(5)
    white = [m + 5.0 * draw.standard_normal(m.size) for m in side_a]
    source = np.exp(8.0 * (healpy.pix2vec(16, np.arange(3072))[0] - 1.0) * 20.0)
    for made, words in (
        (white, "white in pixels"),
        ([m + 100.0 * source for m in side_a], "of the pixels, most at longitude"),
    ):
        found = mcsim.compare(side_a, made, simulator.run)
        assert found.verdict == "unknown"
        assert words in str(found)
        assert words in " ".join(found.to_dict()["left"]["looks"]["W1"])


def test_differencing_scans_are_refused():
    channel = {
        "name": "W1",
        "beam": PEAR,
        "scan": {"kind": "differencing", "model": "wmap", "pair": "WMAP", "sample_period_s": 601.0},
    }
    with refused("differencing", "W1"):
        mcsim.compare([np.zeros(3072)] * 2, [np.ones(3072)] * 2, SMALL | {"channel": [channel]})


@pytest.mark.parametrize("other", [PsiSign(), SpinSign()])
def test_late_samples_move_along_the_scan_whatever_else_differs(other):
    """By moments nearly as by samples; at 4.6 degrees they leave 2 % of the time shift alone."""
    simulator = Simulator(small())
    pair = pairs.given(simulator(), simulator(), simulator.run).pairs[0]
    late, pointing = TimeShift().scene(pair.scene, np.array([0.003]), pair), pair.pointing()
    changed = other.scene(late, np.ones(1), pair)
    wanted, before = (one.sampled(pointing, pair.scene.window) for one in (changed, pair.scene))
    seen = pair.seen & (wanted != healpy.UNSEEN)
    left = (wanted - before - changed.maps() + pair.scene.maps())[seen]
    assert np.sum(left**2) < 0.04 * np.sum((wanted - before)[seen] ** 2)


@pytest.mark.parametrize("splits", [["half1", "half2"], []])
def test_noise_in_common_hides_no_more_than_is_expected_of_it(splits):
    """What the sky leaves of a single map says how large its noise is."""
    simulator = Simulator(small(map=SMALL["map"] | {"splits": splits}))
    noise = noise_of(simulator)
    a, b = ([m + n for m, n in zip(made, noise, strict=True)] for made in (simulator(), ODD["psi_sign"](simulator)))
    given = pairs.given(a, b, simulator.run)
    problem = Prediction(with_shown_sky(given.pairs[0]), (), 0.0)
    alone = problem.corrected(Set(((PsiSign(), np.ones(1)),), 1.0))
    assert 0.02 < alone.left < 0.5
    assert problem.hidden(alone) == pytest.approx(alone.left, rel=0.3)
    assert problem.suffices(alone)


@pytest.mark.slow
def test_nothing_is_simulated_beside_a_set_whose_shortcomings_noise_hides(monkeypatch):
    """Side A once for its sky, which leaves noise, and once as the filtered sky makes it, and the set that is named."""
    simulator, passes = Simulator(small()), []
    noise, made = noise_of(simulator), (simulator(), ODD["psi_sign"](simulator))
    a, b = ([m + n for m, n in zip(side, noise, strict=True)] for side in made)
    whole = Scene.sampled
    monkeypatch.setattr(Scene, "sampled", lambda *given: passes.append(given) or whole(*given))
    assert names(mcsim.compare(a, b, simulator.run)) == ["psi_sign"]
    assert len(passes) <= 3


def test_noise_hides_what_a_coarse_grid_makes_of_the_sky_too():
    """Looked up between the pixels of a map of the same nside, of which noise hides the small scales."""
    simulator = Simulator(small(beam=mcsim.Beam.gaussian(380.0, 32)))
    smooth = healpy.alm2map(healpy.almxfl(simulator.sky, simulator.site.beam.window), 16, lmax=32)
    made = simulator(), simulator(
        sky=np.zeros_like(simulator.sky), added=lambda seen: healpy.get_interp_val(smooth, seen.theta, seen.phi)
    )  # fmt: skip
    a, b = ([m + n for m, n in zip(side, noise_of(simulator), strict=True)] for side in made)
    problem = Prediction(with_shown_sky(pairs.given(a, b, simulator.run).pairs[0]), (), 0.0)
    members = ((Interpolation(), np.array([16.0, 1.0])),)
    alone = Set(members, problem.left(members))
    assert 0.1 < alone.left < 0.5
    assert problem.hidden(alone) == pytest.approx(alone.left, rel=0.3)


@pytest.mark.parametrize("of", ["spin_sign", "psi_offset"])
def test_each_set_is_the_whole_of_its_scan(of):
    simulator = Simulator(MODEL | {"map": MODEL["map"] | {"split_by": "sets"}})
    side_a = simulator()
    np.testing.assert_array_equal(*side_a)
    change, value = CASES[of]
    found = mcsim.compare(side_a, change(simulator, side_a), simulator.run)
    assert names(found) == [of]
    assert found.channels[0].differences[0].amplitude == pytest.approx(value, rel=1e-3)
    assert found.channels[0].left < 1e-5


def test_splits_by_rings_are_refused():
    run = config.load(MODEL | {"map": MODEL["map"] | {"split_by": "rings"}})
    with refused("rings", '"time"', '"sets"'):
        mcsim.compare([np.zeros(3072)] * 2, [np.zeros(3072)] * 2, run)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_halves_that_have_no_pixel_in_common_are_not_exchanged(noise: float) -> None:
    """An exchange of them explained all, as exchanged maps had no data; the noise of a difference had no pixel."""
    simulator = Simulator()
    east = healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[0] > 0.0
    skies, drawn = simulator(), noise_of(simulator)

    def cut(factor: float) -> Maps:
        maps = [factor * m + noise * n for m, n in zip(skies, drawn, strict=True)]
        return [np.where(east, maps[0], healpy.UNSEEN), np.where(east, healpy.UNSEEN, maps[1])]

    found = mcsim.compare(cut(1.0), cut(1.01), simulator.run)
    assert names(found) == ["calibration"]
    assert found.channels[0].differences[0].amplitude == pytest.approx(0.01, rel=0.02)
