"""Summarise records of cases: metrics with targets, and confusion matrices."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from mcsim.benchmark.case import Answer
from mcsim.benchmark.draws import Power
from mcsim.benchmark.intervals import Metric, mean, ratio, removed, share, snr_at_power, width
from mcsim.benchmark.record import Record
from mcsim.benchmark.signatures import any_place_right

ALPHA = 0.05
"""Level of the global test."""

NAMED, PLACED, FAR, REDUCED = 5.0, 6.0, 8.0, 8.0
"""Expected S/N from which on effects are to be named, and to be placed; that a case must have beyond the library to be
called unknown; and from which on the reduction of the excess chi^2 is measured."""

DISTINCT, DEGENERATE = 0.7, 0.9
"""Cosine with another candidate up to which an effect can be told apart, and beyond which it cannot."""


@dataclass(frozen=True, eq=False)
class Confusion:
    """Number of cases by truth and answer, shape (truths, answers)."""

    truths: tuple[str, ...]
    answers: tuple[str, ...]
    counts: NDArray[np.int64]


@dataclass(frozen=True)
class Unlisted:
    """Cases with one effect that the library did not have; the names are keys of ``score.json``."""

    name: str
    cases: int
    unknown: int
    wrong_single_name: int
    mean_distance: float | None


@dataclass(frozen=True, eq=False)
class Score:
    """Benchmark score of a set of records.

    Attributes
    ----------
    title
        What the records are of.
    metrics
        In the order of what they measure: detection, naming, unknown effects, amplitudes, reduction, places.
    all_cases, library_cases, bayes
        Confusion of the diagnosis in all cases and in those of the library, and of the Bayes classifier in the latter.
    unlisted
        Cases by the effect that the library did not have.
    records, power
        What the score was made of.
    """

    title: str
    metrics: tuple[Metric, ...]
    all_cases: Confusion
    library_cases: Confusion
    bayes: Confusion
    unlisted: tuple[Unlisted, ...]
    records: tuple[Record, ...]
    power: Power | None


def summarise(title: str, records: Sequence[Record], power: Power | None = None) -> Score:
    """Summarise records, of draws with the power of detection."""
    known = [record for record in records if record.bayes is not None]
    return Score(
        title=title,
        metrics=(
            *_detection(records, power),
            *_naming(records),
            *_against_bayes(known),
            *_unknown(records),
            *_amplitudes(records),
            *_reductions(records),
            *_places(records),
        ),
        all_cases=confusion(records),
        library_cases=confusion(known),
        bayes=confusion(known, bayes=True),
        unlisted=_unlisted(records),
        records=tuple(records),
        power=power,
    )


def null_pvalues(records: Sequence[Record], power: Power | None) -> NDArray[np.float64]:
    """Return the p-values of the global test of data without an effect."""
    return np.array([r.p_value for r in records if r.kind == "none"]) if power is None else power.null_gap


def _detection(records: Sequence[Record], power: Power | None) -> list[Metric]:
    quiet = null_pvalues(records, power)
    false = share("false alarms, 5 % nominal", quiet <= ALPHA)
    found = [false.against("5 % within the interval", false.low <= ALPHA <= false.high)]
    if len(quiet) >= 5:
        p = float(stats.kstest(quiet, "uniform").pvalue)
        name = "p-values without an effect: p of Kolmogorov and Smirnov"
        found.append(Metric(name, p, np.nan, np.nan, len(quiet)).within("above 0.01", 0.01))
    if power is not None:
        # The limit rises with the S/N.
        limit = float(np.interp(0.9, power.limit, power.grid, left=np.nan, right=np.nan))
        name = f"S/N at 90 % power over its limit {limit:.2f}"
        best = snr_at_power(f"{name}, matched filters", power.strengths, power.by_maximum, limit)
        found.append(best.within("within 10 % of the limit", high=1.1))
        found.append(snr_at_power(f"{name}, global test", power.strengths, power.by_gap, limit))
    strong = [r.p_value <= ALPHA for r in records if r.kind == "one" and r.strength >= NAMED]
    return [*found, share(f"single effects detected, S/N >= {NAMED:g}", strong)]


def _naming(records: Sequence[Record]) -> list[Metric]:
    ones = [r for r in records if r.kind == "one" and r.strength >= NAMED]
    distinct = [r.right for r in ones if r.rival <= DISTINCT]
    between = [r.right for r in ones if DISTINCT < r.rival <= DEGENERATE]
    degenerate = [r.truth in r.answers for r in ones if r.rival > DEGENERATE]
    single, degenerate_name = f"right effect, S/N >= {NAMED:g}", f"truth in the set, S/N >= {NAMED:g}"
    return [
        share(f"{single}, |rho| <= {DISTINCT:g}", distinct).within("at least 95 %", 0.95),
        share(f"{single}, {DISTINCT:g} < |rho| <= {DEGENERATE:g}", between),
        share(f"{degenerate_name}, |rho| > {DEGENERATE:g}", degenerate).within("at least 95 %", 0.95),
        share("truth in the set, two effects", [r.truth in r.answers for r in records if r.kind == "two"]),
    ]


def _against_bayes(known: Sequence[Record]) -> list[Metric]:
    if not known:
        return []
    right = np.array([r.right for r in known], dtype=float)
    best = np.array([r.bayes == r.truth for r in known], dtype=float)
    stated = np.array([r.bayes_right for r in known])
    return [
        share("right answer, diagnosis, truth in the library", right > 0),
        share("right answer, Bayes, truth in the library", best > 0),
        mean("right answers, Bayes less diagnosis", best - right).within("at most 0.02", high=0.02),
        mean("right answers of Bayes, stated probability less share", stated - best),
    ]


def _unknown(records: Sequence[Record]) -> list[Metric]:
    outside = [r for r in records if not r.in_library]
    far = [r for r in outside if r.distances and r.distances[-1] >= FAR]
    near = [r for r in outside if r.distances and r.distances[0] >= FAR > r.distances[-1]]
    single = "wrong single name"
    return [
        share(f"unknown, S/N >= {FAR:g} beyond every triple", [r.right for r in far]).within("at least 90 %", 0.9),
        share(f"unknown, S/N >= {FAR:g} beyond every single effect, not triple", [r.right for r in near]),
        share("unknown, out-of-library effects", [r.right for r in outside if r.kind == "invented"]),
        share(f"{single}, S/N >= {FAR:g} beyond the library", [r.wrong_name for r in [*far, *near]]).within(
            "at most 5 %", high=0.05
        ),
        share(f"{single}, truth in the library", [r.wrong_name for r in records if r.in_library]).within(
            "at most 5 %", high=0.05
        ),
        share(f"{single}, all cases with a detection", [r.wrong_name for r in records if r.verdict != "none"]),
    ]


def _amplitudes(records: Sequence[Record]) -> list[Metric]:
    strong = [r for r in records if r.strength >= NAMED]
    named, fitted = ([pull for r in strong for pull in getattr(r, key)] for key in ("pulls", "fitted"))

    def pulls(which: str, values: Sequence[float]) -> tuple[Metric, Metric]:
        title = f"pulls {which}, S/N >= {NAMED:g}"
        return mean(f"{title}: mean", values), width(f"{title}: width", values)

    acting, chosen = pulls("of the effect that acts", fitted), pulls("where named", named)
    # Naming selects fluctuations upwards: the targets hold without it where that is known.
    first, rest = (acting, chosen) if fitted else (chosen, ())
    return [first[0].within("within 0.1", -0.1, 0.1), first[1].within("0.9 to 1.1", 0.9, 1.1), *rest]


def _reductions(records: Sequence[Record]) -> list[Metric]:
    right = [r for r in records if r.truth and r.best == r.truth and r.achieved is not None and r.predicted is not None]
    strong = [r for r in right if r.strength >= REDUCED]
    # Changes of chi^2, not fractions: those of a small excess are all noise.
    before = np.array([r.gaps[0] if r.gaps else 0.0 for r in strong])
    expected, found = (before * np.array([getattr(r, key) for r in strong]) for key in ("predicted", "achieved"))
    name = f"S/N >= {REDUCED:g}"
    # The amplitude of an effect that does not act is noise, which adds 1 to chi^2 for every component.
    absent = removed("excess chi^2 removed by an effect that does not act", [r.absent for r in records if r.absent])
    return [
        ratio(f"measured over predicted reduction, {name}", expected, found).within("1 +- 0.05", 0.95, 1.05),
        removed(f"excess chi^2 removed, {name}", [r.gaps for r in strong if r.gaps]).within("at least 0.8", 0.8),
        absent.against("not above 0", absent.low <= 0.0),
    ]


def _places(records: Sequence[Record]) -> list[Metric]:
    strong = [r for r in records if r.kind in ("one", "two") and r.strength >= PLACED and r.places is not None]
    hits = [any_place_right([name for name, _ in r.truth], (r.places or ())[:3]) for r in strong]
    known = [hit for hit in hits if hit is not None]
    name = f"right frame, parity and L among the first three places, S/N >= {PLACED:g}"
    return [share(name, known).within("at least 90 %", 0.9)] if known else []


def confusion(records: Sequence[Record], bayes: bool = False) -> Confusion:
    """Count cases by truth and answer of the diagnosis or of the Bayes classifier."""
    rows = [(_truth(record), _bayes(record) if bayes else _answer(record)) for record in records]
    order = {"none": 0, "mixture": 2, "mixture, wrong": 3, "set with the truth": 4, "set without it": 5, "unknown": 6}
    last = {"none": 0, "two": 2, "left out": 3, "out of library": 4}
    truths = sorted({row[0] for row in rows}, key=lambda name: (last.get(name, 1), name))
    answers = sorted({row[1] for row in rows}, key=lambda name: (order.get(name, 1), name))
    counts = np.zeros((len(truths), len(answers)), dtype=np.int64)
    for truth, answer in rows:
        counts[truths.index(truth), answers.index(answer)] += 1
    return Confusion(tuple(truths), tuple(answers), counts)


def _truth(record: Record) -> str:
    if record.kind == "one":
        return next(iter(record.truth))[0]
    return {"none": "none", "two": "two", "left_out": "left out", "invented": "out of library"}[record.kind]


def _answer(record: Record) -> str:
    if record.verdict in ("none", "unknown"):
        return record.verdict
    if record.verdict == "degenerate":
        return "set with the truth" if record.truth in record.answers else "set without it"
    return _named(record.best, record.truth)


def _bayes(record: Record) -> str:
    return _named(record.bayes, record.truth) if record.bayes else "none"


def _named(answer: Answer | None, truth: Answer) -> str:
    assert answer  # a verdict that names something has a set
    if len(answer) > 1:
        return "mixture" if answer == truth else "mixture, wrong"
    ((name, _),) = answer
    other = len(truth) == 1 and answer != truth and {name} == {own for own, _ in truth}
    return f"{name}, other channel" if other else name


def _unlisted(records: Sequence[Record]) -> tuple[Unlisted, ...]:
    found: dict[str, list[Record]] = {}
    for record in records:
        if not record.in_library:
            found.setdefault(next(iter(record.truth))[0], []).append(record)
    return tuple(
        Unlisted(
            name,
            len(rows),
            sum(row.verdict == "unknown" for row in rows),
            sum(row.wrong_name for row in rows),
            float(np.mean(distances)) if (distances := [row.distances[-1] for row in rows if row.distances]) else None,
        )
        for name, rows in sorted(found.items())
    )
