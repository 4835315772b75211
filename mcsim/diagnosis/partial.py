"""Find what is detected of a gap that no set of candidates explains, and refine what acts together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mcsim.datavector.bent import beyond
from mcsim.datavector.candidate import Candidate, columns_of, coordinates_of, effects_at, lost, scatters_of
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.context import DataSet
from mcsim.diagnosis.responses import steepness
from mcsim.diagnosis.selection import Selection
from mcsim.stats.gaussian import Fit
from mcsim.stats.scattered import with_drawn_scatter
from mcsim.support.arrays import Matrix, Vector
from mcsim.systematics import if_possible


@dataclass(frozen=True)
class PartialExplanation:
    """Hold effects that are detected without explaining all of the excess chi^2.

    ``members`` are the indices of the candidates, in the order in which they were detected, and ``fit`` the amplitudes
    of their columns; ``left`` is the share of the excess chi^2 that they leave. The ``templates``, shape (p, K), hold
    for the members together.
    """

    members: tuple[int, ...]
    fit: Fit
    left: float
    templates: Matrix


@dataclass(frozen=True)
class PartialSearch:
    """Add candidates to those that are detected in data, one by one."""

    data: DataSet

    def run(self, t: Matrix, candidates: Sequence[Candidate]) -> PartialExplanation | None:
        """Add the most significant candidate beside those that are detected already, until none is significant.

        None if nothing is. Each is significant beside those before it, before and after it is simulated together with
        them at its amplitude; of two similar effects the one that is not there may be the first.
        """
        null, settings = self.data.context.null, self.data.context.settings
        members: tuple[int, ...] = ()
        refused: set[int] = set()
        while len(members) < settings.partial_effects and len(refused) < settings.partial_refusals:
            pvalues = self._beside(t, candidates, members)
            best = next((int(i) for i in np.argsort(pvalues) if i not in refused), -1)
            if best < 0 or pvalues[best] > settings.partial_level:
                break
            together = (*members, best)
            exact = self.together(candidates, t, together)
            if exact is not None and self._beside(exact, candidates, members)[best] <= settings.partial_level:
                members, t = together, exact
            else:
                refused.add(best)
        if not members:
            return None
        own = t[:, columns_of(candidates, members)]
        fit = null.fit(self.data.x, own)
        excess = null.hartlap_factor * null.chi2(self.data.x) - null.dimension
        left = null.hartlap_factor * fit.chi2 - fit.dimension
        if scatters := scatters_of(candidates, members):
            wide = null.with_extra_covariance(*scatters).fit(self.data.x, own)
            fit = with_drawn_scatter(null, own, wide, scatters)
        return PartialExplanation(members, fit, min(max(left / excess, 0.0), 1.0) if excess > 0.0 else 1.0, t)

    def _beside(self, t: Matrix, candidates: Sequence[Candidate], members: tuple[int, ...]) -> Vector:
        """Return the global p-value of each candidate beside members, which scatter the data as in an attribution.

        A candidate counts for what its nearest possible amplitude explains, and not at all if it, or with it a member,
        is impossible.
        """
        known = self.data.context
        search = Selection(known.null, self.data.x, t, candidates, known.calibration, known.settings).search(members)
        row, less = np.array([members], dtype=np.int64), np.zeros(len(candidates))
        for new in np.flatnonzero(search.beside(row)[0] <= known.settings.partial_level):
            together = (*members, int(new))
            fit = search.null.fit(self.data.x, t[:, columns_of(candidates, together)])
            less[new] = lost(candidates, together, fit, search.null.dof)
        return search.beside(row, less)[0]

    def together(self, candidates: Sequence[Candidate], t: Matrix, members: Sequence[int]) -> Matrix | None:
        """Return templates that are exact for effects that act together, at about their fitted amplitudes.

        Strong effects change their own responses and each other's. None if one can have no such amplitude, or the
        amplitudes diverge round by round. Those of a square, which would go back and forth, go halfway. A share of
        their size counts as settled in the end alone: it is many errors of a strong effect.
        """
        columns, settings = columns_of(candidates, members), self.data.context.settings
        null = self.data.context.null.with_extra_covariance(*scatters_of(candidates, members))
        fitted, rounds = null.fit(self.data.x, t[:, columns]), []
        with if_possible():
            for _ in range(settings.joint_rounds):
                effects = effects_at(candidates, members, fitted)
                tables = [candidates[member].table(effect) for member, effect in zip(members, effects, strict=True)]
                stochastic = any(effect.parametrization.stochastic for effect in effects)
                skies = settings.scatter_skies if stochastic else settings.constrained_skies
                response = self.data.respond(tables, skies).mean(axis=0)
                t = t.copy()
                t[:, columns] += beyond(null, t[:, columns], coordinates_of(candidates, members, effects), response)
                before, fitted = fitted.amplitudes, null.fit(self.data.x, t[:, columns])
                rounds.append((before, fitted.amplitudes))
                if has_settled(settings, *rounds[-1], fitted.covariance):
                    return t
                share = steepness(rounds[-2], rounds[-1], fitted.covariance) if len(rounds) > 1 else 0.0
                fitted = replace(fitted, amplitudes=before + (fitted.amplitudes - before) / (1.0 + share))
        settled = rounds and has_settled(settings, *rounds[-1], fitted.covariance, settings.settled_share)
        return t if settled else None


def has_settled(
    settings: DiagnosisSettings, before: Vector | None, now: Vector, covariance: Matrix, share: float = 0.0
) -> bool:
    """Return True if amplitudes have hardly moved, by their errors, or by a share of their size."""
    if before is None:
        return False
    precision = np.linalg.pinv(covariance)
    moved, size = (float(v @ precision @ v) for v in (now - before, now))
    return moved < max(settings.settled_sigma**2, share**2 * size)
