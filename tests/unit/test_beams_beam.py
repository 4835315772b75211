"""The Beam itself: cutting in m, power, evaluation."""

import numpy as np
import pytest

from mcsim.instrument.beams import MMAX_TOLERANCE, Beam, choose_mmax
from mcsim.instrument.beams.coefficients import power_by_order
from refusals import refused


def random_blm(lmax: int, mmax: int) -> np.ndarray:
    rng = np.random.default_rng(5)
    blm = np.triu(rng.standard_normal((mmax + 1, lmax + 1)) + 1j * rng.standard_normal((mmax + 1, lmax + 1)))
    blm[0] = np.abs(blm[0]) + 10
    return blm


def test_truncation_keeps_account_of_the_power() -> None:
    whole = Beam.normalized(random_blm(20, 9), 9, "a test beam")
    power = power_by_order(whole.blm)
    once = whole.truncated(3)
    twice = whole.truncated(6).truncated(3)
    assert once.mmax == 3
    assert once.neglected_power == pytest.approx(power[4:].sum() / power.sum(), rel=1e-13)
    assert twice.neglected_power == pytest.approx(once.neglected_power, rel=1e-13)
    np.testing.assert_array_equal(once.blm, whole.blm[:4])
    assert whole.truncated(15) is whole


def test_power_counts_both_signs_of_m() -> None:
    blm = np.array([[3.0, 0.0], [0.0, 2.0j]])
    np.testing.assert_array_equal(power_by_order(blm), [9, 8])


def test_circular_part() -> None:
    beam = Beam.elliptical(30, 20, angle_deg=40, lmax=300, mmax=4)
    circular = beam.circular()
    assert circular.mmax == 0
    np.testing.assert_array_equal(circular.window, beam.window)
    assert circular.neglected_power > 1e-3


def test_normalize_divides_by_the_integral() -> None:
    beam = Beam.normalized(random_blm(8, 3) * 7, 3, "a test beam")
    assert beam.window[0] == pytest.approx(1, abs=1e-15)
    np.testing.assert_allclose(beam.blm * beam.integral, random_blm(8, 3) * 7, rtol=1e-14)


@pytest.mark.parametrize(
    ("powers", "expected"),
    [
        ([1.0, 0.0, 0.0, 0.0, 0.0], 0),
        ([1.0, 0.0, 1e-9, 0.0, 0.0], 2),
        ([1.0, 1e-2, 0.0, 0.0, 0.0], 2),
        ([1.0, 0.0, 1e-2, 0.0, 2 * MMAX_TOLERANCE], 4),
        ([1.0, 0.0, 1e-2, 2 * MMAX_TOLERANCE, 0.5 * MMAX_TOLERANCE], 3),
    ],
)
def test_mmax_is_the_smallest_within_tolerance_but_keeps_m2(powers, expected) -> None:
    blm = np.zeros((5, 5), dtype=complex)
    for m, power in enumerate(powers):
        blm[m, 4] = np.sqrt(power / (1 if m == 0 else 2))
    assert choose_mmax(blm) == expected


def test_mmax_of_a_beam_known_only_up_to_a_lower_order() -> None:
    assert choose_mmax(np.array([[1.0, 1.0], [0.0, 0.2]])) == 1


def test_chosen_mmax_of_mild_and_strong_ellipses() -> None:
    assert Beam.elliptical(13.9, 12.7, lmax=1024).mmax == 2
    assert Beam.elliptical(20, 12, lmax=1024).mmax == 4
    assert Beam.elliptical(20, 12, lmax=1024).neglected_power < MMAX_TOLERANCE


def test_values_are_the_elliptical_gaussian() -> None:
    sigma_major, sigma_minor = np.radians([1.0, 0.75]) / np.sqrt(8 * np.log(2))
    # At lmax 1500 and mmax 24 nothing of this beam is cut: what is left is the closed form's own error.
    beam = Beam.elliptical(60, 45, lmax=1500, mmax=24)
    theta, phi = np.meshgrid(np.linspace(1e-3, 0.03, 12), np.arange(0, 6, 0.5))
    expected = np.exp(-((theta * np.cos(phi) / sigma_major) ** 2 + (theta * np.sin(phi) / sigma_minor) ** 2) / 2)
    expected /= 2 * np.pi * sigma_major * sigma_minor
    # The beam's root and its normalisation differ from 1 by theta^2/12, 1e-5 here.
    np.testing.assert_allclose(beam.values(theta, phi), expected, rtol=0, atol=2e-5 * expected.max())


@pytest.mark.parametrize("mmax", [-1, 11])
def test_truncation_to_no_order_is_refused(mmax) -> None:
    with refused("mmax", mmax):
        Beam.gaussian(60, 10).truncated(mmax)


@pytest.mark.parametrize(
    ("change", "named"),
    [((1, 3, np.nan), ("finite",)), ((0, 0, -1.0), ("positive",)), ((0, 0, 0.0), ("positive",))],
)
def test_normalize_refuses(change, named) -> None:
    m, ell, value = change
    blm = random_blm(8, 3)
    blm[m, ell] = value
    with refused(*named):
        Beam.normalized(blm, None, "a test beam")


def test_normalize_refuses_orders_that_are_not_there() -> None:
    with refused("mmax", 5, 3):
        Beam.normalized(random_blm(8, 3), 5, "a test beam")


def test_beams_compare_by_identity() -> None:
    beam = Beam.gaussian(60, 10)
    assert beam == beam
    assert beam != Beam(beam.blm)
