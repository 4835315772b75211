"""Which effect: all subsets of up to three candidates, those that suffice, and what would tell them apart."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.candidate import Candidate, allowed, columns_of
from mcsim.diagnosis.subsets import Subsets
from mcsim.stats.detection import cosines
from mcsim.stats.gaussian import Fit, SimulatedGaussian, fit, whitened_templates
from mcsim.stats.look_elsewhere import Calibration, GlobalTest, global_test

Verdict = Literal["none", "effect", "mixture", "degenerate", "unknown"]

LARGEST = 3
"""Candidates that may act together."""

# Subsets that are solved at once; bounds the memory to some 100 MB.
CHUNK = 1000


@dataclass(frozen=True)
class Explanation:
    """A subset of candidates that suffices.

    Attributes
    ----------
    members
        Indices of the candidates.
    fit
        Amplitudes of the members' columns, one member after the other.
    odds
        Posterior odds against the best explanation, <= 1.
    probability, further
        Of the residual, model errors allowed for, and of the most significant further candidate, trials included.
    """

    members: tuple[int, ...]
    fit: Fit
    odds: float
    pvalue: float
    further: float


@dataclass(frozen=True)
class Contrast:
    """What would tell two explanations apart.

    Attributes
    ----------
    first, second
        Indices into the explanations.
    separation
        White distance of their fitted predictions.
    entries, shares
        Entries of the evidence, the most telling first, and their shares of the squared distance; shares add up to 1
        and can be negative.
    """

    first: int
    second: int
    separation: float
    elements: NDArray[np.int64]
    shares: NDArray[np.float64]


@dataclass(frozen=True)
class Attribution:
    """Verdict on evidence.

    Attributes
    ----------
    verdict
        "none" without a gap, "unknown" where no subset suffices, "degenerate" where several do, else "effect" or
        "mixture".
    explanations
        Minimal subsets that suffice, the most probable first; empty for "none" and "unknown".
    nearest, cosine
        Candidate that lowers chi2 most, and the cosine of its best fit to what departs from the null, noise removed.
    singles
        Fit of each candidate alone.
    correlation
        Largest canonical correlation of each pair of candidates, shape (C, C).
    """

    verdict: Verdict
    gap: GlobalTest
    explanations: tuple[Explanation, ...]
    nearest: int
    cosine: float
    singles: tuple[Fit, ...]
    correlation: NDArray[np.float64]
    contrasts: tuple[Contrast, ...]

    def unexplained(self) -> "Attribution":
        """The same as "unknown", where something else says that no set is to be named."""
        return replace(self, verdict="unknown", explanations=(), contrasts=())


def attribute(
    null: SimulatedGaussian,
    x: NDArray[np.float64],
    t: NDArray[np.float64],
    candidates: Sequence[Candidate],
    calibration: Calibration,
    *,
    alpha: float = 0.05,
    levels: tuple[float, float] = (0.02, 0.005),
    largest: int = LARGEST,
    odds_cut: float = 100.0,
    shape_error: float = 0.01,
) -> Attribution:
    """Attribute a gap to the smallest sets of candidates that suffice.

    Parameters
    ----------
    null, x
        Null and evidence, shape (p_raw,).
    t
        Templates per unit amplitude, shape (p_raw, K).
    candidates, calibration
        Candidates on those templates, and :func:`~mcsim.stats.look_elsewhere.calibrate` of them in this order.
    alpha
        Level of the gap.
    levels
        Of acceptance: a true set is refused as often as this by its residual, and by a further candidate. High levels
        lose true sets, low ones miss that something is unknown.
    largest
        Number of candidates that may act together.
    odds_cut
        Explanations less probable than the best by this factor are dropped.
    shape_error
        Relative error of templates.

    Notes
    -----
    A subset suffices when its residual passes and no candidate of another identity is significant beside it; it is
    reported when no part of it suffices. Each of several candidates must be significant beside the others, or the
    residual is that of something unknown; and several must be more probable than an unknown effect of the same prior
    strength in an isotropic direction. Candidates of one identity compete by evidence alone. An effect that draws
    scatters the evidence: sets with such a member whose scatter is known are judged with a null that is widened by it,
    and one alone has to be significant and probable like several. A template that is wrong by a fraction eps of its
    white length leaves eps^2 s_c^2 in the residual, s_c the white length of its fitted part (at most that of the whole
    fit); the sum over members makes both tests noncentral, in the direction that hurts most.
    The prior of a subset is k! times the product of its candidates' shares of the weight.
    """
    groups = whitened_templates(null, t, [candidate.columns for candidate in candidates])
    searches = list(_searches(null, x, t, candidates, calibration, shape_error, largest))
    y = null.whiten(x)
    found = global_test(null, x, groups, calibration)
    delta_chi2 = groups.delta_chi2(y)
    nearest = int(np.argmax(delta_chi2))
    signal = null.unbiased * delta_chi2[nearest] - groups.sizes[nearest]
    excess = max(null.unbiased * float(y @ y) - null.dimension, signal, 1e-300)
    explanations: tuple[Explanation, ...] = ()
    if found.pvalue <= alpha:
        possible = partial(_possible, x, t, candidates)
        accepted = _accepted(searches, levels, largest, np.log(odds_cut), possible)
        explanations = tuple(_explanations(x, t, candidates, accepted, np.log(odds_cut)))
    return Attribution(
        verdict=_verdict(found.pvalue > alpha, explanations),
        gap=found,
        explanations=explanations,
        nearest=nearest,
        cosine=float(np.sqrt(max(signal, 0.0) / excess)),
        singles=tuple(fit(null, x, t[:, list(candidate.columns)]) for candidate in candidates),
        correlation=cosines(groups),
        contrasts=tuple(_contrasts(null, t, candidates, explanations)),
    )


def _verdict(agrees: bool, explanations: Sequence[Explanation]) -> Verdict:
    if agrees:
        return "none"
    if not explanations:
        return "unknown"
    if len(explanations) > 1:
        return "degenerate"
    return "mixture" if len(explanations[0].members) > 1 else "effect"


def _searches(
    null: SimulatedGaussian,
    x: NDArray[np.float64],
    t: NDArray[np.float64],
    candidates: Sequence[Candidate],
    calibration: Calibration,
    shape_error: float,
    largest: int,
) -> Iterator[Subsets]:
    """One for subsets without a member whose scatter is known, first, and one for each combination of such members."""
    columns, names = [c.columns for c in candidates], [c.identity for c in candidates]
    prior = np.array([candidate.prior for candidate in candidates])
    errors = np.array([shape_error if c.shape_error is None else c.shape_error for c in candidates])
    scatters = {index: c.scatter for index, c in enumerate(candidates) if c.scatter is not None}
    for size in range(largest + 1):
        for drawn in combinations(scatters, size):
            if len({names[index] for index in drawn}) < size:
                continue
            wide = null.with_extra_covariance(*(scatters[index] for index in drawn))
            groups = whitened_templates(wide, t, columns)
            yield Subsets(wide, wide.whiten(x), groups, names, prior, errors, calibration, scatters, drawn)


@dataclass(frozen=True, order=True)
class _Accepted:
    """A minimal sufficient subset, and the null that it was judged with; ordered by evidence."""

    evidence: float
    members: tuple[int, ...]
    pvalue: float
    further: float
    null: SimulatedGaussian = field(compare=False)


def _possible(
    x: NDArray[np.float64],
    t: NDArray[np.float64],
    candidates: Sequence[Candidate],
    null: SimulatedGaussian,
    members: tuple[int, ...],
) -> bool:
    """Whether no member would need an amplitude that it cannot have."""
    if not any(candidates[member].positive or np.isfinite(candidates[member].max_amplitude) for member in members):
        return True
    return allowed(candidates, members, fit(null, x, t[:, columns_of(candidates, members)]))


def _accepted(
    searches: Sequence[Subsets],
    levels: tuple[float, float],
    largest: int,
    cut: float,
    possible: Callable[[SimulatedGaussian, tuple[int, ...]], bool],
) -> list[_Accepted]:
    """Minimal sufficient subsets that are possible, unless their evidence is below the best one's by over ``cut``."""
    accepted: list[_Accepted] = []
    best, unknown = -np.inf, searches[0].unknown
    for size in range(1, largest + 1):
        fresh: list[_Accepted] = []
        for search in searches:
            # With thousands of sets to choose from, some triple comes close to anything; so does a wide scatter.
            doubted = size > 1 or bool(search.drawn)
            least = max(best - cut, unknown if doubted else -np.inf)
            for subsets in search.rows(size, [found.members for found in accepted]):
                fresh += _sufficient(search, subsets, levels, least, doubted, possible)
        accepted += fresh
        best = max([best, *(found.evidence for found in fresh)])
    return accepted


