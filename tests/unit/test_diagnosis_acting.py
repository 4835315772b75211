"""Sets of effects that scatter the data: how probable they are, and what they add beside what is drawn."""

from dataclasses import replace

import numpy as np
import pytest

from benches import Bench, P, twelve_and_two
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.selection import Selection, attribute
from mcsim.stats.detection import log_evidence
from mcsim.stats.scattered import Acting


@pytest.fixture(scope="module")
def bench() -> Bench:
    return twelve_and_two()


def test_an_effect_that_scatters_the_data_is_probable_although_it_leaves_much(bench):
    """All elements vary 2.5 times as much with it as without it, beside an S/N of 30."""
    growth, columns = 2.5**2 - 1.0, P - 1
    excess = np.full(len(bench.candidates), growth)
    own = Acting(size=900.0, chi2=growth * columns, spread=growth**2 * columns, excess=excess, error=0.01 * excess)
    candidates = [replace(bench.candidates[0], acting=own), *bench.candidates[1:]]
    named = 0
    for seed in range(20):
        x = 30.0 * bench.t[:, 0] + 2.5 * np.random.default_rng(seed).normal(size=P)
        found = attribute(Selection(bench.null, x, bench.t, candidates, bench.calibration))
        found = found.if_named(DiagnosisSettings())
        named += found.verdict == "effect" and found.explanations[0].members == (0,)
    # 94 % by the levels of both tests, less three sigma.
    assert named >= 16


def test_what_an_effect_adds_to_the_scatter_counts_over_that_of_what_is_drawn(bench):
    """Both scatter the data along one template: with the other in the data the effect hardly adds to chi^2."""
    rng, t = np.random.default_rng(9), bench.t
    before = rng.normal(size=(24, P))
    pair = before, before + 30.0 * t[:, 0] + np.outer(3.0 * rng.normal(size=24), t[:, 1])
    columns = [one.columns for one in bench.candidates]
    acting = replace(bench.candidates[0], acting=Acting.of(bench.null, t, columns, 0, pair))
    drawn = replace(bench.candidates[1], scatter=np.outer(t[:, 1], 5.0 * rng.normal(size=24)))
    each = [acting, drawn, *bench.candidates[2:]]
    x = bench.null.mean + t[:, :2] @ [30.0, 30.0]
    alone, beside = Selection(bench.null, x, t, each, bench.calibration, DiagnosisSettings()).searches[:2]
    assert beside.scattered == (1,)
    assert alone.candidates[0].acting.chi2 > 4.0
    assert beside.candidates[0].acting.chi2 < 0.3 * alone.candidates[0].acting.chi2


@pytest.mark.parametrize("size", [1, 2, 3])
def test_sets_of_any_size_share_the_prior_of_all_drawings_of_their_members(bench, size):
    """Of C^k ordered drawings of k candidates k! give the same set."""
    x, settings = 9.0 * bench.t[:, 0] + 7.0 * bench.t[:, 1], DiagnosisSettings()
    (search, *_) = Selection(bench.null, x, bench.t, bench.candidates, bench.calibration, settings).searches
    members = np.arange(size)[None]
    solved, columns = search.solve(members), int(search.groups.sizes[members].sum())
    fall = search.total - solved.chi2
    evidence = log_evidence(bench.null, search.total, fall, columns, settings.prior_snr)
    prior = float(np.exp(solved.evidence - evidence)[0])
    assert prior == pytest.approx([1.0, 2.0, 6.0][size - 1] / len(bench.candidates) ** size)
