"""Recursions against exact symbols."""

import numpy as np
import pytest
from wignernj import wigner3j, wigner6j

from mcsim.sphere.wigner import sixj_family, threej_family

# Round-off of a recursion of up to 160 steps: symbols are at most 1 in size.
TOLERANCE = 1e-14


@pytest.mark.parametrize("j2", [0, 1, 2, 3, 7, 40, 1100])
@pytest.mark.parametrize("j3", [0, 1, 2, 5, 8, 80])
def test_threej_family(j2, j3):
    out = np.zeros(2 * min(j2, j3) + 1)
    for m2, m3 in [(0, 0), (0, 1), (0, 2), (0, 4), (1, -1), (2, 1), (-2, 2)]:
        if abs(m2) > j2 or abs(m3) > j3:
            continue
        lowest, n = threej_family(j2, j3, m2, m3, out)
        assert (lowest, lowest + n - 1) == (max(abs(j2 - j3), abs(m2 + m3)), j2 + j3)
        expected = [wigner3j(j, j2, j3, -m2 - m3, m2, m3) for j in range(lowest, lowest + n)]
        np.testing.assert_allclose(out[:n], expected, atol=TOLERANCE, rtol=0)


@pytest.mark.parametrize("l1", [0, 1, 2, 6, 30, 1100])
@pytest.mark.parametrize("L", [0, 1, 2, 3, 6])
def test_sixj_family(l1, L):
    """All that the exact BipoSH needs: {l l1 L1; L L2 l2} with |l1 - l2| <= L."""
    checked = 0
    for L1 in (0, 1, 2, 5, 64):
        for L2 in range(abs(L - L1), L + L1 + 1):
            for l2 in range(max(abs(L - l1), l1 - L), l1 + L + 1):
                lowest, highest = max(abs(l1 - L1), abs(L2 - l2)), min(l1 + L1, L2 + l2)
                if highest < lowest:
                    continue
                out = np.zeros(2 * min(l1, L1, L2, l2) + 1)
                assert sixj_family(l1, L1, L, L2, l2, out) == (lowest, highest - lowest + 1)
                expected = [wigner6j(ell, l1, L1, L, L2, l2) for ell in range(lowest, highest + 1)]
                np.testing.assert_allclose(out[: len(expected)], expected, atol=TOLERANCE, rtol=0)
                checked += 1
    assert checked > 0
