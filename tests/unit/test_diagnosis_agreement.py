"""If mcsim's own simulation agrees with that of somebody else, and how far found noise moves chi^2."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from mcsim import systematics
from mcsim.datavector.candidate import Candidate, numbered
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.agreement import agreement
from mcsim.diagnosis.found_noise import _moved
from mcsim.stats.gaussian import SimulatedGaussian, held_out_pvalues
from mcsim.stats.look_elsewhere import calibrate, global_test

P, SKIES = 12, 40


def compared(shift: float, offset: float = 0.0):
    """Compare with simulations that have a calibration of V beside mcsim's; the default route lacks an offset."""
    rng = np.random.default_rng(4)
    candidates = numbered([Candidate(systematics.get("calibration"), channel, (0,)) for channel in "VW"])
    t = 1e4 * np.eye(P)[:, :2]
    simulations = rng.normal(size=(600, P)) + shift * t[:, 0]
    mean = simulations.mean(axis=0)
    of_mean = SimulatedGaussian.from_simulations(mean + (simulations - mean) / np.sqrt(SKIES))
    null = SimulatedGaussian.from_simulations(simulations)
    ensemble = SimpleNamespace(
        of_mean=lambda _: SimpleNamespace(gaussian=of_mean),
        reference=rng.normal(size=(SKIES, P)) - offset * t[:, 1],
        own_offset=offset * t[:, 1] if offset else None,
        held_out_pvalues=lambda one: held_out_pvalues(simulations, one),
    )
    calibration = calibrate(null, null.whiten_groups(t, [one.columns for one in candidates]), draws=2000)
    source = SimpleNamespace(effects=("calibration", "beam_width"), label="the other")
    context = SimpleNamespace(
        ensemble=ensemble, analysis=SimpleNamespace(source=source), candidates=candidates, templates=t, null=null,
        calibration=calibration, settings=DiagnosisSettings(), frame="ecliptic",
    )  # fmt: skip
    return agreement(context), context, of_mean


@pytest.mark.parametrize(("shift", "said"), [(0.02, "2 %"), (-0.02, "−2 %")])
def test_what_the_other_simulations_have_beside_mcsims_is_told_with_its_sign(shift, said) -> None:
    found, *_ = compared(shift)
    assert not found.agrees
    assert (found.simulator, found.skies, found.effects) == ("the other", SKIES, ("calibration",))
    assert found.nearest == f"calibration of V (about {said} of the gain)"


def test_the_less_probable_of_mean_and_scatter_counts_as_one_of_two() -> None:
    found, known, of_mean = compared(0.0)
    own = known.ensemble.reference
    groups = of_mean.whiten_groups(known.templates, [(0,), (1,)])
    mean = global_test(of_mean, own.mean(axis=0), groups, known.calibration).pvalue
    others = known.ensemble.held_out_pvalues(known.null)
    scatter = stats.ks_2samp([known.null.pvalue(x) for x in own], others).pvalue
    assert found.pvalue == pytest.approx(1.0 - (1.0 - min(mean, scatter)) ** 2, rel=1e-9)
    assert found.agrees == (found.pvalue > known.settings.agreement_level)


def test_a_simulator_that_is_like_either_route_agrees() -> None:
    """Skies of the time-ordered reference, which an offset beside those of the default route makes."""
    assert compared(0.0, offset=0.02)[0].agrees


def test_noise_moves_chi2_by_the_change_of_its_mean_over_its_scatter() -> None:
    """Of twice the variance in 50 elements: from 50 to 100, where chi^2 scatters by 10."""
    rng, size = np.random.default_rng(6), 50
    null, before = SimulatedGaussian(np.zeros(size), np.eye(size), 10**9), rng.normal(size=(2000, size))
    moved = _moved(null, before, 7.0 + np.sqrt(2.0) * before)
    # The variance of 100,000 numbers is known to 0.45 %.
    assert moved == pytest.approx(5.0, rel=0.02)
    assert _moved(null, np.sqrt(2.0) * before, before) == pytest.approx(moved)
