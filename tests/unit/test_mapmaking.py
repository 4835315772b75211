"""Pairs, right-hand sides and solutions of differencing, against explicit matrices and known skies."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import healpy
import numpy as np
import pytest

from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import ScanModel
from mcsim.instrument.scan.geometry import MapGrid
from mcsim.instrument.scan.model import LineOfSight
from mcsim.instrument.scan.pointing import pointing
from mcsim.simulation import convolve, mapmaking, tod
from mcsim.simulation.mapmaking import pairs
from mcsim.simulation.mapmaking.rhs import noise_by_chunk
from mcsim.simulation.mapmaking.solve import apply_normal
from mcsim.sphere.sky import dipole_alm, gaussian_alm
from refusals import refused

# Two sides that are no mirror images, and rates that see the whole sky at nside 32 in 400,000 samples.
SIDES = (LineOfSight("A", 70.5, 2.0), LineOfSight("B", 68.0, 177.0))
MODEL = ScanModel(
    "toy", 129.3, -3600.0, 22.5, 31557600.0, 78.9, 365.25, SIDES, ("A",), {"D": ("A", "B"), "R": ("B", "A")}
)
NSIDE, LMAX = 4, 24
GRID = MapGrid(NSIDE, time_range=(0.0, 0.05))
SHORT = MapGrid(4, time_range=(0.0, 0.01))
EXACT = mapmaking.StoppingRule(1e-12)


@pytest.fixture(scope="module")
def scan() -> mapmaking.DifferencingScan:
    return mapmaking.prepare(MODEL, "D", GRID)


@pytest.fixture(scope="module")
def fine_scan() -> mapmaking.DifferencingScan:
    return mapmaking.prepare(MODEL, "D", MapGrid(32), nthreads=2)


@pytest.fixture(scope="module")
def sky() -> np.ndarray:
    return gaussian_alm(100.0 / (1.0 + np.arange(LMAX + 1)) ** 2, np.random.default_rng(1))


@pytest.fixture(scope="module")
def beams() -> tuple[Beam, Beam]:
    """Different widths, axes and numbers of orders on the two sides."""
    right = Beam.elliptical(600.0, 500.0, angle_deg=-50.0, lmax=LMAX, mmax=2)
    return Beam.elliptical(700.0, 500.0, angle_deg=20.0, lmax=LMAX, mmax=4), right


def pointing_matrix(scan: mapmaking.DifferencingScan, x: float) -> np.ndarray:
    """P, dense, from the pointing of the model and healpy's pixels."""
    first, last = scan.grid.sample_range(MODEL, SIDES[0])
    matrix = np.zeros((last - first, scan.npix))
    for line, weight in zip((scan.side_a, scan.side_b), (1.0 + x, x - 1.0), strict=True):
        theta, phi, _ = pointing(MODEL, line, first, last - first, scan.grid.frame)
        matrix[np.arange(last - first), healpy.ang2pix(scan.grid.nside, theta, phi)] = weight
    return matrix


def normal_matrix(scan: mapmaking.DifferencingScan, x: float) -> np.ndarray:
    """N as the solver applies it, column by column."""
    with ThreadPoolExecutor(1) as pool:
        return np.stack([apply_normal(scan, x, column, pool) for column in np.eye(scan.npix)], axis=1)


def signals(sky: np.ndarray, beams: tuple[Beam, Beam]) -> tuple[list[tod.Stage], list[tod.Stage]]:
    return [tod.sky_signal(sky, LMAX, beams[0])], [tod.sky_signal(sky, LMAX, beams[1])]


def noise(sigma0_uk: float, seed: int) -> mapmaking.DifferenceNoise:
    return mapmaking.DifferenceNoise(sigma0_uk, np.random.default_rng(seed))


def true_rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("x", [0.0, 0.03])
def test_pairs_are_the_normal_matrix(scan, x):
    matrix = pointing_matrix(scan, x)
    np.testing.assert_allclose(normal_matrix(scan, x), matrix.T @ matrix, atol=1e-9)
    np.testing.assert_allclose(mapmaking.diagonal(scan, x), np.sum(matrix**2, axis=0), atol=1e-9)
    np.testing.assert_array_equal(scan.hits_a + scan.hits_b, np.count_nonzero(matrix, axis=0))
    assert scan.samples == len(matrix) == scan.hits_a.sum()


