"""What controls say of a model: perfect data that are diagnosed as the data are."""

from dataclasses import dataclass
from typing import Any

from scipy import stats

from mcsim.diagnosis.selection import Verdict
from mcsim.stats.intervals import binomial_interval
from mcsim.support.numbers import p_equals

LEVEL = 0.01
"""p-value of either test of the controls, of their smallest p-value and of their uniformity, below which they fail."""


@dataclass(frozen=True)
class Control:
    """The diagnosis of one control: global p-value, verdict, and the effects of its most probable set."""

    pvalue: float
    verdict: Verdict
    effects: tuple[str, ...]


@dataclass(frozen=True)
class Controls:
    """Diagnoses of perfect data, drawn at higher fidelity than the model simulates.

    Notes
    -----
    Controls of a right model have p-values that are uniform over data and simulations. They fail if the smallest of N,
    times N (Bonferroni), or the p-value of the Kolmogorov-Smirnov test against uniformity is below ``LEVEL``: those of
    at most 2 % of right models. All p-values share the error of the model's simulations, so that the test is that of
    two samples, controls and simulations. That is cautious: ranks among simulations would share more than these do.
    Rates: tests/statistical/test_control_rates.py.
    """

    members: tuple[Control, ...]  #: one for each control
    drawn: str  #: how they were drawn, in words
    alpha: float  #: global p-value up to which a control counts as a false alarm
    simulations: int  #: of the model, that give the p-values

    @property
    def pvalues(self) -> tuple[float, ...]:
        """Return the p-values, the smallest first."""
        return tuple(sorted(one.pvalue for one in self.members))

    @property
    def false_alarms(self) -> int:
        """Return how many controls are called different from the model."""
        return sum(p <= self.alpha for p in self.pvalues)

    @property
    def interval(self) -> tuple[float, float]:
        """Return the 95 % interval of the share of false alarms."""
        return binomial_interval(self.false_alarms, len(self.members))

    @property
    def uniformity(self) -> float:
        """Return the p-value of the Kolmogorov-Smirnov test of uniform p-values."""
        count = len(self.members)
        size = max(1, round(count * self.simulations / (count + self.simulations)))
        return float(stats.kstwo.sf(stats.kstest(self.pvalues, "uniform").statistic, size))

    @property
    def smallest(self) -> float:
        """Return the smallest p-value times the number of controls, at most 1."""
        return min(1.0, len(self.members) * self.pvalues[0])

    @property
    def failed(self) -> bool:
        """Return True if the model does not describe its own controls."""
        return min(self.smallest, self.uniformity) < LEVEL

    @property
    def counted(self) -> str:
        """Return how many controls are called different, and the tests of their p-values, in words."""
        low, high = (100.0 * end for end in self.interval)
        return (
            f"{self.false_alarms} of {len(self.members)} controls are called different at {100.0 * self.alpha:g} % "
            f"(95 % interval of the share: {low:.0f} to {high:.0f} %); smallest {p_equals(self.pvalues[0])}, "
            f"{p_equals(self.smallest)} for all; uniform with {p_equals(self.uniformity)} (Kolmogorov-Smirnov)"
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return the sentence that stands before all others if the controls fail."""
        if not self.failed:
            return ()
        return (
            f"The model fails its controls, so the verdict says nothing of the data: perfect data of the model, drawn "
            f"with {self.drawn}, differ from its simulations. {self.counted}.",
        )

    def to_json(self) -> dict[str, Any]:
        """Return what ``verdict.json`` says of the controls."""
        return {
            "drawn": self.drawn,
            "members": [
                {"p_value": one.pvalue, "verdict": one.verdict, "effects": list(one.effects)} for one in self.members
            ],
            "ks_p_value": self.uniformity,
            "smallest_p_value": self.smallest,
            "false_alarms": self.false_alarms,
            "false_alarm_share_95": list(self.interval),
            "failed": self.failed,
        }
