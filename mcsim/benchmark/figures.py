"""The figures of a score: shares, powers, pulls, shrinks, and the matrices of confusion, from records of cases."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from mcsim.benchmark.draws import Power
from mcsim.benchmark.expected import places_right
from mcsim.benchmark.intervals import Figure, mean, nominal, removed, share, slope, strength_at, strength_of, width
from mcsim.benchmark.record import Answer, Record

NONE, MIXTURE, SET, UNKNOWN = "none", "mixture", "set", "unknown"
ALPHA = 0.05
NAMED, FAR, APART, TWINS, SHRUNK, PLACED = 5.0, 8.0, 0.7, 0.9, 8.0, 6.0


@dataclass(frozen=True, eq=False)
class Confusion:
    """Cases by what was there and what was said, shape (truths, answers)."""

    truths: tuple[str, ...]
    answers: tuple[str, ...]
    counts: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Score:
    """All figures of a set of records.

    Attributes
    ----------
    title
        Of the records.
    figures
        In the order in which they are asked for.
    said, best
        Confusion of the diagnosis, of all cases, and of the classifier that knows the prior, of those whose truth is in
        its library.
    diagnosed
        Confusion of the diagnosis on the cases of ``best``.
    by_left_out
        Of every effect that was left out: cases, unknown, wrong single name, mean distance.
    records, power
        What they are of.
    """

    title: str
    figures: tuple[Figure, ...]
    said: Confusion
    diagnosed: Confusion
    best: Confusion
    by_left_out: tuple[tuple[str, int, int, int, float], ...]
    records: tuple[Record, ...]
    power: Power | None


def scored(title: str, records: Sequence[Record], power: Power | None = None) -> Score:
    """Score records; of draws also the power of detection."""
    known = [record for record in records if record.bayes is not None]
    return Score(
        title,
        (
            *_detection(records, power),
            *_naming(records, known),
            *_unknowns(records),
            *_amplitudes(records),
            *_shrinks(records),
            *_placing(records),
        ),
        confusion(records),
        confusion(known),
        confusion(known, best=True),
        _rotation(records),
        tuple(records),
        power,
    )


def _detection(records: Sequence[Record], power: Power | None) -> list[Figure]:
    quiet = np.array([record.p_value for record in records if record.kind == "none"])
    if power is not None:
        quiet = power.null_gap
    found = [nominal("false alarms, 5 % nominal", list(quiet <= ALPHA), ALPHA, "5 % within the interval")]
    if len(quiet) >= 5:
        test = stats.kstest(quiet, "uniform")
        p = float(test.pvalue)
        found.append(Figure("p-values uniform: p of KS", p, np.nan, np.nan, len(quiet), "above 0.01", p > 0.01))
    if power is not None:
        limit = strength_of(power.limit, power.grid)
        for name, hits in (("the templates' maximum", power.by_maximum), ("the whole test", power.by_gap)):
            s, low, high = strength_at(power.strengths, hits)
            met = bool(s <= 1.1 * limit) if np.isfinite(s) else None
            target = "within 10 % of the limit" if hits is power.by_maximum else ""
            title = f"strength at 90 % power by {name}, over the limit {limit:.2f}"
            found.append(
                Figure(title, s / limit, low / limit, high / limit, len(hits), target, met if target else None)
            )
    strong = [r.p_value <= ALPHA for r in records if r.kind == "one" and r.strength >= NAMED]
    found.append(share(f"single effects found, s >= {NAMED:g}", strong))
    return found


def _naming(records: Sequence[Record], known: Sequence[Record]) -> list[Figure]:
    ones = [r for r in records if r.kind == "one" and r.strength >= NAMED]
    apart, nearest_candidates = [r for r in ones if r.rival <= APART], [r for r in ones if r.rival > TWINS]
    rest = [r for r in ones if APART < r.rival <= TWINS]
    found = [
        share(
            f"right effect, s >= {NAMED:g}, |rho| <= {APART:g}", [r.right for r in apart], "at least 95 %", least=0.95
        ),
        share(f"right effect, s >= {NAMED:g}, {APART:g} < |rho| <= {TWINS:g}", [r.right for r in rest]),
        share(
            f"truth in the set, s >= {NAMED:g}, |rho| > {TWINS:g}",
            [r.truth in r.answers for r in nearest_candidates],
            "at least 95 %",
            least=0.95,
        ),
        share("truth in the set, two effects", [r.truth in r.answers for r in records if r.kind == "two"]),
    ]
    if known:
        right = np.array([r.right for r in known], dtype=float)
        best = np.array([r.bayes == r.truth for r in known], dtype=float)
        found.append(share("right answer, cases of the library", list(right > 0)))
        found.append(share("right answer, Bayes", list(best > 0)))
        behind = mean("points behind Bayes", list(best - right), "at most 0.02")
        found.append(behind.judged(behind.value <= 0.02))
        found.append(
            mean("Bayes' own account less its share", [r.bayes_right - float(r.bayes == r.truth) for r in known])
        )
    return found


def _unknowns(records: Sequence[Record]) -> list[Figure]:
    foreign = [r for r in records if not r.known]
    far = [r for r in foreign if r.distances and r.distances[-1] >= FAR]
    near = [r for r in foreign if r.distances and r.distances[0] >= FAR > r.distances[-1]]
    named = [r for r in records if r.verdict != "none"]
    return [
        share(
            f"unknown flagged, distance from every triple >= {FAR:g}",
            [r.right for r in far],
            "at least 90 %",
            least=0.9,
        ),
        share(f"unknown flagged, distance >= {FAR:g} from every single, not triple", [r.right for r in near]),
        share("unknown flagged, inventions", [r.right for r in foreign if r.kind == "invented"]),
        share(
            f"wrong single name, of all at distance >= {FAR:g}",
            [r.wrong_name for r in [*far, *near]],
            "at most 5 %",
            max_amplitude=0.05,
        ),
        share(
            "wrong single name, truth in the library",
            [r.wrong_name for r in records if r.known],
            "at most 5 %",
            max_amplitude=0.05,
        ),
        share("wrong single name, of all cases with a gap", [r.wrong_name for r in named]),
    ]


def _amplitudes(records: Sequence[Record]) -> list[Figure]:
    strong = [r for r in records if r.strength >= NAMED]
    named = [pull for r in strong for pull in r.pulls]
    fitted = [pull for r in strong for pull in r.fitted]
    if not fitted:
        return _pulls("where named", named, True)
    # What is named is a choice, which favours fluctuations upwards.
    return [*_pulls("of the effect that is there", fitted, True), *_pulls("where named", named, False)]


def _pulls(which: str, pulls: Sequence[float], analysis: bool) -> list[Figure]:
    title = f"pulls {which}, s >= {NAMED:g}"
    return [
        mean(f"{title}: mean", pulls, "within 0.1" if analysis else "", 0.1 if analysis else None),
        width(f"{title}: width", pulls, "0.9 to 1.1" if analysis else "", (0.9, 1.1) if analysis else None),
    ]


def _shrinks(records: Sequence[Record]) -> list[Figure]:
    right = [r for r in records if r.truth and r.best == r.truth and r.achieved is not None and r.predicted is not None]
    strong = [r for r in right if r.strength >= SHRUNK]
    # Drops, not shares of the gap: those of small gaps are all noise.
    before = np.array([r.gaps[0] if r.gaps else 0.0 for r in strong])
    expected, found = (before * np.array([getattr(r, name) for r in strong]) for name in ("predicted", "achieved"))
    least = removed(f"gap removed, s >= {SHRUNK:g}", [r.gaps for r in strong if r.gaps], "at least 0.8")
    absent = [r.absent for r in records if r.absent is not None]
    # What is not there has an amplitude of noise, which opens a gap by one for every parameter.
    none = removed("gap removed by an effect that is not there", absent, "not above 0")
    return [
        slope(f"achieved against predicted shrink: slope, s >= {SHRUNK:g}", expected, found, "1 +- 0.05", 0.95, 1.05),
        least.judged(least.value >= 0.8),
        none.judged(none.low <= 0.0),
    ]


def _placing(records: Sequence[Record]) -> list[Figure]:
    hits = []
    for r in records:
        if r.kind in ("one", "two") and r.strength >= PLACED and r.places is not None:
            right = places_right([name for name, _ in r.truth], list(r.places[:3]))
            if right is not None:
                hits.append(right)
    if not hits:
        return []
    title = f"right frame, parity and L among the first three places, s >= {PLACED:g}"
    return [share(title, hits, "at least 90 %", least=0.9)]


def confusion(records: Sequence[Record], best: bool = False) -> Confusion:
    """Cases by truth and answer; ``best``: by the answer of the classifier that knows the prior."""
    rows = [(_truth(record), _bayes(record) if best else _answer(record)) for record in records]
    order = {NONE: 0, MIXTURE: 2, "mixture, wrong": 3, "set with the truth": 4, "set without it": 5, UNKNOWN: 6}
    last = {"two": 2, "left out": 3, "invented": 4}
    truths = sorted({row[0] for row in rows}, key=lambda name: (last.get(name, 0 if name == NONE else 1), name))
    answers = sorted({row[1] for row in rows}, key=lambda name: (order.get(name, 1), name))
    counts = np.zeros((len(truths), len(answers)), dtype=np.int64)
    for truth, answer in rows:
        counts[truths.index(truth), answers.index(answer)] += 1
    return Confusion(tuple(truths), tuple(answers), counts)


def _truth(record: Record) -> str:
    if record.kind == "one":
        return next(iter(record.truth))[0]
    return {"none": NONE, "two": "two", "left_out": "left out", "invented": "invented"}[record.kind]


def _answer(record: Record) -> str:
    if record.verdict in (NONE, UNKNOWN):
        return record.verdict
    if record.verdict == "degenerate":
        return "set with the truth" if record.truth in record.answers else "set without it"
    return _one(record.best, record.truth)


def _bayes(record: Record) -> str:
    return _one(record.bayes, record.truth) if record.bayes else NONE


def _one(answer: Answer | None, truth: Answer) -> str:
    assert answer  # a verdict that names something has a set
    if len(answer) == 1:
        ((name, _),) = answer
        other = len(truth) == 1 and answer != truth and {name} == {n for n, _ in truth}
        return f"{name}, other channel" if other else name
    return MIXTURE if answer == truth else "mixture, wrong"


def _rotation(records: Sequence[Record]) -> tuple[tuple[str, int, int, int, float], ...]:
    found: dict[str, list[Record]] = {}
    for record in records:
        if record.kind in ("left_out", "invented"):
            found.setdefault(next(iter(record.truth))[0], []).append(record)
    return tuple(
        (
            name,
            len(rows),
            sum(row.verdict == "unknown" for row in rows),
            sum(row.wrong_name for row in rows),
            float(np.mean([row.distances[-1] for row in rows if row.distances] or [np.nan])),
        )
        for name, rows in sorted(found.items())
    )