def test_partners_are_merged_and_in_order(scan):
    assert scan.count.sum() == 2 * scan.samples
    assert scan.partner.size < scan.count.sum()
    rows = np.repeat(np.arange(scan.npix), np.diff(scan.row_start))
    key = rows.astype(np.int64) * scan.npix + scan.partner
    assert np.all(np.diff(key) > 0)


def test_a_pixel_may_be_its_own_partner():
    """Sides 30 degrees apart in pixels of 58 degrees."""
    near = replace(MODEL, lines_of_sight=(SIDES[0], LineOfSight("B", 60.0, 30.0)))
    scan = mapmaking.prepare(near, "D", replace(SHORT, nside=1))
    matrix = np.zeros((scan.samples, 12))
    for line, weight in zip(near.lines_of_sight, (1.2, -0.8), strict=True):
        theta, phi, _ = pointing(near, line, 0, scan.samples)
        matrix[np.arange(scan.samples), healpy.ang2pix(1, theta, phi)] += weight
    assert np.any(np.isclose(matrix, 0.4))
    np.testing.assert_allclose(normal_matrix(scan, 0.2), matrix.T @ matrix, atol=1e-9)


def test_bands_and_threads_do_not_change_the_pairs(scan, cache, monkeypatch):
    monkeypatch.setattr(pairs, "_BAND", 5_000)
    other = mapmaking.prepare(MODEL, "D", GRID, nthreads=2)
    for name in ("hits_a", "hits_b", "row_start", "partner", "count"):
        np.testing.assert_array_equal(getattr(other, name), getattr(scan, name))
        assert getattr(other, name).dtype == getattr(scan, name).dtype


def test_pairs_are_computed_once(cache, monkeypatch):
    fractions = []
    first = mapmaking.prepare(MODEL, "D", SHORT, progress=fractions.append)
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert [path.name.split("-")[0] for path in cache.iterdir()] == ["pairs"]
    with monkeypatch.context() as patch:
        patch.delattr(pairs, "_write")
        again = mapmaking.prepare(MODEL, "D", SHORT)
    np.testing.assert_array_equal(again.partner, first.partner)
    assert isinstance(again.partner, np.memmap)
    # Another imbalance needs no other pairs; exchanged sides, frames and parts do.
    mapmaking.prepare(MODEL, "R", SHORT)
    mapmaking.prepare(MODEL, "D", replace(SHORT, frame="galactic"))
    mapmaking.prepare(MODEL, "D", replace(SHORT, time_range=(0.01, 0.02)))
    assert len(list(cache.iterdir())) == 4


def test_damaged_pairs_are_made_again(cache):
    first = np.array(mapmaking.prepare(MODEL, "D", SHORT).partner)
    next(cache.glob("*/partner.raw")).write_bytes(b"")
    np.testing.assert_array_equal(mapmaking.prepare(MODEL, "D", SHORT).partner, first)


@pytest.mark.parametrize("x", [0.0, 0.02])
def test_known_sky_is_recovered(x, fine_scan):
    """Equal circular beams, no noise, samples at pixel centres: the map is the smoothed sky."""
    lmax = 64
    sky = gaussian_alm(1000.0 / (1.0 + np.arange(lmax + 1)) ** 2, np.random.default_rng(2))
    sky = sky + dipole_alm([1200.0, -2500.0, 1900.0], lmax)
    side = mapmaking.side_maps(sky, convolve.response(Beam.gaussian(180.0, lmax), lmax), 32)
    assert side.shape == (fine_scan.npix, 1)
    rhs = mapmaking.rhs_from_maps(fine_scan, [(side, side)], mapmaking.Imbalance(x))
    found, report = mapmaking.solve(fine_scan, rhs[0], x, EXACT)
    expected = side[:, 0] - (side[:, 0].mean() if x == 0.0 else 0.0)
    assert report.converged
    assert report.relative_residual < 1e-11
    # The residual counts the monopole by 2 x^2 only.
    assert true_rms(found - expected) < (1e-10 if x == 0.0 else 1e-8) * true_rms(expected)


