"""Read tables of measured spectra: binned BipoSH coefficients, or C_l."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.beamfit.data import Row, Scaling, parts, project
from mcsim.beamfit.table import COLUMNS, in_uk2, read_ecsv, scaling_of
from mcsim.bipolar import Mode
from mcsim.diagnosis.analysis import Job
from mcsim.diagnosis.summaries import Element
from mcsim.errors import InputError
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Spectra:
    """Hold a table of measured spectra.

    Attributes
    ----------
    path
        Of the file.
    frame
        Of its coefficients.
    rows, pairs
        What each number is, and the pair of maps that it is of.
    scaling
        Of all numbers.
    value, error
        uK^2, shape (p,); an error is NaN where the table has none.
    realizations
        Number of skies that the values are the mean of.
    """

    path: str
    frame: str
    rows: tuple[Row, ...]
    pairs: tuple[str, ...]
    scaling: Scaling
    value: Vector
    error: Vector
    realizations: int

    @property
    def elements(self) -> tuple[Element, ...]:
        """Return the description of every number; bins are in fold 0 and 1 alternately."""
        bins = sorted({(row.ell_min, row.ell_max) for row in self.rows})
        return tuple(self._entry(row, pair, bins) for row, pair in zip(self.rows, self.pairs, strict=True))

    def _entry(self, row: Row, pair: str, bins: Sequence[tuple[int, int]]) -> Element:
        maps = [name.partition(":") for name in pair.split(",")]
        splits = {name[2] for name in maps if name[2]}
        ell, mode = (row.ell_min, row.ell_max), row.mode
        kind = f"BipoSH {mode.name}, {'imaginary' if row.imaginary else 'real'}" if mode.L else "spectrum"
        return Element(
            f"{kind}/{pair}/{ell[0]}-{ell[1]}, {_words(self.scaling)}",
            "biposh" if mode.L else "cl",
            tuple(dict.fromkeys(name[0] for name in maps)),
            splits.pop() if len(splits) == 1 else None,
            bins.index(ell) % 2,
            ell,
            mode.L,
            mode.M,
            mode.parity,
            self.frame,
            "table",
            f"{kind}, {_words(self.scaling)}",
        )

    def of(self, simulated: config.RunConfig, first: int, count: int) -> NDArray[np.float64]:
        """Return the same numbers of simulations, shape (count, p), by the function that runs an ensemble."""
        shared = survey(simulated)
        found = [simulate.realize(shared, r)["biposh"] for r in range(first, first + count)]
        biposh, labels = np.stack(found), list(shared.pair_names)
        result = np.empty((count, len(self.rows)))
        for pair in dict.fromkeys(self.pairs):
            own = [i for i, name in enumerate(self.pairs) if name == pair]
            coefficients = biposh[:, labels.index(pair)]
            rows = [self.rows[i] for i in own]
            spectra = {row.mode: coefficients[:, shared.estimator.modes.index(row.mode)] for row in rows}
            result[:, own] = project(rows, self.scaling, spectra)
        return result

    def __call__(self, job: Job) -> NDArray[np.float64]:
        """Return the data vectors of simulations; this is the task that a worker runs."""
        return self.of(config.from_json(job.simulated), job.first, job.count)


def read_spectra(path: str | Path, run: config.RunConfig) -> Spectra:
    """Read measured spectra that a run claims to describe.

    Parameters
    ----------
    path
        ECSV table as for :func:`mcsim.beamfit.read_table`, with rows L = M = d = 0 for power spectra, which in the
        Bennett normalisation are C_l. Several pairs stand together; without a column ``pair`` the table belongs to the
        first map. Without ``value_imag`` only real parts are used; ``error`` may be left out. The header's ``meta``
        must give ``normalisation``, ``scaling`` and, unless all rows have L = 0, ``frame``; ``realizations`` says of
        how many skies the values are the mean (default: 1).
    run
        Fiducial model.

    Raises
    ------
    InputError
        If a table cannot be read, does not say what its numbers are, or goes beyond the run.
    """
    table = read_ecsv(path)
    missing = [name for name in (*COLUMNS, "value") if name not in table.colnames]
    if missing:
        raise InputError(f"{path} has no column {missing[0]}; give {', '.join(COLUMNS)} and value.")
    scaling = scaling_of(path, table.meta)
    maps = config.map_names(run)
    known = [f"{x},{y}" for i, x in enumerate(maps) for y in maps[i:]]
    lmax = config.analysis_lmax(run)
    real = in_uk2(path, table, "value")
    unknown: Vector = np.full(len(table), np.nan)
    imag = in_uk2(path, table, "value_imag") if "value_imag" in table.colnames else unknown
    stated = in_uk2(path, table, "error") if "error" in table.colnames else unknown
    rows: list[Row] = []
    pairs: list[str] = []
    values: list[float] = []
    errors: list[float] = []
    for number, line in enumerate(table):
        mode, low, high = _mode(path, line, scaling), int(line["ell_min"]), int(line["ell_max"])
        pair = str(line["pair"]) if "pair" in table.colnames else known[0]
        if pair not in known:
            raise InputError(f"{path}: {pair} is no pair of the model's maps; use one of {'; '.join(known)}.")
        if not 0 <= low <= high <= lmax:
            raise InputError(
                f"{path}: the bin ell = {low} ... {high} is not within 0 ... {lmax}, the model's analysis; leave the "
                "row out or raise sky.lmax."
            )
        ell = np.arange(low, high + 1)
        other = ell - mode.d
        exists = (other >= 0) & (other <= lmax) & (other + ell >= mode.L)
        alone = len(set(pair.split(","))) == 1
        if not exists.any() or (alone and not mode.in_auto):
            raise InputError(
                f"{path}: there is no {mode.name} of {pair} at l2 = {low} ... {high}, or it repeats another; leave the "
                "row out."
            )
        for imaginary in parts(mode):
            value = float((imag if imaginary else real)[number])
            if imaginary and not np.isfinite(value):
                continue
            if not np.isfinite(value):
                raise InputError(f"{path}: {mode.name} at ell = {low}-{high} is {value:g}; leave the row out.")
            rows.append(Row(mode, low, high, imaginary))
            pairs.append(pair)
            values.append(value)
            # The error of a mode with M > 0 is that of its modulus; its two parts share the variance.
            errors.append(float(stated[number]) * (1.0 if mode.M == 0 else np.sqrt(0.5)))
    if len(set(zip(rows, pairs, strict=True))) < len(rows) or not rows:
        raise InputError(f"{path} gives a bin of one mode twice, or nothing at all; keep one row of each.")
    frame = _frame(path, table.meta, run, any(row.mode.L for row in rows))
    count = _realizations(path, table.meta)
    return Spectra(
        str(path), frame, tuple(rows), tuple(pairs), scaling, np.array(values), np.array(errors), realizations=count
    )


def _words(scaling: Scaling) -> str:
    factor = "l(l+1)/2pi" if scaling.spectrum else "1"
    return f"{'Bennett' if scaling.bennett else 'Hajian-Souradeep'} times {factor}"


def _mode(path: str | Path, line: Any, scaling: Scaling) -> Mode:
    mode = Mode(int(line["L"]), int(line["M"]), int(line["d"]))
    if not (0 <= mode.M <= mode.L and abs(mode.d) <= mode.L):
        raise InputError(f"{path}: the mode {mode.name} does not exist; it needs 0 <= M <= L and |d| <= L.")
    if mode.parity == "odd" and scaling.bennett and not scaling.summary:
        raise InputError(
            f"{path}: {mode.name} has odd parity, which the Bennett normalisation does not have; leave it out."
        )
    return mode


def _frame(path: str | Path, meta: Any, run: config.RunConfig, needed: bool) -> str:
    frame = config.prepared_grid(run)[1]
    found = str(meta.get("frame", "" if needed else frame)).lower()
    if not found:
        raise InputError(f'{path} does not say its frame; add frame: "{frame}" to its meta, if that is the one.')
    if found != frame:
        raise InputError(f"{path} is in the {found} frame, the model in the {frame} one; set map.frame to {found}.")
    return found


def _realizations(path: str | Path, meta: Any) -> int:
    count = meta.get("realizations", 1)
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise InputError(f"{path} is the mean of {count!r} realizations; give a whole number from 1 in its meta.")
    return count
