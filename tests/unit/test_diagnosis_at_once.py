"""Effects that change each other's responses are simulated at once."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mcsim.diagnosis.partial import PartialSearch
from mcsim.diagnosis.refine import Refiner
from mcsim.diagnosis.responses import Responses
from mcsim.diagnosis.selection import Selection, attribute
from pushes import Instrument


def test_effects_that_change_each_other_are_simulated_together():
    instrument = Instrument(bend=0.0, cross=0.06)
    x = instrument.response(12.0, 14.0)
    plain = attribute(Selection(instrument.null, x, instrument.t, instrument.candidates, instrument.calibration))
    assert plain.verdict == "unknown"
    found = instrument.refined(x).attribution
    assert instrument.analysis[-1].keys() == {"A", "B"}
    assert (found.verdict, found.explanations[0].members) == ("mixture", (0, 1))
    assert found.explanations[0].fit.amplitudes == pytest.approx([12.0, 14.0], abs=0.5)


@pytest.mark.parametrize(
    ("cross", "last"), [(0.0, {"B"}), (0.06, {"C"})], ids=["at the end", "beside what is detected"]
)
def test_no_set_is_named_before_each_member_is_simulated(monkeypatch, cross, last):
    instrument, run = Instrument(bend=0.0, cross=cross), PartialSearch.run
    x = instrument.response(12.0, 14.0) + (8.0 * instrument.t[:, 2] if cross else 0.0)
    monkeypatch.setattr(Refiner, "_to_try", lambda *_: [])
    monkeypatch.setattr(PartialSearch, "run", lambda *own: replace(run(*own), members=(0, 1)))
    found = instrument.refined(x).attribution
    assert found.explanations[0].members == ((0, 1, 2) if cross else (0, 1))
    assert last in [one.keys() for one in instrument.analysis]


def test_two_that_change_each_other_are_simulated_together_before_they_are_named():
    """Their product, 3 of 50 standard deviations, is no reason to look for anything else."""
    instrument = Instrument(bend=0.0, cross=3.0 / (12.0 * 14.0))
    found = instrument.refined(instrument.response(12.0, 14.0))
    (best,) = found.attribution.explanations
    assert best.members == (0, 1)
    assert best.fit.chi2 == pytest.approx(0.0, abs=0.1)
    both = found.templates[:, :2] @ best.fit.amplitudes
    assert both @ instrument.sideways[1] == pytest.approx(3.0, abs=0.1)


def test_what_a_pair_is_at_once_is_not_lost_where_others_are_tried():
    """A is simulated by itself again. The products of A and B are 12 standard deviations; C is 3 from both together."""
    instrument = Instrument(bend=0.0, cross=12.0 / (12.0 * 14.0))
    x = instrument.response(12.0, 14.0)
    t = instrument.refined(x).templates.copy()
    near = x + 3.0 * instrument.sideways[0]
    t[:, 2] = near / np.linalg.norm(near)
    found = instrument.refined(x, [(0,)], t).attribution
    assert [one.members for one in found.explanations] == [(0, 1), (2,)]


def test_what_a_pair_is_at_once_is_not_undone_round_by_round(monkeypatch):
    """Each is simulated by itself before both are, and not again."""
    instrument = Instrument(bend=0.0, cross=40.0 / (12.0 * 14.0))
    x = instrument.response(12.0, 14.0)
    monkeypatch.setattr(instrument, "changes_sky", lambda tables: True)
    monkeypatch.setattr(Refiner, "_completed", lambda self, now, found: found)
    data = SimpleNamespace(context=instrument.context, x=x, gap=None, respond=instrument.respond, pair=instrument.pair)
    data.changes_sky = instrument.changes_sky
    now = Responses(instrument.t, instrument.t.copy(), instrument.candidates)
    ((_, found),) = Refiner(data)._in_place(now, 2, [(0, 1)])
    assert [len(one) for one in instrument.analysis] == sorted(len(one) for one in instrument.analysis)
    assert found.explanations[0].members == (0, 1)


@pytest.mark.parametrize(
    ("truth", "straight", "first"),
    [
        pytest.param((12.0, 14.0), 8.0, 8.0, id="that swing: 12 is 18 by the secant of 8, and 8 by that of 18"),
        pytest.param((100.0, 90.0), 97.7, 102.36, id="that move by less than 5 %, which is 2.7 errors"),
    ],
)
def test_amplitudes_of_squares_settle_at_once(truth, straight, first):
    """The response to A is its square over ``straight``, and its template at first the secant of ``first``."""
    instrument = Instrument(bend=0.0, cross=0.0)
    linear = instrument.response
    instrument.response = lambda a, b: linear(a * abs(a) / straight, b)
    data = SimpleNamespace(context=instrument.context, x=instrument.response(*truth), respond=instrument.respond)
    t = instrument.t * [first / straight, 1.0, 1.0]
    exact = PartialSearch(data).together(instrument.candidates, t, (0, 1))
    assert instrument.null.fit(data.x, exact[:, :2]).amplitudes == pytest.approx(truth, abs=0.2)


def test_the_template_of_a_prior_is_not_that_of_all_at_once():
    instrument = Instrument(bend=0.0, cross=12.0 / (12.0 * 14.0))
    x = instrument.response(12.0, 14.0)
    for nuisance in (False, True):
        candidates = [instrument.candidates[0], replace(instrument.candidates[1], nuisance=nuisance)]
        data = SimpleNamespace(context=instrument.context, x=x, respond=instrument.respond)
        now = Responses(instrument.t, instrument.t.copy(), candidates)
        assert Refiner(data)._join(now, (0, 1)) is not nuisance
        assert np.array_equal(now.t, instrument.t) is nuisance
