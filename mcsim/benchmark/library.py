"""Describe the candidates of a diagnosis in whitened coordinates, and judge data vectors that are linear in them."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mcsim.benchmark.case import Answer, Identity, Member
from mcsim.diagnosis.analysis import Analysis, Proposal
from mcsim.diagnosis.candidate import Candidate, columns_of
from mcsim.diagnosis.inference import DiagnosisContext
from mcsim.diagnosis.knowledge import Knowledge
from mcsim.diagnosis.refine import effects_at, significant_templates
from mcsim.diagnosis.selection import Attribution, attribute
from mcsim.diagnosis.subsets import Subsets
from mcsim.diagnosis.summaries import Element
from mcsim.diagnosis.validation import Prediction, Shrink, achieved, predicted
from mcsim.errors import InputError
from mcsim.stats.gaussian import SimulatedGaussian, WhitenedTemplates, fit, whitened_templates
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
    proposals, candidates
        Effects that can be named.
    calibration
        Look-elsewhere correction of the candidates.
    """

    null: SimulatedGaussian
    templates: NDArray[np.float64]
    proposals: Sequence[Proposal]
    candidates: Sequence[Candidate]
    calibration: Calibration

    @classmethod
    def of(cls, context: DiagnosisContext) -> "Library":
        """Take the library from what a diagnosis has learned."""
        templates = significant_templates(context.known)
        return cls(context.null, templates, context.analysis.proposals, context.candidates, context.calibration)

    @cached_property
    def groups(self) -> WhitenedTemplates:
        """Whitened templates, candidate by candidate."""
        return whitened_templates(self.null, self.templates, [candidate.columns for candidate in self.candidates])

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
        ones = np.ones(len(self.candidates))
        search = Subsets(self.null, white, self.groups, self.identities, ones, 0.0 * ones, self.calibration)
        found, best = [], search.total
        for size in range(1, largest + 1):
            left = [search.solve(rows).chi2.min() for rows in search.rows(size, ()) if len(rows)]
            best = min([best, *left])
            found.append(float(np.sqrt(self.null.unbiased * max(best, 0.0))))
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
    folds
        Elements of either half of the data vector, and their distribution; None: there are no halves.
    data
        Data vectors without an effect, shape (n, p_raw).
    """

    library: Library
    rows: NDArray[np.int64]
    folds: tuple[tuple[NDArray[np.int64], SimulatedGaussian], ...] | None
    data: NDArray[np.float64]

    def held_out_reduction(self, x: Vector, members: Sequence[int]) -> tuple[Prediction, Shrink] | None:
        """Fit candidates to one half of a data vector, and predict and measure the reduction of the other's excess.

        None if there are no halves, or if an effect cannot have the fitted amplitude.
        """
        if self.folds is None:
            return None
        (first, used), (second, fresh) = self.folds
        library, columns = self.library, np.array(columns_of(self.library.candidates, members))
        frozen = fit(used, x[first], library.templates[np.ix_(first, columns)])
        try:
            effects = effects_at(library.candidates, library.proposals, members, frozen)
        except InputError:
            return None
        coordinates = np.concatenate([effect.coordinates() for effect in effects])
        here = library.templates[np.ix_(second, columns)]
        expected = predicted(fresh, x[second], here, frozen.amplitudes, frozen.covariance)
        after = replace(fresh, mean=fresh.mean + here @ coordinates)
        return expected, achieved(fresh, after, x[second])


def linear_model(context: DiagnosisContext, without: Sequence[str] = ()) -> LinearModel:
    """Make the linear model of a diagnosis, without some effects; a quarter of its simulations become data.

    Templates are exact here: neither their errors nor the scatter of stochastic effects play a part.
    """
    analysis, known, rows = reduced(context, without)
    kept = len(known.simulations) - int(HELD_OUT * len(known.simulations))
    seen = replace(known, simulations=known.simulations[:kept])
    full = {proposal.label: one for proposal, one in zip(context.analysis.proposals, context.candidates, strict=True)}
    candidates = tuple(
        replace(full[proposal.label], columns=columns, shape_error=None)
        for proposal, columns in zip(analysis.proposals, analysis.columns, strict=True)
    )
    null, templates = seen.null(), significant_templates(known)
    groups = whitened_templates(null, templates, [candidate.columns for candidate in candidates])
    library = Library(null, templates, analysis.proposals, candidates, calibrate(null, groups))
    halves = [np.flatnonzero([element.fold == number for element in analysis.elements]) for number in (0, 1)]
    folds = tuple((half, seen.null(half)) for half in halves) if all(len(half) for half in halves) else None
    return LinearModel(library, rows, folds, known.simulations[kept:] + known.offset)


def reduced(context: DiagnosisContext, names: Collection[str]) -> tuple[Analysis, Knowledge, NDArray[np.int64]]:
    """Leave effects out of a library without learning anything again.

    Their candidates, the columns of their templates and the elements that are matched filters of them go. An element
    does not depend on the others, so the rest is what ``mcsim diagnose --without`` learns from the same simulations.

    Returns
    -------
    tuple
        Analysis and null ensemble without the effects, and the elements of the full data vector that they keep.
    """
    analysis, known = context.analysis, context.known
    kept = [index for index, proposal in enumerate(analysis.proposals) if proposal.kind.name not in names]
    gone = {proposal.label for proposal in analysis.proposals if proposal.kind.name in names}

    def matched_to_gone(element: Element) -> bool:
        label = element.name.removeprefix("score/").rpartition("/")[0]
        return element.statistic == "score" and label in gone

    blocks = tuple(block for block in analysis.blocks if not all(map(matched_to_gone, block.elements)))
    rows = np.flatnonzero([not matched_to_gone(element) for element in analysis.elements])
    columns = np.array([column for index in kept for column in analysis.columns[index]], dtype=np.int64)
    proposals, without = tuple(analysis.proposals[index] for index in kept), (*analysis.without, *names)
    cut = {name: getattr(known, name)[np.ix_(rows, columns)] for name in ("templates", "curvature", "template_error")}
    same = {name: getattr(known, name)[:, rows] for name in ("simulations", "reference")}
    elements = tuple(known.elements[index] for index in rows)
    fewer = replace(known, offset=known.offset[rows], elements=elements, **cut, **same)
    return Analysis(analysis.model, proposals, blocks, tuple(sorted(set(without)))), fewer, rows
