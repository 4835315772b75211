"""Comparisons of two simulations: maps made sample by sample, with differences put in by hand."""

from collections.abc import Callable
from dataclasses import replace

import healpy
import numpy as np
import pytest
from numpy.typing import NDArray

import mcsim
from comparisons import CASES, LMAX, MODEL, NSIDE, ODD, PEAR, Maps, Simulator, names, noise_of, scaled, small
from mcsim import config
from mcsim.comparison import pairs
from mcsim.comparison.description import with_known_offsets
from mcsim.comparison.effects import effects_of
from mcsim.comparison.map_differences import Calibration, Dipole, Monopole
from mcsim.comparison.prediction import Set
from mcsim.comparison.scene_differences import PixelWindow, Smoothing, TimeShift
from mcsim.comparison.search import Problem
from mcsim.comparison.shown_sky import with_shown_sky
from mcsim.instrument.scan import LineOfSight, MapGrid, ScanModel, write_moments_fits
from mcsim.simulation import simulate, tod
from mcsim.simulation.survey import survey


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator()


@pytest.fixture(scope="module")
def side_a(simulator: Simulator) -> Maps:
    return simulator()


@pytest.mark.parametrize("name", CASES)
def test_a_difference_is_named_with_its_amplitude(name, simulator, side_a):
    make, amplitude = CASES[name]
    found = mcsim.compare(side_a, make(simulator, side_a), simulator.run)
    assert found.verdict == "difference"
    assert names(found) == [name]
    assert found.channels[0].differences[0].amplitude == pytest.approx(amplitude, rel=0.02, abs=1e-9)
    assert found.channels[0].left < 0.01


def test_a_mirrored_beam_is_named_or_is_the_turn_that_makes_the_same_maps(simulator, side_a):
    """The mirror image of an ellipse at 20 degrees is the ellipse at -20 degrees: both names are right."""
    beam = simulator.site.beam
    found = mcsim.compare(side_a, simulator(beam=replace(beam, blm=beam.blm.conj())), simulator.run)
    (channel,) = found.channels
    said = {d.name for one in ((channel.differences), *channel.alternatives) for d in one}
    assert {"beam_conjugated", "psi_offset", "beam_turned"} <= said
    assert channel.left < 0.01


def test_what_interpolation_leaves_does_not_choose_a_name():
    """A width beside a calibration takes in what a look-up smooths, and would be named in place of a window."""
    draw = np.random.default_rng(1)
    a, seen = draw.standard_normal((1, 12 * NSIDE**2)), np.ones((1, 12 * NSIDE**2), bool)
    pair = pairs.ChannelPair("T", ("T",), a, a + 0.04 * draw.standard_normal(a.shape), seen)
    scale = (Calibration(), np.array([0.005, 0.0]))
    window, width = ((difference, np.ones(1)) for difference in (PixelWindow(), Smoothing()))
    larger = Set((window, scale, (Monopole(), np.ones(1))), 2e-5)
    for left, first in ((1e-4, window), (2e-3, width)):
        found = Problem(pair, (), 1e-3).preferred([Set((width, scale), 1e-5), larger, Set((window, scale), left)])
        assert found[0].members == (first, scale)


def test_what_leaves_nothing_is_not_given_up_for_fewer_fitted_values():
    """No value takes in all that an interpolation leaves: a pointing offset was a time constant, which is nearly it."""
    draw = np.random.default_rng(1)
    a, seen = draw.standard_normal((1, 12 * NSIDE**2)), np.ones((1, 12 * NSIDE**2), bool)
    pair = pairs.ChannelPair("T", ("T",), a, a + 0.05 * draw.standard_normal(a.shape), seen)
    dipole, width = (Dipole(), np.ones(3)), (Smoothing(), np.ones(1))
    found = Problem(pair, (), 1e-3).preferred([Set((dipole,), 1e-12), Set((width,), 1e-5)])
    assert found[0].members == (dipole,)


