"""Effective beams: the factor f_l of the b_l2 of a configuration that fits the measured BipoSH."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, stats

from mcsim.beamfit.data import EVERYTHING, Measurement, Selection, from_store, with_covariance_of
from mcsim.beamfit.likelihood import Comparison, Solution, compare, size, solve, solve_each, whitening
from mcsim.beamfit.models import Model, model
from mcsim.beamfit.table import check_frame, read_table
from mcsim.beamfit.templates import ORDERS, Order, Polynomial, Templates, templates
from mcsim.config.preparation import frame_of
from mcsim.ensemble import store
from mcsim.ensemble.expectation import Source, survey_of
from mcsim.errors import InputError
from mcsim.support.arrays import Matrix, Vector
from mcsim.support.folders import user_path

NEGLIGIBLE = 0.1
"""Leading order suffices if the higher orders are below this size in sigma: no parameter shifts by more."""

AS_GOOD = 9.0  #: a second minimum is told of if its chi^2 is higher by less than this
SAME = 1e-4  #: imaginary parts of minima that are one; a turn of 0.003 degrees


@dataclass(frozen=True)
class Fit:
    """A model of f_l fitted to measured BipoSH."""

    #: measured, model: data vector, and model of f_l without a parameter that the data do not constrain (the imaginary
    #: part of ``orientation``)
    measured: Measurement
    model: Model
    #: order, beyond_leading: "leading", or "exact" to all orders in the beam; and the size in sigma of the higher ones
    #: at the best fit, ``None`` if leading order was requested
    order: str
    #: offset, design: the expected data are offset + design @ parameters, uK^2: shapes (p,), (p, K); if ``order`` is
    #: "exact", this is their tangent at the best fit
    offset: Vector
    design: Matrix
    solution: Solution  #: parameters, their covariance, chi2, its degrees of freedom and probability
    beyond_leading: float | None = None
    #: of ``orientation`` the second minimum, whose imaginary part has the other sign, if its chi^2 is higher by less
    #: than :data:`AS_GOOD`: spectra that have only the square of that part do not tell its sign
    other: Solution | None = None
    each: tuple[Solution, ...] = ()  #: fits of every realization, if made by :func:`fit_each`

    @property
    def best(self) -> Vector:
        """Return the data expected at the best fit, uK^2, shape (p,)."""
        return self.offset + self.design @ self.solution.parameters

    @property
    def ell(self) -> Vector:
        """Return all multipoles between the first and the last of the data."""
        return np.arange(min(row.ell_min for row in self.measured.rows), self.measured.lmax + 1.0)

    def factor(self) -> tuple[Vector, Vector]:
        """Return f_l at :attr:`ell` and its standard deviation; of ``orientation`` the real part."""
        functions = self.model.functions(self.ell).real
        width = np.sqrt(np.einsum("kl,km,ml->l", functions, self.solution.covariance, functions))
        return self.solution.parameters @ functions, width

    def pulls(self, truth: ArrayLike) -> Matrix:
        """Return (estimate - truth)/error of every realization and parameter, shape (N, K)."""
        return np.array([(one.parameters - np.asarray(truth)) / one.errors for one in self.each])

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, for JSON."""
        solution = self.solution

        def named(values: Vector) -> dict[str, float]:
            return dict(zip(self.model.parameters, values.tolist(), strict=True))

        result: dict[str, Any] = {
            "model": self.model.name,
            "order": self.order,
            "beyond_leading": self.beyond_leading,
            "data": self.measured.origin,
            "pair": self.measured.pair,
            "kind": self.measured.kind,
            "modes": [mode.name for mode in self.measured.modes],
            "unfitted": list(self.measured.unfitted),
            "parameters": named(solution.parameters),
            "errors": named(solution.errors),
            "correlation": solution.correlation.tolist(),
            **{key: getattr(solution, key) for key in ("chi2", "dof", "reduced_chi2", "probability", "simulations")},
        }
        if self.other is not None:
            result["other"] = {"parameters": named(self.other.parameters), "chi2": self.other.chi2}
        if self.each:
            estimates = np.array([one.parameters for one in self.each])
            pulls = self.pulls(solution.parameters)
            uniform = stats.kstest([one.probability for one in self.each], "uniform")
            result["realizations"] = {
                "count": len(self.each),
                "mean": named(estimates.mean(axis=0)),
                "pull_width": named(pulls.std(axis=0, ddof=1)),
                "probability_uniform": float(uniform.pvalue),
            }
        return result


