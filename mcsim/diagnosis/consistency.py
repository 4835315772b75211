"""Compare the amplitude of an effect in independent parts of the data: a name must agree with all of them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import special

from mcsim.datavector.candidate import Candidate
from mcsim.datavector.null_ensemble import NullEnsemble
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.slices import northern
from mcsim.datavector.summaries import Element, bins, scales
from mcsim.sphere.rotation import FRAMES
from mcsim.stats.excess import scatter_chi2
from mcsim.stats.gaussian import Fit, SimulatedGaussian, Tolerated
from mcsim.stats.scattered import with_scatter
from mcsim.support.arrays import Matrix, Rows, Vector, divided
from mcsim.support.numbers import number, p_equals
from mcsim.systematics import Effect, acts_through

LARGE = 12  #: highest degree of the largest scales
SPARE, SPARE_SHRUNK = 2.0, 1.25  #: simulations per element that a comparison needs; with a shrunk covariance
FOLDS = {
    "noise": ("even pixels", "odd pixels"),
    "fine": ("even pixels", "odd pixels"),
    "sky": ("even degrees", "odd degrees"),
    "isotropy": ("lower degrees", "higher degrees"),
}
"""Folds of elements of no split, by their kind."""


@dataclass(frozen=True)
class Comparison:
    """Hold the amplitudes of one effect in independent parts of the data, beside the other effects of its set."""

    #: kind, slices: what the data are divided by ("halves", "degrees", "hemispheres", "splits", "map": the largest
    #: scales of one map, against all of the data), and the parts in words
    kind: str
    slices: tuple[str, ...]
    #: amplitudes, errors: of each part, over the amplitude of the fit
    amplitudes: tuple[float, ...]
    errors: tuple[float, ...]
    pvalue: float  #: probability that amplitudes are so different if the effect acts
    odds: float = 1.0  #: odds of no effect against this one in the data without the part that supports it most


@dataclass(frozen=True)
class MapCheck:
    """Hold chi^2 of the largest scales of a channel's maps before and after a set of effects is taken out.

    ``forecast`` is the expected fall; ``pvalue`` that of what is left, in ``dof`` degrees of freedom.
    """

    maps: tuple[str, ...]
    before: float
    after: float
    forecast: float
    dof: int
    pvalue: float


@dataclass(frozen=True)
class Findings:
    """Hold the comparisons of each effect of a set, and the checks of maps, with the global p-value of all of them."""

    comparisons: tuple[tuple[Comparison, ...], ...] = ()
    maps: tuple[MapCheck, ...] = ()

    def with_further(self, comparisons: Sequence[tuple[Comparison, ...]]) -> "Findings":
        """Return findings with further comparisons of each effect."""
        pairs = zip(self.comparisons, comparisons, strict=True)
        return replace(self, comparisons=tuple(own + further for own, further in pairs))

    @property
    def pvalue(self) -> float:
        """Return the smallest p-value times the number of tests: Bonferroni's bound."""
        each = [one.pvalue for own in self.comparisons for one in own] + [one.pvalue for one in self.maps]
        return min(1.0, len(each) * min(each)) if each else 1.0

    @property
    def odds(self) -> float:
        """Return the largest odds of no effect against one of the effects, in the data without one part.

        They are over the number of comparisons that tell such odds, each of which has the chance of them.
        """
        each = [one.odds for own in self.comparisons for one in own if len(one.slices) > 1]
        return max(each) / len(each) if each else 1.0

    @property
    def bound(self) -> float:
        """Return by which factor, at the least, the comparisons can make the set less probable; 1 if by none.

        -e p ln p is the lower bound of the odds that a p-value leaves (Sellke, Bayarri & Berger, Am. Stat. 55, 62,
        2001).
        """
        p = max(self.pvalue, 1e-300)
        return min(-p * np.log(p) * np.exp(1.0) if p < np.exp(-1.0) else 1.0, 1.0 / max(self.odds, 1.0))

    def contradict(self, settings: DiagnosisSettings) -> bool:
        """Return True if parts of the data contradict one another, or most of them the effect."""
        return self.pvalue <= settings.consistency_level or self.odds >= settings.absence_odds

    @property
    def measured(self) -> bool:
        """Return True if independent parts have measured the amplitude of every effect."""
        return bool(self.comparisons) and all(any(len(one.slices) > 1 for one in own) for own in self.comparisons)


