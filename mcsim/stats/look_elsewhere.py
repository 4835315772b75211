"""Correct for the look-elsewhere effect: a global p-value for many tests, and for many correlated deviations."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special
from scipy.linalg import solve_triangular

from mcsim.errors import InputError
from mcsim.sphere.rng import generator
from mcsim.stats.gaussian import COLLINEAR, SimulatedGaussian, WhitenedTemplates, nested_pvalue, residual_pvalue

# Scatter matrices drawn for a calibration. Each serves many data vectors: it costs a thousand times as much.
SCATTERS = 200

FEWEST = 20  #: simulations that deviations are ranked among

TAIL = 10  #: held-out simulations beyond which their ranks say nothing


@dataclass(frozen=True)
class Calibration:
    """Hold the joint null distribution of the omnibus p-value and the smallest p-value of the candidates."""

    tests: int  #: number of candidates to which the data respond
    #: smallest, combined: sorted draws of the smallest p-value of the candidates, and of the smaller one of the omnibus
    #: p-value and the global p-value of the candidates
    smallest: NDArray[np.float64]
    combined: NDArray[np.float64]
    #: held_out_smallest, held_out_combined: sorted p-values, as these draws give them, of simulations against the
    #: others; None: Gaussian data are trusted
    held_out_smallest: NDArray[np.float64] | None = None
    held_out_combined: NDArray[np.float64] | None = None
    #: of the global p-value of the candidates: below 1 if that of simulations against others is too often small, above
    #: 1 if too seldom
    power: float = 1.0

    def global_pvalue(self, smallest: ArrayLike) -> NDArray[np.float64]:
        """Return the probability that the smallest p-value of all candidates is this one or less.

        This is its rank among the draws, or Bonferroni's bound if that is lower, beyond the reach of the draws.
        """
        found = np.minimum(_rank(self.smallest, smallest), max(self.tests, 1) * np.asarray(smallest))
        return _among(self.held_out_smallest, found**self.power)

    def combine(self, omnibus: ArrayLike, smallest: ArrayLike) -> NDArray[np.float64]:
        """Return one p-value from that of the omnibus test and the smallest one of the candidates."""
        least = np.minimum(omnibus, self.global_pvalue(smallest))
        return _among(self.held_out_combined, np.minimum(_rank(self.combined, least), 2.0 * least))


def _rank(draws: NDArray[np.float64], value: ArrayLike) -> NDArray[np.float64]:
    rank = np.searchsorted(draws, np.asarray(value), side="right")
    return np.asarray((1.0 + rank) / (1.0 + len(draws)), dtype=np.float64)


def _among(held_out: NDArray[np.float64] | None, pvalue: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rank of p-values among those of held-out simulations; below the lowest TAIL, a power of them.

    Notes
    -----
    Tails of simulations that are not quite Gaussian are too heavy: the further out, the more. If the rank is a power a
    of p, the logarithms of the TAIL lowest are exponential, and (TAIL - 2)/sum log(p_TAIL/p_i) is an unbiased estimate
    of a (Hill, Ann. Stat. 3, 1163, 1975; Weissman, JASA 73, 812, 1978), which is not let above 1: of Gaussian
    simulations. Rates far out: tests/statistical/test_tail.py.
    """
    if held_out is None:
        return pvalue
    edge, share = held_out[TAIL - 1], (1.0 + TAIL) / (1.0 + len(held_out))
    spread = float(np.sum(np.log(edge / np.maximum(held_out[: TAIL - 1], 1e-300))))
    power = min(1.0, (TAIL - 2.0) / max(spread, 1e-300))
    return np.where(pvalue >= edge, _rank(held_out, pvalue), share * (np.minimum(pvalue, edge) / edge) ** power)


def calibrate_on(
    calibration: Calibration, null: SimulatedGaussian, candidates: WhitenedTemplates, simulations: NDArray[np.float64]
) -> Calibration:
    """Return a calibration whose p-values are uniform over the simulations of ``null``, shape (N, p_raw).

    For data vectors that are not quite Gaussian: each simulation is tested against all others.

    Notes
    -----
    With c = x_i - mean, S the scatter matrix of all N and a = N/(N - 1) c'S^-1 c, the scatter of the others is that
    less N/(N - 1) c c' (Sherman & Morrison, Ann. Math. Stat. 21, 124, 1950). So chi^2 is (N - 2) a/(1 - a), and its
    fall by templates (N - 2) b/((1 - a)(1 - a + b)), b the part of a that is along them. Against explicit refits:
    tests/unit/test_nuisances.py.
    """
    count, p, n = len(simulations), null.dimension, null.dof - 1
    white = (simulations - simulations.mean(axis=0)) @ null.whitening.T
    scale = count / (count - 1.0) / null.dof
    a, b = scale * np.sum(white**2, axis=1), scale * candidates.delta_chi2(white)
    rest = np.maximum(1.0 - a, 1e-12)
    chi2, falls = n * a / rest, n * b / (rest[:, None] * (rest[:, None] + b))
    smallest = nested_pvalue(falls, chi2[:, None], candidates.sizes, p, n).min(axis=1)
    found = replace(calibration, held_out_smallest=np.sort(calibration.global_pvalue(smallest)))
    combined = found.combine(residual_pvalue(chi2, p, n, scale=null.scale_variance), smallest)
    return replace(found, held_out_combined=np.sort(combined))