def fit(
    data: str | Path | Measurement,
    source: Source,
    name: str = "constant",
    *,
    knots: int = 4,
    order: Order = "auto",
    nthreads: int = 1,
) -> Fit:
    """Fit one model of f_l; see :func:`mcsim.fit`, and :func:`mcsim.beamfit.models.model` for its name and knots.

    ``order`` is "leading" (in the beam's non-circular part), "exact" (all orders) or "auto": all orders if the higher
    ones exceed :data:`NEGLIGIBLE` sigma of the data. Raise InputError for data that do not match the configuration or
    the model, or circular beams.

    Notes
    -----
    f_l = sum_k theta_k g_k(l) rescales b_l2 both at l1 and at l2; other orders of the beam are unchanged. To leading
    order the data are linear in theta; to all orders they are a polynomial of second degree, known from (K + 1)(K +
    2)/2 predictions. scipy's Levenberg-Marquardt minimises chi^2 from the leading-order fit. Errors and tests are
    those of the tangent there, exact if the curvature within the errors of theta is negligible
    (tests/unit/test_fit_exact.py compares with a minimisation over independent predictions). On simulated ensembles
    the pulls have unit width (tests/statistical/test_fit.py), and the data of a hit-averaged WMAP-like scan fitted with
    parallel transport give 0.6575 (tests/integration/test_prediction.py).
    """
    survey = survey_of(source, nthreads)
    return fit_models(measurement(data, survey), survey, [name], knots=knots, order=order, nthreads=nthreads)[0]


def _fit(made: Templates, name: str, knots: int, order: Order) -> Fit:
    """Fit one model; see :func:`fit`."""
    if order not in ORDERS:
        raise InputError(f"there is no order {order!r} of the prediction; choose among {', '.join(ORDERS)}.")
    measured = made.measured
    first = min(row.ell_min for row in measured.rows)
    chosen = model(name, (first, measured.lmax), knots)
    expected = made.leading(chosen)
    if name == "orientation" and _unseen(expected.linear, measured):
        chosen = Model(name, chosen.parameters[:1], lambda ell: np.ones((1, len(ell))))
        expected = expected.keeping(1)
    offset, design = expected.constant, expected.linear
    solution = _solve(measured, offset, design)
    beyond = None
    if order != "leading":
        change = made.beyond_leading(chosen, solution.parameters)
        beyond = size(change, measured.covariance, measured.simulations)
    if order == "leading" or (order == "auto" and beyond is not None and beyond < NEGLIGIBLE):
        return Fit(measured, chosen, "leading", offset, design, solution, beyond)
    expected = made.exact(chosen)
    best, *others = _minima(measured, expected, solution.parameters, mirrored="imaginary" in chosen.parameters)
    design = expected.derivative(best)
    offset = expected.at(best) - design @ best
    solution, other = _solve(measured, offset, design), None
    for place in others:
        slope = expected.derivative(place)
        found = _solve(measured, expected.at(place) - slope @ place, slope)
        other = found if found.chi2 - solution.chi2 < AS_GOOD else None
    return Fit(measured, chosen, "exact", offset, design, solution, beyond, other)


def fit_models(
    measured: Measurement,
    source: Source,
    names: Sequence[str],
    *,
    knots: int = 4,
    order: Order = "auto",
    nthreads: int = 1,
) -> list[Fit]:
    """Fit several models to the same data as :func:`fit` does, to the same order: all orders if one model needs them.

    InputError as well for no model or a repeated one.
    """
    if isinstance(names, str) or not isinstance(names, Sequence):
        such = names if isinstance(names, str) else "constant"
        raise InputError(f"models = {names!r} is no list of models; give one, such as [{such!r}].")
    if not names or any(names.count(name) > 1 for name in names):
        said = ", ".join(map(str, names)) or "(none)"
        raise InputError(f"the models {said} are not different ones; name each model once.")
    made = templates(survey_of(source, nthreads), measured, nthreads)
    fits = [_fit(made, name, knots, order) for name in names]
    if len({one.order for one in fits}) > 1:
        fits = [one if one.order == "exact" else _fit(made, one.model.name, knots, "exact") for one in fits]
    return fits


def _solve(measured: Measurement, offset: Vector, design: Matrix) -> Solution:
    return solve(measured.value - offset, design, measured.covariance, measured.simulations)


