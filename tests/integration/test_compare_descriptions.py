"""Comparisons of another program's maps with a description that says as little as it may."""

from dataclasses import replace

import healpy
import numpy as np
import pytest

import mcsim
from comparisons import MODEL, PEAR, SMALL, Simulator, names, small
from mcsim import config
from mcsim.comparison import report
from mcsim.comparison.differences import State
from mcsim.comparison.effects import effects_of
from mcsim.comparison.map_differences import NoiseShared
from mcsim.comparison.pairs import ChannelPair, given
from mcsim.comparison.scene_differences import TimeShift
from mcsim.simulation import sampled, simulate
from mcsim.simulation.channels import MOST_ORDERS, NEGLECTED, load_beam, with_all_orders
from mcsim.simulation.survey import survey
from mcsim.sphere.rotation import rotate_alm
from refusals import refused

ELLIPSE = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 420.0, "fwhm_minor_arcmin": 320.0, "angle_deg": 20.0}
PLAIN = MODEL | {"channel": [MODEL["channel"][0] | {"beam": ELLIPSE}]}
"""The beam without its m_max, of which a run takes two orders."""

DESCRIPTION = """
schema = 1
name = "plain"
[sky]
spectrum = "wmap7"
lmax = 32
[map]
nside = 16
[[channel]]
name = "W1"
beam = { kind = "elliptical_gaussian", fwhm_major_arcmin = 420.0, fwhm_minor_arcmin = 320.0, angle_deg = 20.0 }
scan = { kind = "hit_averaged", model = "wmap", line_of_sight = "A", sample_period_s = 601.0 }
"""

SIMULATOR = """
import mcsim
from comparisons import Simulator, small

BEAM = mcsim.Beam.elliptical(420.0, 320.0, angle_deg=20.0, lmax=32, mmax=6)


class Other:
    def simulate(self, seed, effects=(), sky=None):
        simulator = Simulator(small("wmap", BEAM, map={"nside": 16}))
        return {"W1": simulator(sky=sky, psi=lambda p: p + 0.005)[0]}
"""


@pytest.fixture(scope="module")
def whole() -> Simulator:
    """Return a simulator with more orders of the beam than a run takes."""
    simulator = Simulator(PLAIN)
    simulator.site = replace(simulator.site, beam=load_beam(with_all_orders(simulator.run).channels[0], 32))
    return simulator


def test_a_beam_without_m_max_has_all_orders_that_can_be_seen():
    [spec] = config.load(PLAIN).channels
    [full] = with_all_orders(config.load(PLAIN)).channels
    cut, beam = load_beam(spec, 32), load_beam(full, 32)
    assert cut.neglected_power > 1e3 * NEGLECTED
    assert cut.mmax < beam.mmax <= MOST_ORDERS
    assert beam.neglected_power <= NEGLECTED
    assert with_all_orders(config.load(MODEL)) == config.load(MODEL)


def test_a_beam_of_few_orders_stays_as_it_is():
    run = config.load(small(beam=PEAR.truncated(2)))
    assert load_beam(with_all_orders(run).channels[0], 32).mmax == 2


def test_each_beam_of_a_pair_has_the_orders_of_its_own():
    """Those of side A were given to side B, and a circular side A left side B as it was."""
    oval = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 500.0, "fwhm_minor_arcmin": 350.0}
    [plain] = with_all_orders(config.load(small(beam=oval))).channels
    for beam in ({"kind": "gaussian", "fwhm_arcmin": 400.0}, oval | {"m_max": 2}):
        pair = {"beam": beam, "beam_b": oval, "scan": {"kind": "differencing", "model": "wmap", "pair": "WMAP"}}
        run = small()
        [full] = with_all_orders(config.load(run | {"channel": [run["channel"][0] | pair]})).channels
        assert full.beam_b == plain.beam
        assert full.beam_b.m_max > 2


def test_a_small_turn_of_a_beam_without_m_max_is_no_other_ellipse(whole):
    found = mcsim.compare(whole(), whole(psi=lambda p: p + np.deg2rad(0.3)), whole.run)
    assert names(found) == ["psi_offset"]
    assert found.channels[0].left < 1e-5


