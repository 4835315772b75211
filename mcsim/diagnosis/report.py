"""One self-contained page about a diagnosis: the verdict for a busy person, then all that it rests on."""

import base64
import io
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jinja2
from matplotlib.figure import Figure

from mcsim.diagnosis import figures as plots
from mcsim.diagnosis.inference import Diagnosis
from mcsim.diagnosis.view import APART, ReportView

DOTS_PER_INCH = 120

_DATA = {"verdict", "configuration", "entries", "places", "explanations", "contrasts"}
"""Attributes of the evidence that hold data; the others are settings."""

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Picture:
    """A picture inside the page: PNG as base64, what it shows for those who cannot see it, its width in CSS pixels."""

    data: str
    words: str
    width: int


def write(diagnosis: Diagnosis, path: str | Path) -> None:
    """Write a diagnosis as one HTML file that needs nothing else, not even a network.

    Parameters
    ----------
    diagnosis
        Of one case.
    path
        Of the file; its folder must exist.
    """
    Path(path).write_text(page(diagnosis), encoding="utf-8")


def page(diagnosis: Diagnosis) -> str:
    """The page as text; whatever comes from configurations or data is escaped."""
    view = ReportView(diagnosis.verdict, diagnosis.evidence)
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "measured": measured,
        "number": number,
        "parameters": parameters,
        "probability": probability,
    }
    return environment.get_template("report.html.j2").render(
        verdict=diagnosis.verdict,
        sentence=plots.sentence_for_people(diagnosis),
        sets=_sets(view),
        view=view,
        pictures=_pictures(view),
        contrasts=[(one, _picture(plots.telling_figure(one), _telling_words(one))) for one in view.contrasts],
        settings=_settings(view),
        configuration=json.dumps(json.loads(diagnosis.evidence.attrs["configuration"]), indent=2, ensure_ascii=False),
        apart=APART,
        version=version("mcsim"),
    )


def measured(value: float, sigma: float) -> str:
    """A value with its error, to two digits of that."""
    if not (math.isfinite(value) and math.isfinite(sigma)) or sigma <= 0.0:
        return number(value)
    power = math.floor(math.log10(max(sigma, abs(value))))
    if -5 <= power <= 5:
        return _fixed(value, sigma)
    return f"({_fixed(value / 10.0**power, sigma / 10.0**power)}) × {_power(power)}"


def _fixed(value: float, sigma: float) -> str:
    decimals = max(0, 1 - math.floor(math.log10(sigma)))
    shown = f"{value:.{decimals}f}"
    # Nothing is not negative.
    sign = "−" if value < 0.0 and float(shown) != 0.0 else ""
    return f"{sign}{shown.lstrip('-')} ± {sigma:.{decimals}f}"


def number(value: float) -> str:
    """Three digits; a dash for what is not known."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞"
    return _typeset(f"{value:.3g}")


def parameters(given: Mapping[str, Any]) -> str:
    """Parameters of an effect that are set, in one line."""
    return ", ".join(f"{key} = {_value(value)}" for key, value in given.items() if value not in (None, ""))


def _value(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"({', '.join(_value(item) for item in value)})"
    return number(value) if isinstance(value, float) else str(value)


def probability(value: float) -> str:
    """Two digits, tiny ones as powers of ten."""
    return _typeset(f"{value:.2g}")


def _typeset(text: str) -> str:
    digits, _, power = text.partition("e")
    return f"{digits} × {_power(int(power))}" if power else digits.replace("-", "−")


def _power(exponent: int) -> str:
    return "10" + str(exponent).translate(_SUPERSCRIPTS)


def _sets(view: ReportView) -> list[dict[str, Any]]:
    """Accepted sets, the most probable first, with odds and probability of what each leaves."""
    verdict = view.verdict
    effects = [verdict["effects"], *verdict["alternatives"]] if verdict["effects"] else []
    return [
        {"effects": one, "odds": stated["odds"], "p": stated["probability"], "further": stated["further"]}
        for one, stated in zip(effects, view.explanations, strict=True)
    ]


def _settings(view: ReportView) -> list[tuple[str, str]]:
    rows = [(key.replace("_", " "), str(value)) for key, value in view.evidence.attrs.items() if key not in _DATA]
    run = json.loads(view.evidence.attrs["configuration"])
    return [*rows, ("seed of the run", str(run.get("ensemble", {}).get("seed", "–")))]


def _pictures(view: ReportView) -> dict[str, Picture]:
    gap, best = view.excess, view.ranked[0]
    change = f", {gap.after:.0f} after" if gap.after is not None else ""
    largest = max(zip(abs(view.z), view.elements, strict=True), key=lambda pair: pair[0])
    figures: dict[str, tuple[Figure | None, str]] = {
        "gap": (plots.gap_figure(view), f"Bars: gap of {gap.before:.0f} before{change}; {gap.words}."),
        "impacts": (
            plots.impacts_figure(view),
            f"Bars: candidates fitted alone, ranked; first {best.label} with {best.impact:.1f} sigmas.",
        ),
        "blocks": (
            plots.blocks_figure(view),
            f"Table of deviates by kind and map; the largest is {largest[0]:.1f} sigmas, {largest[1]['kind']}.",
        ),
        "entries": (plots.entries_figure(view), "Points: deviate of every entry, before and after the fit."),
        "residual": (plots.residual_figure(view), "Sky maps of what is left of each map, over its noise."),
        "correlation": (plots.correlation_figure(view), "Matrix: correlation of the responses of the candidates."),
        "isolation": (plots.isolation_figure(view), "Matrix: strength at which two candidates are told apart."),
        "calibration": (
            plots.calibration_figure(view),
            "Histogram of probabilities of simulations held out, and the data's among draws without a gap.",
        ),
    }
    return {name: _picture(figure, words) for name, (figure, words) in figures.items() if figure is not None}


def _telling_words(contrast: dict[str, Any]) -> str:
    return f"Points: where {contrast['first']} and {contrast['second']} differ, with the data."


def _picture(figure: Figure, words: str) -> Picture:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DOTS_PER_INCH, facecolor="white", metadata={"Software": None})
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    return Picture(data, words, round(72 * figure.get_figwidth()))
