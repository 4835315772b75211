"""No set of effects is named that was not compared in parts of the data."""

from types import SimpleNamespace

import numpy as np

from mcsim import systematics
from mcsim.datavector.candidate import Candidate
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis import naming
from mcsim.diagnosis.consistency import Findings, MapCheck
from mcsim.diagnosis.selection import Attribution, Explanation
from mcsim.stats.gaussian import Fit


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
    context = SimpleNamespace(settings=settings, candidates=candidates, run=SimpleNamespace(channels=[]))
    agreed, sentences = naming.agreeing(SimpleNamespace(context=context), None, found)
    assert compared == list("ABCDEF")
    assert agreed.verdict == "unknown"
    assert len(sentences) == len(each)
