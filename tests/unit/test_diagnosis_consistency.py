"""A name must agree with all parts of the data, and its parameters be possible."""

from dataclasses import fields, replace
from types import SimpleNamespace

import healpy
import numpy as np
import pytest
from scipy.special import sph_harm_y

from mcsim import systematics
from mcsim.datavector import slices
from mcsim.datavector.candidate import BEYOND, Candidate
from mcsim.datavector.null_ensemble import NullEnsemble
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.summaries import Element
from mcsim.diagnosis.consistency import Action, Comparison, Findings, MapCheck, Slices, contradiction
from mcsim.sphere import healpix
from mcsim.sphere.rotation import rotation_matrix
from mcsim.systematics.added import LATE

NSIDE = 16
GAIN = Candidate(systematics.get("gain_drift"), "W1", (0, 1))
CALIBRATION = Candidate(systematics.get("calibration"), "W1", (0,))
LOUDER = Candidate(systematics.get("noise_level"), "W1", (0,))


def real_harmonic(degree, order, component, theta, phi):
    """sqrt(2) Re Y, or -sqrt(2) Im Y, as scipy has it."""
    y = sph_harm_y(degree, order, theta, phi)
    return y.real if order == 0 else np.sqrt(2.0) * (-y.imag if component == "imaginary" else y.real)


def pixels(nside=NSIDE):
    return healpy.pix2ang(nside, np.arange(12 * nside**2))


@pytest.fixture(scope="module")
def model():
    parts = [SimpleNamespace(channel=0, name=f"W1:{split}", split=split) for split in ("a", "b")]
    return SimpleNamespace(
        parts=parts, lmax=24, nside=NSIDE, channels=("W1",), frame="ecliptic", of=lambda channel: (0, 1)
    )


def test_numbers_are_sums_of_pixels_times_real_harmonics(model):
    draw = np.random.default_rng(1)
    residual, expected = draw.normal(size=(2, 2, 12 * NSIDE**2))
    adjoint = [healpix.analysis(one, model.lmax) for one in residual]
    # The adjoint of a synthesis, not an analysis: pixels count alike.
    adjoint = [healpy.map2alm(one, model.lmax, iter=0) * 12 * NSIDE**2 / (4.0 * np.pi) for one in residual]
    found = slices.values_of(model, SimpleNamespace(residual=residual, expected=expected, adjoint=adjoint))
    elements = slices.elements_of(model)
    assert len(found) == len(elements) == 2 * (25 + 9)
    for value, one in zip(found, elements, strict=True):
        part = ["a", "b"].index(one.split)
        seen = residual[part] * (expected[part] if one.kind == "gain" else 1.0)
        assert value == pytest.approx(real_harmonic(one.L, one.M, one.component, *pixels()) @ seen, abs=1e-6)


@pytest.mark.parametrize("frame", ["ecliptic", "galactic"])
def test_a_hemisphere_is_kept_as_by_a_mask(model, frame):
    elements = [one for one in slices.elements_of(model) if one.split == "a" and one.kind == "residual"]
    fine = 64
    theta, phi = pixels(fine)
    harmonics = np.stack([real_harmonic(one.L, one.M, one.component, theta, phi) for one in elements])
    draw = np.random.default_rng(2).normal(size=len(elements))
    height = rotation_matrix("ecliptic", frame)[2] @ np.stack(healpy.pix2vec(fine, np.arange(12 * fine**2)))
    weight = np.where(np.abs(height) < 1e-9, 0.5, height > 0.0)
    masked = harmonics @ (weight * (draw @ harmonics)) * 4.0 * np.pi / len(theta)
    # Pixels along the edge are on one side or the other: sqrt(6 nside) of them at nside 32.
    assert np.allclose(slices.northern(elements, frame) @ draw, masked, atol=0.02)


