"""The default route against the time-ordered reference: what pixel window and centroid offsets explain."""

from dataclasses import replace

import healpy
import numpy as np
import pytest

from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import Moments, ScanModel
from mcsim.instrument.scan.geometry import MapGrid
from mcsim.simulation import convolve, mapmaking, tod
from mcsim.simulation.observe import observe
from mcsim.sphere import healpix
from mcsim.sphere.sky import gaussian_alm
from mcsim.sphere.spectra import load

NSIDE, LMAX = 64, 192
# Half a year, a sample every 8 seconds: 35 in the median pixel.
MODEL = ScanModel.load("wmap").with_sampling(8.0)
LINE = MODEL.line_of_sight("A")
HALF = MapGrid(NSIDE, time_range=(0.0, 0.5))


@pytest.fixture(scope="module")
def sky() -> np.ndarray:
    return gaussian_alm(load("wmap7", LMAX), np.random.default_rng(1))


@pytest.fixture(scope="module")
def beam() -> Beam:
    return Beam.elliptical(88.0 * 1.15**0.5, 88.0 / 1.15**0.5, angle_deg=20.0, lmax=LMAX)


@pytest.fixture(scope="module")
def moments(beam: Beam) -> Moments:
    return Moments.from_model(MODEL, NSIDE, beam.mmax, time_range=HALF.time_range)


def default_route(sky: np.ndarray, beam: Beam, moments: Moments, window: np.ndarray | None) -> tuple[np.ndarray, ...]:
    """Map without centroid term, the non-circular part of it, and the centroid term."""
    response = convolve.response(beam, LMAX, window)
    effect = convolve.noncircular_map(convolve.spin_maps(sky, response, NSIDE), moments)
    gradient = healpix.gradient(convolve.circular_alm(sky, response), NSIDE, LMAX)
    return convolve.circular_map(sky, response, NSIDE) + effect, effect, convolve.centroid_map(gradient, moments)


def test_samples_at_pixel_centres_give_the_same_map(sky, beam, moments):
    found, hits = tod.observe(MODEL, LINE, HALF, [tod.sky_signal(sky, LMAX, beam)], at_pixel_centres=True)
    expected, effect, _ = default_route(sky, beam, moments, None)
    np.testing.assert_array_equal(hits, moments.hits)
    seen = hits > 0
    assert seen.mean() > 0.99
    assert np.std(effect) > 0.01 * np.std(expected)
    assert np.abs(found - expected)[seen].max() < 1e-9 * np.std(expected)


def test_window_and_centroid_explain_what_pixels_do(sky, beam, moments):
    """Each term enters with amplitude 1, and little is left.

    Both are leading terms of the spread of samples in a pixel: the next ones are smaller by (l x pixel size)^2 ~ 0.02
    to 0.1 at l = 50 to 100, where this beam leaves power, and by 1 / sqrt(hits) for the scatter of the second moments.
    """
    found, hits = tod.observe(MODEL, LINE, HALF, [tod.sky_signal(sky, LMAX, beam, 1e-7)])
    seen = hits > 0
    bare, effect, _ = default_route(sky, beam, moments, None)
    windowed, _, centroid = default_route(sky, beam, moments, healpix.pixel_window(NSIDE, LMAX))
    missing, terms = (found - bare)[seen], np.stack([(windowed - bare)[seen], centroid[seen]], axis=1)
    amplitudes = np.linalg.lstsq(terms, missing, rcond=None)[0]
    np.testing.assert_allclose(amplitudes, 1.0, atol=0.06)
    left = missing - terms.sum(axis=1)
    print(
        f"sky {np.std(found[seen]):.2f}, effect {np.std(effect[seen]):.3f}; left: {np.std(missing):.3f}, with the "
        f"window {np.std(missing - terms[:, 0]):.3f}, with both {np.std(left):.3f} uK"
    )
    assert np.std(missing - terms[:, 0]) < 0.7 * np.std(missing)
    assert np.std(left) < 0.6 * np.std(missing - terms[:, 0])
    assert np.std(left) < 0.025 * np.std(found[seen])


def test_powers_of_the_offsets_explain_what_is_left(sky, beam):
    """Each power of the offsets leaves less of a circular beam's map; of the whole beam's, less than its shape makes.

    The correlation of offsets with orientations, which no power contains, is some tenths of the effect of the shape.
    """
    moments = Moments.on_grid(MODEL.with_lines_of_sight("A"), replace(HALF, offset_order=4), beam.mmax)
    seen, left = moments.hits > 0, {}
    for name, seen_through in (("circular", beam.truncated(0)), ("whole", beam)):
        found, _ = tod.observe(MODEL, LINE, HALF, [tod.sky_signal(sky, LMAX, seen_through, 1e-7)])
        made = [observe(sky, seen_through, moments.up_to_offsets(order)) for order in (1, 2, 3, 4)]
        left[name] = [np.std((found - one)[seen]) for one in made]
    effect = np.std(default_route(sky, beam, moments, None)[1][seen])
    print(f"effect {effect:.3f} uK; left with powers up to 1, 2, 3, 4: {left}")
    for before, after, share in zip(left["circular"], left["circular"][1:], (0.25, 0.7, 0.4), strict=False):
        assert after < share * before
    assert left["whole"][3] < 0.3 * effect


def test_differencing_at_true_pointing_differs_by_what_pixels_do(sky, beam, rhs_from_samples):
    """Two-beam map from interpolated samples against the one from spin maps, with and without the pixel window."""
    scan = mapmaking.prepare(MODEL, "WMAP", HALF)
    rule, stages = mapmaking.StoppingRule(1e-6), [tod.sky_signal(sky, LMAX, beam, 1e-7)]
    solutions = [mapmaking.solve(scan, rhs_from_samples(scan, (stages, stages)), rule=rule)[0]]
    for window in (None, healpix.pixel_window(NSIDE, LMAX)):
        side = mapmaking.side_maps(sky, convolve.response(beam, LMAX, window), NSIDE)
        solutions.append(mapmaking.solve(scan, mapmaking.rhs_from_maps(scan, [(side, side)])[0], rule=rule)[0])
    seen = solutions[0] != healpy.UNSEEN
    reference, bare, windowed = (solution[seen] for solution in solutions)
    print(f"left: {np.std(reference - bare):.3f}, with the window {np.std(reference - windowed):.3f} uK")
    assert np.std(reference - windowed) < 0.7 * np.std(reference - bare)
    assert np.std(reference - windowed) < 0.05 * np.std(reference)