@pytest.mark.slow
def test_orders_that_a_run_leaves_out_are_those_of_its_own_maps(whole):
    """Maps of mcsim's own, which have fewer orders, are known for that on both sides, and told from maps with all."""
    cut = Simulator(PLAIN)
    side_a = cut()
    found = mcsim.compare(side_a, cut(psi=lambda p: p + np.deg2rad(0.3)), cut.run)
    assert names(found) == ["psi_offset"]
    assert found.channels[0].left < 1e-5
    for sides in ((whole(), side_a), (side_a, whole())):
        found = mcsim.compare(*sides, whole.run, accuracy=1e-4)
        assert names(found) == ["mmax_cut"]
        assert found.channels[0].differences[0].amplitude == cut.site.beam.mmax


def test_maps_from_orientation_moments_have_the_orders_of_a_run(whole):
    run = whole.run
    made = [simulate.maps(survey(run), 0, sky=sky) for sky in (whole.sky, 1.001 * whole.sky)]
    found = mcsim.compare(*(list(one) for one in made), run)
    assert names(found) == ["calibration"]
    assert found.channels[0].left < 1e-6


@pytest.mark.slow
def test_psi_of_the_other_sign_and_from_the_other_end_is_named():
    """Codes of the COSMO and the IAU convention exchange psi and pi - psi: neither a sign nor half a turn alone."""
    beam = mcsim.Beam.elliptical(400.0, 320.0, lmax=32, mmax=3)
    beam.blm[1] += 0.05 * beam.blm[0] * (np.arange(33) / 32) ** 3
    beam.blm[3, 3:] += 0.03 * beam.blm[0, 3:] * (np.arange(3, 33) / 32) ** 3
    simulator = Simulator(small("litebird", beam, period_s=631.0))
    found = mcsim.compare(simulator(), simulator(psi=lambda p: np.pi - p), simulator.run)
    (channel,) = found.channels
    said = [{d.name for d in one} for one in (channel.differences, *channel.alternatives)]
    assert {"psi_sign", "psi_offset"} in said
    assert channel.left < 1e-3


def test_what_a_wrong_beam_leaves_of_the_sky_is_no_noise():
    draw = np.random.default_rng(1)
    noise = draw.standard_normal((2, 12 * 16**2))
    sky = [healpy.smoothing(one, np.deg2rad(10.0)) for one in noise]
    for maps, expected in ((noise, 2), (np.stack(sky), 0)):
        pair = ChannelPair("W", ("W:a", "W:b"), maps, maps[::-1], np.ones(maps.shape, bool))
        assert len(NoiseShared().starts(State(pair, None, maps, ()))) == 0, "no model says that this is noise"
        pair = replace(pair, noise_uk=np.ones(maps.shape))
        assert len(NoiseShared().starts(State(pair, None, maps, ()))) == 2 * expected


def test_a_mirrored_turn_is_the_same_from_either_side(tmp_path):
    """If psi of one side is that of the other times -1 plus 30 degrees, so is that of the other one."""
    simulator = Simulator(small(map={"nside": 16}))
    one, other = simulator(), simulator(psi=lambda p: np.deg2rad(30.0) - p)
    same = simulator(beam=simulator.site.beam.rotated(np.deg2rad(30.0)), psi=lambda p: -p)
    np.testing.assert_allclose(np.stack(same), np.stack(other), atol=1e-5)
    PEAR.save(tmp_path / "pear.npz")
    for side, maps in (("a", other), ("b", one)):
        (tmp_path / side).mkdir()
        healpy.write_map(tmp_path / side / "W1.fits", maps[0], dtype=np.float64, column_units="uK")
    beam = f'beam = {{ kind = "blm", path = "{tmp_path / "pear.npz"}" }}\n'
    (tmp_path / "b" / "model.toml").write_text(
        "".join(beam if line.startswith("beam") else line for line in DESCRIPTION.splitlines(keepends=True))
    )
    for found in (mcsim.compare(one, other, simulator.run), mcsim.compare(tmp_path / "a", tmp_path / "b")):
        [channel] = found.channels
        psi, turn = 1.0, 0.0
        for d in channel.differences:
            psi, turn = (-psi, -turn) if d.name == "psi_sign" else (psi, turn + d.amplitude)
        assert (psi, turn) == (-1.0, pytest.approx(30.0, abs=0.1))
        [turned] = [d.amplitude for one in channel.alternatives for d in one if d.name == "beam_turned"]
        assert turned == pytest.approx(30.0, abs=0.1)


