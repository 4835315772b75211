"""One case as the score sees it: what was there, what was said, and what could have been said."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim.benchmark.bayes import Bayes
from mcsim.benchmark.prior import CaseSampler
from mcsim.benchmark.truth import Identity, Kind
from mcsim.diagnosis.candidate import Candidate
from mcsim.diagnosis.subsets import Subsets
from mcsim.stats.gaussian import SimulatedGaussian, WhitenedTemplates, whitened_templates
from mcsim.stats.look_elsewhere import Calibration

Vector = NDArray[np.float64]
Answer = frozenset[Identity]


@dataclass(frozen=True)
class Record:
    """What is known of a case after its key is opened.

    Attributes
    ----------
    kind, truth
        Kind of the case, and what was there.
    strength, columns
        White length of all that was there, and number of amplitudes of an only effect.
    rival
        Largest cosine of the response with a candidate that was not there.
    distances
        White length that the best one, two and three candidates, none of them there, leave of the response.
    p_value, maximum
        Of the gap, and of the most significant candidate alone, trials included.
    verdict, answers
        What was said: the verdict, and the accepted sets, the best first.
    bayes
        The most probable set, of cases whose truth the classifier knows; else None.
    bayes_right
        Its probability of being right, by its own account.
    pulls
        Fitted less true amplitudes over their errors, where the only effect was named.
    fitted
        The same of the fit of the only effect, named or not; empty where it was not fitted for itself.
    predicted, achieved, sigma
        Shrink of the gap; None where none was measured.
    gaps, absent
        Gap before and after, with what was named; and with an effect that is not there.
    places
        (frame, L, parity) of the first three places; None where they were not looked for.
    sampled
        Data made sample by sample.
    """

    case: str
    kind: Kind
    truth: Answer
    strength: float
    columns: int
    rival: float
    distances: tuple[float, ...]
    p_value: float
    maximum: float
    verdict: str
    answers: tuple[Answer, ...]
    bayes: Answer | None = None
    bayes_right: float = np.nan
    pulls: tuple[float, ...] = ()
    fitted: tuple[float, ...] = ()
    predicted: float | None = None
    achieved: float | None = None
    sigma: float | None = None
    gaps: tuple[float, float] | None = None
    absent: tuple[float, float] | None = None
    places: tuple[tuple[str | None, int | None, str | None], ...] | None = None
    sampled: bool = False

    @property
    def best(self) -> Answer | None:
        """The set that is named first."""
        return self.answers[0] if self.answers else None

    @property
    def known(self) -> bool:
        """Whether the library has all that was there."""
        return self.kind in ("none", "one", "two")

    @property
    def right(self) -> bool:
        """Named first, or none where there is none; of what the library does not have, "unknown"."""
        if not self.known:
            return self.verdict == "unknown"
        return self.verdict == "none" if not self.truth else self.best == self.truth

    @property
    def wrong_name(self) -> bool:
        """One effect named, without an alternative, that was not there."""
        return self.verdict == "effect" and self.best is not None and not self.best <= self.truth

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        row = asdict(self)
        row["truth"] = _sorted(self.truth)
        row["answers"] = [_sorted(answer) for answer in self.answers]
        row["bayes"] = None if self.bayes is None else _sorted(self.bayes)
        return {
            key: None if isinstance(value, float) and not np.isfinite(value) else value for key, value in row.items()
        }


def _sorted(answer: Answer) -> list[list[str | None]]:
    return [list(identity) for identity in sorted(answer, key=lambda i: (i[0], i[1] or ""))]


@dataclass(frozen=True, eq=False)
class Geometry:
    """Responses of a library in white coordinates."""

    null: SimulatedGaussian
    candidates: Sequence[Candidate]
    groups: WhitenedTemplates
    calibration: Calibration

    @classmethod
    def of(
        cls, null: SimulatedGaussian, t: NDArray[np.float64], candidates: Sequence[Candidate], calibration: Calibration
    ) -> "Geometry":
        """From templates."""
        return cls(
            null, candidates, whitened_templates(null, t, [candidate.columns for candidate in candidates]), calibration
        )

    def bayes(self, sampler: CaseSampler) -> Bayes:
        """The classifier that knows what the urn draws."""
        identities = [candidate.identity for candidate in self.candidates]
        return Bayes(self.null, self.groups, identities, sampler.weights(), sampler.prior)

    def rival(self, response: Vector, truth: Iterable[Identity]) -> float:
        """Largest cosine of a response with the candidates that are not of the truth."""
        white = self.null.whiten_templates(response[:, None])[:, 0]
        size = float(np.linalg.norm(white))
        there = set(truth)
        others = [index for index, candidate in enumerate(self.candidates) if candidate.identity not in there]
        if size == 0.0 or not others:
            return 0.0
        return float(np.sqrt(np.max(self.groups.delta_chi2(white)[others])) / size)

    def distances(self, response: Vector, max_amplitude: int = 3) -> tuple[float, ...]:
        """White length that is left of a response by the best 1, 2, ... candidates of this library."""
        white = self.null.whiten_templates(response[:, None])[:, 0]
        names = [candidate.identity for candidate in self.candidates]
        ones = np.ones(len(names))
        search = Subsets(self.null, white, self.groups, names, ones, np.zeros(len(names)), self.calibration)
        found, best = [], search.total
        for size in range(1, max_amplitude + 1):
            left = [search.solve(rows).chi2.min() for rows in search.rows(size, ()) if len(rows)]
            best = min([best, *left])
            found.append(float(np.sqrt(self.null.unbiased * max(best, 0.0))))
        return tuple(found)


def most_probable(probabilities: dict[Answer, float]) -> tuple[Answer, float]:
    """The most probable set, and its probability."""
    answer = max(probabilities, key=lambda one: probabilities[one])
    return answer, probabilities[answer]
