"""One case: maps against a model and what its simulations have taught; verdict and all that it rests on."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from mcsim import config
from mcsim.diagnosis.analysis import Analysis
from mcsim.diagnosis.candidate import Candidate, columns_of
from mcsim.diagnosis.knowledge import CONSTRAINED_SKIES, Ask, Knowledge
from mcsim.diagnosis.observed_maps import exchanges
from mcsim.diagnosis.partial_explanation import PartialExplanation
from mcsim.diagnosis.refine import (
    Refined,
    Respond,
    detected_in,
    refine,
    scatter_of,
    significant_templates,
    tables_at,
    templates_on_sky,
)
from mcsim.diagnosis.report_arrays import report_arrays
from mcsim.diagnosis.responses import Responses
from mcsim.diagnosis.selection import Attribution
from mcsim.diagnosis.validation import Prediction, Shrink, achieved, carried, excess, predicted
from mcsim.diagnosis.verdict import detectable_of, sentence, verdict_of
from mcsim.diagnosis.where import Place, places
from mcsim.diagnosis.wiener_filter import show
from mcsim.diagnosis.with_scatter import with_scatter
from mcsim.errors import InputError
from mcsim.stats.gaussian import SimulatedGaussian, fit, whitened_templates
from mcsim.stats.look_elsewhere import Calibration, calibrate, global_test

Vector = NDArray[np.float64]

ALPHA = 0.05
"""Probability below which there is a gap."""

EXCHANGED = 0.01
"""Probability above which maps in another order are said to fit the model."""

OPENED = 3.0
"""Standard deviations below zero, or below what was forecast, from which on a shrink speaks against what was added."""

MEASURED = 0.2
"""Share of an effect's strength that either half of the evidence must hear for a shrink to be measured."""


@dataclass(frozen=True)
class DiagnosisContext:
    """What every case of a model is judged with.

    Attributes
    ----------
    run, asked, known
        What is believed, what is asked of it, what its simulations answered.
    null
        Of the whole evidence.
    candidates, calibration
        Of the proposals.
    """

    run: config.RunConfig
    analysis: Analysis
    known: Knowledge
    null: SimulatedGaussian
    candidates: tuple[Candidate, ...]
    calibration: Calibration


@dataclass(frozen=True)
class Diagnosis:
    """Whether, where, which, how far: a verdict and the evidence that it rests on.

    Attributes
    ----------
    verdict
        As written to ``verdict.json``.
    evidence
        What was measured and what simulations say of it; dimensions entry, column, place.
    attribution
        Candidates, explanations and their fits.
    """

    verdict: dict[str, Any]
    evidence: xr.Dataset
    attribution: Attribution

    @property
    def sentence(self) -> str:
        """The verdict for a busy person."""
        return sentence(self.verdict)

    def save(self, folder: str | Path) -> None:
        """Write ``verdict.json`` and ``evidence.zarr`` into a folder, made where it does not exist."""
        target = Path(folder)
        target.mkdir(parents=True, exist_ok=True)
        (target / "verdict.json").write_text(json.dumps(self.verdict, indent=1, allow_nan=False) + "\n")
        # Text as objects: for numpy's fixed-length text Zarr 3 has no stable form.
        texts = {
            name: values.astype(object) for name, values in self.evidence.variables.items() if values.dtype.kind == "U"
        }
        self.evidence.assign(texts).to_zarr(target / "evidence.zarr", mode="w", consolidated=False)


def context(run: config.RunConfig, analysis: Analysis, known: Knowledge) -> DiagnosisContext:
    """Make ready for the cases of a model."""
    null = known.null()
    scatter = scatter_of(known, analysis)
    candidates = tuple(
        Candidate(
            proposal.kind.name,
            proposal.channel,
            columns,
            settings=proposal.settings,
            unit=proposal.kind.unit,
            # What an effect draws at random is not known even where the sky is.
            shape_error=min(float(own), 1.0) if proposal.drawn else None,
            positive=proposal.kind.sign != 0,
            max_amplitude=proposal.kind.max_amplitude,
        )
        for proposal, columns, own in zip(analysis.proposals, analysis.columns, scatter, strict=True)
    )
    groups = whitened_templates(null, significant_templates(known), [candidate.columns for candidate in candidates])
    return DiagnosisContext(run, analysis, known, null, candidates, calibrate(null, groups))