@pytest.mark.parametrize("lmax", [8, 12, 13, 16, 23, 24, 40, 300])
def test_ranges_of_degrees_follow_one_another_to_the_last(lmax):
    """None starts behind its end, however few degrees the maps have."""
    empty = np.zeros((0, 0))
    nothing = NullEnsemble(empty, np.zeros(0), (), empty, empty, empty, empty, empty)
    tested = Slices(nothing, np.zeros(0), 0, ("half1", "half2"), lmax, DiagnosisSettings())
    found = tested._divisions(GAIN, np.zeros(0))
    (degrees,) = (one for one in found if one.kind == "degrees")
    ends = [tuple(map(int, word.removeprefix("ℓ ").split("–"))) for word in degrees.words]
    assert [first for first, _ in ends] == [0, *(last + 1 for _, last in ends[:-1])]
    assert all(first <= last for first, last in ends)
    assert ends[-1][1] == lmax


class Bench:
    """A gain drift that shows with opposite signs in the halves, beside noise of 400 simulations."""

    def __init__(self):
        draw = np.random.default_rng(3)
        modes = [(0, 0, None), (1, 0, None), (1, 1, "real"), (1, 1, "imaginary")]
        elements = [
            Element(f"{kind}/{split}/{L}{M}{c}", "map", ("W1",), split, fold, (L, L), L, M, None, "ecliptic", kind, c)
            for kind in ("beam", "residual")
            for fold, split in enumerate(("half1", "half2"))
            for L, M, c in modes
        ]
        drawn, empty = draw.normal(size=(400, 16)), np.zeros((0, 16))
        self.ensemble = NullEnsemble(drawn, np.zeros(16), tuple(elements), empty, empty, empty, empty, empty)
        shape = draw.normal(size=(4, 2))
        self.t = np.concatenate([shape, -shape, 2.0 * shape, -2.0 * shape])
        self.signs = np.repeat([1.0, -1.0, 1.0, -1.0], 4)

    def findings(self, signal, theta, seed=None, candidate=GAIN, scatters=(), wider=1.0, pair=None):
        z = signal + (0.0 if seed is None else np.random.default_rng([4, seed]).normal(size=16))
        tested = Slices(self.ensemble, z, 8, ("half1", "half2"), 24, DiagnosisSettings())
        covariance = wider**2 * np.linalg.inv(self.t.T @ self.t)
        action = replace(Action.of(self.t @ theta, self.t, theta, covariance, scatters), wider=wider, pair=pair)
        return tested.findings([candidate], [action])


@pytest.fixture(scope="module")
def bench():
    return Bench()


THETA = np.array([2.0, 1.0])


@pytest.mark.slow
def test_a_true_effect_is_refused_as_seldom_as_the_levels_say(bench):
    found = [bench.findings(bench.t @ THETA, THETA, seed) for seed in range(300)]
    refused = sum(one.contradict(DiagnosisSettings()) for one in found)
    # 1 % of 300, and at most as many by the odds: more than 13 once in a thousand runs.
    assert refused <= 13
    assert all(one.measured for one in found)
    halves = [own.pvalue for one in found for own in one.comparisons[0] if own.kind == "halves"]
    assert len(halves) == 300
    # The tolerated error of the response makes small p-values rarer.
    assert np.mean(np.array(halves) <= 0.05) <= 0.05 + 4 * np.sqrt(0.05 * 0.95 / 300)


@pytest.mark.parametrize(("wider", "refused"), [(1.0, True), (2.0, False)])
def test_parts_scatter_with_the_effect_as_the_amplitude_does(bench, wider, refused):
    """The effect differs from half to half by sqrt(3) times the errors that the amplitudes have without it."""
    draw, response = np.random.default_rng(13), bench.t @ THETA
    first = np.tile(np.repeat([1.0, 0.0], 4), 2)
    own = [half * response / np.linalg.norm(half * response) for half in (first, 1.0 - first)]
    found = []
    for seed in range(200):
        more = sum(np.sqrt(3.0) * draw.normal() * one for one in own)
        (each,) = bench.findings(response + more, THETA, seed, wider=wider).comparisons
        found += [one.pvalue for one in each if one.kind == "halves"]
    share = np.mean(np.array(found) <= 0.05)
    assert (share > 0.05 + 6.0 * np.sqrt(0.05 * 0.95 / 200)) == refused


