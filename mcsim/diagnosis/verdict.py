"""Give the verdict on data: on all of them, or on what is left without bad pixels."""

from dataclasses import replace

from mcsim.datavector.bad_pixels import BadPixels
from mcsim.diagnosis.context import DataSet
from mcsim.diagnosis.inference import Inferred, inferred
from mcsim.diagnosis.refine import Refiner
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.support.numbers import p_equals
from mcsim.systematics import acts_through

FEWER = 0.5  #: share of how far pixels stand out that is left beside an effect which may make them, at most

LOOK_SO = "Glitches, sources and the Galaxy look so, and no effect on beam or gain does"


def diagnose_data(data: DataSet, case: str) -> DiagnosisResult:
    """Diagnose observed maps or measured spectra; raise InputError if they cannot be what they claim to be."""
    return diagnosed(data, case)[1]


def diagnosed(data: DataSet, case: str) -> tuple[DataSet | None, DiagnosisResult]:
    """Diagnose as :func:`diagnose_data` does; return also the data of which it is, None if bad pixels are all.

    Pixels that stand out of residual maps are left out, unless an effect makes them, and so are those that do beside
    the effects which fit the rest. If the rest departs from the model, the result is of the rest.
    """
    bad = data.bad_pixels([])
    if bad and (found := _made(data, bad)) is not None:
        return data, found.result(case)
    bad, rest, left = _without(data, bad)
    if bad is None:
        return data, left.result(case)
    if rest is data:
        most = 100.0 * data.context.settings.missing_share
        remedy = f"{LOOK_SO}. With what is UNSEEN these pixels are more than {most:g} % of a map, and nothing is named "
        remedy += "before they are left out; give the model a mask (map.mask)."
        return None, left.result(case, *bad.sentences, remedy)
    if left.refined.attribution.verdict == "none":
        fits = f"{LOOK_SO}. Without these pixels the model fits ({p_equals(rest.gap.pvalue)})."
        return None, _unexplained(data).result(case, *bad.sentences, fits)
    departs = f"{LOOK_SO}: {bad.left_out} of all that follows. Whole maps have {p_equals(data.gap.pvalue)}."
    return rest, left.result(case, *bad.sentences, departs)


def _without(data: DataSet, bad: BadPixels | None) -> tuple[BadPixels | None, DataSet, Inferred]:
    """Return bad pixels with all that stand out beside the effects of the rest, the rest, and what it says.

    If more are bad than may be left out the rest is all data, and nothing is said of it. Beside a model that fits the
    rest nothing hides more of them.
    """
    if (rest := data.without(bad) if bad else data) is None:
        return bad, data, _unexplained(data)
    left = inferred(rest)
    if left.refined.attribution.verdict == "none":
        return bad, rest, left
    more = data.bad_pixels(left.acting)
    larger = more is not None and (bad is None or more.number > bad.number)
    return _without(data, more) if larger else (bad, rest, left)


def _made(data: DataSet, bad: BadPixels) -> Inferred | None:
    """Return what data say as they are if effects that are named, or detected, make their bad pixels, else None."""
    if _left_beside(_unrefined(data), bad) > FEWER:
        return None
    found = inferred(data)
    named = found.refined.attribution.explanations or found.refined.partial is not None
    return found if named and not _left_beside(found, bad) else None


def _left_beside(found: Inferred, bad: BadPixels) -> float:
    """Return how far pixels stand out beside the effects that fit best, over how far they do by themselves.

    Noise in excess of the model's may be a few strong glitches, and leaves none.
    """
    candidates, (members, _) = found.data.context.candidates, found.best
    if any(acts_through(candidates[member].effect, "excess") for member in members):
        return 0.0
    left = found.data.bad_pixels(found.acting)
    return left.size / bad.size if left else 0.0


def _unrefined(data: DataSet) -> Inferred:
    """Return what data say as they are, by the templates of the model."""
    return Inferred(data, Refiner(data).unrefined())


def _unexplained(data: DataSet) -> Inferred:
    """Return that nothing is named for a gap, if there is one."""
    found = _unrefined(data).refined
    if found.attribution.verdict != "none":
        found = replace(found, attribution=found.attribution.unexplained())
    return Inferred(data, found)