def test_a_turn_of_a_degree_is_not_taken_for_a_turn_of_half_a_circle_more(simulator, side_a):
    found = mcsim.compare(side_a, simulator(psi=lambda p: p + np.deg2rad(1.0)), simulator.run)
    (channel,) = found.channels
    assert channel.differences[0].name == "psi_offset"
    assert channel.differences[0].amplitude == pytest.approx(1.0, rel=1e-3)


def test_time_stamps_of_half_a_sample_are_named():
    beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 660.0, "fwhm_minor_arcmin": 540.0}
    scan = {"kind": "hit_averaged", "model": "litebird", "sample_period_s": 93.0}
    channel = {"name": "T", "beam": beam, "scan": scan}
    run = config.load(MODEL | {"sky": {"spectrum": "wmap7", "lmax": 30}, "map": {"nside": 16}, "channel": [channel]})
    whole = survey(run)
    pointing, sky = whole.channels[0].site.pointed(""), simulate.draw_sky(whole, 0)
    observe = tod.sky_signal(sky, 30, whole.channels[0].site.beam, 1e-8, 1)
    model = pointing.model
    later = replace(
        model,
        spin_phase_deg=180.0 * 93.0 / model.spin_period_s,
        precession_phase_deg=180.0 * 93.0 / model.precession_period_s,
        orbit_phase_deg=180.0 * 93.0 / model.orbit_period_s,
    )

    def made(seen: mcsim.ScanModel) -> NDArray[np.float64]:
        both = (tod.samples(m, pointing.line, MapGrid(16, "ecliptic")) for m in (model, seen))
        stream = (replace(there, pixel=here.pixel) for here, there in zip(*both, strict=True))
        return tod.bin_samples(observe(stream), 16)[0]

    found = mcsim.compare([made(model)], [made(later)], run)
    assert names(found) == ["time_shift"]
    assert found.channels[0].differences[0].amplitude == pytest.approx(0.5, rel=0.01)


@pytest.mark.parametrize("coordinate", ["longitude", "latitude"])
@pytest.mark.parametrize("of", ["the sky", "the pixels"])
def test_mirrored_coordinates_are_named(coordinate, of, simulator, side_a):
    """HEALPix is its own mirror image in both, so that mirrored maps are exchanged pixels."""
    theta, phi = healpy.pix2ang(NSIDE, np.arange(side_a[0].size))
    degree, order = healpy.Alm.getlm(LMAX)
    if coordinate == "longitude":
        sky, pixels = simulator.sky.conj(), healpy.ang2pix(NSIDE, theta, 2.0 * np.pi - phi)
    else:
        sky, pixels = (-1.0) ** (degree + order) * simulator.sky, healpy.ang2pix(NSIDE, np.pi - theta, phi)
    side_b = simulator(sky=sky) if of == "the sky" else [map_[pixels] for map_ in side_a]
    found = mcsim.compare(side_a, side_b, simulator.run)
    assert names(found) == ["frame_reversed"]
    assert found.channels[0].differences[0].parameters == {"coordinate": coordinate, "of": of}
    assert found.channels[0].left < 1e-4


def test_two_differences_are_both_named(simulator, side_a):
    side_b = scaled(simulator(psi=lambda p: p + np.pi / 2), 1.002)
    found = mcsim.compare(side_a, side_b, simulator.run)
    assert found.verdict == "mixture"
    assert sorted(names(found)) == ["calibration", "psi_offset"]
    sets = [frozenset(d.name for d in one) for one in found.channels[0].alternatives]
    assert sets == [{"calibration", "beam_turned"}], "one set, in one order"


def test_an_effect_of_the_library_is_named(simulator, side_a):
    effect = config.Effect(name="pointing_offset", channel="W1", parameters={"amplitude": 2.0, "angle_deg": 90.0})
    from mcsim.simulation import sampled

    side_b = [m for _, m in sampled.maps(survey(replace(simulator.run, effects=(effect,))), 0)]
    found = mcsim.compare(side_a, side_b, simulator.run)
    assert names(found) == ["pointing_offset"]
    assert found.channels[0].differences[0].amplitude == pytest.approx(2.0, rel=0.03)


