"""Rings without pixels: against brute-force spin transforms, and against HEALPix on the same skies."""

from dataclasses import replace

import ducc0
import healpy
import numpy as np
import pytest

from mcsim import config
from mcsim.ensemble.prediction import predict
from mcsim.instrument import scan
from mcsim.instrument.scan.limit import caustics, graded_rule, limit_moments, limit_quadrature
from mcsim.simulation import channels, convolve, rings, simulate
from mcsim.simulation import survey as survey_
from mcsim.sphere import alm as alm_
from mcsim.sphere.sky import gaussian_alm
from mcsim.systematics import Effect
from refusals import refused

LMAX = 24
WMAP = scan.ScanModel.load("wmap")
LITEBIRD = scan.ScanModel.load("litebird")
PSI0 = 0.3


def a_response(s, seed=0):
    """A beam of one order, with complex factors, and a sky."""
    rng = np.random.default_rng(seed)
    factors = np.zeros((s + 1, LMAX + 1), dtype=complex)
    factors[s, s:] = rng.standard_normal(LMAX + 1 - s) + 1j * rng.standard_normal(LMAX + 1 - s)
    return gaussian_alm(np.ones(LMAX + 1), rng), convolve.Response(factors)


def brute_force(alm, response, s, theta, weight, w, lmax):
    """Spin transforms by ducc0 to many rings, times the moment, and back."""
    factor = response.factors[s]
    fields = np.stack([alm_.multiply(alm, -factor.real, LMAX), alm_.multiply(alm, -factor.imag, LMAX)])
    real, imag = ducc0.sht.alm2leg(alm=fields, lmax=LMAX, theta=theta, spin=s)
    product = 2.0 * weight[:, None] * (w.real[:, None] * real - w.imag[:, None] * imag)
    return ducc0.sht.leg2alm(leg=product[None, :, : lmax + 1], lmax=lmax, theta=theta, spin=0)[0]


@pytest.mark.parametrize("model", [WMAP, LITEBIRD], ids=["wmap", "litebird"])
@pytest.mark.parametrize("s", [1, 2, 3, 4, 7])
def test_limit_against_brute_force(model, s):
    alm, response = a_response(s)
    # Its 121 nodes between caustics are enough for products of degree 48.
    theta, weight = limit_quadrature(model)
    w = limit_moments(model, theta, s)[1][s - 1]
    expected = brute_force(alm, response, s, theta, 2.0 * np.pi * weight, w, LMAX)
    found = rings.noncircular_alm(alm, response, rings.limit_rings(model, [s], 2 * LMAX), LMAX)
    # Round-off of the recurrence behind the Gauss rules.
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()


@pytest.mark.parametrize("s", [1, 2, 5])
@pytest.mark.parametrize("lmax", [LMAX, 16])
def test_parallel_transport_against_brute_force(s, lmax):
    alm, response = a_response(s)
    # Equal steps of theta: with the weights of Fejer exact for polynomials (even s), with equal ones for sin(theta)
    # times polynomials (odd s).
    steps = 4 * LMAX + 8
    theta = np.pi * np.arange(1, steps) / steps
    odd = np.arange(1, steps, 2)
    fejer = 8.0 * np.pi / steps * (np.sin(np.outer(theta, odd)) / odd).sum(axis=1)
    weight = np.sin(theta) * (2.0 * np.pi**2 / steps if s % 2 else fejer)
    expected = brute_force(alm, response, s, theta, weight, np.full(theta.size, np.exp(-1j * s * PSI0)), lmax)
    grid = rings.parallel_transport_rings(PSI0, [s], LMAX + lmax)
    assert grid[0].theta.size == (LMAX + lmax) // 2 + 1
    found = rings.noncircular_alm(alm, response, grid, lmax)
    # Round-off.
    assert np.abs(found - expected).max() < 1e-11 * np.abs(expected).max()


