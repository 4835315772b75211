"""A table of measured spectra: read it, describe its numbers, and simulate them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mcsim import config
from mcsim.beamfit.data import Row, Scaling, project
from mcsim.beamfit.table import (
    check_frame,
    check_parity,
    count_of,
    errors_of_parts,
    highest_of,
    identified,
    in_uk2,
    read_ecsv,
    scaling_of,
)
from mcsim.bipolar import Mode
from mcsim.bipolar.modes import existing
from mcsim.datavector.analysis import Analysis, Job, analysis_of, kinds_of, surveys
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.summaries import Block, Element
from mcsim.errors import InputError
from mcsim.simulation import simulate
from mcsim.sphere.rotation import FRAMES, rotate_biposh
from mcsim.support.arrays import Vector
from mcsim.systematics import Library, acts_through

_SPECTRAL_HOOKS = ("sky", "beam", "pointing", "spread", "orientations", "noise", "knee", "excess")
"""Hooks that change spectra of a map. Gains and signals of samples do so in the lowest degrees only, and are no
candidates."""


class Pair(NamedTuple):
    """Describe a pair of maps: its label in tables and stores, and channel and split (None: no splits) of each map."""

    label: str
    channels: tuple[str, str]
    splits: tuple[str | None, str | None]

    @property
    def auto(self) -> bool:
        """Return True if both maps are the same."""
        return self.channels[0] == self.channels[1] and self.splits[0] == self.splits[1]


@dataclass(frozen=True)
class Spectra:
    """Hold a table of measured spectra; it is also the task of a worker that simulates them."""

    path: str
    frame: str
    rows: tuple[Row, ...]  # what each number is
    pairs: tuple[Pair, ...]  # the pair of maps that it is of
    scaling: Scaling  # of all numbers
    value: Vector  # uK^2, shape (p,)
    error: Vector  # the same, NaN where the table has none
    realizations: int  # skies that the values are the mean of
    highest: int | None = None  # highest degree of the maps of the data; None: that of the model

    @property
    def elements(self) -> tuple[Element, ...]:
        """Return the description of every number; bins are in fold 0 and 1 alternately."""
        bins = sorted({(row.ell_min, row.ell_max) for row in self.rows})
        normalisation = "Bennett" if self.scaling.bennett else "Hajian-Souradeep"
        scale = f"{normalisation} times {'l(l+1)/2pi' if self.scaling.spectrum else '1'}"
        scale += "" if self.highest is None else f", of maps up to l = {self.highest}"
        found = []
        for (mode, low, high, imaginary), pair in zip(self.rows, self.pairs, strict=True):
            part, words = "imaginary" if imaginary else "real", f"L = {mode.L}, M = {mode.M}, d = {mode.d}"
            what = f"BipoSH {mode.name}, {part}" if mode.L else "spectrum"
            name, statistic = f"{what}/{pair.label}/{low}-{high}, {scale}", "biposh" if mode.L else "cl"
            split = pair.splits[0] if pair.splits[0] == pair.splits[1] else None
            own = Element(name, statistic, tuple(dict.fromkeys(pair.channels)), split, bins.index((low, high)) % 2)
            own = replace(own, ell=(low, high), L=mode.L, M=mode.M, parity=mode.parity, frame=self.frame)
            found.append(replace(own, kind="table", component=f"BipoSH {words}, {part}" if mode.L else "C_ℓ"))
        return tuple(found)

    def __call__(self, job: Job) -> Vector:
        """Return the same numbers of simulations, shape (count, p), by the function that runs an ensemble."""
        realized = [(shared, simulate.realize(shared, realization)) for realization, shared in surveys(job)]
        shared, biposh = realized[0][0], np.stack([spectra["biposh"] for _, spectra in realized])
        columns = []
        for row, pair in zip(self.rows, self.pairs, strict=True):
            where = shared.pair_names.index(pair.label), shared.estimator.modes.index(row.mode)
            columns.append(project([row], self.scaling, {row.mode: biposh[:, *where]}, self.highest))
        return np.concatenate(columns, axis=1)

    def views(self) -> Iterator[tuple[Element, Vector]]:
        """Yield M = 0 in other frames, if the table has every M: its description, and its weights of the values."""
        at = {(pair, row): i for i, (pair, row) in enumerate(zip(self.pairs, self.rows, strict=True))}
        for (pair, row), number in at.items():
            mode = row.mode
            if mode.L == 0 or mode.M > 0:
                continue
            family = [Mode(mode.L, M, mode.d) for M in range(mode.L + 1)]
            needed = [
                (m, part, at.get((pair, row._replace(mode=m, imaginary=part)))) for m in family for part in m.parts
            ]
            if any(i is None for _, _, i in needed):
                continue
            unit = np.zeros((len(self.rows), len(family), 1), dtype=np.complex128)
            for m, part, i in needed:
                unit[i, m.M, 0] = 1j if part else 1.0
            for frame in FRAMES:
                if frame != self.frame:
                    turned = rotate_biposh(unit, [(m.L, m.M, m.d) for m in family], self.frame, frame)[:, 0, 0]
                    own = self.elements[number]
                    own = replace(own, name=f"{own.name} {frame}", frame=frame)
                    yield own, turned.imag if row.imaginary else turned.real


def _check_filter(path: str | Path, stated: str, needed: str) -> None:
    """Raise InputError for spectra of maps that were filtered otherwise than those of the model."""
    if stated != needed:
        raise InputError(
            f'{path} has spectra of maps with filter = "{stated}", and the model has [biposh] filter = "{needed}"; set '
            f'that to "{stated}", or take spectra that agree.'
        )


def read_spectra(path: str | Path, run: config.RunConfig) -> Spectra:
    """Read measured spectra that a run claims to describe; raise InputError if they say too little or go beyond it.

    The file is an ECSV table as for :func:`mcsim.beamfit.read_table`, with rows L = M = d = 0 for power spectra, which
    in the Bennett normalisation are C_l. Several pairs stand together; without a column ``pair`` the table belongs to
    the first map. Without ``value_imag`` only real parts are used; ``error`` may be left out. The header's ``meta``
    must give ``normalisation``, ``scaling`` and, unless all rows have L = 0, ``frame``; ``realizations`` says of how
    many skies the values are the mean (default: 1), ``lmax`` where the maps end (default: as the model), and ``filter``
    how they were filtered, which has to be the run's ``biposh.filter`` (default: not at all).
    """
    table = read_ecsv(path)
    _check_filter(path, str(table.meta.get("filter", "none")), run.biposh.filter)
    scaling, known, lmax = scaling_of(path, table.meta), _pairs(run), config.analysis_lmax(run)
    absent, highest = np.full(len(table), np.nan), highest_of(path, table.meta)
    real = in_uk2(path, table, "value")
    imag, stated = (in_uk2(path, table, name) if name in table.colnames else absent for name in ("value_imag", "error"))
    of_parts = errors_of_parts(path, table, stated)
    found: dict[tuple[Row, Pair], tuple[float, float]] = {}
    for number, (L, M, d, low, high) in enumerate(identified(path, table).T.tolist()):
        label = str(table["pair"][number]) if "pair" in table.colnames else next(iter(known))
        if label not in known:
            raise InputError(f"{path}: {label} is no pair of the model's maps; use one of {'; '.join(known)}.")
        mode, pair = Mode(L, M, d), known[label]
        check_parity(path, mode, scaling)
        _check_row(path, Row(mode, low, high, False), pair, lmax, highest)
        for imaginary in mode.parts:
            key, value = (Row(mode, low, high, imaginary), pair), float((imag if imaginary else real)[number])
            if imaginary and not np.isfinite(value):
                continue
            if not np.isfinite(value):
                raise InputError(f"{path}: {mode.name} at ell = {low}-{high} is {value:g}; leave the row out.")
            if key in found:
                raise InputError(f"{path} gives a bin of one mode twice; keep one row of each.")
            found[key] = value, float((stated if M == 0 else of_parts[imaginary])[number])
    if not found:
        raise InputError(f"{path} has no finite value; give the measured bins.")
    (rows, pairs), (value, error) = zip(*found, strict=True), np.array(list(found.values())).T
    frame, said = config.prepared_grid(run)[1], str(table.meta.get("frame", "")).lower()
    if not said and any(row.mode.L for row in rows):
        raise InputError(f'{path} does not say its frame; add frame: "{frame}" to its meta, if that is the one.')
    check_frame(path, said or frame, frame)
    return Spectra(str(path), frame, rows, pairs, scaling, value, error, count_of(path, table.meta), highest)


def _pairs(run: config.RunConfig) -> dict[str, Pair]:
    """Return every pair of maps of a run by its label, the first map's own first."""
    found = {}
    for x, y in combinations_with_replacement(run.each_map, 2):
        label = f"{x.name},{y.name}"
        found[label] = Pair(label, (x.channel.name, y.channel.name), (x.split, y.split))
    return found


