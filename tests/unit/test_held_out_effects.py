"""The reduction by an effect whose fit has more coordinates than what is free where it is frozen."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from mcsim import Effect
from mcsim.datavector.candidate import Candidate
from mcsim.datavector.null_ensemble import NullEnsemble
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.summaries import Element
from mcsim.diagnosis.context import DataSet
from mcsim.diagnosis.inference import reduction_of
from mcsim.systematics.parametrization import PowerLaw


@dataclass(frozen=True, kw_only=True)
class Dust(Effect):
    """A user's effect that draws nothing and has a spectral index."""

    name = "dust"
    scope = "common"
    unit = "uK"
    cause = "dust"
    signature = "of its frequencies"
    step = 1.0
    parametrization = PowerLaw(parameter="index", reference_ghz=94.0)

    index: float = 2.0

    def sky(self, sky, site, draw):
        return sky


def test_a_power_law_that_draws_nothing_has_a_reduction():
    rng = np.random.default_rng(7)
    elements = tuple(Element(f"power/{k}", "noise", ("W1",), fold=k // 4) for k in range(8))
    empty = np.zeros((0, 8))
    ensemble = NullEnsemble(rng.normal(size=(400, 8)), np.zeros(8), elements, empty, empty, empty, empty, empty)
    half = rng.normal(size=(4, 3))
    t, how = np.concatenate([half, half]), Dust.parametrization.seen_at([41.0, 61.0, 94.0])
    candidate = Candidate(Dust, None, (0, 1, 2), fit=how)
    coordinates = how.coordinates(Dust(amplitude=30.0, index=1.5))
    fit = replace(ensemble.gaussian.fit(t @ coordinates, t), amplitudes=coordinates)
    context = SimpleNamespace(
        candidates=[candidate],
        null=ensemble.gaussian,
        ensemble=ensemble,
        settings=DiagnosisSettings(),
        knows=lambda one: False,
    )
    data = SimpleNamespace(
        context=context,
        x=t @ coordinates,
        halves=lambda: (np.eye(8), "halves"),
        respond=lambda tables, skies: np.tile(t @ coordinates, (skies, 1)),
    )
    data.in_halves = lambda change: DataSet.in_halves(data, change)
    found = SimpleNamespace(explanations=[SimpleNamespace(members=(0,), fit=fit)])
    reduction = reduction_of(data, SimpleNamespace(attribution=found, templates=t, candidates=[candidate]))
    assert reduction is not None
    assert reduction.achieved.value == pytest.approx(1.0, abs=4.0 * reduction.achieved.sigma)


@pytest.mark.parametrize(("of_both", "in_each", "seen"), [(300.0, 10.0, True), (300.0, 2.0, False), (10.0, 3.0, True)])
def test_halves_that_see_an_effect_well_test_it_however_much_the_rest_sees(of_both, in_each, seen):
    """An S/N of 10 in each half is enough; of 2 beside 300 it is not, but 3 beside 10 is."""
    elements = tuple(Element(f"e{k}", "noise", ("W1",), fold=fold) for k, fold in enumerate((0, 1, None)))
    simulations = np.random.default_rng(8).normal(size=(4000, 3))
    empty = np.zeros((0, 3))
    ensemble = NullEnsemble(simulations, np.zeros(3), elements, empty, empty, empty, empty, empty)
    context = SimpleNamespace(ensemble=ensemble, null=ensemble.gaussian, settings=DiagnosisSettings())
    data = SimpleNamespace(context=context, x=np.zeros(3), halves=lambda: (np.eye(3), "halves"))
    assert (DataSet.in_halves(data, np.array([in_each, in_each, of_both])) is not None) == seen