@pytest.mark.parametrize("known", [False, True])
def test_maps_may_keep_what_the_effect_leaves_by_its_scatter(bench, known):
    """In each sky the response differs from its mean by as much as noise, which eight skies tell."""
    draw, response, left = np.random.default_rng(14), bench.t @ THETA, []
    for seed in range(200):
        before = draw.normal(size=(8, 16))
        pair = (before, before + response + draw.normal(size=(8, 16))) if known else None
        found = bench.findings(response + draw.normal(size=16), THETA, seed, pair=pair)
        left += [one.pvalue for one in found.maps]
    share, error = np.mean(np.array(left) <= 0.05), np.sqrt(0.05 * 0.95 / 200)
    assert (share < 0.05 + 4.0 * error) if known else (share > 0.05 + 6.0 * error)


def test_a_map_is_compared_as_the_part_of_the_fit_that_it_is(bench):
    """A calibration, fitted to two maps whose largest scales have 0.9 of the noise of the data vector's elements."""
    draw, shape = np.random.default_rng(8), np.repeat(np.random.default_rng(9).normal(size=4)[None], 2, axis=0).ravel()
    response = 6.0 * np.concatenate([shape, shape]) / np.linalg.norm(shape)

    def noise(count):
        of_vector = draw.normal(size=(count, 8))
        own = np.sqrt(1.0 - 0.9**2) * draw.normal(size=(count, 8))
        return np.concatenate([of_vector, 0.9 * of_vector + own], axis=1)

    ensemble, settings = replace(bench.ensemble, simulations=noise(2000)), DiagnosisSettings(consistency_error=1e-6)
    tested = Slices(ensemble, np.zeros(16), 8, ("half1", "half2"), 24, settings)
    null, found = tested.null(np.arange(8)), []
    for z in response + noise(400):
        fit = null.fit(z[:8], response[:8, None])
        action = Action.of(response * fit.amplitudes[0], response[:, None], fit.amplitudes, fit.covariance)
        (each,) = replace(tested, z=z).findings([CALIBRATION], [action]).comparisons
        found += [next(one.pvalue for one in each if one.kind == "map")]
    for level in (0.05, 0.2, 0.5):
        rate = float(np.mean(np.array(found) <= level))
        assert abs(rate - level) < 4.0 * np.sqrt(level * (1.0 - level) / 400), level


@pytest.mark.parametrize("known", [pytest.param(True, marks=pytest.mark.slow), False])
def test_the_scatter_of_draws_is_no_contradiction(bench, known):
    """A stochastic effect whose draws differ by three times the noise, in every element; 24 are known."""
    draw, refused = np.random.default_rng(5), 0
    for seed in range(100):
        draws = 3.0 * draw.normal(size=(16, 24))
        scatter = (draws - draws.mean(axis=1, keepdims=True)) * np.sqrt((1.0 + 1.0 / 24.0) / 23.0)
        signal = 3.0 * (bench.t @ THETA + draw.normal(size=16))
        found = bench.findings(signal, 3.0 * THETA, seed, scatters=[scatter] if known else ())
        refused += found.contradict(DiagnosisSettings())
    # 1 % of 100, and more than 5 once in a thousand runs.
    assert refused <= 5 if known else refused >= 30


def test_a_signal_that_is_the_same_in_both_halves_is_no_gain_drift(bench):
    found = bench.findings(bench.signs * (bench.t @ THETA), THETA)
    assert found.contradict(DiagnosisSettings())
    effect = GAIN.fitted(1e-3 * THETA, np.eye(2) * 1e-9)
    halves = next(one for one in found.comparisons[0] if one.kind == "halves")
    assert halves.slices == ("half1", "half2")
    assert np.allclose(halves.amplitudes, [1.0, -1.0], atol=0.1)
    words = contradiction(found, [GAIN], [effect], DiagnosisSettings().consistency_level)
    assert "0.22" in words
    assert "−0.2" in words


