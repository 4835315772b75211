"""Simulate responses at the fitted amplitudes, where effects are too strong for a linear response."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.candidate import Candidate, columns_of, effects_at, parts_of
from mcsim.diagnosis.context import DataSet, DiagnosisContext
from mcsim.diagnosis.partial_explanation import Detection, PartialExplanation
from mcsim.diagnosis.selection import Attribution, attribute
from mcsim.errors import InputError
from mcsim.stats.gaussian import Fit, SimulatedGaussian, orthonormal

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Refined:
    """Hold an attribution with responses at the amplitudes that it names.

    The ``templates``, shape (p, K), and the ``candidates``, with the scatter of stochastic ones, are those at the
    amplitudes that were simulated; ``partial`` is what is detected if no set of candidates is accepted.
    """

    attribution: Attribution
    templates: Matrix
    candidates: tuple[Candidate, ...]
    partial: PartialExplanation | None = None


@dataclass(frozen=True)
class Refiner:
    """Attribute, simulate what was named at its amplitude, and attribute again until nothing changes."""

    data: DataSet

    @property
    def context(self) -> DiagnosisContext:
        """Return the model, its simulations and templates."""
        return self.data.context

    def run(self, t: Matrix, candidates: Sequence[Candidate]) -> Refined:
        """Refine templates ``t``, shape (p, K), and the attribution.

        Notes
        -----
        A response that is simulated at its coordinates changes its templates to the secant, exact there. A candidate
        that can have neither the fitted amplitude nor half of it is taken out. Of a stochastic one the scatter of the
        response is kept.
        """
        t, tried = t.copy(), list(candidates)
        done: dict[int, Vector] = {}
        found = self._attribute(t, tried)
        for _ in range(self.context.settings.refine_rounds):
            changed = False
            for index, coordinates, covariance in self._to_try(found, tried):
                if candidates[index].nuisance:
                    continue
                columns, how = list(candidates[index].columns), candidates[index].effect.parametrization
                nonlinear = self._is_nonlinear(columns, coordinates)
                stochastic = how.stochastic and (how.sign == 0 or coordinates[0] > 0.0)
                if not (nonlinear or stochastic) or self._has_settled(done.get(index), coordinates, covariance):
                    continue
                done[index] = coordinates
                answer = self._simulated(candidates[index], coordinates, covariance, stochastic)
                changed = True
                if answer is None:
                    t[:, columns] = 0.0
                    continue
                at, changes = answer
                response = changes.mean(axis=0)
                if stochastic:
                    # The scatter of one draw about the mean of as many as there are.
                    share = (1.0 / self.data.realizations + 1.0 / len(changes)) / (len(changes) - 1.0)
                    scatter = np.sqrt(share) * (changes - response).T
                    tried[index] = replace(tried[index], scatter=scatter, shape_error=None)
                if nonlinear:
                    t[:, columns] += self._beyond(t[:, columns], at, response)
            if not changed:
                break
            found = self._attribute(t, tried)
        detected = None
        if found.verdict == "unknown":
            detected = self.detected_in(t, tried)
            if detected is not None and len(detected.members) <= self.context.settings.max_effects:
                together = self._attribute(detected.templates, tried)
                if together.explanations:
                    t, found, detected = detected.templates, together, None
        return Refined(found, t, tuple(tried), detected)

    def detected_in(self, t: Matrix, candidates: Sequence[Candidate]) -> PartialExplanation | None:
        """Return the effects that are detected, each set simulated together at its amplitudes."""
        known, exact = self.context, partial(self._together, candidates)
        return Detection(known.null, self.data.x, candidates, known.calibration, exact, known.settings).run(t)

    def _attribute(self, t: Matrix, candidates: Sequence[Candidate]) -> Attribution:
        known = self.context
        return attribute(known.null, self.data.x, t, candidates, known.calibration, known.settings)

    def _together(
        self, candidates: Sequence[Candidate], t: Matrix, members: tuple[int, ...], fitted: Fit
    ) -> Matrix | None:
        """Return templates that are exact for effects that act together, at about their fitted amplitudes.

        Strong effects change their own responses and each other's. None if one can have no such amplitude, or the
        amplitudes diverge round by round.
        """
        columns = np.array(columns_of(candidates, members))
        for _ in range(self.context.settings.joint_rounds):
            try:
                effects = effects_at(candidates, members, fitted)
                tables = [candidates[member].table(effect) for member, effect in zip(members, effects, strict=True)]
                stochastic = any(effect.parametrization.stochastic for effect in effects)
                response = self.data.respond(tables, self._skies(stochastic)).mean(axis=0)
            except InputError:
                return None
            t = t.copy()
            at = np.concatenate([effect.parametrization.coordinates(effect) for effect in effects])
            t[:, columns] += self._beyond(t[:, columns], at, response)
            before, fitted = fitted, self.context.null.fit(self.data.x, t[:, columns])
            if self._has_converged(before.amplitudes, fitted):
                return t
        return None

    def _skies(self, stochastic: bool) -> int:
        return self.context.settings.scatter_skies if stochastic else self.context.settings.constrained_skies

    def _beyond(self, t: Matrix, at: Vector, response: Vector) -> Matrix:
        """Return what makes templates, shape (p, k), exact at coordinates: the response beyond their sum.

        It is shared in proportion to the squared white norms of the parts, so that a weakly constrained one, whatever
        its fitted coordinate, does not change.
        """
        parts = t * at
        weights = np.sum(self.context.null.whiten_templates(parts) ** 2, axis=0)
        shares = np.divide(weights, at * weights.sum(), out=np.zeros_like(at), where=weights > 0.0)
        return np.outer(response - parts.sum(axis=1), shares)

    def _simulated(
        self, candidate: Candidate, coordinates: Vector, covariance: Matrix, stochastic: bool
    ) -> tuple[Vector, Matrix] | None:
        """Return coordinates and responses at the fitted amplitude or half of it; None if the effect can have neither.

        A linear fit may lie somewhat beyond what the effect can be, and the effect be there; far beyond it is not.
        """
        for factor in (1.0, 0.5):
            try:
                effect = candidate.detected(factor * coordinates, covariance / factor**2)
                response = self.data.respond([candidate.table(effect)], self._skies(stochastic))
                return effect.parametrization.coordinates(effect), response
            except InputError:
                continue
        return None

    def _to_try(self, found: Attribution, candidates: Sequence[Candidate]) -> list[tuple[int, Vector, Matrix]]:
        """Return candidates with fitted coordinates: those of the best explanations, or the best single ones."""
        work: dict[int, tuple[int, Vector, Matrix]] = {}
        if found.verdict == "none":
            return []
        for explanation in found.explanations[:2]:
            for part in parts_of(candidates, explanation.members, explanation.fit):
                work.setdefault(part[0], part)
        if found.explanations and len(found.explanations[0].members) == 1:
            return list(work.values())
        # Single ones too: a strong effect has a nonlinear response, and a stochastic one scatters it, until only a
        # mixture seems to be sufficient.
        ranked = [int(index) for index in np.argsort([-single.delta_chi2 for single in found.singles])]
        stochastic = {
            candidates[index].identity for index in work if candidates[index].effect.parametrization.stochastic
        }
        for place, index in enumerate(ranked):
            single, candidate = found.singles[index], candidates[index]
            pvalue = float(self.context.calibration.global_pvalue(single.nested_pvalue))
            detected = candidate.effect.parametrization.stochastic and pvalue <= self.context.settings.stochastic_level
            if place < self.context.settings.tried or (detected and candidate.identity not in stochastic):
                work.setdefault(index, (index, single.amplitudes, single.covariance))
                if candidate.effect.parametrization.stochastic:
                    stochastic.add(candidate.identity)
        return list(work.values())

    def _is_nonlinear(self, columns: list[int], coordinates: Vector) -> bool:
        """Return True if the second derivative matters at these coordinates."""
        shift = self.context.bank.curvature[:, columns] @ coordinates**2
        crossed = float(np.sum(np.abs(coordinates)) ** 2) / max(float(coordinates @ coordinates), 1e-300)
        size = float(np.linalg.norm(self.context.null.whiten_templates(shift[:, None])))
        return crossed * size > self.context.settings.nonlinear_sigma

    def _has_converged(self, before: Vector, now: Fit) -> bool:
        """Return True if amplitudes have hardly moved, by their errors, or by their size if the errors are tiny."""
        precision, settings = np.linalg.pinv(now.covariance), self.context.settings
        moved, size = (float(v @ precision @ v) for v in (now.amplitudes - before, now.amplitudes))
        return moved < max(settings.settled_sigma**2, settings.settled_share**2 * size)

    def _has_settled(self, before: Vector | None, now: Vector, covariance: Matrix) -> bool:
        if before is None:
            return False
        moved = now - before
        return float(moved @ np.linalg.pinv(covariance) @ moved) < self.context.settings.settled_sigma**2


def with_scatter(null: SimulatedGaussian, t: Matrix, found: Fit, before: Matrix, after: Matrix) -> Fit:
    """Return a fit of templates, shape (p_raw, K), with the errors of its amplitudes with the effects in the data.

    ``before`` and ``after`` are data vectors of the same skies without the effects and with them at their amplitudes,
    shape (skies, p_raw).

    Notes
    -----
    A strong effect changes the scatter of the data. The fit is linear, so that it is applied to every sky. The variance
    of each amplitude grows by its excess among the skies with the effects over that without them: the same skies, whose
    common scatter cancels. Correlations stay; errors are not made smaller.
    """
    basis, back = orthonormal(null.whiten_templates(t))
    without, acting = (
        np.var(back @ basis.T @ null.whiten_templates(rows.T), axis=1, ddof=1) for rows in (before, after)
    )
    own = np.diag(found.covariance)
    factor = np.sqrt(1.0 + np.divide(np.maximum(acting - without, 0.0), own, out=np.zeros_like(own), where=own > 0.0))
    return replace(found, covariance=factor[:, None] * found.covariance * factor)