def calibrate_in_folds(calibration: Calibration, null: SimulatedGaussian, candidates: WhitenedTemplates) -> Calibration:
    """Return a calibration for a shrunk covariance, by its simulations against those of other folds.

    Notes
    -----
    Such a covariance is better for some templates than for others, so that the smallest p-value is too small; or for
    all templates than for what is drawn like the data, so that it is too large. If p^a is uniform, log p has the mean
    -1/a: the power is estimated by maximum likelihood, within a/sqrt(N).
    """
    if not calibration.tests:
        return calibration
    chi2, falls = [], []
    for fold in null.folds:
        turned = fold.turn @ candidates.basis
        pairs = zip(candidates.start[:-1], candidates.start[1:], strict=True)
        basis = np.concatenate([np.linalg.qr(turned[:, low:high])[0] for low, high in pairs], axis=1)
        chi2.append(np.sum(fold.white**2, axis=1))
        falls.append(replace(candidates, basis=basis).delta_chi2(fold.white))
    total = np.concatenate(chi2)
    scores = null.nested_test(np.concatenate(falls), total[:, None], candidates.sizes)
    found = calibration.global_pvalue(scores.min(axis=1))
    return replace(calibration, power=-1.0 / float(np.mean(np.log(np.maximum(found, 1e-300)))))


