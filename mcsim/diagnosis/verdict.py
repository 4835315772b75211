"""Give the verdict on data: on all of them, or on what is left without bad pixels."""

from mcsim.diagnosis.bad_pixels import LOOK_SO, TOO_MANY
from mcsim.diagnosis.context import DataSet
from mcsim.diagnosis.inference import inferred
from mcsim.diagnosis.result import DiagnosisResult


def diagnose_data(data: DataSet, case: str) -> DiagnosisResult:
    """Diagnose observed maps or measured spectra; raise InputError if they cannot be what they claim to be."""
    return diagnosed(data, case)[1]


def diagnosed(data: DataSet, case: str) -> tuple[DataSet, DiagnosisResult]:
    """Diagnose as :func:`diagnose_data` does; return also the data of which the result is.

    Pixels that stand out of residual maps, beside what the effects that are named add, are left out; if the rest then
    departs from the model, the result is of the rest.
    """
    whole = inferred(data)
    rest, sentences = data.without_bad_pixels(whole.acting)
    if not sentences or whole.has_glitches:
        return data, whole.result(case)
    if rest is None:
        return data, whole.unexplained().result(case, *sentences, TOO_MANY)
    left = inferred(rest)
    if left.refined.attribution.verdict == "none":
        fits = f"{LOOK_SO}. Without these pixels the model fits (p = {rest.gap.pvalue:.2g})."
        return data, whole.unexplained().result(case, *sentences, fits)
    departs = f"{LOOK_SO}: they are left out of all that follows. With them the maps have p = {data.gap.pvalue:.2g}."
    return rest, left.result(case, *sentences, departs)