def test_imbalance_taken_for_zero_leaves_the_dipole(fine_scan):
    """A wrong x is a signal of x (T_A + T_B): the dipole's part of it is not small."""
    sky = dipole_alm([0.0, 0.0, 3300.0], 8)
    side = mapmaking.side_maps(sky, convolve.response(Beam.gaussian(180.0, 8), 8), 32)
    errors = []
    for fiducial in (0.01, 0.0):
        rhs = mapmaking.rhs_from_maps(fine_scan, [(side, side)], mapmaking.Imbalance(0.01, fiducial))
        found, _ = mapmaking.solve(fine_scan, rhs[0], fiducial, EXACT)
        errors.append(true_rms(found - side[:, 0]))
    assert errors[0] < 1e-5
    # x (T_A + T_B) is up to 22 uK in the differences; the year averages most of it away.
    assert 0.2 < errors[1] < 22.0


def test_map_is_the_least_squares_solution(scan):
    """Noise alone, against a dense solver."""
    rng = np.random.default_rng(3)
    for x in (0.0, 0.05):
        matrix = pointing_matrix(scan, x)
        data = rng.standard_normal(len(matrix))
        expected = np.linalg.lstsq(matrix, data, rcond=1e-10)[0]
        found, report = mapmaking.solve(scan, matrix.T @ data, x, EXACT)
        seen = mapmaking.diagonal(scan, x) > 0
        assert report.converged
        shift = expected[seen].mean() if x == 0.0 else 0.0
        np.testing.assert_allclose(found[seen], expected[seen] - shift, atol=1e-8)


def test_right_hand_side_is_the_sum_over_samples(scan, sky, beams):
    """Orientation of every sample from the model's pointing; beams by their maps S_s."""
    x, fiducial = 0.04, 0.01
    sides = [mapmaking.side_maps(sky, convolve.response(beam, LMAX), NSIDE) for beam in beams]
    assert [side.shape[1] for side in sides] == [9, 5]
    difference = 0.0
    for line, maps, gain in zip(SIDES, sides, (1.0 + x, x - 1.0), strict=True):
        theta, phi, psi = pointing(MODEL, line, 0, scan.samples)
        pixel = healpy.ang2pix(NSIDE, theta, phi)
        orders = [
            maps[pixel, 2 * s - 1] * np.cos(s * psi) + maps[pixel, 2 * s] * np.sin(s * psi)
            for s in range(1, maps.shape[1] // 2 + 1)
        ]
        difference = difference + gain * (maps[pixel, 0] + sum(orders))
    expected = pointing_matrix(scan, fiducial).T @ difference
    found = mapmaking.rhs_from_maps(scan, [tuple(sides)], mapmaking.Imbalance(x, fiducial))
    np.testing.assert_allclose(found[0], expected, atol=1e-9 * np.abs(expected).max())


def test_maps_of_sides_are_the_time_ordered_reference_at_pixel_centres(scan, sky, beams, rhs_from_samples, monkeypatch):
    monkeypatch.setattr(tod, "CHUNK", 3000)
    sides = tuple(mapmaking.side_maps(sky, convolve.response(beam, LMAX), NSIDE) for beam in beams)
    imbalance = mapmaking.Imbalance(0.04, 0.01)
    fast = mapmaking.rhs_from_maps(scan, [sides], imbalance, noise(3.0, 5))[0]
    slow = rhs_from_samples(scan, signals(sky, beams), imbalance, noise(3.0, 5), at_pixel_centres=True)
    np.testing.assert_allclose(fast, slow, atol=1e-9 * np.abs(slow).max())


@pytest.mark.parametrize("side", [0, 1])
def test_stages_belong_to_their_side(side, scan, sky, beams, rhs_from_samples):
    """A gain of 1.5 on one side is a beam 1.5 times as strong there."""

    def louder(stream):
        for chunk in stream:
            yield replace(chunk, signal_uk=1.5 * chunk.signal_uk)

    stages = signals(sky, beams)
    stages[side].append(louder)
    found = rhs_from_samples(scan, stages)
    scaled = tuple(Beam((1.5 if k == side else 1.0) * beam.blm) for k, beam in enumerate(beams))
    expected = rhs_from_samples(scan, signals(sky, scaled))
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())


