"""Samples off their pixels' centres: against the sky at their own places."""

from dataclasses import dataclass, replace

import ducc0
import healpy
import numpy as np
import pytest
from astropy.io import fits

import mcsim
from mcsim import config
from mcsim.ensemble import plan
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import MapGrid, Moments, ScanModel, read_moments, write_moments_fits
from mcsim.instrument.scan.offsets import exponents
from mcsim.instrument.scan.pointing import pointing
from mcsim.simulation import sampled, simulate, windows
from mcsim.simulation.offsets import Expansion, expansion, offset_maps, transforms
from mcsim.simulation.survey import survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.sky import dipole_alm, gaussian_alm
from mcsim.systematics import Effect, Site, catalogue
from refusals import refused

NSIDE, LMAX, SAMPLES = 8, 16, 5
NPIX = 12 * NSIDE**2


@pytest.fixture(scope="module")
def sky() -> np.ndarray:
    return gaussian_alm(np.ones(LMAX + 1), np.random.default_rng(1))


def tangent(nside: int) -> tuple[np.ndarray, ...]:
    """Centre, e_theta and e_phi of every pixel, shape (npix, 3)."""
    theta, phi = healpy.pix2ang(nside, np.arange(12 * nside**2))
    south = np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)], axis=1)
    east = np.stack([-np.sin(phi), np.cos(phi), 0.0 * phi], axis=1)
    return np.stack(healpy.pix2vec(nside, np.arange(len(theta))), axis=1), south, east


def scattered(shrunk: float) -> tuple[np.ndarray, ...]:
    """Theta, phi, psi of samples anywhere in all pixels, the poles' too, and their offsets shrunk by a factor."""
    rng = np.random.default_rng(2)
    vectors = rng.standard_normal((400 * NPIX, 3))
    vectors /= np.linalg.norm(vectors, axis=1)[:, None]
    pixel = healpy.vec2pix(NSIDE, *vectors.T)
    order = np.argsort(pixel, kind="stable")
    starts = np.searchsorted(pixel[order], np.arange(NPIX))
    chosen = (starts[:, None] + np.arange(SAMPLES)).ravel()
    vectors, pixel = vectors[order][chosen], pixel[order][chosen]
    np.testing.assert_array_equal(pixel, np.repeat(np.arange(NPIX), SAMPLES))
    centre, south, east = (each[pixel] for each in tangent(NSIDE))
    u = shrunk * np.sum(vectors * south, axis=1), shrunk * np.sum(vectors * east, axis=1)
    moved = np.sqrt(1.0 - u[0] ** 2 - u[1] ** 2)[:, None] * centre + u[0][:, None] * south + u[1][:, None] * east
    theta = np.arctan2(np.hypot(moved[:, 0], moved[:, 1]), moved[:, 2])
    return theta, np.arctan2(moved[:, 1], moved[:, 0]) % (2 * np.pi), rng.uniform(0, 6, pixel.size)


def moments_of(samples: tuple[np.ndarray, ...], order: int, tmp_path) -> Moments:
    np.save(tmp_path / "samples.npy", np.stack(samples, axis=1))
    return Moments.from_pointing_files(tmp_path / "samples.npy", NSIDE, 1, offset_order=order)


def at_places(alm: np.ndarray, theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """The sky at any directions, by ducc0's own interpolation-free sums over a grid of nonuniform points."""
    places = np.stack([theta, phi], axis=1)
    return ducc0.sht.synthesis_general(alm=alm[None], loc=places, spin=0, lmax=LMAX, epsilon=1e-13)[0]


@pytest.mark.parametrize("order", [2, 3, 4])
def test_error_falls_with_the_next_power_of_the_offsets(sky, order, tmp_path) -> None:
    """The largest error over all pixels, the poles' included."""
    r, weight = healpix.distances_from_centres(NSIDE)
    left = []
    for shrunk in (0.5, 0.25, 0.125):
        theta, phi, psi = scattered(shrunk)
        truth = at_places(sky, theta, phi).reshape(NPIX, SAMPLES).mean(axis=1)
        terms = Expansion(shrunk * r, weight, LMAX, order)
        smooth = healpix.synthesis(alm_.multiply(sky, terms.smooth, LMAX)[None], NSIDE, LMAX)[0]
        made = smooth + offset_maps(sky, terms, [moments_of((theta, phi, psi), order, tmp_path)])[0]
        left.append(np.abs(made - truth).max() / np.std(truth))
    falls = np.log2(np.divide(left[:-1], left[1:]))
    assert np.all(np.abs(falls - (order + 1)) < 0.3)


@pytest.mark.parametrize("lmax", [2, 3])
def test_a_sky_of_fewer_degrees_than_powers_is_one_of_more(lmax, sky, tmp_path) -> None:
    own, moments = alm_.resize(sky, LMAX, lmax), moments_of(scattered(1.0), 4, tmp_path)
    [found] = offset_maps(own, expansion(NSIDE, lmax, 4), [moments])
    [expected] = offset_maps(alm_.resize(own, lmax, LMAX), expansion(NSIDE, LMAX, 4), [moments])
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.std(expected))