@pytest.mark.parametrize("others", [{}, {"beam_ellipticity": 0.05}])
def test_a_gain_that_leaves_a_part_of_the_dipole_is_named(others):
    """It is no factor of the maps, from which the dipole is taken with a gain of 1, but like a ring's pick-up."""
    dipole = {"dipole_uk": 3364.5, "dipole_lon_deg": 264.0, "dipole_lat_deg": 48.0}
    wanted = {"calibration": 0.01, **others}
    run = config.load(small(beam=mcsim.Beam.gaussian(380.0, 32)) | {"sky": MODEL["sky"] | dipole})
    effects = tuple(config.Effect(name=n, channel="W1", parameters={"amplitude": v}) for n, v in wanted.items())
    sides = (list(simulate.maps(survey(replace(run, effects=one)), 0)) for one in ((), effects))
    found = mcsim.compare(*sides, run)
    assert {d.name: d.amplitude for d in found.channels[0].differences} == pytest.approx(wanted, rel=0.01)
    assert found.channels[0].left < 1e-6


def test_powers_of_offsets_stand_for_samples_that_are_not_known(tmp_path):
    """Maps of the same sky are identical if a file of moments knows the offsets of the samples; no pointing."""
    beam = {"kind": "gaussian", "fwhm_arcmin": 180.0}
    simulator = Simulator({**MODEL, "channel": [{**MODEL["channel"][0], "beam": beam}]})
    pointing = simulator.site.pointed("")
    model = pointing.model.with_lines_of_sight(pointing.line.name)
    for half, split in enumerate(MODEL["map"]["splits"]):
        grid = MapGrid(NSIDE, "ecliptic", (half / 2, (half + 1) / 2), offset_order=4)
        write_moments_fits(tmp_path / f"{split}.fits", mcsim.Moments.on_grid(model, grid, 5))
    scan = {"kind": "moments", "path": str(tmp_path / "{split}.fits")}
    table = {**MODEL, "channel": [{"name": "W1", "beam": beam, "scan": scan}]}
    run = config.load(table)
    first = config.load({**table, "map": MODEL["map"] | {"offset_order": 1}})
    made = [list(simulate.maps(survey(with_known_offsets(one)), 0, sky=simulator.sky)) for one in (run, first)]
    side_b = simulator()
    found = mcsim.compare(made[0], side_b, run).channels[0]
    assert found.verdict == "identical"
    assert found.rms_uk < 2e-4 * found.sky_rms_uk
    usual = np.std((np.stack(made[1]) - np.stack(side_b))[np.stack(side_b) != healpy.UNSEEN])
    assert usual > 50.0 * found.rms_uk


@pytest.fixture(scope="module")
def odd() -> Simulator:
    return Simulator(small("litebird", period_s=631.0))


@pytest.fixture(scope="module")
def odd_side_a(odd: Simulator) -> Maps:
    return odd()


@pytest.mark.parametrize("name", ODD)
def test_a_beam_of_odd_orders_is_no_obstacle(name, odd, odd_side_a):
    found = mcsim.compare(odd_side_a, ODD[name](odd), odd.run)
    assert names(found) == [name]


def test_channels_exchanged_or_with_the_same_noise_are_named():
    channel = small()["channel"][0]
    other = {**channel, "name": "W2", "beam": mcsim.Beam.gaussian(380.0, 32)}
    model = small() | {"channel": [channel, other]}
    one, two = Simulator(model), Simulator(model, 1)
    clean = [*one(), *two()]
    exchanged = mcsim.compare(clean, clean[2:] + clean[:2], one.run)
    assert names(exchanged) == ["channel_exchanged"] * 2
    draw = np.random.default_rng(3)
    noise = [20.0 * draw.standard_normal(m.size) for m in clean]
    side_a = [m + n for m, n in zip(clean, noise, strict=True)]
    noisy = replace(one.run, channels=tuple(replace(c, noise=config.Noise(sigma0_uk=250.0)) for c in one.run.channels))
    found = mcsim.compare(side_a, [*side_a[:2], clean[2] + noise[0], clean[3] + noise[1]], noisy)
    assert [(d.name, d.channel) for c in found.channels for d in c.differences] == [("noise_shared", "W2")]
    assert found.channels[1].differences[0].amplitude == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("correlation", [0.7, 0.8, 1.0])
