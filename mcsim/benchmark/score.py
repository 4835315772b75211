"""Open the keys and score the verdicts; score draws of the evidence by the same figures."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.benchmark import report
from mcsim.benchmark.bayes import Bayes
from mcsim.benchmark.draws import draws, powers
from mcsim.benchmark.figures import Score, scored
from mcsim.benchmark.learned_model import LearnedModel, without_effects
from mcsim.benchmark.make import SETTINGS, sampler_of
from mcsim.benchmark.prior import Prior
from mcsim.benchmark.record import Answer, Geometry, Record, most_probable
from mcsim.benchmark.run import VERDICTS, settings_of
from mcsim.benchmark.truth import Truth, finished_cases, open_key
from mcsim.diagnosis.analysis import analysis_of
from mcsim.diagnosis.api import prepared
from mcsim.diagnosis.batch import asking, batch
from mcsim.diagnosis.refine import significant_templates
from mcsim.errors import InputError
from mcsim.support.folders import writable

Vector = NDArray[np.float64]


def score(folder: str | Path, *, workers: int | None = None, quiet: bool = True) -> Score:
    """Score a challenge: check the seals, open the keys, and compare.

    Parameters
    ----------
    folder
        With cases, keys and verdicts; gets ``score/score.json``, ``score/report.html`` and ``score/score.png``.
    workers
        Processes that learn the model again, should it not be in the cache; default: the model's; 0: this one.

    Raises
    ------
    InputError
        A key that is not the sealed one, or no verdict.
    """
    target = Path(folder)
    fiducial, simulations = settings_of(target)
    cases = [case for case in finished_cases(target) if (target / VERDICTS / case).is_dir()]
    if not cases:
        raise InputError(f"{folder} has no verdicts; run mcsim challenge run {folder} first.")
    truths = [open_key(target, case) for case in cases]
    with batch(fiducial.compute.workers if workers is None else workers) as call:
        prepared(fiducial, analysis_of(fiducial), asking(call, quiet), simulations)
    text = config.to_json(fiducial)
    full = without_effects(text, simulations, ())
    prior = Prior(**json.loads((target / SETTINGS).read_text())["prior"])
    diagnose_maps = _Judge(text, simulations, full, prior)
    # Cases of one library after each other: a lesser court takes a second.
    order = sorted(range(len(cases)), key=lambda index: truths[index].without)
    records = {index: diagnose_maps.record(truths[index], target / VERDICTS / cases[index]) for index in order}
    result = scored(f"{len(cases)} full skies", [records[index] for index in range(len(cases))])
    report.write([result], target / "score")
    return result


def score_draws(
    model: str | Path | Mapping[str, Any] | config.RunConfig,
    number: int,
    seed: int,
    folder: str | Path,
    *,
    prior: Prior | None = None,
    simulations: int | None = None,
    detections: int = 4000,
    workers: int | None = None,
    quiet: bool = True,
) -> Score:
    """Score draws of a model's compressed evidence; see :func:`mcsim.benchmark.draws.draws`.

    Parameters
    ----------
    model, simulations
        As for :func:`mcsim.benchmark.make.make`.
    number, detections
        Of draws that are judged, and of further ones whose detection alone is looked at.
    seed, prior
        Of the draws.
    folder
        Gets ``score.json``, ``report.html`` and ``score.png``.
    workers
        Processes; default: the model's; 0: this one.
    """
    run = model if isinstance(model, config.RunConfig) else config.load(model)
    writable(Path(folder))
    with batch(run.compute.workers if workers is None else workers) as call:
        context = prepared(run, analysis_of(run), asking(call, quiet), simulations)
        records = draws(context, number, seed, prior=prior, call=call)
    power = powers(context, detections, seed)
    result = scored(f"{number} draws of the evidence", records, power)
    report.write([result], Path(folder))
    return result


class _Judge:
    """From a key and a verdict to a record."""

    def __init__(self, model: str, simulations: int | None, full: LearnedModel, prior: Prior) -> None:
        self.model, self.simulations, self.full = model, simulations, full
        self.templates = significant_templates(full.context.known)
        self.geometry = _geometry(full)
        self.bayes: Bayes = self.geometry.bayes(sampler_of(full.context, prior))

    def record(self, truth: Truth, folder: Path) -> Record:
        """Of one case."""
        verdict = json.loads((folder / "verdict.json").read_text())
        answer = json.loads((folder / "answer.json").read_text())
        learned = without_effects(self.model, self.simulations, truth.without)
        geometry = self.geometry if not truth.without else _geometry(learned)
        response = self._response(truth)
        best, right = None, np.nan
        if truth.kind in ("none", "one", "two"):
            best, right = most_probable(self.bayes.probabilities(np.array(answer["evidence"])))
        shrink = verdict["shrink"] or {}
        members = truth.members
        return Record(
            truth.case,
            truth.kind,
            truth.identities,
            members[0].strength if len(members) == 1 else self.full.context.null.expected_snr(response),
            len(members[0].coordinates) if len(members) == 1 else 0,
            geometry.rival(response[learned.rows], truth.identities) if members else 0.0,
            geometry.distances(response[learned.rows]) if truth.kind in ("left_out", "invented") else (),
            verdict["gap"]["p_value"],
            answer["maximum"],
            verdict["verdict"],
            _answers(verdict),
            best,
            right,
            self._pulls(truth, answer),
            (),
            shrink.get("predicted"),
            shrink.get("achieved"),
            shrink.get("sigma"),
            (shrink["gap_before"], shrink["gap_after"]) if shrink else None,
            None,
            tuple((place["frame"], place["L"], place["parity"]) for place in verdict["where"][:3]),
            truth.sampled,
        )

    def _response(self, truth: Truth) -> Vector:
        total = np.zeros(len(self.templates))
        for member in truth.members:
            if member.candidate is None:
                total += np.array(member.response)
            else:
                columns = list(self.full.context.candidates[member.candidate].columns)
                total += self.templates[:, columns] @ np.array(member.coordinates)
        return total

    def _pulls(self, truth: Truth, answer: Mapping[str, Any]) -> tuple[float, ...]:
        if truth.kind != "one" or not answer["explanations"]:
            return ()
        (member,), best = truth.members, answer["explanations"][0]
        assert member.candidate is not None  # it is of the library
        if best["proposals"] != [self.full.context.analysis.proposals[member.candidate].label]:
            return ()
        fitted = zip(best["amplitudes"], member.coordinates, best["errors"], strict=True)
        return tuple(float((value - true) / error) for value, true, error in fitted)


def _geometry(learned: LearnedModel) -> Geometry:
    context = learned.context
    return Geometry.of(context.null, significant_templates(context.known), context.candidates, context.calibration)


def _answers(verdict: Mapping[str, Any]) -> tuple[Answer, ...]:
    sets = [verdict["effects"], *verdict["alternatives"]] if verdict["effects"] else []
    return tuple(frozenset((effect["name"], effect["channel"]) for effect in one) for one in sets)