def test_an_effect_that_only_one_part_shows_is_absent_by_the_odds(bench):
    signal = np.where(np.arange(16) % 8 < 4, bench.t @ THETA, 0.0)
    findings = bench.findings(signal, THETA)
    assert findings.odds >= DiagnosisSettings().absence_odds


def test_odds_against_an_effect_allow_for_the_error_of_its_amplitude(bench):
    """Its amplitude in the other part is 1 only within the error of the fit, whose variance adds to its own."""
    signal = np.where(np.arange(16) % 8 < 4, bench.t @ THETA, 0.0)
    tested = Slices(bench.ensemble, signal, 8, ("half1", "half2"), 24, DiagnosisSettings())
    action, found = Action.of(bench.t @ THETA, bench.t, THETA, np.linalg.inv(bench.t.T @ bench.t)), []
    for error in (0.1, 0.4):
        (own,) = tested.findings([GAIN], [replace(action, error=error)]).comparisons
        found.append(next(one for one in own if one.kind == "halves"))
    distance = 0.5 - found[0].amplitudes[1]  # from half way between absent and as fitted
    variances = [distance / np.log(one.odds) for one in found]
    assert variances[1] - variances[0] == pytest.approx(0.4**2 - 0.1**2, rel=1e-6)


def test_odds_are_over_the_number_of_comparisons_that_tell_them():
    """Each of several has the chance of large ones; a map against all of the data tells none."""
    ones = (1.0, 1.0)
    halves, degrees = (Comparison(kind, ("a", "b"), ones, ones, 1.0, odds) for kind, odds in (("h", 60.0), ("d", 2.0)))
    of_map = Comparison("map", ("a",), (1.0,), (1.0,), 1.0, 1e9)
    assert Findings(((halves, of_map), (degrees,))).odds == pytest.approx(30.0)
    assert Findings(((of_map,),)).odds == 1.0


def test_what_an_effect_leaves_in_the_maps_is_tested(bench):
    extra = np.where(np.arange(16) == 9, 8.0, 0.0)
    (left,) = bench.findings(bench.t @ THETA + extra, THETA).maps
    assert left.maps == ("W1 half1", "W1 half2")
    assert left.pvalue < 1e-4
    (right,) = bench.findings(bench.t @ THETA, THETA).maps
    assert right.pvalue > 0.5
    # Chance is zero here, of which fitted columns take one each on average.
    assert right.before - right.after == pytest.approx(right.forecast - 2.0, rel=0.005)


def test_what_a_drawn_pattern_leaves_in_the_maps_is_its_own(bench):
    """Sources add to the largest scales of the maps, each sky other ones; their mean response says nothing of it."""
    sources = Candidate(systematics.get("point_sources"), None, (0, 1))
    extra = np.where(np.arange(16) == 9, 8.0, 0.0)
    found = bench.findings(bench.t @ THETA + extra, THETA, candidate=sources)
    assert found.maps == ()
    assert not any(one.kind == "map" for own in found.comparisons for one in own)


