"""Numbers beside the data vector: what each map shows by itself at the largest scales.

No test of the gap sees them, so that they cost it no power. They are what an effect must agree with before it is named.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from mcsim.datavector.filter_model import Model
from mcsim.datavector.summaries import Element, of_map, sine_of_latitude
from mcsim.datavector.wiener_filter import FilteredMaps
from mcsim.sphere import healpix, real
from mcsim.support.arrays import Matrix, Vector

DEGREES = {"residual": 4, "gain": 2}
"""Highest degree of the residual, and of residual times sky: a gain that depends on direction."""

NSIDE = 32  #: of the pixels that real harmonics are integrated over


def elements_of(model: Model) -> tuple[Element, ...]:
    """Describe the numbers of every map, in the order of :func:`values_of`."""
    found = []
    for part in range(len(model.parts)):
        alike = of_map(model, part)
        for kind, top in DEGREES.items():
            for degree, order, component in real.harmonics(min(top, model.lmax)):
                own = replace(alike, name=f"{kind}/{alike.name}/{degree},{order}{component[:1]}", L=degree, M=order)
                # The product with the sky has its power at all degrees of the sky.
                ell = (degree, degree) if kind == "residual" else None
                found.append(replace(own, kind=kind, ell=ell, component=component or None))
    return tuple(found)


def values_of(model: Model, filtered: FilteredMaps) -> Vector:
    """Return real coefficients of every map's residual over its noise variance, and of that times the sky."""
    found = []
    low, top = (min(one, model.lmax) for one in DEGREES.values())
    harmonics = _harmonics(model.nside, top)
    for i in range(len(model.parts)):
        gain = harmonics @ (filtered.residual[i] * filtered.expected[i])
        found += [real.coefficients(filtered.adjoint[i], model.lmax, low), gain]
    return np.concatenate(found)


@lru_cache(maxsize=2)
def _harmonics(nside: int, top: int) -> Matrix:
    """Return the real harmonics at pixel centres, shape ((top + 1)^2, npix)."""
    return np.stack([healpix.synthesis(real.to_alm(unit, top)[None], nside, top)[0] for unit in np.eye((top + 1) ** 2)])


def northern(elements: Sequence[Element], frame: str) -> Matrix:
    """Return the matrix that keeps the northern hemisphere of a frame, shape (E, E), for elements of one map frame.

    What it leaves of the identity keeps the southern one. Signals beyond the highest degree are left out.
    """
    found = np.zeros((len(elements), len(elements)))
    groups: dict[tuple[str, str | None, str], list[int]] = {}
    for row, one in enumerate(elements):
        groups.setdefault((one.channels[0], one.split, one.kind), []).append(row)
    for rows in groups.values():
        top = max(elements[row].L or 0 for row in rows)
        found[np.ix_(rows, rows)] = _overlap(elements[rows[0]].frame or frame, frame, top)
    return found


@lru_cache(maxsize=16)
def _overlap(frame: str, to: str, top: int) -> Matrix:
    """Return the integrals of products of real harmonics over a hemisphere."""
    npix, harmonics = 12 * NSIDE**2, _harmonics(NSIDE, top)
    height = sine_of_latitude(frame, to, NSIDE)
    weight = np.where(np.abs(height) < 1e-9, 0.5, height > 0.0) * 4.0 * np.pi / npix
    return np.asarray((harmonics * weight) @ harmonics.T)
