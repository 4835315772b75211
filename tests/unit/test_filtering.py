"""Quadratic maximum-likelihood BipoSH against whole matrices, each convention by a covariance that is written out."""

import healpy
import numpy as np
import pytest
import wignernj

import mcsim
from mcsim import config
from mcsim.bipolar import Mode, estimate, estimator, parse_mode
from mcsim.bipolar.modes import bin_factor
from mcsim.instrument.beams import Beam
from mcsim.simulation import convolve, simulate
from mcsim.simulation.filtering import LOWEST, Bands, Filtering, Response, _unbiased
from mcsim.simulation.inverse_covariance import InverseCovariance, ObservedMap, product, unit_skies
from mcsim.simulation.map_filter import MapFilter, unknown_dipole
from mcsim.simulation.survey import survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from refusals import refused

NSIDE, LMAX, WIDTH = 8, 8, 3
CL = unknown_dipole(np.append([0.0, 0.0], 3000.0 / np.arange(2, LMAX + 1.0) ** 2))
TABLES = estimator(2, LMAX, both_orders=True)
UNITS = [sky for _, sky in unit_skies(LMAX)]


CENTRES = np.array(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2)))
FITTED = np.stack([np.ones(12 * NSIDE**2), *CENTRES, CENTRES[0] * CENTRES[2] ** 3])  # dipole and a foreground


def map_filter(seed: int, tolerance: float = 1e-6, templates: np.ndarray | None = None) -> MapFilter:
    """One map with a mask, uneven noise and a pixel window."""
    rng = np.random.default_rng(seed)
    latitude = np.rad2deg(np.arcsin(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2]))
    precision = rng.uniform(0.2, 5.0, latitude.size) * (np.abs(latitude - 10.0 * seed) > 12.0) / 30.0**2
    window = healpix.pixel_window(NSIDE, LMAX)
    response = convolve.response(Beam.gaussian(900.0, LMAX), LMAX, window)
    inverse = InverseCovariance(CL, [ObservedMap(response, precision, templates=templates)], tolerance)
    return MapFilter(f"map{seed}", inverse, window, LMAX)


def filtered_covariance(one: MapFilter) -> tuple[np.ndarray, np.ndarray]:
    """C^-1 of a map between unit skies, w Y^t C^-1 Y w, and the operator w Y^t C^-1 on its pixels."""
    degrees = np.array([ell for ell, _ in unit_skies(LMAX)])
    pixels = np.stack([healpy.alm2map(sky, NSIDE, lmax=LMAX) for sky in UNITS], axis=1) * one.window[degrees]
    precision = one.inverse.precision[0]
    seen = precision > 0.0
    sky = pixels[seen] * (one.inverse.maps[0].response.factors[0].real / one.window)[degrees]
    covariance = (sky * CL[degrees]) @ sky.T + np.diag(1.0 / precision[seen])
    operator = np.zeros((len(UNITS), precision.size))
    operator[:, seen] = np.linalg.solve(covariance, pixels[seen]).T
    if (fitted := one.inverse.maps[0].templates) is not None:
        known = np.linalg.solve(covariance, fitted[:, seen].T)
        size = np.linalg.inv(fitted[:, seen] @ known)
        operator[:, seen] -= operator[:, seen] @ fitted[:, seen].T @ size @ known.T
    return operator @ pixels, operator


def packed(alm: np.ndarray) -> np.ndarray:
    return np.array([product(alm, sky, LMAX) for sky in UNITS])


@pytest.fixture(scope="module")
def products() -> np.ndarray:
    """BipoSH of every pair of unit skies, shape (sky, sky, mode, lmax + 1)."""
    return np.stack([[estimate(TABLES, x, y) for y in UNITS] for x in UNITS])


@pytest.fixture(scope="module")
def filters() -> list[MapFilter]:
    return [map_filter(0), map_filter(1)]


def forms(bands: Bands, products: np.ndarray) -> np.ndarray:
    """Matrices t_p with q_p = x' t_p y, shape (p, sky, sky)."""
    found = np.stack([[bands.sums(one) for one in row] for row in products])
    found = np.moveaxis(found, -1, 0)
    return (found + np.swapaxes(found, 1, 2)) / 2.0 if bands.auto else found