@dataclass(frozen=True)
class Action:
    """Describe what a fitted effect does to the data and the numbers beside them, p + E together.

    ``response`` is that at the fitted amplitude, shape (p + E,), and ``error`` the relative error of the amplitude;
    ``directions``, shape (p + E, K - 1), are the responses to changes of its parameters that leave the amplitude.
    ``scatters``, shape (p + E, draws), have the deviations of the draws of a stochastic effect, and of what it does
    together with others; ``growth`` is the factor of the variance of noise, and so of the standard deviation of its
    power, and ``wider`` that of the errors of amplitudes with the effect in the data. ``pair`` are data of the same
    skies without the effect and with it, (skies, p + E) each.
    """

    response: Vector
    directions: Matrix
    error: float
    scatters: tuple[Matrix, ...] = ()
    growth: float = 1.0
    wider: float = 1.0
    pair: tuple[Matrix, Matrix] | None = None

    @classmethod
    def of(
        cls, response: Vector, t: Matrix, theta: Vector, covariance: Matrix, scatters: Sequence[Matrix] = ()
    ) -> "Action":
        """Make it from the response and templates, shape (p + E, K), fitted with these amplitudes."""
        weight = np.linalg.pinv(covariance) @ theta
        snr = float(weight @ theta)
        # Independent of the amplitude in the metric of the fit.
        rest = np.linalg.svd(weight[None])[2][1:].T
        return cls(response, t @ rest, 1.0 / np.sqrt(max(snr, 1.0)), tuple(scatters))


@dataclass(frozen=True)
class Division:
    """Divide elements, the ``rows``, into parts: ``keep`` are matrices that keep a part, (rows, rows) each."""

    kind: str
    words: tuple[str, ...]
    rows: Rows
    keep: tuple[Matrix, ...]


