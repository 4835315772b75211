"""Products of maps: what a pattern that is drawn and a signal that is not add to them together."""

from dataclasses import dataclass, replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from mcsim.datavector.candidate import Candidate, crossed_by, scatters_of
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.crossed import cross, together
from mcsim.diagnosis.selection import Selection, attribute
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.stats.look_elsewhere import calibrate
from mcsim.systematics import Effect, Parametrization

P, SKIES = 40, 48
RNG = np.random.default_rng(31)
SIGNAL = RNG.normal(size=P) * (np.arange(P) < P // 2)  # half of the elements are of another channel
PATTERNS = RNG.choice([-1.0, 1.0], size=(SKIES, P))  # their squares are known


@dataclass(frozen=True, kw_only=True)
class Steady(Effect):
    """The same signal in every sky."""

    name = "steady"
    scope = "channel"
    unit = "uK"
    cause = signature = ""
    step = 1.0


@dataclass(frozen=True, kw_only=True)
class Drawn(Steady):
    """A pattern of its own in every sky."""

    name = "drawn"
    parametrization = Parametrization(stochastic=True)


class Squares:
    """Data are squares of maps, with noise of variance one."""

    def __init__(self) -> None:
        self.null = SimulatedGaussian.from_simulations(np.random.default_rng(32).normal(size=(900, P)))
        self.context = SimpleNamespace(null=self.null, settings=DiagnosisSettings())
        self.x, self.asked = np.zeros(P), []

    def typical(self, tables, skies, acting):
        assert [table.name for table in acting] == ["drawn", "steady"]
        self.asked.append([table.name for table in tables])
        parts = {"steady": SIGNAL, "drawn": PATTERNS[:skies]}
        maps = sum(float(table.parameters["amplitude"]) * parts[table.name] for table in tables)
        return np.broadcast_to(maps**2, (skies, P))

    def scatter(self, changes):
        return (changes - changes.mean(axis=0)).T / np.sqrt(len(changes) - 1.0)


@pytest.fixture
def data() -> Squares:
    return Squares()


CANDIDATES = [Candidate(Drawn, "A", (0,), scatter=np.zeros((P, SKIES))), Candidate(Steady, "A", (1,))]


def parts(drawn: float, steady: float):
    return [(0, np.array([drawn]), np.eye(1) * 1e-4), (1, np.array([steady]), np.eye(1) * 1e-4)]


def tables(drawn: float, steady: float):
    return [
        one.table(kind(amplitude=size))
        for one, kind, size in zip(CANDIDATES, (Drawn, Steady), (drawn, steady), strict=True)
    ]


def test_two_signals_scatter_squares_by_twice_their_product(data):
    expected = data.scatter(2.0 * 0.5 * 3.0 * PATTERNS * SIGNAL)
    assert together(data, *tables(0.5, 3.0)) == pytest.approx(expected, abs=1e-12)


def test_what_they_scatter_is_left_out_where_it_is_little(data):
    assert together(data, *tables(0.01, 0.1)) is None
    assert len(data.asked) == 3  # in few skies


def test_skies_whose_number_is_given_are_simulated_once(data, monkeypatch):
    """As those of measured spectra, which are as many as there are of reference."""
    typical = data.typical
    monkeypatch.setattr(data, "typical", lambda own, skies, acting: typical(own, 24, acting))
    assert together(data, *tables(0.5, 3.0)).shape == (P, 24)
    assert len(data.asked) == 3


def test_a_candidate_knows_what_it_does_with_others_until_these_move(data):
    candidates, drawn = [*CANDIDATES], {}
    assert cross(data, candidates, drawn, parts(0.5, 3.0))
    assert list(candidates[0].crossed) == [1]
    assert not candidates[1].crossed
    before = len(data.asked)
    assert not cross(data, candidates, drawn, parts(0.52, 2.9))
    assert len(data.asked) == before
    assert cross(data, candidates, drawn, parts(0.5, 6.0))
    assert candidates[0].crossed[1] == pytest.approx(together(data, *tables(0.5, 6.0)))
    assert cross(data, candidates, drawn, parts(0.01, 0.1))
    assert not candidates[0].crossed


def test_a_pair_that_two_sets_have_is_drawn_where_the_first_has_it(data):
    candidates, drawn = [*CANDIDATES], {}
    assert cross(data, candidates, drawn, parts(0.5, 3.0))
    assert not cross(data, candidates, drawn, parts(0.5, 6.0), kept=(2, 1, 0))
    assert candidates[0].crossed[1] == pytest.approx(together(data, *tables(0.5, 3.0)))
    assert cross(data, candidates, drawn, parts(0.5, 6.0), kept=(0, 2))


def test_one_pattern_scatters_with_several_at_once(data):
    """Of two opposite signals there is nothing; as if each had a pattern of its own, there was twice one of them."""
    own = data.scatter(PATTERNS * SIGNAL)
    one = replace(CANDIDATES[0], crossed={1: own, 2: -own})
    candidates = [one, *(Candidate(Steady, name, (k,)) for k, name in enumerate("AB", 1))]
    (_, both) = scatters_of(candidates, (0, 1, 2))
    assert not both.any()
    (_, single) = scatters_of(candidates, (2, 0))
    assert single == pytest.approx(-own)


def test_two_that_draw_or_two_that_do_not_are_not_crossed(data):
    steady = [Candidate(Steady, "A", (0,)), Candidate(Steady, "B", (1,))]
    assert not cross(data, steady, {}, parts(0.5, 3.0))
    both = [CANDIDATES[0], Candidate(Drawn, "B", (1,), scatter=np.zeros((P, SKIES)))]
    assert not cross(data, both, {}, parts(0.5, 3.0))
    unknown = [Candidate(Drawn, "A", (0,)), CANDIDATES[1]]  # in sets without scatter its pattern counts as known
    assert not cross(data, unknown, {}, parts(0.5, 3.0))
    assert not data.asked


@pytest.mark.parametrize("known", [True, False])
def test_a_pair_suffices_with_what_both_scatter_together(data, known):
    """Squares of a map that has both have their products, far more than noise beside the two squares."""
    amplitudes = 2.0, 20.0
    response = np.column_stack([amplitudes[0] ** 2 * np.ones(P), (amplitudes[1] * SIGNAL) ** 2])
    candidates = [*CANDIDATES]
    if known:
        cross(data, candidates, {}, parts(*amplitudes))
    assert crossed_by(candidates, (0,)) == ([1] if known else [])
    assert crossed_by(candidates, (1,)) == []
    assert len(scatters_of(candidates, (0, 1))) == (2 if known else 1)
    assert len(scatters_of(candidates, (0,))) == 1
    calibration = calibrate(data.null, data.null.whiten_groups(response, [(0,), (1,)]))
    rng, suffices = np.random.default_rng(33), 0
    for pattern in rng.choice([-1.0, 1.0], size=(20, P)):
        x = (amplitudes[0] * pattern + amplitudes[1] * SIGNAL) ** 2 + rng.normal(size=P)
        selection = Selection(data.null, x, response / amplitudes, candidates, calibration)
        sets = [rows.tolist() for search in selection.searches for found in search.rows(2) for rows in found]
        assert sorted(map(sorted, sets)) == [[0, 1]]  # in one search alone
        suffices += [set(one.members) for one in attribute(selection).explanations] == [{0, 1}]
    assert suffices >= 18 if known else suffices <= 2


def test_every_set_is_searched_once_whatever_scatters_together(data):
    crossed = {place: np.ones((P, SKIES)) for place in (1, 2)}
    drawn = Candidate(Drawn, "A", (0,), scatter=np.ones((P, SKIES)), crossed=crossed)
    candidates = [drawn, *(Candidate(Steady, name, (k,)) for k, name in enumerate("ABC", 1))]
    t = np.random.default_rng(35).normal(size=(P, 4))
    calibration = calibrate(data.null, data.null.whiten_groups(t, [one.columns for one in candidates]))
    searches = Selection(data.null, data.x, t, candidates, calibration).searches
    for size in (1, 2, 3, 4):
        sets = [tuple(sorted(row)) for search in searches for rows in search.rows(size) for row in rows.tolist()]
        assert sorted(sets) == list(combinations(range(4), size))
    (wide,) = [search for search in searches if search.scattered == (0, 2)]
    assert {tuple(sorted(row)) for rows in wide.rows(3) for row in rows.tolist()} == {(0, 2, 3)}