def test_noise_that_is_shared_in_part_has_its_correlation(correlation, simulator, side_a):
    run = replace(simulator.run, channels=(replace(simulator.run.channels[0], noise=config.Noise(sigma0_uk=60.0)),))
    hits = [np.maximum(m.moments.hits, 1.0) for m in survey(run).making.channels[0].maps]
    own, other = np.random.default_rng(6).standard_normal((2, hits[0].size))
    both = np.sqrt(1.0 - correlation**2) * own + correlation * other
    a, b = (
        [np.where(m > -1e20, m + 60.0 * n / np.sqrt(h), m) for m, n, h in zip(side_a, noise, hits, strict=True)]
        for noise in ((own, other), (both, other))
    )
    [found] = mcsim.compare(a, b, run).channels[0].differences
    assert found.name == "noise_shared"
    assert found.amplitude == pytest.approx(correlation, abs=0.02)


@pytest.mark.parametrize("width", [-0.1, 0.1])
def test_noise_in_common_is_not_that_of_another_channel(width):
    """What it hides of the sky, seen through another beam, is like a part of it: 1 to 4 % were said to be shared."""
    channel = small(beam=mcsim.Beam.gaussian(500.0, 32))["channel"][0]
    model = small() | {"channel": [channel, channel | {"name": "W2", "beam": mcsim.Beam.gaussian(380.0, 32)}]}
    wide = channel | {"beam": mcsim.Beam.gaussian(500.0 * (1.0 + width), 32)}
    one, two = Simulator(model), Simulator(model, 1)
    draw = np.random.default_rng(3)
    clean = [*one(), *two()]
    noise = [10.0 * draw.standard_normal(m.size) for m in clean]
    side_a, side_b = (
        [m + n for m, n in zip(maps, noise, strict=True)]
        for maps in (clean, [*Simulator(model | {"channel": [wide, model["channel"][1]]})(), *clean[2:]])
    )
    noisy = replace(one.run, channels=tuple(replace(c, noise=config.Noise(sigma0_uk=120.0)) for c in one.run.channels))
    [found, same] = mcsim.compare(side_a, side_b, noisy).channels
    assert [d.name for d in found.differences] == ["beam_width"]
    assert found.differences[0].amplitude == pytest.approx(width, abs=0.01)
    assert not same.differences


def test_a_split_that_has_its_own_map_was_not_exchanged():
    simulator = Simulator(small(beam=mcsim.Beam.gaussian(380.0, 32)))
    one, other = simulator(), simulator(sky=np.roll(simulator.sky, 40))
    assert mcsim.compare([other[0], one[1]], one, simulator.run).verdict == "unknown"


@pytest.mark.parametrize("sigma0_uk", [0.0, 60.0])
def test_noise_of_one_channel_on_one_side_is_not_shared(sigma0_uk):
    """The maps without it are those with it, less their own noise and with none of the other channel's."""
    channel = small(beam=mcsim.Beam.gaussian(380.0, 32))["channel"][0] | {"noise": {"sigma0_uk": sigma0_uk}}
    simulator = Simulator(small() | {"channel": [channel, {**channel, "name": "W2"}]})
    clean = simulator()
    noisy = [m + n for m, n in zip(clean, noise_of(simulator), strict=True)]
    found = mcsim.compare([*clean, *clean], [*noisy, *clean], simulator.run)
    assert [channel.verdict for channel in found.channels] == ["unknown", "identical"]


