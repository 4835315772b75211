"""A library with an effect less, derived from the full one: nothing is learned again."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.analysis import Analysis
from mcsim.diagnosis.candidate import numbered
from mcsim.diagnosis.null_ensemble import NullEnsemble
from mcsim.diagnosis.summaries import Block
from mcsim.diagnosis.templates import TemplateBank


@dataclass(frozen=True)
class Reduced:
    """Questions and knowledge without some effects.

    Attributes
    ----------
    analysis, ensemble, bank
        As of ``analysis_of(run, without)``.
    rows, columns
        Entries of the evidence and columns of the templates that are kept of the full ones.
    """

    analysis: Analysis
    ensemble: NullEnsemble
    bank: TemplateBank
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]


def without(analysis: Analysis, ensemble: NullEnsemble, bank: TemplateBank, names: Collection[str]) -> Reduced:
    """Leave out effects: their proposals, the columns of their templates, and the entries that are matched to them.

    Parameters
    ----------
    analysis, ensemble, bank
        Of the full library.
    names
        Of the effects; names that are not proposed are passed over.

    Notes
    -----
    An entry of the evidence does not depend on what else is asked, so the rest is what it would be had the effects
    never been there; the simulations are the same ones, as they are with ``mcsim diagnose --without``.
    """
    kept = [index for index, candidate in enumerate(analysis.candidates) if candidate.name not in names]
    labels = {candidate.label for candidate in analysis.candidates if candidate.name in names}
    blocks: list[Block] = []
    rows: list[int] = []
    start = 0
    for block in analysis.blocks:
        stop = start + len(block.elements)
        matched = {element.name.removeprefix("score/").rpartition("/")[0] for element in block.elements}
        if not (block.elements[0].statistic == "score" and matched <= labels):
            blocks.append(block)
            rows += range(start, stop)
        start = stop
    columns = [column for index in kept for column in analysis.candidates[index].columns]
    fewer = Analysis(
        analysis.model,
        numbered([analysis.candidates[index] for index in kept]),
        tuple(blocks),
        tuple(sorted({*analysis.without, *names})),
    )
    row, column = np.array(rows, dtype=np.int64), np.array(columns, dtype=np.int64)
    return Reduced(fewer, ensemble.restrict(row), bank.subset(row, column), row, column)