def diagnose_maps(context: DiagnosisContext, case: str, maps: Sequence[NDArray[np.float64]], ask: Ask) -> Diagnosis:
    """Judge a set of maps.

    Parameters
    ----------
    court
        Of the model.
    case
        Name of the case.
    maps
        In the order of the model's.
    ask
        Runs further simulations, with effects at the amplitudes that are found.
    """
    analysis, known = context.analysis, context.known
    answer = analysis.answer(maps, bipolar_scan=True)
    x, numbers = answer[: len(analysis.elements)], answer[len(analysis.elements) :]

    respond = Responses(context.run, analysis, known, show(analysis.model, maps), ask)
    t = significant_templates(known)
    groups = whitened_templates(context.null, t, [candidate.columns for candidate in context.candidates])
    if global_test(context.null, x, groups, context.calibration).pvalue <= ALPHA:
        t = templates_on_sky(known, analysis, t, respond)
    refined = refine(known, context.null, x, t, context.candidates, analysis.proposals, context.calibration, respond)
    found = refined.attribution
    exchanged = list(_exchanged(context, maps, found))
    notes = exchanged.copy()
    if exchanged:
        # An order of the maps in which the model fits says more than any effect.
        found = found.unexplained()
    shrink = None
    if found.explanations:
        found = _with_errors(context, refined, found, respond)
        found, shrink = confirmed(context, found, shrink_of(context, x, refined, respond), notes)
    where = _where(context, x, numbers)
    able = detectable_of(context.null, refined.templates, context.candidates, analysis.proposals)
    filtered = None if exchanged else partial_explanation_of(context, x, refined, found, respond)
    verdict = verdict_of(case, found, context.candidates, analysis.proposals, where, shrink, able, notes, filtered)
    shown = report_arrays(
        analysis.model, maps, known.simulations, context.null, found, context.candidates, analysis.proposals
    )
    constrained = dataset(context, x, replace(refined, attribution=found), where, verdict)
    evidence = constrained.merge(shown, combine_attrs="no_conflicts")
    return Diagnosis(verdict, evidence, found)


def confirmed(
    context: DiagnosisContext, found: Attribution, shrink: tuple[Prediction, Shrink, str] | None, notes: list[str]
) -> tuple[Attribution, tuple[Prediction, Shrink, str] | None]:
    """Attribution and shrink, where they hold once the set that fits best is simulated.

    What opens the gap, or closes less than half of what it was forecast to close, both beyond error, is not what is
    there, and is not named. Half of the data that shows no gap beyond its own error measures no share of it.
    """
    if shrink is None:
        return found, None
    before, fraction, expected = shrink[1].before, shrink[1].fraction, shrink[0].fraction
    opened = fraction.value * before.value + OPENED * fraction.sigma * abs(before.value) < 0.0
    short = expected.value - fraction.value > OPENED * np.hypot(expected.sigma, fraction.sigma)
    if opened or (short and before.value > 0.0 and fraction.value < 0.5 * min(expected.value, 1.0)):
        best = " and ".join(context.analysis.proposals[member].label for member in found.explanations[0].members)
        does = f"opens the gap of the other from {before.value:.3g} to {shrink[1].after.value:.3g}"
        if shrink[1].after.value < before.value:
            does = f"takes {fraction.value:.0%} of the other's gap, where {expected.value:.0%} were forecast"
        notes.append(f"What fits best, {best}, is not named: simulated with its amplitude from one half, it {does}.")
        return found.unexplained(), None
    if before.value < before.sigma:
        notes.append(
            f"No shrink is given: the half that would measure it shows no gap by itself ({before.value:.2g} +- "
            f"{before.sigma:.2g})."
        )
        return found, None
    return found, shrink


