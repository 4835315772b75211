"""Binned BipoSH spectra as a real data vector with its covariance, from the realizations of a store."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from mcsim.bipolar import Mode, bennett_factor, parse_mode
from mcsim.bipolar.modes import bin_factor
from mcsim.ensemble import opening, store, tables
from mcsim.errors import InputError
from mcsim.support.arrays import divided
from mcsim.support.folders import user_path

Kind = Literal["plain", "difference"]

QUADRUPOLE = ("L2M0d0", "L2M0d2")  #: A^{20}_{l l} and A^{20}_{l-2,l}: the modes fitted by default


@dataclass(frozen=True)
class Selection:
    """Selection of the fitted spectra of a store or table."""

    modes: Sequence[str] = QUADRUPOLE  #: labels of the modes, which are fitted jointly
    ell_range: tuple[int, int] | None = None  #: first and last multipole; bins within them are used
    kind: Kind | None = None  #: "difference" to the circular-beam controls (default if they exist) or "plain"
    pair: str | None = None  #: label of the pair of maps; by default the first

    def __post_init__(self) -> None:
        """Raise InputError for modes that cannot exist or repeat, an empty range, or another kind."""
        if isinstance(self.modes, str) or not self.modes or len(set(self.parsed)) < len(self.modes):
            raise InputError(f"modes = {self.modes!r} are no different labels; give some such as ['L2M0d0'].")
        if self.kind is not None and self.kind not in get_args(Kind):
            raise InputError(f"the kind of spectra {self.kind!r} is not known; give plain or difference.")
        if self.ell_range is not None and not _is_range(self.ell_range):
            raise InputError(f"ell_range = {self.ell_range!r} is no range; give (first, last), 0 <= first <= last.")

    @property
    def parsed(self) -> tuple[Mode, ...]:
        """Modes, parsed from their labels."""
        return tuple(parse_mode(str(name)) for name in self.modes)


def _is_range(given: Any) -> bool:
    """Return True for two whole numbers of degrees, in order."""
    ends: Any = given if isinstance(given, Sequence) and len(given) == 2 else ("", "")
    return all(isinstance(end, int | np.integer) for end in ends) and bool(0 <= ends[0] <= ends[1])


EVERYTHING = Selection()  #: the quadrupole modes at every ell


class Row(NamedTuple):
    """One element of the data vector: real or imaginary part of the mean of a mode over ell_min <= l2 <= ell_max."""

    mode: Mode
    ell_min: int
    ell_max: int
    imaginary: bool


class Scaling(NamedTuple):
    """Scaling of the binned coefficients: Bennett or Hajian-Souradeep normalisation, times l(l+1)/2pi or not.

    ``summary`` marks the scaling of an ensemble's summary, which alone combines odd parity with Bennett's.
    """

    bennett: bool
    spectrum: bool
    summary: bool

    def factor(self, mode: Mode, lmax: int) -> NDArray[np.float64]:
        """Return the factor from raw coefficients, shape (lmax + 1,)."""
        if self.summary:
            return bin_factor(mode, lmax)
        ell = np.arange(lmax + 1.0)
        factor = ell * (ell + 1.0) / (2.0 * np.pi) if self.spectrum else np.ones(lmax + 1)
        return factor * bennett_factor(mode, lmax) if self.bennett else factor


SUMMARY = Scaling(bennett=True, spectrum=True, summary=True)


@dataclass(frozen=True)
class Measurement:
    """Data vector of a fit."""

    #: origin, pair, kind: source of the data, their pair of maps (``None``: the only map), and "plain" or "difference"
    #: to the circular-beam controls
    origin: str
    pair: str | None
    kind: str
    #: rows, scaling: mode, part and bin of each element, and the scaling of all
    rows: tuple[Row, ...]
    scaling: Scaling
    #: value, covariance: data vector and its covariance, uK^2 and uK^4, shape (p,) and (p, p)
    value: NDArray[np.float64]
    covariance: NDArray[np.float64]
    #: number of realizations that the covariance is estimated from; ``None``: the covariance is known
    simulations: int | None
    realizations: NDArray[np.float64] | None = None  #: data vectors of the realizations, shape (N, p), if known
    highest: int | None = None  #: highest degree of the maps of the data; ``None``: not known, that of the model
    count: int = 1  #: number of realizations whose mean the data are
    unfitted: tuple[str, ...] = ()  #: modes of the pair that are detected in the store but not fitted, strongest first

    @property
    def of_one_map(self) -> bool:
        """Return True unless the pair is of two different maps."""
        return is_of_one_map(self.pair)

    @property
    def modes(self) -> tuple[Mode, ...]:
        """Modes, each once, in order."""
        return tuple(dict.fromkeys(row.mode for row in self.rows))

    @property
    def lmax(self) -> int:
        """Largest ell."""
        return max(row.ell_max for row in self.rows)


def is_of_one_map(pair: str | None) -> bool:
    """Return True unless the label of a pair is that of two different maps."""
    return pair is None or len(set(pair.split(","))) == 1


def project(
    rows: Sequence[Row], scaling: Scaling, spectra: Mapping[Mode, NDArray[np.complex128]], highest: int | None = None
) -> NDArray[np.float64]:
    """Return data vectors, shape (..., rows), of spectra of shape (..., lmax + 1); NaN where a bin is empty.

    Bins have no coefficients with l2 or l1 = l2 - d above ``highest``, where data end that are compared with these.
    """
    scaled = {mode: scaling.factor(mode, array.shape[-1] - 1) * array for mode, array in spectra.items()}
    columns = []
    for row in rows:
        last = row.ell_max if highest is None else min(row.ell_max, highest + min(row.mode.d, 0))
        inside = scaled[row.mode][..., row.ell_min : last + 1]
        exists = np.isfinite(inside)
        count = exists.sum(axis=-1)
        total = np.where(exists, inside, 0.0).sum(axis=-1)
        mean = divided(total, count)
        columns.append(np.where(count > 0, mean.imag if row.imaginary else mean.real, np.nan))
    return np.stack(columns, axis=-1)


def from_store(path: str | Path, selection: Selection = EVERYTHING) -> Measurement:
    """Read the mean of an ensemble, with the covariance of its data vector over all modes and bins of the summary.

    Raise InputError if the store lacks what is selected.
    """
    with opening.open_ensemble(path) as ensemble:
        biposh = ensemble.attrs["configuration"]["biposh"]
        refuse_filtered(path, biposh.get("filter", "none"))
        width = int(biposh["summary_bin"])
        lmax = ensemble.sizes["ell"] - 1
        paired = "biposh_circular" in ensemble
        label = str(ensemble["pair"].values[0]) if selection.pair is None else selection.pair
    chosen = ("difference" if paired else "plain") if selection.kind is None else selection.kind
    first, last = selection.ell_range or (0, lmax)
    bins = [(a, min(a + width - 1, lmax)) for a in range(0, lmax + 1, width)]
    rows = tuple(
        Row(mode, a, b, imaginary)
        for mode in selection.parsed
        for imaginary in mode.parts
        for a, b in bins
        if a >= first and b <= last
    )
    if not rows:
        raise InputError(
            f"no bin of {path} lies within ell = {first} ... {min(last, lmax)}; its bins are {width} wide and end at "
            f"ell = {lmax}, choose a range that holds one."
        )
    drawn = realizations(path, rows, SUMMARY, chosen, label)
    measured = np.atleast_1d(np.isfinite(drawn).all(axis=0))
    kept = tuple(row for row, keep in zip(rows, measured, strict=True) if keep)
    if absent := set(selection.parsed) - {row.mode for row in kept}:
        raise InputError(f"{path} has no {min(absent).name} for the pair {label} at these ell; leave the mode out.")
    drawn = drawn[:, measured]
    value, covariance = drawn.mean(axis=0), _covariance(drawn) / len(drawn)
    fitted, count = {row.mode.name for row in kept}, len(drawn)
    others = tuple(name for name in _detected(path, chosen, label) if name not in fitted)
    return Measurement(str(path), label, chosen, kept, SUMMARY, value, covariance, count, drawn, lmax, count, others)


def _detected(path: str | Path, kind: Kind, pair: str) -> list[str]:
    """Return the modes that are detected in the summary of a store, none without one."""
    if not (user_path(path) / "summary").is_dir():
        return []
    with opening.open_summary(path) as summary:
        suffix = "_difference" if kind == "difference" else ""
        names = [f"biposh{suffix}_binned_{what}" for what in ("mean", "standard_error")]
        return tables.detected(opening.read_in(summary[[*names, "count"]], path), suffix, pair)


def refuse_filtered(path: str | Path, name: str) -> None:
    """Raise InputError for spectra that a filter has made: response and scatter are not those of other maps."""
    if name != "none":
        raise InputError(
            f"{path} has spectra of maps with filter = {name!r}, whose response to a beam is not that of the fitted "
            'templates; run them with biposh.filter = "none", and take those.'
        )


def with_covariance_of(measured: Measurement, path: str | Path, pair: str | None = None) -> Measurement:
    """Return the data of a measurement with the covariance of an ensemble that models it, that of a mean of as many.

    The measurement is usually from a table, whose own errors are not used. ``pair`` is a label of the store; by default
    that of the measurement, or the store's first of one map, or of two, as it is. InputError if the store lacks such a
    pair, or a mode or degree of the measurement, or filters its maps.
    """
    with opening.open_ensemble(path) as ensemble:
        refuse_filtered(path, ensemble.attrs["configuration"]["biposh"].get("filter", "none"))
        labels = [str(name) for name in ensemble["pair"].values]
    alike = [name for name in labels if is_of_one_map(name) == measured.of_one_map]
    if not (pair or alike):
        kind = "one map" if measured.of_one_map else "two different maps"
        raise InputError(f"{path} has no pair of {kind}, as the data are; give a store that has, or name a pair of it.")
    label = pair or (measured.pair if measured.pair in labels else alike[0])
    drawn = realizations(path, measured.rows, measured.scaling, measured.kind, label, measured.highest)
    return replace(measured, covariance=_covariance(drawn) / measured.count, simulations=len(drawn))


def _covariance(drawn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sample covariance of data vectors, shape (N, p) to (p, p)."""
    return np.atleast_2d(np.cov(drawn.T, ddof=1))


