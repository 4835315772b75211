"""No set of effects is named that was not compared in parts of the data."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mcsim import systematics
from mcsim.datavector.candidate import Candidate
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis import naming
from mcsim.diagnosis.consistency import Findings, MapCheck
from mcsim.diagnosis.selection import Attribution, Explanation
from mcsim.stats.gaussian import Fit


def data_of(context):
    """Return data of which no place stands out."""
    return SimpleNamespace(context=context, stands_out_beside=lambda found: False)


def test_a_set_behind_others_that_parts_contradict_is_compared_too(monkeypatch):
    """Only so many agreeing sets are compared; those that fall away do not count."""
    settings, compared = DiagnosisSettings(), []
    candidates = [Candidate(systematics.get("calibration"), channel, (k,)) for k, channel in enumerate("ABCDEF")]
    assert len(candidates) > settings.compared_sets + 1
    fit = Fit(np.array([0.1]), np.eye(1) * 1e-6, 100.0, 100.0, 0.0, 1.0, 10, 0.5)
    each = tuple(Explanation((k,), fit, 1.0 / (k + 1), 0.5, 0.5) for k in range(len(candidates)))
    found = Attribution("degenerate", None, each, 0, 1.0, (fit,) * len(each), (), 1.0)
    bad = Findings(maps=(MapCheck(("A",), 9.0, 9.0, 1.0, 1, 1e-9),), comparisons=((),))

    def findings(members, actions):
        compared.extend(one.channel for one in members)
        return bad

    monkeypatch.setattr(naming, "slices_of", lambda data: SimpleNamespace(findings=findings))
    monkeypatch.setattr(naming, "_actions", lambda *_: [])
    monkeypatch.setattr(naming, "_of_splits", lambda *_: [()])
    context = SimpleNamespace(settings=settings, candidates=candidates, run=SimpleNamespace(channels=[]))
    agreed, sentences = naming.agreeing(data_of(context), SimpleNamespace(templates=None), found)
    assert compared == list("ABCDEF")
    assert agreed.verdict == "unknown"
    assert len(sentences) == len(each)


def of_two(monkeypatch, odds, probability, pvalue):
    """Return what is left of two sets, the first of which parts of the data contradict with a p-value."""
    candidates = [Candidate(systematics.get("calibration"), channel, (k,)) for k, channel in enumerate("AB")]
    fit = Fit(np.array([0.1]), np.eye(1) * 1e-6, 100.0, 100.0, 0.0, 1.0, 10, 0.5)
    each = tuple(Explanation((k,), fit, own, 0.5, 0.5) for k, own in enumerate((1.0, odds)))
    found = Attribution("degenerate", None, each, 0, 1.0, (fit, fit), (), probability)
    bad = Findings(maps=(MapCheck(("A",), 9.0, 9.0, 1.0, 1, pvalue),), comparisons=((),))
    results = iter([bad, Findings(comparisons=((),))])
    monkeypatch.setattr(naming, "slices_of", lambda data: SimpleNamespace(findings=lambda *_: next(results)))
    monkeypatch.setattr(naming, "_actions", lambda *_: [])
    monkeypatch.setattr(naming, "_of_splits", lambda *_: [()])
    context = SimpleNamespace(settings=DiagnosisSettings(), candidates=candidates, run=SimpleNamespace(channels=[]))
    return *naming.agreeing(data_of(context), SimpleNamespace(templates=None), found), bad


@pytest.mark.parametrize(("odds", "verdict"), [(1e-3, "effect"), (1e-5, "unknown")])
def test_what_is_left_is_named_if_it_is_probable_without_what_fell_away(odds, verdict, monkeypatch):
    """0.9999 of the probability was that of two sets, and the better one falls away."""
    left, sentences, _ = of_two(monkeypatch, odds, 0.9999, 1e-30)
    assert left.verdict == verdict
    assert [one.members for one in left.contradicted] == ([(0,)] if verdict == "effect" else [(0,), (1,)])
    np.testing.assert_allclose(left.probability, 0.9999 * odds / (0.9999 * odds + 1e-4 * (1.0 + odds)), rtol=1e-6)
    assert len(sentences) == (1 if verdict == "effect" else 2)


def test_what_fell_away_keeps_as_much_probability_as_the_parts_leave_it(monkeypatch):
    """A p-value of 1e-4 makes a set 400 times less probable at most: it may have been that one all the same."""
    left, _, bad = of_two(monkeypatch, 0.5, 0.999, 1e-4)
    assert 0.002 < bad.bound < 0.003
    assert [one.members for one in left.contradicted] == [(0,)]
    own, rest = 0.999 * 0.5 / 1.5, 0.999 * bad.bound / 1.5
    np.testing.assert_allclose(left.probability, own / (own + rest + 0.001), rtol=1e-9)


def test_where_nothing_is_left_nothing_is_compared():
    """With rivals of one split beside an unlisted effect, no set describes the data."""
    found = Attribution("unknown", None, (), 0, 1.0, (), (), 0.0)
    assert naming.agreeing(None, None, found) == (found, [])


def test_a_set_that_an_effect_outweighs_is_refused_in_a_sentence_that_names_both():
    candidates = [Candidate(systematics.get("calibration"), channel, (k,)) for k, channel in enumerate("ABC")]
    fit = Fit(np.array([0.1]), np.eye(1) * 1e-6, 100.0, 100.0, 0.0, 1.0, 10, 0.5)
    gap, context = SimpleNamespace(pvalue=1e-9), SimpleNamespace(settings=DiagnosisSettings(), candidates=candidates)
    whole = Attribution("mixture", gap, (Explanation((0, 1), fit, 1.0, 0.5, 0.5),), 2, 1.0, (), (), 0.01, rival=2)
    found, (sentence,) = naming.probable(context, SimpleNamespace(attribution=whole))
    assert (found.verdict, found.faint) == ("unknown", False)
    assert all(one.title in sentence for one in candidates)
    assert "0.99" in sentence
    whole = replace(whole, rival=None)
    found, sentences = naming.probable(context, SimpleNamespace(attribution=whole))
    assert (found.faint, sentences) == (True, [])
    whole = replace(whole, probability=0.9)
    assert naming.probable(context, SimpleNamespace(attribution=whole)) == (whole, [])