@dataclass(frozen=True)
class Slices:
    """Test sets of effects in parts of a data vector and of the numbers beside it.

    ``ensemble`` and ``z``, shape (p + E,), are both together; the last E elements are the numbers beside. ``folds``
    are those of the data vector in words, and ``lmax`` is its highest degree.
    """

    ensemble: NullEnsemble
    z: Vector
    beside: int
    folds: tuple[str, str]
    lmax: int
    settings: DiagnosisSettings
    scatters: tuple[Matrix, ...] = ()  # of stochastic effects, (p + E, draws), that add to the covariance
    #: of rows that were needed so far, by the bytes of their indices
    nulls: dict[bytes, SimulatedGaussian] = field(default_factory=dict, repr=False)

    def findings(self, candidates: Sequence[Candidate], actions: Sequence[Action]) -> Findings:
        """Test a set of effects by what each does to the data.

        Notes
        -----
        The amplitudes of a comparison, the directions of all effects and the amplitudes of the others are fitted
        together; that the amplitudes are equal is Rao's exact small-sample test
        (:func:`mcsim.stats.gaussian.nested_pvalue`), correlations of the parts included. Parts in which the effect has
        an expected S/N below ``slice_snr`` are left out. Responses are tolerated to be wrong by ``consistency_error``
        of their white norm. Odds without the best part are those of amplitude 0 against 1 in all others. The scatter of
        stochastic effects is a part of the covariance.
        """
        scatters = tuple(scatter for action in actions for scatter in action.scatters)
        if scatters and not self.scatters:
            return replace(self, scatters=scatters, nulls={}).findings(candidates, actions)
        # More noise, or a pattern that is drawn, is more of chi^2: what is left in the maps then says nothing of it.
        noisy = any(acts_through(one.effect, "noise") or one.parametrization.stochastic for one in candidates)
        free = np.concatenate([action.directions for action in actions], axis=1)
        comparisons = []
        for place, (candidate, action) in enumerate(zip(candidates, actions, strict=True)):
            others = [other.response for k, other in enumerate(actions) if k != place]
            beside = np.column_stack([free, *others])
            divisions = self._divisions(candidate, action.response)
            own = [one for part in divisions if (one := self._compared(part, action, beside)) is not None]
            if len(candidates) == 1 and not noisy:
                own += self._of_maps(candidate.channel, action)
            comparisons.append(tuple(own))
        channels = {candidate.channel for candidate in candidates}
        names = {element.channels[0] for element in self.ensemble.elements[len(self.z) - self.beside :]}
        seen = sorted(names if None in channels else {one for one in channels if one is not None})
        checks = (self._left(channel, actions, free) for channel in ([] if noisy else seen))
        return Findings(tuple(comparisons), tuple(check for check in checks if check is not None))

    def _folds(self, own: Sequence[tuple[int, Element]], response: Vector) -> tuple[str, str]:
        """Return what the folds are in words, of the kind of elements in which a response shows most."""
        sizes: dict[str, float] = {}
        for row, e in own:
            if e.fold is not None:
                sizes[e.kind] = sizes.get(e.kind, 0.0) + float(response[row] / self.ensemble.spread[row]) ** 2
        return FOLDS.get(max(sizes, key=lambda kind: sizes[kind], default=""), self.folds)

    def _divisions(self, candidate: Candidate, response: Vector) -> Iterator[Division]:
        each = [(row, e) for row, e in enumerate(self.ensemble.elements) if e.statistic != "score"]
        own = [(row, e) for row, e in each if candidate.channel is None or set(e.channels) == {candidate.channel}]
        first = len(self.z) - self.beside
        halves = [[row for row, e in own if e.fold == fold] for fold in (0, 1)]
        yield _of_rows("halves", self._folds(own, response), halves)
        noisy = acts_through(candidate.effect, "noise")  # it shows in differences of splits, and in pixels
        ends = {e for e in (LARGE, max(LARGE, bins(2, self.lmax, 2)[0][1])) if e < self.lmax}
        edges = [e for _, e in scales(self.lmax)] if noisy else sorted({*ends, self.lmax})
        starts = (0, *(edge + 1 for edge in edges))
        words = tuple(f"ℓ {low}–{high}" for low, high in zip(starts, edges, strict=False))
        degrees: list[list[int]] = [[] for _ in edges]
        for row, e in own:
            if e.ell is not None:
                place = sum(e.ell[1] > edge for edge in edges[:-1])
                if place < len(edges) - 1 or e.ell[0] >= starts[place]:
                    degrees[place].append(row)
        if noisy:
            words, degrees = (*words, "single pixels"), [*degrees, [row for row, e in own if e.kind == "noise"]]
        yield _of_rows("degrees", words, degrees)
        beside = [(row, e) for row, e in own if row >= first]
        for frame in FRAMES if beside else ():
            north = northern([e for _, e in beside], frame)
            words = tuple(f"the {frame} {side}" for side in ("north", "south"))
            rows = np.array([row for row, _ in beside])
            yield Division("hemispheres", words, rows, (north, np.eye(len(rows)) - north))

    def null(self, rows: Rows) -> SimulatedGaussian | None:
        """Return the null distribution of some elements; None if there are too few simulations, or none of these."""
        spare = SPARE_SHRUNK if self.ensemble.shrunk else SPARE
        if not 0 < len(rows) <= len(self.ensemble.simulations) // spare:
            return None
        key = rows.tobytes()
        if key not in self.nulls:
            own = self.ensemble.restrict(rows).gaussian
            self.nulls[key] = own.with_extra_covariance(*(one[rows] for one in self.scatters))
        return self.nulls[key]

    def _compared(self, division: Division, action: Action, others: Matrix) -> Comparison | None:
        """Return the comparison of a division's parts; None if the effect does not show in two of them."""
        response = action.response
        division = self._clear(division, response, action.growth > 1.0)
        if len(division.keep) < 2 or (null := self.null(division.rows)) is None:
            return None
        rows = division.rows
        x, beside, count = self.z[rows], others[rows], others.shape[1]
        parts = [one @ response[rows] for one in division.keep]
        whole = null.fit(x, np.column_stack([beside, response[rows]]))
        apart = null.fit(x, np.column_stack([beside, *parts]))
        wider = self._wider(null, np.column_stack([beside, *parts]), apart, action, rows, slice(count, None))
        amplitudes, errors = apart.amplitudes[count:], wider * apart.errors[count:]
        fitted, further = null.dimension - whole.dimension, whole.dimension - apart.dimension
        if further < 1 or np.any(errors == 0.0):
            return None
        allowance = self._tolerated(null, whole.amplitudes[-1] * response[rows])
        more, chi2 = max(whole.chi2 - apart.chi2, 0.0) / wider**2, whole.chi2 / action.growth**2
        p = float(null.nested_test(more, chi2, further, fitted, Tolerated(allowance)))
        best = int(np.argmax(amplitudes / errors))
        found = null.fit(x, np.column_stack([beside, parts[best], sum(parts) - parts[best]]))
        variance = (wider * found.errors[-1]) ** 2 + action.error**2 + self.settings.consistency_error**2
        odds = float(np.exp(min((0.5 - found.amplitudes[-1]) / variance, 100.0)))
        return Comparison(division.kind, division.words, tuple(amplitudes.tolist()), tuple(errors.tolist()), p, odds)

    def _wider(self, null: SimulatedGaussian, t: Matrix, fit: Fit, action: Action, rows: Rows, own: slice) -> float:
        """Return by how much errors of amplitudes grow with the effect in the data, at least as they do in all data.

        They are the ``own`` of a fit of templates, (rows, K): a part may be made of what the effect scatters most.
        """
        if action.pair is None:
            return action.wider
        grown = with_scatter(null, t, fit, *(each[:, rows] for each in action.pair))
        return max(action.wider, float(np.max(divided(grown.errors, fit.errors, 1.0)[own])))

    def _clear(self, division: Division, response: Vector, known: bool) -> Division:
        """Return a division without parts in which a response does not show; neighbours that do together are one."""
        rows, least = division.rows, self.settings.slice_snr * (0.5 if known else 1.0)
        kept: list[Matrix] = []
        words: list[str] = []
        null = self.null(rows)
        if null is None:
            return replace(division, keep=())
        pending, names = np.zeros((len(rows), len(rows))), list[str]()
        for keep, word in zip(division.keep, division.words, strict=True):
            pending, names = pending + keep, [*names, word]
            if null.expected_snr(pending @ response[rows]) >= least:
                kept, words = [*kept, pending], [*words, " and ".join(names)]
                pending, names = np.zeros_like(pending), []
        inside = np.flatnonzero(np.sum(kept, axis=0).any(axis=1)) if kept else np.arange(0)
        return replace(
            division, rows=rows[inside], keep=tuple(one[np.ix_(inside, inside)] for one in kept), words=tuple(words)
        )

    def _tolerated(self, null: SimulatedGaussian, *changes: Vector) -> float:
        """Return the squared S/N of the errors of changes of elements that are tolerated."""
        return sum((self.settings.consistency_error * null.expected_snr(change)) ** 2 for change in changes)

    def _maps(self, channel: str | None) -> dict[str, list[int]]:
        """Return the rows beside the data vector of each map of a channel, or of all, by name."""
        found: dict[str, list[int]] = {}
        for row in range(len(self.z) - self.beside, len(self.z)):
            e = self.ensemble.elements[row]
            if channel is None or e.channels == (channel,):
                found.setdefault(" ".join(filter(None, (e.channels[0], e.split))), []).append(row)
        return found

    def _of_maps(self, channel: str | None, action: Action) -> Iterator[Comparison]:
        """Yield the amplitude in each map's largest scales, against that of the fit with its relative error.

        A map is a part of the data of the fit: by how much both amplitudes vary together follows from the simulations.
        """
        response, seen = action.response, list[tuple[str, Rows, SimulatedGaussian]]()
        for name, members in self._maps(channel).items():
            rows = np.array(members)
            null = self.null(rows)
            if null is not None and null.expected_snr(response[rows]) >= self.settings.slice_snr:
                seen.append((name, rows, null))
        whole = self._amplitudes(np.arange(len(self.z) - self.beside), action) if seen else None
        for name, rows, null in seen:
            t = np.column_stack([response[rows], action.directions[rows]])
            found = null.fit(self.z[rows], t)
            wider = self._wider(null, t, found, action, rows, slice(1))
            amplitude, own = float(found.amplitudes[0]), wider * float(found.errors[0])
            each = self._amplitudes(rows, action)
            alike = 0.0 if whole is None or each is None else float(np.corrcoef(each, whole)[0, 1])
            apart = own**2 + action.error**2 - 2.0 * alike * own * action.error
            tolerated = np.sqrt(apart + self.settings.consistency_error**2)
            p = float(2.0 * special.stdtr(found.dof, -abs(amplitude - 1.0) / tolerated)) if own > 0.0 else 1.0
            yield Comparison("map", (name,), (amplitude,), (own,), p)

    def _amplitudes(self, rows: Rows, action: Action) -> Vector | None:
        """Return the amplitude that elements give to an effect in each simulation, shape (N,); None if in none."""
        null = self.null(rows)
        if null is None or not action.response[rows].any():
            return None
        t = null.whiten_templates(np.column_stack([action.response[rows], action.directions[rows]]))
        return np.asarray(self.ensemble.simulations[:, rows] @ (np.linalg.pinv(t)[0] @ null.whitening))

    def _left(self, channel: str, actions: Sequence[Action], directions: Matrix) -> MapCheck | None:
        """Return chi^2 of a channel's largest scales before and after effects, and their scatter; None if not known."""
        maps = self._maps(channel)
        rows = np.array([row for members in maps.values() for row in members], dtype=np.int64)
        null = self.null(rows)
        if null is None:
            return None
        x, responses = self.z[rows], np.column_stack([action.response for action in actions])
        t, count = np.column_stack([responses[rows], directions[rows]]), responses.shape[1]
        found = null.fit(x, t)
        fitted = null.dimension - found.dimension  # which takes as much of chi^2 from chance
        forecast = null.expected_snr(t[:, :count].sum(axis=1)) ** 2 + fitted
        tolerated = self._tolerated(null, *(t * found.amplitudes)[:, :count].T)
        pairs = [action.pair for action in actions if action.pair is not None]
        each = [scatter_chi2(null, t, before[:, rows], after[:, rows]) for before, after in pairs]
        added, spread = (sum(one) for one in zip((tolerated, 0.0), *each, strict=True))
        p = float(null.residual_test(found.chi2, fitted, added, spread))
        scale = null.hartlap_factor
        return MapCheck(tuple(maps), scale * null.chi2(x), scale * found.chi2, forecast, found.dimension, p)


