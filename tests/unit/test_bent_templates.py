"""A strong effect whose response is more bent than straight is looked for where a parabola fits the data."""

from dataclasses import dataclass

import numpy as np
import pytest

from mcsim.datavector.bent import bent_templates
from mcsim.datavector.candidate import Candidate
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.systematics import Effect, Parametrization

P = 40
RNG = np.random.default_rng(17)
NULL = SimulatedGaussian.from_simulations(RNG.normal(size=(800, P)))
ALONG, BESIDE, OTHER, SQUARE, REST = np.linalg.qr(RNG.normal(size=(P, 5)))[0].T
T = np.stack([ALONG, BESIDE, OTHER], axis=1)


@dataclass(frozen=True, kw_only=True)
class OfTheBeam(Effect):
    """A vector of two components, all its power in the squares of the data, to which maps are in no proportion."""

    name = "vector"
    scope = "channel"
    unit = "uK"
    cause = signature = ""
    step = 1.0
    parametrization = Parametrization(max_amplitude=50.0)

    def beam(self, beam, site):
        return beam


@dataclass(frozen=True, kw_only=True)
class Vector(OfTheBeam):
    """The same, added to the sky."""

    def sky(self, sky, site, draw):
        return sky


@dataclass(frozen=True, kw_only=True)
class Drawn(Vector):
    parametrization = Parametrization(stochastic=True)


def bent(x, bend, kind=Vector):
    """Templates of a vector, and of another effect, whose response is straight."""
    curvature = np.outer(bend * (SQUARE + 0.3 * BESIDE), [1.0, 1.0, 0.0])
    return bent_templates(NULL, x, T, curvature, (Candidate(kind, "A", (0, 1)), Candidate(Vector, "B", (2,))))


def response(at, bend):
    return T[:, :2] @ at + bend * (SQUARE + 0.3 * BESIDE) * (at @ at)


@pytest.mark.parametrize("at", [(8.0, -5.0), (-3.0, 9.0), (-20.0, -20.0)])
def test_the_secant_is_that_of_the_true_amplitude(at):
    at, bend = np.array(at), 2.0
    x = response(at, bend) + RNG.normal(size=P)
    straight = NULL.fit(x, T[:, :2])
    assert np.abs(straight.amplitudes - at).max() > 20.0  # the square has most of it
    found = bent(x, bend)
    np.testing.assert_allclose(found[:, :2] @ at, response(at, bend), rtol=0, atol=0.02 * np.linalg.norm(x))
    np.testing.assert_allclose(NULL.fit(x, found[:, :2]).amplitudes, at, rtol=0, atol=2.0)
    np.testing.assert_array_equal(found[:, 2], T[:, 2])


def test_a_straight_fit_that_lies_far_below_is_no_reason_to_stay_straight():
    """A calibration of 3 % was fitted as one of 0.08 %, where nothing is bent, and a ring was named for it."""
    at, bend = np.array([6.0, -8.0]), 2.0
    x = bend * SQUARE * (at @ at) + RNG.normal(size=P)
    x += T[:, :2] @ (0.04 * at - NULL.fit(x, T[:, :2]).amplitudes)
    curvature = np.outer(bend * SQUARE, [1.0, 1.0, 0.0])
    found = bent_templates(NULL, x, T, curvature, (Candidate(Vector, "A", (0, 1)), Candidate(Vector, "B", (2,))))
    assert np.linalg.norm(NULL.fit(x, found[:, :2]).amplitudes) == pytest.approx(np.linalg.norm(at), rel=0.05)
    np.testing.assert_array_equal(found[:, 2], T[:, 2])


@pytest.mark.parametrize(("left", "taken"), [(0.4, True), (0.6, False)])
def test_a_parabola_that_leaves_more_than_half_is_chance(left, taken):
    """What neither the straight response nor its square explains is ``left`` of what the straight fit leaves."""
    at, bend = np.array([6.0, -8.0]), 2.0
    square = bend * SQUARE * (at @ at)
    x = square + np.sqrt(left / (1.0 - left) * (square @ square)) * REST
    x += T[:, :2] @ (0.04 * at - NULL.fit(x, T[:, :2]).amplitudes)
    found = bent_templates(NULL, x, T, np.outer(bend * SQUARE, [1.0, 1.0, 0.0]), (Candidate(Vector, "A", (0, 1)),))
    assert np.array_equal(found, T) is not taken


def test_a_parabola_that_fits_worse_than_the_straight_response_is_none():
    at = np.array([6.0, -8.0])
    np.testing.assert_array_equal(bent(T[:, :2] @ at + 20.0 * REST, 2.0), T)


@pytest.mark.parametrize(
    ("at", "bend", "kind"),
    [
        ((8.0, -5.0), 0.02, Vector),
        ((8.0, -5.0), 2.0, Drawn),
        ((8.0, -5.0), 2.0, OfTheBeam),
        ((60.0, 0.0), 2.0, Vector),
        ((0.0, 0.0), 2.0, Vector),
    ],
    ids=["hardly bent", "drawn", "of the beam", "impossible", "absent"],
)
def test_other_templates_stay(at, bend, kind):
    x = response(np.array(at), bend)
    np.testing.assert_array_equal(bent(x, bend, kind), T)
