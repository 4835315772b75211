"""Data expected of effective beams b_l2 f_l: polynomials in the parameters of f_l."""

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from mcsim.beamfit.data import Measurement, project
from mcsim.beamfit.models import Model
from mcsim.bipolar.theory import ScannedBeam
from mcsim.ensemble import expectation
from mcsim.errors import InputError
from mcsim.simulation.survey import Survey

Order = Literal["auto", "leading", "exact"]

ORDERS: tuple[str, ...] = get_args(Order)

TRIAL_MOMENTS = 16  #: degree of the orientation moments that gives the size of the higher orders to about 5 %


@dataclass(frozen=True)
class Polynomial:
    """Data as a polynomial of second degree in the parameters theta.

    The coefficients, in uK^2, have shapes (p,), (p, K) and, symmetric in the last two axes, (p, K, K).
    """

    constant: NDArray[np.float64]
    linear: NDArray[np.float64]
    quadratic: NDArray[np.float64]

    def at(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the data, shape (p,)."""
        return self.constant + self.linear @ theta + self.quadratic @ theta @ theta

    def derivative(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivative with respect to theta, shape (p, K)."""
        return self.linear + 2.0 * self.quadratic @ theta

    def keeping(self, count: int) -> "Polynomial":
        """Return the polynomial of the first ``count`` parameters, the others being 0."""
        return Polynomial(self.constant, self.linear[:, :count], self.quadratic[:, :count, :count])


@dataclass(frozen=True)
class Templates:
    """Prediction of binned data for a survey's beams with b_l2 times f_l.

    The measurement defines the bins, ``pair`` the indices of the maps; ``beams`` are those of these maps, with moments
    of high degree. ``known`` keeps the exact data computed so far, by f_l: nested models share them. ``control``: the
    coefficients of the circular-beam control, which paired differences are without.
    """

    measured: Measurement
    survey: Survey
    pair: tuple[int, int]
    beams: tuple[ScannedBeam, ScannedBeam]
    nthreads: int = 1
    control: NDArray[np.complex128] | None = None
    known: dict[bytes, NDArray[np.float64]] = field(default_factory=dict, repr=False)

    def data(self, factor: NDArray, exact: bool = False, L_moments: int | None = None) -> NDArray[np.float64]:
        """Return data, shape (p,), for f_l at l = 0, 1, ...: to all orders in the beam if ``exact``, else to leading.

        The moments of the scan are taken up to ``L_moments``; default: up to those that are known.
        """
        x, y = (_rescaled(beam, factor, L_moments) for beam in self.beams)
        modes = self.measured.modes
        seen = expectation.signal(self.survey, (x, y), self.pair, modes, exact, self.nthreads)
        if self.control is not None:
            seen = seen - self.control
        if self.measured.kind == "plain" and self.measured.of_one_map:
            seen = seen + expectation.noise_mean(self.survey, self.pair[0], modes)
        spectra = dict(zip(modes, seen, strict=True))
        return project(self.measured.rows, self.measured.scaling, spectra, self.measured.highest)

    def functions(self, model: Model) -> NDArray:
        """Return g_k(l) at every l of the beams, shape (K, l)."""
        return model.functions(np.arange(self.beams[0].blm.shape[1], dtype=float))

    def leading(self, model: Model) -> Polynomial:
        """Return the data to leading order in the beam, which are linear in the parameters."""
        functions = self.functions(model)
        constant = self.data(0.0 * functions[0])
        linear = np.stack([self.data(function) - constant for function in functions], axis=-1)
        return Polynomial(constant, linear, np.zeros((*linear.shape, len(functions))))

    def exact(self, model: Model) -> Polynomial:
        """Return the data to all orders in the beam.

        Notes
        -----
        The exact A^{LM} is bilinear in the beams of the two maps, hence a polynomial of second degree in theta. Its
        (K + 1)(K + 2)/2 values at 0, +-h_k and h_k + h_l determine it.
        """
        functions = self.functions(model)
        K, step = len(functions), 1.0 / np.abs(functions).max(axis=1)
        scaled = step[:, None] * functions

        def at(factor: NDArray) -> NDArray[np.float64]:
            key = factor.astype(complex).tobytes()
            if key not in self.known:
                self.known[key] = self.data(factor, exact=True)
            return self.known[key]

        constant = at(0.0 * functions[0])
        above, below = (np.stack([at(sign * one) for one in scaled], axis=-1) for sign in (1.0, -1.0))
        linear, even = 0.5 * (above - below), 0.5 * (above + below) - constant[:, None]
        quadratic = np.zeros((len(constant), K, K))
        for k in range(K):
            quadratic[:, k, k] = even[:, k]
            for m in range(k):
                both = at(scaled[k] + scaled[m]) - constant - linear[:, k] - linear[:, m] - even[:, k] - even[:, m]
                quadratic[:, k, m] = quadratic[:, m, k] = 0.5 * both
        return Polynomial(constant, linear / step, quadratic / np.outer(step, step))

    def beyond_leading(self, model: Model, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the approximate difference between all orders and the leading one at theta, shape (p,)."""
        factor, degree = theta @ self.functions(model), max(TRIAL_MOMENTS, *(mode.L for mode in self.measured.modes))
        return self.data(factor, True, degree) - self.data(factor, False, degree)


def templates(survey: Survey, measured: Measurement, nthreads: int = 1) -> Templates:
    """Build the templates of a survey for a measurement.

    Raise InputError for a survey without a spectrum, with another lmax or other maps, or with circular beams.
    """
    expectation.spectrum(survey)
    reach = measured.lmax
    if measured.highest is not None:
        reach = max(reach, *(min(row.ell_max - min(row.mode.d, 0), measured.highest) for row in measured.rows))
    if reach > survey.lmax:
        raise InputError(f"the data reach ell = {reach}, the configuration ends at {survey.lmax}; raise its lmax.")
    pair = _maps_of(survey, measured.pair)
    beams = expectation.scanned_beams(survey, expectation.moments_needed(survey, exact=True), nthreads)
    x, y = (beams[number] for number in pair)
    if x.smax < 2 or y.smax < 2:
        raise InputError(f"a beam of {survey.config.name} is circular, so it has no b_l2 to rescale; give its shape.")
    control = None
    if measured.kind == "difference":
        circular = x.circular, y.circular
        control = expectation.signal(survey, circular, pair, measured.modes, exact=False, nthreads=nthreads)
    made = Templates(measured, survey, pair, (x, y), nthreads, control)
    expected = made.data(np.ones(x.blm.shape[1]))
    if not np.isfinite(expected).all():
        row = measured.rows[int(np.argmin(np.isfinite(expected)))]
        raise InputError(
            f"no coefficient of {row.mode.name} exists at ell = {row.ell_min}-{row.ell_max}; leave the bin out."
        )
    return made


def _rescaled(beam: ScannedBeam, factor: NDArray, L_moments: int | None) -> ScannedBeam:
    """Return a beam with b_l2 f_l, and its moments up to a degree."""
    blm = beam.blm.copy()
    blm[2] *= factor
    if L_moments is None:
        return ScannedBeam(blm, beam.w)
    low, high = beam.L_max - L_moments, beam.L_max + L_moments + 1
    return ScannedBeam(blm, beam.w[:, : L_moments + 1, low:high])


def _maps_of(survey: Survey, pair: str | None) -> tuple[int, int]:
    """Return the indices of the maps of a pair; a single map matches any name."""
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
