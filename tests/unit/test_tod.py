"""Pointing, signal and binning of the sample-by-sample route, each against an independent evaluation."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import ducc0
import healpy
import numpy as np
import pytest

from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import ScanModel
from mcsim.instrument.scan.geometry import MapGrid
from mcsim.instrument.scan.model import LineOfSight
from mcsim.instrument.scan.pointing import pointing
from mcsim.simulation import tod
from mcsim.sphere import alm as alm_
from mcsim.sphere.sky import dipole_alm, gaussian_alm
from refusals import refused

LINE = LineOfSight("A", 70.5, 12.0)
MODEL = ScanModel("toy", 129.3, -3600.0, 22.5, 31557600.0, 11.0, 10.0, (LINE,), ("A",))
NSIDE, LMAX = 16, 40
GRID = MapGrid(NSIDE)


@pytest.fixture(scope="module")
def sky() -> np.ndarray:
    return gaussian_alm(100.0 / (1.0 + np.arange(LMAX + 1)) ** 2, np.random.default_rng(1))


@pytest.fixture(scope="module")
def beam() -> Beam:
    """Every order up to 3, complex, none small."""
    rng = np.random.default_rng(2)
    ell = np.arange(LMAX + 1)
    blm = np.zeros((4, LMAX + 1), complex)
    for m in range(4):
        phase = np.exp(2j * np.pi * rng.random(LMAX + 1)) if m else 1.0
        blm[m] = np.where(
            ell >= m, np.sqrt((2 * ell + 1) / (4 * np.pi)) * np.exp(-((ell / 30.0) ** 2)) / (1 + m) * phase, 0
        )
    return Beam(blm)


def whole(stream: Iterable[tod.Samples]) -> tod.Samples:
    """All chunks of a stream as one."""
    parts = list(stream)
    fields = ("time_s", "theta", "phi", "psi", "pixel", "signal_uk")
    return tod.Samples(*(np.concatenate([getattr(part, name) for part in parts]) for name in fields))


def test_samples_are_the_pointing_of_the_model(monkeypatch):
    monkeypatch.setattr(tod, "CHUNK", 7001)
    count = MODEL.samples(LINE)
    stream = whole(tod.samples(MODEL, LINE, MapGrid(NSIDE, "galactic")))
    theta, phi, psi = pointing(MODEL, LINE, 0, count, "galactic")
    np.testing.assert_allclose(stream.theta, theta, atol=1e-11)
    np.testing.assert_allclose(np.exp(1j * stream.phi), np.exp(1j * phi), atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * stream.psi), np.exp(1j * psi), atol=1e-9)
    np.testing.assert_array_equal(stream.pixel, healpy.ang2pix(NSIDE, theta, phi))
    np.testing.assert_allclose(stream.time_s, 11.0 * np.arange(count))
    assert not stream.signal_uk.any()


def test_parts_of_the_survey_follow_each_other():
    everything = whole(tod.samples(MODEL, LINE, GRID))
    halves = [whole(tod.samples(MODEL, LINE, replace(GRID, time_range=part))) for part in ((0.0, 0.37), (0.37, 1.0))]
    for name in ("time_s", "theta", "pixel"):
        joined = np.concatenate([getattr(half, name) for half in halves])
        np.testing.assert_allclose(joined, getattr(everything, name), rtol=1e-10)


def test_at_pixel_centres_only_the_direction_changes():
    free = whole(tod.samples(MODEL, LINE, GRID))
    moved = whole(tod.samples(MODEL, LINE, GRID, at_pixel_centres=True))
    np.testing.assert_array_equal(moved.psi, free.psi)
    np.testing.assert_array_equal(moved.pixel, free.pixel)
    theta, phi = healpy.pix2ang(NSIDE, free.pixel)
    np.testing.assert_array_equal(moved.theta, theta)
    np.testing.assert_array_equal(moved.phi, phi)


def test_without_angles_times_and_pixels_are_the_same():
    whole_, bare = (whole(tod.samples(MODEL, LINE, GRID, angles=angles)) for angles in (True, False))
    np.testing.assert_array_equal(bare.time_s, whole_.time_s)
    np.testing.assert_array_equal(bare.pixel, whole_.pixel)
    assert bare.theta.size == bare.phi.size == bare.psi.size == 0


def test_signal_is_the_integral_of_sky_times_turned_beam(sky, beam):
    """The beam turned to (phi, theta, psi) by its Euler angles, then integrated against the sky."""
    stream = next(iter(tod.samples(MODEL, LINE, GRID)))
    few = replace(stream, **{name: getattr(stream, name)[:2000:157] for name in vars(stream)})
    found = next(tod.sky_signal(sky, LMAX, beam)([few])).signal_uk
    full = np.zeros(alm_.size(LMAX), complex)
    for m in range(beam.mmax + 1):
        full[alm_.start(LMAX, m) + m : alm_.start(LMAX, m) + LMAX + 1] = beam.blm[m, m:]
    weight = np.where(np.arange(full.size) <= LMAX, 1.0, 2.0)
    for k in range(few.theta.size):
        turned = ducc0.sht.rotate_alm(full, LMAX, few.psi[k], few.theta[k], few.phi[k])
        expected = np.sum(weight * (sky * turned.conj()).real)
        # The interpolation is asked for 1e-10 of a signal of rms 14 uK.
        assert found[k] == pytest.approx(expected, abs=1e-8)


def test_dipole_is_seen_through_the_beam():
    vector = np.array([1200.0, -2500.0, 1900.0])
    beam = Beam.gaussian(900.0, 8)
    stream = next(iter(tod.samples(MODEL, LINE, GRID)))
    found = next(tod.sky_signal(dipole_alm(vector, 8), 8, beam)([stream])).signal_uk
    expected = beam.window[1] * healpy.ang2vec(stream.theta, stream.phi) @ vector
    assert beam.window[1] < 0.99
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_map_is_the_mean_of_the_samples(sky, beam):
    stages = [tod.sky_signal(sky, LMAX, beam)]
    stream = whole(tod.through(tod.samples(MODEL, LINE, MapGrid(32)), stages))
    found, hits = tod.observe(MODEL, LINE, MapGrid(32), stages)
    expected = np.full(12 * 32**2, healpy.UNSEEN)
    for pixel in np.unique(stream.pixel):
        expected[pixel] = stream.signal_uk[stream.pixel == pixel].mean()
    np.testing.assert_array_equal(hits, np.bincount(stream.pixel, minlength=hits.size))
    assert 0 < np.count_nonzero(hits == 0) < hits.size
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_noise_is_white_and_does_not_depend_on_chunks(sky, beam, monkeypatch):
    signal = tod.sky_signal(sky, LMAX, beam)

    def with_noise() -> np.ndarray:
        return tod.observe(MODEL, LINE, GRID, [signal, tod.white_noise(50.0, np.random.default_rng(4))])[0]

    clean, hits = tod.observe(MODEL, LINE, GRID, [signal])
    noisy = with_noise()
    seen = hits > 0
    scaled = (noisy - clean)[seen] * np.sqrt(hits[seen]) / 50.0
    # The mean square of n standard normal numbers has the standard deviation sqrt(2/n).
    assert abs(np.mean(scaled**2) - 1.0) < 4.0 * np.sqrt(2.0 / seen.sum())
    monkeypatch.setattr(tod, "CHUNK", 1000)
    again = with_noise()
    # Chunks begin the phases of the pointing anew, to 1e-11 rad.
    np.testing.assert_allclose(again[seen], noisy[seen], atol=1e-6)


def test_threads_do_not_change_a_bit(sky, beam):
    one, two = (tod.observe(MODEL, LINE, GRID, [tod.sky_signal(sky, LMAX, beam, nthreads=n)])[0] for n in (1, 2))
    np.testing.assert_array_equal(one, two)


def test_stages_act_where_they_are_put(sky, beam, monkeypatch):
    """A turn of the true beam changes what is seen, not where it is binned; a filter may remember the chunk before."""
    monkeypatch.setattr(tod, "CHUNK", 5000)

    def turn(stream: Iterable[tod.Samples]) -> Iterator[tod.Samples]:
        for chunk in stream:
            yield replace(chunk, psi=chunk.psi + 0.3)

    def lag(stream: Iterable[tod.Samples]) -> Iterator[tod.Samples]:
        before = 0.0
        for chunk in stream:
            yield replace(chunk, signal_uk=np.concatenate([[before], chunk.signal_uk[:-1]]))
            before = chunk.signal_uk[-1]

    turned = Beam(beam.blm * np.exp(-0.3j * np.arange(4))[:, None])
    expected = whole(tod.through(tod.samples(MODEL, LINE, GRID), [tod.sky_signal(sky, LMAX, turned)]))
    found, hits = tod.observe(MODEL, LINE, GRID, [turn, tod.sky_signal(sky, LMAX, beam), lag])
    shifted = np.concatenate([[0.0], expected.signal_uk[:-1]])
    total = np.bincount(expected.pixel, weights=shifted, minlength=hits.size)
    np.testing.assert_allclose(found[hits > 0] * hits[hits > 0], total[hits > 0], atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"time_range": (0.5, 0.5)}, ("time_range", "(0.5, 0.5)")),
        ({"time_range": (0.0, 1e-9)}, ("time_range", "(0, 1e-09)")),
        ({"nside": 12}, ("nside", 12)),
        ({"frame": "solar"}, ("frame", "solar")),
    ],
)
def test_bad_grids_are_named(changes, named):
    with refused(*named):
        tod.observe(MODEL, LINE, MapGrid(**({"nside": NSIDE} | changes)), [])


@pytest.mark.parametrize("spin_period_s", [10.0, -10.0])
def test_rings_follow_each_other_in_time_whichever_way_the_survey_spins(spin_period_s):
    time_s = np.arange(60.0)
    for index in range(3):
        assert np.array_equal(tod.on_rings(time_s, spin_period_s, 3, index), time_s // 10 % 3 == index)


@pytest.mark.parametrize(
    ("changes", "named"),
    [({"lmax": 30}, ("lmax", 30, "(861,)", "(496,)")), ({"beam": Beam.gaussian(900.0, 20)}, ("l = 20", "lmax", 40))],
)
def test_skies_and_beams_that_do_not_fit_are_named(changes, named, sky, beam):
    with refused(*named):
        tod.sky_signal(**({"alm": sky, "lmax": LMAX, "beam": beam} | changes))


def test_dipole_needs_its_degree():
    with refused("lmax", 0):
        dipole_alm([0.0, 0.0, 1.0], 0)
