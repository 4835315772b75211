"""Simulate responses at the fitted amplitudes, where effects are too strong for a linear response."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy import special

from mcsim.datavector.bent import beyond
from mcsim.datavector.candidate import Candidate, Part, columns_of, parts_of, scatters_of
from mcsim.diagnosis.context import DataSet, DiagnosisContext
from mcsim.diagnosis.crossed import MOVED, cross
from mcsim.diagnosis.partial import PartialExplanation, PartialSearch, has_settled
from mcsim.diagnosis.responses import Responses, steepness
from mcsim.diagnosis.selection import Attribution, Explanation, Selection, attribute
from mcsim.stats.detection import cosines
from mcsim.stats.gaussian import Fit
from mcsim.stats.scattered import GROWS, Acting
from mcsim.support.arrays import Matrix, Vector
from mcsim.systematics import if_possible

ALIKE = 0.7  #: cosine of linear responses from which on one candidate can pass for another
WIDE = 8.0
"""Variance that an effect adds along its own response, over that without it, from which on its scatter is drawn: what
it makes of noise and of the part of the sky that is not known, and what is like it makes otherwise, is no small part of
the difference of the two then."""

BENT = 1.5  #: by which a bend may be larger than it is told, of other skies and at an amplitude that it makes too small
TOGETHER = 3  #: members of the largest sets that are simulated where nothing else explains the data
NEARLY = 0.8  #: share of what the best single candidate explains, from which on others are tried that explain less


@dataclass(frozen=True)
class Refined:
    """Hold an attribution with responses at the amplitudes that it names.

    The ``templates``, shape (p, K), and the ``candidates``, with the scatter of stochastic ones, are those at the
    amplitudes that were simulated; the ``straight`` ones are of small amplitudes. ``partial`` is what is detected if no
    set of candidates is accepted.
    """

    attribution: Attribution
    templates: Matrix
    candidates: tuple[Candidate, ...]
    straight: Matrix
    partial: PartialExplanation | None = None


@dataclass(frozen=True)
class Refiner:
    """Attribute, simulate what was named at its amplitude, and attribute again until nothing changes."""

    data: DataSet

    @property
    def context(self) -> DiagnosisContext:
        """Return the model, its simulations and templates."""
        return self.data.context

    def unrefined(self) -> Refined:
        """Return the attribution by the templates of the model, without any simulation."""
        t, candidates = self.context.templates, self.context.candidates
        return Refined(self._attribute(Responses(t, t, [*candidates])), t, candidates, t)

    def run(
        self,
        t: Matrix,
        candidates: Sequence[Candidate],
        sets: Sequence[tuple[int, ...]] = (),
        start: Matrix | None = None,
    ) -> Refined:
        """Refine templates ``t``, shape (p, K), and the attribution; of ``sets`` all members, named or not.

        The first attribution is by the templates ``start``, shape (p, K); by default ``t``.

        Notes
        -----
        A response that is simulated at its coordinates changes its templates to the secant, exact there. A candidate
        that can have neither the fitted amplitude nor half of it is taken out. Of a stochastic one the scatter of the
        response is kept, of any other one by how much it scatters the data. Where the power of an effect counts,
        which grows as the square of the amplitude, the secant at a_0 finds a^2/a_0 for a: the mean of this and a_0 is
        Newton's step. Of a steeper response two simulations say by how much a falls as a_0 rises. With the scatter that
        it has at the amplitude of a set, a stochastic one may not suffice though it is all: it is tried at the
        amplitude that it has alone, too, and so is what was simulated far from there in a set of effects that are
        alike. Members of the best sets are always simulated, and what is like them where its templates may be why it
        fits worse. A faint gap has the odds of the first templates at most.
        """
        start = t if start is None else start
        now = Responses(t, start.copy(), list(candidates))
        first = found = self._attribute(now)
        for _ in range(self.context.settings.refine_rounds):
            fitted = (part for members in sets for part in self._fitted(now, members)[1])
            tried = [self._simulate(now, *part, curved=True) for part in fitted]
            changed = tried + [self._simulate(now, *part) for part in self._to_try(found, now.candidates)]
            if not any(changed):
                break
            found = self._attribute(now)
        # Members of sets that were named were simulated at once; one by one they no longer are what they were.
        joined = [self._join(now, one.members) for one in reversed(first.explanations[:2] if sets else ())]
        found = self._attribute(now) if any(joined) else found
        now, found = self._with_smaller(now, self._completed(now, found))
        if found.verdict == "unknown" and not (found.faint or sets):
            now, found = self._with_sets(now, found, Responses(t, t.copy(), list(candidates)))
        for index in self._displaced(now, first, found):
            alone = self._alone(now, start, index)
            own = self._completed(alone, self._attribute(alone))
            if (index,) in [one.members for one in own.explanations]:
                now, found = alone, own
        scattered = [i for i, one in enumerate(now.candidates) if one.scatter is not None]
        for index in scattered if all(len(one.members) > 1 for one in found.explanations) else []:
            alone = self._alone(now, start, index)
            own = self._attribute(alone)
            if (index,) in [one.members for one in own.explanations]:
                now, found = alone, own
                break
        detected = PartialSearch(self.data).run(now.t, now.candidates) if found.verdict == "unknown" else None
        if detected is not None and len(detected.members) <= self.context.settings.max_effects:
            done = {member: now.done.get(member) for member in detected.members}
            beside = Responses(now.linear, detected.templates.copy(), [*now.candidates], done)
            beside.crossed.update(now.crossed)
            together = self._completed(beside, self._attribute(beside))
            if together.explanations:
                now, found, detected = beside, together, None
        if found.gap.pvalue > self.context.settings.faint_pvalue:
            # Templates that were simulated at what noise looks like follow noise: the odds of a faint gap are theirs.
            found = replace(found, probability=min(found.probability, first.probability))
        return Refined(found, now.t, tuple(now.candidates), t, detected)

    def _fitted(self, now: Responses, members: Sequence[int]) -> tuple[Fit, list[Part]]:
        """Return the fit of a set, whose members may scatter the data, and its members with their coordinates."""
        null = self.context.null.with_extra_covariance(*scatters_of(now.candidates, members))
        fit = null.fit(self.data.x, now.t[:, columns_of(now.candidates, members)])
        return fit, list(parts_of(now.candidates, members, fit))

    def _cross(self, now: Responses, members: Sequence[int], kept: Sequence[int] = ()) -> bool:
        """Draw what members of a set, not both of ``kept``, scatter together there; return True if anything changed."""
        return cross(self.data, now.candidates, now.crossed, self._fitted(now, members)[1], kept)

    def _join(self, now: Responses, members: Sequence[int]) -> bool:
        """Let templates of several members be those of all at once; return True if that changed anything.

        A wider beam of one channel hides some of the sky that another effect is seen in. Not of a nuisance, whose
        template is that of a prior, nor of what draws its pattern, whose amplitude is found with others round by round.
        """
        own, columns = [now.candidates[member] for member in members], columns_of(now.candidates, members)
        single = len(own) < 2 or any(one.nuisance or one.parametrization.stochastic for one in own)
        if single or (exact := PartialSearch(self.data).together(now.candidates, now.t, members)) is None:
            return False
        change = (exact - now.t)[:, columns] @ self._fitted(now, members)[0].amplitudes
        if np.linalg.norm(self.context.null.whiten_templates(change[:, None])) <= self.context.settings.nonlinear_sigma:
            return False
        now.t[:, columns] = exact[:, columns]
        return True

    def _completed(self, now: Responses, found: Attribution) -> Attribution:
        """Return the attribution once each member of its best sets has been simulated, at the fitted amplitude."""
        rounds = self.context.settings.refine_rounds
        while best := found.explanations[:2]:
            parts = [part for one in best for part in parts_of(now.candidates, one.members, one.fit)]
            untried = {part[0]: part for part in parts if part[0] not in now.done}
            changed = [self._simulate(now, *part) for part in untried.values()]
            changed += [self._simulate_in_place(now, *place) for one in best for place in self._alike(now, one)]
            if (rounds := rounds - 1) >= 0:
                changed += [self._join(now, best[0].members), self._cross(now, best[0].members)]
                changed += [self._cross(now, one.members, kept=best[0].members) for one in best[1:]]
            if not any(changed):
                break
            found = self._attribute(now)
        return found

    def _with_smaller(self, now: Responses, found: Attribution) -> tuple[Responses, Attribution]:
        """Return responses and attribution with a smaller set, if one suffices once it is simulated at its amplitudes.

        Single candidates are simulated at theirs beforehand. What a bent response leaves of the data seems to be more
        effects until it is simulated beside the others that act.
        """
        size = _size(found)
        best = found.explanations[:2] if size > 2 else ()
        parts = [part for one in best for part in combinations(one.members, size - 1)]
        smaller = (one for one in self._in_place(now, size, parts) if 0 < _size(one[1]) < size)
        return next(smaller, (now, found))

    def _with_sets(self, now: Responses, found: Attribution, first: Responses) -> tuple[Responses, Attribution]:
        """Return responses and attribution with a set that suffices once it is simulated from the ``first`` responses.

        Two effects that bend may each explain less alone than others, which are simulated in their place.
        """
        sufficient = (one for one in self._in_place(first, TOGETHER + 1) if one[1].explanations)
        return next(sufficient, (now, found))

    def _in_place(
        self, now: Responses, size: int, sets: Sequence[tuple[int, ...]] = ()
    ) -> Iterator[tuple[Responses, Attribution]]:
        """Yield responses with the members of a set simulated at their amplitudes, and the attribution by them.

        First of ``sets``; then of those that have several members, fewer than a size, and explain nearly as much as the
        best of as many: among these none is of effects whose scatter is drawn.
        """
        chosen = self._selection(now)
        tried = list(sets)
        for fewer in range(2, size):
            ranked = chosen.most_probable(fewer, 2 * self.context.settings.tried)
            most = max((fit.delta_chi2 for _, fit in ranked), default=0.0)
            tried += [members for members, fit in ranked if fit.delta_chi2 >= NEARLY * most]
        for members in dict.fromkeys(tried):
            beside, joined = now.copy(), False
            for _ in range(self.context.settings.refine_rounds):
                for index in () if joined else members:  # one by one they would no longer be what they are at once
                    self._simulate_in_place(beside, tuple(one for one in members if one != index), index)
                joined = self._join(beside, members)
                if not (self._cross(beside, members) or joined):
                    break
            yield beside, self._completed(beside, self._attribute(beside))

    def _alike(self, now: Responses, one: Explanation) -> list[tuple[tuple[int, ...], int]]:
        """Return candidates that were not simulated and are like a member of a set, behind the other members.

        All of them if the residual does not pass without an error of the templates: far from linear responses what is
        tolerated is much, and what is there looks worse than what is like it until it is simulated. Otherwise those
        that leave a dipole in the only channel, and those whose response bends so much there that it may be all that
        they fit worse by.
        """
        tolerated = one.fit.pvalue <= self.context.settings.residual_level
        # In an observed sky that has a strong effect of its own, responses are less alike than in others.
        groups = [own.columns for own in now.candidates]
        each = [cosines(self.context.null.whiten_groups(t, groups)) for t in (now.linear, self.context.templates)]
        cosine = np.maximum(*each)
        found: dict[int, tuple[int, ...]] = {}
        for member in one.members:
            others = tuple(other for other in one.members if other != member)
            taken = {now.candidates[other].identity for other in others}
            for index in np.flatnonzero(cosine[member] >= ALIKE).tolist():
                if index in now.done or now.candidates[index].identity in taken:
                    continue
                if tolerated or self._may_replace(now, one, others, index):
                    found.setdefault(index, others)
        return [(others, index) for index, others in found.items()]

    def _may_replace(self, now: Responses, one: Explanation, others: tuple[int, ...], index: int) -> bool:
        """Return True if an effect fits worse than a set beside others by no more than its bent response may cost it.

        A template that is wrong by b standard deviations raises chi^2 of the true effect by b^2 on average, with a
        scatter of 2 b. By how much the products of a dipole with the observed sky are wrong is not known.
        """
        candidate, settings = now.candidates[index], self.context.settings
        fit, (*_, (_, coordinates, covariance)) = self._fitted(now, (*others, index))
        with if_possible():  # of no such size
            there = candidate.table(candidate.detected(coordinates, covariance))
            if self.data.dipole_snr([there]) > settings.nonlinear_sigma:
                return True
        bend = self._bend(list(candidate.columns), coordinates)
        allowed = (BENT * bend + 2.0) ** 2 + 2.0 * np.log(settings.odds_cut)
        return bend > settings.nonlinear_sigma and fit.chi2 - one.fit.chi2 <= allowed

    def _simulate_in_place(self, now: Responses, others: tuple[int, ...], index: int) -> bool:
        """Simulate a candidate beside others at its amplitude until that settles; return True if anything changed."""
        changed = False
        for _ in range(self.context.settings.refine_rounds):
            _, (*_, part) = self._fitted(now, (*others, index))
            if not self._simulate(now, *part, curved=True):
                break
            changed = True
        return changed

    def _simulate(
        self, now: Responses, index: int, coordinates: Vector, covariance: Matrix, curved: bool = False
    ) -> bool:
        """Simulate a candidate at fitted coordinates, and return True, unless it has been there.

        ``curved``: its second derivative may matter, and is not known.
        """
        candidate = now.candidates[index]
        columns, how, done = list(candidate.columns), candidate.parametrization, now.done.get(index)
        within = candidate.nuisance and not self._is_beyond_prior(now.linear[:, columns], len(now.candidates))
        if within or self._has_been(now, index, coordinates, covariance):
            return False
        bends = (self._bend(columns, one) for one in (coordinates, done) if one is not None)
        nonlinear = curved or how.nonlinear or candidate.nuisance or max(bends) > self.context.settings.nonlinear_sigma
        # From here on its template is what it does to this very sky, and its prior a part of its error.
        candidate = now.candidates[index] = replace(candidate, nuisance=False)
        stochastic = how.stochastic and (how.sign == 0 or coordinates[0] > 0.0)
        if (stochastic or nonlinear) and done is not None:
            share = self._squared(now.linear[:, columns], now.t[:, columns], done)
            if index in now.last:
                share = max(share, steepness(now.last[index], (done, coordinates), covariance))
            now.last[index] = done, coordinates
            coordinates = done + (coordinates - done) / (1.0 + share)
        now.done[index] = now.asked[index] = coordinates
        answer = self._simulated(candidate, coordinates, covariance, stochastic)
        if answer is None:
            if nonlinear or stochastic:
                now.t[:, columns] = 0.0
            return True
        at, changes, pair = answer
        now.done[index] = at
        there = candidate.table(candidate.with_coordinates(at, np.eye(len(at))))
        if stochastic or nonlinear or self.data.changes_sky([there]):
            now.t[:, columns] += beyond(self.context.null, now.t[:, columns], at, changes.mean(axis=0))
        if stochastic:
            now.candidates[index] = replace(candidate, scatter=self.data.scatter(changes), shape_error=None)
        elif pair is not None and not self.context.knows(there):
            groups = [one.columns for one in now.candidates]
            acting = Acting.of(self.context.null, now.t, groups, index, pair)
            if acting.own > GROWS:
                pair = self.data.pair([there], self.context.settings.strong_skies) or pair
                acting = Acting.of(self.context.null, now.t, groups, index, pair)
            if acting.own <= WIDE or how.noise_alone:
                now.candidates[index] = replace(candidate, acting=acting, scatter=None)
            elif candidate.scatter is None or done is None or np.linalg.norm(at - done) > MOVED * np.linalg.norm(at):
                drawn = self.data.respond([there], self.context.settings.scatter_skies)
                now.candidates[index] = replace(candidate, acting=None, scatter=self.data.scatter(drawn))
        return True

    def _has_been(self, now: Responses, index: int, coordinates: Vector, covariance: Matrix) -> bool:
        """Return True if a candidate was simulated about at these coordinates, or at the possible ones next to them."""
        candidate, settings = now.candidates[index], self.context.settings
        if has_settled(settings, now.asked.get(index), coordinates, covariance):
            return True
        with if_possible():
            at = candidate.parametrization.coordinates(candidate.detected(coordinates, covariance))
            return has_settled(settings, now.done.get(index), at, covariance)
        return False

    def _displaced(self, now: Responses, first: Attribution, found: Attribution) -> list[int]:
        """Return candidates that explain less alone than by their first templates, and were simulated elsewhere.

        In a set the amplitudes of effects that are alike can be large and of opposite signs. A response that was
        simulated there says nothing of the amplitude that the effect has alone, to which no other set may lead back.
        """
        return [
            index
            for index, done in now.done.items()
            if (now.candidates[index].scatter is None or not now.candidates[index].parametrization.stochastic)
            and (alone := found.singles[index]).delta_chi2 < first.singles[index].delta_chi2
            and not has_settled(self.context.settings, done, alone.amplitudes, alone.covariance)
        ]

    def _alone(self, now: Responses, start: Matrix, index: int) -> Responses:
        """Return the responses with a candidate at the amplitude that it has alone, by its first templates at first."""
        null, columns = self.context.null, list(now.candidates[index].columns)
        now = now.copy()
        for known in (now.done, now.asked, now.last):
            known.pop(index, None)
        now.t[:, columns] = start[:, columns]
        for pair in [pair for pair in now.crossed if pair[0] == index]:
            del now.crossed[pair]
        now.candidates[index] = replace(now.candidates[index], scatter=None, crossed={})
        for _ in range(self.context.settings.refine_rounds):
            wide = null.with_extra_covariance(*scatters_of(now.candidates, [index]))
            fit = wide.fit(self.data.x, now.t[:, columns])
            if not self._simulate(now, index, fit.amplitudes, fit.covariance):
                break
        return now

    def _attribute(self, now: Responses) -> Attribution:
        return attribute(self._selection(now), self.data.gap)

    def _selection(self, now: Responses) -> Selection:
        known = self.context
        return Selection(known.null, self.data.x, now.t, now.candidates, known.calibration, known.settings)

    def _squared(self, linear: Matrix, t: Matrix, at: Vector) -> float:
        """Return the share of the response of templates at coordinates that is not in the linear ones, 0 to 1."""
        first, whole = self.context.null.whiten_templates(np.stack([linear @ at, t @ at], axis=1)).T
        return float(np.clip(1.0 - first @ whole / max(float(whole @ whole), 1e-300), 0.0, 1.0))

    def _simulated(
        self, candidate: Candidate, coordinates: Vector, covariance: Matrix, stochastic: bool
    ) -> tuple[Vector, Matrix, tuple[Matrix, Matrix] | None] | None:
        """Return coordinates, responses and data without and with the effect at the fitted amplitude or half of it.

        None if the effect can have neither. A linear fit may lie somewhat beyond what the effect can be, and the effect
        be there; far beyond it is not. The data are None of a stochastic effect, and where there are none.
        """
        settings = self.context.settings
        skies = settings.scatter_skies if stochastic else settings.constrained_skies
        for factor in (1.0, 0.5):
            with if_possible():
                effect = candidate.detected(factor * coordinates, factor**2 * covariance)
                tables = [candidate.table(effect)]
                pair = None if stochastic else self.data.pair(tables)
                changes = self.data.respond(tables, skies) if pair is None else pair[1] - pair[0]
                return candidate.parametrization.coordinates(effect), changes, pair
        return None

    def _to_try(self, found: Attribution, candidates: Sequence[Candidate]) -> list[Part]:
        """Return candidates with fitted coordinates: those of the best explanations, or the best single ones."""
        if found.verdict == "none":
            return []
        singles: list[Part] = [(index, one.amplitudes, one.covariance) for index, one in enumerate(found.singles)]
        sets = [part for one in found.explanations[:2] for part in parts_of(candidates, one.members, one.fit)]
        work: dict[int, Part] = {}
        for part in sets + [part for part in singles if candidates[part[0]].nuisance]:
            work.setdefault(part[0], part)
        # Single ones too: a strong effect has a nonlinear response, and a stochastic one scatters it, until only a
        # mixture seems to be sufficient. Where a single one is, the stochastic ones that may be as well.
        alone = bool(found.explanations) and len(found.explanations[0].members) == 1
        tried = 0 if alone else self.context.settings.tried
        explained = np.array([single.delta_chi2 for single in found.singles])
        ranked = [int(index) for index in np.argsort(-explained)]
        # Squares of maps, which a strong effect makes, are fitted best by responses that no effect can have so large.
        inside = [index for index in ranked if candidates[index].beyond(*singles[index][1:]) == 0.0]
        best = {one for among in (ranked, inside) for one in _nearly_best(explained, among, tried)}
        stochastic = {candidates[index].identity for index in work if candidates[index].parametrization.stochastic}
        for index in ranked:
            single, candidate = found.singles[index], candidates[index]
            pvalue = float(self.context.calibration.global_pvalue(single.nested_pvalue))
            draws = candidate.parametrization.stochastic
            detected = draws and (not found.explanations or pvalue <= self.context.settings.stochastic_level)
            detected = detected and (not alone or self._may_suffice(candidate, single))
            if index in best or (detected and candidate.identity not in stochastic):
                work.setdefault(index, singles[index])
                if draws:
                    stochastic.add(candidate.identity)
        return list(work.values())

    def _may_suffice(self, candidate: Candidate, alone: Fit) -> bool:
        """Return True if what a candidate leaves of the data can be an error of its templates, those of other skies."""
        wrong = 0.0 if candidate.shape_error is None else candidate.shape_error**2 * alone.delta_chi2
        pvalue = self.context.null.residual_test(alone.chi2, len(candidate.columns), wrong)
        return bool(pvalue > self.context.settings.residual_level)

    def _is_beyond_prior(self, t: Matrix, candidates: int) -> bool:
        """Return True if data depart along the templates of a nuisance, shape (p, k), by more than its prior explains.

        What else is missing may leave much: chi^2 falls by what the covariance says, without a scale from what is left.
        """
        null = self.context.null
        fall = null.hartlap_factor * null.fit(self.data.x, t).delta_chi2
        return bool(candidates * special.chdtrc(t.shape[1], fall) <= self.context.settings.further_level)

    def _bend(self, columns: list[int], coordinates: Vector) -> float:
        """Return by how many standard deviations a response departs from a straight line at these coordinates."""
        shift = self.context.bank.curvature[:, columns] @ coordinates**2
        crossed = float(np.sum(np.abs(coordinates)) ** 2) / max(float(coordinates @ coordinates), 1e-300)
        return crossed * float(np.linalg.norm(self.context.null.whiten_templates(shift[:, None])))


def _nearly_best(explained: Vector, ranked: Sequence[int], least: int) -> Sequence[int]:
    """Return the first of a ranking that explain nearly as much as the best: as many as ``least``, or up to twice."""
    nearly = sum(explained[one] >= NEARLY * explained[ranked[0]] for one in ranked)
    return ranked[: min(max(least, int(nearly)), 2 * least)]


def _size(found: Attribution) -> int:
    """Return the number of members of the smallest set; 0 without one."""
    return min((len(one.members) for one in found.explanations), default=0)