def _of_rows(kind: str, words: tuple[str, ...], parts: Sequence[Sequence[int]]) -> Division:
    """Return a division into parts of rows by themselves."""
    rows = np.array([row for part in parts for row in part], dtype=np.int64)
    which = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    return Division(kind, words, rows, tuple(np.diag((which == k).astype(float)) for k in range(len(parts))))


def contradiction(findings: Findings, candidates: Sequence[Candidate], effects: Sequence[Effect], level: float) -> str:
    """Return in words the part of the data that contradicts a set of effects, at this level of the p-value."""
    pairs = zip(candidates, effects, findings.comparisons, strict=True)
    each = [(candidate, effect, one) for candidate, effect, own in pairs for one in own]
    worst = min((one.pvalue for _, _, one in each), default=1.0)
    if findings.pvalue > level:
        candidate, effect, one = max(each, key=lambda own: own[2].odds)
        return (
            f"{candidate.title} would be {amplitudes(one, effect)}; without the part that supports it most, the data "
            f"are {number(one.odds, 2)} times as probable without it"
        )
    left = min(findings.maps, key=lambda one: one.pvalue, default=None)
    if left is not None and left.pvalue < worst:
        maps, before, after = " and ".join(left.maps), number(left.before), number(left.after)
        return (
            f"the largest scales of {maps} do not agree with it: χ² is {before} before and {after} after it is taken "
            f"out, for {left.dof} degrees of freedom ({p_equals(left.pvalue)})"
        )
    candidate, effect, one = min(each, key=lambda own: own[2].pvalue)
    return f"{candidate.title} would be {amplitudes(one, effect)} ({p_equals(one.pvalue)})"


def amplitudes(one: Comparison, effect: Effect) -> str:
    """Return the amplitudes of a comparison in words, in the unit of the effect at its fitted amplitude."""
    parts, size = zip(one.slices, one.amplitudes, one.errors, strict=True), effect.amplitude
    words = [f"{effect.format_amplitude(a * size, sigma * abs(size))} in {where}" for where, a, sigma in parts]
    words += [f"{effect.format_amplitude(size)} in all of the data"] * (one.kind == "map")
    return " and ".join(words)
