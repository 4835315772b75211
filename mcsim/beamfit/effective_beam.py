"""Effective beams: the f_l by which the b_l2 of a configuration must be rescaled to give the measured BipoSH."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from mcsim.beamfit.data import QUADRUPOLE, Kind, Measurement, from_store, project, with_covariance_of
from mcsim.beamfit.likelihood import Comparison, Solution, compare, solve, solve_each
from mcsim.beamfit.models import Model, model
from mcsim.beamfit.table import read_table
from mcsim.bipolar.theory import ScannedBeam, cmb_biposh_leading
from mcsim.ensemble import prediction, store
from mcsim.errors import InputError
from mcsim.simulation.survey import Survey


@dataclass(frozen=True)
class Fit:
    """A model of f_l fitted to measured BipoSH.

    Attributes
    ----------
    measured
        The data.
    model
        The model of f_l; where the data do not see one of its parameters (the imaginary part of ``orientation``),
        without.
    offset, design
        The data expected of the orders of the beam other than 2, and per unit of each parameter, uK^2: shapes (p,),
        (p, K).
    solution
        Parameters, their covariance, chi2, its degrees of freedom and probability.
    each
        The same for every realization, where asked for.
    """

    measured: Measurement
    model: Model
    offset: NDArray[np.float64]
    design: NDArray[np.float64]
    solution: Solution
    each: tuple[Solution, ...] = ()

    @property
    def best(self) -> NDArray[np.float64]:
        """Data expected of the best fit, uK^2, shape (p,)."""
        return self.offset + self.design @ self.solution.parameters

    @property
    def ell(self) -> NDArray[np.float64]:
        """Multipoles from the first to the last of the data."""
        return np.arange(min(row.ell_min for row in self.measured.rows), self.measured.lmax + 1.0)

    def factor(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """f_l at :attr:`ell` and its standard deviation; of ``orientation`` the real part."""
        functions = self.model.functions(self.ell).real
        width = np.sqrt(np.einsum("kl,km,ml->l", functions, self.solution.covariance, functions))
        return self.solution.parameters @ functions, width

    def pulls(self, truth: Sequence[float]) -> NDArray[np.float64]:
        """(estimate - truth)/error of every realization and parameter, shape (N, K)."""
        return np.array([(one.parameters - truth) / one.errors for one in self.each])

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, for JSON."""
        solution = self.solution
        result: dict[str, Any] = {
            "model": self.model.name,
            "data": self.measured.origin,
            "pair": self.measured.pair,
            "kind": self.measured.kind,
            "modes": [mode.name for mode in self.measured.modes],
            "parameters": dict(zip(self.model.parameters, solution.parameters.tolist(), strict=True)),
            "errors": dict(zip(self.model.parameters, solution.errors.tolist(), strict=True)),
            "correlation": solution.correlation.tolist(),
            "chi2": solution.chi2,
            "dof": solution.dof,
            "reduced_chi2": solution.reduced_chi2,
            "probability": solution.probability,
            "simulations": solution.simulations,
        }
        if self.each:
            estimates = np.array([one.parameters for one in self.each])
            pulls = self.pulls(solution.parameters.tolist())
            uniform = stats.kstest([one.probability for one in self.each], "uniform")
            result["realizations"] = {
                "count": len(self.each),
                "mean": dict(zip(self.model.parameters, estimates.mean(axis=0).tolist(), strict=True)),
                "pull_width": dict(zip(self.model.parameters, pulls.std(axis=0, ddof=1).tolist(), strict=True)),
                "probability_uniform": float(uniform.pvalue),
            }
        return result


def fit(
    data: str | Path | Measurement,
    source: prediction.Source,
    name: str = "constant",
    *,
    modes: Sequence[str] = QUADRUPOLE,
    ell_range: tuple[int, int] | None = None,
    kind: Kind | None = None,
    pair: str | None = None,
    covariance: str | Path | None = None,
    knots: int = 4,
    each: bool = False,
    nthreads: int = 1,
) -> Fit:
    """Fit effective beams b_l2^eff = f_l b_l2 to measured or simulated BipoSH.

    Parameters
    ----------
    data
        A store, whose mean is fitted with the covariance of its realizations over their number; or an ECSV table; or
        what :func:`measurement` made of one.
    source
        Configuration of the spectrum, the beams and the scan whose b_l2 are rescaled: often the beam of the data under
        parallel transport.
    name, knots
        Model of f_l: "constant", "linear", "spline" or "orientation"; see :func:`mcsim.beamfit.models.model`.
    modes, ell_range, kind, pair, covariance
        See :func:`measurement`.
    each
        Fit every realization of the store on its own, too, for pulls.
    nthreads
        Threads.

    Raises
    ------
    InputError
        For data that do not fit the configuration or the model, and circular beams.

    Notes
    -----
    To leading order A^{LM} is linear in b_l2 (:func:`mcsim.predict.cmb_biposh_leading`), so f_l = sum_k theta_k g_k(l)
    makes a linear model: its templates are the A^{LM} of g_k(l) b_l2, both at l1 and at l2; other orders of the beam
    stay as they are. On simulated ensembles the pulls have unit width (tests/statistical/test_fit.py), and the data of
    a hit-averaged WMAP-like scan fitted with parallel transport give 0.6575 (tests/integration/test_prediction.py). The
    paired difference of many realizations has smaller errors than the second order of the beam that the templates lack.
    """
    survey = prediction.survey_of(source, nthreads)
    measured = measurement(data, survey, modes=modes, ell_range=ell_range, kind=kind, pair=pair, covariance=covariance)
    first = min(row.ell_min for row in measured.rows)
    chosen = model(name, (first, measured.lmax), knots)
    offset, design = templates(survey, measured, chosen, nthreads)
    if name == "orientation" and _unseen(design, measured):
        chosen = Model(name, chosen.parameters[:1], lambda ell: np.ones((1, len(ell))))
        design = design[:, :1]
    solution = solve(measured.value - offset, design, measured.covariance, measured.simulations)
    singly: tuple[Solution, ...] = ()
    if each:
        if measured.realizations is None:
            raise InputError(f"{measured.origin} is no ensemble; fits of single realizations need a store.")
        singly = tuple(solve_each(measured.realizations - offset, design))
    return Fit(measured, chosen, offset, design, solution, singly)


