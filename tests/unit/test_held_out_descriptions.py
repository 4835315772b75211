"""What describes a gap is told only if held-out data bear it out, with an amplitude that a part of the data can ask."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import kstest

from mcsim import systematics
from mcsim.datavector.candidate import Candidate
from mcsim.datavector.halves import Halves
from mcsim.datavector.null_ensemble import NullEnsemble
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.summaries import Element
from mcsim.diagnosis import unlisted
from mcsim.diagnosis.context import DataSet
from mcsim.diagnosis.inference import reduction_of
from mcsim.reconstruction.simulated_effects import Reconstruction
from mcsim.stats.excess import HeldOut, Measured
from mcsim.stats.gaussian import SimulatedGaussian


def held_out(before: float, after: float, predicted: float) -> HeldOut:
    share, error = 1.0 - after / before, 0.1
    return HeldOut(
        Measured(predicted, error), Measured(share, error), Measured(before, 40.0), Measured(after, 40.0), 0.5, "half2"
    )


@dataclass(frozen=True)
class Result:
    notes: tuple[str, ...] = ("first",)
    nuisances: tuple[object, ...] = ()
    unlisted: tuple[object, ...] | None = None
    unlisted_held_out: HeldOut | None = None


@pytest.mark.parametrize(
    ("before", "after", "predicted", "told"),
    [(349.0, 180.0, 0.5, True), (349.0, 39_692.0, 0.8, False), (349.0, 349.0, 0.8, False), (349.0, 349.0, 0.1, True)],
)
def test_what_held_out_data_refute_is_not_told(monkeypatch, before, after, predicted, told) -> None:
    """It raises the excess, or removes nothing where it should; where little is forecast nothing is refuted."""
    found, reduction = (SimpleNamespace(says="is noise, W alone"),), held_out(before, after, predicted)
    for name in ("scene_for", "search_of"):
        monkeypatch.setattr(unlisted, name, lambda *_: None)
    monkeypatch.setattr(unlisted, "structures_of", lambda *_: (found, reduction))
    analysis = SimpleNamespace(job=lambda _: None, run=None, nuisances=(), settings=DiagnosisSettings())
    data = SimpleNamespace(context=SimpleNamespace(analysis=analysis))
    result = unlisted.reconstructed(Result(), data, None)
    assert result.unlisted == (found if told else ())
    assert result.unlisted_held_out is (reduction if told else None)
    assert result.notes[0] == "first"
    assert len(result.notes) == (1 if told else 2)
    assert told or "is noise, W alone" in result.notes[1]


def test_amplitudes_of_a_part_stay_between_none_and_the_largest() -> None:
    """The nearest in the metric of the fit, together: what one may not explain, the other one does as far as it may."""
    null = SimulatedGaussian(np.zeros(4), np.eye(4), 10_000)
    first, second = np.arange(4), np.arange(4, 8)
    part = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    t = np.concatenate([part, part])
    x = t @ [9.6, 1.2, -1.4]
    asked: list[np.ndarray] = []

    def respond(frozen):
        asked.append(frozen.amplitudes)
        return t @ frozen.amplitudes

    free = Halves(x, null, null, first, second)
    assert free.reduction(t, respond, (), "half2").data == "half2"
    told = replace(free, largest=2.0).reduction(t, respond, (), "half2").data
    assert told == "half2, with 2.0 and 0.5 and 0.0 times its size, as the other half asks"
    np.testing.assert_allclose(asked[0], [9.6, 1.2, -1.4], atol=1e-9)
    # With the third at zero the second is what the data have in its place.
    np.testing.assert_allclose(asked[1], [2.0, 1.2 - 0.7, 0.0], atol=1e-6)


@pytest.mark.parametrize(("turned", "measured"), [(0.0, True), (1.0, False)])
def test_a_half_whose_fit_its_own_response_contradicts_measures_nothing(turned, measured) -> None:
    """Halves that see the power of two amplitudes alone; noise along the second is another power than what was fitted.

    Of a strong dipole in one map without splits 129, 273 and -98 uK were frozen in place of 60, 0 and 0.
    """
    rng, strength, across = np.random.default_rng(7), 0.01, np.array([600.0, -600.0, 600.0, -600.0])
    elements = tuple(Element(f"power/{k}", "noise", ("W1",), fold=k // 4) for k in range(8))
    empty = np.zeros((0, 8))
    ensemble = NullEnsemble(rng.normal(size=(400, 8)), np.zeros(8), elements, empty, empty, empty, empty, empty)
    t = np.stack([np.full(8, 20.0 / strength), np.tile(across, 2)], axis=1)
    amplitudes = np.array([strength, 0.0])
    x = t @ amplitudes + turned * 2.5 * strength * np.concatenate([across, np.zeros(4)])
    candidate = Candidate(systematics.get("gain_drift"), "W1", (0, 1))

    def respond(tables, skies):
        (table,) = tables
        return np.full((skies, 8), 20.0 * (table.parameters["amplitude"] / strength) ** 2)

    fit = replace(ensemble.gaussian.fit(x, t), amplitudes=amplitudes)
    context = SimpleNamespace(
        candidates=[candidate], null=ensemble.gaussian, ensemble=ensemble, settings=DiagnosisSettings()
    )
    data = SimpleNamespace(context=context, x=x, halves=lambda: (np.eye(8), "half2"), respond=respond)
    data.in_halves = lambda change: DataSet.in_halves(data, change)
    attribution = SimpleNamespace(explanations=[SimpleNamespace(members=(0,), fit=fit)])
    found = reduction_of(data, SimpleNamespace(attribution=attribution, templates=t, candidates=[candidate]))
    assert (found is not None) == measured
    assert not measured or found.achieved.value == pytest.approx(1.0, abs=0.1)


def test_names_of_effects_that_a_run_or_a_library_has_are_not_given_again():
    """An earlier description that the run names would be written over, and the run changed."""
    run = SimpleNamespace(effects=(SimpleNamespace(name="/out/unlisted_1.py"), SimpleNamespace(name="gain_drift")))
    analysis = SimpleNamespace(run=run, library=(("unlisted_3", None), ("calibration", None)))
    made = Reconstruction(SimpleNamespace(analysis=analysis), None, None, np.zeros(0), None)
    assert made.names == ("unlisted_2", "unlisted_4", "unlisted_5")


def test_errors_of_a_frozen_shape_are_no_departure_of_what_remains() -> None:
    """One half hardly tells two of six coordinates, the other one does: of such skies half had p < 0.01."""
    rng, null = np.random.default_rng(11), SimulatedGaussian(np.zeros(40), np.eye(40), 10_000)
    first, second = np.arange(40), np.arange(40, 80)
    templates = rng.normal(size=(80, 6))
    templates[:40, :2] *= 0.15
    theta = np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0])
    covariance = np.linalg.inv(templates[first].T @ templates[first])
    plain, told, forecast = [], [], []
    for _ in range(200):
        x = templates @ theta + rng.normal(size=80)
        fitted = covariance @ templates[first].T @ x[first]
        t = (templates @ fitted)[:, None]
        drawn = rng.multivariate_normal(np.zeros(6), covariance, 12).T
        halves = Halves(x, null, null, first, second)

        def respond(frozen, t=t):
            return t @ frozen.amplitudes

        plain.append(halves.reduction(t, respond).pvalue_after)
        found = halves.reduction(t, respond, shapes=[templates @ drawn])
        told.append(found.pvalue_after)
        before = found.before.value
        forecast.append((found.achieved.value - found.predicted.value) * before / (found.predicted.sigma * before))
    assert np.mean(np.array(plain) < 0.01) > 0.3
    # A noncentral spread of few directions is followed by its first two moments.
    assert abs(np.mean(np.array(told) < 0.05) - 0.05) < 4.0 * np.sqrt(0.05 * 0.95 / 200)
    assert kstest(told, "uniform").statistic < 0.15
    assert abs(np.mean(forecast)) < 4.0 / np.sqrt(200)
    assert np.std(forecast) < 1.5
