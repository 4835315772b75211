"""Score the verdicts on full skies beside their keys, and draws of the data vector, without maps, like them."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from mcsim.benchmark import folder as files
from mcsim.benchmark import report
from mcsim.benchmark.bayes import BayesClassifier, facts
from mcsim.benchmark.case import Drawn, Prior, Record, Truth
from mcsim.benchmark.folder import Settings
from mcsim.benchmark.models import EffectsLibrary, LinearModel, learned_model, linear_model, simulated, workers_of
from mcsim.benchmark.sampler import CaseSampler
from mcsim.benchmark.summary import ALPHA, Power, Score
from mcsim.datavector.campaign import Batch, asking
from mcsim.datavector.candidate import Candidate
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.diagnosis.selection import Attribution, Selection, Verdict, attribute
from mcsim.ensemble.runner import Workers
from mcsim.errors import InputError
from mcsim.sphere import rng
from mcsim.stats.detection import power
from mcsim.stats.intervals import pulls
from mcsim.stats.look_elsewhere import GlobalTest, global_test
from mcsim.support.arrays import Matrix, Vector
from mcsim.support.folders import not_a_file, not_filled, read_json, user_path, writable

CASES_PER_TASK = 20
DETECTIONS = 4000  #: draws of single effects that are tested for detection alone
UNLIKE = 0.3  #: cosine below which an effect that does not act is unlike those that do
STRONG = 8.0  #: expected S/N from which on an effect that does not act is added as well


def score(folder: str | Path, *, workers: Workers | None = None, quiet: bool = True) -> Score:
    """Check the seals of a challenge, open the keys, and compare them with the verdicts.

    The folder gets ``score/score.json``, ``score/report.html`` and ``score/score.png``. ``workers`` are the processes
    that learn the model again, should it not be in the cache (:func:`mcsim.benchmark.challenge.make`). InputError if
    there is no verdict, or one cannot be read, or a key is not the sealed one, or cases that have keys are lost.
    """
    target = user_path(folder)
    not_a_file(target / "score")
    made = files.all_cases(target)
    cases = [case for case in made if files.is_answered(target, case)]
    for case in cases:
        files.check_answer(target, case)
    if not cases:
        raise InputError(f"{folder} has no verdicts; run mcsim challenge run {folder} first.")
    settings, truths = Settings.read(target), [files.open_key(target, case) for case in cases]
    for truth in truths:
        _check_question(settings, target, truth)
    with workers_of(settings, workers, quiet):
        pass  # now the model is in the cache
    bayes = BayesClassifier(CaseSampler(settings.prior, learned_model(settings)))
    # Cases of one library after each other: a smaller library takes a second.
    order = sorted(truths, key=lambda truth: truth.without)
    records = [_record(settings, truth, target / files.VERDICTS / truth.case, bayes) for truth in order]
    others = f" of {len(made)}; the others have no verdict" if len(cases) < len(made) else ""
    result = Score(f"{len(cases)} full skies{others}", sorted(records, key=lambda record: record.case))
    report.write(result, target / "score")
    return result


def score_draws(
    settings: Settings,
    folder: str | Path,
    number: int,
    seed: int,
    *,
    workers: Workers | None = None,
    quiet: bool = True,
) -> Score:
    """Score draws of a model's data vector (:func:`draws`), and write the score into a folder.

    :data:`DETECTIONS` more draws are tested for detection alone. ``workers`` as for
    :func:`mcsim.benchmark.challenge.make`.
    """
    if number < 1:
        raise InputError(f"a score of {number} draws is none; ask for at least 1.")
    target = user_path(folder)
    not_filled(target)
    writable(target)
    with workers_of(settings, workers, quiet) as call:
        context = learned_model(settings).context
        with asking(call, quiet) as ask:
            fresh = simulated(context, number, seed, ask)
        records = draws(context, number, seed, settings.prior, call, fresh)
    found = powers(linear_model(context, fresh=fresh), DETECTIONS, seed)
    result = Score(f"{number} draws of the data vector", records, found)
    report.write(result, target)
    return result


def _check_question(settings: Settings, folder: Path, truth: Truth) -> None:
    """Raise InputError unless a case was diagnosed without the effects that its key leaves out."""
    asked = files.question(settings, folder, truth.case)
    if set(asked) != set(truth.without):
        said, own = (", ".join(names) or "nothing" for names in (asked, truth.without))
        raise InputError(
            f"{folder / files.MAPS / truth.case / files.QUESTION} leaves out {said}, but the key {own}; restore it, "
            f"delete {folder / files.VERDICTS / truth.case} and run mcsim challenge run again."
        )


def _record(settings: Settings, truth: Truth, folder: Path, bayes: BayesClassifier) -> Record:
    """Compare the key of a case with the verdict in a folder."""
    model, full = learned_model(settings, truth.without), bayes.sampler.effects_library
    remedy = f"delete {folder} and run mcsim challenge run again"
    verdict, answer = (read_json(folder / name, remedy) for name in ("verdict.json", files.ANSWER))
    try:
        if verdict["case"] != truth.case:
            raise ValueError(f"it is of {verdict['case']}")
        known = files.names_of_effects(settings)
        said, x = _said(truth, verdict, answer, full, known), _numbers(answer["evidence"], len(model.rows))
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise InputError(f"{folder} holds no verdict ({error}); {remedy}.") from error
    response, members = full.response(truth.members), truth.members
    return Record(
        case=truth.case,
        strength=members[0].strength if len(members) == 1 else full.null.expected_snr(response),
        sampled=truth.sampled,
        **said,
        **facts(truth, x, response[model.rows], model, bayes),
    )


def _said(
    truth: Truth,
    verdict: Mapping[str, Any],
    answer: Mapping[str, Any],
    library: EffectsLibrary,
    known: Set[str],
) -> dict[str, Any]:
    """Return what a record says of the verdict; ValueError if it names other effects than the ``known`` ones."""
    sets = [verdict["effects"], *verdict["alternatives"]] if verdict["effects"] else []
    word = _word(verdict["verdict"], sets)
    answers = tuple(frozenset((effect["name"], effect["channel"]) for effect in one) for one in sets)
    if unknown := sorted({name for one in answers for name, _ in one} - known):
        raise ValueError(f"{unknown[0]!r} is no effect")
    return {
        "p_value": _probability(verdict["gap"]["p_value"]),
        "maximum": _probability(answer["maximum"]),
        "verdict": word,
        "answers": answers,
        "pulls": _pulls(truth, verdict, answer, library),
        **_reduction(verdict["shrink"]),
        "places": tuple((place["frame"], place["L"], place["parity"]) for place in verdict["where"][:3]),
    }


def _pulls(
    truth: Truth, verdict: Mapping[str, Any], answer: Mapping[str, Any], library: EffectsLibrary
) -> tuple[float, ...]:
    """Return fitted less true components over their errors, where the only effect is named first."""
    if truth.kind != "one" or not answer["explanations"]:
        return ()
    (member,), best = truth.members, answer["explanations"][0]
    assert member.candidate is not None  # it is of the library
    if not _is_named(verdict["effects"], library.candidates[member.candidate]):
        return ()
    amplitudes = _numbers(best["amplitudes"], len(member.coordinates))
    return pulls(amplitudes, member.coordinates, np.asarray(best["errors"], dtype=float))


def _numbers(values: Any, count: int) -> Vector:
    """Return a list as an array; ValueError unless it has so many finite numbers."""
    found = np.array(values, dtype=float)
    if found.shape != (count,):
        raise ValueError(f"{found.size} numbers where {count} are needed")
    if not np.isfinite(found).all():
        raise ValueError("numbers that are not finite")
    return found


def _probability(value: Any) -> float:
    """Return a number from 0 to 1; ValueError for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value <= 1.0:
        raise ValueError(f"{value!r} is no probability")
    return value


