"""A library with an effect less, derived from the full one: nothing is learned again."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.blocks import Block
from mcsim.diagnosis.evidence import Questions
from mcsim.diagnosis.knowledge import Knowledge


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

    asked: Questions
    known: Knowledge
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]


def without(asked: Questions, known: Knowledge, names: Collection[str]) -> Reduced:
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
    kept = [index for index, proposal in enumerate(asked.proposals) if proposal.kind.name not in names]
    labels = {proposal.label for proposal in asked.proposals if proposal.kind.name in names}
    blocks: list[Block] = []
    rows: list[int] = []
    start = 0
    for block in asked.blocks:
        stop = start + len(block.entries)
        matched = {entry.name.removeprefix("score/").rpartition("/")[0] for entry in block.entries}
        if not (block.entries[0].statistic == "score" and matched <= labels):
            blocks.append(block)
            rows += range(start, stop)
        start = stop
    columns = [column for index in kept for column in asked.columns[index]]
    fewer = Questions(
        asked.model,
        tuple(asked.proposals[index] for index in kept),
        tuple(blocks),
        tuple(sorted({*asked.without, *names})),
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
        entries=tuple(known.entries[index] for index in row),
    )
    return Reduced(fewer, taught, row, column)
