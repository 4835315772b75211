"""A library with an effect less, derived from the full one: nothing is learned again."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.analysis import Analysis
from mcsim.diagnosis.knowledge import Knowledge
from mcsim.diagnosis.summaries import Block


@dataclass(frozen=True)
class Reduced:
    """Questions and knowledge without some effects.

    Attributes
    ----------
    asked, known
        As ``questions(run, without)`` and what its simulations would have taught.
    rows, columns
        Entries of the evidence and columns of the templates that are kept of the full ones.
    """

    analysis: Analysis
    known: Knowledge
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]


def without(analysis: Analysis, known: Knowledge, names: Collection[str]) -> Reduced:
    """Leave out effects: their proposals, the columns of their templates, and the entries that are matched to them.

    Parameters
    ----------
    asked, known
        Of the full library.
    names
        Of the effects; names that are not proposed are passed over.

    Notes
    -----
    An entry of the evidence does not depend on what else is asked, so the rest is what it would be had the effects
    never been there; the simulations are the same ones, as they are with ``mcsim diagnose --without``.
    """
    kept = [index for index, proposal in enumerate(analysis.proposals) if proposal.kind.name not in names]
    labels = {proposal.label for proposal in analysis.proposals if proposal.kind.name in names}
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
    columns = [column for index in kept for column in analysis.columns[index]]
    fewer = Analysis(
        analysis.model,
        tuple(analysis.proposals[index] for index in kept),
        tuple(blocks),
        tuple(sorted({*analysis.without, *names})),
    )
    row, column = np.array(rows, dtype=np.int64), np.array(columns, dtype=np.int64)
    cut = np.ix_(row, column)
    taught = replace(
        known,
        simulations=known.simulations[:, row],
        offset=known.offset[row],
        templates=known.templates[cut],
        curvature=known.curvature[cut],
        template_error=known.template_error[cut],
        reference=known.reference[:, row],
        elements=tuple(known.elements[index] for index in row),
    )
    return Reduced(fewer, taught, row, column)