def test_samples_at_the_centres_need_nothing(sky) -> None:
    terms = expansion(NSIDE, LMAX, 4, spread=0.0)
    np.testing.assert_allclose(terms.smooth, 1.0, rtol=1e-12)
    assert not any(window.any() for window in terms.windows.values())


def test_first_and_second_derivatives_are_healpys(sky) -> None:
    """One sample a pixel at a small offset: d . grad and half of d d Hessian, from healpy's first derivatives."""
    south, east = 1e-4 * np.random.default_rng(3).standard_normal((2, NPIX))
    powers = np.stack([south**2, south * east, east**2])
    moments = Moments(NSIDE, "ecliptic", np.ones(NPIX), np.zeros((1, NPIX), complex), south, east, powers)
    terms = Expansion(np.linspace(0.0, 3e-4, 50), np.full(50, 0.02), LMAX, 2)
    smooth = healpix.synthesis(alm_.multiply(sky, terms.smooth - 1.0, LMAX)[None], NSIDE, LMAX)[0]
    made = offset_maps(sky, terms, [moments])[0] + smooth
    _, down, across = healpy.alm2map_der1(sky, NSIDE, lmax=LMAX)
    first = south * down + east * across
    assert np.abs(made - first).max() < 1e-2 * np.abs(first).max()
    size, step = np.hypot(south, east), 1e-3
    centre, e_south, e_east = tangent(NSIDE)
    along = (south[:, None] * e_south + east[:, None] * e_east) / size[:, None]
    on_circle = [at_places(sky, *healpy.vec2ang(np.cos(t) * centre + np.sin(t) * along)) for t in (-step, 0.0, step)]
    second = 0.5 * (size / step) ** 2 * (on_circle[0] - 2.0 * on_circle[1] + on_circle[2])
    assert np.abs(made - first - second).max() < 1e-3 * np.abs(second).max()


def brute_force(samples: np.ndarray, a: int, b: int) -> np.ndarray:
    """<dtheta^a dphi^b> by explicit tangent vectors and numpy's sums."""
    theta, phi, _ = samples
    pixel = healpy.ang2pix(NSIDE, theta, phi)
    _, south, east = (each[pixel] for each in tangent(NSIDE))
    vector = healpy.ang2vec(theta, phi)
    powers = np.sum(vector * south, axis=1) ** a * np.sum(vector * east, axis=1) ** b
    return np.bincount(pixel, powers, NPIX) / np.maximum(np.bincount(pixel, minlength=NPIX), 1)


MODEL = ScanModel.load("wmap").with_sampling(300.0).with_lines_of_sight("A")
GRID = MapGrid(NSIDE, "galactic", (0.0, 0.5), offset_order=4)


@pytest.fixture(scope="module")
def streamed() -> Moments:
    return Moments.on_grid(MODEL, GRID, 2, nthreads=2)


def test_streamed_powers_against_brute_force(streamed) -> None:
    line = MODEL.line_of_sight("A")
    samples = np.array(pointing(MODEL, line, 0, GRID.sample_range(MODEL, line)[1], "galactic"))
    for row, (a, b) in zip(streamed.offset_moments, exponents(4), strict=True):
        expected = brute_force(samples, a, b)
        assert np.abs(row - expected).max() < 1e-9 * np.abs(expected).max()
    q = streamed.spin_of_offsets(4, 2)
    a, b = streamed.offset_moments[7:][[0, 4]], streamed.offset_moments[7:][[1, 3]]
    np.testing.assert_allclose(q, a[0] - a[1] + 2j * (b[0] + b[1]), atol=1e-18)