def test_more_noise_is_more_in_all_degrees_and_in_pixels():
    """Stripes raise the power of the difference of splits where they are; power scatters more where there is more."""
    elements = [power(f"difference/{low}", (low, high)) for low, high in ((2, 12), (13, 24))]
    elements += [Element(f"noise/{fold}", "noise", ("W1",), fold=fold, kind="noise") for fold in (0, 1)]
    elements.append(Element("residual", "map", ("W1",), ell=(0, 0), L=0, M=0, kind="residual", frame="ecliptic"))
    drawn, empty = np.random.default_rng(5).normal(size=(400, 5)), np.zeros((0, 5))
    ensemble = NullEnsemble(drawn, np.zeros(5), tuple(elements), empty, empty, empty, empty, empty)
    white, stripes = np.array([5.0, 15.0, 10.0, 10.0, 0.0]), np.array([0.0, 22.0, 10.0, 10.0, 0.0])

    def refused(z, growth):
        tested = Slices(ensemble, z, 1, ("half1", "half2"), 24, DiagnosisSettings())
        action = Action(white, np.zeros((5, 0)), 0.05, growth=growth, wider=growth)
        (own,) = (found := tested.findings([LOUDER], [action])).comparisons
        (degrees,) = (one for one in own if one.kind == "degrees")
        assert degrees.slices == ("ℓ 0–12", "ℓ 13–24", "single pixels")
        # Differences of splits have both of them.
        assert [one.slices for one in own if one.kind == "halves"] == [("even pixels", "odd pixels")]
        return found.contradict(DiagnosisSettings())

    assert not refused(white, 1.4)
    assert refused(stripes, 1.4)
    assert not refused(stripes, 5.0)
    # A part that shows half of it by chance is no sign that it is absent, if its power scatters as much more.
    assert not refused(np.array([0.0, 15.0, 10.0, 10.0, 0.0]), 4.0)


def test_parts_with_more_noise_contradict_an_effect_as_seldom_as_the_levels_say():
    """Of three times the noise, which few simulations without it weight: its chi^2 is nine times as large."""
    draw, draws, empty = np.random.default_rng(15), 300, np.zeros((0, 24))
    elements = tuple(power(f"{k}", (2, 12) if k < 12 else (13, 24)) for k in range(24))
    settings, white, found = DiagnosisSettings(consistency_error=1e-6), np.full(24, 5.0), []
    action = Action(white, np.zeros((24, 0)), 0.05, growth=3.0, wider=3.0)
    for _ in range(draws):
        ensemble = NullEnsemble(draw.normal(size=(60, 24)), np.zeros(24), elements, *[empty] * 5)
        z = white + 3.0 * np.sqrt(1.0 + 1.0 / 60.0) * draw.normal(size=24)
        (own,) = Slices(ensemble, z, 0, ("half1", "half2"), 24, settings).findings([LOUDER], [action]).comparisons
        found += [one.pvalue for one in own if one.kind == "degrees"]
    assert len(found) == draws
    for level in (0.05, 0.2, 0.5):
        assert abs(np.mean(np.array(found) <= level) - level) < 4.0 * np.sqrt(level * (1.0 - level) / draws), level


@pytest.mark.parametrize(("growth", "counts"), [(1.0, False), (1.4, True)])
def test_a_part_counts_at_half_the_snr_if_the_effect_is_one_on_noise(growth, counts):
    ensemble = NullEnsemble(
        np.random.default_rng(16).normal(size=(400, 2)),
        np.zeros(2),
        (power("low", (2, 12)), power("high", (13, 24))),
        *[np.zeros((0, 2))] * 5,
    )
    response = np.array([10.0, 0.75 * DiagnosisSettings().slice_snr])
    tested = Slices(ensemble, response, 0, ("half1", "half2"), 24, DiagnosisSettings())
    (own,) = tested.findings([LOUDER], [Action(response, np.zeros((2, 0)), 0.1, growth=growth)]).comparisons
    assert [one.slices for one in own if one.kind == "degrees"] == [("ℓ 0–12", "ℓ 13–24")] * counts


def power(name, ell):
    """The power of the difference of splits in a range of degrees."""
    return Element(name, "cl", ("W1",), ell=ell, L=0, kind="difference")


@pytest.mark.parametrize("p", [0.2, 0.01, 1e-5])
def test_a_pvalue_makes_a_set_less_probable_by_its_bound_at_most(p):
    # p-values of an alternative that are a p^(a-1), 0 < a <= 1, are the more probable ones by 1/bound at most.
    a = np.linspace(1e-4, 1.0, 100_000)
    check = MapCheck(("W1",), 1.0, 1.0, 1.0, 1, p)
    assert Findings(maps=(check,)).bound == pytest.approx(1.0 / np.max(a * p ** (a - 1.0)), rel=1e-6)
    comparison = Comparison("halves", ("a", "b"), (1.0, 1.0), (1.0, 1.0), 1.0, odds=50.0)
    assert Findings(((comparison,),)).bound == pytest.approx(0.02)
    assert Findings().bound == 1.0


