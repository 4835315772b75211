"""What a diagnosis says in words: the numbers in its sentences."""

from types import SimpleNamespace

import pytest

from mcsim.diagnosis import words
from mcsim.stats.excess import HeldOut, Measured


def sets(*odds: float) -> SimpleNamespace:
    """Return a result with sets of these odds, and two elements of the data vector."""
    elements = [SimpleNamespace(words="the first element"), SimpleNamespace(words="the second element")]
    return SimpleNamespace(sets=[SimpleNamespace(odds=one) for one in odds], elements=elements)


@pytest.mark.parametrize(
    ("separation", "said"),
    [
        (0.02, "More data of this kind cannot"),
        (0.1, "takes 3.29: 1.08 × 10³ times as much data of the second element."),
        (1.0, "takes 3.29: 10.8 times as much data of the second element."),
        (3.0, "takes 3.29: 1.2 times as much data of the second element."),
        (3.5, "the second has odds 0.2 against the first"),
    ],
)
def test_data_that_tell_two_sets_apart_grow_with_the_square_of_their_distance(separation, said) -> None:
    contrast = SimpleNamespace(separation=separation, first=1, second=2, elements=(1, 0))
    assert said in words.apart(sets(1.0, 0.5, 0.1), contrast)


def test_what_an_effect_removes_from_maps_is_a_fall() -> None:
    one = SimpleNamespace(maps=("V", "W"), before=250.0, after=200.0, forecast=45.0, pvalue=0.3)
    found = words.compared_parts(SimpleNamespace(effects=(), sets=[SimpleNamespace(maps=(one,))]))
    assert found == ["Largest scales of V and W: χ² falls by 50, 45 forecast; p = 0.3 of the rest"]


def an_effect(amplitude: float = -6.0, sigma: float = 0.5, pvalues: tuple[float, ...] = ()) -> SimpleNamespace:
    consistency = tuple(SimpleNamespace(pvalue=one) for one in pvalues)
    parts = tuple(f"part {number}" for number in range(len(pvalues)))
    return SimpleNamespace(
        label="offset of V", words="6 arcmin", amplitude=amplitude, sigma=sigma, consistency=consistency, parts=parts
    )


def a_set(pvalue: float = 0.6, further: float = 0.4, alone: float | None = None) -> SimpleNamespace:
    return SimpleNamespace(effects=(an_effect(),), pvalue=pvalue, further=further, pvalue_alone=alone, maps=())


def a_result(kind: str, **values: object) -> SimpleNamespace:
    every = {"orders": (), "faint": False, "nearest": 0, "candidates": [SimpleNamespace(label="gain of W")], "sets": ()}
    every |= {"contradicted": (), "partial": (), "partial_left": None, "unlisted": None, "nearest_pvalue": None}
    every |= {"test": SimpleNamespace(pvalue=1e-5, dimension=30), "cosine": 0.6, "places": (), "effects": ()}
    return SimpleNamespace(kind=kind, **(every | values))


@pytest.mark.parametrize(
    ("pvalue", "further", "reserved", "marginal"),
    [(0.6, 0.4, False, False), (0.03, 0.4, True, False), (0.6, 0.03, True, True), (0.03, 0.03, True, True)],
)
def test_a_further_candidate_that_is_nearly_significant_is_told(pvalue, further, reserved, marginal) -> None:
    text = words.status(a_result("effect", sets=(a_set(pvalue, further),)))
    assert ("with a reservation" in text) == reserved
    assert ("the most significant further candidate is marginal" in text) == marginal
    assert ("no further candidate is significant" in text) != marginal


@pytest.mark.parametrize(
    ("pvalue", "alone", "said"),
    [(0.5, 0.003, True), (0.5, 0.007, False), (0.5, 0.2, False), (0.004, 0.003, False), (0.5, None, False)],
)
def test_what_is_tolerated_is_told_where_a_residual_passes_by_it_alone(pvalue, alone, said) -> None:
    assert ("tolerated" in words.left_by(a_set(pvalue, alone=alone))) == said


def test_the_nearest_candidate_explains_the_square_of_its_cosine() -> None:
    text = words.status(a_result("unknown"))
    assert "cosine 0.60" in text
    assert "36 % of the excess" in text
    assert "of cases" not in text


@pytest.mark.parametrize(("count", "said"), [(1, False), (2, True)])
def test_what_is_detected_together_leaves_a_share_of_the_excess(count, said) -> None:
    result = a_result("unknown", partial=(an_effect(),) * count, partial_left=0.37)
    assert ("they leave 37 % of the excess χ²" in words.sentence(result)) == said


