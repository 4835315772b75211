"""Amplitudes that maps could show but no effect can have are said to be impossible, in texts and in JSON."""

from dataclasses import replace

import numpy as np
import pytest

import mcsim
from mcsim import systematics
from mcsim.datavector.candidate import Candidate
from mcsim.diagnosis import report
from pictures import quick_pictures

from .test_diagnosis_report import Page, diagnosis
from .test_information import one_map


@pytest.mark.parametrize("name", sorted(systematics.catalogue()))
def test_the_largest_amplitude_is_that_of_the_bounds(name) -> None:
    kind = systematics.get(name)
    largest = Candidate(kind, None, (0,)).largest
    reached = [abs(replace(kind(), amplitude=sign * 1e9).within_bounds().amplitude) for sign in (-1.0, 1.0)]
    assert largest == min(max(reached), kind.parametrization.max_amplitude)
    assert Candidate(kind, None, (0,), fit=replace(kind.parametrization, max_amplitude=1e-6)).largest == 1e-6


def test_a_diagnosis_says_what_no_effect_can_have(monkeypatch) -> None:
    said = ", more than is possible"
    plain = diagnosis("none")
    assert [one["amplitude_max"] for one in plain.to_json()["detectable"]] == [1.0, 120.0, 10.0]
    assert not any(said in one.detectable_words + one.separable_words for one in plain.candidates)
    monkeypatch.setattr(Candidate, "largest", 2.0 * plain.candidates[1].detectable)
    found = diagnosis("none")
    for one in found.candidates:
        assert one.detectable_words.endswith(said) == (one.detectable > one.largest)
        assert one.separable_words.endswith(said) == (one.separable > one.largest)
    with quick_pictures(empty=True):
        page = Page(report.page(found)).text
    assert page.count(said) == sum(
        (one.detectable > one.largest) + (one.separable > one.largest) for one in found.candidates
    )
    monkeypatch.setattr(Candidate, "largest", np.inf)
    assert {one["amplitude_max"] for one in diagnosis("none").to_json()["detectable"]} == {None}


def test_a_limit_marks_what_no_effect_can_have() -> None:
    chosen = mcsim.LimitSettings(only=("beam_width", "noise_level"), dense=True)
    found = mcsim.limit(one_map(nside=4, sigma0_uk=300.0), settings=chosen)
    width, noise = found.effects
    assert (width.amplitude_max, noise.amplitude_max) == (0.5, 3.0)
    assert noise.amplitude_90 < 3.0 < 0.5 * width.amplitude_90
    assert [one["amplitude_max"] for one in found.to_json()["effects"]] == [0.5, 3.0]
    table = found.lines()
    stars = {
        start: line.count("*") for line in table for start in ("beam_width", "noise_level") if line.startswith(start)
    }
    assert stars == {"beam_width": 3, "noise_level": 0}
    assert sum(line.startswith("*: more than the effect can have") for line in table) == 1