def test_an_effect_that_is_impossibly_large_has_no_response():
    simulator = Simulator()
    side_a = simulator()
    side_b = simulator(sky=rotate_alm(simulator.sky, 32, "galactic", "ecliptic"))
    [pair] = given(side_a, side_b, simulator.run).pairs
    width = next(one for one in effects_of(pair, simulator.run) if one.name == "beam_width")
    assert width.response(np.array([0.01]), pair.scene, pair) is not None
    assert width.response(np.array([150.0]), pair.scene, pair) is None


@pytest.mark.parametrize("factors", [(1.0, 1.0), (1.0, 1.01)])
def test_a_report_of_maps_that_are_the_same_draws_no_warning(factors):
    rng = np.random.default_rng(2)
    side_a = [rng.standard_normal(12 * 16**2) for _ in factors]
    side_a[1][:40] = healpy.UNSEEN
    side_b = [np.where(m > -1e20, f * m, m) for m, f in zip(side_a, factors, strict=True)]
    found = mcsim.compare(side_a, side_b, Simulator().run)
    axes = report.figure(found.channels[0]).axes
    assert any("W1:half1" in one.get_title() for one in axes) == (factors[1] == 1.0)


def test_maps_without_a_pixel_in_common_are_refused(tmp_path):
    sky, half = np.random.default_rng(0).standard_normal(192), np.arange(192) < 96
    for side, seen in (("a", half), ("b", ~half)):
        (tmp_path / side).mkdir()
        healpy.write_map(tmp_path / side / "W1.fits", np.where(seen, sky, healpy.UNSEEN), dtype=float)
    with refused("W1"):
        mcsim.compare(tmp_path / "a", tmp_path / "b")


@pytest.mark.slow
def test_the_nearest_set_is_said_as_a_whole():
    """A sign alone leaves more than there was; beside half a turn it leaves next to nothing."""
    beam = mcsim.Beam.elliptical(400.0, 320.0, lmax=32, mmax=3)
    beam.blm[1] += 0.05 * beam.blm[0] * (np.arange(33) / 32) ** 3
    simulator = Simulator(small("litebird", beam, period_s=631.0))
    draw = np.random.default_rng(1)
    side_b = [m + 0.5 * draw.standard_normal(m.size) for m in simulator(psi=lambda p: np.pi - p)]
    [found] = mcsim.compare(simulator(), side_b, simulator.run).channels
    assert found.verdict == "unknown"
    assert 0.0 < found.nearest_explains < 1.0
    assert f"{100 * found.nearest_explains:.0f} %" in found.sentence()
    assert all(d.name in found.sentence() for d in found.nearest)


def test_a_comparison_without_a_model_asks_for_one_and_knows_another_sky(tmp_path, whole):
    turned, other = whole(psi=lambda p: p + 1.0), whole(sky=np.roll(whole.sky, 40))
    for side, maps in (("a", whole()), ("b", turned), ("c", other)):
        (tmp_path / side).mkdir()
        for split, one in zip(MODEL["map"]["splits"], maps, strict=True):
            healpy.write_map(tmp_path / side / f"W1_{split}.fits", one, dtype=np.float64, column_units="uK")
    looks = []
    for side in "bc":
        found = mcsim.compare(tmp_path / "a", tmp_path / side)
        assert found.verdict == "unknown"
        assert "model" in str(found)
        looks.append([look for channel in found.channels for look in channel.looks if "sides correlate" in look])
    assert [len(one) for one in looks] == [0, 2]


def test_a_configuration_beside_another_simulator_has_all_orders(tmp_path, whole):
    (tmp_path / "other.py").write_text(SIMULATOR)
    for name, more in (("plain", ""), ("other", 'simulator = "other.py:Other"\n')):
        (tmp_path / f"{name}.toml").write_text(more + DESCRIPTION)
    found = mcsim.compare(tmp_path / "plain.toml", tmp_path / "other.toml")
    assert names(found) == ["psi_offset"]
    assert found.channels[0].differences[0].amplitude == pytest.approx(np.rad2deg(0.005), rel=1e-3)
    assert found.channels[0].left < 1e-3