def test_all_else_is_the_same_bit_for_bit(streamed) -> None:
    plain = Moments.from_model(MODEL, NSIDE, 2, "galactic", (0.0, 0.5))
    for name in ("hits", "w", "dtheta", "dphi"):
        np.testing.assert_array_equal(getattr(streamed, name), getattr(plain, name))
    lower = Moments.on_grid(MODEL, replace(GRID, offset_order=2), 2)
    np.testing.assert_array_equal(lower.offset_moments, streamed.up_to_offsets(2).offset_moments)
    assert (plain.offset_order, lower.offset_order, streamed.offset_order) == (1, 2, 4)
    assert streamed.up_to_offsets(0).offset_order == 0


def test_files_keep_the_powers(streamed, tmp_path) -> None:
    path = tmp_path / "moments.fits"
    write_moments_fits(path, streamed)
    streamed.save(tmp_path / "folder")
    table = streamed.as_table(tmp_path)
    for back in (read_moments(path), Moments.load(tmp_path / "folder"), read_moments(tmp_path / table["path"])):
        np.testing.assert_array_equal(back.offset_moments, streamed.offset_moments)
    with fits.open(path) as hdus:
        units = {column.name: column.unit for column in hdus[1].columns}
    assert (units["OFFSET_1_1"], units["OFFSET_0_4"]) == ("rad2", "rad4")


@pytest.mark.parametrize("unit", ["deg2", "deg**2", "deg^(2)"])
def test_powers_in_other_units(streamed, tmp_path, unit) -> None:
    path = tmp_path / "moments.fits"
    write_moments_fits(path, streamed.up_to_offsets(2))
    with fits.open(path, mode="update") as hdus:
        table = hdus[1]
        number = table.columns.names.index("OFFSET_1_1") + 1
        table.data["OFFSET_1_1"] = table.data["OFFSET_1_1"] * np.rad2deg(1.0) ** 2
    fits.setval(path, f"TUNIT{number}", value=unit, ext=1)
    back = read_moments(path).offset_moments
    np.testing.assert_allclose(back[1], streamed.offset_moments[1], rtol=1e-12)


def test_incomplete_powers_are_refused(streamed, tmp_path) -> None:
    path = tmp_path / "moments.fits"
    write_moments_fits(path, streamed)
    with fits.open(path, mode="update") as hdus:
        hdus[1].columns["OFFSET_2_1"].name = "OTHER"
    with refused("moments.fits", "OFFSET_2_1"):
        read_moments(path)
    with refused("offset_moments", "dtheta"):
        replace(streamed, dtheta=None, dphi=None)
    with refused("offset_moments", "(12, 768)", "(5, 768)"):
        replace(streamed, offset_moments=streamed.offset_moments[:5])
    with refused("offset_order", "5"):
        MapGrid(NSIDE, offset_order=5)
    with refused("order 4", "5"):
        streamed.spin_of_offsets(5, 1)


def table(moments: Moments | ScanModel, beam: Beam, sky: np.ndarray, **map_keys: object) -> dict:
    channel = {"name": "W1", "beam": beam, "scan": moments}
    return {
        "name": "test", "sky": {"alm": sky, "lmax": LMAX}, "map": {"nside": NSIDE, "frame": "galactic", **map_keys},
        "channel": [channel], "biposh": {"lmax": LMAX},
    }  # fmt: skip


@pytest.fixture(scope="module")
def beam() -> Beam:
    return Beam.elliptical(900.0, 600.0, angle_deg=30.0, lmax=LMAX, mmax=2)


def test_a_run_takes_the_powers_it_asks_for(sky, beam, streamed) -> None:
    for order in (0, 1, 2, 4):
        run = config.load(table(streamed, beam, sky, offset_order=order))
        own = streamed.up_to_offsets(order)
        expected = mcsim.observe(sky, beam, own, pixel_window=True)
        np.testing.assert_array_equal(simulate.maps(survey(run), 0)[0], expected)
    plain = config.load(table(streamed, beam, sky))
    np.testing.assert_array_equal(simulate.maps(survey(plain), 0)[0], mcsim.observe(sky, beam, own.up_to_offsets(1)))
    one, two = (config.load(table(streamed, beam, sky, offset_order=order)) for order in (1, 2))
    assert config.digest(one) == config.digest(plain) != config.digest(two)