def _word(value: Any, sets: Sequence[Sequence[Any]]) -> str:
    """Return one of the words for a verdict; ValueError for anything else, or if its sets of effects are others."""
    if value not in get_args(Verdict):
        raise ValueError(f"{value!r} is not one of {', '.join(get_args(Verdict))}")
    sizes = [len(one) for one in sets]
    agrees = {"effect": sizes == [1], "mixture": len(sizes) == 1 and sizes[0] > 1, "degenerate": len(sizes) > 1}
    if not agrees.get(value, not sizes):
        raise ValueError(f"{value!r} with sets of {', '.join(map(str, sizes)) or 'no'} effects")
    return str(value)


def _is_named(effects: Sequence[Mapping[str, Any]], candidate: Candidate) -> bool:
    """Return True if the only effect of a verdict is the candidate, with its settings."""
    identities = [(effect["name"], effect["channel"]) for effect in effects]
    return identities == [candidate.identity] and candidate.settings.items() <= effects[0]["parameters"].items()


@dataclass(frozen=True, eq=False)
class Draw:
    """Number of a draw, what it is, and the response of the data vector of its library, shape (p_raw,)."""

    number: int
    drawn: Drawn
    response: Vector


def draws(
    context: DiagnosisContext, number: int, seed: int, prior: Prior, call: Batch, fresh: Matrix | None = None
) -> list[Record]:
    """Draw data vectors and judge them by :func:`mcsim.diagnosis.selection.attribute`; one record for each draw.

    x = data vector of a simulation without effects that is not in the covariance (:func:`linear_model`), plus templates
    times coordinates: responses are straight lines here, and templates exact. What they are not, and everything else
    that a map goes through, is tested by full skies. Out-of-library effects have no template and are not drawn.
    """
    full = linear_model(context, fresh=fresh)
    sampler = CaseSampler(prior, full)
    kinds = sampler.kinds(seed, number)
    by_library: dict[tuple[str, ...], list[Draw]] = {}
    for case in range(number):
        drawn = sampler.draw(kinds, seed, case)
        by_library.setdefault(drawn.without, []).append(Draw(case, drawn, full.response(drawn.members)))
    tasks = []
    for names, cases in by_library.items():
        model = linear_model(context, names, fresh) if names else full
        posed = [replace(draw, response=draw.response[model.rows]) for draw in cases]
        tasks += [(model, prior, seed, posed[i : i + CASES_PER_TASK]) for i in range(0, len(posed), CASES_PER_TASK)]
    return sorted((record for _, found in call(judge, tasks) for record in found), key=lambda record: record.case)