def test_a_configuration_that_is_a_side_describes_it_whatever_lies_beside(tmp_path):
    texts = [DESCRIPTION, DESCRIPTION.replace("angle_deg = 20.0", "angle_deg = 21.0")]
    texts.append(DESCRIPTION.replace("nside = 16", 'nside = 16\nframe = "galactic"'))
    a, b, model = (tmp_path / name for name in ("a.toml", "b.toml", "model.toml"))
    for path, text in zip((a, b, model), texts, strict=True):
        path.write_text(text)
    found = mcsim.compare(a, b)
    assert names(found) == ["psi_offset"]
    assert found.channels[0].differences[0].amplitude == pytest.approx(1.0, abs=0.01)
    with refused(a, "ecliptic", model, "galactic", "--model"):
        mcsim.compare(a, b, model)
    [folder] = mcsim.write_maps(a, tmp_path / "maps", realizations=0)
    with refused(folder, "ecliptic", model, "galactic", "--model"):
        mcsim.compare(folder, folder)
    assert mcsim.compare(folder, a).verdict == "identical"


@pytest.mark.parametrize("described", ["model.toml", "folder"])
@pytest.mark.parametrize(
    ("beams", "name", "amplitude"),
    [
        (("fwhm_major_arcmin = 420.0", "fwhm_major_arcmin = 320.0"), "beam_width", 320.0 / 420.0 - 1.0),
        (("angle_deg = 20.0", "angle_deg = 40.0"), "psi_offset", 20.0),
    ],
)
def test_what_is_side_b_s_own_describes_that(tmp_path, described, beams, name, amplitude):
    """The sky of side A is not that which its maps show through the beam of side B."""
    text = DESCRIPTION.replace("320.0", "420.0") if name == "beam_width" else DESCRIPTION
    there = text.replace(*beams).replace("fwhm_minor_arcmin = 420.0", "fwhm_minor_arcmin = 320.0")
    (tmp_path / "a.toml").write_text(text)
    (tmp_path / "model.toml").write_text(there)
    side = tmp_path / "model.toml"
    mcsim.write_maps(tmp_path / "a.toml", tmp_path / "a", realizations=0)
    if described == "folder":
        [side] = mcsim.write_maps(side, tmp_path / "b", realizations=0)
        (tmp_path / "model.toml").rename(tmp_path / "b" / "model.toml")
    found = mcsim.compare(tmp_path / "a", side)
    assert names(found) == [name]
    assert found.channels[0].differences[0].amplitude == pytest.approx(amplitude, rel=1e-3)
    assert found.to_dict()["model_describes"] == {"W1": "b"}
    assert found.channels[0].left < 1e-6


@pytest.mark.parametrize("factor", [1.0, 1e-6])
def test_a_configuration_beside_maps_of_a_run_has_the_orders_of_a_run(tmp_path, factor):
    """Whatever else is different, which may be far more than the orders that a run leaves out."""
    head = DESCRIPTION.partition("scan =")[0]
    for name, psi_deg in (("a", 10.0), ("b", 15.0)):
        (tmp_path / f"{name}.toml").write_text(
            head + f'scan = {{ kind = "parallel_transport", psi0_deg = {psi_deg} }}\n'
        )
    a, b = (tmp_path / f"{name}.toml" for name in "ab")
    [folder] = mcsim.write_maps(b, tmp_path / "b", realizations=0)
    map_ = factor * healpy.read_map(folder / "W1.fits")
    healpy.write_map(folder / "W1.fits", map_, dtype=np.float64, column_units="uK", overwrite=True)
    for sides, sign in (((a, folder), 1.0), ((folder, a), -1.0)):
        found = mcsim.compare(*sides, a if sign > 0.0 else b)
        assert sorted(names(found)) == (["psi_offset"] if factor == 1.0 else ["psi_offset", "unit"])
        turned = next(d for d in found.channels[0].differences if d.name == "psi_offset")
        assert turned.amplitude == pytest.approx(5.0 * sign, rel=1e-3)
        assert found.channels[0].left < 1e-6


