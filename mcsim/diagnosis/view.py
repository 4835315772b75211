"""A diagnosis made ready to be shown: its numbers put side by side, its entries in words."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from mcsim.diagnosis.validation import excess_of
from mcsim.stats.detection import snr_needed, snr_to_separate
from mcsim.stats.gaussian import nested_pvalue

Vector = NDArray[np.float64]

APART = 3.29
"""Distance in standard deviations at which the nearer of two predictions is the right one in 95 cases of 100."""

LEAST_SHRINK = 0.3
"""Error of the shrink from which on it says nothing of use."""

_KINDS = {
    "beam": "beam",
    "dipole": "dipole of the residual",
    "noise": "noise variance",
    "square": "residual times sky²",
    "common": "power that splits share",
    "difference": "power of split difference",
    "contrast": "contrast of frequencies",
    "sky": "spectrum of the sky",
    "isotropy": "modulation of the sky",
}


@dataclass(frozen=True)
class Ranked:
    """A candidate fitted alone.

    Attributes
    ----------
    index, label, unit
        Of the candidate.
    amplitude, sigma
        NaN where no effect has such an amplitude.
    impact
        Square root of the fall of chi^2.
    p
        Of such a fall, corrected for looking at all candidates (Bonferroni).
    accepted, alternative
        Whether the best explanation has it, or another one.
    """

    index: int
    label: str
    unit: str
    amplitude: float
    sigma: float
    impact: float
    p: float
    accepted: bool
    alternative: bool


@dataclass(frozen=True)
class ExcessSummary:
    """Excess of chi^2 before and after (None: nothing was added), each with a standard deviation.

    ``words`` says on which data; ``expected`` is what was predicted to remain.
    """

    before: float
    before_sigma: float
    after: float | None
    after_sigma: float
    expected: float | None
    words: str


@dataclass(frozen=True)
class ReportView:
    """What a verdict and its evidence say.

    Attributes
    ----------
    verdict
        Of schema 1.
    evidence
        As stored beside it.
    """

    verdict: Mapping[str, Any]
    evidence: xr.Dataset

    @cached_property
    def elements(self) -> list[dict[str, Any]]:
        """Where each number was heard, with its kind and column of the block picture."""
        found = []
        for row in json.loads(self.evidence.attrs["entries"]):
            split = f":{row['split']}" if row["split"] else ""
            several = len(row["channels"]) != 1
            found.append({**row, "kind": _kind(row), "column": "several" if several else row["channels"][0] + split})
        return found

    @cached_property
    def explanations(self) -> list[dict[str, Any]]:
        """Accepted sets of candidates: members, amplitudes, odds, probability."""
        return list(json.loads(self.evidence.attrs["explanations"]))

    @cached_property
    def labels(self) -> list[str]:
        """Candidates."""
        return [str(label) for label in self.evidence["candidate"].values]

    def columns(self, members: Sequence[int]) -> list[int]:
        """Columns of the templates that belong to candidates, one candidate after the other."""
        owners = [str(name).rpartition("/")[0] for name in self.evidence["column"].values]
        return [k for member in members for k, owner in enumerate(owners) if owner == self.labels[member]]

    def prediction(self, explanation: int) -> Vector:
        """What a set of candidates changes in every entry, over the scatter."""
        one = self.explanations[explanation]
        t = self.evidence["templates"].values[:, self.columns(one["members"])]
        change: Vector = t @ np.asarray(one["amplitudes"]) / self.evidence["standard_deviation"].values
        return change

    @property
    def z(self) -> Vector:
        """Deviates before."""
        return np.asarray(self.evidence["z"].values, dtype=np.float64)

    @property
    def left(self) -> Vector | None:
        """Deviates after the best explanation was fitted; None where there is none."""
        return self.z - self.prediction(0) if self.explanations else None

    @cached_property
    def ranked(self) -> list[Ranked]:
        """Candidates fitted alone, the one that matters most first."""
        evidence, gap = self.evidence, self.verdict["gap"]
        filtered = np.any(evidence["templates"].values != 0.0, axis=0)
        rank = np.array([int(filtered[self.columns([k])].sum()) for k in range(len(self.labels))])
        delta_chi2 = evidence["drop"].values
        p = nested_pvalue(delta_chi2, gap["statistic"], rank, gap["dof"], int(evidence.attrs["simulations"]) - 1)
        sets = [one["members"] for one in self.explanations]
        return [
            Ranked(
                index=int(k),
                label=self.labels[k],
                unit=str(evidence["unit"].values[k]),
                amplitude=float(evidence["alone"].values[k]),
                sigma=float(evidence["alone_sigma"].values[k]),
                impact=float(np.sqrt(max(delta_chi2[k], 0.0))),
                p=min(1.0, float(p[k]) * int((rank > 0).sum())),
                accepted=any(k in one for one in sets[:1]),
                alternative=any(k in one for one in sets[1:]),
            )
            for k in np.argsort(-delta_chi2, kind="stable")
        ]

    @cached_property
    def excess(self) -> ExcessSummary:
        """Before and after, on fresh data where the shrink was measured, else of the whole evidence."""
        shrink = self.verdict["shrink"]
        if shrink is not None:
            before, after = shrink["gap_before"], shrink["gap_after"]
            expected = before * (1.0 - shrink["predicted"])
            errors = shrink["sigma_before"], shrink["sigma_after"]
            return ExcessSummary(before, errors[0], after, errors[1], expected, f"judged on {shrink['data']}")
        n, p = int(self.evidence.attrs["simulations"]) - 1, self.verdict["gap"]["dof"]
        found = excess_of(self.verdict["gap"]["statistic"], p, n)
        if not self.explanations:
            return ExcessSummary(found.value, found.sigma, None, 0.0, None, "all of the evidence")
        one = self.explanations[0]
        left = excess_of(one["chi2"], one["dimension"], n)
        return ExcessSummary(
            found.value, found.sigma, left.value, left.sigma, None, "fitted and judged on the same data"
        )

    @property
    def shrink_is_measured(self) -> bool:
        """Whether the data of the shrink have a gap to judge it by."""
        shrink = self.verdict["shrink"]
        return shrink is not None and shrink["gap_before"] > 0.0 and shrink["sigma"] < LEAST_SHRINK

    @cached_property
    def isolating(self) -> NDArray[np.float64]:
        """Strength at which each candidate is told from each other one in 95 cases of 100, shape (C, C)."""
        needed = snr_to_separate(self.evidence["correlation"].values)
        np.fill_diagonal(needed, np.nan)
        return needed

    @cached_property
    def nearest_candidates(self) -> list[dict[str, Any]]:
        """Of every candidate the one most like it, and the amplitude from which they are told apart."""
        evidence = self.evidence
        labels = {_label(row): row for row in self.verdict["detectable"]}
        p, N = self.verdict["gap"]["dof"], int(evidence.attrs["simulations"])
        filtered = {label: min(len(self.columns([k])), p) for k, label in enumerate(self.labels)}
        strengths = {k: snr_needed(k, len(self.labels), p, N) for k in set(filtered.values())}
        found = []
        for k, label in enumerate(self.labels):
            if label not in labels:
                continue
            row = labels[label]
            cosine = np.abs(evidence["correlation"].values[k])
            # Candidates that differ in settings only are variants of one effect, no twins.
            own = label.partition(",")[0].rstrip(")")
            cosine[[other.partition(",")[0].rstrip(")") == own for other in self.labels]] = -1.0
            twin = int(np.argmax(cosine))
            lone = cosine[twin] < 0.0
            isolate = 0.0 if lone else self.isolating[k, twin]
            scale = float(row["amplitude_90"]) / strengths[filtered[label]]
            found.append(
                {
                    "label": label,
                    "unit": row["unit"],
                    "detectable": float(row["amplitude_90"]),
                    "twin": "" if lone else self.labels[twin],
                    "cosine": float(max(cosine[twin], 0.0)),
                    "strength": float(isolate),
                    "isolated": float(isolate * scale),
                }
            )
        return found

    @cached_property
    def contrasts(self) -> list[dict[str, Any]]:
        """Pairs of explanations: how far apart, how much more is needed, and which entries tell."""
        found = []
        for one in json.loads(self.evidence.attrs["contrasts"]):
            first, second = one["first"], one["second"]
            a, b = self.prediction(first), self.prediction(second)
            separation = one["separation"]
            found.append(
                {
                    "first": self.set_label(first),
                    "second": self.set_label(second),
                    "separation": separation,
                    "odds": self.explanations[second]["odds"] / self.explanations[first]["odds"],
                    "factor": (APART / separation) ** 2 if separation > 0 else np.inf,
                    "entries": [
                        {
                            "words": entry_words(self.elements[k]),
                            "share": share,
                            "first": float(a[k]),
                            "second": float(b[k]),
                            "data": float(self.z[k]),
                        }
                        for k, share in zip(one["entries"], one["shares"], strict=True)
                        if share > 0.0
                    ],
                }
            )
        return found

    def set_label(self, explanation: int) -> str:
        """Members of an explanation in words."""
        return " and ".join(self.labels[member] for member in self.explanations[explanation]["members"])

    @cached_property
    def blocks(self) -> tuple[list[str], list[str], list[NDArray[np.float64]]]:
        """Kinds, columns, and the largest deviate of every block before and (where explained) after; NaN where none."""
        kinds = list(dict.fromkeys(element["kind"] for element in self.elements))
        columns = sorted({element["column"] for element in self.elements}, key=lambda name: (name == "several", name))
        tables = []
        for z in (self.z, self.left):
            if z is None:
                continue
            table = np.full((len(kinds), len(columns)), np.nan)
            for element, value in zip(self.elements, z, strict=True):
                at = kinds.index(element["kind"]), columns.index(element["column"])
                if not abs(table[at]) >= abs(value):
                    table[at] = value
            tables.append(table)
        return kinds, columns, tables


def _kind(row: Mapping[str, Any]) -> str:
    prefix, _, rest = row["name"].partition("/")
    if prefix == "score":
        return f"matched: {rest.partition(' (')[0]}"
    return _KINDS.get(prefix, prefix) + (f", order {row['L']}" if prefix == "beam" else "")


def entry_words(row: Mapping[str, Any]) -> str:
    """Where a number was heard, for people."""
    prefix, _, rest = row["name"].partition("/")
    if prefix == "score":
        label, _, number = rest.rpartition("/")
        return f"matched to {label}, component {int(number) + 1}" if number.isdigit() else f"matched to {rest}"
    words = [_kind(row), ", ".join(row["channels"])]
    if prefix == "beam":
        words[0] += ", imaginary" if "im/" in row["name"] else ", real" if row["L"] else ""
    if row["split"]:
        words.append(row["split"])
    if row["ell"]:
        low, high = row["ell"]
        words.append(f"ℓ {low}–{high}" if high > low else f"ℓ {low}")
    elif "/" in rest:
        words.append(rest.partition("/")[2].replace("/", ", "))
    return ", ".join(words)


def _label(row: Mapping[str, Any]) -> str:
    """Label of a candidate from its row among what is detectable."""
    settings = ", ".join(f"{key} = {value}" for key, value in row.get("settings", {}).items())
    return f"{row['name']} ({row['channel'] or 'all'}{', ' + settings if settings else ''})"
