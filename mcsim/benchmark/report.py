"""Write a score as JSON, as one self-contained HTML page, as a picture, and as lines for a terminal."""

import json
from collections.abc import Sequence
from dataclasses import is_dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from mcsim.benchmark.intervals import Metric
from mcsim.benchmark.picture import score_figure
from mcsim.benchmark.summary import Score
from mcsim.support import page

DOTS_PER_INCH = 110


def write(score: Score, folder: Path) -> None:
    """Write ``score.json``, ``report.html`` and ``score.png`` into a folder, which is made if it does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "score.json").write_text(json.dumps([_plain(_content(score))], indent=1, allow_nan=False) + "\n")
    picture = page.png(score_figure(score), DOTS_PER_INCH)
    (folder / "score.png").write_bytes(picture)
    text = page.render(
        Path(__file__).with_name("report.html.j2"),
        {"value": _value, "interval": _interval, "mark": _mark},
        score=score,
        metrics=_ordered(score.metrics),
        short=[metric.name for metric in score.metrics if metric.met is False],
        open=sum(bool(metric.target) and metric.met is None for metric in score.metrics),
        confusions=[
            ("Diagnosis, all cases", score.all_cases),
            ("Bayes classifier, cases whose truth is in the library", score.bayes),
            ("Diagnosis, cases whose truth is in the library", score.library_cases),
        ],
        picture=page.embedded(picture),
        version=version("mcsim"),
    )
    (folder / "report.html").write_text(text, encoding="utf-8")


def lines(score: Score) -> list[str]:
    """Return the metrics for a terminal, those that miss their target first."""
    return [
        f"{_mark(one):<6} {one.name}: {_value(one)}{f' [{_interval(one)}]' if _interval(one) else ''} of {one.count}"
        + (f"; target: {one.target}" if one.target else "")
        for one in _ordered(score.metrics)
    ]


def _content(score: Score) -> dict[str, Any]:
    return {
        "schema": 1,
        "version": version("mcsim"),
        "title": score.title,
        "figures": score.metrics,
        "confusion": score.all_cases,
        "confusion_library": score.library_cases,
        "confusion_bayes": score.bayes,
        "left_out": score.unlisted,
        "cases": score.records,
    }


def _plain(value: Any) -> Any:
    """Return nested dataclasses, arrays and sets as JSON has them, None in place of NaN."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, frozenset):  # effects by name and channel, which can be None
        return [list(one) for one in sorted(value, key=lambda one: (one[0], one[1] or ""))]
    if isinstance(value, tuple):
        return [_plain(one) for one in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return _plain(vars(value)) if is_dataclass(value) else value


def _ordered(metrics: Sequence[Metric]) -> list[Metric]:
    return sorted(metrics, key=lambda metric: (False, True, None).index(metric.met))


def _mark(metric: Metric) -> str:
    return {True: "met", False: "missed", None: ""}[metric.met]


def _value(metric: Metric) -> str:
    return f"{metric.value:.3g}" if np.isfinite(metric.value) else "–"


def _interval(metric: Metric) -> str:
    return f"{metric.low:.3g}, {metric.high:.3g}" if np.isfinite(metric.low) else ""