def test_a_gain_beside_a_dipole_is_a_factor_from_either_side(tmp_path):
    effect = '[[effect]]\nname = "calibration"\nchannel = "W1"\namplitude = 0.05\n'
    for name, more in (("plain", ""), ("gain", effect)):
        (tmp_path / f"{name}.toml").write_text(DESCRIPTION.replace("lmax = 32", "lmax = 32\ndipole_uk = 3364.5") + more)
    plain, gain = tmp_path / "plain.toml", tmp_path / "gain.toml"
    [folder] = mcsim.write_maps(gain, tmp_path / "maps", realizations=0)
    for sides, amplitude in (((plain, folder), 0.05), ((folder, plain), 1.0 / 1.05 - 1.0)):
        found = mcsim.compare(*sides)
        assert names(found) == ["calibration"]
        assert found.channels[0].differences[0].amplitude == pytest.approx(amplitude, rel=1e-4)


@pytest.mark.parametrize(
    ("name", "size", "amplitude", "words"),
    [
        ("beam_width", 0.2, 1.0 / 1.2 - 1.0, "in side A: FWHM 20"),
        ("beam_ellipticity", 0.1, 0.1, "in side A: axis ratio 1.1"),
        ("beam_coma", 0.1, 0.1, "in side A: k = 0.1"),
    ],
)
def test_an_effect_of_side_a_is_taken_back_in_side_b(tmp_path, name, size, amplitude, words):
    """A beam that is a fifth wider is made narrower by a sixth; what side A has is said besides."""
    for side in ("acting", "plain"):
        (tmp_path / side).mkdir()
    (tmp_path / "plain" / "model.toml").write_text(DESCRIPTION.replace("20.0 }", "20.0, m_max = 4 }"))
    plain = config.load(tmp_path / "plain" / "model.toml")
    acting = replace(plain, effects=(config.Effect(name=name, channel="W1", parameters={"amplitude": size}),))
    for run in (plain, acting):
        [(_, map_)] = sampled.maps(survey(run), 0)
        file = tmp_path / ("acting" if run.effects else "plain") / "W1.fits"
        healpy.write_map(file, map_, dtype=np.float64, coord="E", column_units="uK")
    found = mcsim.compare(tmp_path / "acting", tmp_path / "plain")
    assert names(found) == [name]
    assert found.channels[0].differences[0].amplitude == pytest.approx(amplitude, rel=0.03)
    assert words in str(found)


@pytest.mark.parametrize(
    ("name", "size"),
    [("beam_width", 0.2), ("beam_ellipticity", 0.2), ("pointing_offset", 60.0), ("time_constant", 0.3)],
)
def test_strong_effects_are_simulated_without_samples(tmp_path, name, size):
    """In maps by orientation moments: in proportion to a small step an ellipse was another one, with psi 20 deg off.

    The fit ends where so little is left that nothing is looked for in it.
    """
    effect = f'[[effect]]\nname = "{name}"\nchannel = "W1"\namplitude = {size}\n'
    text = DESCRIPTION.replace("20.0 }", "20.0, m_max = 4 }").replace("lmax = 32", "lmax = 32\ndipole_uk = 3364.5")
    for side, more in (("plain", ""), ("acting", effect)):
        (tmp_path / f"{side}.toml").write_text(text + more)
    found = mcsim.compare(tmp_path / "plain.toml", tmp_path / "acting.toml")
    assert names(found) == [name]
    assert found.channels[0].differences[0].amplitude == pytest.approx(size, rel=5e-3)
    assert found.channels[0].left < 1e-4