def judge(model: LinearModel, prior: Prior, seed: int, cases: Sequence[Draw]) -> list[Record]:
    """Judge draws of one library."""
    bayes = BayesClassifier(CaseSampler(prior, model))
    found = []
    for draw in cases:
        x = model.data[draw.number % len(model.data)] + draw.response
        said = attribute(Selection(model.null, x, model.templates, model.candidates, model.calibration))
        said = said.if_named(DiagnosisSettings())
        reduction = model.held_out_reduction(x, said.explanations[0].members) if said.explanations else None
        record = Record(
            case=f"draw-{draw.number:05d}",
            strength=model.null.expected_snr(draw.response),
            p_value=said.gap.pvalue,
            maximum=said.gap.maximum,
            verdict=said.verdict,
            answers=tuple(frozenset(model.identities[m] for m in one.members) for one in said.explanations),
            absent=_absent(model, draw, x, seed),
            **facts(draw.drawn, x, draw.response, model, bayes),
            **_fitted(said, draw.drawn),
            **_reduction(None if reduction is None else reduction.to_json()),
        )
        found.append(record)
    return found


def _fitted(said: Attribution, drawn: Drawn) -> dict[str, Any]:
    """Return the pulls of the only effect, where it was named, and named or not."""
    if drawn.kind != "one":
        return {}
    (member,) = drawn.members
    assert member.candidate is not None  # it is of the library
    alone = said.singles[member.candidate]
    fitted = pulls(alone.amplitudes, member.coordinates, alone.errors)
    named = bool(said.explanations) and said.explanations[0].members == (member.candidate,)
    return {"pulls": fitted if named else (), "fitted": fitted}


def _reduction(shrink: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return what a record says of a reduction as ``verdict.json`` has it; nothing if it was not measured."""
    if not shrink:
        return {}
    kept = {key: shrink.get(key) for key in ("predicted", "achieved", "sigma")}
    return {**kept, "gaps": (shrink["gap_before"], shrink["gap_after"])}


def _absent(model: LinearModel, draw: Draw, x: Vector, seed: int) -> tuple[float, float] | None:
    """Return the excess chi^2 before and after one effect that neither acts nor is like the one that does."""
    if draw.drawn.kind != "one" or model.null.expected_snr(draw.response) < STRONG:
        return None
    acts = np.array([identity in draw.drawn.identities for identity in model.identities])
    unlike = np.flatnonzero(~acts & (model.cosines(draw.response) < UNLIKE) & (model.groups.sizes > 0))
    if not len(unlike):
        return None
    chosen = int(unlike[rng.generator(seed, draw.number, "challenge/absent").integers(len(unlike))])
    found = model.held_out_reduction(x, (chosen,))
    return None if found is None else (found.before.value, found.after.value)


def powers(model: LinearModel, number: int, seed: int) -> Power:
    """Test draws of single effects with an expected S/N from 1 to 9 for detection, without attribution."""
    only = Prior(none=0.0, one=1.0, two=0.0, left_out=0.0, invented=0.0, weakest=1.0, strongest=9.0)
    sampler = CaseSampler(only, model)
    kinds = sampler.kinds(seed, number)
    drawn = [sampler.draw(kinds, seed, case).members for case in range(number)]

    def test(x: Vector) -> GlobalTest:
        return global_test(model.null, x, model.groups, model.calibration)

    tested = [test(model.data[case % len(model.data)] + model.response(one)) for case, one in enumerate(drawn)]
    grid = np.linspace(0.5, 9.0, 35)
    columns, counts = np.unique([len(members[0].coordinates) for members in drawn], return_counts=True)

    def mean_power(simulations: int | None) -> Vector:
        rest = ALPHA / model.calibration.tests, model.null.dimension, simulations
        return np.average([[power(s, int(k), *rest) for s in grid] for k in columns], axis=0, weights=counts)

    return Power(
        strengths=np.array([members[0].strength for members in drawn]),
        by_maximum=np.array([one.maximum <= ALPHA for one in tested]),
        by_gap=np.array([one.pvalue <= ALPHA for one in tested]),
        grid=grid,
        limit=mean_power(None),
        finite=mean_power(model.null.dof + 1),
        null_gap=np.array([test(x).pvalue for x in model.data]),
    )