@pytest.mark.parametrize("factor", [1.0, 1.002])
def test_a_channel_that_has_its_own_maps_was_not_exchanged(factor):
    """The other channel shows another sky, and nothing else would be like its side A as the first channel is."""
    channel = small(beam=mcsim.Beam.gaussian(380.0, 32))["channel"][0]
    simulator = Simulator(small() | {"channel": [channel, {**channel, "name": "W2"}]})
    one, other = simulator(), simulator(sky=np.roll(simulator.sky, 40))
    found = mcsim.compare([*one, *one], [*scaled(one, factor), *other], simulator.run)
    assert [channel.verdict for channel in found.channels] == [
        "identical" if factor == 1.0 else "difference",
        "unknown",
    ]


def test_stripes_of_a_binned_map_are_those_that_a_destriper_takes_off():
    simulator = Simulator(small())
    draw = np.random.default_rng(4)
    drift = np.cumsum(draw.standard_normal(2000))
    drift -= drift.mean()

    def offsets(chunk: tod.Samples) -> NDArray[np.float64]:
        return drift[(chunk.time_s / (256 * 601.0)).astype(int)]

    found = mcsim.compare(simulator(added=offsets), simulator(), simulator.run)
    assert names(found) == ["map_making"]
    assert found.channels[0].differences[0].amplitude == pytest.approx(found.channels[0].rms_uk, rel=0.1)


def test_a_sky_that_is_looked_up_on_a_grid_is_named():
    simulator = Simulator(small(beam=mcsim.Beam.gaussian(380.0, 32)))
    smooth = healpy.alm2map(healpy.almxfl(simulator.sky, simulator.site.beam.window), 32, lmax=32)

    def nearest(chunk: tod.Samples) -> NDArray[np.float64]:
        return np.asarray(smooth[healpy.ang2pix(32, chunk.theta, chunk.phi)])

    found = mcsim.compare(simulator(), simulator(sky=np.zeros_like(simulator.sky), added=nearest), simulator.run)
    assert names(found) == ["interpolation"]
    assert found.channels[0].differences[0].amplitude == 32


def test_a_reversed_spin_keeps_the_turn_of_the_instrument(odd):
    """Moments of the other scan are turned as those of the model are, in whichever order the two are found."""
    found = mcsim.compare(odd(), odd(turning={"spin_period_s": -1.0}, psi=lambda p: p + 0.8), odd.run)
    (channel,) = found.channels
    assert sorted(names(found)) == ["psi_offset", "spin_sign"]
    assert channel.left < 1e-4
    turned = next(d for d in channel.differences if d.name == "psi_offset")
    assert turned.amplitude == pytest.approx(np.rad2deg(0.8), abs=0.02)


def drift_of(simulator: Simulator, sky: NDArray[np.complex128]) -> Callable[[tod.Samples], NDArray[np.float64]]:
    """What a gain that drifts by 2 % over the year adds to samples of a sky."""
    observe = tod.sky_signal(sky, 32, PEAR, 1e-8, 1)
    year_s = simulator.site.pointed("").model.orbit_period_s

    def drift(chunk: tod.Samples) -> NDArray[np.float64]:
        [seen] = observe([replace(chunk, signal_uk=0.0 * chunk.psi)])
        return 0.02 * np.sin(2.0 * np.pi * chunk.time_s / year_s) * seen.signal_uk

    return drift


def test_garbage_behind_the_mask_of_a_nested_map_hides_no_other_difference():
    """It is in pixels that are compared until the order is right, where the other side had something to say."""
    simulator = Simulator(small())
    masked = healpy.pix2vec(16, np.arange(12 * 16**2))[2] > 0.5
    run = mcsim.load_config(small(map={**small()["map"], "mask": np.where(masked, 0.0, 1.0)}))
    side_b = simulator(added=drift_of(simulator, simulator.sky))
    garbage = 500.0 * np.random.default_rng(1).standard_normal(masked.size)
    found = mcsim.compare(simulator(), [healpy.reorder(np.where(masked, garbage, m), r2n=True) for m in side_b], run)
    assert sorted(names(found)) == ["gain_drift", "ordering"]
    assert found.channels[0].differences[0].amplitude == pytest.approx(0.02, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "change"), [("beam_window", lambda sky: healpy.almxfl(sky, PEAR.window)), ("frame_reversed", np.conj)]
)
def test_an_effect_through_another_sky_is_measured_there(name, change):
    """A gain that drifts over the year, and a sky that was smoothed, or mirrored: the drift acts on that sky."""
    simulator = Simulator(small())
    sky = change(simulator.sky)
    found = mcsim.compare(simulator(), simulator(sky=sky, added=drift_of(simulator, sky)), simulator.run)
    assert sorted(names(found)) == [name, "gain_drift"]
    drifting = next(d for d in found.channels[0].differences if d.name == "gain_drift")
    assert drifting.amplitude == pytest.approx(0.02, rel=0.01)