def information(forms_: np.ndarray, first: np.ndarray, second: np.ndarray, auto: bool) -> np.ndarray:
    """F = 1/2 Tr[C_p C^-1 C_p' C^-1] with C_p = 2 t_p of one map; Tr[t_p' C_x^-1 t_p' C_y^-1] of two."""
    moved = first @ forms_ @ second
    return (2.0 if auto else 1.0) * np.einsum("pij,qij->pq", forms_, moved)


def test_filter_equals_a_dense_solve(filters) -> None:
    one = map_filter(0, tolerance=1e-10)
    _, operator = filtered_covariance(one)
    data = np.random.default_rng(4).normal(size=12 * NSIDE**2) * 50.0
    expected = operator @ data
    for tried, error in ((one, 1e-8), (filters[0], 1e-5)):
        assert np.abs(packed(tried.apply(data)[0]) - expected).max() < error * np.abs(expected).max()
    again, _ = one.apply(data, near=one.apply(0.9 * data)[1])
    assert np.abs(packed(again) - expected).max() < 1e-8 * np.abs(expected).max()


def test_filter_of_maps_from_which_templates_were_subtracted_equals_a_dense_solve() -> None:
    """C^-1 - C^-1 T (T^t C^-1 T)^-1 T^t C^-1: the same whatever the amplitude of the templates is."""
    one = map_filter(0, 1e-10, FITTED)
    _, operator = filtered_covariance(one)
    data = np.random.default_rng(5).normal(size=12 * NSIDE**2) * 50.0
    expected = operator @ data
    scale = np.abs(expected).max()
    assert np.abs(expected - filtered_covariance(map_filter(0))[1] @ data).max() > 0.01 * scale
    for size in (0.0, 3000.0):
        assert np.abs(packed(one.apply(data + size * FITTED.sum(axis=0))[0]) - expected).max() < 1e-7 * scale


@pytest.mark.slow
def test_variance_behind_subtracted_templates_is_the_inverse_of_the_fisher_matrix(products) -> None:
    """Probes have templates of no amplitude, which the filter takes for any."""
    one, draws = map_filter(0, templates=FITTED), 300
    bands = Bands(TABLES.modes, LMAX, WIDTH, True)
    covariance, _ = filtered_covariance(one)
    inverse = np.linalg.inv(information(forms(bands, products), covariance, covariance, True))
    found = np.stack([bands.sums(estimate(TABLES, one.probe(k))) @ inverse for k in range(draws)])
    apart = (found - found.mean(axis=0)) ** 2
    error = apart.std(axis=0) / np.sqrt(draws)
    pulls = (apart.mean(axis=0) * draws / (draws - 1) - np.diag(inverse)) / error
    assert np.abs(pulls).max() < 4.5
    assert abs(pulls.mean()) < 1.0


@pytest.mark.parametrize("noise", [lambda z: 100.0 * np.exp(0.8 * z), lambda z: np.where(z > 0.0, 100.0, np.inf)])
def test_mean_of_noise_equals_the_trace(noise) -> None:
    """Uneven noise of all of the sky, and half of it hidden: Tr[C^-1 N C^-1 Y_l] over the response to a flat C_l."""
    sky_lmax = LMAX + 6
    degrees = np.array([ell for ell, _ in unit_skies(sky_lmax)])
    cl, window = np.resize(CL, sky_lmax + 1), np.ones(sky_lmax + 1)
    cl[LMAX + 1 :] = 3000.0 / np.arange(LMAX + 1.0, sky_lmax + 1.0) ** 2
    z = healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2]
    precision = noise(z) ** -2.0
    response = convolve.response(Beam.gaussian(900.0, sky_lmax), sky_lmax, window)
    one = MapFilter("map", InverseCovariance(cl, [ObservedMap(response, precision)]), window, LMAX)
    seen = precision > 0.0
    pixels = np.stack([healpy.alm2map(sky, NSIDE, lmax=sky_lmax)[seen] for _, sky in unit_skies(sky_lmax)], axis=1)
    sky = pixels * response.factors[0].real[degrees]
    operator = np.linalg.solve((sky * cl[degrees]) @ sky.T + np.diag(1.0 / precision[seen]), pixels).T
    through, answer = operator**2 @ (1.0 / precision[seen]), ((operator @ pixels) ** 2).sum(axis=1)
    exact = np.bincount(degrees, through) / np.bincount(degrees, answer)
    # Pixels that are not seen have noise of their own, which is none of the map's.
    variance = np.where(seen, np.divide(1.0, precision, out=np.full(z.size, 1e6), where=seen), 1e6)
    found = one.noise(variance * 4.0 * np.pi / z.size)
    # The wavelengths of l = 2 and 3 are about that of the half itself.
    np.testing.assert_allclose(found[4 : LMAX + 1], exact[4 : LMAX + 1], rtol=0.05)