def test_nothing_contradicts_an_effect_that_no_part_measures():
    """As an error of the noise level: neither parts nor the largest scales are compared."""
    assert not Findings(comparisons=((),)).contradict(DiagnosisSettings())


@pytest.mark.parametrize("name", sorted(systematics.catalogue()))
def test_every_parameter_has_a_bound_with_its_source(name):
    kind = systematics.get(name)
    bounded = {one.parameter for one in kind.bounds}
    # Texts are settings, tuples are directions, and any angle is possible.
    free = {f.name for f in fields(kind) if isinstance(f.default, str | tuple) or f.name.endswith("_deg")}
    assert bounded | free == {f.name for f in fields(kind)}
    assert all(one.source and one.low < one.high for one in kind.bounds)
    assert kind(amplitude=kind.step).within_bounds().amplitude == kind.step


@pytest.mark.parametrize(("quadrupole", "error", "possible"), [(27.0, 0.5, False), (1.4, 0.5, True), (0.3, 0.1, True)])
def test_a_ring_has_one_sign(quadrupole, error, possible):
    """As fitted to a calibration error: a ring of -1.6e-4 of the peak with a quadrupole of 27 times itself."""
    ring = Candidate(systematics.get("beam_sidelobe"), "W1", (0, 1), {"calibrated": "none"})
    a = -1.6e-4
    coordinates = np.array([a * (1.0 - quadrupole), a * quadrupole])
    # The sum of both is known to a percent, the share of the second to an error.
    along, across = np.array([1.0, 1.0]), np.array([1.0, -1.0])
    covariance = (0.01 * a) ** 2 / 4 * np.outer(along, along) + (error * a) ** 2 * np.outer(across, across)
    distance = ring.beyond(coordinates, covariance)
    assert np.isfinite(distance) == possible
    fitted = ring.fitted(coordinates, covariance)
    assert abs(fitted.quadrupole) <= 1.0
    if abs(quadrupole) > 1.0 and possible:
        assert 0.0 < distance < BEYOND
        assert fitted.quadrupole == 1.0
    elif possible:
        assert distance == 0.0


def test_the_ring_of_one_sign_that_is_nearest_has_an_amplitude_of_its_own():
    """Of (-2, 5) the sum is 3: a ring of q = 1 and this sum is (0, 3), but the nearest one is (0, 5)."""
    ring = Candidate(systematics.get("beam_sidelobe"), "W1", (0, 1), {"calibrated": "none"})
    coordinates, covariance = 1e-5 * np.array([-2.0, 5.0]), 4e-10 * np.eye(2)
    fitted = ring.fitted(coordinates, covariance)
    assert (fitted.amplitude, fitted.quadrupole) == (pytest.approx(5e-5, rel=1e-9), 1.0)
    assert ring.beyond(coordinates, covariance) == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize(
    ("along", "across", "possible"),
    [(0.0, 0.0027, False), (0.05, 0.0, True), (-0.003, 0.0018, True), (0.003, -9e-4, True)],
)
def test_an_orbital_dipole_is_late_by_an_hour_at_most(along, across, possible):
    """Towards the Sun it is nearly a monopole: a monopole of S/N 7 was a set with one that is four hours late."""
    dipole = Candidate(systematics.get("orbital_dipole"), "W1", (0, 1))
    coordinates, covariance = np.array([along, across]), np.diag([4e-4, 4e-4]) ** 2
    distance = dipole.beyond(coordinates, covariance)
    assert np.isfinite(distance) == possible
    fitted = dipole.fitted(coordinates, covariance)
    found = dipole.parametrization.coordinates(fitted)
    assert abs(found[1]) <= LATE * (1.0 + 1e-9)
    assert fitted.within_bounds() is fitted
    if abs(across) <= LATE:
        assert distance == 0.0
        np.testing.assert_allclose(found, coordinates, rtol=1e-12)
