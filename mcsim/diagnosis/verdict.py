"""The verdict as JSON of schema 1, and in a sentence."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.analysis import Proposal
from mcsim.diagnosis.candidate import Candidate, parts_of
from mcsim.diagnosis.partial_explanation import PartialExplanation
from mcsim.diagnosis.refine import effect_at
from mcsim.diagnosis.selection import Attribution, Explanation
from mcsim.diagnosis.validation import Prediction, Shrink
from mcsim.diagnosis.where import Place
from mcsim.stats.detection import detectable
from mcsim.stats.gaussian import SimulatedGaussian

SCHEMA = 1
PLACES = 12
SETS = 2
"""Alternatives that a sentence has room for."""


def effects_of(
    explanation: Explanation | PartialExplanation, candidates: Sequence[Candidate], proposals: Sequence[Proposal]
) -> list[dict[str, Any]]:
    """The effects of a set with amplitude, standard error, unit and parameters."""
    found = []
    for member, theta, covariance in parts_of(candidates, explanation.members, explanation.fit):
        effect = effect_at(proposals[member], theta, covariance)
        found.append(
            {
                "name": effect.name,
                "channel": proposals[member].channel,
                "amplitude": effect.amplitude,
                "sigma": _sigma(proposals[member], theta, covariance),
                "unit": effect.unit,
                "parameters": {key: _plain(value) for key, value in effect.parameters().items()},
            }
        )
    return found


def _sigma(proposal: Proposal, theta: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
    """Standard error of the amplitude, by its slopes in the coordinates over their own errors.

    Over less, what is at the edge of the possible would not move. What data do not tell is not varied.
    """
    scale = np.sqrt(np.diag(covariance))
    precision = np.asarray(np.linalg.pinv(covariance), dtype=np.float64)
    constrained = proposal.kind.constrained(theta, precision)
    slopes: NDArray[np.float64] = np.zeros(len(theta))
    for k in np.flatnonzero((scale > 0.0) & ((constrained != 0.0) | (theta == 0.0))):
        step = scale[k] * np.eye(len(theta))[k]
        up, down = (proposal.with_parameters(constrained + sign, precision).amplitude for sign in (step, -step))
        slopes[k] = (up - down) / (2.0 * scale[k])
    return float(np.sqrt(max(float(slopes @ covariance @ slopes), 0.0)))


def _plain(value: Any) -> Any:
    return [float(item) for item in value] if isinstance(value, tuple) else value


def where_of(place: Place) -> dict[str, Any]:
    """A place, as JSON has it."""
    e = place.element
    return {
        "statistic": {"score": "map", "noise": "cl"}.get(e.statistic, e.statistic),
        "channels": list(e.channels),
        "split": e.split,
        "L": e.L,
        "M": e.M,
        "parity": e.parity,
        "ell": None if e.ell is None else list(e.ell),
        "frame": e.frame,
        "z": place.z,
        "p": place.p,
    }


def detectable_of(
    null: SimulatedGaussian, t: NDArray[np.float64], candidates: Sequence[Candidate], proposals: Sequence[Proposal]
) -> list[dict[str, Any]]:
    """Smallest amplitude of every candidate that is found in nine cases of ten, root mean square over directions."""
    found = []
    for candidate, proposal in zip(candidates, proposals, strict=True):
        size = detectable(null, t[:, list(candidate.columns)], len(candidates)).typical
        if np.isfinite(size):
            direction = np.zeros(len(candidate.columns))
            direction[0] = size
            amplitude = proposal.with_parameters(direction, np.eye(len(direction))).amplitude
            row = {"name": candidate.name, "channel": candidate.channel, "amplitude_90": abs(amplitude)}
            found.append({**row, "unit": candidate.unit, "settings": dict(candidate.settings)})
    return found


def verdict_of(
    case: str,
    found: Attribution,
    candidates: Sequence[Candidate],
    proposals: Sequence[Proposal],
    where: Sequence[Place],
    shrink: tuple[Prediction, Shrink, str] | None,
    able: Sequence[Mapping[str, Any]],
    notes: Sequence[str],
    filtered: PartialExplanation | None = None,
) -> dict[str, Any]:
    """``verdict.json``, schema 1; ``heard`` goes with "unknown"."""
    sets = [effects_of(explanation, candidates, proposals) for explanation in found.explanations]
    nearest = proposals[found.nearest]
    result: dict[str, Any] = {
        "schema": SCHEMA,
        "case": case,
        "gap": {"p_value": found.gap.pvalue, "statistic": found.gap.chi2, "dof": found.gap.dimension},
        "verdict": found.verdict,
        "effects": sets[0] if sets else [],
        "alternatives": sets[1:],
        "odds": [explanation.odds for explanation in found.explanations],
        "where": [where_of(place) for place in where[:PLACES]],
        "shrink": None,
        "nearest": {"name": nearest.kind.name, "channel": nearest.channel, "cosine": found.cosine},
        "heard": [] if filtered is None else effects_of(filtered, candidates, proposals),
        "left": None if filtered is None else filtered.left,
        "detectable": list(able),
        "notes": list(notes),
    }
    if shrink is not None:
        predicted, achieved, data = shrink
        result["shrink"] = {
            "predicted": predicted.fraction.value,
            "achieved": achieved.fraction.value,
            "sigma": achieved.fraction.sigma,
            "sigma_predicted": predicted.fraction.sigma,
            "gap_before": achieved.before.value,
            "sigma_before": achieved.before.sigma,
            "gap_after": achieved.after.value,
            "sigma_after": achieved.after.sigma,
            "p_value_after": achieved.probability_after,
            "data": data,
        }
    return result


def sentence(verdict: Mapping[str, Any]) -> str:
    """The verdict for a busy person."""
    p = verdict["gap"]["p_value"]
    kind = verdict["verdict"]
    if kind == "none":
        return f"The model describes the data (p = {p:.2g})."
    level = f"= {p:.1g}" if p > 0.0 else "< 1e-300"
    start = f"The model does not describe the data (p {level}): "
    if kind == "unknown":
        near = verdict["nearest"]
        where = near["channel"] or "all channels"
        nearest = f"nearest is {near['name']} in {where} (cosine {near['cosine']:.2f})"
        return f"{start}no effect of the library explains it; {nearest}.{_partly(verdict)}"
    text = " and ".join(_words(effect) for effect in verdict["effects"])
    if kind == "degenerate":
        shown = verdict["alternatives"][:SETS]
        others = "; or ".join(" and ".join(_words(effect) for effect in one) for one in shown)
        more = len(verdict["alternatives"]) - len(shown)
        return f"{start}{text}; or {others}" + (f"; or {more} more sets." if more else ".")
    return f"{start}{text}."


def _partly(verdict: Mapping[str, Any]) -> str:
    if len(verdict["heard"]) < 2:
        return ""
    names = [f"{effect['name']} in {effect['channel'] or 'all channels'}" for effect in verdict["heard"]]
    return f" Heard in it are {', '.join(names[:-1])} and {names[-1]}, which leave {verdict['left']:.0%} of the gap."


def _words(effect: Mapping[str, Any]) -> str:
    where = effect["channel"] or "all channels"
    return f"{effect['name']} in {where}, {effect['amplitude']:.3g} +- {effect['sigma']:.2g} ({effect['unit']})"