@pytest.mark.parametrize(("nside", "wide", "apart"), [(64, 32, 2.0), (32, 64, 0.5)])
def test_samples_farther_from_the_centres_have_the_window_of_larger_pixels(nside, wide, apart) -> None:
    """Of pixels of another resolution, which have other shapes; as a power of their window it is 30 times as far."""
    own, other = (healpix.pixel_window(one, 160) for one in (nside, wide))
    assert np.abs(windows.stretched(own, nside, apart) - other).max() < 1.5e-3
    assert np.abs(own ** (apart * apart) - other).max() > 0.02
    for same, spread in ((own, 1.0), (own, -1.0), (np.ones(161), apart)):
        assert np.array_equal(windows.stretched(same, nside, spread), same)
    np.testing.assert_allclose(windows.stretched(own, nside, 0.0), 1.0, atol=1e-6)
    # The last degree is that of a longer table too: farther out it looks for one of (apart - 1) / 2 degrees more.
    np.testing.assert_allclose(windows.stretched(own[:97], nside, apart)[-1], windows.stretched(own, nside, apart)[96])


def test_spread_to_nothing_is_a_survey_of_centres(sky, beam, streamed) -> None:
    """The effect "pixelization" at 1 moves samples to the centres, whatever powers count."""
    run = table(streamed, beam, sky, offset_order=3)
    run["effect"] = [{"name": "pixelization", "channel": "W1", "amplitude": 1.0}]
    found = simulate.maps(survey(config.load(run)), 0)[0]
    expected = mcsim.observe(sky, beam, streamed.up_to_offsets(0), pixel_window=False)
    np.testing.assert_allclose(found, expected, atol=1e-10 * np.std(expected))


def test_the_control_has_the_powers_too(sky, streamed) -> None:
    """A circular beam: map and control are the same; the control's a_lm are the map's."""
    run = config.load(table(streamed, Beam.gaussian(600.0, LMAX), sky, offset_order=4))
    spectra = simulate.realize(survey(run), 0)
    np.testing.assert_allclose(spectra["cl"], spectra["cl_circular"], rtol=1e-12)
    kept = replace(run, ensemble=replace(run.ensemble, keep_maps=True))
    both = simulate.realize(survey(kept), 0)
    np.testing.assert_array_equal(both["cl"], spectra["cl"])


@dataclass(frozen=True, kw_only=True)
class Constant(Effect):
    """A relative error of the gain of all samples, by the time of each."""

    name, scope, unit, step = "constant", "channel", "fraction", 1e-3
    cause = signature = "A test."

    def gain(self, time_s: np.ndarray, site: Site) -> np.ndarray:
        return np.full(time_s.shape, self.amplitude)


IN_A = ({"splits": ["a", "b"], "split_by": "rings"}, {"name": "split_calibration", "split": "a"}, (0.01, 0.0))
BY_TIME = ({}, {"name": "constant"}, (0.01,))


@pytest.mark.parametrize(("splits", "effect", "factors"), [IN_A, BY_TIME], ids=["split", "time"])
@pytest.mark.parametrize("order", [1, 2, 4])
def test_an_error_of_the_gain_scales_all_that_offsets_do(splits, effect, factors, order, sky, beam) -> None:
    """Of the sky and its dipole; beyond the first order it knew their mean alone, and lacked 0.9 % of the effect."""
    own = effect | {"channel": "W1", "amplitude": 0.01}
    run = table(MODEL, beam, sky, offset_order=order, **splits)
    run["sky"] |= {"dipole_uk": 2.0}
    library = {**catalogue(), Constant.name: Constant}
    made, acting = (survey(config.load(run | {"effect": effects}), library=library) for effects in ([], [own]))
    dipole = dipole_alm(made.channels[0].site.dipole_uk, LMAX)
    change = np.subtract(simulate.maps(acting, 0), simulate.maps(made, 0))
    whole = simulate.maps(made, 0, sky=sky + dipole)
    for found, seen, factor in zip(change, whole, factors, strict=True):
        np.testing.assert_allclose(found, factor * seen, atol=1e-9 * np.std(seen))


