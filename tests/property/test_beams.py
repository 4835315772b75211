"""Properties that every beam has."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mcsim.instrument.beams import Beam, BeamMap, blm_of_map
from mcsim.instrument.beams.coefficients import power_by_order

widths = st.floats(5.0, 300.0)
ratios = st.floats(1.0, 3.0)
angles = st.floats(-180.0, 180.0)


@given(widths, ratios, angles)
def test_ellipse_turns_by_its_phases(minor: float, ratio: float, angle_deg: float) -> None:
    upright = Beam.elliptical(minor * ratio, minor, lmax=150, mmax=6).blm
    turned = Beam.elliptical(minor * ratio, minor, angle_deg=angle_deg, lmax=150, mmax=6).blm
    phases = np.exp(-1j * np.arange(7) * np.radians(angle_deg))[:, None]
    np.testing.assert_allclose(turned, upright * phases, rtol=0, atol=1e-14 * np.abs(upright).max())


@given(widths, ratios, angles)
def test_no_coefficient_exceeds_that_of_a_point(minor: float, ratio: float, angle_deg: float) -> None:
    # A positive beam of unit integral has |b_lm| <= max |Y_lm| <= sqrt((2l+1)/4pi), reached at l = m = 0 only.
    beam = Beam.elliptical(minor * ratio, minor, angle_deg=angle_deg, lmax=150, mmax=6)
    bound = np.sqrt((2 * np.arange(151) + 1) / (4 * np.pi))
    assert np.all(np.abs(beam.blm) <= bound * (1 + 1e-14))


@given(widths, ratios, st.integers(0, 12))
def test_power_is_shared_between_what_is_kept_and_what_is_not(minor: float, ratio: float, mmax: int) -> None:
    whole = Beam.elliptical(minor * ratio, minor, lmax=150, mmax=20)
    cut = whole.truncated(mmax)
    kept = power_by_order(cut.blm).sum() / power_by_order(whole.blm).sum() * (1 - whole.neglected_power)
    np.testing.assert_allclose(kept + cut.neglected_power, 1.0, rtol=1e-13)


@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
def test_quarter_turns_of_any_map_are_exact(seed: int, quarters: int) -> None:
    image = np.random.default_rng(seed).standard_normal((17, 17))
    image[8, 8] += 100.0
    pixel, cut = np.radians(0.5), np.radians(3.9)
    upright = Beam.normalized(blm_of_map(BeamMap(image, pixel, (8, 8), cut), 60, 5), 5, "a map")
    # Columns are x and rows y, so that numpy's rot90 from axis 1 (x) to axis 0 (y) turns the beam from x towards y.
    turned_image = np.rot90(image, quarters, axes=(1, 0))
    turned = Beam.normalized(blm_of_map(BeamMap(turned_image, pixel, (8, 8), cut), 60, 5), 5, "a map")
    phases = np.exp(-1j * np.arange(6) * quarters * np.pi / 2)[:, None]
    np.testing.assert_allclose(turned.blm, upright.blm * phases, rtol=0, atol=1e-11 * np.abs(upright.blm).max())