def _minima(measured: Measurement, expected: Polynomial, start: Vector, mirrored: bool) -> list[Vector]:
    """Return the parameters at which chi^2 has a minimum, the lowest first.

    ``mirrored``: of a complex factor there may be two, of either sign of the imaginary part. The search begins where
    that part is at most 1, as the mean of turned beams has it, whatever the leading order makes of it, and not at 0,
    where the search would stay.
    """
    if not mirrored:
        return [_minimise(measured, expected, start)[0]]
    aside = np.array([start[0], np.clip(abs(start[1]), 0.1, 1.0)])
    found = [_minimise(measured, expected, aside * [1.0, sign]) for sign in (1.0, -1.0)]
    (best, _), (other, _) = sorted(found, key=lambda one: one[1])
    return [best] if abs(best[1] - other[1]) < SAME else [best, other]


def _minimise(measured: Measurement, expected: Polynomial, start: Vector) -> tuple[Vector, float]:
    """Return the parameters at a minimum of chi^2, and half of the value there."""
    white = whitening(measured.value, expected.linear, measured.covariance, measured.simulations)

    def residual(theta: Vector) -> Vector:
        return np.asarray(white @ (measured.value - expected.at(theta)))

    def slope(theta: Vector) -> Matrix:
        return np.asarray(-white @ expected.derivative(theta))

    limits = {"xtol": 1e-13, "ftol": 1e-13, "gtol": 1e-13}
    found = optimize.least_squares(residual, start, jac=slope, method="lm", x_scale="jac", **limits)
    if not found.success:
        raise InputError(
            f"the fit of {measured.origin} to all orders does not converge ({found.message}); choose a simpler model."
        )
    return np.asarray(found.x), float(found.cost)


def fit_each(found: Fit) -> Fit:
    """Return a fit of an ensemble with the fits of every realization, on the tangent at the best fit of their mean."""
    if found.measured.realizations is None:
        raise InputError(f"{found.measured.origin} is no ensemble; fits of single realizations need a store.")
    return replace(found, each=tuple(solve_each(found.measured.realizations - found.offset, found.design)))


def measurement(
    data: str | Path | Measurement,
    source: Source,
    selection: Selection = EVERYTHING,
    covariance: str | Path | None = None,
) -> Measurement:
    """Read the data vector of a fit.

    ``data``: a store (a folder): its mean, with the covariance of its realizations over their number; an ECSV table; or
    a measurement, which has its selection.
    ``source``, ``selection``: configuration, whose frame the data must have, and the modes, multipoles, kind and pair
    that are fitted. ``covariance``: store that models the data, whose covariance, over the number of realizations that
    the data are the mean of, replaces that of the data. Raise InputError for data that cannot be read or lack what is
    selected, and for data or a covariance in another frame than the configuration, or of filtered maps.
    """
    if isinstance(data, Measurement):
        if selection != EVERYTHING:
            raise InputError("a measurement holds what is fitted; give the selection to what reads it, or none here.")
        return data if covariance is None else _with_covariance_of(data, covariance, None, survey_of(source).frame)
    path, frame = user_path(data), survey_of(source).frame
    if path.is_dir():
        measured = from_store(path, selection)
        check_frame(path, frame_of(store.attributes(path)["configuration"]), frame)
    else:
        measured = read_table(path, frame, selection, errors=covariance is None)
    return measured if covariance is None else _with_covariance_of(measured, covariance, selection.pair, frame)


def _with_covariance_of(measured: Measurement, path: str | Path, pair: str | None, frame: str) -> Measurement:
    """Return a measurement with the covariance of a store; InputError if that is in another frame."""
    check_frame(path, frame_of(store.attributes(user_path(path))["configuration"]), frame)
    return with_covariance_of(measured, path, pair)


def _unseen(design: Matrix, measured: Measurement) -> bool:
    """Return True if the data do not constrain the imaginary part: its template is a multiple of the real one.

    It is zero for a beam along the scan, and in even parity as large as that for one at an angle.
    """
    real, imaginary = (design / np.sqrt(np.diag(measured.covariance))[:, None]).T
    own = imaginary - real * (real @ imaginary) / max(float(real @ real), 1e-300)
    return bool(np.linalg.norm(own) < 1e-6 * np.linalg.norm(real))


def comparisons(fits: Sequence[Fit]) -> list[tuple[str, str, Comparison]]:
    """Return every pair of nested models among fits to the same data: the smaller, the larger and their test."""
    nested = {("constant", "linear"), ("constant", "spline"), ("linear", "spline"), ("constant", "orientation")}
    return [
        (a.model.name, b.model.name, compare(a.solution, b.solution))
        for a in fits
        for b in fits
        if (a.model.name, b.model.name) in nested and a.solution.dof > b.solution.dof and a.order == b.order
    ]
