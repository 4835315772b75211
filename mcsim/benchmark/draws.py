"""Draw data vectors without maps: thousands of cases that are judged like full skies."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim.benchmark.bayes import BayesClassifier
from mcsim.benchmark.case import Drawn, Prior
from mcsim.benchmark.library import LinearModel, linear_model
from mcsim.benchmark.record import Record, best_possible, facts, pulls
from mcsim.benchmark.sampler import CaseSampler
from mcsim.diagnosis.batch import Batch
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.diagnosis.selection import Attribution
from mcsim.sphere import rng
from mcsim.stats.detection import power

Vector = NDArray[np.float64]

CASES_PER_TASK = 20
UNLIKE = 0.3
"""Cosine below which an effect that does not act is unlike those that do."""

STRONG = 8.0
"""Expected S/N from which on an effect that does not act is added as well."""


@dataclass(frozen=True, eq=False)
class Draw:
    """Number of a draw, what it is, and the response of the data vector of its library, shape (p_raw,)."""

    number: int
    drawn: Drawn
    response: Vector


def draws(context: DiagnosisContext, number: int, seed: int, prior: Prior, call: Batch | None = None) -> list[Record]:
    """Draw data vectors and judge them.

    Parameters
    ----------
    context
        What a diagnosis of the model has learned.
    number
        Number of draws.
    seed
        Of the draws.
    prior
        Distribution that is drawn from; out-of-library effects have no template and are not drawn.
    call
        Runs tasks; default: in this process.

    Returns
    -------
    list
        One record for each draw, judged by :func:`mcsim.diagnosis.selection.attribute`.

    Notes
    -----
    x = data vector of a simulation without effects that is not in the covariance (the first one again when all have
    been used), plus templates times coordinates: responses are straight lines here, and templates exact. What they are
    not, and everything else that a map goes through, is tested by full skies.
    """
    full = linear_model(context)
    sampler = CaseSampler(prior, full.library)
    kinds = sampler.kinds(seed, number)
    by_library: dict[tuple[str, ...], list[tuple[int, Drawn]]] = {}
    for case in range(number):
        drawn = sampler.draw(kinds, seed, case)
        by_library.setdefault(drawn.without, []).append((case, drawn))
    tasks = []
    for names, cases in by_library.items():
        model = linear_model(context, names) if names else full
        posed = [Draw(case, drawn, full.library.response(drawn.members)[model.rows]) for case, drawn in cases]
        tasks += [(model, prior, seed, posed[i : i + CASES_PER_TASK]) for i in range(0, len(posed), CASES_PER_TASK)]
    found = call(judge, tasks) if call else enumerate(judge(*task) for task in tasks)
    return sorted((record for _, records in found for record in records), key=lambda record: record.case)


def judge(model: LinearModel, prior: Prior, seed: int, cases: Sequence[Draw]) -> list[Record]:
    """Judge draws of one library."""
    library = model.library
    bayes = BayesClassifier(CaseSampler(prior, library))
    found = []
    for draw in cases:
        drawn, x = draw.drawn, model.data[draw.number % len(model.data)] + draw.response
        said = library.attribute(x)
        identities = library.identities
        found.append(
            Record(
                case=f"draw-{draw.number:05d}",
                strength=library.null.expected_snr(draw.response),
                p_value=said.gap.pvalue,
                maximum=said.gap.maximum,
                verdict=said.verdict,
                answers=tuple(frozenset(identities[m] for m in one.members) for one in said.explanations),
                absent=_absent(model, draw, x, seed),
                **facts(drawn, draw.response, library),
                **best_possible(drawn, x, bayes),
                **_pulls(said, drawn),
                **_reduction(model, x, said),
            )
        )
    return found


def _pulls(said: Attribution, drawn: Drawn) -> dict[str, Any]:
    """Return the pulls of the only effect, where it was named, and named or not."""
    if drawn.kind != "one":
        return {}
    (member,) = drawn.members
    assert member.candidate is not None  # it is of the library
    alone = said.singles[member.candidate]
    fitted = pulls(alone.amplitudes, member.coordinates, alone.errors)
    named = bool(said.explanations) and said.explanations[0].members == (member.candidate,)
    return {"pulls": fitted if named else (), "fitted": fitted}


def _reduction(model: LinearModel, x: Vector, said: Attribution) -> dict[str, Any]:
    found = model.held_out_reduction(x, said.explanations[0].members) if said.explanations else None
    if found is None:
        return {}
    return {
        "predicted": found.predicted.value,
        "achieved": found.achieved.value,
        "sigma": found.achieved.sigma,
        "gaps": (found.before.value, found.after.value),
    }


def _absent(model: LinearModel, draw: Draw, x: Vector, seed: int) -> tuple[float, float] | None:
    """Return the excess chi^2 before and after one effect that neither acts nor is like the one that does."""
    library, truth = model.library, draw.drawn.identities
    if draw.drawn.kind != "one" or library.null.expected_snr(draw.response) < STRONG:
        return None
    unlike = [
        index
        for index, cosine in enumerate(library.cosines(draw.response))
        if library.identities[index] not in truth and cosine < UNLIKE and library.groups.sizes[index] > 0
    ]
    if not unlike:
        return None
    chosen = unlike[int(rng.generator(seed, draw.number, "challenge/absent").integers(len(unlike)))]
    found = model.held_out_reduction(x, (chosen,))
    return None if found is None else (found.before.value, found.after.value)


@dataclass(frozen=True, eq=False)
class Power:
    """Detection of single effects against their expected S/N.

    Attributes
    ----------
    strengths, by_maximum, by_gap
        Of every draw: expected S/N, and whether the largest matched filter and the global test detect it at 5 %.
    grid, limit, finite
        Grid of S/N, and the mean power after Bonferroni over the library with infinitely many simulations and with
        those that there are.
    null_maximum, null_gap
        p-values of data vectors without an effect.
    """

    strengths: Vector
    by_maximum: NDArray[np.bool_]
    by_gap: NDArray[np.bool_]
    grid: Vector
    limit: Vector
    finite: Vector
    null_maximum: Vector
    null_gap: Vector


def powers(model: LinearModel, number: int, seed: int, *, alpha: float = 0.05) -> Power:
    """Test draws of single effects with an expected S/N from 1 to 9 for detection, without attribution."""
    library, data = model.library, model.data
    only = Prior(none=0.0, one=1.0, two=0.0, left_out=0.0, invented=0.0, weakest=1.0, strongest=9.0)
    sampler = CaseSampler(only, library)
    kinds = sampler.kinds(seed, number)
    drawn = [sampler.draw(kinds, seed, case).members for case in range(number)]
    tested = [library.test(data[case % len(data)] + library.response(members)) for case, members in enumerate(drawn)]
    quiet = [library.test(x) for x in data]
    grid, tests = np.linspace(0.5, 9.0, 35), library.calibration.tests
    columns, counts = np.unique([len(members[0].coordinates) for members in drawn], return_counts=True)

    def mean_power(simulations: int | None) -> Vector:
        rest = alpha / tests, library.null.dimension, simulations
        return np.average([[power(s, int(k), *rest) for s in grid] for k in columns], axis=0, weights=counts)

    return Power(
        strengths=np.array([members[0].strength for members in drawn]),
        by_maximum=np.array([one.maximum <= alpha for one in tested]),
        by_gap=np.array([one.pvalue <= alpha for one in tested]),
        grid=grid,
        limit=mean_power(None),
        finite=mean_power(library.null.n_sims),
        null_maximum=np.array([one.maximum for one in quiet]),
        null_gap=np.array([one.pvalue for one in quiet]),
    )
