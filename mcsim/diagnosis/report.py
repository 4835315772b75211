"""One self-contained page about a diagnosis: the verdict, then all that it rests on."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from mcsim.diagnosis import figures, words
from mcsim.diagnosis.result import PLACES, DiagnosisResult
from mcsim.reconstruction.figure import structure_figure
from mcsim.support import page as page_
from mcsim.support.numbers import measured, number, p_equals, probability

DOTS_PER_INCH = 120


def page(result: DiagnosisResult) -> str:
    """Return the page as text; whatever comes from configurations or data is escaped."""
    return page_.render(
        Path(__file__).with_name("report.html.j2"),
        {one.__name__: one for one in (measured, number, parameters, probability, p_equals)},
        result=result,
        words=words,
        settings=asdict(result.settings),
        places=PLACES,
        pictures=_pictures(result),
        configuration=json.dumps(json.loads(result.configuration), indent=2, ensure_ascii=False),
    )


def parameters(given: Mapping[str, Any]) -> str:
    """Return the parameters of an effect that are set, in one line."""
    return ", ".join(f"{key} = {_value(value)}" for key, value in given.items() if value not in (None, ""))


def _value(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"({', '.join(_value(item) for item in value)})"
    return number(value) if isinstance(value, float) else str(value)


def _pictures(result: DiagnosisResult) -> dict[str, dict[str, Any]]:
    z, element = max(zip(abs(result.z), result.elements, strict=True), key=lambda pair: pair[0])
    best = result.ranked[0]
    first = f"the first is {best.label}, {number(best.significance)}, {p_equals(best.pvalue)}"
    largest = f"the largest is {z:.1f}, {element.words}"
    fit = " before and after the fit" if result.z_after is not None else ""
    drawn = {
        "excess": (figures.excess_figure(result), f"Bars: {_excess(result)}."),
        "candidates": (figures.candidates_figure(result), f"Bars: candidates fitted alone, ranked; {first}."),
        "blocks": (figures.blocks_figure(result), f"Table of deviations by kind and map{fit}; {largest}."),
        "elements": (figures.elements_figure(result), f"Points: deviation of every element{fit}; {largest}."),
        "residual": (figures.residual_figure(result), "Sky maps of the residuals over the scatter of simulations."),
        "correlation": (figures.correlation_figure(result), "Matrix: correlation of the responses of candidates."),
        "separation": (figures.separation_figure(result), "Matrix: strength needed to choose between candidates."),
        "calibration": (figures.calibration_figure(result), "Histogram and curve: p-values of simulations."),
    }
    if result.controls is not None:
        drawn["controls"] = (figures.controls_figure(result, result.controls), f"Points: {result.controls.counted}.")
    for one in result.contrasts:
        if one.first == 0:
            text = f"Points: elements in which {result.sets[0].label} and {result.sets[one.second].label} differ."
            drawn[f"contrast{one.second}"] = (figures.contrast_figure(result, one), text)
    for place, found in enumerate(result.unlisted or (), 1):
        drawn[f"unlisted{place}"] = (structure_figure(found, result.frame), f"Map and profile: {found.says}.")
    return {name: _picture(figure, text) for name, (figure, text) in drawn.items() if figure is not None}


def _excess(result: DiagnosisResult) -> str:
    """Return the bars of :func:`~mcsim.diagnosis.figures.excess_figure` in words."""
    if (found := result.held_out) is not None:
        before, after = (measured(one.value, one.sigma) for one in (found.before, found.after))
        return f"excess chi-squared on held-out data, {before} of the model and {after} with the effects"
    words = f"excess chi-squared of the model on all data, {measured(result.excess.value, result.excess.sigma)}"
    if not result.sets:
        return words
    fitted = result.sets[0].excess
    return f"{words}, and after the fit to the same data, {measured(fitted.value, fitted.sigma)}"


def _picture(figure: Figure, words: str) -> dict[str, Any]:
    """Return PNG as base64, what it shows for those who cannot see it, and its width in CSS pixels."""
    data = page_.embedded(page_.png(figure, DOTS_PER_INCH))
    return {"data": data, "words": words, "width": round(72 * figure.get_figwidth())}
