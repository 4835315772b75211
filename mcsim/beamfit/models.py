"""Models of f_l, by which b_l2 is rescaled: linear combinations of known functions of l."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from mcsim.errors import InputError

MODELS = ("constant", "linear", "spline", "orientation")


@dataclass(frozen=True)
class Model:
    """f_l = sum_k theta_k g_k(l): one of :data:`MODELS`, and the names of its parameters theta_k.

    ``functions`` maps ell, shape (n,), to g_k(ell), shape (K, n); complex for ``orientation`` alone.
    """

    name: str
    parameters: tuple[str, ...]
    functions: Callable[[NDArray[np.float64]], NDArray]


def model(name: str, ell_range: tuple[int, int], knots: int = 4) -> Model:
    """Build a model.

    "constant": alpha. "linear": alpha + beta l. "spline": a natural cubic spline from the first to the last l of
    ``ell_range``, linear outside, whose parameters are its values at ``knots`` >= 3 equidistant multipoles.
    "orientation": a complex constant, as :func:`mcsim.beamfit.orientation` reads it. Raise InputError for another name,
    or too few knots.

    Notes
    -----
    Each model contains the constant one, and the spline contains the linear one within ``ell_range``, so that
    differences of chi^2 between them have the distribution that :func:`mcsim.beamfit.likelihood.compare` assumes.
    """
    if name == "constant":
        return Model(name, ("alpha",), lambda ell: np.ones((1, len(ell))))
    if name == "linear":
        return Model(name, ("alpha", "beta"), lambda ell: np.stack([np.ones(len(ell)), ell]))
    if name == "orientation":
        return Model(name, ("real", "imaginary"), lambda ell: np.stack([np.ones(len(ell)), np.full(len(ell), 1j)]))
    if name == "spline":
        if knots < 3:
            raise InputError(f"a spline of {knots} knots is no more than a line; give 3 knots or more.")
        places = np.linspace(*ell_range, knots)
        if len(set(np.round(places))) < knots:
            raise InputError(f"{knots} knots do not fit into ell = {ell_range[0]} ... {ell_range[1]}; give fewer.")
        spline = CubicSpline(places, np.eye(knots), bc_type="natural")
        names = tuple(f"f({place:.0f})" for place in places)

        def functions(ell: NDArray[np.float64]) -> NDArray[np.float64]:
            inside = np.clip(ell, places[0], places[-1])
            return (spline(inside) + (ell - inside)[:, None] * spline(inside, 1)).T

        return Model(name, names, functions)
    raise InputError(f"there is no model {name!r} of f_l; choose among {', '.join(MODELS)}.")