def test_a_side_without_effects_describes_itself(tmp_path):
    """Through the beam without its own effect, a side that is a fifth wider had another that is a quarter narrower."""
    for name, size in (("plain", None), ("wide", 0.2)):
        effect = "" if size is None else f'[[effect]]\nname = "beam_width"\nchannel = "W1"\namplitude = {size}\n'
        (tmp_path / f"{name}.toml").write_text(DESCRIPTION.replace("20.0 }", "20.0, m_max = 4 }") + effect)
    plain, wide = (tmp_path / f"{name}.toml" for name in ("plain", "wide"))
    found = mcsim.compare(wide, plain)
    assert found.to_dict()["model_describes"] == {"W1": "b"}
    assert names(found) == ["beam_width"]
    assert found.channels[0].differences[0].amplitude == pytest.approx(1.0 / 1.2 - 1.0, rel=2e-3)


def acting(tmp_path, name, *effects):
    """Write a description with effects in W1, and return its path."""
    tables = (f'[[effect]]\nname = "{one}"\nchannel = "W1"\namplitude = {size}\n' for one, size in effects)
    (tmp_path / f"{name}.toml").write_text(DESCRIPTION.replace("20.0 }", "20.0, m_max = 4 }") + "".join(tables))
    return tmp_path / f"{name}.toml"


@pytest.mark.parametrize(
    ("own", "other", "named", "size"),
    [
        ([("beam_width", 0.2)], [("beam_width", 0.3)], "beam_width", 1.3 / 1.2 - 1.0),
        ([("beam_ellipticity", 0.3)], [("beam_ellipticity", 0.3), ("beam_coma", 0.05)], "beam_coma", 0.05),
    ],
)
def test_a_side_is_described_through_the_beam_that_its_effects_make(tmp_path, own, other, named, size):
    """Through the beam without them the width was 0.15, and the coma *unknown*."""
    found = mcsim.compare(acting(tmp_path, "a", *own), acting(tmp_path, "b", *other))
    assert names(found) == [named]
    assert found.channels[0].differences[0].amplitude == pytest.approx(size, rel=2e-3)
    assert found.channels[0].left < 1e-3


@pytest.mark.parametrize(("name", "size"), [("beam_coma", 0.1), ("beam_ellipticity", 0.3)])
def test_an_effect_of_side_a_is_named_whoever_gives_the_model(tmp_path, name, size):
    """Through the model's beam a coma was *unknown*, and an ellipse had a beam beside it that is 3 % smaller."""
    sides = acting(tmp_path, "a", (name, size)), acting(tmp_path, "b")
    folders = [mcsim.write_maps(side, tmp_path / side.stem, realizations=0)[0] for side in sides]
    found = mcsim.compare(*folders, sides[1])
    assert names(found) == [name]
    assert found.channels[0].differences[0].amplitude == pytest.approx(size, rel=0.02)
    assert found.channels[0].left < 1e-3
    assert found.to_dict()["model_describes"] == {"W1": "b"}


def test_other_effects_of_a_description_are_warned_of(tmp_path):
    own = ("pointing_offset", 60.0), ("beam_width", 0.2)
    with pytest.warns(UserWarning, match=r"plain has effects \(pointing_offset\).*relative to the survey without them"):
        mcsim.compare(acting(tmp_path, "a", *own), acting(tmp_path, "b", *own, ("beam_coma", 0.05)))


def test_another_spectrum_is_no_cause_where_no_sample_can_be_elsewhere(tmp_path):
    """Under parallel transport a set must explain as much as where samples are known."""
    head = DESCRIPTION.partition("scan =")[0].replace("420.0", "300.0").replace("320.0", "240.0")
    head = head.replace("lmax = 32", "lmax = 40") + 'scan = { kind = "parallel_transport" }\n'
    for name, text in (("a", head), ("b", head.replace("wmap7", "planck2018"))):
        (tmp_path / f"{name}.toml").write_text(text)
    [folder] = mcsim.write_maps(tmp_path / "b.toml", tmp_path / "maps", realizations=0)
    assert mcsim.compare(tmp_path / "a.toml", folder).verdict == "unknown"


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (("wmap7", "planck2018"), "sky.spectrum"),
        (("lmax = 32", "lmax = 31"), "sky.lmax"),
        (("seed = 1", "seed = 2"), 2),
    ],
)
def test_descriptions_of_different_skies_are_not_compared(tmp_path, change, key):
    """Of another spectrum a beam was blamed, which explained 95 %."""
    text = DESCRIPTION + "[ensemble]\nseed = 1\nrealizations = 1\n"
    assert change[0] in text
    for name, own in (("a", text), ("b", text.replace(*change))):
        (tmp_path / f"{name}.toml").write_text(own)
    with refused(tmp_path / "a.toml", tmp_path / "b.toml", key):
        mcsim.compare(tmp_path / "a.toml", tmp_path / "b.toml")