def _check_row(path: str | Path, row: Row, pair: Pair, lmax: int, highest: int | None) -> None:
    """Raise InputError for a mode or a bin that the pair does not have."""
    mode, low, high, _ = row
    if not (0 <= mode.M <= mode.L and abs(mode.d) <= mode.L):
        raise InputError(f"{path}: the mode {mode.name} does not exist; it needs 0 <= M <= L and |d| <= L.")
    if not 0 <= low <= high <= lmax:
        raise InputError(
            f"{path}: the bin ell = {low} ... {high} is not within 0 ... {lmax}, the model's analysis; leave the "
            "row out or raise biposh.lmax (by default sky.lmax)."
        )
    exists = existing(mode.L, mode.d, lmax if highest is None else min(lmax, highest))[low : high + 1]
    if not exists.any() or (pair.auto and not mode.in_auto):
        raise InputError(
            f"{path}: there is no {mode.name} of {pair.label} at l2 = {low} ... {high}, or it repeats another; leave "
            "the row out."
        )


def estimator_for(run: config.RunConfig, measured: Spectra) -> config.RunConfig:
    """Return the run with the estimator that a table needs: its L, its pairs, and no circular-beam control."""
    both = not all(pair.auto for pair in measured.pairs)
    biposh = replace(run.biposh, L_max=max(row.mode.L for row in measured.rows), pairs="all" if both else "auto")
    return replace(run, biposh=biposh, ensemble=replace(run.ensemble, paired=False, keep_maps=False))


def analysis_of_spectra(
    run: config.RunConfig,
    measured: Spectra,
    without: Sequence[str] = (),
    nthreads: int = 1,
    settings: DiagnosisSettings | None = None,
    library: Library | None = None,
) -> Analysis:
    """Define the analysis of a table: effects that change spectra, and the numbers of the table as data vector.

    Arguments are those of :func:`~mcsim.datavector.analysis.analysis_of`.
    """
    excluded = [name for name, kind in kinds_of(library, run) if not acts_through(kind, *_SPECTRAL_HOOKS)]
    settings = (settings or DiagnosisSettings()).without_shrinkage()
    analysis = analysis_of(run, (*without, *excluded), nthreads, settings, library)
    return replace(analysis, blocks=(Block(measured.elements, lambda filtered: measured.value),), of_maps=False)