def measurement(
    data: str | Path | Measurement,
    source: prediction.Source,
    *,
    modes: Sequence[str] = QUADRUPOLE,
    ell_range: tuple[int, int] | None = None,
    kind: Kind | None = None,
    pair: str | None = None,
    covariance: str | Path | None = None,
) -> Measurement:
    """Read what is to be fitted.

    Parameters
    ----------
    data
        Store (a folder) or ECSV table.
    source
        Configuration, for the frame.
    modes
        Labels of the modes that are fitted jointly.
    ell_range
        Only bins within these multipoles.
    kind
        "difference" to the circular twins (default where there are any) or "plain".
    pair
        Label of the pair of maps; by default the first.
    covariance
        Store that models the data: the covariance of one of its realizations replaces that of the data.
    """
    if isinstance(data, Measurement):
        return data
    survey = prediction.survey_of(source)
    path, frame = Path(data), survey.config.map.frame
    if path.is_dir():
        measured = from_store(path, modes, ell_range, kind, pair)
        _check_frame(path, frame)
    else:
        measured = read_table(path, frame, modes, ell_range, kind, pair)
    return measured if covariance is None else with_covariance_of(measured, covariance, pair)


def _check_frame(path: Path, frame: str) -> None:
    found = store.attributes(path)["configuration"]["map"]["frame"]
    if found != frame:
        raise InputError(f"{path} is in the {found} frame, the configuration in the {frame} one; rotate one of them.")


def templates(
    survey: Survey, measured: Measurement, chosen: Model, nthreads: int = 1
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Data expected of the orders of the beam but 2, shape (p,), and per unit of each parameter, shape (p, K)."""
    if survey.cl is None:
        raise InputError(f"{survey.config.name} names no spectrum; add sky.spectrum for the templates of a fit.")
    if measured.lmax > survey.lmax:
        raise InputError(
            f"the data reach ell = {measured.lmax}, the configuration ends at {survey.lmax}; raise its lmax."
        )
    L_max = max(mode.L for mode in measured.modes)
    beams = prediction.scanned_beams(survey, L_max, nthreads)
    pair = _maps_of(survey, measured.pair)
    x, y = (beams[number] for number in pair)
    if x.smax < 2 or y.smax < 2:
        raise InputError(f"a beam of {survey.config.name} is circular, so it has no b_l2 to rescale; give its shape.")
    cl, modes = survey.cl, [(mode.L, mode.M, mode.d) for mode in measured.modes]

    def expected(change: Any) -> NDArray[np.float64]:
        left, right = (ScannedBeam(change(beam.blm.copy()), beam.w) for beam in (x, y))
        seen = cmb_biposh_leading(modes, cl, survey.lmax, left, right)
        spectra = prediction.without_windows(survey, seen, modes, pair)
        return project(measured.rows, measured.scaling, dict(zip(measured.modes, spectra, strict=True)))

    def without(blm: NDArray[np.complex128]) -> NDArray[np.complex128]:
        blm[2] = 0.0
        return blm

    def scaled(function: NDArray) -> Any:
        def change(blm: NDArray[np.complex128]) -> NDArray[np.complex128]:
            blm[1:2] = 0.0
            blm[2] *= function
            blm[3:] = 0.0
            return blm

        return change

    functions = chosen.functions(np.arange(x.blm.shape[1], dtype=float))
    return expected(without), np.stack([expected(scaled(function)) for function in functions], axis=-1)


def _maps_of(survey: Survey, pair: str | None) -> tuple[int, int]:
    """Numbers of the maps of a pair; the only map stands for any name."""
    names = survey.map_names
    if len(names) == 1:
        return 0, 0
    wanted = [] if pair is None else pair.split(",")
    if len(wanted) != 2 or any(name not in names for name in wanted):
        raise InputError(
            f"the configuration has the maps {', '.join(names)}, the data are of {pair or 'a pair without name'}; "
            "name their pair, or give a configuration with one map."
        )
    return names.index(wanted[0]), names.index(wanted[1])


def _unseen(design: NDArray[np.float64], measured: Measurement) -> bool:
    """Whether the data say nothing about the imaginary part: in sigmas its template is under 1e-6 of the real one."""
    size = np.linalg.norm(design / np.sqrt(np.diag(measured.covariance))[:, None], axis=0)
    return bool(size[1] < 1e-6 * size[0])


def comparisons(fits: Sequence[Fit]) -> list[tuple[str, str, Comparison]]:
    """Every pair of nested models among fits to the same data: the smaller, the larger and their test."""
    nested = {("constant", "linear"), ("constant", "spline"), ("linear", "spline"), ("constant", "orientation")}
    return [
        (a.model.name, b.model.name, compare(a.solution, b.solution))
        for a in fits
        for b in fits
        if (a.model.name, b.model.name) in nested and a.solution.dof > b.solution.dof
    ]