@pytest.mark.parametrize("s", [1, 2, 4, 6])
def test_real_part_of_spin_maps(s):
    """Re S_s at rings of a HEALPix map, for beams of complex b_lm: what the division by sin^s leaves."""
    alm, response = a_response(s, seed=3)
    nside = 16
    expected = convolve.spin_maps(alm, response, nside)[s][0]
    theta = healpy.pix2ang(nside, np.arange(12 * nside**2))[0]
    ring = np.flatnonzero(np.isclose(theta, theta[5 * nside**2]))
    fourier = np.fft.rfft(expected[ring]) / ring.size
    found = rings._real_part(alm, response.factors[s], s, theta[ring[:1]], 1)[0]
    phi = healpy.pix2ang(nside, ring[0])[1]
    m = np.arange(LMAX + 1)
    assert np.allclose(found * np.exp(1j * m * phi), fourier[: LMAX + 1], atol=1e-10 * np.abs(found).max())


def test_few_rings():
    """The reason to have them: fewer than HEALPix has, and symmetric about the equator."""
    degree = 400
    (grid,) = rings.limit_rings(WMAP, [2], degree)
    assert grid.theta.size < 0.8 * degree
    assert np.allclose(grid.theta, np.pi - grid.theta[::-1], rtol=0.0, atol=1e-12)


def test_rules_of_many_points_are_free_of_the_round_off_of_their_recurrence():
    """The lines of sight nearly meet the poles: point by point integrals were wrong by 8e-5 of that of |w|."""
    lines = tuple(replace(line, boresight_angle_deg=30.2) for line in LITEBIRD.lines_of_sight)
    model, degree = replace(LITEBIRD, precession_angle_deg=60.0, lines_of_sight=lines), 1400
    theta, weight = graded_rule(caustics(model), lambda half: int(400 + 3 * degree * half))
    measure = weight * limit_moments(model, theta, 2)[1][1].real
    (grid,) = rings.limit_rings(model, [2], degree)
    for k in range(0, degree, 70):
        found = grid.phase.real * (grid.weight @ np.cos(k * grid.theta))
        assert abs(found - measure @ np.cos(k * theta)) < 1e-10 * np.abs(measure).sum()


def run(**changes):
    base = {
        "schema": 1,
        "name": "rings",
        "sky": {"spectrum": "wmap7", "lmax": 48},
        "map": {"grid": "gl"},
        "channel": [channel({"kind": "hit_averaged", "model": "wmap"})],
        "biposh": {"L_max": 2, "summary_bin": 8},
        "ensemble": {"realizations": 4, "seed": 7},
    }
    return config.load(base | changes)


def channel(which, **more):
    beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 260.0, "fwhm_minor_arcmin": 200.0, "m_max": 2}
    return {"name": "W1", "beam": beam, "scan": which} | more


PT = channel({"kind": "parallel_transport", "psi0_deg": 20.0})


@pytest.mark.parametrize("which", ["parallel transport", "limit"])
def test_same_spectra_as_healpix(which, tmp_path):
    """Binned A^{20} of the same skies agree within 1e-3 of the error bar of the paired difference."""
    nside, realizations = 128, 4
    pixels = PT
    if which == "limit":
        theta = healpy.pix2ang(nside, np.arange(12 * nside**2))[0]
        rows, ring = np.unique(theta, return_inverse=True)
        hits, w = limit_moments(WMAP, rows, 2)
        path = tmp_path / "moments.fits"
        scan.write_moments_fits(path, scan.Moments(nside, "ecliptic", hits[ring], w[:, ring]))
        pixels = channel({"kind": "moments", "path": str(path)})
    on_pixels = run(
        map={"nside": nside, "pixel_window": "none"}, channel=[pixels], biposh={"L_max": 2, "iterations": 1}
    )
    on_rings = run(channel=[PT]) if which == "parallel transport" else run()
    differences = []
    for source in (on_pixels, on_rings):
        shared = survey_.survey(source)
        row = [mode.name for mode in shared.estimator.modes].index("L2M0d0")
        found = [simulate.realize(shared, number) for number in range(realizations)]
        spectra = np.array([(f["biposh"] - f["biposh_circular"])[0, row, 2:42].real for f in found])
        differences.append(spectra.reshape(realizations, 5, 8).mean(axis=-1))
    error = differences[1].std(axis=0, ddof=1) / np.sqrt(realizations)
    gap = np.abs(differences[0].mean(axis=0) - differences[1].mean(axis=0))
    # The pixels' own error, which falls with nside: that of sums over rings across the caustics, and at the poles.
    assert np.all(gap < (1e-3 if which == "parallel transport" else 1e-2) * error)


