"""Simulations of the model: the null distribution of the data vector."""

import json
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from pydantic import TypeAdapter

from mcsim.datavector.candidate import Column, TemplateBank
from mcsim.datavector.summaries import Element, pair_classes
from mcsim.ensemble.datasets import write_dataset
from mcsim.stats.gaussian import SimulatedGaussian, WhitenedTemplates, held_out_pvalues
from mcsim.stats.look_elsewhere import Calibration, calibrate, calibrate_in_folds, calibrate_on
from mcsim.support.arrays import Matrix, Vector, divided

QUADRATIC = 0.05  #: share of an element's variance that may come from squares and products of nuisances
ROUND_OFF = 1e-20  #: variance, relative to the largest, of a direction that is there only by round-off


@dataclass(frozen=True)
class NullEnsemble:
    """Hold data vectors of simulations without any candidate effect; measured spectra have no scan and residuals."""

    simulations: Matrix  # (N, p)
    offset: Vector  # mean of the time-ordered reference less that of the default route for the same skies, (p,)
    elements: tuple[Element, ...]
    reference: Matrix  # data vectors of the skies with which responses are measured, (skies, p)
    bipolar_scan: Matrix  # of the first n simulations, (n, numbers)
    residual_mean: Matrix  # of their coarse residual maps, (map, npix)
    residual_scatter: Matrix  # standard deviation of the same
    residual_rms: Matrix  # rms of each over this scatter, (n, map)
    redundant: float = 1e-4  # directions with less than this fraction of the largest variance are left out
    # Of an external model: the reference of its simulator if that can add effects, of the extended data vector,
    # and the offset of mcsim's routes.
    external_reference: Matrix | None = None
    own_offset: Vector | None = None
    # Numbers beside the data vector, which no test of the gap sees: of the same simulations, (N, E), and all else.
    slices: Matrix = field(default_factory=lambda: np.zeros((0, 0)))
    slice_offset: Vector = field(default_factory=lambda: np.zeros(0))
    slice_reference: Matrix = field(default_factory=lambda: np.zeros((0, 0)))
    slice_elements: tuple[Element, ...] = ()
    nuisances: Matrix | None = None  # coordinates that every simulation drew, (N, k); None: there are none
    shrunk: bool = False  # few simulations, whose covariance is shrunk; not with nuisances
    skies: int = 1  # of which the data are the mean

    @property
    def folds(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the places of the elements of fold 0, and of fold 1."""
        folds = np.array([element.fold for element in self.elements])
        return np.flatnonzero(folds == 0), np.flatnonzero(folds == 1)

    @cached_property
    def spread(self) -> Vector:
        """Return the standard deviation of every element, shape (p,)."""
        return np.asarray(self.simulations.std(axis=0))

    @cached_property
    def gaussian(self) -> SimulatedGaussian:
        """Return the Gaussian with mean and covariance of the simulations, the mean moved by the offset.

        Which directions are redundant is decided without the nuisances: beside a wide prior all others look small.
        """
        found = self._of_one()
        return replace(found, scale_variance=found.scale_variance / self.skies)

    def _of_one(self) -> SimulatedGaussian:
        """Return the Gaussian for data of a single sky."""
        if self.nuisances is None:
            alike = pair_classes(self.elements) if self.shrunk else None
            return SimulatedGaussian.from_simulations(self.simulations, self.offset, self.redundant, self.shrunk, alike)
        tested = self.tested
        kept = SimulatedGaussian.from_simulations(self.quiet[:, tested], floor=self.redundant).whitening
        wide = SimulatedGaussian.from_simulations(self.simulations[:, tested] @ kept.T, floor=ROUND_OFF)
        whitening = np.zeros((wide.dimension, len(tested)))
        whitening[:, tested] = wide.whitening @ kept
        return replace(wide, mean=self.simulations.mean(axis=0) + self.offset, whitening=whitening)

    def held_out_pvalues(self, null: SimulatedGaussian) -> Vector:
        """Return the p-value of every simulation, of a single sky each, against all others, shape (N,): uniform."""
        return held_out_pvalues(self.simulations, replace(null, scale_variance=self.skies * null.scale_variance))

    def calibration(self, null: SimulatedGaussian, groups: WhitenedTemplates) -> Calibration:
        """Return the null distribution of the tests, on held-out simulations with nuisances or a shrunk covariance.

        Nuisances make data less Gaussian; a shrunk covariance is better for some templates than for others.
        """
        found = calibrate(null, groups)
        if self.nuisances is not None:
            single = replace(null, scale_variance=self.skies * null.scale_variance)  # of one sky, as simulations are
            return calibrate_on(found, single, groups, self.simulations)
        return calibrate_in_folds(found, null, groups) if null.folds else found

    @cached_property
    def tested(self) -> NDArray[np.bool_]:
        """Return True for elements that are about as Gaussian as the tests take them to be, shape (p,).

        Powers follow the square of a nuisance that is larger than the noise: the share of their variance beside what is
        linear that products of two nuisances explain may be QUADRATIC, and four standard errors of such a share.
        """
        if self.nuisances is None:
            return np.ones(len(self.elements), dtype=np.bool_)
        z = _standardised(self.nuisances)
        one, two = np.triu_indices(z.shape[1])
        squares = (_standardised(z[:, one] * z[:, two]).T @ _standardised(self.quiet) / len(z)) ** 2
        share = np.sum(squares - 1.0 / len(z), axis=0)
        return np.asarray(share < QUADRATIC + 4.0 * np.sqrt(2.0 * len(one)) / len(z))

    @cached_property
    def quiet(self) -> Matrix:
        """Return the simulations without what is linear in their nuisances, shape (N, p)."""
        return without_nuisances(self.simulations, self.nuisances)

    @property
    def without_offset(self) -> "NullEnsemble":
        """Return the ensemble of maps by the default route: its mean is that of the simulations."""
        none = np.zeros_like
        return replace(self, offset=none(self.offset), slice_offset=none(self.slice_offset))

    def first(self, count: int) -> "NullEnsemble":
        """Return the ensemble of the first simulations."""
        nuisances = None if self.nuisances is None else self.nuisances[:count]
        return replace(self, simulations=self.simulations[:count], nuisances=nuisances, slices=self.slices[:count])

    @cached_property
    def extended(self) -> "NullEnsemble":
        """Return the ensemble of the data vector with the numbers beside it behind it, (p + E) elements."""
        if not self.slice_elements:
            return self
        return replace(
            self,
            simulations=np.concatenate([self.simulations, self.slices], axis=1),
            offset=np.concatenate([self.offset, self.slice_offset]),
            reference=np.concatenate([self.reference, self.slice_reference], axis=1),
            elements=(*self.elements, *self.slice_elements),
            slice_elements=(),
        )

    def restrict(self, rows: NDArray[np.int64]) -> "NullEnsemble":
        """Return the ensemble of some elements."""
        elements = tuple(self.elements[row] for row in rows)
        simulations, reference = self.simulations[:, rows], self.reference[:, rows]
        return replace(self, simulations=simulations, offset=self.offset[rows], elements=elements, reference=reference)

    def remix(self, matrix: Matrix) -> "NullEnsemble":
        """Return the ensemble of as many linear combinations of the elements, shape (p, p)."""
        simulations, reference = self.simulations @ matrix.T, self.reference @ matrix.T
        return replace(self, simulations=simulations, offset=matrix @ self.offset, reference=reference)

    def scattered_as(self, simulations: Matrix, reference: Matrix) -> "NullEnsemble":
        """Return the ensemble with the scatter of other simulations, (N, p + E), about its mean, and a reference."""
        size, beside = len(self.elements), len(self.slice_elements)
        deviations, own = np.split(simulations - simulations.mean(axis=0), [size], axis=1)
        return replace(
            self,
            simulations=self.simulations.mean(axis=0) + deviations,
            reference=reference[:, :size],
            slices=self.slices.mean(axis=0) + own if beside else self.slices,
            slice_reference=reference[:, size:],
        )

    def of_mean(self, realizations: int) -> "NullEnsemble":
        """Return the ensemble of the mean of several skies.

        Notes
        -----
        A mean of R skies less that of N simulations has the covariance C (1/R + 1/N); the tests take it to be 1 + 1/N
        times that of the simulations. These are contracted about their mean until it is: the tests stay exact.
        Nuisances are the same in all skies, and what is linear in them is not contracted. The variance of a scale, like
        any kurtosis, falls as 1/R.
        """
        count = len(self.simulations)
        scale = np.sqrt((count + realizations) / (realizations * (count + 1.0)))
        mean = self.simulations.mean(axis=0)
        common = self.simulations - self.quiet
        return replace(self, simulations=mean + scale * (self.quiet - mean) + common, skies=realizations)


def _standardised(rows: Matrix) -> Matrix:
    return divided(rows - rows.mean(axis=0), np.std(rows, axis=0))


def without_nuisances(simulations: Matrix, nuisances: Matrix | None) -> Matrix:
    """Return simulations, shape (N, p), less their regression on the nuisances that they drew, shape (N, k)."""
    if nuisances is None:
        return simulations
    centred = nuisances - nuisances.mean(axis=0)
    return np.asarray(simulations - centred @ np.linalg.lstsq(centred, simulations, rcond=None)[0])


def save(path: Path, ensemble: NullEnsemble, bank: TemplateBank) -> None:
    """Write an ensemble and the templates to a new Zarr store: every array by its name."""
    values = {f.name: getattr(one, f.name) for one in (ensemble, bank) for f in fields(one)}
    values |= {"response_skies": values.pop("skies")}  # the ensemble's are an attribute
    arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
    attributes = {
        "elements": json.dumps([asdict(element) for element in ensemble.elements]),
        "slice_elements": json.dumps([asdict(element) for element in ensemble.slice_elements]),
        "columns": json.dumps(bank.labels),
        "redundant": ensemble.redundant,
        "shrunk": ensemble.shrunk,
        "skies": ensemble.skies,
    }
    variables = {name: ([f"{name}_{axis}" for axis in range(array.ndim)], array) for name, array in arrays.items()}
    write_dataset(xr.Dataset(variables, attrs=attributes), Path(path))


def load(path: Path) -> tuple[NullEnsemble, TemplateBank]:
    """Read what :func:`save` wrote."""
    with xr.open_zarr(path, chunks=None) as dataset:
        arrays = {str(name): np.asarray(values) for name, values in dataset.data_vars.items()}
        elements, beside = (
            TypeAdapter(tuple[Element, ...]).validate_json(dataset.attrs[key]) for key in ("elements", "slice_elements")
        )
        columns = TypeAdapter(tuple[Column, ...]).validate_json(dataset.attrs["columns"])
        redundant, shrunk = float(dataset.attrs["redundant"]), bool(dataset.attrs["shrunk"])
        skies = int(dataset.attrs["skies"])
    names = "matrix", "error", "curvature", "faint_share", "response_skies", "slice_matrix"
    matrix, error, curvature, *rest = map(arrays.pop, names)
    bank = TemplateBank(matrix, error, curvature, columns, *rest)
    kept = NullEnsemble(
        **arrays, elements=elements, slice_elements=beside, redundant=redundant, shrunk=shrunk, skies=skies
    )
    return kept, bank
