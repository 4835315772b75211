"""BipoSH coefficients under rotations, exchange and scaling: properties that hold for any two real fields."""

import ducc0
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mcsim.bipolar import estimate, estimator
from mcsim.sphere import alm as alm_

LMAX, L_MAX = 8, 3
TABLES = estimator(L_MAX, LMAX, both_orders=True)
ROW = {(mode.L, mode.M, mode.d): row for row, mode in enumerate(TABLES.modes)}
angles = st.floats(-6.3, 6.3)
seeds = st.integers(0, 2**32 - 1)


def field(seed):
    """Coefficients of a real field."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=alm_.size(LMAX)) + 1j * rng.normal(size=alm_.size(LMAX))
    a[: LMAX + 1] = a[: LMAX + 1].real
    return a


def strengths(biposh):
    """Sum over all M of |A^{LM}|^2, of each L, d and ell; coefficients of -M have the same modulus."""
    found = {}
    for (L, M, d), row in ROW.items():
        square = np.nan_to_num(np.abs(biposh[row]) ** 2)
        found[L, d] = found.get((L, d), 0.0) + (1.0 if M == 0 else 2.0) * square
    return found


@given(seeds, seeds, angles, angles, angles)
def test_a_rotation_only_mixes_orders(one, other, psi, theta, phi):
    """The rotation is ducc0's, which knows nothing of BipoSH."""
    a, b = field(one), field(other)
    turned = [ducc0.sht.rotate_alm(x, LMAX, psi, theta, phi) for x in (a, b)]
    before, after = strengths(estimate(TABLES, a, b)), strengths(estimate(TABLES, *turned))
    assert after.keys() == before.keys()
    np.testing.assert_allclose([after[key] for key in before], list(before.values()), rtol=1e-9, atol=1e-9)


@given(seeds, seeds, angles)
def test_a_turn_about_the_pole_is_a_phase(one, other, alpha):
    """a_lm -> e^{-i m alpha} a_lm turns A^{LM} by e^{-i M alpha}."""
    a, b = field(one), field(other)
    phase = np.exp(-1j * alpha * np.concatenate([np.full(LMAX + 1 - m, m) for m in range(LMAX + 1)]))
    before, after = estimate(TABLES, a, b), estimate(TABLES, phase * a, phase * b)
    orders = np.array([mode.M for mode in TABLES.modes])
    np.testing.assert_allclose(after, np.exp(-1j * orders * alpha)[:, None] * before, atol=1e-10)


@given(seeds, seeds)
def test_exchanged_fields_have_the_sign_of_the_parity(one, other):
    """A^{LM}_{l2 l1} of (b, a) is (-1)^{l1 + l2 + L} A^{LM}_{l1 l2} of (a, b), from the symmetries of the symbols."""
    a, b = field(one), field(other)
    forward, backward = estimate(TABLES, a, b), estimate(TABLES, b, a)
    for (L, M, d), row in ROW.items():
        l2 = np.arange(max(0, d), min(LMAX, LMAX + d) + 1)
        here, there = forward[row, l2], backward[ROW[L, M, -d], l2 - d]
        # NaN where the coefficient does not exist, on both sides.
        np.testing.assert_allclose(there, (-1.0) ** (d + L) * here, atol=1e-10)


@given(seeds, seeds, st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_the_estimator_is_bilinear(one, other, x, y):
    a, b = field(one), field(other)
    scale = 1.0 + x * x + y * y
    np.testing.assert_allclose(
        estimate(TABLES, x * a, y * b) / scale, x * y * estimate(TABLES, a, b) / scale, atol=1e-10
    )