def unitary() -> tuple[np.ndarray, list[tuple[int, int]]]:
    """Coefficients a_lm, m of both signs, of the unit skies, and their (l, m)."""
    indices = [(ell, m) for ell in range(LMAX + 1) for m in range(-ell, ell + 1)]
    values = [[sky[alm_.start(LMAX, abs(m)) + ell] for sky in UNITS] for ell, m in indices]
    signs = np.array([(-1.0) ** m if m < 0 else 1.0 for _, m in indices])[:, None]
    both = np.where(np.array([m < 0 for _, m in indices])[:, None], np.conj(values), values)
    return signs * both, indices


def clebsch(mode: Mode, l2: int) -> np.ndarray:
    """(-1)^m2 C^{LM}_{l1 m1 l2 -m2} between all (l1, m1) and (l2, m2)."""
    indices = unitary()[1]
    found = np.zeros((len(indices), len(indices)))
    for i, (l1, m1) in enumerate(indices):
        for j, (other, m2) in enumerate(indices):
            if (l1, other, m1 - m2) == (l2 - mode.d, l2, mode.M):
                found[i, j] = (-1) ** m2 * float(wignernj.clebsch_gordan(l1, m1, l2, -m2, mode.L, mode.M))
    return found


@pytest.mark.parametrize("auto", [True, False])
@pytest.mark.parametrize(
    ("name", "value"),
    [("L2M0d0", 7.0), ("L2M0d1", 5.0j), ("L1M1d1", 3.0 - 4.0j), ("L2M1d2", 2.0 + 6.0j), ("L2M2d0", -1.0 + 2.0j)],
)
def test_mean_is_what_a_covariance_was_given(products, filters, name: str, value: complex, auto: bool) -> None:
    """Sign, phase, parity and normalisation: A = value / factor in one bin of one mode, zero in all others."""
    mode, place = parse_mode(name), 1
    vectors, _ = unitary()
    ells = range(max(WIDTH * place, LOWEST + mode.d), WIDTH * (place + 1))
    factor = bin_factor(mode, LMAX)
    given = sum(clebsch(mode, l2) * value / factor[l2] for l2 in ells)
    change = (vectors.conj().T @ given @ vectors).real  # of real skies
    if auto:
        change = (change + change.T) / 2.0
    found = vectors @ change @ vectors.conj().T
    share = np.array([np.sum(found * clebsch(mode, l2)) * factor[l2] / value for l2 in ells])
    np.testing.assert_allclose(share, share[0].real, rtol=1e-12)  # what reality and exchange leave of it
    change /= share[0].real

    bands = Bands(TABLES.modes, LMAX, WIDTH, auto)
    t = forms(bands, products)
    first, second = (filtered_covariance(each)[0] for each in (filters[0], filters[0 if auto else 1]))
    mean = np.einsum("pij,ij->p", t, first @ change @ second)
    result = bands.spectra(np.linalg.solve(information(t, first, second, auto), mean))
    expected = np.where(np.isnan(result), np.nan, 0.0).astype(complex)
    expected[TABLES.modes.index(mode), place] = value
    np.testing.assert_allclose(result, expected, atol=1e-8)


