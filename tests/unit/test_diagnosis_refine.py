"""Responses at the amplitudes that were found: bent ones, and those of what draws its pattern."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from mcsim.datavector.candidate import Candidate
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.partial import has_settled
from mcsim.diagnosis.refine import Refiner, _nearly_best
from mcsim.diagnosis.responses import Responses
from mcsim.diagnosis.selection import Selection, attribute
from mcsim.errors import InputError
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.stats.look_elsewhere import calibrate
from mcsim.systematics import Bound, Parametrization
from pushes import Instrument, P, Push


@dataclass(frozen=True, kw_only=True)
class Bounded(Push):
    """One that ends at 12."""

    bounds = (Bound("amplitude", -12.0, 12.0, "a test"),)


class Unconstrained(Parametrization):
    def constrained(self, coordinates, precision):
        return 0.0 * coordinates


class Resolved(Parametrization):
    """What is measured below five standard deviations counts as nothing."""

    def constrained(self, coordinates, precision):
        return coordinates * (coordinates @ precision @ coordinates > 25.0)


@pytest.mark.parametrize("amplitude", [15.0, -15.0])
def test_a_bent_response_is_found_at_its_amplitude(amplitude):
    instrument = Instrument(bend=0.04, cross=0.0)
    x = instrument.response(amplitude, 0.0)
    plain = attribute(Selection(instrument.null, x, instrument.t, instrument.candidates, instrument.calibration))
    assert plain.verdict == "unknown"
    found = instrument.refined(x).attribution
    assert [explanation.members for explanation in found.explanations] == [(0,)]
    assert found.explanations[0].fit.amplitudes == pytest.approx([amplitude], abs=0.3)


class Steep(Instrument):
    """The response of A grows with the fifth power of its amplitude."""

    def response(self, a: float, b: float) -> np.ndarray:
        return self.t[:, 0] * (a + 3e-4 * a**5) + self.t[:, 1] * b


@pytest.mark.parametrize("amplitude", [6.0, 10.0, -13.0])
def test_the_amplitude_of_a_steep_response_is_where_its_secant_says_the_same(amplitude):
    """A straight line says up to 124, and the secant at that next to nothing, where the response is straight."""
    instrument = Steep(bend=0.0, cross=0.0)
    instrument.curvature = np.outer(instrument.t[:, 0], [0.03, 0.0, 0.0])
    found = instrument.refined(instrument.response(amplitude, 0.0)).attribution
    assert [explanation.members for explanation in found.explanations] == [(0,)]
    assert found.explanations[0].fit.amplitudes == pytest.approx([amplitude], abs=0.1)
    assert len(instrument.analysis) <= 8


def test_an_amplitude_at_its_bound_is_simulated_once():
    """The fit asks for 40, again and again; the effect ends at 12. Beside another it is found within, at 10."""
    instrument = Steep(bend=0.0, cross=0.0)
    instrument.candidates[0] = replace(instrument.candidates[0], effect=Bounded)
    found = instrument.refined(40.0 * instrument.t[:, 0]).attribution
    assert [list(tables) for tables in instrument.analysis[:3]] == [["A"], ["B"], ["C"]]
    assert instrument.analysis[0] == {"A": 12.0}
    assert [one.members for one in found.explanations] == [(0,)]
    assert found.explanations[0].fit.amplitudes == pytest.approx([10.0], abs=0.1)


@pytest.mark.parametrize(("along", "tried"), [(15.9, 15.5), (21.0, 3.9)])
def test_what_explains_nearly_as_much_as_the_best_is_tried_too(along, tried):
    """A is bent: its line explains 225 of 549, and C, which leaves something else, 253 or 441.

    Beside that A is tried at what it adds to C, once C alone has failed.
    """
    instrument = Instrument(bend=0.08, cross=0.0)
    instrument.settings = DiagnosisSettings(tried=1)
    x = instrument.response(15.0, 0.0)
    size = float(np.linalg.norm(x))
    instrument.t[:, 2] = along * x / size**2 + np.sqrt(1.0 - (along / size) ** 2) * instrument.sideways[1]
    found = instrument.refined(x).attribution
    assert [list(tables) for tables in instrument.analysis[:2]] == [["C"], ["A"]]
    assert instrument.analysis[1]["A"] == pytest.approx(tried, abs=0.1)
    assert [one.members for one in found.explanations] == [(0,)]


def test_a_rival_is_simulated_at_its_amplitude_though_another_is_named():
    """A is bent, which its templates do not know; C has the straight response that A has at this amplitude."""
    instrument = Instrument(bend=0.04, cross=0.0)
    instrument.curvature = np.zeros_like(instrument.curvature)
    x = instrument.response(15.0, 0.0)
    instrument.t[:, 2] = x / np.linalg.norm(x)
    assert [one.members for one in instrument.refined(x).attribution.explanations] == [(2,)]
    found = instrument.refined(x, sets=[(0,)]).attribution
    assert {one.members for one in found.explanations} == {(0,), (2,)}


@pytest.mark.parametrize(("beside", "members"), [(0.0, {(0,), (2,)}), (20.0, {(2,)})])
def test_what_is_like_a_name_is_simulated_where_its_response_bends(beside, members):
    """C has the response of A at its amplitude. Beside it A leaves 9^2, which its bend of 9 can be, or 9^2 + 20^2."""
    instrument = Instrument(bend=0.04, cross=0.0)
    x = instrument.response(15.0, 0.0) + beside * instrument.t[:, 1]
    instrument.t[:, 2] = x / np.linalg.norm(x)
    found = instrument.refined(x).attribution
    assert {one.members for one in found.explanations} == members
    assert any("A" in tables for tables in instrument.analysis) == ((0,) in members)


def test_what_is_like_a_name_is_simulated_where_its_bend_is_told_a_fifth_too_small():
    """It is that of other skies: of a calibration of S/N 113 it was 54 in place of 58, and a ring was named alone."""
    instrument = Instrument(bend=0.0125, cross=0.0)
    instrument.curvature *= 0.8
    x = instrument.response(60.0, 0.0)
    instrument.t[:, 2] = x / np.linalg.norm(x)
    assert {one.members for one in instrument.refined(x).attribution.explanations} == {(0,), (2,)}


@pytest.mark.parametrize(("crossed", "members"), [("A", {(0,), (2,)}), ("B", {(2,)})])
def test_what_is_like_a_name_is_simulated_where_it_responds_to_the_observed_sky(crossed, members):
    """C has the response of A in this sky, of which no curvature knows."""
    instrument = Instrument(bend=0.04, cross=0.0)
    instrument.curvature = np.zeros_like(instrument.curvature)
    instrument.crossed = crossed
    x = instrument.response(15.0, 0.0)
    instrument.t[:, 2] = x / np.linalg.norm(x)
    found = instrument.refined(x).attribution
    assert {one.members for one in found.explanations} == members
    assert any("A" in tables for tables in instrument.analysis) == (crossed == "A")


def test_what_is_like_a_member_is_simulated_where_a_set_suffices_by_tolerance_alone():
    """C has the response of A at its amplitude but for 0.9 %: 1 % is tolerated, which is ten standard deviations."""
    instrument = Instrument(bend=0.0005, cross=0.0)
    instrument.curvature = np.zeros_like(instrument.curvature)
    x = instrument.response(1000.0, 0.0)
    along = x / np.linalg.norm(x)
    instrument.t[:, 2] = along + 0.009 * instrument.sideways[1]
    plain = attribute(Selection(instrument.null, x, instrument.t, instrument.candidates, instrument.calibration))
    assert [one.members for one in plain.explanations] == [(2,)]
    assert plain.explanations[0].fit.pvalue < 1e-3 < 0.02 < plain.explanations[0].pvalue
    found = instrument.refined(x).attribution
    assert [one.members for one in found.explanations] == [(0,)]
    assert found.explanations[0].fit.amplitudes == pytest.approx([1000.0], rel=1e-3)
    # Where nothing has to be tolerated, nothing else is simulated.
    instrument.analysis.clear()
    instrument.t[:, 2] = along
    assert [one.members for one in instrument.refined(x).attribution.explanations] == [(2,)]
    assert all(list(tables) == ["C"] for tables in instrument.analysis)


def test_the_bent_response_of_one_of_two_is_not_explained_by_two_in_its_place():
    """A is bent, which its templates do not know. C and D together have the straight response that A has beside B."""
    instrument = Instrument(bend=0.04, cross=0.0)
    own = instrument.response(15.0, 0.0)
    x = own + 20.0 * instrument.t[:, 1]
    along, across = own / np.linalg.norm(own), instrument.sideways[1]
    instead = np.stack([along + across, along - across], axis=1) / np.sqrt(2.0)
    instrument.t = np.concatenate([instrument.t[:, :2], instead], axis=1)
    instrument.candidates = [Candidate(Push, name, (k,)) for k, name in enumerate("ABCD")]
    groups = instrument.null.whiten_groups(instrument.t, [(0,), (1,), (2,), (3,)])
    instrument.calibration, instrument.curvature = calibrate(instrument.null, groups), np.zeros((P, 4))
    instrument.settings = DiagnosisSettings(tried=1)
    plain = attribute(Selection(instrument.null, x, instrument.t, instrument.candidates, instrument.calibration))
    assert [one.members for one in plain.explanations] == [(1, 2, 3)]
    best, *_ = instrument.refined(x).attribution.explanations
    assert best.members == (0, 1)
    assert best.fit.amplitudes == pytest.approx([15.0, 20.0], abs=0.5)


def test_secants_of_a_power_do_not_swing_about_the_amplitude():
    """A response that is nearly all a square: each secant by itself would be as far on the other side."""
    instrument = Instrument(bend=0.5, cross=0.0)
    found = instrument.refined(instrument.response(40.0, 0.0)).attribution
    assert [explanation.members for explanation in found.explanations] == [(0,)]
    assert found.explanations[0].fit.amplitudes == pytest.approx([40.0], rel=1e-3)


@pytest.mark.parametrize(("noise", "verdict"), [(None, "unknown"), (1.2, "effect")])
def test_an_effect_may_leave_the_chi2_that_its_scatter_adds(noise, verdict):
    instrument = Instrument(bend=0.0, cross=0.0, noise=noise)
    scatter = np.random.default_rng(24).normal(size=P)
    # A residual 1.3 times as large as the noise of the model: below the level of 0.01.
    x = instrument.response(12.0, 0.0) + 1.3 * np.sqrt(P) * scatter / np.linalg.norm(scatter)
    assert instrument.refined(x).attribution.verdict == verdict


@pytest.mark.parametrize(("along", "faint"), [(2.9, True), (4.5, False)])
def test_a_faint_gap_has_the_odds_of_templates_that_were_known_before(along, faint):
    """The bend explains 3 more of the noise, which is no evidence for what was simulated at the amplitude of noise."""
    instrument = Instrument(bend=3.0 / along**2, cross=0.0)
    x = instrument.response(along, 0.0)
    plain = attribute(Selection(instrument.null, x, instrument.t, instrument.candidates, instrument.calibration))
    found = instrument.refined(x).attribution
    assert (found.gap.pvalue > instrument.settings.faint_pvalue) == faint
    assert found.verdict == "effect"
    if faint:
        assert found.probability == plain.probability < 0.8
    else:
        assert found.probability > max(plain.probability, 0.9)


def test_every_member_of_a_named_set_is_simulated_whatever_the_rounds():
    instrument = Instrument(bend=0.0, cross=0.0)
    instrument.settings = DiagnosisSettings(refine_rounds=0)
    assert [one.members for one in instrument.refined(instrument.response(12.0, 14.0)).attribution.explanations] == [
        (0, 1)
    ]
    assert [list(one) for one in instrument.analysis] == [["A"], ["B"]]


def test_what_is_none_of_the_library_stays_unknown_beside_two_that_are():
    instrument = Instrument(bend=0.0, cross=0.0)
    x = instrument.response(12.0, 14.0) + 10.0 * instrument.sideways[1]
    found = instrument.refined(x).attribution
    assert instrument.analysis[-1].keys() == {"A", "B"}
    assert found.verdict == "unknown"


def test_the_share_that_detected_effects_leave_is_that_of_unbiased_chi2():
    """Of few simulations chi^2 is larger on average, the less so the more simulations there are."""
    instrument, few, size = Instrument(bend=0.0, cross=0.0), 120, 16.0
    instrument.null = SimulatedGaussian(np.zeros(P), np.eye(P), few)
    groups = instrument.null.whiten_groups(instrument.t, [(0,), (1,), (2,)])
    instrument.calibration = calibrate(instrument.null, groups, draws=2000)
    x = instrument.response(1.5 * size, 2.0 * size) + size * instrument.sideways[1]
    found = instrument.refined(x).partial
    assert sorted(found.members) == [0, 1]
    # An inverse Wishart matrix of n degrees of freedom is n/(n - p - 1) times too large.
    scale = (few - 2.0 - P) / (few - 1.0) / (1.0 + 1.0 / few) * size**2
    assert found.left == pytest.approx((scale - (P - 2)) / (7.25 * scale - P), rel=1e-9)


def test_amplitudes_that_run_away_are_not_detected():
    """Of a response that turns back upon itself no amplitude is the one that the fit asks for."""
    instrument = Instrument(bend=0.0, cross=0.0)
    saturated = instrument.response
    instrument.response = lambda a, b: saturated(2.0 * np.tanh(a / 2.0), b)  # never more than 2 along A
    x = instrument.t[:, :2] @ [14.0, 12.0] + 10.0 * instrument.sideways[1]
    found = instrument.refined(x)
    assert found.attribution.verdict == "unknown"
    assert [instrument.candidates[member].channel for member in found.partial.members] == ["B"]


def test_what_data_tell_nothing_of_is_neither_detected_nor_simulated(monkeypatch):
    """However significant: an effect without an amplitude is none."""
    instrument = Instrument(bend=0.0, cross=0.0)
    x = instrument.response(12.0, 14.0) + 10.0 * instrument.sideways[1]
    monkeypatch.setattr(Push, "parametrization", Unconstrained())
    found = instrument.refined(x)
    assert found.attribution.verdict == "unknown"
    assert found.partial is None
    assert instrument.analysis == []


def test_half_of_an_effect_that_cannot_be_whole_is_as_significant(monkeypatch):
    """At half of the amplitude its error was four times that of this half, and what it has was no longer measured."""
    instrument = Instrument(bend=0.0, cross=0.0)
    respond, x = instrument.respond, instrument.response(12.0, 0.0)

    def limited(tables, skies):
        if float(tables[0].parameters["amplitude"]) > 10.0:
            raise InputError("too large")
        return respond(tables, skies)

    monkeypatch.setattr(Push, "parametrization", Resolved())
    monkeypatch.setattr(instrument, "respond", limited)
    instrument.refined(x)
    assert [amplitudes["A"] for amplitudes in instrument.analysis] == pytest.approx([6.0], abs=0.1)


@pytest.mark.parametrize(("snr", "error", "members"), [(8.0, 0.85, {(0,), (2,)}), (12.0, 0.01, {(2,)})])
def test_a_stochastic_effect_that_may_suffice_is_simulated_beside_a_single_one(monkeypatch, snr, error, members):
    """C leaves 0.3 of the S/N of what A has drawn for this very sky, which is far from what A does on average."""
    instrument = Instrument(bend=0.0, cross=0.0)
    kind = type("Draws", (Push,), {"parametrization": Parametrization(stochastic=True)})
    instrument.candidates[0] = Candidate(kind, "A", (0,), shape_error=error)
    instrument.t[:, 0] *= 0.5
    own, draws = instrument.t[:, 0] + np.sqrt(0.75) * instrument.sideways[0], np.random.default_rng(25).normal(size=48)
    instrument.t[:, 2] = np.sqrt(1.0 - 0.3**2) * own + 0.3 * instrument.sideways[1]
    drawn = instrument.t[:, 0] + np.sqrt(0.75) * draws[:, None] * instrument.sideways[0]

    def respond(tables, skies):
        (table,) = tables
        straight = np.tile(instrument.t[:, 2], (skies, 1))
        return float(table.parameters["amplitude"]) * (straight if table.channel == "C" else drawn[:skies])

    monkeypatch.setattr(instrument, "respond", respond)
    found = instrument.refined(snr * own).attribution
    assert {one.members for one in found.explanations} == members


def test_a_stochastic_effect_is_tried_where_nothing_explains_the_data(monkeypatch):
    """What A has drawn is 20 times its mean, which beside that is not significant, and C is like what was drawn."""
    instrument = Instrument(bend=0.0, cross=0.0)
    instrument.settings = replace(instrument.settings, tried=1)
    kind = type("Draws", (Push,), {"parametrization": Parametrization(stochastic=True)})
    instrument.candidates[0] = Candidate(kind, "A", (0,))
    mean, (across, beside) = instrument.t[:, 0], instrument.sideways
    instrument.t[:, 2] = 0.95 * across + np.sqrt(1.0 - 0.95**2) * beside
    drawn = mean + 20.0 * np.random.default_rng(25).normal(size=(48, 1)) * across

    def respond(tables, skies):
        (table,) = tables
        response = np.tile(instrument.t[:, 2], (skies, 1)) if table.channel == "C" else drawn[:skies]
        return float(table.parameters["amplitude"]) * response

    monkeypatch.setattr(instrument, "respond", respond)
    (found,) = instrument.refined(12.0 * (mean + 20.0 * across)).attribution.explanations
    assert found.members == (0,)
    assert found.fit.amplitudes == pytest.approx([12.0], abs=4.0 * found.fit.errors[0])


def test_the_response_to_what_draws_its_pattern_is_the_mean_of_its_draws():
    """Its template is known from few skies, a third of which is chance."""
    instrument, rng = Instrument(bend=0.0, cross=0.0), np.random.default_rng(25)
    kind = type("Draws", (Push,), {"parametrization": Parametrization(stochastic=True, mean_response=True)})
    instrument.candidates[0] = Candidate(kind, "A", (0,), shape_error=0.3)
    drawn = 40.0 * (instrument.t[:, 0] + 0.02 * rng.normal(size=(48, P)))
    first = instrument.t + 0.3 * np.outer(instrument.sideways[0], [1.0, 0.0, 0.0])
    data = SimpleNamespace(context=instrument.context, respond=lambda tables, skies: drawn, scatter=instrument.scatter)
    data.changes_sky = instrument.changes_sky
    now = Responses(first, first.copy(), instrument.candidates)
    assert Refiner(data)._simulate(now, 0, np.array([40.0]), np.eye(1))
    assert now.t[:, 0] == pytest.approx(drawn.mean(axis=0) / 40.0, abs=1e-12)


@pytest.mark.parametrize("enough", [3.0, 30.0], ids=["suffices alone", "does not"])
def test_a_stochastic_effect_is_tried_at_the_amplitude_that_it_has_alone(monkeypatch, enough):
    """Beside others its amplitude is 2, alone it is 14: that alone with the scatter of the latter suffices is found."""
    instrument, rng = Instrument(bend=0.0, cross=0.0), np.random.default_rng(25)
    kind = type("Draws", (Push,), {"parametrization": Parametrization(stochastic=True)})
    instrument.candidates[0] = Candidate(kind, "A", (0,))
    patterns = rng.normal(size=(48, P)) / np.sqrt(P)

    def respond(tables, skies):
        drawn = any(table.channel == "A" for table in tables)
        one = sum(float(table.parameters["amplitude"]) for table in tables)
        return one * (instrument.t[:, 0] + drawn * patterns[:skies])

    x = 14.0 * instrument.t[:, 0]
    pair = attribute(Selection(instrument.null, x, instrument.t, instrument.candidates, instrument.calibration))
    (one,) = pair.explanations
    set_fit = instrument.null.fit(x - 12.0 * instrument.t[:, 0], instrument.t[:, :2])

    def attributed(self, now):
        scatter = now.candidates[0].scatter
        if scatter is not None and np.sqrt(np.sum(scatter**2)) > enough:
            return pair
        return replace(pair, explanations=(replace(one, members=(0, 1), fit=set_fit),), verdict="mixture")

    monkeypatch.setattr(Refiner, "_attribute", attributed)
    monkeypatch.setattr(instrument, "respond", respond)
    found = instrument.refined(x)
    assert [own.members for own in found.attribution.explanations] == ([(0,)] if enough < 10.0 else [(0, 1)])


def test_what_was_simulated_far_away_in_a_set_is_tried_at_the_amplitude_that_it_has_alone(monkeypatch):
    """In a set that looks best at first A is 60; alone it is 15, as it is, and then C suffices as well as A."""
    instrument = Instrument(bend=0.04, cross=0.0)
    x = instrument.response(15.0, 0.0)
    instrument.t[:, 2] = x / np.linalg.norm(x)
    far = instrument.null.fit(x + 45.0 * instrument.t[:, 0], instrument.t[:, :2])

    def attributed(self, now):
        found = attribute(Selection(instrument.null, x, now.t, now.candidates, instrument.calibration))
        (best, *_) = found.explanations
        in_a_set = replace(found, explanations=(replace(best, members=(0, 1), fit=far),), verdict="mixture")
        return in_a_set if np.array_equal(now.t, instrument.t) else found

    monkeypatch.setattr(Refiner, "_attribute", attributed)
    found = instrument.refined(x).attribution
    assert instrument.analysis[0]["A"] == pytest.approx(60.0, abs=1.0)
    (own,) = [one for one in found.explanations if one.members == (0,)]
    assert own.fit.amplitudes == pytest.approx([15.0], abs=0.3)
    assert {one.members for one in found.explanations} == {(0,), (2,)}


def test_a_set_is_fitted_where_a_member_does_not_scatter_the_data() -> None:
    """Half of a direction that B scatters is along A, which would be 45 there."""
    instrument = Instrument(bend=0.0, cross=0.0)
    along = instrument.t[:, 0] + instrument.sideways[0]
    draws = np.random.default_rng(23).normal(size=12)
    scatter = 1000.0 * np.outer(along, draws - draws.mean()) / np.sqrt(11.0)
    candidates = [instrument.candidates[0], replace(instrument.candidates[1], scatter=scatter)]
    data = SimpleNamespace(context=instrument, x=5.0 * instrument.t[:, 0] + 40.0 * along)
    fit, parts = Refiner(data)._fitted(Responses(instrument.t, instrument.t, candidates), (0, 1))
    assert fit.amplitudes == pytest.approx([5.0, 0.0], abs=0.5)
    assert [part[0] for part in parts] == [0, 1]


def test_the_parts_of_a_set_are_tried_in_its_place(monkeypatch) -> None:
    tried: list[tuple[int, ...]] = []
    monkeypatch.setattr(Refiner, "_in_place", lambda self, now, size, sets: iter(tried.extend(sets) or ()))
    found = SimpleNamespace(explanations=[SimpleNamespace(members=(0, 1, 2)), SimpleNamespace(members=(3, 4, 5, 6))])
    now = SimpleNamespace()
    assert Refiner(SimpleNamespace())._with_smaller(now, found) == (now, found)
    assert tried[:3] == [(0, 1), (0, 2), (1, 2)]
    assert {len(one) for one in tried} == {2}


def test_those_that_explain_nearly_as_much_as_the_best_are_tried_up_to_twice_as_many() -> None:
    explained = np.array([10.0, 9.0, 8.5, 8.1, 7.0, 1.0])
    assert list(_nearly_best(explained, [0, 1, 2, 3, 4, 5], 2)) == [0, 1, 2, 3]
    assert list(_nearly_best(explained, [4, 5], 2)) == [4, 5]
    assert list(_nearly_best(explained, [1, 5], 1)) == [1]
    assert list(_nearly_best(explained, [], 2)) == []
    assert list(_nearly_best(explained, [0, 1], 0)) == []


@pytest.mark.parametrize(
    ("moved", "share", "settled"), [(0.5, 0.01, True), (2.0, 0.01, False), (0.2, 0.0, True), (0.5, 0.0, False)]
)
def test_amplitudes_settle_within_a_share_of_their_size_or_of_their_errors(moved, share, settled):
    """At 100 errors a share of 0.01 is one error."""
    settings, now = DiagnosisSettings(settled_sigma=0.3), np.array([5.0])
    assert has_settled(settings, now - 0.05 * moved, now, np.array([[0.05**2]]), share) == settled
