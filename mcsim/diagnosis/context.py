"""What all data sets of a model are tested with, and what a data set has to offer to be diagnosed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.diagnosis.analysis import Analysis
from mcsim.diagnosis.campaign import skies
from mcsim.diagnosis.candidate import Candidate
from mcsim.diagnosis.null_ensemble import NullEnsemble
from mcsim.diagnosis.places import Place
from mcsim.diagnosis.selection import Attribution
from mcsim.diagnosis.settings import DiagnosisSettings
from mcsim.diagnosis.templates import TemplateBank
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.stats.look_elsewhere import Calibration, calibrate

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class DiagnosisContext:
    """Hold what all data sets of a model are tested with.

    Attributes
    ----------
    run, analysis
        Fiducial model and its analysis.
    ensemble, bank
        Its simulations, and the templates of the candidates.
    null
        Distribution of the whole data vector.
    candidates, calibration
        Candidates with the errors of their templates, and their calibration.
    sky_scatter
        Relative scatter of each candidate's response among skies, shape (candidates,).
    """

    run: config.RunConfig
    analysis: Analysis
    ensemble: NullEnsemble
    bank: TemplateBank
    null: SimulatedGaussian
    candidates: tuple[Candidate, ...]
    calibration: Calibration
    sky_scatter: Vector

    @property
    def settings(self) -> DiagnosisSettings:
        """Return the settings of the analysis."""
        return self.analysis.settings

    @property
    def templates(self) -> Matrix:
        """Return the templates, shape (p, K), noisy ones without the elements that are only noise."""
        return self.bank.significant(self.ensemble.spread, self.settings)


def context(run: config.RunConfig, analysis: Analysis, ensemble: NullEnsemble, bank: TemplateBank) -> DiagnosisContext:
    """Prepare the tests of data sets of a model."""
    null = ensemble.gaussian
    counts = [skies(candidate, analysis.model.lmax, analysis.settings) for candidate in analysis.candidates]
    scatter = bank.sky_scatter(ensemble.spread, analysis.candidates, counts)
    candidates = tuple(
        # What a stochastic effect draws is not known even if the sky is.
        replace(candidate, shape_error=min(float(own), 1.0) if candidate.random_response else None)
        for candidate, own in zip(analysis.candidates, scatter, strict=True)
    )
    templates = bank.significant(ensemble.spread, analysis.settings)
    groups = null.whiten_groups(templates, [candidate.columns for candidate in candidates])
    return DiagnosisContext(run, analysis, ensemble, bank, null, candidates, calibrate(null, groups), scatter)


class Responder(Protocol):
    """Simulate how the data vector responds to effects."""

    def __call__(self, found: Sequence[config.Effect], skies: int) -> Matrix:
        """Return the changes of the data vector in simulated skies, shape (rows, p)."""

    def pair(self, found: Sequence[config.Effect]) -> tuple[Matrix, Matrix] | None:
        """Return data vectors of the same skies without the effects and with them; None if errors do not need them."""


class DataSet(Protocol):
    """Offer data to a diagnosis: observed maps, or measured spectra."""

    @property
    def context(self) -> DiagnosisContext:
        """Return the model, its simulations and templates."""

    @property
    def x(self) -> Vector:
        """Return the data vector, shape (p,)."""

    @property
    def realizations(self) -> int:
        """Return the number of skies of which the data are the mean."""

    @property
    def respond(self) -> Responder:
        """Return what simulates responses to effects for these data."""

    def templates(self) -> Matrix:
        """Return the templates for these data, shape (p, K)."""

    def exchanged(self, found: Attribution) -> list[str]:
        """Return sentences on orders of the maps in which the model fits better than any effect explains."""

    def notes(self) -> list[str]:
        """Return sentences on the data."""

    def halves(self) -> tuple[Matrix | None, str]:
        """Return a matrix that makes the two folds of the data vector independent, and what they are in words."""

    def places(self) -> list[Place]:
        """Return where the data depart from the model, the largest departure first."""

    def residual_maps(self) -> Matrix | None:
        """Return the residual maps over the scatter of those of simulations, shape (map, npix); None without maps."""

    def provenance(self) -> dict[str, str | int]:
        """Return what the result states of the data, by name."""