def test_an_estimate_without_a_filter_has_more_variance_for_the_same_numbers(products) -> None:
    """What bins of the masked map's own A^{LM} measure is R, not 1: V alone can be below F^-1, R^-1 V R^-t cannot."""
    one, bands = map_filter(0), Bands(TABLES.modes, LMAX, WIDTH, True)
    degrees = np.array([ell for ell, _ in unit_skies(LMAX)])
    seen = one.inverse.precision[0] > 0.0
    field = np.stack([healpy.alm2map(sky, NSIDE, lmax=LMAX)[seen] for sky in UNITS], axis=1)
    sky = field * one.inverse.maps[0].response.factors[0].real[degrees]
    covariance = (sky * np.where(degrees < LOWEST, 0.0, CL[degrees])) @ sky.T
    covariance += np.diag(1.0 / one.inverse.precision[0][seen])
    window = one.window[degrees]
    filtered = (field * window).T @ np.linalg.inv(covariance)
    masked = field.T * (4.0 * np.pi / seen.size / np.sqrt(seen.mean())) / window[:, None]
    used, (mode, place, part) = bands.count > 0.0, bands.numbers
    factor = np.stack([bin_factor(each, LMAX) for each in bands.modes])
    terms = np.add.reduceat(np.where(used, factor * np.where(used, products, 0.0), 0.0), bands.first, axis=-1)
    count = np.add.reduceat(used, bands.first, axis=-1)[mode, place]
    plain = np.where(part == 0, terms.real[..., mode, place], terms.imag[..., mode, place]) / count
    plain = np.moveaxis(plain + np.swapaxes(plain, 0, 1), -1, 0) / 2.0
    t, inside = forms(bands, products), masked @ (field * window)
    fisher = information(t, *[filtered @ (field * window)] * 2, True)
    response = 2.0 * np.einsum("pij,qij->pq", inside.T @ plain @ inside, t)
    spread = masked @ covariance @ masked.T
    variance = 2.0 * np.einsum("pij,qji->pq", plain @ spread, plain @ spread)
    inverse, back = np.linalg.inv(fisher), np.linalg.inv(response)
    assert (np.diag(inverse) > np.diag(variance)).mean() > 0.2
    left = back @ variance @ back.T - inverse
    assert np.linalg.eigvalsh(left).min() > -1e-6 * np.abs(left).max()
    assert np.median(np.diag(inverse) / np.diag(inverse + left)) < 0.9


def variance_of_probes(t: np.ndarray, first: np.ndarray, second: np.ndarray, number: int, auto: bool) -> np.ndarray:
    """Variance of F from all pairs of probes: of a U-statistic of (x' t_p y)(x' t_q y), and of as many pairs alone."""
    expected = information(t, first, second, auto)
    size = np.diag(expected)
    pairs = number * (number - 1) / (2.0 if auto else 1.0)
    result = (np.outer(size, size) + expected**2) / pairs
    for row, one in enumerate(t):
        for left, right, mine, other in ((one, t, first, second), (one.T, np.swapaxes(t, 1, 2), second, first)):
            given = left @ other @ np.swapaxes(right, 1, 2)  # E[(x' t_p y)(x' t_q y) | x] = x' given x
            moved = (given + np.swapaxes(given, 1, 2)) @ mine / 2.0
            result[row] += (8.0 if auto else 1.0) * 2.0 * np.einsum("qij,qji->q", moved, moved) / number
    return result


@pytest.mark.slow
def test_random_probes_estimate_the_fisher_matrix(products, filters) -> None:
    """Of one map and of two, element by element."""
    number = 40
    for pairs, auto in ((((0, 0),), True), (((0, 1),), False)):
        filtering = Filtering(tuple(filters), pairs, TABLES, WIDTH, number)
        found = filtering.response([tuple(each.probe(k) for each in filters) for k in range(number)], 0)
        t = forms(filtering.bands[0], products)
        first, second = (filtered_covariance(filters[place])[0] for place in pairs[0])
        apart = found.matrix - information(t, first, second, auto)
        assert np.abs(apart / np.sqrt(variance_of_probes(t, first, second, number, auto))).max() < 5.5


def test_the_inverse_of_an_estimated_matrix_is_unbiased() -> None:
    """Pairs of probes are not independent: of 24 numbers of 60 modes the inverse is 6 % too large by itself."""
    rng = np.random.default_rng(5)
    size, modes, number, sets = 24, 60, 32, 200
    forms = rng.standard_normal((size, modes, modes))
    forms += np.swapaxes(forms, 1, 2)
    exact = np.diag(np.linalg.inv(np.einsum("pij,qij->pq", forms, forms)))
    first, second = np.triu_indices(number, 1)
    half = number // 2
    own = np.select([second < half, first >= half], [0, 1], 2)
    found, independent = [], []
    for _ in range(sets):
        probes = rng.standard_normal((number, modes))
        values = np.einsum("ni,pij,nj->np", probes[first], forms, probes[second], optimize=True)
        halves = [(values[own == which].T @ values[own == which], float(np.sum(own == which))) for which in (0, 1)]
        ratio = np.mean(np.diag(np.linalg.inv(values.T @ values / len(values))) / exact)
        found.append(_unbiased(halves, float(len(values))) * ratio)
        independent.append((len(values) - size - 1) / len(values) * ratio)
    error = np.std(found) / np.sqrt(sets)
    assert error < 0.01
    assert abs(np.mean(found) - 1.0) < 3.0 * error
    assert np.mean(independent) - 1.0 > 5.0 * error
    few = [(total, 47.0) for total, _ in halves]
    assert _unbiased(few, 190.0) == (190 - size - 1) / 190