def seen_at(simulator: Simulator, model: ScanModel, line: LineOfSight) -> Maps:
    """The sky at the directions of another scan, in the pixels of the simulator's own."""
    known, observe = simulator.site.pointed(""), tod.sky_signal(simulator.sky, 32, PEAR, 1e-8, 1)
    maps = []
    for half in (0, 1):
        grid = MapGrid(16, "ecliptic", (half / 2, (half + 1) / 2))
        both = tod.samples(known.model, known.line, grid), tod.samples(model, line, grid)
        stream = (replace(there, pixel=here.pixel) for here, there in zip(*both, strict=True))
        mean, hits = tod.bin_samples(observe(stream), 16)
        maps.append(np.where(hits > 0, mean, healpy.UNSEEN))
    return maps


@pytest.mark.slow
def test_an_effect_beside_a_time_shift_is_that_of_late_samples():
    """Otherwise a shift of the beam's size and an offset across it are better explained by one offset of the two."""
    simulator = Simulator(small(), 0)
    known = simulator.site.pointed("")
    tilted = replace(known.line, boresight_angle_deg=known.line.boresight_angle_deg + 1.0)
    side_b = seen_at(simulator, known.model.ahead(601.0 * 0.003), tilted)
    pair = with_shown_sky(pairs.given(simulator(), side_b, simulator.run).pairs[0])
    [offset] = [one for one in effects_of(pair, simulator.run) if one.name == "pointing_offset"]
    problem = Problem(pair, (), 0.0)
    members = ((TimeShift(), np.array([0.003])), (offset, np.array([0.0, -60.0])))
    exact = problem._measured(Set(members, problem.left(members)))
    assert exact.left < 1e-6
    assert problem._measured(Set(members[:1], 1.0)).left > 0.01


@pytest.mark.slow
def test_both_ways_to_mirror_coordinates_are_tried_beside_others():
    """Mirrored pixels explain nearly as much as a mirrored sky until the reversed precession is added."""
    simulator = Simulator(small("planck", period_s=301.0))
    found = mcsim.compare(
        simulator(), simulator(sky=np.conj(simulator.sky), turning={"precession_period_s": -1.0}), simulator.run
    )
    assert sorted(names(found)) == ["frame_reversed", "precession_sign"]
    assert found.channels[0].left < 1e-4


@pytest.mark.parametrize(("name", "amplitude"), [("lmax_cut", 22.0), ("mmax_cut", 0.0), ("pixel_centres", -1.0)])
def test_the_model_may_describe_the_other_side(name, amplitude, simulator, side_a):
    found = mcsim.compare(CASES[name][0](simulator, side_a), side_a, simulator.run)
    assert names(found) == [name]
    assert found.channels[0].differences[0].amplitude == amplitude
    assert found.to_dict()["model_describes"] == {"W1": "b"}
    assert found.channels[0].left < 0.01
    assert "the model describes side B" in str(found)


def test_time_stamps_a_whole_sample_off_are_named_however_far_that_is():
    simulator = Simulator(small())
    pointing = simulator.site.pointed("")
    side_b = seen_at(simulator, pointing.model.ahead(601.0), pointing.line)
    found = mcsim.compare(simulator(), side_b, simulator.run)
    assert names(found) == ["time_shift"]
    assert found.channels[0].differences[0].amplitude == 1.0
