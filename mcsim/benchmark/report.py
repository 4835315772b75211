"""The score as JSON, as one self-contained HTML page, and as a picture."""

import base64
import html
import io
import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from mcsim.benchmark.figures import Confusion, Score
from mcsim.benchmark.intervals import Figure
from mcsim.benchmark.picture import challenge_figure

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; margin: 1rem 0; } td, th { padding: .25rem .7rem; text-align: left; }
tr { border-bottom: 1px solid #ddd; } td.n { text-align: right; font-variant-numeric: tabular-nums; }
.met { color: #2c7a2c; } .short { color: #b3261e; font-weight: 600; } img { max-width: 100%; }
.grid td { text-align: right; font-size: 12px; padding: .1rem .4rem; } .grid th { font-size: 12px; }
"""


def write(scores: Sequence[Score], folder: Path) -> None:
    """Write ``score.json``, ``report.html`` and ``score.png`` into a folder, made where it does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "score.json").write_text(json.dumps([_plain(one) for one in scores], indent=1, allow_nan=False) + "\n")
    pictures = []
    for number, one in enumerate(scores):
        buffer = io.BytesIO()
        challenge_figure(one).savefig(buffer, format="png", dpi=110)
        pictures.append(buffer.getvalue())
        (folder / ("score.png" if number == 0 else f"score-{number}.png")).write_bytes(buffer.getvalue())
    (folder / "report.html").write_text(_page(scores, pictures))


def lines(one: Score) -> list[str]:
    """Figures for a terminal, those that fall short first."""
    return [f"{_mark(figure):<6} {_words(figure)}" for figure in _ordered(one.figures)]


def _plain(one: Score) -> dict[str, Any]:
    return {
        "schema": 1,
        "version": version("mcsim"),
        "title": one.title,
        "figures": [figure.plain() for figure in one.figures],
        "confusion": _matrix(one.said),
        "confusion_library": _matrix(one.diagnosed),
        "confusion_bayes": _matrix(one.best),
        "left_out": [
            {
                "name": name,
                "cases": cases,
                "unknown": unknown,
                "wrong_single_name": wrong,
                "mean_distance": distance if np.isfinite(distance) else None,
            }
            for name, cases, unknown, wrong, distance in one.by_left_out
        ],
        "cases": [record.plain() for record in one.records],
    }


def _matrix(matrix: Confusion) -> dict[str, Any]:
    return {"truths": matrix.truths, "answers": matrix.answers, "counts": matrix.counts.tolist()}


def _ordered(figures: Sequence[Figure]) -> list[Figure]:
    return sorted(figures, key=lambda figure: {False: 0, True: 1, None: 2}[figure.met])


def _mark(figure: Figure) -> str:
    return {True: "met", False: "short", None: ""}[figure.met]


def _words(figure: Figure) -> str:
    interval = f" [{figure.low:.3g}, {figure.high:.3g}]" if np.isfinite(figure.low) else ""
    value = f"{figure.value:.3g}" if np.isfinite(figure.value) else "-"
    target = f"; {figure.target}" if figure.target else ""
    return f"{figure.name}: {value}{interval} of {figure.count}{target}"


def _page(scores: Sequence[Score], pictures: Sequence[bytes]) -> str:
    parts = []
    for one, picture in zip(scores, pictures, strict=True):
        short = [figure.name for figure in one.figures if figure.met is False]
        unknown = sum(bool(figure.target) and figure.met is None for figure in one.figures)
        met = "All targets that could be judged are met." if unknown else "All targets are met."
        said = f"Short of their targets: {'; '.join(short)}." if short else met
        said += f" {unknown} could not be judged, for want of cases." if unknown else ""
        image = base64.b64encode(picture).decode()
        parts += [
            f"<h1>{html.escape(one.title)}</h1><p>{html.escape(said)} Intervals are 95 %.</p>",
            _table(one.figures),
            f'<img alt="score" src="data:image/png;base64,{image}">',
            "<h2>What was said of what was there</h2>",
            _grid(one.said),
            "<h2>The classifier that knows the prior, on the cases of its library</h2>",
            _grid(one.best),
            "<h2>The diagnosis on the same cases</h2>",
            _grid(one.diagnosed),
            "<h2>Effects that the library did not have</h2>",
            _left_out(one),
        ]
    title = html.escape(" and ".join(one.title for one in scores))
    body = "\n".join(parts)
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>mcsim challenge: {title}</title>'
        f"<style>{_STYLE}</style><body>{body}<p>mcsim {version('mcsim')}</p></body></html>\n"
    )


def _table(figures: Sequence[Figure]) -> str:
    rows = []
    for figure in _ordered(figures):
        kind = {True: "met", False: "short", None: ""}[figure.met]
        value = f"{figure.value:.3g}" if np.isfinite(figure.value) else "-"
        interval = f"{figure.low:.3g} to {figure.high:.3g}" if np.isfinite(figure.low) else ""
        rows.append(
            f'<tr><td>{html.escape(figure.name)}</td><td class="n">{value}</td><td class="n">{interval}</td>'
            f'<td class="n">{figure.count}</td><td>{html.escape(figure.target)}</td>'
            f'<td class="{kind}">{_mark(figure)}</td></tr>'
        )
    head = "<tr><th>figure</th><th>value</th><th>interval</th><th>cases</th><th>target</th><th></th></tr>"
    return f"<table>{head}{''.join(rows)}</table>"


def _grid(matrix: Confusion) -> str:
    if not matrix.truths:
        return "<p>No case.</p>"
    head = "".join(f"<th>{html.escape(answer)}</th>" for answer in matrix.answers)
    rows = []
    for truth, counts in zip(matrix.truths, matrix.counts, strict=True):
        total = max(int(counts.sum()), 1)
        cells = "".join(
            f'<td style="background:rgba(31,95,168,{0.75 * count / total:.2f})">{int(count) or ""}</td>'
            for count in counts
        )
        rows.append(f"<tr><th>{html.escape(truth)}</th>{cells}</tr>")
    return f'<table class="grid"><tr><th></th>{head}</tr>{"".join(rows)}</table>'


def _left_out(one: Score) -> str:
    if not one.by_left_out:
        return "<p>No case.</p>"
    rows = "".join(
        f'<tr><td>{html.escape(name)}</td><td class="n">{cases}</td><td class="n">{unknown}</td>'
        f'<td class="n">{wrong}</td><td class="n">{distance:.1f}</td></tr>'
        for name, cases, unknown, wrong, distance in one.by_left_out
    )
    head = "<th>effect</th><th>cases</th><th>unknown</th><th>wrong single name</th><th>mean distance</th>"
    return f"<table><tr>{head}</tr>{rows}</table>"