def _sufficient(
    search: Subsets,
    subsets: NDArray[np.int64],
    levels: tuple[float, float],
    least: float,
    doubted: bool,
    possible: Callable[[SimulatedGaussian, tuple[int, ...]], bool],
) -> Iterator[_Accepted]:
    """Of subsets of the same ranks those that suffice; of doubted ones every member has to be significant."""
    solved = search.solve(subsets)
    passing = np.flatnonzero((solved.pvalue > levels[0]) & (solved.evidence >= least))
    for first in range(0, len(passing), CHUNK):
        rows = passing[first : first + CHUNK]
        further = search.further(subsets[rows], solved.chi2[rows], solved.allowance[rows])
        alone = further > levels[1]
        if doubted:
            alone &= search.least_needed(subsets[rows]) <= levels[1]
        for row, beside in zip(rows[alone], further[alone], strict=True):
            members = tuple(int(member) for member in subsets[row])
            if possible(search.null, members):
                numbers = float(solved.evidence[row]), members, float(solved.pvalue[row]), float(beside)
                yield _Accepted(*numbers, search.null)


def _explanations(
    x: NDArray[np.float64],
    t: NDArray[np.float64],
    candidates: Sequence[Candidate],
    accepted: Sequence[_Accepted],
    cut: float,
) -> Iterator[Explanation]:
    """The most probable first; of those that differ only in settings the most probable one."""
    seen: set[frozenset[tuple[str, str | None]]] = set()
    ranked = sorted(accepted, reverse=True)
    for found in ranked:
        identity = frozenset(candidates[member].identity for member in found.members)
        lost = ranked[0].evidence - found.evidence
        if lost <= cut and identity not in seen:
            seen.add(identity)
            best = fit(found.null, x, t[:, columns_of(candidates, found.members)])
            yield Explanation(found.members, best, float(np.exp(-lost)), found.pvalue, found.further)


def _contrasts(
    null: SimulatedGaussian,
    t: NDArray[np.float64],
    candidates: Sequence[Candidate],
    explanations: Sequence[Explanation],
) -> Iterator[Contrast]:
    """Each pair of explanations, and the entries in which their predictions differ by most of their distance."""
    predictions = [
        t[:, columns_of(candidates, explanation.members)] @ explanation.fit.amplitudes for explanation in explanations
    ]
    for first, second in combinations(range(len(predictions)), 2):
        difference = predictions[first] - predictions[second]
        white = null.whiten_templates(difference[:, None])[:, 0]
        squared = float(white @ white)
        shares = difference * (null.whitening.T @ white) / np.sqrt(1.0 + 1.0 / null.count) / max(squared, 1e-300)
        order = np.argsort(-shares)
        yield Contrast(first, second, float(np.sqrt(squared)), order, shares[order])
