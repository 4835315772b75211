"""Effects on request take the place of a member of a named set only where the data cannot tell them apart."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mcsim.datavector.candidate import Candidate, TemplateBank, numbered
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.refine import Refined
from mcsim.diagnosis.rivals import _in_other_splits, in_place
from mcsim.diagnosis.selection import Selection, attribute
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.stats.look_elsewhere import calibrate
from mcsim.systematics import Effect, Parametrization

P, N, S = 40, 600, 12.0


def candidate(name: str, channel: str | None, sign: int = 0) -> Candidate:
    attributes = {"name": name, "unit": "", "step": 1.0, "parametrization": Parametrization(sign=sign)}
    return Candidate(type(name, (Effect,), attributes), channel, (0,))


@pytest.fixture(scope="module")
def named() -> SimpleNamespace:
    """Data with one effect of S/N 12, "b" of channel V1, named alone among three."""
    rng = np.random.default_rng(5)
    t = np.linalg.qr(rng.normal(size=(P, 5)))[0]
    null = SimulatedGaussian.from_simulations(rng.normal(size=(N, P)))
    candidates = numbered([candidate("a", "V1"), candidate("b", "V1"), candidate("c", None)])
    groups = null.whiten_groups(t[:, :3], [one.columns for one in candidates])
    x = S * t[:, 1] + rng.normal(size=P)
    found = attribute(Selection(null, x, t[:, :3], candidates, calibrate(null, groups, draws=2000)))
    assert [one.members for one in found.explanations] == [(1,)]
    return SimpleNamespace(null=null, x=x, t=t, refined=Refined(found, t[:, :3], candidates, t[:, :3]))


@pytest.mark.parametrize(
    ("cosine", "channel", "sign", "is_rival"),
    [
        (1.0, "V1", 0, True),
        (0.99, "V1", 0, True),
        (0.7, "V1", 0, False),  # leaves half of 144
        (1.0, None, 0, True),
        (-1.0, "V1", 1, False),  # would need an amplitude of the wrong sign
    ],
)
def test_what_leaves_as_little_is_a_rival(named, cosine, channel, sign, is_rival):
    response = cosine * named.t[:, [1]] + np.sqrt(1.0 - cosine**2) * named.t[:, [4]]
    rivals = [(candidate("other", channel, sign), response)]
    assert list(in_place(named.null, named.x, named.refined, (1,), rivals, DiagnosisSettings())) == [(0, ())] * is_rival


@pytest.mark.parametrize(("beside", "is_rival"), [(0.0, False), (1.0, True)])
def test_numbers_beside_the_data_vector_tell_a_rival_from_a_member(named, beside, is_rival):
    """In the data vector both are the same; ten numbers beside it hear the member alone, or both."""
    rng = np.random.default_rng(7)
    t = np.zeros((10, 3))
    t[0, 1] = 0.5
    null = SimulatedGaussian.from_simulations(rng.normal(size=(N, P + 10)))
    z = np.concatenate([named.x, S * t[:, 1] + rng.normal(size=10)])
    refined = replace(named.refined, templates=np.concatenate([named.refined.templates, t]))
    response = np.concatenate([named.t[:, [1]], beside * t[:, [1]]])
    rivals = [(candidate("other", "V1"), response)]
    assert list(in_place(null, z, refined, (1,), rivals, DiagnosisSettings())) == [(0, ())] * is_rival


def test_a_rival_takes_the_place_of_as_many_members_as_it_can(named):
    """Alone, if it explains what two do; else beside one of them, unless it has to replace both."""
    settings, three = DiagnosisSettings(), named.refined
    x = named.x + S * named.t[:, 0]
    both = named.t[:, [0]] + named.t[:, [1]]
    rivals = [(candidate("both", "V1"), both), (candidate("one", "V1"), named.t[:, [1]])]
    found = list(in_place(named.null, x, three, (0, 1), rivals, settings))
    assert found == [(0, ()), (1, (0,))]
    assert list(in_place(named.null, x, three, (0, 1), rivals, settings, least=2)) == [(0, ())]


def test_columns_are_added_behind_those_of_a_bank():
    rng, labels = np.random.default_rng(6), candidate("a", None).labels
    matrix, more = rng.normal(size=(4, 1)), rng.normal(size=(6, 1))
    bank = TemplateBank(
        matrix, 0.1 * matrix, 0.2 * matrix, labels, np.array([0.3]), np.array([4.0]), rng.normal(size=(2, 1))
    )
    wide = bank.with_columns(candidate("b", None).labels, more)
    np.testing.assert_array_equal(wide.matrix, np.hstack([matrix, more[:4]]))
    np.testing.assert_array_equal(wide.slice_matrix, np.hstack([bank.slice_matrix, more[4:]]))
    assert not np.any(wide.error[:, 1])
    assert not np.any(wide.curvature[:, 1])
    assert wide.faint_share.tolist() == [0.3, 1.0]
    assert [one.effect for one in wide.labels] == ["a", "b"]
    assert not replace(bank, slice_matrix=np.zeros((0, 0))).with_columns(labels, more[:4]).slice_matrix.size


@pytest.mark.parametrize(("key", "both"), [("split", True), ("calibrated", False)])
def test_all_splits_that_explain_the_data_are_given(named, key, both):
    """In one channel an error of one half is one of the other with the other sign: it was named as one's for certain.

    Candidates that differ in another setting are one explanation, with what is most probable.
    """
    kind = candidate("b", "V1").effect
    one, other = (Candidate(kind, "V1", (0,), {key: name}) for name in ("half1", "half2"))
    assert [*_in_other_splits([(one, named.t[:, [1]]), (other, -named.t[:, [1]])], 0)] == [1] * both
    candidates = numbered([candidate("a", "V1"), one, other])
    near = 0.999 * named.t[:, [1]] + np.sqrt(1.0 - 0.999**2) * named.t[:, [4]]
    t = np.concatenate([named.t[:, :2], -near], axis=1)
    groups = named.null.whiten_groups(t, [each.columns for each in candidates])
    found = attribute(Selection(named.null, named.x, t, candidates, calibrate(named.null, groups, draws=2000)))
    assert sorted(each.members for each in found.explanations) == ([(1,), (2,)] if both else [(1,)])
