"""Detection beside other effects counts what the possible part of an amplitude explains."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from mcsim.datavector.candidate import Candidate, beyond, lost
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.partial import PartialSearch
from mcsim.stats.gaussian import Fit, SimulatedGaussian, nested_pvalue
from mcsim.stats.look_elsewhere import Calibration
from mcsim.stats.scattered import Acting
from mcsim.systematics import Bound, Effect, Parametrization

P = 6
FREE, LEVEL = np.inf, 0.05
SIGMA = 1.25
"""Error of the amplitude that is tested: the part of its template beside the other one has a norm of 0.8."""

NOMINAL = float(stats.norm.isf(LEVEL / 2.0))


class Known:
    """Two unit templates at a cosine of 0.6 on P normal elements of known covariance; the second is tested."""

    def __init__(self, low: float, high: float, sign: int = 0, simulations: int = 10_000_000) -> None:
        attributes = {"unit": "", "scope": "channel", "step": 1.0}
        bounds = (Bound("amplitude", low, high, "of a test"),)
        own = {**attributes, "name": "bounded", "bounds": bounds, "parametrization": Parametrization(sign=sign)}
        kinds = [type("free", (Effect,), {**attributes, "name": "free"}), type("bounded", (Effect,), own)]
        self.candidates = [Candidate(kind, None, (k,)) for k, kind in enumerate(kinds)]
        self.t = np.eye(P)[:, :2] @ [[1.0, 0.6], [0.0, 0.8]]
        null = SimulatedGaussian(np.zeros(P), np.eye(P), simulations)
        # The p-value of a candidate stands for the global one.
        calibration = Calibration(1, np.empty(0), np.empty(0))
        settings = replace(DiagnosisSettings(), partial_level=1.0, template_error=0.0)
        self.context = SimpleNamespace(null=null, calibration=calibration, settings=settings)

    def pvalue(self, z: float, besides: float = 0.0) -> float:
        """Return the p-value of the second template, at z errors beside the first, which is strong."""
        x = np.array([30.0, z, 0.0, 0.0, 0.0, besides])
        beside = PartialSearch(SimpleNamespace(context=self.context, x=x))._beside
        return float(beside(self.t, self.candidates, (0,))[1])


@pytest.mark.parametrize(
    ("low", "high", "sign", "found"),
    [
        (-FREE, FREE, 0, [(-FREE, -NOMINAL), (NOMINAL, FREE)]),
        (-20.0, 20.0, 0, [(-FREE, -NOMINAL), (NOMINAL, FREE)]),
        # Half of the mixture is chi^2 of no degree of freedom (Chernoff 1954): half the size.
        (0.0, FREE, 0, [(NOMINAL, FREE)]),
        (-FREE, FREE, 1, [(NOMINAL, FREE)]),
        # Within bounds of one error z^2 - (z - 1)^2 reaches the critical value later; beyond by three it is impossible.
        (-SIGMA, SIGMA, 0, [(-4.0, -(NOMINAL**2 + 1.0) / 2.0), ((NOMINAL**2 + 1.0) / 2.0, 4.0)]),
    ],
)
def test_size(low: float, high: float, sign: int, found: list[tuple[float, float]]) -> None:
    """Without the effect z is normal: nominal where no bound is near, half on a bound, less between near ones."""
    known = Known(low, high, sign)
    for z in np.linspace(-6.02, 6.02, 87):
        assert (known.pvalue(z) <= LEVEL) == any(first <= z <= last for first, last in found), z


def test_interior_amplitudes_are_found_as_without_bounds() -> None:
    free, bounded = Known(-FREE, FREE), Known(-20.0, 20.0)
    for z in np.linspace(0.0, 20.0 / SIGMA, 30):
        assert bounded.pvalue(z) == free.pvalue(z) == pytest.approx(2.0 * stats.norm.sf(z), rel=1e-3)


def test_the_largest_amplitude_is_found() -> None:
    """Half of the fits are beyond a bound that is the truth; their distance from it is of noise."""
    known = Known(-10.0, 10.0)
    for noise in (-3.0, -1.0, 0.0, 1.0, 2.9):
        assert known.pvalue(10.0 / SIGMA + noise) < 1e-5


@pytest.mark.parametrize(("besides", "count"), [(0.0, 10_000_000), (40.0, 500)])
def test_an_impossible_amplitude_explains_what_its_possible_part_does(besides: float, count: int) -> None:
    """Whatever the data hold besides: errors that this doubles are not the measure of a distance."""
    known, free = Known(-0.5 * SIGMA, 0.5 * SIGMA, 0, count), Known(-FREE, FREE, 0, count)
    z = 3.4
    # Half an error is possible: chi^2 falls by z^2 - (z - 0.5)^2.
    fall, left = z**2 - (z - 0.5) ** 2, (z**2 + besides**2) / (1.0 + 1.0 / count)
    expected = nested_pvalue(fall / (1.0 + 1.0 / count), left, 1, P - 1, count - 1)
    assert known.pvalue(z, besides) == pytest.approx(float(expected), rel=1e-6)
    assert free.pvalue(z, besides) < 0.5 * known.pvalue(z, besides)
    # More than three errors beyond is not this effect at all.
    assert known.pvalue(3.6 if besides == 0.0 else 7.6, besides) == 1.0


def bounded_pair() -> list[Candidate]:
    """Two candidates that can be up to one, in a fit whose errors are one."""
    bounded = Known(-1.0, 1.0).candidates[1]
    return [bounded, replace(bounded, columns=(1,))]


def fitted(*amplitudes: float) -> Fit:
    return Fit(np.array(amplitudes), np.eye(2), 12, 0.0, 1.0, 10.0, 10, 1.0)


def test_what_makes_another_member_impossible_is_lost() -> None:
    candidates = bounded_pair()
    # Errors are those of a Student t: their squares are (n + chi^2)/(dof - 2) = 3 times those of the fit's metric.
    assert lost(candidates, (0, 1), fitted(2.5, 3.0), 20) == pytest.approx(3.0 * 2.0**2)
    assert lost(candidates, (0, 1), fitted(5.0, 0.5), 20) == np.inf


def test_a_fit_is_beyond_bounds_by_errors_with_what_the_effect_scatters() -> None:
    candidates = bounded_pair()
    assert beyond(candidates, (0, 1), fitted(2.5, 3.0)) == pytest.approx(2.5)
    none = np.zeros(2)
    for own, expected in ((3.0, 2.5 / 2.0), (-0.75, 2.5)):  # less scatter makes no error less
        acting = [replace(one, acting=Acting(1.0, 0.0, 0.0, none, none, own)) for one in candidates]
        assert beyond(acting, (0, 1), fitted(2.5, 3.0)) == pytest.approx(expected)