def test_skies_together_are_skies_alone(scan, sky, beams):
    first = tuple(mapmaking.side_maps(sky, convolve.response(beam, LMAX), NSIDE) for beam in beams)
    control = tuple(side[:, :1] for side in first)
    together = mapmaking.rhs_from_maps(scan, [first, control], noise=noise(3.0, 6))
    for row, sides in zip(together, (first, control), strict=True):
        alone = mapmaking.rhs_from_maps(scan, [sides], noise=noise(3.0, 6))[0]
        np.testing.assert_allclose(row, alone, atol=1e-12 * np.abs(alone).max())


def test_noise_has_the_normal_matrix_as_covariance(scan):
    """b' N^+ b / sigma^2 is chi-square with as many degrees of freedom as N has rank."""
    nothing = (np.zeros((scan.npix, 1)), np.zeros((scan.npix, 1)))
    rhs = mapmaking.rhs_from_maps(scan, [nothing], noise=noise(7.0, 7))[0]
    normal = normal_matrix(scan, 0.0)
    rank = np.linalg.matrix_rank(normal, hermitian=True)
    assert rank == np.count_nonzero(scan.hits_a + scan.hits_b) - 1
    chi_square = rhs @ np.linalg.pinv(normal, hermitian=True) @ rhs / 7.0**2
    assert abs(chi_square - rank) < 4.0 * np.sqrt(2.0 * rank)


def test_a_difference_has_the_mean_of_the_variances_of_its_pixels(scan):
    """With factors of 0 and 4 by turns: noise of both pixels would be none where one of them has none."""
    factor = np.where(np.arange(scan.npix) % 3 == 0, 4.0, 0.0)
    nothing = (np.zeros((scan.npix, 1)), np.zeros((scan.npix, 1)))
    found = mapmaking.rhs_from_maps(scan, [nothing], noise=replace(noise(7.0, 7), factor=factor))[0]
    pieces = tod.chunks(*scan.grid.sample_range(MODEL, SIDES[0]))
    draw, matrix = noise_by_chunk(noise(7.0, 7), pieces), pointing_matrix(scan, 0.0)
    each = np.sqrt(0.5 * np.abs(matrix) @ factor) * np.concatenate([draw(*one) for one in pieces])
    np.testing.assert_allclose(found, each @ matrix, rtol=0, atol=1e-9 * np.abs(found).max())


def test_threads_do_not_change_a_bit(scan, sky, beams, monkeypatch):
    monkeypatch.setattr(tod, "CHUNK", 900)
    sides = tuple(mapmaking.side_maps(sky, convolve.response(beam, LMAX), NSIDE) for beam in beams)
    results = []
    for nthreads in (1, 2, 3):
        rhs = mapmaking.rhs_from_maps(scan, [sides], mapmaking.Imbalance(0.01), noise(2.0, 8), nthreads)[0]
        results.append((rhs, mapmaking.solve(scan, rhs, 0.01, nthreads=nthreads)[0]))
    for rhs, solution in results[1:]:
        np.testing.assert_array_equal(rhs, results[0][0])
        np.testing.assert_array_equal(solution, results[0][1])