def realizations(
    path: str | Path, rows: Sequence[Row], scaling: Scaling, kind: str, pair: str, highest: int | None = None
) -> NDArray[np.float64]:
    """Return data vectors of all finished realizations of a store, shape (N, rows), read chunk by chunk.

    ``highest`` is that of :func:`project`.

    InputError if the store has another lmax or lacks the pair, a mode or the circular-beam controls.
    """
    target = user_path(path)
    with opening.open_ensemble(target) as ensemble:
        labels = {str(name): number for number, name in enumerate(ensemble["mode"].values)}
        pairs = [str(name) for name in ensemble["pair"].values]
        lmax, paired = ensemble.sizes["ell"] - 1, "biposh_circular" in ensemble
    if pair not in pairs:
        raise InputError(f"There is no pair {pair} in {path}; choose among {'; '.join(pairs)}.")
    if kind == "difference" and not paired:
        raise InputError(
            f"{path} has no circular-beam controls; fit its plain spectra, or run it with ensemble.paired = true."
        )
    missing = [row.mode.name for row in rows if row.mode.name not in labels]
    if missing:
        raise InputError(f"{path} has no mode {missing[0]}; it holds {', '.join(labels)}.")
    if max(row.ell_max for row in rows) > lmax:
        raise InputError(f"{path} ends at ell = {lmax}, below the last bin of the data; give narrower data.")
    number, size, chunk = pairs.index(pair), len(store.done(target)), store.chunk(target)
    found = []
    for start in range(0, size, chunk):
        arrays = store.read(target, start, min(start + chunk, size))
        done = arrays["done"]
        biposh = arrays["biposh"][done, number]
        if kind == "difference":
            biposh = biposh - arrays["biposh_circular"][done, number]
        spectra = {row.mode: biposh[:, labels[row.mode.name]] for row in rows}
        found.append(project(rows, scaling, spectra, highest))
    joined = np.concatenate(found)
    if len(joined) < 3:
        raise InputError(f"{path} has {len(joined)} finished realizations, too few for a covariance; run more.")
    return joined
