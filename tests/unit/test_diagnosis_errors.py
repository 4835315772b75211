"""Errors of fitted effects."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mcsim import config, systematics
from mcsim.datavector.candidate import Candidate, tables_beside
from mcsim.datavector.same_skies import SameSkies
from mcsim.diagnosis.assemble import effects_of
from mcsim.diagnosis.inference import _scattered
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.stats.gaussian import Fit, SimulatedGaussian
from mcsim.support.arrays import Matrix
from mcsim.systematics import Parametrization


def candidate_of(name: str) -> tuple[Candidate, int]:
    """An effect of W1, and the number of its components."""
    size = len(Candidate(systematics.get(name), "W1", ()).basis)
    return Candidate(systematics.get(name), "W1", tuple(range(size))), size


@pytest.mark.parametrize("name", ["beam_coma", "beam_ellipticity", "dipole_residual", "calibration"])
def test_an_amplitude_is_no_more_errors_from_zero_than_chi2_falls(name: str) -> None:
    rng = np.random.default_rng(1)
    candidate, size = candidate_of(name)
    mixing = np.eye(size) - 0.3
    covariance = 1e-6 * mixing @ mixing.T
    for theta in rng.multivariate_normal(np.zeros(size), covariance, 50):
        fall = float(theta @ np.linalg.solve(covariance, theta))
        [found] = effects_of([candidate], [0], Fit(theta, covariance, 1000, fall, 1.0, 0.0, 1, 1.0), "galactic")
        assert (found.amplitude / found.sigma) ** 2 <= fall * (1.0 + 1e-9)


def test_an_error_where_a_bound_fixes_a_parameter_is_that_along_the_bound() -> None:
    """Round part and quadrupole of a ring are fitted with strongly correlated errors; |quadrupole| is at most 1."""
    effect = systematics.get("beam_sidelobe")
    candidate = Candidate(effect, "W1", (0, 1))
    unit = effect.parametrization.coordinates(effect(amplitude=1.0, quadrupole=-1.0))
    covariance = np.diag([1e-5, 1e-6]) ** 2
    theta = 2e-5 * unit - np.array([1.8e-5, 0.0])  # two errors off: the quadrupole would be -10
    [found] = effects_of([candidate], [0], Fit(theta, covariance, 1000, 400.0, 1.0, 0.0, 1, 1.0), "galactic")
    assert found.parameters["quadrupole"] == -1.0
    assert found.sigma == pytest.approx(float(unit @ np.linalg.solve(covariance, unit)) ** -0.5, rel=1e-9)


def test_a_dipole_of_which_one_component_is_hardly_known_has_that_in_its_error() -> None:
    """Beside an uncertain calibration it is fitted across that of the sky: 11.8 uK along it were 3.2 +- 1.4 uK."""
    candidate, _ = candidate_of("dipole_residual")
    for hardly, sigma in ((1.4, 1.4), (8.5, (3.2**2 + 8.5**2) ** 0.5 + (3.2**2 + 1.4**2) ** 0.5 - 2.0 * 3.2)):
        found_at = Fit(np.array([3.2, 1e-9, 1e-9]), np.diag([1.4, hardly, 1.4]) ** 2, 1000, 100.0, 1.0, 0.0, 1, 1.0)
        [found] = effects_of([candidate], [0], found_at, "galactic")
        assert found.amplitude == pytest.approx(3.2)
        assert "longitude" in found.words
        assert found.words.endswith("(galactic)")
        assert found.sigma == pytest.approx(sigma, rel=1e-6)


def test_the_error_of_a_whole_number_is_in_its_own_unit() -> None:
    """Coordinates of a map-making that stops early are 1.5^n - 1, not n times those of one iteration."""
    effect = systematics.get("mapmaking_convergence")
    candidate, size = Candidate(effect, "W1", (0,)), 1.5**30
    found_at = Fit(np.array([size - 1.0]), np.array([[(0.1 * size) ** 2]]), 1000, 100.0, 1.0, 0.0, 1, 1.0)
    [found] = effects_of([candidate], [0], found_at, "galactic")
    assert found.amplitude == pytest.approx(30.0, abs=1e-6)
    assert found.sigma == pytest.approx(np.log(1.1 / 0.9) / (2.0 * np.log(1.5)), rel=1e-6)


@pytest.mark.parametrize(("name", "followed"), [("beam_coma", False), ("beam_ellipticity", True)])
def test_no_slope_is_taken_along_an_amplitude_that_the_effect_cannot_follow(name: str, followed: bool) -> None:
    """The four amplitudes of a coma have two parameters: slopes along each would make a singular matrix."""
    candidate, size = candidate_of(name)
    theta = candidate.parametrization.coordinates(candidate.effect(amplitude=0.02, angle_deg=20.0))
    found = Fit(theta, 1e-6 * np.eye(size), 1000, 400.0, 1.0, 0.0, 1, 1.0)
    tables = [table for _, table in tables_beside([candidate], [0], found, np.full((1, size), 1e9), 0.3)]
    assert [table is not None for table in tables] == size * [followed]


def test_each_effect_of_a_set_scatters_the_skies_in_which_its_response_is_measured() -> None:
    """Beside a spectrum, measured in typical skies, errors of a modulation were those of a sky that is not observed."""
    rng, size, skies = np.random.default_rng(8), 12, 8
    null, t = SimulatedGaussian(np.zeros(size), np.eye(size), 1_000_000), np.eye(size)[:, :2]
    mean = type("Spectrum", (systematics.get("calibration"),), {"parametrization": Parametrization(mean_response=True)})
    library = {"calibration": systematics.get("calibration"), "spectrum": mean}
    mean.name = "spectrum"
    candidates = [Candidate(kind, None, (k,)) for k, kind in enumerate(library.values())]
    analysis: Any = SimpleNamespace(library=library, model=SimpleNamespace(channels=("W1", "W2")))
    same = SameSkies(analysis, lambda _: [], ())
    asked: list[tuple[str, int | None]] = []

    def pair(found: list[config.Effect], number: int | None) -> tuple[Matrix, Matrix]:
        asked.append((" ".join(one.name for one in found), number))
        before = rng.normal(size=(skies, size))
        typical = 5.0 * rng.normal(size=(skies, size)) * (len(found) > 1)
        return before, (1.5 if found[0].name == "spectrum" else 1.0) * before + 20.0 * t[:, 0] + typical

    data: Any = SimpleNamespace(same_skies=same, pair=pair)
    data.in_same_skies = lambda found: ObservedMaps.in_same_skies(data, found)
    settings = SimpleNamespace(nonlinear_sigma=0.5, constrained_skies=8, strong_skies=24)
    known = {"null": null, "templates": t, "settings": settings}
    data.context = SimpleNamespace(candidates=candidates, knows=lambda table: False, **known)
    fit = null.fit(t @ [0.2, 0.1], t)
    found = _scattered(data, candidates, [0, 1], t, fit)
    # With the variance more than half as large again, more skies tell it.
    assert asked == [(name, number) for number in (None, 8, 24) for name in ("calibration", "spectrum")]
    # Noise that is 1.5 times as strong, and an eighth of what more is in the mean over as many skies.
    np.testing.assert_allclose(found.errors / fit.errors, np.sqrt(1.5**2 + 0.5**2 / skies), rtol=1e-9)
