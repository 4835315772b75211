"""Put a diagnosis together: fits, tests and held-out data become one :class:`DiagnosisResult`."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.diagnosis.candidate import Candidate, columns_of, parts_of
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.diagnosis.partial_explanation import PartialExplanation
from mcsim.diagnosis.places import Place
from mcsim.diagnosis.refine import Refined
from mcsim.diagnosis.result import (
    CandidateResult,
    ContrastResult,
    DiagnosisResult,
    EffectResult,
    EffectSet,
    GlobalResult,
    HeldOut,
)
from mcsim.diagnosis.selection import Explanation
from mcsim.diagnosis.validation import Prediction, Shrink, excess_of
from mcsim.errors import InputError
from mcsim.stats.detection import detectable, snr_needed, snr_to_separate
from mcsim.stats.gaussian import Fit, SimulatedGaussian, residual_pvalue

Vector = NDArray[np.float64]
Reduction = tuple[Prediction, Shrink, str]
"""What was predicted, what was achieved, and on which data, in words."""

TELLING = 12
"""Elements that are named where two sets differ."""


@dataclass(frozen=True)
class Findings:
    """What was found in one case.

    Attributes
    ----------
    x
        Data vector, shape (p,).
    refined
        Final attribution and templates.
    places, held_out, partial, notes
        Localisation, (prediction, reduction, data in words), what is detected beside "unknown", and remarks.
    residual_maps
        From :func:`mcsim.diagnosis.residual_maps.standardised`; None without maps.
    """

    x: Vector
    refined: Refined
    places: Sequence[Place]
    held_out: Reduction | None
    partial: PartialExplanation | None
    notes: Sequence[str]
    residual_maps: Vector | None = None


def result_of(
    context: DiagnosisContext, case: str, findings: Findings, provenance: Mapping[str, Any] | None = None
) -> DiagnosisResult:
    """Return the result of a case; ``provenance`` is added to what every diagnosis states."""
    ensemble, null = context.ensemble, context.null
    found, candidates = findings.refined.attribution, context.candidates
    partial, count = findings.partial, len(ensemble.simulations)
    model = context.analysis.model
    return DiagnosisResult(
        case=case,
        kind=found.verdict,
        test=GlobalResult(
            found.gap.pvalue,
            found.gap.omnibus,
            found.gap.maximum,
            found.gap.chi2,
            found.gap.dimension,
            excess_of(found.gap.chi2, found.gap.dimension, null.dof),
            count,
        ),
        sets=tuple(
            EffectSet(
                tuple(effects_of(one, candidates)),
                tuple(one.members),
                tuple(columns_of(candidates, one.members)),
                tuple(one.fit.amplitudes.tolist()),
                tuple(one.fit.errors.tolist()),
                one.odds,
                one.pvalue,
                one.further,
                excess_of(one.fit.chi2, one.fit.dimension, null.dof),
            )
            for one in found.explanations
        ),
        contrasts=tuple(
            ContrastResult(
                one.first,
                one.second,
                one.separation,
                tuple(one.elements[:TELLING].tolist()),
                tuple(one.shares[:TELLING].tolist()),
            )
            for one in found.contrasts
        ),
        nearest=found.nearest,
        cosine=found.cosine,
        partial=() if partial is None else tuple(effects_of(partial, candidates)),
        partial_left=None if partial is None else partial.left,
        held_out=None if findings.held_out is None else _held_out(*findings.held_out),
        places=tuple(findings.places),
        candidates=tuple(_candidates(context, findings.refined)),
        elements=context.analysis.elements,
        maps=tuple(part.name for part in model.parts),
        data=findings.x,
        mean=null.mean,
        standard_deviation=ensemble.simulations.std(axis=0, ddof=1),
        templates=findings.refined.templates,
        correlation=found.correlation,
        held_out_pvalues=held_out_pvalues(ensemble.simulations, null),
        calibration=context.calibration.combined,
        residual_maps=findings.residual_maps,
        residual_range=None
        if findings.residual_maps is None
        else np.quantile(ensemble.residual_rms, [0.025, 0.975], axis=0).T,
        frame=model.survey.frame,
        notes=tuple(findings.notes),
        settings=context.settings,
        provenance={
            "simulations of the model": count,
            "skies constrained by the data": context.settings.constrained_skies,
            "seed of the run": context.run.ensemble.seed,
            **(provenance or {}),
        },
        configuration=config.to_json(context.run),
    )


def _held_out(predicted: Prediction, achieved: Shrink, data: str) -> HeldOut:
    return HeldOut(
        predicted.fraction, achieved.fraction, achieved.before, achieved.after, achieved.probability_after, data
    )


def effects_of(
    explanation: Explanation | PartialExplanation, candidates: Sequence[Candidate]
) -> Iterator[EffectResult]:
    """Yield the effects of a set with amplitude, standard error, unit and parameters.

    Raises
    ------
    InputError
        If no effect has such an amplitude.
    """
    for member, theta, covariance in parts_of(candidates, explanation.members, explanation.fit):
        candidate = candidates[member]
        effect, sigma = candidate.fitted(theta, covariance), _sigma(candidate, theta, covariance)
        yield EffectResult(
            name=effect.name,
            channel=candidate.channel,
            amplitude=effect.amplitude,
            sigma=sigma,
            unit=effect.unit,
            parameters={key: _plain(value) for key, value in effect.parameters().items()},
            label=candidate.title,
            words=effect.describe(sigma),
        )


def _sigma(candidate: Candidate, theta: Vector, covariance: Vector) -> float:
    """Return the standard error of the amplitude, from its slopes in the coordinates over their own errors.

    A step of one error moves also an amplitude at the edge of what is possible. What the data do not constrain is not
    varied.
    """
    scale = np.sqrt(np.diag(covariance))
    precision = np.asarray(np.linalg.pinv(covariance), dtype=np.float64)
    constrained = candidate.effect.constrained(theta, precision)
    slopes: Vector = np.zeros(len(theta))
    for k in np.flatnonzero((scale > 0.0) & ((constrained != 0.0) | (theta == 0.0))):
        step = scale[k] * np.eye(len(theta))[k]
        up, down = (candidate.with_coordinates(constrained + sign, precision).amplitude for sign in (step, -step))
        slopes[k] = (up - down) / (2.0 * scale[k])
    return float(np.sqrt(max(float(slopes @ covariance @ slopes), 0.0)))


def _plain(value: Any) -> Any:
    return [float(item) for item in value] if isinstance(value, tuple) else value


def _candidates(context: DiagnosisContext, refined: Refined) -> Iterator[CandidateResult]:
    """Yield every candidate with its fit alone, what would be detected, and what is most like it."""
    null, t = context.null, refined.templates
    found, candidates = refined.attribution, context.candidates
    p, N = null.dimension, len(context.ensemble.simulations)
    responds = np.any(t != 0.0, axis=0)
    rank = np.array([int(responds[list(one.columns)].sum()) for one in candidates])
    pvalues = null.nested_test(np.array([s.delta_chi2 for s in found.singles]), found.gap.chi2, rank)
    for k, candidate in enumerate(candidates):
        columns = list(candidate.columns)
        amplitude, sigma, words = _alone(k, found.singles[k], candidates)
        size = detectable_amplitude(null, t[:, columns], len(candidates), candidate)
        # Candidates that differ in settings only are variants of one effect.
        others = [j for j, other in enumerate(candidates) if other.identity != candidate.identity]
        similar = max(others, key=lambda j: abs(found.correlation[k, j]), default=None)
        cosine = 0.0 if similar is None else abs(float(found.correlation[k, similar]))
        strength = 0.0 if similar is None else float(snr_to_separate(np.array([cosine]))[0])
        needed = snr_needed(min(len(columns), p), len(candidates), p, N)
        separable = float("nan") if size is None or similar is None else strength * size / needed
        yield CandidateResult(
            name=candidate.name,
            channel=candidate.channel,
            settings=dict(candidate.settings),
            unit=candidate.unit,
            label=candidate.title,
            columns=tuple(candidate.columns),
            amplitude=amplitude,
            sigma=sigma,
            words=words,
            delta_chi2=null.hartlap_factor * float(found.singles[k].delta_chi2),
            pvalue=min(1.0, float(pvalues[k]) * int((rank > 0).sum())),
            detectable=size,
            detectable_words="–" if size is None else candidate.effect.format_amplitude(size),
            similar=similar,
            correlation=cosine,
            strength=strength,
            separable=separable,
            separable_words=candidate.effect.format_amplitude(separable) if np.isfinite(separable) else "–",
        )


def detectable_amplitude(null: SimulatedGaussian, t: Vector, looks: int, candidate: Candidate) -> float | None:
    """Return the smallest amplitude that is found in nine cases of ten, rms over directions; None: no response.

    Parameters
    ----------
    null, t, looks
        Null, templates of the candidate, shape (p, k), and number of candidates.
    candidate
        The candidate.
    """
    size = detectable(null, t, looks).typical
    if not np.isfinite(size):
        return None
    direction = np.zeros(t.shape[1])
    direction[0] = size
    return abs(candidate.with_coordinates(direction, np.eye(len(direction))).amplitude)


def _alone(index: int, single: Fit, candidates: Sequence[Candidate]) -> tuple[float, float, str]:
    """Return amplitude, standard error and words of a candidate; NaN where no effect has such an amplitude."""
    try:
        fitted = Explanation((index,), single, 1.0, single.pvalue, single.pvalue)
        (effect,) = effects_of(fitted, candidates)
    except InputError:
        return float("nan"), float("nan"), "no such amplitude"
    return effect.amplitude, effect.sigma, effect.words


def held_out_pvalues(simulations: Vector, null: SimulatedGaussian) -> Vector:
    """Return the p-value of every simulation against all others, shape (N,): uniform for Gaussian data vectors.

    Notes
    -----
    With c = x_i - mean, S the scatter of all N and a = N/(N - 1) c'S^-1 c, the scatter of the others is
    S - N/(N - 1) c c', and x_i less their mean is N/(N - 1) c: its square in their scatter, over 1 + 1/(N - 1), is
    a/(1 - a) (Sherman & Morrison, Ann. Math. Stat. 21, 124, 1950).
    Against explicit refits: tests/unit/test_diagnosis_report.py.
    """
    count = len(simulations)
    white = (simulations - simulations.mean(axis=0)) @ null.whitening.T
    a = np.sum(white**2, axis=1) / null.dof * count / (count - 1)
    square = (null.dof - 1) * a / np.maximum(1.0 - a, 1e-12)
    return residual_pvalue(square, null.dimension, null.dof - 1)
