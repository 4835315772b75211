"""Describe the candidates of a diagnosis in whitened coordinates, and judge data vectors that are linear in them."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mcsim.benchmark.case import Answer, Identity, Member
from mcsim.diagnosis.analysis import Analysis
from mcsim.diagnosis.candidate import Candidate, columns_of, effects_at, numbered
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.diagnosis.null_ensemble import NullEnsemble
from mcsim.diagnosis.selection import Attribution, attribute
from mcsim.diagnosis.subsets import Subsets
from mcsim.diagnosis.summaries import Element
from mcsim.diagnosis.templates import TemplateBank
from mcsim.diagnosis.validation import Halves, HeldOut
from mcsim.errors import InputError
from mcsim.stats.gaussian import Fit, SimulatedGaussian, WhitenedTemplates
from mcsim.stats.look_elsewhere import Calibration, GlobalTest, calibrate, global_test

Vector = NDArray[np.float64]

HELD_OUT = 0.25
"""Share of the simulations that serve as data, and not for the covariance."""


@dataclass(frozen=True, eq=False)
class Library:
    """Candidates of a diagnosis, their templates, and the noise model that they are tested with.

    Attributes
    ----------
    null
        Distribution of the data vector, of p_raw elements, without any effect.
    templates
        Response per unit coordinate, shape (p_raw, K).
    candidates
        Effects that can be named.
    calibration
        Look-elsewhere correction of the candidates.
    """

    null: SimulatedGaussian
    templates: NDArray[np.float64]
    candidates: Sequence[Candidate]
    calibration: Calibration

    @classmethod
    def of(cls, context: DiagnosisContext) -> "Library":
        """Take the library from what a diagnosis has learned."""
        return cls(context.null, context.templates, context.candidates, context.calibration)

    @cached_property
    def groups(self) -> WhitenedTemplates:
        """Whitened templates, candidate by candidate."""
        return self.null.whiten_groups(self.templates, [candidate.columns for candidate in self.candidates])

    @property
    def identities(self) -> list[Identity]:
        """Name and channel of each candidate."""
        return [candidate.identity for candidate in self.candidates]

    def response(self, members: Iterable[Member]) -> Vector:
        """Return the change of the data vector by effects of this library or of none, shape (p_raw,)."""
        total = np.zeros(len(self.templates))
        for member in members:
            if member.candidate is None:
                total += np.array(member.response)
            else:
                columns = list(self.candidates[member.candidate].columns)
                total += self.templates[:, columns] @ np.array(member.coordinates)
        return total

    def cosines(self, response: Vector) -> Vector:
        """Return the cosine of a response, shape (p_raw,), with the span of each candidate, shape (candidates,)."""
        white = self.null.whiten_templates(response[:, None])[:, 0]
        size = float(np.linalg.norm(white))
        return np.sqrt(self.groups.delta_chi2(white)) / size if size > 0.0 else np.zeros(len(self.candidates))

    def rival(self, response: Vector, truth: Answer) -> float:
        """Return the largest cosine of a response with a candidate that is not among the effects of ``truth``."""
        others = [identity not in truth for identity in self.identities]
        return float(np.max(self.cosines(response)[others], initial=0.0))

    def distances(self, response: Vector, largest: int = 3) -> tuple[float, ...]:
        """Return the S/N that the best sets of 1, 2, ..., ``largest`` candidates leave of a response."""
        white = self.null.whiten_templates(response[:, None])[:, 0]
        search = Subsets(self.null, white, self.groups, self.candidates, self.calibration)
        found, best = [], search.total
        for size in range(1, largest + 1):
            left = [search.solve(rows).chi2.min() for rows in search.rows(size, ()) if len(rows)]
            best = min([best, *left])
            found.append(float(np.sqrt(self.null.hartlap_factor * max(best, 0.0))))
        return tuple(found)

    def test(self, x: Vector) -> GlobalTest:
        """Test a data vector for any departure from the model."""
        return global_test(self.null, x, self.groups, self.calibration)

    def attribute(self, x: Vector) -> Attribution:
        """Attribute a data vector to effects of the library."""
        return attribute(self.null, x, self.templates, self.candidates, self.calibration)


@dataclass(frozen=True, eq=False)
class LinearModel:
    """A model whose responses are straight lines: simulated data vectors plus templates times coordinates.

    Attributes
    ----------
    library
        Whose covariance does not know the simulations that serve as data.
    rows
        Elements of the full data vector that it uses.
    halves
        The two folds of the data vector; None: there are none.
    data
        Data vectors without an effect, shape (n, p_raw).
    """

    library: Library
    rows: NDArray[np.int64]
    halves: Halves | None
    data: NDArray[np.float64]

    def held_out_reduction(self, x: Vector, members: Sequence[int]) -> HeldOut | None:
        """Fit candidates to one half of a data vector, and predict and measure the reduction of the other's excess.

        None if there are no halves, or if an effect cannot have the fitted amplitude.
        """
        if self.halves is None:
            return None
        candidates = self.library.candidates
        t = self.library.templates[:, columns_of(candidates, members)]

        def respond(frozen: Fit) -> Vector:
            effects = effects_at(candidates, members, frozen)
            return np.asarray(t @ np.concatenate([effect.coordinates() for effect in effects]))

        try:
            return replace(self.halves, x=x).reduction(t, respond)
        except InputError:
            return None


def linear_model(context: DiagnosisContext, without: Sequence[str] = ()) -> LinearModel:
    """Make the linear model of a diagnosis, without some effects; a quarter of its simulations become data.

    Templates are exact here: neither their errors nor the scatter of stochastic effects play a part.
    """
    analysis, ensemble, bank, rows = reduced(context, without)
    kept = len(ensemble.simulations) - int(HELD_OUT * len(ensemble.simulations))
    seen = replace(ensemble, simulations=ensemble.simulations[:kept])
    candidates = tuple(replace(candidate, shape_error=None) for candidate in analysis.candidates)
    null, templates = seen.gaussian, bank.significant(ensemble.spread, context.settings)
    groups = null.whiten_groups(templates, [candidate.columns for candidate in candidates])
    library = Library(null, templates, candidates, calibrate(null, groups))
    halves = Halves.of(seen, np.zeros(len(templates)))
    return LinearModel(library, rows, halves, ensemble.simulations[kept:] + ensemble.offset)


def reduced(
    context: DiagnosisContext, names: Collection[str]
) -> tuple[Analysis, NullEnsemble, TemplateBank, NDArray[np.int64]]:
    """Leave effects out of a library without learning anything again.

    Their candidates, the columns of their templates and the elements that are matched filters of them go. An element
    does not depend on the others, so the rest is what ``mcsim diagnose --without`` learns from the same simulations.

    Returns
    -------
    tuple
        Analysis, null ensemble and templates without the effects, and the elements of the full data vector that they
        keep.
    """
    analysis = context.analysis
    kept = [candidate for candidate in analysis.candidates if candidate.name not in names]
    gone = {candidate.label for candidate in analysis.candidates if candidate.name in names}

    def matched_to_gone(element: Element) -> bool:
        label = element.name.removeprefix("score/").rpartition("/")[0]
        return element.statistic == "score" and label in gone

    blocks = tuple(block for block in analysis.blocks if not all(map(matched_to_gone, block.elements)))
    rows = np.flatnonzero([not matched_to_gone(element) for element in analysis.elements])
    columns = np.array([column for candidate in kept for column in candidate.columns], dtype=np.int64)
    without = tuple(sorted({*analysis.without, *names}))
    fewer = Analysis(analysis.model, numbered(kept), blocks, without)
    return fewer, context.ensemble.restrict(rows), context.bank.subset(rows, columns), rows
