"""Comparisons of two simulations: maps made sample by sample, with differences put in by hand."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace

import healpy
import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

import mcsim
from mcsim import config
from mcsim.cli import app
from mcsim.comparison import pairs, scene
from mcsim.comparison.pairs import with_known_offsets
from mcsim.comparison.prediction import Prediction, Set
from mcsim.comparison.result import ComparisonResult
from mcsim.comparison.scene_differences import PsiSign
from mcsim.comparison.shown_sky import with_shown_sky
from mcsim.ensemble.maps import write_map
from mcsim.instrument.scan import MapGrid, write_moments_fits
from mcsim.simulation import simulate, tod
from mcsim.simulation.survey import survey
from mcsim.sphere.rotation import rotate_alm
from pictures import quick_pictures
from refusals import refused

NSIDE, LMAX = 16, 32
MODEL = {
    "schema": 1,
    "name": "pair",
    "sky": {"spectrum": "wmap7", "lmax": LMAX},
    "map": {"nside": NSIDE, "splits": ["half1", "half2"]},
    "channel": [
        {
            "name": "W1",
            "frequency_ghz": 94.0,
            "beam": {
                "kind": "elliptical_gaussian", "fwhm_major_arcmin": 400.0, "fwhm_minor_arcmin": 320.0,
                "angle_deg": 20.0, "m_max": 4,
            },
            "scan": {"kind": "hit_averaged", "model": "wmap", "line_of_sight": "A", "sample_period_s": 361.0},
        }
    ],
    "ensemble": {"seed": 3},
}  # fmt: skip

Maps = list[NDArray[np.float64]]


class Simulator:
    """Another simulator of the same survey: every sample by totalconvolve, every argument free."""

    def __init__(self, model: dict = MODEL, channel: int = 0) -> None:
        self.run = config.load(model)
        whole = survey(self.run)
        self.site = whole.making.channels[channel].site
        self.sky = simulate.draw_sky(whole, 0)
        self.halves = len(self.run.map.splits)

    def __call__(
        self,
        sky: NDArray[np.complex128] | None = None,
        beam: mcsim.Beam | None = None,
        psi: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
        centred: bool = False,
        turning: dict[str, float] | None = None,
        added: Callable[[tod.Samples], NDArray[np.float64]] | None = None,
    ) -> Maps:
        pointing, nside = self.site.pointed(""), self.site.nside
        periods = {key: sign * getattr(pointing.model, key) for key, sign in (turning or {}).items()}
        model = replace(pointing.model, **periods)
        observe = tod.sky_signal(self.sky if sky is None else sky, self.site.lmax, beam or self.site.beam, 1e-8, 1)

        def pointed(half: int) -> Iterator[tod.Samples]:
            share = (half / self.halves, (half + 1) / self.halves)
            for chunk in tod.samples(model, pointing.line, MapGrid(nside, "ecliptic", share)):
                theta, phi = healpy.pix2ang(nside, chunk.pixel) if centred else (chunk.theta, chunk.phi)
                extra = chunk.signal_uk if added is None else added(chunk)
                turned = chunk.psi if psi is None else psi(chunk.psi)
                yield replace(chunk, theta=theta, phi=phi, psi=turned, signal_uk=extra)

        binned = [tod.bin_samples(observe(pointed(half)), nside) for half in range(self.halves)]
        return [np.where(hits > 0, mean, healpy.UNSEEN) for mean, hits in binned]


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator()


@pytest.fixture(scope="module")
def side_a(simulator: Simulator) -> Maps:
    return simulator()


def names(found: ComparisonResult) -> list[str]:
    return [d.name for channel in found.channels for d in channel.differences]


CASES: dict[str, tuple[Callable[[Simulator, Maps], Maps], float]] = {
    "psi_offset": (lambda s, a: s(psi=lambda p: p + np.deg2rad(30.0)), 30.0),
    "psi_sign": (lambda s, a: s(psi=lambda p: -p), 1.0),
    "mmax_cut": (lambda s, a: s(beam=s.site.beam.truncated(0)), 0.0),
    "pixel_centres": (lambda s, a: s(centred=True), 1.0),
    "spin_sign": (lambda s, a: s(turning={"spin_period_s": -1.0}), 1.0),
    "frame_rotated": (lambda s, a: s(sky=rotate_alm(s.sky, LMAX, "galactic", "ecliptic")), 110.5),
    "lmax_cut": (lambda s, a: s(sky=healpy.almxfl(s.sky, np.arange(LMAX + 1) <= 22)), 22.0),
    "pixel_window": (lambda s, a: s(sky=healpy.almxfl(s.sky, mcsim_window())), 1.0),
    "beam_window": (lambda s, a: s(sky=healpy.almxfl(s.sky, s.site.beam.window)), 1.0),
    "calibration": (lambda s, a: scaled(a, 1.002), 0.002),
    "unit": (lambda s, a: scaled(a, 1e-3), 1e-3),
    "monopole": (lambda s, a: [np.where(m > -1e20, m + 2.0, m) for m in a], 2.0),
    "ordering": (lambda s, a: [healpy.reorder(m, r2n=True) for m in a], 1.0),
    "split_exchanged": (lambda s, a: a[::-1], 1.0),
}


def mcsim_window() -> NDArray[np.float64]:
    from mcsim.sphere.healpix import pixel_window

    return pixel_window(NSIDE, LMAX)


def scaled(maps: Maps, factor: float) -> Maps:
    return [np.where(m > -1e20, factor * m, m) for m in maps]


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


def test_a_turn_of_a_degree_is_not_taken_for_a_turn_of_half_a_circle_more(simulator, side_a):
    found = mcsim.compare(side_a, simulator(psi=lambda p: p + np.deg2rad(1.0)), simulator.run)
    (channel,) = found.channels
    assert channel.differences[0].name == "psi_offset"
    assert channel.differences[0].amplitude == pytest.approx(1.0, rel=1e-3)


def test_time_stamps_of_half_a_sample_are_named():
    beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 660.0, "fwhm_minor_arcmin": 540.0}
    scan = {"kind": "hit_averaged", "model": "litebird", "sample_period_s": 31.0}
    channel = {"name": "T", "beam": beam, "scan": scan}
    run = config.load(MODEL | {"sky": {"spectrum": "wmap7", "lmax": 30}, "map": {"nside": 16}, "channel": [channel]})
    whole = survey(run)
    pointing, sky = whole.channels[0].site.pointed(""), simulate.draw_sky(whole, 0)
    observe = tod.sky_signal(sky, 30, whole.channels[0].site.beam, 1e-8, 1)
    model = pointing.model
    later = replace(
        model,
        spin_phase_deg=180.0 * 31.0 / model.spin_period_s,
        precession_phase_deg=180.0 * 31.0 / model.precession_period_s,
        orbit_phase_deg=180.0 * 31.0 / model.orbit_period_s,
    )

    def made(seen: mcsim.ScanModel) -> NDArray[np.float64]:
        both = (tod.samples(m, pointing.line, MapGrid(16, "ecliptic")) for m in (model, seen))
        stream = (replace(there, pixel=here.pixel) for here, there in zip(*both, strict=True))
        return tod.bin_samples(observe(stream), 16)[0]

    found = mcsim.compare([made(model)], [made(later)], run)
    assert names(found) == ["time_shift"]
    assert found.channels[0].differences[0].amplitude == pytest.approx(0.5, rel=0.01)


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


def test_zeros_that_stand_for_holes_hide_nothing(simulator, side_a):
    hole = np.abs(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2]) < 0.3
    filled = [[np.where(hole, 0.0, m) for m in side] for side in (side_a, CASES["pixel_window"][0](simulator, side_a))]
    assert names(mcsim.compare(*filled, simulator.run)) == ["pixel_window"]


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


def test_maps_at_the_centres_of_pixels_are_recognised(simulator):
    """Maps of a pipeline without a scan: one through the pixel window, one without it."""
    run = replace(simulator.run, map=replace(simulator.run.map, splits=()))
    smooth = healpy.almxfl(simulator.sky, simulator.site.beam.window)
    without = healpy.alm2map(smooth, NSIDE, lmax=LMAX)
    found = mcsim.compare([healpy.alm2map(healpy.almxfl(smooth, mcsim_window()), NSIDE, lmax=LMAX)], [without], run)
    assert names(found) == ["pixel_window"]
    assert found.channels[0].differences[0].amplitude == -1.0
    assert found.channels[0].left < 1e-4


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
    with quick_pictures():
        assert CliRunner().invoke(app, ["compare", a, b, "-o", out, "--fail-above", "1e-4"]).exit_code == 1


@pytest.mark.parametrize(
    ("a", "b", "model"),
    [([np.zeros(12)], [np.ones(12)], None), ([np.zeros(12)] * 2, [np.ones(12)] * 2, MODEL), ("nowhere", "x", None)],
)
def test_what_cannot_be_compared_is_refused(a, b, model):
    with pytest.raises(mcsim.InputError):
        mcsim.compare(a, b, model)


SMALL = MODEL | {"sky": {"spectrum": "wmap7", "lmax": 32}, "map": {"nside": 16, "splits": ["half1", "half2"]}}
PEAR = mcsim.Beam.elliptical(400.0, 320.0, 20.0, 32, mmax=3)
PEAR.blm[1] += 0.2 * np.exp(0.7j) * PEAR.blm[0] * (np.arange(33) / 32) ** 3
PEAR.blm[3, 3:] += 0.1 * np.exp(-0.4j) * PEAR.blm[0, 3:] * (np.arange(3, 33) / 32) ** 3


def small(model: str = "wmap", beam: mcsim.Beam = PEAR, period_s: float = 361.0, **more: object) -> dict:
    """Return a run of nside 16 with a beam of odd orders."""
    line = {"line_of_sight": "A"} if model == "wmap" else {}
    scan = {"kind": "hit_averaged", "model": model, "sample_period_s": period_s} | line
    return SMALL | {"channel": [{"name": "W1", "frequency_ghz": 94.0, "beam": beam, "scan": scan}]} | more


def test_a_run_is_simulated_sample_by_sample_where_the_other_side_is(tmp_path):
    """Samples spread over their pixels: the moments of the default simulation miss a few per cent of the sky."""
    simulator = Simulator(small("litebird", mcsim.Beam.gaussian(380.0, 32)))
    for split, map_ in zip(("half1", "half2"), simulator(), strict=True):
        write_map(tmp_path / f"W1_{split}.fits", map_.astype(np.float32), "ecliptic")
    model = tmp_path / "run.toml"
    model.write_text(
        'schema = 1\nname = "pair"\nsky = { spectrum = "wmap7", lmax = 32 }\nensemble = { seed = 3 }\n'
        'map = { nside = 16, splits = ["half1", "half2"] }\n'
        '[[channel]]\nname = "W1"\nbeam = { kind = "gaussian", fwhm_arcmin = 380.0 }\n'
        'scan = { kind = "hit_averaged", model = "litebird", sample_period_s = 361.0 }\n'
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


ODD: dict[str, Callable[[Simulator], Maps]] = {
    "beam_conjugated": lambda s: s(beam=replace(s.site.beam, blm=s.site.beam.blm.conj())),
    "psi_sign": lambda s: s(psi=lambda p: -p),
    "precession_sign": lambda s: s(turning={"precession_period_s": -1.0}),
    "mmax_cut": lambda s: s(beam=s.site.beam.truncated(2)),
}


@pytest.fixture(scope="module")
def odd() -> Simulator:
    return Simulator(small("litebird"))


@pytest.fixture(scope="module")
def odd_side_a(odd: Simulator) -> Maps:
    return odd()


@pytest.mark.parametrize("name", ODD)
def test_a_beam_of_odd_orders_is_no_obstacle(name, odd, odd_side_a):
    found = mcsim.compare(odd_side_a, ODD[name](odd), odd.run)
    assert names(found) == [name]


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
    simulator = Simulator(small("litebird", period_s=181.0, preparation=steps, map=SMALL["map"] | {"nside": 32}))
    whole = survey(simulator.run)

    def prepared(maps: Maps) -> Maps:
        return [m.preparation.apply(made) for m, made in zip(whole.making.channels[0].maps, maps, strict=True)]

    side_a = prepared(simulator())
    assert names(mcsim.compare(side_a, prepared(simulator(psi=lambda p: p + 1.0)), simulator.run)) == ["psi_offset"]
    assert mcsim.compare(side_a, side_a, simulator.run).verdict == "identical"


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
    found = mcsim.compare(side_a, [*side_a[:2], clean[2] + noise[0], clean[3] + noise[1]], one.run)
    assert [(d.name, d.channel) for c in found.channels for d in c.differences] == [("noise_shared", "W2")]
    assert found.channels[1].differences[0].amplitude == pytest.approx(1.0, abs=0.02)


def test_stripes_of_a_binned_map_are_those_that_a_destriper_takes_off():
    simulator = Simulator(small())
    draw = np.random.default_rng(4)
    drift = np.cumsum(draw.standard_normal(2000))
    drift -= drift.mean()

    def offsets(chunk: tod.Samples) -> NDArray[np.float64]:
        return drift[(chunk.time_s / (256 * 361.0)).astype(int)]

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


def test_a_reversed_spin_keeps_the_turn_of_the_instrument(odd):
    """Moments of the other scan are turned as those of the model are, in whichever order the two are found."""
    found = mcsim.compare(odd(), odd(turning={"spin_period_s": -1.0}, psi=lambda p: p + 0.8), odd.run)
    (channel,) = found.channels
    assert sorted(names(found)) == ["psi_offset", "spin_sign"]
    assert channel.left < 1e-4
    turned = next(d for d in channel.differences if d.name == "psi_offset")
    assert turned.amplitude == pytest.approx(np.rad2deg(0.8), abs=0.02)


def test_an_effect_through_another_sky_is_measured_there():
    """A gain that drifts over the year, and a sky that was smoothed already: the drift acts on the smoother sky."""
    simulator = Simulator(small())
    whole = survey(simulator.run)
    observe = tod.sky_signal(healpy.almxfl(simulator.sky, PEAR.window), 32, PEAR, 1e-8, 1)
    year_s = simulator.site.pointed("").model.orbit_period_s

    def drift(chunk: tod.Samples) -> NDArray[np.float64]:
        [seen] = observe([replace(chunk, signal_uk=0.0 * chunk.psi)])
        return 0.02 * np.sin(2.0 * np.pi * chunk.time_s / year_s) * seen.signal_uk

    smooth = simulator(sky=healpy.almxfl(simulator.sky, PEAR.window), added=drift)
    found = mcsim.compare(simulator(), smooth, whole.config)
    assert sorted(names(found)) == ["beam_window", "gain_drift"]
    drifting = next(d for d in found.channels[0].differences if d.name == "gain_drift")
    assert drifting.amplitude == pytest.approx(0.02, rel=0.01)


def test_noise_in_common_hides_no_more_than_is_expected_of_it():
    simulator = Simulator(small())
    draw = np.random.default_rng(6)
    hits = [m.moments.hits for m in survey(simulator.run).making.channels[0].maps]
    noise = [60.0 * draw.standard_normal(h.size) / np.sqrt(np.maximum(h, 1.0)) for h in hits]
    a, b = ([m + n for m, n in zip(made, noise, strict=True)] for made in (simulator(), ODD["psi_sign"](simulator)))
    found = mcsim.compare(a, b, simulator.run)
    assert names(found) == ["psi_sign"]
    given = pairs.given(a, b, simulator.run)
    problem = Prediction(with_shown_sky(given.pairs[0]), (), 0.0)
    alone = problem.corrected(Set(((PsiSign(), np.ones(1)),), 1.0))
    assert 0.02 < alone.left < 0.5
    assert problem.hidden(alone) == pytest.approx(alone.left, rel=0.3)


@pytest.mark.parametrize("name", ["lmax_cut", "mmax_cut"])
def test_the_model_may_describe_the_other_side(name, simulator, side_a):
    found = mcsim.compare(CASES[name][0](simulator, side_a), side_a, simulator.run)
    assert names(found) == [name]
    assert found.channels[0].differences[0].amplitude == CASES[name][1]
    assert found.to_dict()["model_describes"] == {"W1": "b"}
    assert found.channels[0].left < 0.01
    assert "the model describes side B" in str(found)


def test_time_stamps_a_whole_sample_off_are_named_however_far_that_is():
    simulator = Simulator(small())
    pointing = simulator.site.pointed("")
    ahead = scene.ahead(pointing.model, 361.0)
    observe = tod.sky_signal(simulator.sky, 32, PEAR, 1e-8, 1)

    def late(half: int) -> NDArray[np.float64]:
        grid = MapGrid(16, "ecliptic", (half / 2, (half + 1) / 2))
        both = (tod.samples(model, pointing.line, grid) for model in (pointing.model, ahead))
        stream = (replace(there, pixel=here.pixel) for here, there in zip(*both, strict=True))
        mean, hits = tod.bin_samples(observe(stream), 16)
        return np.where(hits > 0, mean, healpy.UNSEEN)

    found = mcsim.compare(simulator(), [late(0), late(1)], simulator.run)
    assert names(found) == ["time_shift"]
    assert found.channels[0].differences[0].amplitude == 1.0