@pytest.mark.parametrize("order", [1, 2, 4])
def test_an_error_of_the_gain_scales_what_samples_see_that_are_nearer_to_the_centres(order, sky, beam) -> None:
    run, library = table(MODEL, beam, sky, offset_order=order), {**catalogue(), Constant.name: Constant}
    nearer = {"name": "pixelization", "channel": "W1", "amplitude": 0.5}
    gain = {"name": "constant", "channel": "W1", "amplitude": 0.01}
    before, after = (
        simulate.maps(survey(config.load(run | {"effect": effects}), library=library), 0)[0]
        for effects in ([nearer], [nearer, gain])
    )
    np.testing.assert_allclose(after - before, 0.01 * before, atol=1e-9 * np.std(before))


@dataclass(frozen=True, kw_only=True)
class Wave(Constant):
    """A gain that changes along the scan within a pixel."""

    name = "wave"

    def gain(self, time_s: np.ndarray, site: Site) -> np.ndarray:
        return self.amplitude * np.sin(2.0 * np.pi * time_s / 7.0)


def test_a_gain_that_changes_inside_a_pixel_counts_to_first_order_at_any_order_of_the_offsets(sky) -> None:
    """Against single samples."""
    left = {}
    for order in (1, 4):
        run = table(MODEL, Beam.gaussian(900.0, lmax=LMAX), sky, offset_order=order)
        wave, library = {"name": "wave", "channel": "W1", "amplitude": 0.01}, {**catalogue(), Wave.name: Wave}
        made, acting = (survey(config.load(run | {"effect": own}), library=library) for own in ([], [wave]))
        change = simulate.maps(acting, 0)[0] - simulate.maps(made, 0)[0]
        true = sampled.maps(acting, 0)[0][1] - sampled.maps(made, 0)[0][1]
        left[order] = np.std(change - true) / np.std(true)
    assert left[1] < 0.2
    assert left[4] < 1.05 * left[1]


@dataclass(frozen=True, kw_only=True)
class Round(Constant):
    """A true beam that lacks all orders of the fiducial one but m = 0."""

    name = "round"

    def beam(self, beam: Beam, site: Site) -> Beam:
        return beam.circular()

    def gain(self, time_s: np.ndarray, site: Site) -> None:
        return None


def test_a_dipole_is_taken_off_through_orders_that_the_true_beam_lacks() -> None:
    """Through the fiducial beam, which a dipole shows at m = 1; against single samples."""
    blm = Beam.gaussian(900.0, lmax=LMAX).blm * np.array([[1.0], [0.3]])
    blm[1, 0] = 0.0
    run = table(MODEL, Beam(blm), np.zeros(alm_.size(LMAX), dtype=complex))
    run["sky"] |= {"dipole_uk": 3000.0}
    run["effect"] = [{"name": "round", "channel": "W1", "amplitude": 1.0}]
    made = survey(config.load(run), library={**catalogue(), Round.name: Round})
    found, true = simulate.maps(made, 0)[0], sampled.maps(made, 0)[0][1]
    assert np.std(true) > 10.0
    assert np.std(found - true) < 0.1 * np.std(true)


@pytest.mark.parametrize("factor", [0.5, -1.0])
def test_powers_of_offsets_that_shrink_are_those_of_shrunk_offsets(streamed, factor) -> None:
    found = streamed.shrunk(factor)
    np.testing.assert_allclose(found.dtheta, factor * streamed.dtheta)
    np.testing.assert_allclose(found.dphi, factor * streamed.dphi)
    powers = factor ** np.array([2] * 3 + [3] * 4 + [4] * 5)
    np.testing.assert_allclose(found.offset_moments, powers[:, None] * streamed.offset_moments)


def test_orders_that_cannot_be_are_refused(sky, beam, streamed) -> None:
    with refused("map.offset_order", 3, 2, "OFFSET_a_b"):
        survey(config.load(table(streamed.up_to_offsets(2), beam, sky, offset_order=3)))
    with refused("offset_order", "pixel_window"):
        config.load(table(streamed, beam, sky, offset_order=2, pixel_window="none"))
    with refused("map.offset_order", "5"):
        config.load(table(streamed, beam, sky, offset_order=5))


def test_a_dry_run_counts_the_transforms(sky, beam, streamed) -> None:
    assert [transforms(order) for order in (2, 3, 4)] == [5, 9, 14]
    lines = {
        order: plan.cost(config.load(table(streamed, beam, sky, offset_order=order))).lines(1, 1) for order in (1, 4)
    }
    assert [line for line in lines[4] if "offsets" in line and "14 further transforms" in line]
    assert not [line for line in lines[1] if "offsets" in line]