def calibrate(
    null: SimulatedGaussian, candidates: WhitenedTemplates, draws: int = 20_000, seed: int = 0
) -> Calibration:
    """Draw data and scatter matrices without any effect, for the geometry of the candidates.

    Notes
    -----
    Let u be the data's part in the span of all templates, of rank r, and v the q = p - r others. Then v'S^-1 v ~
    q/(n - q + 1) F(q, n - q + 1), u - S_uv S_vv^-1 v = sqrt(1 + v'S_vv^-1 v) z with z normal, and S_u.v ~ W_r(n - q),
    all independent: r dimensions are drawn instead of p. The true metric is taken to be the estimated one. Uniform
    for p = 20, N = 200 and p = 100, N = 1000: tests/statistical/test_diagnose_statistics.py.
    """
    n, p = null.dof, null.dimension
    rng = generator(seed, 0, "diagnose/calibration")
    sizes = candidates.sizes
    _, singular, right = np.linalg.svd(candidates.basis, full_matrices=False)
    r = int((singular > COLLINEAR).sum())
    q, each = p - r, -(-draws // SCATTERS)
    coordinates = singular[:r, None] * right[:r]
    columns = {int(k): candidates.start[:-1][sizes == k, None] + np.arange(k) for k in np.unique(sizes[sizes > 0])}
    omnibus, smallest = np.empty((SCATTERS, each)), np.ones((SCATTERS, each))
    for row in range(SCATTERS):
        rest = q / (n - q + 1) * rng.f(q, n - q + 1, each) if q else np.zeros(each)
        root = np.tril(rng.normal(size=(r, r)), -1) + np.diag(np.sqrt(rng.chisquare(n - q - np.arange(r))))
        y = solve_triangular(root, rng.normal(size=(r, each)), lower=True) * np.sqrt(1.0 + rest)
        white = solve_triangular(root, coordinates, lower=True)
        total = n * (rest + np.sum(y**2, axis=0))
        omnibus[row] = residual_pvalue(total, p, n)
        for k, index in columns.items():
            basis = np.linalg.qr(np.moveaxis(white[:, index], 0, 1))[0]
            delta_chi2 = n * np.max(np.sum((np.swapaxes(basis, 1, 2) @ y) ** 2, axis=1), axis=0)
            smallest[row] = np.minimum(smallest[row], nested_pvalue(delta_chi2, total, k, p, n))
    first = Calibration(int((sizes > 0).sum()), np.sort(smallest.ravel()), np.empty(0))
    least = np.minimum(omnibus.ravel(), first.global_pvalue(smallest.ravel()))
    return replace(first, combined=np.sort(least))


@dataclass(frozen=True)
class GlobalTest:
    """Hold the global p-value, its two parts, and the most significant candidate."""

    pvalue: float  #: uniform if the model is right
    #: chi2, dimension, omnibus: chi^2 of the data, its degrees of freedom, and its p-value
    chi2: float
    dimension: int
    omnibus: float
    #: maximum, best: global p-value of the most significant candidate, and its index
    maximum: float
    best: int


def global_test(
    null: SimulatedGaussian, x: NDArray[np.float64], candidates: WhitenedTemplates, calibration: Calibration
) -> GlobalTest:
    """Test data, shape (p_raw,), with chi^2 and with every candidate, and combine both into one p-value."""
    y = null.whiten(x)
    chi2 = float(y @ y)
    scores = null.nested_test(candidates.delta_chi2(y), chi2, candidates.sizes)
    best, omnibus = int(np.argmin(scores)), float(null.residual_test(chi2))
    return GlobalTest(
        pvalue=float(calibration.combine(omnibus, scores[best])),
        chi2=chi2,
        dimension=null.dimension,
        omnibus=omnibus,
        maximum=float(calibration.global_pvalue(scores[best])),
        best=best,
    )


def scan_pvalues(
    x: NDArray[np.float64], simulations: NDArray[np.float64], held_out: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the deviations of many correlated numbers ``x``, shape (..., B), and their global p-values.

    The deviations are normal deviates; the p-value of one is the probability that the largest |z| of all is at least as
    large. ``simulations`` has the shape (N, B), N >= FEWEST. ``held_out``, of the same shape, are the deviations of
    each of them from others; None: from all others.

    Notes
    -----
    Each simulation is compared with others (leave one out), as the data are with all. p is the rank of |z| among the
    maxima of the simulations; beyond the largest, 1 - (1 - p_1)^B_eff of the normal p_1, with the effective number of
    trials B_eff fitted by maximum likelihood to the upper tenth of the maxima.
    """
    count = len(simulations)
    if count < FEWEST:
        raise InputError(f"{count} simulations are too few to rank deviations; give at least {FEWEST}.")
    if held_out is None:
        centred = simulations - simulations.mean(axis=0)
        # Of N values without the i-th: mean moves by -c/(N-1), the sum of squares falls by c^2 N/(N-1).
        left = np.sum(centred**2, axis=0) - centred**2 * count / (count - 1)
        others = np.sqrt(np.maximum(left, 0.0) / (count - 2))
        held_out = _normal(centred * np.sqrt(count / (count - 1)) / others, count - 2)
    maxima, z = np.max(np.abs(held_out), axis=1), deviations(x, simulations)
    exceeding = count - np.searchsorted(np.sort(maxima), np.abs(z), side="left")
    waits = np.sort(-np.log1p(-2.0 * special.ndtr(-maxima)))
    upper = max(10, count // 10)
    trials = max(upper / (np.sum(waits[:upper]) + (count - upper) * waits[upper - 1]), 1.0)
    beyond = -np.expm1(trials * np.log1p(-np.minimum(2.0 * special.ndtr(-np.abs(z)), 1.0 - 1e-12)))
    ranked = (1.0 + exceeding) / (1.0 + count)
    return z, np.where(exceeding > 0, ranked, np.minimum(ranked, beyond))


def deviations(x: NDArray[np.float64], simulations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the normal deviates of numbers, shape (..., B), that simulations, shape (N, B), do not know."""
    count, spread = len(simulations), simulations.std(axis=0, ddof=1)
    return _normal((x - simulations.mean(axis=0)) / spread / np.sqrt(1.0 + 1.0 / count), count - 1)


def deviates_of_means(ratio: NDArray[np.float64], complex_: NDArray[np.bool_], count: int) -> NDArray[np.float64]:
    """Return the normal deviates of the two-sided probabilities of means over their errors, >= 0.

    ``ratio``: the modulus of a mean of ``count`` draws over its standard error, of real numbers or, where ``complex_``,
    of complex ones, whose parts have equal variances and whose error is that of both together. Zero for a single draw.

    Notes
    -----
    Of t with n = ``count`` - 1 degrees of freedom, p = I_x(n/2, 1/2), x = n/(n + t^2), is x^(n/2) (1 - x)^(-1/2) over
    n/2 B(n/2, 1/2) where it is so small that it underflows. Of F with 2 and 2 n it is (1 + t^2/n)^-n.
    """
    n = count - 1.0
    if n < 1.0:
        return np.zeros(np.shape(ratio))
    t = np.abs(np.asarray(ratio))
    more, p = np.log1p(t**2 / n), 2.0 * special.stdtr(n, -t)
    far = -0.5 * (n * more + np.log(np.maximum(-np.expm1(-more), 1e-300))) - np.log(0.5 * n)
    of_real = np.where(p > 1e-290, np.log(np.maximum(p, 1e-300)), far - special.betaln(0.5 * n, 0.5))
    return np.asarray(np.abs(special.ndtri_exp(np.where(complex_, -n * more, of_real) - np.log(2.0))))


def _normal(t: NDArray[np.float64], dof: int) -> NDArray[np.float64]:
    """Return the normal deviate of the same probability as a Student t."""
    return -np.sign(t) * special.ndtri(np.maximum(special.stdtr(dof, -np.abs(t)), 1e-300))
