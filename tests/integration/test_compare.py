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
from mcsim.comparison.result import ComparisonResult
from mcsim.ensemble.maps import write_map
from mcsim.instrument.scan.geometry import MapGrid
from mcsim.simulation import simulate, tod
from mcsim.simulation.survey import survey
from mcsim.sphere.rotation import rotate_alm
from refusals import refused

NSIDE, LMAX = 32, 64
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
                "kind": "elliptical_gaussian", "fwhm_major_arcmin": 200.0, "fwhm_minor_arcmin": 160.0,
                "angle_deg": 20.0, "m_max": 4,
            },
            "scan": {"kind": "hit_averaged", "model": "wmap", "line_of_sight": "A", "sample_period_s": 61.0},
        }
    ],
    "ensemble": {"seed": 3},
}  # fmt: skip

Maps = list[NDArray[np.float64]]


class Simulator:
    """Another simulator of the same survey: every sample by totalconvolve, every argument free."""

    def __init__(self) -> None:
        self.run = config.load(MODEL)
        whole = survey(self.run)
        self.site = whole.channels[0].site
        self.sky = simulate.draw_sky(whole, 0)

    def __call__(
        self,
        sky: NDArray[np.complex128] | None = None,
        beam: mcsim.Beam | None = None,
        psi: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
        centred: bool = False,
        spin: int = 1,
    ) -> Maps:
        pointing = self.site.pointed("")
        model = replace(pointing.model, spin_period_s=spin * pointing.model.spin_period_s)
        observe = tod.sky_signal(self.sky if sky is None else sky, LMAX, beam or self.site.beam, 1e-8, 1)

        def pointed(half: int) -> Iterator[tod.Samples]:
            for chunk in tod.samples(model, pointing.line, MapGrid(NSIDE, "ecliptic", (half / 2, (half + 1) / 2))):
                theta, phi = healpy.pix2ang(NSIDE, chunk.pixel) if centred else (chunk.theta, chunk.phi)
                yield replace(chunk, theta=theta, phi=phi, psi=chunk.psi if psi is None else psi(chunk.psi))

        binned = [tod.bin_samples(observe(pointed(half)), NSIDE) for half in (0, 1)]
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
    "spin_sign": (lambda s, a: s(spin=-1), 1.0),
    "frame_rotated": (lambda s, a: s(sky=rotate_alm(s.sky, LMAX, "galactic", "ecliptic")), 110.5),
    "lmax_cut": (lambda s, a: s(sky=healpy.almxfl(s.sky, np.arange(LMAX + 1) <= 45)), 45.0),
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


def test_files_are_compared_from_the_command_line(tmp_path, simulator, side_a):
    sides = {"a": side_a, "b": scaled(side_a, 1.01)}
    for side, maps in sides.items():
        (tmp_path / side).mkdir()
        for split, map_ in zip(("half1", "half2"), maps, strict=True):
            write_map(tmp_path / side / f"W1_{split}.fits", map_, "ecliptic")
    a, b, out = (str(tmp_path / name) for name in ("a", "b", "out"))
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
    assert CliRunner().invoke(app, ["compare", a, b, "-o", out, "--fail-above", "1e-4"]).exit_code == 1


@pytest.mark.parametrize(
    ("a", "b", "model"),
    [([np.zeros(12)], [np.ones(12)], None), ([np.zeros(12)] * 2, [np.ones(12)] * 2, MODEL), ("nowhere", "x", None)],
)
def test_what_cannot_be_compared_is_refused(a, b, model):
    with pytest.raises(mcsim.InputError):
        mcsim.compare(a, b, model)


def test_prepared_models_are_refused(side_a):
    with refused("[[preparation]]"):
        mcsim.compare(side_a, side_a, MODEL | {"preparation": [{"kind": "subtract_dipole"}]})
