"""Amplitudes, probabilities and durations as people read them."""

from types import SimpleNamespace

import numpy as np
import pytest

import mcsim
from mcsim import systematics
from mcsim.datavector.candidate import Candidate
from mcsim.diagnosis import words
from mcsim.diagnosis.assemble import effects_of
from mcsim.diagnosis.fitted import CandidateResult
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.ensemble.describe import describe_prediction
from mcsim.information.result import Limits
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import Moments
from mcsim.stats.excess import HeldOut, Measured
from mcsim.support.numbers import duration, measured, number, probability
from refusals import refused


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (0.10034, 0.0098, "0.100 ± 0.010"),
        (1.1592, 0.0081, "1.159 ± 0.008"),
        (123.4, 12.0, "123 ± 12"),
        (-2.5e-7, 3e-8, "(−2.50 ± 0.30) × 10⁻⁷"),
        (-0.00001, 0.0039, "0.000 ± 0.004"),
        (0.3, 0.0, "0.3"),
        (float("nan"), 1.0, "–"),
    ],
)
def test_values_are_written_to_the_digits_of_their_errors(value, sigma, text):
    assert measured(value, sigma) == text


def test_tiny_probabilities_are_powers_of_ten():
    assert probability(1.04e-8) == "1 × 10⁻⁸"
    assert number(float("inf")) == "∞"


@pytest.mark.parametrize("name", systematics.catalogue())
def test_amplitudes_of_every_effect_are_printed_with_their_error(name):
    kind = systematics.get(name)
    effect = systematics.basis_of(kind)[0]
    assert "±" in effect.describe(0.1 * kind.step)
    assert "±" not in effect.describe()
    assert "_" not in kind.label("W1").replace("C_ℓ", "")


def test_amplitudes_have_the_units_that_people_read():
    ellipse, offset = (systematics.get(name) for name in ("beam_ellipticity", "pointing_offset"))
    assert ellipse(amplitude=0.1592, angle_deg=2.0).describe(0.0081) == (
        "axis ratio 1.159 ± 0.008 with the major axis along the scan"
    )
    assert offset(amplitude=1.53, angle_deg=178.0).describe(0.041) == "1.53′ ± 0.04′ against the scan"
    assert offset(amplitude=1.53, angle_deg=-37.0).direction() == "at −37° to the scan"
    assert systematics.get("noise_level").format_amplitude(-0.095, 0.01) == "9.5 % ± 1.0 % less noise"
    plain = type("Plain", (systematics.Effect,), {"name": "plain", "unit": "k of {k}", "__module__": __name__})
    assert plain.format_amplitude(0.00122, 0.00005) == "0.00122 ± 0.00005 (k of {k})"
    assert ellipse.label("W1") == "beam ellipticity of W1"


def test_an_amplitude_at_the_edge_of_the_possible_has_an_error():
    kind = systematics.get("spectrum")
    errors = np.array([0.2, 0.02, 0.02, 0.02, 0.02, 0.02])
    less_than_nothing = SimpleNamespace(amplitudes=np.array([-1.1, 0, 0, 0, 0, 0]), covariance=np.diag(errors**2))
    (found,) = effects_of([Candidate(kind, None, tuple(range(6)))], (0,), less_than_nothing, "galactic")
    assert found.amplitude == pytest.approx(0.99)
    # That of the fit: the data are 5.5 errors from none, whatever is possible.
    assert found.sigma == pytest.approx(0.2, rel=1e-3)


def test_what_data_do_not_tell_is_no_part_of_an_error():
    kind = systematics.get("spectrum")
    errors = np.array([0.02, 0.02, 0.02, 0.02, 0.02, 0.4])
    fitted = SimpleNamespace(amplitudes=np.array([0.3, 0, 0, 0, 0, 1.0]), covariance=np.diag(errors**2))
    (found,) = effects_of([Candidate(kind, None, tuple(range(6)))], (0,), fitted, "galactic")
    assert found.amplitude == pytest.approx(0.3)
    assert found.sigma == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.0456, "45.6 ms"), (1.53, "1.53 s"), (119.0, "119 s"), (150.0, "2.5 min"), (9000.0, "2.5 h"), (432000.0, "5 d")],
)
def test_durations_are_said_in_a_unit_that_people_use(seconds, words):
    assert duration(seconds) == words