def _with_errors(context: DiagnosisContext, refined: Refined, found: Attribution, respond: Responses) -> Attribution:
    """The attribution, the best set with the errors that its amplitudes have where its effects act.

    Of effects that draw the scatter is known already: it has widened the null that they were fitted with.
    """
    best = found.explanations[0]
    if any(refined.candidates[member].scatter is not None for member in best.members):
        return found
    try:
        acting = tables_at(context.candidates, context.analysis.proposals, best.members, best.fit)
        before, after = respond.pair(acting)
    except InputError:
        return found  # between what was fitted and what can be
    t = refined.templates[:, columns_of(context.candidates, best.members)]
    own = replace(best, fit=with_scatter(context.null, t, best.fit, before, after))
    return replace(found, explanations=(own, *found.explanations[1:]))


def partial_explanation_of(
    context: DiagnosisContext, x: Vector, refined: Refined, found: Attribution, respond: Respond
) -> PartialExplanation | None:
    """What of the library is heard in a gap that it does not explain."""
    if found.verdict != "unknown" or refined.filtered is not None:
        return refined.filtered
    rest = context.analysis.proposals, context.calibration, respond
    return detected_in(context.null, x, refined.templates, refined.candidates, *rest)


def shrink_of(
    context: DiagnosisContext, x: Vector, refined: Refined, respond: Respond
) -> tuple[Prediction, Shrink, str] | None:
    """Fit one half of the evidence, freeze, add to the simulator, and look at the other half.

    The best explanation is fitted to the entries of fold 0 alone; the ensemble is simulated again with its effects; the
    gap of the entries of fold 1, whose noise is independent, is measured against both ensembles, the second one
    scattered by what draws. None where one half hardly hears the effect: without splits the halves are degrees and
    pixels, which say little of beams and pointing.
    """
    folds = np.array([-1 if element.fold is None else element.fold for element in context.analysis.elements])
    used, fresh = np.flatnonzero(folds == 0), np.flatnonzero(folds == 1)
    if not len(used) or not len(fresh):
        return None
    members = refined.attribution.explanations[0].members
    columns = columns_of(context.candidates, members)
    change = refined.templates[:, columns] @ refined.attribution.explanations[0].fit.amplitudes
    filtered = min(context.known.null(rows).expected_snr(change[rows]) for rows in (used, fresh))
    if filtered < MEASURED * context.null.expected_snr(change):
        return None
    chosen = np.array(columns)
    scatters = [one for one in (refined.candidates[member].scatter for member in members) if one is not None]
    learning, before = context.known.null(used), context.known.null(fresh)
    frozen = fit(
        learning.with_extra_covariance(*(one[used] for one in scatters)),
        x[used],
        refined.templates[np.ix_(used, chosen)],
    )
    try:
        acting = tables_at(context.candidates, context.analysis.proposals, members, frozen)
        mean = before.mean + respond(acting, CONSTRAINED_SKIES).mean(axis=0)[fresh]
    except InputError:
        return None  # half of the evidence asks for an amplitude that the effect cannot have
    after = replace(before, mean=mean).with_extra_covariance(*(one[fresh] for one in scatters))
    here = refined.templates[np.ix_(fresh, chosen)]
    if scatters:
        response = refined.templates[:, chosen] @ frozen.amplitudes
        squares = _squares(before, response, scatters, fresh), _squares(learning, response, scatters, used)
        noise = fit(learning, x[used], refined.templates[np.ix_(used, chosen)]).covariance
        expected = carried(before, after, x[fresh], here, noise, excess(learning, x[used]), *squares)
    else:
        expected = predicted(before, x[fresh], here, frozen.amplitudes, frozen.covariance)
    return expected, achieved(before, after, x[fresh]), _fresh_words(context)


def _squares(
    null: SimulatedGaussian, response: Vector, scatters: Sequence[NDArray[np.float64]], rows: NDArray[np.int64]
) -> Vector:
    """White squares of the draws of a response."""
    deviations = reduce(np.add, [np.sqrt(scatter.shape[1]) * scatter for scatter in scatters])
    return np.array([null.expected_snr(draw) ** 2 for draw in (response + deviations.T)[:, rows]])