def test_prediction_has_the_limit():
    predicted = predict(run())
    shared = survey_.survey(run())
    (grid,) = shared.channels[0].rings
    scale = np.sqrt(15.0 / (32.0 * np.pi))
    theta, weights = limit_quadrature(WMAP)
    # w_{2,20} of w_2 = sum_L w_{2,L0} (-2)Y_L0, where (-2)Y_20 = sqrt(15/32 pi) sin^2(theta).
    w20 = 2.0 * np.pi * scale * np.sum(weights * limit_moments(WMAP, theta, 2)[1][1] * np.sin(theta) ** 2)
    transported = predict(run(channel=[channel({"kind": "parallel_transport"})]))
    from_rings = 2.0 * np.pi * np.sum(grid.phase.real * grid.weight * np.sin(grid.theta) ** 2) / (2.0 * np.pi)
    ratio = (predicted / transported)["biposh_difference_mean"].sel(mode="L2M0d0")[0, 10].item()
    assert np.isclose(scale * from_rings, w20.real, rtol=1e-10)
    assert np.isclose(ratio.real, scan.limit_factors(WMAP, [2]).quadrupole_ratio, rtol=1e-8)
    assert predicted.attrs["left_out"] == "nothing"


def test_analysis_below_the_sky():
    """What a lower lmax of the analysis gives is what the higher one gives there."""
    low = simulate.realize(survey_.survey(run(biposh={"L_max": 2, "lmax": 40})), 1)
    high = simulate.realize(survey_.survey(run()), 1)
    assert np.allclose(low["cl"], high["cl"][:, :41], rtol=1e-7)


class OnPixels(Effect):
    name = "on_pixels"

    def spread(self):
        return 0.5


class OnBeam(Effect):
    name = "on_beam"

    def beam(self, beam, site):
        return beam


def test_effects_on_pixels_are_refused():
    channels.refuse_pixel_effects("W1", (OnBeam(),))
    with refused("on_pixels", "W1", "map.grid"):
        channels.refuse_pixel_effects("W1", (OnBeam(), OnPixels()))


LIMIT = channel({"kind": "hit_averaged", "model": "wmap"})


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"map": {}}, ("map", "nside")),
        ({"map": {"grid": "gl", "nside": 64}}, ("map", "nside", "grid")),
        ({"map": {"grid": "gl", "splits": ["a", "b"]}}, ("map", "splits", "grid")),
        ({"map": {"grid": "gl", "pixel_window": "computed"}}, ("map", "pixel_window", "grid")),
        ({"map": {"grid": "gl", "frame": "galactic"}}, ("map.frame", "galactic", "ecliptic", "map.grid")),
        (
            {"channel": [channel({"kind": "hit_averaged", "model": "wmap", "sample_period_s": 5.0})]},
            ("channel[W1].scan.sample_period_s", 5.0, "map.grid"),
        ),
        ({"channel": [LIMIT | {"noise": {"sigma0_uk": 1.0}}]}, ("channel[W1].noise.sigma0_uk", 1)),
        (
            {"channel": [channel({"kind": "differencing", "model": "wmap", "pair": "WMAP"})]},
            ("channel[W1].scan", "differencing", "hit_averaged", "map.grid"),
        ),
        ({"ensemble": {"keep_maps": True}}, ("ensemble.keep_maps", "true")),
        ({"biposh": {"weighting": "hits"}}, ("biposh.weighting", "hits")),
        ({"biposh": {"iterations": 1}}, ("biposh.iterations", 1)),
    ],
)
def test_refusals(changes, named):
    with refused(*named):
        run(**changes)


def test_refused_scans():
    with refused("Planck", 2, 50):
        rings.limit_rings(scan.ScanModel.load("planck"), [2], 8)
    lines = scan.ScanModel.load("wmap_focal_plane")
    with refused("W1A, W1B", "scan.line_of_sight"):
        rings.limit_rings(lines, [2], 8)


def test_hash_and_round_trip():
    loaded = run()
    assert config.load(config.to_dict(loaded)) == loaded
    assert config.science(loaded)["map"]["grid"] == "gl"
    assert "nside" not in config.science(loaded)["map"]
    pixels = run(map={"nside": 32}, channel=[PT])
    assert "grid" not in config.science(pixels)["map"]
    assert config.digest(pixels) == config.digest(run(map={"nside": 32, "grid": "healpix"}, channel=[PT]))