@pytest.mark.parametrize(
    ("files", "why"), [((None, "text"), "No effect of the simulator"), (("text", None), "do not respond to it")]
)
def test_a_reduction_that_no_effect_can_make_is_said_so(files, why):
    """Further structures are what the first one leaves: without an effect of that, none is added."""
    noise = {"stage": "noise", "split": "half1"}
    found = tuple(SimpleNamespace(sentence="Something.", file=file, **noise) for file in files)
    said = words.unlisted(SimpleNamespace(unlisted=found, unlisted_held_out=None))[-1]
    assert why in said
    assert ("split_noise gives half1 noise of its own" in said) == (files[0] is None)


@pytest.mark.parametrize("found", [(), (SimpleNamespace(says="is proportional to the sky, W1 alone"),)])
def test_a_verdict_without_a_name_says_what_is_missing(found):
    nothing = {"faint": False, "orders": (), "contradicted": (), "partial": (), "partial_left": None}
    result = SimpleNamespace(kind="unknown", test=SimpleNamespace(pvalue=1e-9), unlisted=found, **nothing)
    assert words.sentence(result).endswith("is proportional to the sky, W1 alone.") == bool(found)


def test_coefficients_that_are_real_are_printed_without_what_rounding_leaves():
    """At M = 0 even parity is real and odd parity imaginary, whatever the size of the other part."""
    expected = mcsim.predict("tiny")
    plain = describe_prediction(expected)
    assert "j" not in plain
    for name in ("biposh_binned_mean", "biposh_difference_binned_mean"):
        expected[name] = expected[name] * (1.0 + 1e-9j)
    assert describe_prediction(expected) == plain
    swapped = expected.assign_coords(d=expected.d + 1)
    assert "j" in describe_prediction(swapped)


def test_results_print_as_a_line() -> None:
    """A diagnosis was 120,000 characters, most of them arrays."""
    sets = (SimpleNamespace(label="ellipticity of W1"), SimpleNamespace(label="coma of W1"))
    found = SimpleNamespace(case="first", kind="degenerate", test=SimpleNamespace(pvalue=1.234e-5), sets=sets)
    expected = "<DiagnosisResult first: degenerate, p = 1.2e-05, ellipticity of W1; or coma of W1>"
    assert DiagnosisResult.__repr__(found) == expected
    assert repr(Beam.gaussian(60.0, 100)) == "<Beam: lmax = 100, mmax = 0>"
    still = Moments.parallel_transport(nside=4, smax=2)
    assert repr(still) == "<Moments: nside = 4, ecliptic frame, smax = 2, 192 hits>"
    limits = SimpleNamespace(model="small", lines=lambda: ["effect  sigma", "gain  0.01"])
    assert Limits.__repr__(limits).splitlines() == ["<Limits of small>", "effect  sigma", "gain  0.01"]


@pytest.mark.parametrize(
    ("columns", "expected"), [((4,), ["gain"]), ((1, 2), ["gain, component 1", "gain, component 2"])]
)
def test_columns_of_a_candidate_have_names(columns, expected) -> None:
    assert CandidateResult.components.fget(SimpleNamespace(label="gain", columns=columns)) == expected


@pytest.mark.parametrize(("sigma", "quoted"), [(0.29, True), (0.97, False)])
def test_a_forecast_is_quoted_where_it_says_something(sigma: float, quoted: bool) -> None:
    """ "90 % ± 97 % was predicted" stood beside what was achieved."""
    reduction = HeldOut(
        Measured(0.9, sigma), Measured(0.7, 0.1), Measured(90.0, 20.0), Measured(27.0, 9.0), 0.4, "half2"
    )
    said = words.held_out(SimpleNamespace(held_out=reduction))
    assert ("90 %" in said) == quoted
    assert "70 % ± 10 %" in said


def test_only_an_effect_of_nearly_that_name_is_suggested() -> None:
    """At the usual likeness "nonsense" was taken for noise_knee."""
    with refused("beam_widht", "beam_width?"):
        systematics.get("beam_widht")
    with refused("nonsense", "beam_coma"):  # all of them
        systematics.get("nonsense")
