"""One case: maps against a model and what its simulations have taught; verdict and all that it rests on."""

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.diagnosis.analysis import Analysis
from mcsim.diagnosis.assemble import Findings, result_of
from mcsim.diagnosis.candidate import Candidate, columns_of
from mcsim.diagnosis.context import DiagnosisContext
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
from mcsim.diagnosis.residual_maps import standardised
from mcsim.diagnosis.responses import Responses
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.diagnosis.selection import Attribution
from mcsim.diagnosis.validation import Prediction, Shrink, achieved, carried, excess, predicted
from mcsim.diagnosis.where import Place, places
from mcsim.diagnosis.wiener_filter import show
from mcsim.diagnosis.with_scatter import with_scatter
from mcsim.errors import InputError
from mcsim.stats.gaussian import SimulatedGaussian, fit, whitened_templates
from mcsim.stats.look_elsewhere import calibrate, global_test
from mcsim.support.numbers import measured

Vector = NDArray[np.float64]

ALPHA = 0.05
"""Probability below which there is a gap."""

EXCHANGED = 0.01
"""Probability above which maps in another order are said to fit the model."""

OPENED = 3.0
"""Standard deviations below zero, or below what was forecast, from which on a shrink speaks against what was added."""

MEASURED = 0.2
"""Share of an effect's strength that either half of the evidence must hear for a shrink to be measured."""


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


def diagnose_maps(
    context: DiagnosisContext, case: str, maps: Sequence[NDArray[np.float64]], ask: Ask
) -> DiagnosisResult:
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
    drawn, size = len(known.bipolar_scan), len(analysis.elements)
    x, numbers, coarse = np.split(answer, [size, size + known.bipolar_scan.shape[1]])

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
    filtered = None if exchanged else partial_explanation_of(context, x, refined, found, respond)
    seen = standardised(coarse.reshape(known.residual_mean.shape), known.residual_mean, known.residual_scatter, drawn)
    findings = Findings(
        x, replace(refined, attribution=found), where, shrink, filtered, notes, seen, known.residual_rms
    )
    return result_of(context, case, findings)


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
        best = " and ".join(context.analysis.proposals[member].title for member in found.explanations[0].members)
        does = f"raises the excess χ² of the other half from {before.value:.3g} to {shrink[1].after.value:.3g}"
        if shrink[1].after.value < before.value:
            removed, forecast = 100.0 * fraction.value, 100.0 * expected.value
            does = f"removes {removed:.0f} % of the excess χ² of the other half, where {forecast:.0f} % were predicted"
        notes.append(f"The best fit, {best}, is not named: simulated with its amplitude from one half, it {does}.")
        return found.unexplained(), None
    if before.value < before.sigma:
        notes.append(
            "No reduction on held-out data is given: they show no excess χ² by themselves "
            f"({measured(before.value, before.sigma)})."
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