@pytest.mark.parametrize("turned", [7.0, 10.0, 15.0])
def test_beside_another_difference_a_run_has_its_own_orders(tmp_path, turned):
    """All orders of the beam left a little less beside a turned one, by chance, and a cut of the orders was named."""
    text = DESCRIPTION.replace("320.0", "330.0").replace("lmax = 32", "lmax = 40").replace("601.0", "61.0")
    other = text.partition("[[channel]]")[2].replace("W1", "V1").replace('"A"', '"B"').replace("20.0 }", "70.0 }")
    text += "[[channel]]" + other.replace("420.0", "400.0").replace("330.0", "350.0")
    text += "[ensemble]\nrealizations = 1\nseed = 1\n"
    (tmp_path / "a.toml").write_text(text)
    (tmp_path / "b.toml").write_text(text.replace("angle_deg = 20.0", f"angle_deg = {20.0 + turned}", 1))
    [folder] = mcsim.write_maps(tmp_path / "a.toml", tmp_path / "a", realizations=0, sample_by_sample=True)
    found = mcsim.compare(folder, tmp_path / "b.toml")
    assert {one.name: [d.name for d in one.differences] for one in found.channels} == {"W1": ["psi_offset"], "V1": []}
    [turn] = next(one for one in found.channels if one.name == "W1").differences
    assert turn.amplitude == pytest.approx(turned, rel=0.01)


@pytest.mark.parametrize("name", ["maps.zarr", "W1.fits", "maps.npz"])
def test_stored_maps_are_named_in_a_configuration(tmp_path, name):
    if name.endswith(".zarr"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "zarr.json").write_text("{}")
    else:
        (tmp_path / name).write_bytes(b"\x93")
    with refused(tmp_path / name, "maps", "CHANNEL.fits"):
        mcsim.compare(tmp_path / name, tmp_path / name, config.load(MODEL))


def test_what_responds_by_rounding_alone_is_no_effect():
    """The orientations of a whole survey are its own: of its halves they are not."""
    for splits in ([], ["half1", "half2"]):
        simulator = Simulator(small(map={"nside": 16, "splits": splits}))
        [pair] = given(simulator(), simulator(), simulator.run).pairs
        found = {one.name for one in effects_of(pair, simulator.run)}
        assert {"beam_ellipticity", "gain_drift"} < found
        assert ("orientation_averaging" in found) == bool(splits)


def test_late_samples_add_no_dipole_to_an_effect():
    """A response to an ellipse has 0.1 uK of a dipole, and not the 770 uK by which late samples see it elsewhere."""
    made, dipole = [], {"dipole_uk": 3000.0, "dipole_lon_deg": 264.0, "dipole_lat_deg": 48.0}
    for sky in (SMALL["sky"], SMALL["sky"] | dipole):
        simulator = Simulator(small(sky=sky))
        [pair] = given(simulator(), simulator(), simulator.run).pairs
        ellipse = next(one for one in effects_of(pair, simulator.run) if one.name == "beam_ellipticity")
        late = TimeShift().scene(replace(pair.scene, sky=simulator.sky), np.array([0.01]), pair)
        made.append(np.where(pair.seen, ellipse.sampled(np.array([0.1, 0.0]), late, pair), 0.0))
    assert made[0].std() > 0.1
    assert np.abs(made[1] - made[0]).max() < 1.0


@pytest.mark.parametrize(("share", "correlation"), [(0.5, np.sqrt(0.5)), (1.0, 1.0), (0.0, 0.0), (-5.0, -np.sqrt(0.5))])
def test_a_share_of_noise_is_a_correlation(share, correlation):
    """The least share, (1 - sqrt 2)/2, is beyond what rounding leaves of a root: it was nan."""
    assert NoiseShared().amplitude(np.array([share, 0.0])) == pytest.approx(correlation)