def test_solution_can_be_stopped_and_continued(fine_scan):
    rng = np.random.default_rng(9)
    side = rng.standard_normal((fine_scan.npix, 1))
    rhs = mapmaking.rhs_from_maps(fine_scan, [(side, side)])[0]
    stopped = [mapmaking.solve(fine_scan, rhs, rule=mapmaking.StoppingRule(1e-8, n)) for n in (1, 2, 3, 4)]
    report = stopped[-1][1]
    assert not report.converged
    assert report.iterations == len(report.history) == 4
    assert [each.history for _, each in stopped] == [report.history[:n] for n in (1, 2, 3, 4)]
    assert report.relative_residual == pytest.approx(report.history[-1], rel=1e-9)
    errors = [true_rms(found - side[:, 0] + side.mean()) for found, _ in stopped]
    assert errors == sorted(errors, reverse=True)
    finished, report = mapmaking.solve(fine_scan, rhs)
    # A relative residual of ten per cent and more is left after 4 iterations; 1e-8 needs about three for each ten.
    assert 15 < report.iterations < 40
    _, again = mapmaking.solve(fine_scan, rhs, start=finished)
    assert (again.iterations, again.converged) == (0, True)
    assert again.relative_residual < 1e-8


def test_nothing_observed_gives_nothing(scan):
    found, report = mapmaking.solve(scan, np.zeros(scan.npix))
    seen = scan.hits_a + scan.hits_b > 0
    assert not found[seen].any()
    assert report == mapmaking.MapmakingReport(0, True, 0.0, ())


def test_unseen_pixels_say_so():
    scan = mapmaking.prepare(MODEL, "D", MapGrid(32, time_range=(0.0, 0.02)))
    side = np.random.default_rng(10).standard_normal((scan.npix, 1))
    found, _ = mapmaking.solve(
        scan, mapmaking.rhs_from_maps(scan, [(side, side)])[0], rule=mapmaking.StoppingRule(1e-6)
    )
    seen = scan.hits_a + scan.hits_b > 0
    assert 0.1 < seen.mean() < 0.9
    assert np.all(found[~seen] == healpy.UNSEEN)
    assert np.all(np.abs(found[seen]) < 100.0)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"x": 1.0}, ("imbalance", 1)),
        ({"rhs": np.zeros(5)}, ("(5,)", "(192,)")),
        ({"rhs": np.full(192, np.nan)}, ("right-hand", "finite")),
        ({"start": np.zeros(5)}, ("map", "(5,)", "(192,)")),
    ],
)
def test_bad_input_to_the_solver_is_named(changes, named, scan):
    with refused(*named):
        mapmaking.solve(**({"scan": scan, "rhs": np.zeros(scan.npix)} | changes))


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: mapmaking.Imbalance(-1.5), ("imbalance", -1.5)),
        (lambda: mapmaking.Imbalance(0.0, 2.0), ("imbalance", 2)),
        (lambda: noise(-1.0, 1), ("noise", "-1 uK")),
        (lambda: noise(np.nan, 1), ("noise", "nan uK")),
        (lambda: mapmaking.StoppingRule(tol=0.0), ("tol", 0)),
        (lambda: mapmaking.StoppingRule(max_iterations=-1), ("max_iterations", -1)),
        (lambda: MapGrid(3), ("nside", 3)),
        (lambda: MapGrid(4, "solar"), ("frame", "solar")),
        (lambda: MapGrid(4, time_range=(0.3, 0.1)), ("time_range", "(0.3, 0.1)")),
    ],
)
def test_bad_settings_are_named(make, named):
    with refused(*named):
        make()


def test_maps_of_another_nside_are_refused(scan):
    with refused(12, 192):
        mapmaking.rhs_from_maps(scan, [(np.zeros((12, 1)), np.zeros((192, 1)))])


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"pair": "X"}, ("'X'", "D, R")),
        ({"grid": MapGrid(4, time_range=(0.0, 1e-9))}, ("time_range", "(0, 1e-09)")),
        (
            {"model": replace(MODEL, lines_of_sight=(SIDES[0], replace(SIDES[1], sample_period_s=50.0)))},
            ("78.9 s", "50 s", "sample_period_s"),
        ),
    ],
)
def test_bad_input_to_the_pairs_is_named(changes, named):
    with refused(*named):
        mapmaking.prepare(**({"model": MODEL, "pair": "D", "grid": SHORT} | changes))


def test_cache_that_cannot_be_written_is_named(monkeypatch):
    monkeypatch.setenv("MCSIM_CACHE", "/dev/null/pairs")
    with refused("/dev/null/pairs", "MCSIM_CACHE"):
        mapmaking.prepare(MODEL, "D", SHORT)