def test_sets_beyond_those_that_are_shown_are_counted() -> None:
    shown = words.SETS + 1
    for more, said in ((0, ""), (1, "; or with 1 more set."), (4, "; or with 4 more sets.")):
        text = words.sentence(a_result("degenerate", sets=(a_set(),) * (shown + more)))
        assert text.count("offset of V") == shown
        assert text.endswith(said or "offset of V (6 arcmin).")


def test_the_least_likely_comparison_and_amplitudes_over_their_errors_are_told(tmp_path) -> None:
    one = an_effect(pvalues=(0.5, 0.02, 0.9))
    found = a_result(
        "effect", case="case", sets=(a_set(),), effects=(one,), held_out=None, controls=None, agreement=None,
        maps=("V:a", "V:b"), provenance={}, elements=[SimpleNamespace(split=own, words="") for own in ("a", "b", None)],
        residual_maps=(), simulations=500, settings=SimpleNamespace(max_effects=3), excess=Measured(20.0, 9.0),
        places=[SimpleNamespace(element=SimpleNamespace(words="first"), z=4.0, p=0.01)],
        warnings=(), nuisances=(), notes=(), untested=(),
    )  # fmt: skip
    lines = words.summary(found, tmp_path)
    assert "parts agree   the least likely of 3 comparisons of amplitudes has p = 0.02" in lines
    assert "effect        offset of V: 6 arcmin; amplitude/error −12" in lines
    assert any("measured from 2 maps (2 splits); 500 simulations" in line for line in lines)
    assert any("χ² = 50 for 30 degrees of freedom" in line for line in lines)
    alone = SimpleNamespace(**(vars(found) | {"candidates": found.candidates[:1]}))
    assert words.tested(alone).endswith("; one candidate effect")
    assert "(1 splits)" not in words.tested(SimpleNamespace(**(vars(found) | {"elements": found.elements[::2]})))


def a_reduction(before: float, after: float, achieved: Measured, predicted: Measured) -> HeldOut:
    return HeldOut(predicted, achieved, Measured(before, 9.0), Measured(after, 8.0), 0.4, "half2")


@pytest.mark.parametrize(
    ("before", "sigmas", "said", "unsaid"),
    [
        (200.0, (0.05, 0.04), "90 % ± 5 % of the excess χ² of half2; 95 % ± 4 % was predicted", "uncertain"),
        (200.0, (0.05, 0.4), "90 % ± 5 % of the excess χ² of half2; what was predicted is too uncertain", "95"),
        (200.0, (0.4, 0.05), "Too uncertain to measure a reduction: excess χ² of half2 200 ± 9 before", "%"),
        (-200.0, (0.05, 0.05), "Too uncertain to measure a reduction: excess χ² of half2 −200 ± 9 before", "%"),
    ],
)
def test_fractions_that_are_too_uncertain_are_not_quoted(before, sigmas, said, unsaid) -> None:
    held_out = a_reduction(before, 20.0, Measured(0.9, sigmas[0]), Measured(0.95, sigmas[1]))
    text = words.held_out(SimpleNamespace(held_out=held_out))
    assert said in text
    assert unsaid not in text


def test_an_effect_that_is_refuted_raises_what_is_left_or_removes_little_of_it() -> None:
    removes = words.refuted(a_reduction(200.0, 160.0, Measured(0.2, 0.1), Measured(0.9, 0.1)))
    assert "removes 20 % of the excess χ² of the other half, where 90 % were predicted" in removes
    assert "from 200 to 300" in words.refuted(a_reduction(200.0, 300.0, Measured(-0.5, 0.1), Measured(0.9, 0.1)))


@pytest.mark.parametrize("agrees", [True, False])
def test_responses_are_approximate_where_simulators_disagree(agrees) -> None:
    found = SimpleNamespace(
        simulator="other", pvalue=0.2, agrees=agrees, skies=8, nearest="gain", effects=("pointing",)
    )
    text = words.agreement(found)
    assert ("approximate" in text) != agrees
    assert ("nearest to what is in other beside it is gain" in text) != agrees
    assert text.endswith("those of pointing are other's.")


@pytest.mark.parametrize(("pvalue", "said"), [(0.01, True), (0.02, False)])
def test_a_group_counts_up_to_its_level(pvalue, said) -> None:
    place = SimpleNamespace(element=SimpleNamespace(words="the first"), z=4.0, p=pvalue)
    result = a_result("none", places=(place,), settings=SimpleNamespace(place_pvalue=0.0123))
    assert ("the first (z = 4.0, p = 0.01" in words.status(result)) == said
