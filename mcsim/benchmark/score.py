"""Open the keys and score the verdicts; score draws of the data vector by the same metrics."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mcsim.benchmark import report
from mcsim.benchmark.bayes import BayesClassifier
from mcsim.benchmark.case import Truth
from mcsim.benchmark.draws import draws, powers
from mcsim.benchmark.folder import VERDICTS, Settings, finished_cases, open_key, read_json
from mcsim.benchmark.learned import learned_model, workers_of
from mcsim.benchmark.library import Library, linear_model
from mcsim.benchmark.record import Record, best_possible, facts, pulls
from mcsim.benchmark.sampler import CaseSampler
from mcsim.benchmark.summary import Score, summarise
from mcsim.diagnosis.candidate import Candidate
from mcsim.errors import InputError
from mcsim.support.folders import writable

DETECTIONS = 4000
"""Draws of single effects that are tested for detection alone."""


def score(folder: str | Path, *, workers: int | None = None, quiet: bool = True) -> Score:
    """Check the seals of a challenge, open the keys, and compare them with the verdicts.

    Parameters
    ----------
    folder
        With cases, keys and verdicts. It gets ``score/score.json``, ``score/report.html`` and ``score/score.png``.
    workers
        Processes that learn the model again, should it not be in the cache; default: the model's; 0: this process.
    quiet
        Report no progress.

    Raises
    ------
    InputError
        If there is no verdict, or one cannot be read, or a key is not the sealed one.
    """
    target = Path(folder)
    made = finished_cases(target)
    cases = [case for case in made if (target / VERDICTS / case).is_dir()]
    if not cases:
        raise InputError(f"{folder} has no verdicts; run mcsim challenge run {folder} first.")
    settings, truths = Settings.read(target), [open_key(target, case) for case in cases]
    with workers_of(settings, workers, quiet):
        pass  # now the model is in the cache
    library = learned_model(settings).library
    bayes = BayesClassifier(CaseSampler(settings.prior, library))
    # Cases of one library after each other: a smaller library takes a second.
    order = sorted(truths, key=lambda truth: truth.without)
    records = [_record(settings, truth, target / VERDICTS / truth.case, bayes) for truth in order]
    title = f"{len(cases)} full skies" + (
        f" of {len(made)}; the others have no verdict" if len(cases) < len(made) else ""
    )
    result = summarise(title, sorted(records, key=lambda record: record.case))
    report.write(result, target / "score")
    return result


def score_draws(
    settings: Settings, folder: str | Path, number: int, seed: int, *, workers: int | None = None, quiet: bool = True
) -> Score:
    """Score draws of a model's data vector; see :func:`mcsim.benchmark.draws.draws`.

    Parameters
    ----------
    settings
        Model, prior and number of simulations.
    folder
        Gets ``score.json``, ``report.html`` and ``score.png``.
    number
        Number of draws; :data:`DETECTIONS` more are tested for detection alone.
    seed
        Of the draws.
    workers
        Number of processes; default: the model's; 0: this process.
    quiet
        Report no progress.
    """
    if number < 1:
        raise InputError(f"a score of {number} draws is none; ask for at least 1.")
    writable(Path(folder))
    with workers_of(settings, workers, quiet) as call:
        context = learned_model(settings).context
        records = draws(context, number, seed, settings.prior, call)
    power = powers(linear_model(context), DETECTIONS, seed)
    result = summarise(f"{number} draws of the data vector", records, power)
    report.write(result, Path(folder))
    return result


def _record(settings: Settings, truth: Truth, folder: Path, bayes: BayesClassifier) -> Record:
    """Compare the key of a case with the verdict in a folder."""
    model, full = learned_model(settings, truth.without), bayes.sampler.library
    remedy = f"delete {folder} and run mcsim challenge run again"
    verdict, answer = (read_json(folder / name, remedy) for name in ("verdict.json", "answer.json"))
    try:
        said, x = _said(truth, verdict, answer, full), np.array(answer["evidence"], dtype=float)
    except (KeyError, TypeError) as error:
        raise InputError(f"{folder} holds no verdict ({error}); {remedy}.") from error
    response, members = full.response(truth.members), truth.members
    return Record(
        case=truth.case,
        strength=members[0].strength if len(members) == 1 else full.null.expected_snr(response),
        sampled=truth.sampled,
        **said,
        **facts(truth, response[model.rows], model.library),
        **best_possible(truth, x, bayes),
    )


def _said(truth: Truth, verdict: Mapping[str, Any], answer: Mapping[str, Any], library: Library) -> dict[str, Any]:
    """Return what a record says of the verdict."""
    sets = [verdict["effects"], *verdict["alternatives"]] if verdict["effects"] else []
    reduction = verdict["shrink"] or {}
    return {
        "p_value": verdict["gap"]["p_value"],
        "maximum": answer["maximum"],
        "verdict": verdict["verdict"],
        "answers": tuple(frozenset((effect["name"], effect["channel"]) for effect in one) for one in sets),
        "pulls": _pulls(truth, verdict, answer, library),
        **{key: reduction.get(key) for key in ("predicted", "achieved", "sigma")},
        "gaps": (reduction["gap_before"], reduction["gap_after"]) if reduction else None,
        "places": tuple((place["frame"], place["L"], place["parity"]) for place in verdict["where"][:3]),
    }


def _pulls(truth: Truth, verdict: Mapping[str, Any], answer: Mapping[str, Any], library: Library) -> tuple[float, ...]:
    """Return fitted less true components over their errors, where the only effect is named first."""
    if truth.kind != "one" or not answer["explanations"]:
        return ()
    (member,), best = truth.members, answer["explanations"][0]
    assert member.candidate is not None  # it is of the library
    if not _is_named(verdict["effects"], library.candidates[member.candidate]):
        return ()
    return pulls(best["amplitudes"], member.coordinates, best["errors"])


def _is_named(effects: Sequence[Mapping[str, Any]], candidate: Candidate) -> bool:
    """Return True if the only effect of a verdict is the candidate, with its settings."""
    identities = [(effect["name"], effect["channel"]) for effect in effects]
    return identities == [candidate.identity] and candidate.settings.items() <= effects[0]["parameters"].items()