@pytest.mark.slow
def test_variance_is_the_inverse_of_the_fisher_matrix(products, filters) -> None:
    """Estimates from noisy masked maps of isotropic skies, within 4 errors of the sample variance."""
    draws = 300
    bands = Bands(TABLES.modes, LMAX, WIDTH, True)
    covariance, _ = filtered_covariance(filters[0])
    inverse = np.linalg.inv(information(forms(bands, products), covariance, covariance, True))
    found = np.stack([bands.sums(estimate(TABLES, filters[0].probe(1000 + k))) @ inverse for k in range(draws)])
    apart = (found - found.mean(axis=0)) ** 2
    error = apart.std(axis=0) / np.sqrt(draws)
    pulls = (apart.mean(axis=0) * draws / (draws - 1) - np.diag(inverse)) / error
    assert np.abs(pulls).max() < 4.5
    assert abs(pulls.mean()) < 1.0


def run(**biposh) -> config.RunConfig:
    channel = {
        "name": "A",
        "beam": {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 600.0, "fwhm_minor_arcmin": 400.0},
        "scan": {"kind": "parallel_transport"},
        "noise": {"sigma0_uk": 30.0},
    }
    return config.load(
        {
            "name": "filtered",
            "sky": {"spectrum": "wmap7", "lmax": 24},
            "map": {"nside": 16},
            "channel": [channel],
            "biposh": {"L_max": 2, "summary_bin": 8} | biposh,
        }
    )


def test_full_sky_with_uniform_noise_is_the_estimator_without_a_filter() -> None:
    """x = a / C, A[x] C_l1 C_l2 = A to the last digits, and bins are means weighted by the inverse variance."""
    plain, shared = survey(run()), survey(run(filter="inverse_covariance"))
    expected, found = simulate.realize(plain, 3), simulate.realize(shared, 3)
    for name in ("biposh", "biposh_circular", "cl"):
        scale = np.nanmax(np.abs(expected[name]))
        np.testing.assert_allclose(found[name], expected[name], atol=1e-12 * scale, rtol=1e-9)
    filtering = shared.filtering
    assert filtering is not None
    assert filtering.drawn == 0
    total = filtering.filters[0].total
    noise = 30.0**2 * healpy.nside2pixarea(16)
    beam = np.abs(shared.channels[0].beam.window)
    np.testing.assert_allclose(total[2:], shared.cl[2:] * beam[2:] ** 2 + noise, rtol=1e-12)
    row = shared.estimator.modes.index(Mode(2, 1, 2))
    ell = np.arange(8, 16)
    factor = bin_factor(Mode(2, 1, 2), 24)[ell]
    weight = 1.0 / (factor**2 * total[ell] * total[ell - 2])
    mean = np.sum(weight * factor * expected["biposh"][0, row, ell]) / weight.sum()
    assert found["biposh_qml"][0, row, 1] == pytest.approx(mean, rel=1e-9)
    assert filtering.errors()[0, row, 1] == pytest.approx(1.0 / np.sqrt(weight.sum()), rel=1e-9)
    np.testing.assert_allclose(filtering.band_powers(expected["biposh"]), found["biposh_qml"], rtol=1e-9)


def test_a_run_without_the_key_keeps_its_identity() -> None:
    """Neither the key nor its bins count where nothing is filtered; with it they do."""
    plain = run()
    assert {"filter", "probes"}.isdisjoint(config.science(plain)["biposh"])
    assert {"filter", "probes"}.isdisjoint(config.resolved(plain)["biposh"])
    filtered = run(filter="inverse_covariance")
    assert config.from_json(config.to_json(filtered)) == filtered
    assert config.digest(filtered) != config.digest(run(filter="inverse_covariance", summary_bin=4))
    assert config.digest(plain) == config.digest(run(summary_bin=4))


