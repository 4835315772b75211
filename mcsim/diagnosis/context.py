"""What all data sets of a model are tested with, and what a data set has to offer to be diagnosed."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np

from mcsim import config
from mcsim.datavector.analysis import Analysis
from mcsim.datavector.bad_pixels import BadPixels
from mcsim.datavector.campaign import Ask, after_jobs, without_repeats
from mcsim.datavector.candidate import Candidate, TemplateBank
from mcsim.datavector.halves import Halves
from mcsim.datavector.localisation import Place
from mcsim.datavector.nuisances import with_nuisances
from mcsim.datavector.null_ensemble import NullEnsemble
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.noise_of_splits import NoiseOfSplits
from mcsim.diagnosis.shared_noise import CrossPowers
from mcsim.stats.gaussian import SimulatedGaussian, WhitenedTemplates
from mcsim.stats.look_elsewhere import Calibration, GlobalTest, global_test
from mcsim.support.arrays import Matrix, Vector
from mcsim.systematics import if_possible

Data = TypeVar("Data")


@dataclass(frozen=True)
class DiagnosisContext:
    """Hold what all data sets of a model are tested with."""

    analysis: Analysis
    ensemble: NullEnsemble
    bank: TemplateBank
    null: SimulatedGaussian  # distribution of the whole data vector
    candidates: tuple[Candidate, ...]  # with the errors of their templates
    calibration: Calibration  # of the candidates
    sky_scatter: Vector  # relative scatter of each candidate's response among skies, (candidates,)
    templates: Matrix  # (p, K), of noisy ones faint elements are shrunk
    always: WhitenedTemplates  # those of candidates that are proposed whatever the data are, white, one by one
    noise: tuple[config.Effect, ...] = ()  # with which ensemble and null distribution scatter, about the model's mean
    without_noise: "DiagnosisContext | None" = None  # what the model itself is tested with, if that is another

    @property
    def run(self) -> config.RunConfig:
        """Return the fiducial run."""
        return self.analysis.run

    @property
    def settings(self) -> DiagnosisSettings:
        """Return the settings of the analysis."""
        return self.analysis.settings

    @property
    def frame(self) -> str:
        """Return the frame that directions of effects are in: that of maps as they are made, which steps may turn."""
        return self.run.map.frame

    @cached_property
    def cross_powers(self) -> CrossPowers:
        """Return what noise that maps have in common does to the cross powers of residuals."""
        return CrossPowers(self.analysis, self.ensemble.bipolar_scan)

    @property
    def of_model(self) -> "DiagnosisContext":
        """Return what the model itself is tested with, whatever noise was found."""
        return self.without_noise or self

    def knows(self, one: config.Effect) -> bool:
        """Return True for an effect whose noise is in the scatter of the null distribution."""
        return bool(self.noise) and not without_repeats(self.noise, [one])

    @property
    def of_pixel_means(self) -> "DiagnosisContext":
        """Return what maps by the default route are tested with: they lack what the time-ordered reference has."""
        mean = self.null.mean - self.ensemble.offset
        return replace(self, ensemble=self.ensemble.without_offset, null=self.null.shift(mean))

    def extended_reference(self, found: Sequence[config.Effect]) -> Matrix:
        """Return data vectors, and the numbers beside them, of the skies with which responses are measured."""
        if any(map(self.knows, found)):
            return self.of_model.extended_reference(found)
        if self.analysis.source_of(found) is None:
            return self.ensemble.extended.reference
        assert self.ensemble.external_reference is not None  # simulated where the source can add effects
        return self.ensemble.external_reference


def context(analysis: Analysis, ensemble: NullEnsemble, bank: TemplateBank) -> DiagnosisContext:
    """Prepare the tests of data sets of a model."""
    null, scatter = ensemble.gaussian, bank.sky_scatter(ensemble.spread, analysis.candidates)
    candidates = tuple(
        # What a stochastic effect draws is not known even if the sky is.
        replace(candidate, shape_error=min(float(own), 1.0) if candidate.random_response else None)
        for candidate, own in zip(analysis.candidates, scatter, strict=True)
    )
    templates = bank.significant(ensemble.spread, analysis.settings)
    if ensemble.nuisances is not None:
        candidates, templates = with_nuisances(ensemble, null, analysis.nuisances, candidates, templates)
    groups = null.whiten_groups(templates, [candidate.columns for candidate in candidates])
    calibration = ensemble.calibration(null, groups)
    return DiagnosisContext(analysis, ensemble, bank, null, candidates, calibration, scatter, templates, groups)


def over_steps(
    candidates: Sequence[Candidate], change: Callable[[config.Effect], Matrix]
) -> Iterator[tuple[Candidate, Matrix]]:
    """Yield those that can be simulated with the mean change by each small effect over its coordinate, (p + E, K)."""
    for one in candidates:
        with if_possible():
            changes = [change(one.table(effect)).mean(axis=0) for effect in one.basis]
            yield one, np.stack(changes, axis=1) / one.steps


@dataclass(frozen=True, eq=False)
class DataSet(ABC, Generic[Data]):
    """Offer data to a diagnosis: observed maps, or measured spectra."""

    context: DiagnosisContext
    data: Data  # maps in the order of the model's, or a table
    ask: Ask  # runs further simulations, with effects at the amplitudes that are found

    @property
    @abstractmethod
    def x(self) -> Vector:
        """Return the data vector, shape (p,)."""

    @cached_property
    def gap(self) -> GlobalTest:
        """Return the test of the data against the model, with templates that were known before the data."""
        known = self.context.of_model
        return global_test(known.null, self.x, known.always, known.calibration)

    @property
    def realizations(self) -> int:
        """Return the number of skies of which the data are the mean."""
        return 1

    @property
    @abstractmethod
    def folds(self) -> tuple[str, str]:
        """Return what the two folds of the data vector are, in words."""

    @abstractmethod
    def halves(self) -> tuple[Matrix, str]:
        """Return a matrix that makes the two folds of the data vector independent, and what they are in words."""

    def in_halves(self, change: Vector) -> tuple[Halves, Matrix, str] | None:
        """Return what fits one half and tests the other, with the two of :meth:`halves`.

        None if there are no halves, or if a change of the data vector, shape (p,), hardly shows in one of them.
        """
        (matrix, words), settings = self.halves(), self.context.settings
        halves = Halves.of(self.context.ensemble.remix(matrix), matrix @ self.x)
        least = min(settings.half_snr_share * self.context.null.expected_snr(change), settings.half_snr)
        return None if halves is None or halves.expected_snr(matrix @ change) < least else (halves, matrix, words)

    @abstractmethod
    def places(self) -> list[Place]:
        """Return where the data depart from the model, the largest departure first."""

    def respond(self, found: Sequence[config.Effect], skies: int) -> Matrix:
        """Return changes of the data vector by effects, (rows, p), in ``skies`` skies or those of the reference."""
        return self.respond_extended(found, skies)[:, : len(self.x)]

    def pair_extended(self, found: Sequence[config.Effect], skies: int) -> tuple[Matrix, Matrix]:
        """Return :attr:`extended` of skies without and with effects that are simulated in the same ones, (rows, p + E).

        They are ``skies`` skies, or those of the reference.
        """
        after = self.ask(after_jobs(self.context.analysis, found))
        return self.context.extended_reference(found), np.concatenate(after)

    @property
    def extended(self) -> Vector:
        """Return the data vector with the numbers beside it behind it, if there are any."""
        return self.x

    def respond_extended(self, found: Sequence[config.Effect], skies: int) -> Matrix:
        """Return the changes of :meth:`respond` for :attr:`extended`."""
        before, after = self.pair_extended(found, skies)
        return after - before

    def typical(self, found: Sequence[config.Effect], skies: int, acting: Sequence[config.Effect]) -> Matrix:
        """Return the changes of :meth:`respond_extended` in skies that nothing constrains, the same for all effects.

        Patterns are the same as well if one simulator draws them: that of all that are ``acting``.
        """
        return self.respond_extended(found, skies)

    def responses(self, candidates: Sequence[Candidate], skies: int) -> Iterator[tuple[Candidate, Matrix]]:
        """Yield those that can be simulated with their responses to small effects over coordinates, (p + E, K)."""
        return over_steps(candidates, lambda table: self.respond_extended([table], skies))

    def scatter(self, changes: Matrix) -> Matrix:
        """Return deviations of changes by a stochastic effect, shape (draws, p), from their mean, (p, draws).

        They are those of one draw from the mean of as many as there are, as
        :meth:`~mcsim.stats.gaussian.SimulatedGaussian.with_extra_covariance` takes them.
        """
        share = (1.0 / self.realizations + 1.0 / len(changes)) / (len(changes) - 1.0)
        return np.asarray(np.sqrt(share) * (changes - changes.mean(axis=0)).T)

    def pair(self, found: Sequence[config.Effect], skies: int | None = None) -> tuple[Matrix, Matrix] | None:
        """Return data vectors of the same skies without effects and with them; None if errors do not need them.

        ``skies``: their number, where it can be chosen; None: that of the settings.
        """
        return None

    def in_same_skies(self, found: Sequence[config.Effect]) -> list[list[config.Effect]]:
        """Return the effects in groups of which each is simulated in the same skies."""
        return [list(found)]

    def changes_sky(self, found: Sequence[config.Effect]) -> bool:
        """Return True if responses to effects depend on what these have done to the sky that the data are of."""
        return False

    def dipole_snr(self, found: Sequence[config.Effect]) -> float:
        """Return the S/N of the dipole that effects leave in the only channel, whose products with its sky count."""
        return 0.0

    def templates(self) -> Matrix:
        """Return the templates for these data, shape (p, K)."""
        return self.context.templates

    @property
    def exchanged(self) -> list[str]:
        """Return sentences on orders of the maps in which the model fits, if it does not in that of the data."""
        return []

    @property
    def noise_in_common(self) -> list[str]:
        """Return a sentence on noise that maps have in common, if the model fits with it."""
        return []

    @property
    def noise_of_splits(self) -> list[NoiseOfSplits]:
        """Return the noise of the splits of each channel over that of the model, where it is measured."""
        return []

    @property
    def instead(self) -> list[str]:
        """Return sentences on what describes the data and is no effect: noise in common, or another order of maps."""
        return (self.noise_in_common if self.gap.pvalue <= self.context.settings.alpha else []) or self.exchanged

    def bad_pixels(self, found: Sequence[config.Effect]) -> BadPixels | None:
        """Return places of the data that stand out beside what effects add to them, None if there are none."""
        return None

    def without(self, bad: BadPixels) -> "DataSet | None":
        """Return the data without bad pixels; None if these are more than may be left out."""
        return self

    def notes(self) -> list[str]:
        """Return sentences on the data."""
        return []

    def residual_maps(self) -> Matrix | None:
        """Return the residual maps over the scatter of those of simulations, shape (map, npix); None without maps."""
        return None

    def provenance(self) -> dict[str, str | int]:
        """Return what the result states of the data, by name."""
        return {}