def _fresh_words(context: DiagnosisContext) -> str:
    splits = context.run.map.splits
    if len(splits) < 2:
        return "odd degrees, alternate pixels"
    return f"{' and '.join(splits[1::2])} (frozen on {' and '.join(splits[::2])})"


def _exchanged(context: DiagnosisContext, maps: Sequence[NDArray[np.float64]], found: Attribution) -> list[str]:
    """Orders of the maps in which the model fits, where it does not as they are and no single effect explains it."""
    if found.gap.omnibus > EXCHANGED or (found.explanations and len(found.explanations[0].members) == 1):
        return []  # as they are the maps fit as well, or one effect says what is wrong
    names = [part.name for part in context.analysis.model.parts]
    notes = []
    for order in exchanges(names):
        p = context.null.pvalue(context.analysis.answer([maps[i] for i in order]))
        if p > EXCHANGED:
            moved = [f"{names[i]} as {name}" for name, i in zip(names, order, strict=True) if names[i] != name]
            notes.append(f"The model fits (p = {p:.2g}) with maps exchanged: {', '.join(moved)}.")
    return notes


def _where(context: DiagnosisContext, x: Vector, numbers: Vector) -> list[Place]:
    """Places in the atlas, and in what of the evidence is matched to no effect."""
    own = [i for i, element in enumerate(context.analysis.elements) if element.statistic != "score"]
    count = len(context.known.bipolar_scan)
    drawn = np.concatenate([context.known.bipolar_scan, context.known.simulations[:count][:, own]], axis=1)
    shifted = x[own] - context.known.offset[own]
    elements = (*context.analysis.bipolar_scan.elements, *(context.analysis.elements[i] for i in own))
    return places(np.concatenate([numbers, shifted]), drawn, elements)


def dataset(
    context: DiagnosisContext, x: Vector, refined: Refined, where: Sequence[Place], verdict: dict[str, Any]
) -> xr.Dataset:
    """Everything measured, with names and units."""
    known = context.known
    spread = known.simulations.std(axis=0, ddof=1)
    found = refined.attribution
    element = [e.name for e in context.analysis.elements]
    column = [f"{p.label}/{k}" for p in context.analysis.proposals for k in range(len(p.basis))]
    candidate = [p.label for p in context.analysis.proposals]
    best = np.zeros(len(element))
    if found.explanations:
        columns = columns_of(context.candidates, found.explanations[0].members)
        best = refined.templates[:, columns] @ found.explanations[0].fit.amplitudes
    return xr.Dataset(
        {
            "data": ("entry", x, {"long_name": "evidence of the data"}),
            "mean": ("entry", context.null.mean, {"long_name": "mean of the model, referee's offset included"}),
            "standard_deviation": ("entry", spread, {"long_name": "scatter of the model"}),
            "z": ("entry", (x - context.null.mean) / spread, {"long_name": "data less mean, over scatter"}),
            "explained": ("entry", best / spread, {"long_name": "best explanation, over scatter"}),
            "templates": (("entry", "column"), refined.templates, {"long_name": "response per unit coordinate"}),
            "correlation": (("candidate", "other"), found.correlation, {"long_name": "white canonical correlation"}),
            "drop": ("candidate", [s.delta_chi2 for s in found.singles], {"long_name": "fall of chi^2, fitted alone"}),
            "calibration": ("draw", context.calibration.combined, {"long_name": "smaller probability, without a gap"}),
            "place_z": ("place", [p.z for p in where], {"long_name": "deviate of a group"}),
            "place_p": ("place", [p.p for p in where], {"long_name": "probability, trials included"}),
        },
        coords={"entry": element, "column": column, "candidate": candidate, "other": candidate},
        attrs={
            "verdict": json.dumps(verdict),
            "configuration": config.to_json(context.run),
            "entries": json.dumps([asdict(e) for e in context.analysis.elements]),
            "places": json.dumps([asdict(p.element) for p in where]),
            "simulations": len(known.simulations),
            "skies_of_responses": CONSTRAINED_SKIES,
        },
    )
