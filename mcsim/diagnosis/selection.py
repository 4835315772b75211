"""Select the smallest sets of candidates that explain the data, and what would tell these sets apart."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from typing import Literal

import numpy as np
from scipy import special

from mcsim.datavector.candidate import Candidate, beyond, columns_of, crossed_by, scatters_of
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.consistency import Findings
from mcsim.diagnosis.subsets import EXHAUSTIVE, Subsets, chunks
from mcsim.stats.gaussian import Fit, SimulatedGaussian
from mcsim.stats.look_elsewhere import Calibration, GlobalTest, global_test
from mcsim.stats.scattered import Acting, Groups, variance_beside
from mcsim.support.arrays import Matrix, Rows, Vector

SCATTERED = 2  #: members of a set at most whose scatter is known

Verdict = Literal["none", "effect", "mixture", "degenerate", "unknown"]


@dataclass(frozen=True)
class Explanation:
    """Describe an accepted set of candidates, the ``members``, by their indices.

    ``fit`` has the amplitudes of their columns, one member after the other; ``odds`` are posterior odds relative to
    the best explanation, <= 1; ``pvalue`` is that of the residual, with errors of the templates tolerated, and
    ``further`` the global p-value of the most significant further candidate. ``findings`` compare its amplitudes in
    parts of the data.
    """

    members: tuple[int, ...]
    fit: Fit
    odds: float
    pvalue: float
    further: float
    findings: Findings = field(default_factory=Findings)


@dataclass(frozen=True)
class Contrast:
    """Say what would tell two explanations, given by their indices, apart.

    ``separation`` is the white norm of the difference of their fitted predictions; ``elements`` of the data vector
    stand with the most discriminating first, beside their ``shares`` of the squared norm, which add up to 1 and can be
    negative.
    """

    first: int
    second: int
    separation: float
    elements: tuple[int, ...]
    shares: tuple[float, ...]


@dataclass(frozen=True)
class Attribution:
    """Hold the verdict on a data vector."""

    #: "none" if the model describes the data, "unknown" if no set is accepted, "degenerate" if several are, else
    #: "effect" or "mixture"
    verdict: Verdict
    gap: GlobalTest  #: global test of the data against the model
    #: explanations, contrasts: minimal accepted sets, the most probable first, and each pair of them; empty for "none"
    #: and "unknown"
    explanations: tuple[Explanation, ...]
    #: nearest, cosine: candidate that lowers chi^2 most, and the cosine between its best fit and the departure from the
    #: model, without noise
    nearest: int
    cosine: float
    singles: tuple[Fit, ...]  #: fit of each candidate alone
    contrasts: tuple[Contrast, ...]
    #: posterior probability of the accepted sets beside no effect, an unknown effect and every effect alone that is in
    #: none of them; the three kinds (no effect, known, unknown) are equally probable before, and look-elsewhere is
    #: charged for
    probability: float = 1.0
    #: effect alone that makes it small: it is more probable than no effect and an unknown one together, and does not
    #: suffice
    rival: int | None = None
    faint: bool = False  #: True if it is too small for a name for another reason
    contradicted: tuple[Explanation, ...] = ()  #: sets that parts of the data contradict, or leave improbable

    def if_named(self, settings: DiagnosisSettings) -> "Attribution":
        """Return the attribution without its explanations if these are less probable than all else together."""
        if not self.explanations or self.probability >= settings.named_probability:
            return self
        return replace(self.unexplained(), faint=self.rival is None or self.gap.pvalue > settings.faint_pvalue)

    def of(self, explanations: Sequence[Explanation]) -> "Attribution":
        """Return the attribution with some explanations, the most probable first, with odds against that one."""
        ranked = sorted(explanations, key=lambda one: -one.odds)
        explanations = tuple(replace(one, odds=one.odds / ranked[0].odds) for one in ranked)
        kept = {one.members: place for place, one in enumerate(explanations)}
        places = [kept.get(one.members) for one in self.explanations]
        contrasts = tuple(
            replace(one, first=min(first, second), second=max(first, second))
            for one in self.contrasts
            if (first := places[one.first]) is not None and (second := places[one.second]) is not None
        )
        return replace(self, verdict=_verdict(False, explanations), explanations=explanations, contrasts=contrasts)

    def unexplained(self) -> "Attribution":
        """Return the same attribution with the verdict "unknown" and no explanation."""
        return replace(self, verdict="unknown", explanations=(), contrasts=())


def attribute(selection: "Selection", gap: GlobalTest | None = None) -> Attribution:
    """Attribute a departure of data from the model to the smallest sets of candidates that explain it.

    ``gap``: the test of the data against the model, with templates that do not follow from the data: what is measured
    anew once they were looked at would be another chance. None: the test with the templates of the selection.

    Notes
    -----
    A set is sufficient if its residual passes (``residual_level``) and no candidate of another identity is significant
    beside it (``further_level``); it is reported if no part of it is sufficient. Each of several candidates must be
    significant beside the others, or the residual is that of something unknown; and several must be more probable than
    an unknown effect of the same prior S/N in an isotropic direction. Candidates of one identity compete by evidence
    alone. A gap that is faint has many explanations, no effect among them: see ``probability`` of the attribution.
    A stochastic effect scatters the data: sets with a member whose scatter is known are tested with a null
    distribution to which it is added, and such a member alone has to be significant and probable like several. A
    template that is wrong by a fraction eps of its white norm leaves eps^2 s_c^2 in the residual, s_c the white norm of
    its fitted part (at most that of the whole fit); the sum over members makes both tests noncentral, in the least
    favourable direction. The prior of a set is k! times the product of its candidates' shares of the weight.
    """
    null, candidates, settings = selection.null, selection.candidates, selection.settings
    first = selection.searches[0]
    groups, y = first.groups, first.y
    found = global_test(null, selection.x, groups, selection.calibration) if gap is None else gap
    delta_chi2 = groups.delta_chi2(y)
    nearest = int(np.argmax(delta_chi2))
    signal = null.hartlap_factor * delta_chi2[nearest] - groups.sizes[nearest]
    excess = max(null.hartlap_factor * float(y @ y) - null.dimension, signal, 1e-300)
    accepted = selection.accepted() if found.pvalue <= settings.alpha else []
    probability, rival = selection.probability(accepted) if accepted else (0.0, None)
    explanations = tuple(selection.explanations(accepted))
    return Attribution(
        verdict=_verdict(found.pvalue > settings.alpha, explanations),
        gap=found,
        explanations=explanations,
        nearest=nearest,
        cosine=float(np.sqrt(max(signal, 0.0) / excess)),
        singles=tuple(selection.fit(first, (place,)) for place in range(len(candidates))),
        contrasts=tuple(selection.contrasts(explanations)),
        probability=probability,
        rival=rival,
    )


def _verdict(agrees: bool, explanations: Sequence[Explanation]) -> Verdict:
    if agrees:
        return "none"
    if len(explanations) != 1:
        return "degenerate" if explanations else "unknown"
    return "mixture" if len(explanations[0].members) > 1 else "effect"


@dataclass(frozen=True, order=True)
class _Accepted:
    """Hold a minimal sufficient set and the search that it was found in; ordered by evidence."""

    evidence: float
    members: tuple[int, ...]
    pvalue: float
    further: float
    search: Subsets = field(compare=False)


@dataclass(frozen=True)
class Selection:
    """Select among sets of candidates."""

    null: SimulatedGaussian  # distribution of the data vector without an effect
    x: Vector  # data, (p_raw,)
    t: Matrix  # templates per unit amplitude, (p_raw, K)
    candidates: Sequence[Candidate]
    calibration: Calibration  # :func:`~mcsim.stats.look_elsewhere.calibrate` of the candidates in this order
    settings: DiagnosisSettings = field(default_factory=DiagnosisSettings)
    _fits: dict[tuple[Subsets, tuple[int, ...]], Fit] = field(default_factory=dict, init=False)

    def explanations(self, accepted: Sequence[_Accepted]) -> Iterator[Explanation]:
        """Yield the most probable first; of those that differ in settings other than a split the most probable one."""
        seen: set[frozenset[tuple[str, str | None, str | None]]] = set()
        ranked = sorted(accepted, reverse=True)
        for found in ranked:
            claims = frozenset(self.candidates[member].claim for member in found.members)
            lost = ranked[0].evidence - found.evidence
            if lost <= np.log(self.settings.odds_cut) and claims not in seen:
                seen.add(claims)
                best = self.fit(found.search, found.members)
                yield Explanation(found.members, best, float(np.exp(-lost)), found.pvalue, found.further)

    def contrasts(self, explanations: Sequence[Explanation]) -> Iterator[Contrast]:
        """Yield each pair of explanations with the elements in which their predictions differ most."""
        null = self.null
        predictions = [self.t[:, columns_of(self.candidates, one.members)] @ one.fit.amplitudes for one in explanations]
        for first, second in combinations(range(len(predictions)), 2):
            difference = predictions[first] - predictions[second]
            white = null.whiten_templates(difference[:, None])[:, 0]
            squared = float(white @ white)
            shares = difference * (null.whitening.T @ white) / np.sqrt(1.0 + 1.0 / null.n_sims) / max(squared, 1e-300)
            order = np.argsort(-shares)
            yield Contrast(first, second, float(np.sqrt(squared)), tuple(order.tolist()), tuple(shares[order].tolist()))

    def probability(self, accepted: Sequence[_Accepted]) -> tuple[float, int | None]:
        """Return the posterior probability of accepted sets, and their rival; see :class:`Attribution`.

        A part of an accepted set is no rival of the names in it.
        """
        searches = self.searches
        known = dict[tuple[int, ...], float]()
        for search in searches:
            for subsets in search.rows(1):
                evidence = search.solve(subsets).evidence.tolist()
                alone = (
                    _Accepted(e, (int(k),), 0.0, 0.0, search)
                    for e, k in zip(evidence, subsets[:, 0], strict=True)
                    if not any(k in found.members for found in accepted)
                )
                known = {one.members: one.evidence for one in self._possible(alone)} | known
        own = special.logsumexp([one.evidence for one in accepted])
        others = special.logsumexp([-np.inf, *known.values()])
        neither = np.logaddexp(self.null.log_likelihood(searches[0].total), searches[0].unknown)
        rival = max(known, key=known.__getitem__)[0] if others > neither else None
        return float(np.exp(own - special.logsumexp([own, others, neither]))), rival

    def accepted(self) -> list[_Accepted]:
        """Return minimal sufficient sets that are possible and whose evidence is not below the best by the cut.

        All sets of up to EXHAUSTIVE members are tried; larger ones grow from those. The search ends one size above the
        first accepted set.
        """
        accepted: list[_Accepted] = []
        searches = self.searches
        subsets: list[list[Rows]] = [[] for _ in searches]
        best, unknown, cut = -np.inf, searches[0].unknown, np.log(self.settings.odds_cut)
        for size in range(1, self.settings.max_effects + 1):
            if accepted and size > max(len(accepted[0].members) + 1, EXHAUSTIVE):
                break
            fresh: list[_Accepted] = []
            for place, search in enumerate(searches):
                # With thousands of sets to choose from, some triple comes close to anything; so does a wide scatter.
                doubted = size > 1 or bool(search.scattered)
                least = max(best - cut, unknown if doubted else -np.inf)
                every = size - len(search.scattered) <= EXHAUSTIVE
                tried = search.rows(size) if every else search.grown(subsets[place])
                subsets[place] = [_without(rows, [found.members for found in accepted]) for rows in tried]
                for rows in subsets[place]:
                    fresh += self._possible(_sufficient(search, rows, least, doubted))
            accepted += fresh
            best = max([best, *(found.evidence for found in fresh)])
        return accepted

    def most_probable(self, size: int, count: int) -> list[tuple[tuple[int, ...], Fit]]:
        """Return the most probable sets of a size with their fits, whether they suffice or not."""
        search = self.searches[0]
        tried = list(search.rows(min(size, EXHAUSTIVE)))
        for _ in range(EXHAUSTIVE, size):
            tried = list(search.grown(tried))
        found = [
            (evidence, tuple(members))
            for subsets in tried
            for rows in chunks(subsets)
            for evidence, members in zip(search.solve(rows).evidence.tolist(), rows.tolist(), strict=True)
        ]
        return [(members, self.fit(search, members)) for _, members in sorted(found, reverse=True)[:count]]

    @cached_property
    def searches(self) -> list[Subsets]:
        """Return a search of sets without a member whose scatter is known, and of each combination of few such members.

        A candidate with which these scatter together is in all sets of a search, or in none: each set is in one search
        alone. Combinations of candidates that exclude each other are left out.
        """
        scatters = [index for index, candidate in enumerate(self.candidates) if candidate.scatter is not None]
        most = self.settings.max_effects
        drawn = [own for size in range(min(SCATTERED, most) + 1) for own in combinations(scatters, size)]
        beside = [(own, crossed_by(self.candidates, own)) for own in drawn]
        sets = [(*own, *more) for own, others in beside for k in range(most + 1) for more in combinations(others, k)]
        identities = [{self.candidates[member].identity for member in members} for members in sets]
        return [
            self.search(members)
            for members, own in zip(sets, identities, strict=True)
            if len(own) == len(members) <= most
        ]

    def search(self, members: Sequence[int]) -> Subsets:
        """Return the search of sets with all of the members whose scatter is known, alone or together with these."""
        drawn = [member for member in members if self.candidates[member].scatter is not None]
        beside = set(crossed_by(self.candidates, drawn))
        own = (*drawn, *(member for member in members if member in beside))
        columns, known = [candidate.columns for candidate in self.candidates], scatters_of(self.candidates, own)
        wide = self.null.with_extra_covariance(*known)
        variance = variance_beside(self.null, self.t, columns, drawn, known)
        groups, y = wide.whiten_groups(self.t, columns), wide.whiten(self.x)
        # What others add to the scatter is less over the scatter of these.
        each = self.candidates if not known else list(self._acting_beside(wide, columns))
        return Subsets(wide, y, groups, each, self.calibration, self.settings, own, variance)

    def _acting_beside(self, wide: SimulatedGaussian, columns: Groups) -> Iterator[Candidate]:
        """Yield the candidates with what they add to the scatter of data of another distribution."""
        for place, one in enumerate(self.candidates):
            pair = None if one.acting is None else one.acting.pair
            yield one if pair is None else replace(one, acting=Acting.of(wide, self.t, columns, place, pair))

    def _possible(self, found: Iterable[_Accepted]) -> Iterator[_Accepted]:
        """Yield the sets whose fitted amplitudes are possible, with the evidence of the nearest ones within bounds."""
        for one in found:
            distance = beyond(self.candidates, one.members, self.fit(one.search, one.members))
            if np.isfinite(distance):
                yield replace(one, evidence=one.evidence - 0.5 * distance**2)

    def fit(self, search: Subsets, members: tuple[int, ...]) -> Fit:
        """Return the fit of a set, with the distribution of a search; it is kept."""
        if (search, members) not in self._fits:
            found = search.null.fit(self.x, self.t[:, columns_of(self.candidates, members)])
            self._fits[search, members] = found
        return self._fits[search, members]


def _without(rows: Rows, accepted: Sequence[tuple[int, ...]]) -> Rows:
    """Return the subsets that have no accepted part."""
    kept = np.ones(len(rows), dtype=bool)
    for part in accepted:
        kept &= ~np.all([np.any(rows == member, axis=1) for member in part], axis=0)
    return rows[kept]


def _sufficient(search: Subsets, subsets: Rows, least: float, doubted: bool) -> Iterator[_Accepted]:
    """Yield the sufficient ones of subsets of the same ranks; each member of doubted ones has to be significant."""
    settings = search.settings
    for rows in chunks(subsets):
        solved = search.solve(rows)
        kept = (solved.pvalue > settings.residual_level) & (solved.evidence >= least)
        if doubted:
            kept[kept] &= search.least_needed(rows[kept]) <= settings.further_level
        further = search.beside(rows[kept]).min(axis=1) if kept.any() else np.empty(0)
        numbers = zip(solved.evidence[kept], solved.pvalue[kept], further, rows[kept].tolist(), strict=True)
        for evidence, pvalue, beside, members in numbers:
            if beside > settings.further_level:
                yield _Accepted(float(evidence), tuple(members), float(pvalue), float(beside), search)
