r"""Fisher information of maps from whole matrices: the reference for small maps.

V_i = dP_i S^1/2 has a column for every unit sky, and V_0 = P S^1/2. With Z_i = C^-1 V_i::

    dC_i = V_i V_0^t + V_0 V_i^t + dN_i,
    1/2 Tr[C^-1 dC_i C^-1 dC_j] = Tr[V_0^t Z_i V_0^t Z_j] + Tr[V_j^t Z_i V_0^t Z_0]
                                  + sum_p (Z_i Z_0^t)_pp dN_j,pp + (i <-> j) + 1/2 sum_pq (C^-1_pq)^2 dN_i,pp dN_j,qq.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from mcsim.errors import InputError
from mcsim.information.derivatives import Derivative
from mcsim.information.fisher import Information, means
from mcsim.simulation.inverse_covariance import RANK, InverseCovariance, unit_skies
from mcsim.support.arrays import Cl, Matrix, Vector, divided
from mcsim.support.progress import Reporter

BYTES = 4 << 30  #: largest memory of the matrices


class Size(NamedTuple):
    """Size of the matrices: observed pixels of all maps, modes of the sky, and bytes of all of them."""

    pixels: int
    modes: int
    bytes: int


def size_of(filtered: InverseCovariance, columns: int) -> Size:
    """Return the size of the matrices for a number of coordinates."""
    pixels, modes = int(np.count_nonzero(filtered.precision)), (filtered.lmax + 1) ** 2
    return Size(pixels, modes, 8 * (3 * pixels**2 + (2 * columns + 2) * pixels * modes))


def dense(filtered: InverseCovariance, derivatives: Sequence[Derivative], cl: Cl, report: Reporter) -> Information:
    """Return the Fisher information; raise InputError if the matrices do not fit :data:`BYTES`.

    ``cl`` is the spectrum of the sky that effects act on, uK^2, shape (lmax + 1,), at most that of the inverse
    covariance; ``report`` counts the derivatives.
    """
    size = size_of(filtered, len(derivatives))
    if size.bytes > BYTES:
        raise InputError(
            f"the matrices of {size.pixels} pixels, {size.modes} modes of the sky and {len(derivatives)} coordinates "
            f"take {size.bytes / 1e9:.3g} GB, more than {BYTES / 1e9:.3g} GB; take fewer effects, or random probes."
        )
    seen = filtered.precision.ravel() > 0.0
    degrees, units = zip(*unit_skies(filtered.lmax), strict=True)
    skies = [np.sqrt(cl[ell]) * sky for ell, sky in zip(degrees, units, strict=True)]
    response = np.stack([filtered.observe(sky).ravel()[seen] for sky in units], axis=1)
    V0 = response * np.sqrt(cl[list(degrees)])
    covariance = (response * filtered.cl[list(degrees)]) @ response.T
    covariance[np.diag_indices_from(covariance)] += 1.0 / filtered.precision.ravel()[seen]
    solve = _inverse(covariance, _templates(filtered)[:, seen])
    Z0 = solve(V0)
    inner = V0.T @ Z0
    changes, solved, noises, mean = [], [], [], []
    for number, derivative in enumerate(derivatives):

        def whole(maps: Vector, part: slice = derivative.maps) -> Vector:
            full = np.zeros_like(filtered.precision)
            full[part] = maps
            return full.ravel()[seen]

        V = np.stack([whole(derivative.of_sky(sky)) for sky in skies], axis=1)
        changes.append(V)
        solved.append(solve(V) if V.any() else V)
        noises.append(None if derivative.noise is None else whole(derivative.noise))
        mean.append([whole(half) for half in means(filtered, derivative)])
        report(number + 1.0)
    inverse = solve(np.eye(size.pixels)) if any(noise is not None for noise in noises) else None
    K = len(derivatives)
    across = [V0.T @ Z for Z in solved]
    local = [np.sum(Z * Z0, axis=1) for Z in solved]
    found = np.zeros((K, K))
    for i in range(K):
        for j in range(i + 1):
            value = float(np.sum(across[i] * across[j].T) + np.sum((changes[j].T @ solved[i]) * inner.T))
            mine, other = noises[i], noises[j]
            if other is not None:
                value += float(local[i] @ other)
            if mine is not None:
                value += float(local[j] @ mine)
            if inverse is not None and mine is not None and other is not None:
                value += float(0.5 * mine @ (inverse**2 @ other))
            found[i, j] = found[j, i] = value
    for half in range(2):
        columns = np.stack([own[half] for own in mean], axis=1)
        others = np.stack([own[1 - half] for own in mean], axis=1)
        found += 0.5 * columns.T @ solve(others)
    return Information((found + found.T) / 2.0)


def _templates(filtered: InverseCovariance) -> Matrix:
    """Return the templates of every map, none of the others, of norm one: shape (K, pixels of all maps)."""
    found = [np.zeros((0, filtered.precision.size))]
    for i, m in enumerate(filtered.maps):
        if m.templates is not None:
            seen = np.where(m.precision > 0.0, m.templates, 0.0)
            full = np.zeros((len(seen), *filtered.precision.shape))
            full[:, i] = divided(seen, np.linalg.norm(seen, axis=1)[:, None])
            found.append(full.reshape(len(seen), -1))
    return np.concatenate(found)


def _inverse(covariance: Matrix, templates: Matrix) -> Callable[[Matrix], Matrix]:
    """Return what applies C^-1, with templates, shape (K, pixels), of any amplitude added to the covariance."""
    factor = cho_factor(covariance, lower=True)
    weighted = cho_solve(factor, templates.T)
    own = np.linalg.pinv(templates @ weighted, RANK, hermitian=True)

    def solve(columns: Matrix) -> Matrix:
        return np.asarray(cho_solve(factor, columns) - weighted @ (own @ (weighted.T @ columns)))

    return solve
