"""Summarise records of cases: metrics with targets, confusion matrices, and places of the effects' signatures."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from mcsim.benchmark.case import KINDS, Answer, Record
from mcsim.stats.intervals import Metric, mean, ratio, removed, share, snr_at_power, width
from mcsim.support.arrays import Vector
from mcsim.systematics.signatures import any_place_right

ALPHA = 0.05  #: level of the global test

NAMED, PLACED, FAR, REDUCED = 5.0, 6.0, 8.0, 8.0
"""Expected S/N from which on effects are to be named, and to be placed; that a case must have beyond the library to be
called unknown; and from which on the reduction of the excess chi^2 is measured."""

DISTINCT, DEGENERATE = 0.7, 0.9
"""Cosine with another candidate up to which an effect can be told apart, and beyond which it cannot."""

TRUTHS = ("none", "", "two", "left out", "out of library")
ANSWERS = ("none", "", "mixture", "mixture, wrong", "set with the truth", "set without it", "unknown")
"""Rows (by kind of case) and columns of a confusion matrix; names of single effects stand in place of the empty one."""


@dataclass(frozen=True, eq=False)
class Confusion:
    """Number of cases by truth and answer, shape (truths, answers)."""

    truths: list[str]
    answers: list[str]
    counts: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Power:
    """Detection of single effects against their expected S/N.

    Of every draw: ``strengths`` (expected S/N), and whether the largest matched filter (``by_maximum``) and the global
    test (``by_gap``) detect it at 5 %. On the ``grid`` of S/N: the mean power after Bonferroni over the library with
    infinitely many simulations (``limit``) and with those that there are (``finite``). Of data vectors without an
    effect: the p-values of the global test (``null_gap``).
    """

    strengths: Vector
    by_maximum: NDArray[np.bool_]
    by_gap: NDArray[np.bool_]
    grid: Vector
    limit: Vector
    finite: Vector
    null_gap: Vector


@dataclass(frozen=True, eq=False)
class Score:
    """Benchmark score of records; the title says what they are of, the power belongs to draws."""

    title: str
    records: Sequence[Record]
    power: Power | None = None

    @cached_property
    def metrics(self) -> tuple[Metric, ...]:
        """Metrics in the order of what they measure; their fields are keys of ``score.json``."""
        topics = (_naming, _against_bayes, _unknown, _amplitudes, _reductions, _places)
        return (*_detection(self), *(metric for topic in topics for metric in topic(self.records)))

    @property
    def in_library(self) -> list[Record]:
        """Return the records that the Bayes classifier has answered: the library has the truth."""
        return [record for record in self.records if record.bayes is not None]

    @property
    def null_pvalues(self) -> Vector:
        """Return the p-values of the global test of data without an effect."""
        quiet = [record.p_value for record in self.records if record.kind == "none"]
        return np.array(quiet) if self.power is None else self.power.null_gap

    @property
    def unlisted(self) -> list[dict[str, Any]]:
        """Return counts of cases by the one effect that the library did not have; keys are those of ``score.json``."""
        found: dict[str, list[Record]] = {}
        for record in self.records:
            if not record.in_library:
                ((name, _),) = record.truth
                found.setdefault(name, []).append(record)
        return [_counts(name, rows) for name, rows in sorted(found.items())]


def _counts(name: str, rows: Sequence[Record]) -> dict[str, Any]:
    distances = [row.distances[-1] for row in rows if row.distances]
    return {
        "name": name,
        "cases": len(rows),
        "unknown": sum(row.verdict == "unknown" for row in rows),
        "wrong_single_name": sum(row.wrong_name for row in rows),
        "mean_distance": float(np.mean(distances)) if distances else None,
    }


def _detection(score: Score) -> list[Metric]:
    quiet, power = score.null_pvalues, score.power
    false = share("false alarms, 5 % nominal", quiet <= ALPHA)
    found = [false.against("5 % within the interval", false.low <= ALPHA <= false.high)]
    if len(quiet) >= 5:
        p = float(stats.kstest(quiet, "uniform").pvalue)
        name = "p-values without an effect: p of Kolmogorov and Smirnov"
        found.append(Metric(name, len(quiet), p).within("above 0.01", 0.01))
    if power is not None:
        # The limit rises with the S/N.
        limit = float(np.interp(0.9, power.limit, power.grid, left=np.nan, right=np.nan))
        name = f"S/N at 90 % power over its limit {limit:.2f}"
        best = snr_at_power(f"{name}, matched filters", power.strengths, power.by_maximum, limit)
        found.append(best.within("within 10 % of the limit", high=1.1))
        found.append(snr_at_power(f"{name}, global test", power.strengths, power.by_gap, limit))
    strong = [r.p_value <= ALPHA for r in score.records if r.kind == "one" and r.strength >= NAMED]
    return [*found, share(f"single effects detected, S/N >= {NAMED:g}", strong)]


def _naming(records: Sequence[Record]) -> list[Metric]:
    ones = [r for r in records if r.kind == "one" and r.strength >= NAMED]
    distinct = [r for r in ones if r.rival <= DISTINCT]
    between = [r.right for r in ones if DISTINCT < r.rival <= DEGENERATE]
    degenerate = [r.truth in r.answers for r in ones if r.rival > DEGENERATE]
    pairs = [r for r in records if r.kind == "two"]
    clear = [r for r in pairs if r.weakest >= NAMED and r.rival <= DISTINCT]
    single, several = f"right effect, S/N >= {NAMED:g}", f"truth in the set, S/N >= {NAMED:g}"
    return [
        share(f"{single}, |rho| <= {DISTINCT:g}", [r.right for r in distinct]).within("at least 95 %", 0.95),
        share(f"{single}, |rho| <= {DISTINCT:g}, Bayes", [r.bayes == r.truth for r in distinct]),
        share(f"{single}, {DISTINCT:g} < |rho| <= {DEGENERATE:g}", between),
        share(f"{several}, |rho| > {DEGENERATE:g}", degenerate).within("at least 95 %", 0.95),
        share("truth in the set, two effects", [r.truth in r.answers for r in pairs]),
        share(f"both of two effects, S/N >= {NAMED:g} each, |rho| <= {DISTINCT:g}", [r.right for r in clear]).within(
            "at least 80 %", 0.8
        ),
        mean("sets of effects in a degenerate answer", [len(r.answers) for r in records if r.verdict == "degenerate"]),
    ]


def _against_bayes(records: Sequence[Record]) -> list[Metric]:
    known = [r for r in records if r.bayes is not None]
    right = np.array([r.right for r in known], dtype=float)
    best = np.array([r.bayes == r.truth for r in known], dtype=float)
    stated = np.array([r.bayes_right for r in known])
    metrics = [
        share("right answer, diagnosis, truth in the library", right > 0),
        share("right answer, Bayes, truth in the library", best > 0),
        mean("right answers, Bayes less diagnosis", best - right).within("at most 0.02", high=0.02),
        mean("right answers of Bayes, stated probability less share", stated - best),
    ]
    return metrics if known else []


def _unknown(records: Sequence[Record]) -> list[Metric]:
    outside = [r for r in records if not r.in_library]
    far = [r for r in outside if r.distances and r.distances[-1] >= FAR]
    near = [r for r in outside if r.distances and r.distances[0] >= FAR > r.distances[-1]]
    detected = [r.wrong_name for r in records if r.verdict != "none"]

    def wrong(where: str, values: Sequence[bool]) -> Metric:
        return share(f"wrong single name, {where}", values).within("at most 5 %", high=0.05)

    return [
        share(f"unknown, S/N >= {FAR:g} beyond every triple", [r.right for r in far]).within("at least 90 %", 0.9),
        share(f"unknown, S/N >= {FAR:g} beyond every single effect, not triple", [r.right for r in near]),
        share("unknown, out-of-library effects", [r.right for r in outside if r.kind == "invented"]),
        wrong(f"S/N >= {FAR:g} beyond the library", [r.wrong_name for r in [*far, *near]]),
        wrong("truth in the library", [r.wrong_name for r in records if r.in_library]),
        share("wrong single name, all cases with a detection", detected),
    ]


def _amplitudes(records: Sequence[Record]) -> list[Metric]:
    strong = [r for r in records if r.strength >= NAMED]
    found = []
    # Naming selects fluctuations upwards: the targets hold without it where that is known.
    for which, key in (("of the effect that acts", "fitted"), ("where named", "pulls")):
        values = [pull for r in strong for pull in getattr(r, key)]
        title = f"pulls {which}, S/N >= {NAMED:g}"
        if values or key == "pulls":
            found += [mean(f"{title}: mean", values), width(f"{title}: width", values)]
    return [found[0].within("within 0.1", -0.1, 0.1), found[1].within("0.9 to 1.1", 0.9, 1.1), *found[2:]]


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
    rows = [(_truth(r), _named(r.bayes, r.truth) if bayes else _answer(r)) for r in records]
    truths, answers = _sorted({row[0] for row in rows}, TRUTHS), _sorted({row[1] for row in rows}, ANSWERS)
    counts = [rows.count((truth, answer)) for truth in truths for answer in answers]
    return Confusion(truths, answers, np.array(counts, dtype=np.int64).reshape(len(truths), len(answers)))


def _sorted(names: Collection[str], order: Sequence[str]) -> list[str]:
    return sorted(names, key=lambda name: (order.index(name if name in order else ""), name))


def _truth(record: Record) -> str:
    return TRUTHS[KINDS.index(record.kind)] or next(iter(record.truth))[0]


def _answer(record: Record) -> str:
    if record.verdict == "degenerate":
        return "set with the truth" if record.truth in record.answers else "set without it"
    return "unknown" if record.verdict == "unknown" else _named(record.best, record.truth)


def _named(answer: Answer | None, truth: Answer) -> str:
    """Return the column of a set of effects."""
    if not answer:
        return "none"
    if len(answer) > 1:
        return "mixture" if answer == truth else "mixture, wrong"
    ((name, _),) = answer
    other = len(truth) == 1 and answer != truth and {name} == {own for own, _ in truth}
    return f"{name}, other channel" if other else name
