"""Simulations of the model: the null distribution of the data vector."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from mcsim.diagnosis.summaries import Element
from mcsim.diagnosis.templates import TemplateBank
from mcsim.stats.gaussian import SimulatedGaussian


@dataclass(frozen=True)
class NullEnsemble:
    """Hold data vectors of simulations without any candidate effect.

    Attributes
    ----------
    simulations
        Shape (N, p).
    offset
        Mean of the time-ordered reference less that of the default route for the same skies, shape (p,).
    elements
        Descriptions of the p elements.
    reference
        Data vectors of the skies with which responses are measured, shape (skies, p).
    bipolar_scan
        Bipolar scan of the first simulations, shape (n, numbers).
    residual_mean, residual_scatter, residual_rms
        Mean and standard deviation of the coarse residual maps of the same, shape (map, npix), and the rms of each over
        this scatter, shape (n, map); without any element for measured spectra.
    redundant
        Directions with less than this fraction of the largest variance are left out.
    """

    simulations: NDArray[np.float64]
    offset: NDArray[np.float64]
    elements: tuple[Element, ...]
    reference: NDArray[np.float64]
    bipolar_scan: NDArray[np.float64]
    residual_mean: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    residual_scatter: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    residual_rms: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    redundant: float = 1e-4

    @cached_property
    def spread(self) -> NDArray[np.float64]:
        """Return the standard deviation of every element, shape (p,)."""
        return np.asarray(self.simulations.std(axis=0))

    @cached_property
    def gaussian(self) -> SimulatedGaussian:
        """Return the Gaussian with mean and covariance of the simulations, the mean moved by the offset."""
        return SimulatedGaussian.from_simulations(self.simulations, self.offset, self.redundant)

    def restrict(self, rows: NDArray[np.int64]) -> "NullEnsemble":
        """Return the ensemble of some elements."""
        return replace(
            self,
            simulations=self.simulations[:, rows],
            offset=self.offset[rows],
            elements=tuple(self.elements[row] for row in rows),
            reference=self.reference[:, rows],
        )

    def remix(self, matrix: NDArray[np.float64]) -> "NullEnsemble":
        """Return the ensemble of as many linear combinations of the elements, shape (p, p)."""
        return replace(
            self,
            simulations=self.simulations @ matrix.T,
            offset=matrix @ self.offset,
            reference=self.reference @ matrix.T,
        )

    def of_mean(self, realizations: int) -> "NullEnsemble":
        """Return the ensemble of the mean of several skies.

        Notes
        -----
        A mean of R skies less that of N simulations has the covariance C (1/R + 1/N); the tests take it to be 1 + 1/N
        times that of the simulations. These are contracted about their mean until it is: the tests stay exact.
        """
        count = len(self.simulations)
        scale = np.sqrt((count + realizations) / (realizations * (count + 1.0)))
        mean = self.simulations.mean(axis=0)
        return replace(self, simulations=mean + scale * (self.simulations - mean))


def save(path: Path, ensemble: NullEnsemble, bank: TemplateBank) -> None:
    """Write an ensemble and the templates to a new Zarr store."""
    dataset = xr.Dataset(
        {
            "simulations": (("simulation", "element"), ensemble.simulations, {"long_name": "data vector of the model"}),
            "offset": ("element", ensemble.offset, {"long_name": "time-ordered reference less default route"}),
            "matrix": (("element", "column"), bank.matrix, {"long_name": "response per unit coordinate"}),
            "curvature": (("element", "column"), bank.curvature, {"long_name": "half the second derivative"}),
            "error": (("element", "column"), bank.error, {"long_name": "standard error of the response"}),
            "reference": (("sky", "element"), ensemble.reference, {"long_name": "data vector of the responses' skies"}),
            "bipolar_scan": (("scanned", "number"), ensemble.bipolar_scan, {"long_name": "bipolar scan of the model"}),
            "residual_mean": (("map", "pixel"), ensemble.residual_mean, {"long_name": "mean of coarse residual maps"}),
            "residual_scatter": (
                ("map", "pixel"),
                ensemble.residual_scatter,
                {"long_name": "scatter of the same"},
            ),
            "residual_rms": (("scanned", "map"), ensemble.residual_rms, {"long_name": "rms of coarse residual maps"}),
        },
        attrs={
            "elements": json.dumps([asdict(element) for element in ensemble.elements]),
            "redundant": ensemble.redundant,
        },
    )
    dataset.to_zarr(path, mode="w", consolidated=False)


def load(path: Path) -> tuple[NullEnsemble, TemplateBank]:
    """Read what :func:`save` wrote."""
    with xr.open_zarr(path, consolidated=False) as dataset:
        arrays = {str(name): np.asarray(values) for name, values in dataset.data_vars.items()}
        elements = tuple(_element(row) for row in json.loads(dataset.attrs["elements"]))
        redundant = float(dataset.attrs["redundant"])
    bank = TemplateBank(**{name: arrays.pop(name) for name in ("matrix", "error", "curvature")})
    return NullEnsemble(**arrays, elements=elements, redundant=redundant), bank


def _element(row: Mapping[str, Any]) -> Element:
    ell = row["ell"]
    return Element(**{**row, "channels": tuple(row["channels"]), "ell": None if ell is None else tuple(ell)})