def test_a_map_without_values_that_a_filter_weights_is_refused() -> None:
    """UNSEEN is -1.6e30 uK to a filter that does not look."""
    one = map_filter(0)
    hidden = np.where(one.inverse.precision[0] > 0.0, 1.0, healpy.UNSEEN)
    assert np.isfinite(one.apply(hidden)[0]).all()
    for bad in (healpy.UNSEEN, np.nan, np.inf):
        with refused("map0", 3, "map.mask"):
            one.apply(np.where(np.cumsum(one.inverse.precision[0] > 0.0) <= 3, bad, 1.0))
    with refused("map0", 8):
        one.apply(np.ones(12 * 4**2))


def test_a_subtracted_dipole_has_any_amplitude() -> None:
    """What a prepared run estimates from a sky is what it estimates from the sky with another dipole."""
    plain = config.to_dict(run(filter="inverse_covariance"))
    steps = [{"kind": "subtract_dipole"}]
    shared = survey(config.load(plain | {"preparation": steps}))
    assert shared.filtering is not None
    one = shared.filtering.filters[0]
    assert not one.uniform
    assert shared.filtering.drawn > 0
    sky = next(iter(simulate.maps(shared.making, 0)))
    moved = sky + 3000.0 * np.array(healpy.pix2vec(16, np.arange(12 * 16**2)))[2]
    found, again = (one.apply(map_uk)[0] for map_uk in (sky, moved))
    np.testing.assert_allclose(again, found, atol=1e-5 * np.abs(found).max())
    without = survey(config.load(plain)).filtering
    assert without is not None
    # Without the step a dipole of 100 uK is nothing unusual, and one of 3000 is.
    np.testing.assert_allclose(found, without.filters[0].apply(sky)[0], atol=0.02 * np.abs(found).max())


def test_a_preparation_that_changes_pixels_does_not_go_with_a_filter(tmp_path) -> None:
    plain = config.to_dict(run(filter="inverse_covariance"))
    with refused("preparation", "smooth", "biposh.filter"):
        config.load(plain | {"preparation": [{"kind": "smooth", "fwhm_arcmin": 900.0}]})
    healpy.write_map(tmp_path / "soft.fits", np.linspace(0.0, 1.0, 12 * 16**2), dtype=np.float64)
    soft = config.load(plain | {"preparation": [{"kind": "mask", "mask": str(tmp_path / "soft.fits")}]})
    with refused("preparation", "map.mask"):
        survey(soft)


def test_what_a_filter_cannot_bear_is_refused() -> None:
    with refused("biposh.iterations"):
        run(filter="inverse_covariance", iterations=1)
    with refused("biposh.weighting"):
        run(filter="inverse_covariance", weighting="hits")
    with refused("biposh.probes"):
        run(probes=20)
    plain = config.to_dict(run(filter="inverse_covariance"))
    del plain["channel"][0]["noise"]
    with refused("channel[A]"):
        config.load(plain)
    with refused(10, "biposh.probes"):
        _ = Filtering((map_filter(0),), ((0, 0),), TABLES, WIDTH, 10).drawn


def test_more_numbers_than_the_maps_tell_apart_are_refused() -> None:
    """Ten random forms of nine numbers are told apart, of eleven they are not, in whatever units they are."""
    rng = np.random.default_rng(8)
    for size in (9, 11):
        forms = rng.standard_normal((size, 10)) * np.logspace(-6, 6, size)[:, None]
        response = Response(forms @ forms.T)
        if size > 10:
            with refused(size, "biposh.summary_bin"):
                response.checked()
        else:
            assert response.checked() is response


def test_predictions_behind_a_mask_do_not_depend_on_where_it_is_declared(tmp_path) -> None:
    """Estimates are those of the full sky; moments of prepared maps are zero behind their mask."""
    path, height = tmp_path / "mask.fits", healpy.pix2vec(16, np.arange(12 * 16**2))[2]
    healpy.write_map(path, (np.abs(height) > 0.35).astype(float), dtype=np.float64)
    plain = config.to_dict(run(filter="inverse_covariance", lmax=24))
    plain["sky"]["lmax"] = 32
    own = plain | {"map": plain["map"] | {"mask": str(path), "mask_frame": "ecliptic"}}
    step = plain | {"preparation": [{"kind": "mask", "mask": str(path), "mask_frame": "ecliptic"}]}
    first, second = (mcsim.predict(config.load(one)) for one in (own, step))
    for name in ("biposh_difference_mean", "biposh_qml_difference_mean"):
        expected = first[name].values
        np.testing.assert_allclose(second[name].values, expected, atol=2e-3 * np.nanmax(np.abs(expected)))
