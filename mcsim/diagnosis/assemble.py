"""Put a diagnosis together: fits, tests and held-out data become one :class:`DiagnosisResult`."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from mcsim import config
from mcsim.datavector.candidate import Candidate, columns_of, parts_of, scatters_of
from mcsim.datavector.nuisances import NuisanceResult, Regression, with_priors
from mcsim.diagnosis.consistency import amplitudes
from mcsim.diagnosis.context import DataSet, DiagnosisContext
from mcsim.diagnosis.fitted import CandidateResult, EffectResult, EffectSet
from mcsim.diagnosis.partial import PartialExplanation
from mcsim.diagnosis.refine import Refined
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.diagnosis.selection import Explanation
from mcsim.stats.detection import cosines, detectable, snr_needed, snr_to_separate
from mcsim.stats.excess import HeldOut, excess_of
from mcsim.stats.gaussian import Fit
from mcsim.support.arrays import Matrix, Vector
from mcsim.systematics import described, if_possible

TELLING = 12  #: elements that are named where two sets differ


def result_of(
    data: DataSet, case: str, refined: Refined, reduction: HeldOut | None, notes: Sequence[str]
) -> DiagnosisResult:
    """Return the result of a case from its final attribution and the reduction on held-out data."""
    context, found, partial = data.context, refined.attribution, refined.partial
    ensemble, null, model, tested = context.ensemble, context.null, context.analysis.model, context.of_model
    residuals = data.residual_maps()
    correlation = cosines(tested.null.whiten_groups(refined.straight, [one.columns for one in context.candidates]))
    return DiagnosisResult(
        case=case,
        kind=found.verdict,
        test=found.gap,
        sets=tuple(_set_of(context, one) for one in found.explanations),
        contradicted=tuple(_set_of(context, one) for one in found.contradicted),
        contrasts=tuple(
            replace(one, elements=one.elements[:TELLING], shares=one.shares[:TELLING]) for one in found.contrasts
        ),
        nearest=found.nearest,
        faint=found.faint,
        probability=found.probability,
        cosine=found.cosine,
        nearest_pvalue=found.singles[found.nearest].pvalue,
        partial=() if partial is None else tuple(_partial(context, refined.candidates, partial)),
        partial_left=None if partial is None else partial.left,
        held_out=reduction,
        nuisances=tuple(_nuisances(data, refined)),
        places=tuple(data.places()),
        candidates=tuple(_candidates(data, refined, correlation)),
        elements=context.analysis.elements,
        maps=tuple(part.name for part in model.parts),
        data=data.x,
        mean=null.mean,
        standard_deviation=tested.ensemble.simulations.std(axis=0, ddof=1),
        templates=refined.templates,
        correlation=correlation,
        held_out_pvalues=tested.ensemble.held_out_pvalues(tested.null),
        calibration=tested.calibration.combined,
        residual_maps=residuals,
        residual_range=None if residuals is None else np.quantile(ensemble.residual_rms, [0.025, 0.975], axis=0).T,
        frame=model.frame,
        notes=tuple(notes),
        untested=()
        if ensemble.nuisances is None
        else tuple(one.words for one, ok in zip(ensemble.elements, ensemble.tested, strict=True) if not ok),
        settings=context.settings,
        provenance={
            "simulations of the model": len(ensemble.simulations),
            "skies constrained by the data": context.settings.constrained_skies,
            "seed of the run": context.run.ensemble.seed,
            **({"worth": tested.null.dof + 1} if tested.null.covariance_dof is not None else {}),
            **data.provenance(),
        },
        configuration=config.to_json(context.run),
    )


def _partial(
    context: DiagnosisContext, candidates: Sequence[Candidate], found: PartialExplanation
) -> Iterator[EffectResult]:
    """Return effects that do not explain all, with the priors of nuisances among them in their errors."""
    t = found.templates[:, columns_of(candidates, found.members)]
    fit = with_priors(context.null, t, found.fit, [candidates[member] for member in found.members])
    return effects_of(context.candidates, found.members, fit, context.frame)


def _set_of(context: DiagnosisContext, one: Explanation) -> EffectSet:
    """Return a set of effects with its amplitudes in parts of the data."""
    effects = list(effects_of(context.candidates, one.members, one.fit, context.frame))
    fitted = [context.candidates[m].fitted(*part) for m, *part in parts_of(context.candidates, one.members, one.fit)]
    for place, own in enumerate(one.findings.comparisons):
        words = tuple(amplitudes(comparison, fitted[place]) for comparison in own)
        effects[place] = replace(effects[place], consistency=own, parts=words)
    return EffectSet(
        effects=tuple(effects),
        candidates=tuple(one.members),
        coordinates=tuple(one.fit.amplitudes.tolist()),
        errors=tuple(one.fit.errors.tolist()),
        odds=one.odds,
        pvalue=one.pvalue,
        further=one.further,
        excess=excess_of(one.fit.chi2, one.fit.dimension, context.null.dof),
        maps=one.findings.maps,
        pvalue_alone=one.fit.pvalue,
    )


def _nuisances(data: DataSet, refined: Refined) -> Iterator[NuisanceResult]:
    """Yield what the data say of the nuisances beside the effects that are named, or else detected, of any size."""
    context, found, partial = data.context, refined.attribution, refined.partial
    if context.ensemble.nuisances is None:
        return
    members, t = found.explanations[0].members if found.explanations else (), refined.templates
    if partial is not None and not members:
        members, t = partial.members, partial.templates
    null = context.null.with_extra_covariance(*scatters_of(refined.candidates, members))
    known = Regression.of(context.ensemble, null, t[:, columns_of(refined.candidates, members)])
    yield from known.results(context.analysis.nuisances, data.x)


def effects_of(candidates: Sequence[Candidate], members: Sequence[int], fit: Fit, frame: str) -> Iterator[EffectResult]:
    """Yield the effects of a fit to maps in a frame; raise InputError if no effect has such an amplitude."""
    for member, theta, covariance in parts_of(candidates, members, fit):
        candidate = candidates[member]
        effect, sigma = candidate.fitted(theta, covariance), _sigma(candidate, theta, covariance, "amplitude")
        errors = {name: _sigma(candidate, theta, covariance, name) for name in candidate.parametrization.measured}
        yield EffectResult(
            name=effect.name,
            channel=candidate.channel,
            amplitude=effect.amplitude,
            sigma=sigma,
            unit=effect.unit,
            parameters={
                key: list(map(float, value)) if isinstance(value, tuple) else value
                for key, value in effect.parameters().items()
            },
            label=candidate.title,
            words=described(effect, frame, sigma, errors),
            errors=errors,
        )


def _sigma(candidate: Candidate, theta: Vector, covariance: Vector, parameter: str) -> float:
    """Return the standard error of a parameter, from its slopes in the coordinates over their own errors.

    A step of one error moves also a value at the edge of what is possible. What the data do not constrain is not
    varied. The error of an amplitude to which coordinates are proportional is at least that with all else fixed, and
    just that where bounds fix the rest. A vector of which one component is hardly known, as a dipole along that of the
    sky is beside an uncertain calibration, is fitted across it, where this component has no slope: its error is at
    least by how much all vectors that may be are longer on average.
    """
    how = candidate.parametrization
    scale, slopes = np.sqrt(np.diag(covariance)), np.zeros(len(theta))
    precision = np.asarray(np.linalg.pinv(covariance), dtype=np.float64)
    constrained = how.constrained(theta, precision)
    for k in np.flatnonzero((scale > 0.0) & ((constrained != 0.0) | (theta == 0.0))):
        step = scale[k] * np.eye(len(theta))[k]
        up, down = (getattr(candidate.with_coordinates(constrained + s, precision), parameter) for s in (step, -step))
        slopes[k] = (up - down) / (2.0 * scale[k])
    inside, variance = candidate.fitted(theta, covariance), max(float(slopes @ covariance @ slopes), 0.0)
    unit = how.coordinates(replace(inside, amplitude=1.0))
    if parameter == "amplitude" and not how.nonlinear and (known := float(unit @ precision @ unit)) > 0.0:
        free = candidate.with_coordinates(constrained, precision)
        longer = _longer(candidate, constrained, covariance, precision) if inside == free else 0.0
        variance = max(variance * (inside == free), 1.0 / known, longer**2)
    return float(np.sqrt(variance))


def _longer(candidate: Candidate, theta: Vector, covariance: Matrix, precision: Matrix) -> float:
    """Return by how much the amplitude grows on average when coordinates move by their errors, either way.

    0 if some coordinates are not constrained: these are not varied.
    """
    if np.count_nonzero(theta) < len(theta):
        return 0.0
    errors, axes = np.linalg.eigh(covariance)
    here, more = abs(candidate.with_coordinates(theta, precision).amplitude), 0.0
    for step in (axes * np.sqrt(np.maximum(errors, 0.0))).T:
        there = (abs(candidate.with_coordinates(one, precision).amplitude) for one in (theta + step, theta - step))
        more += 0.5 * sum(there) - here
    return max(more, 0.0)


def _candidates(data: DataSet, refined: Refined, correlation: Matrix) -> Iterator[CandidateResult]:
    """Yield every candidate with its fit alone, what would be detected, and what is most like it.

    The last two follow from straight responses and the model's noise, whatever was found: ``correlation`` has shape
    (C, C). Look-elsewhere counts the candidates that are proposed whatever the data are.
    """
    null, t, found, candidates = data.context.null, refined.templates, refined.attribution, refined.candidates
    known, straight, tests = data.context.of_model.null, refined.straight, len(data.context.analysis.candidates)
    rank = null.whiten_groups(t, [one.columns for one in candidates]).sizes
    for k, candidate in enumerate(candidates):
        columns = list(candidate.columns)
        amplitude, sigma, words = float("nan"), float("nan"), "no such amplitude"
        with if_possible():
            fit = with_priors(null, t[:, columns], found.singles[k], [candidate])
            (alone,) = effects_of(candidates, (k,), fit, data.context.frame)
            amplitude, sigma, words = alone.amplitude, alone.sigma, alone.words
        typical, fixed = candidate.typical, candidate.fixed
        at = "".join(f" at {name.replace('_', ' ')} {value:g}" for name, value in fixed.items())
        reach, size = detectable(known, straight[:, columns], tests, typical), None
        responds = max(int(np.any(straight[:, columns] != 0.0, axis=0).sum()), 1)
        needed = snr_needed(min(responds, known.dimension), tests, known.dimension, known.dof + 1)
        if np.isfinite(reach):
            size = abs(candidate.with_coordinates(reach * typical[:, 0], np.eye(len(columns))).amplitude)
        # Candidates that differ in settings only are variants of one effect.
        others = [j for j, other in enumerate(candidates) if other.identity != candidate.identity]
        similar = max(others, key=lambda j: abs(correlation[k, j]), default=None)
        cosine = 0.0 if similar is None else abs(float(correlation[k, similar]))
        strength = 0.0 if similar is None else float(snr_to_separate(cosine))
        separable = float("nan") if size is None or similar is None else strength * size / needed
        yield CandidateResult(
            name=candidate.name,
            channel=candidate.channel,
            settings=dict(candidate.settings),
            unit=candidate.effect.unit,
            label=candidate.title,
            columns=tuple(candidate.columns),
            amplitude=amplitude,
            sigma=sigma,
            words=words,
            delta_chi2=null.hartlap_factor * float(found.singles[k].delta_chi2),
            pvalue=min(1.0, found.singles[k].nested_pvalue * int((rank[:tests] > 0).sum())),
            detectable=size,
            detectable_words=_in_words(candidate, size, at),
            fixed=fixed,
            similar=similar,
            correlation=cosine,
            strength=strength,
            separable=separable,
            separable_words=_in_words(candidate, separable, at),
            largest=candidate.largest,
        )


def _in_words(candidate: Candidate, size: float | None, at: str) -> str:
    """Return an amplitude as people read it, ``at`` parameters, and that the effect cannot have it where this is so."""
    if size is None or not np.isfinite(size):
        return "–"
    beyond = ", more than is possible" if size > candidate.largest else ""
    return f"{candidate.effect.format_amplitude(size)}{at}{beyond}"
