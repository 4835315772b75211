"""Put together what is known of a case once its key is open: the truth, the answer, and the best possible answer."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mcsim.benchmark.bayes import BayesClassifier
from mcsim.benchmark.case import IN_LIBRARY, Answer, Drawn, Kind
from mcsim.benchmark.library import Library

Vector = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Record:
    """One case after its key is opened; the names are keys of ``score.json``.

    Attributes
    ----------
    case, kind, truth
        Name and kind of the case, and the effects that act.
    strength, columns
        Expected S/N of all effects together, and number of linear components of a single one.
    rival
        Largest cosine of the response with a candidate that does not act.
    distances
        S/N that the best one, two and three candidates, none of them acting, leave of the response.
    p_value, maximum
        p-value of the global test, and of the most significant candidate alone, look-elsewhere effect included.
    verdict, answers
        Verdict, and the accepted sets of effects, the best first.
    bayes, bayes_right
        Most probable set of the Bayes-optimal classifier, and the probability that this gives it; None and NaN where
        the truth is none of its hypotheses.
    pulls
        Fitted less true components over their errors, where the only effect was named.
    fitted
        The same of a fit of the only effect, named or not.
    predicted, achieved, sigma
        Fractional reduction of the excess chi^2 on held-out data, and the error of the measured one; None: not
        measured.
    gaps, absent
        Excess chi^2 of held-out data before and after the named effects are added; after one that does not act.
    places
        (frame, L, parity) of the three most significant places; None: not looked for.
    sampled
        True if the maps were made sample by sample.
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
        """Set of effects that is named first."""
        return self.answers[0] if self.answers else None

    @property
    def in_library(self) -> bool:
        """True if the library has all effects that act."""
        return self.kind in IN_LIBRARY

    @property
    def right(self) -> bool:
        """True if the truth is named first, or called unknown where the library does not have it."""
        if not self.in_library:
            return self.verdict == "unknown"
        return self.verdict == "none" if not self.truth else self.best == self.truth

    @property
    def wrong_name(self) -> bool:
        """True if one effect is named, without an alternative, that does not act."""
        return self.verdict == "effect" and self.best is not None and not self.best <= self.truth


def pulls(fitted: ArrayLike, true: ArrayLike, errors: ArrayLike) -> tuple[float, ...]:
    """Return fitted less true components over their errors, without components that the data do not constrain."""
    difference, sigma = np.asarray(fitted) - np.asarray(true), np.asarray(errors)
    return tuple(float(value) for value in difference[sigma > 0.0] / sigma[sigma > 0.0])


def facts(drawn: Drawn, response: Vector, library: Library) -> dict[str, Any]:
    """Return what a record says of the truth, from the response of the data vector of the case's library."""
    return {
        "kind": drawn.kind,
        "truth": drawn.identities,
        "columns": len(drawn.members[0].coordinates) if len(drawn.members) == 1 else 0,
        "rival": library.rival(response, drawn.identities) if drawn.members else 0.0,
        "distances": () if drawn.in_library else library.distances(response),
    }


def best_possible(drawn: Drawn, x: Vector, bayes: BayesClassifier) -> dict[str, Any]:
    """Return what a record says of the best possible answer to a data vector."""
    return dict(zip(("bayes", "bayes_right"), bayes.best(x), strict=True)) if drawn.in_library else {}
