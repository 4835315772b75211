"""Measured spectra as a data set: a table of binned BipoSH coefficients, or C_l, against simulations of the model."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mcsim import config
from mcsim.datavector.campaign import after_jobs
from mcsim.datavector.localisation import Place, places
from mcsim.datavector.spectra_table import Spectra
from mcsim.diagnosis.context import DataSet
from mcsim.diagnosis.output import DIGEST, digest
from mcsim.errors import InputError
from mcsim.support.arrays import Matrix, Vector

MORE = 16  #: times as many skies as otherwise over which a response is averaged at most
KNOWN = 0.15  #: error of an amplitude by the response that is not known, over its error by the data, up to which it is


@dataclass(frozen=True, eq=False)
class MeasuredSpectra(DataSet[Spectra]):
    """Offer a table of spectra as a data set.

    The simulations in its context are contracted by :meth:`~mcsim.datavector.null_ensemble.NullEnsemble.of_mean`.

    Notes
    -----
    The covariance is always that of simulations of the model, over the number of skies behind the mean: errors in a
    table say nothing of correlations. They are only compared with it, in a note. The reduction is fitted to every other
    bin and tested with the others. What the former predict of the latter, where simulations find them correlated, is
    subtracted; the correlation that remains is stated. Rotated to other frames are only spectra with every M, real and
    imaginary. A mean of many skies may have smaller errors than a response over a few: this is averaged over twice as
    many, and again, until it has none to speak of beside them (:data:`KNOWN`).
    """

    _without: dict[range, Matrix] = field(default_factory=dict, init=False, repr=False)  # effects, by their skies

    def __post_init__(self) -> None:
        """Refuse numbers that cannot be in the unit, or the mean of as many skies, as the table says."""
        measured, context, limits = self.data, self.context, self.context.settings
        path, value = measured.path, measured.value
        power = np.array([row.mode.L == 0 for row in measured.rows])
        size = np.abs(value) / np.sqrt(np.mean(context.ensemble.simulations**2, axis=0))
        unit = "is the unit in its header the right one, and the scaling?"
        if power.any() and not 1.0 / limits.cl_ratio < (ratio := np.median(size[power])) < limits.cl_ratio:
            factor = f"beyond a factor of {limits.cl_ratio:g} either way"
            raise InputError(f"{path}: C_l are {ratio:.2g} times the model's, {factor}; {unit}")
        if not power.all() and (ratio := np.median(size[~power])) > limits.biposh_ratio:
            raise InputError(
                f"{path}: BipoSH are {ratio:.2g} times as large as the simulations', beyond {limits.biposh_ratio:g}; "
                f"{unit}"
            )
        if 1.0 - context.null.pvalue(value) < limits.small_chi2_pvalue:
            raise InputError(
                f"{path} departs from the model by chi^2 = {context.null.chi2(value):.2g} in {context.null.dimension} "
                f"numbers, far less than a mean of {measured.realizations} skies can; say of how many in its meta "
                "(realizations), or correct its unit."
            )

    @property
    def realizations(self) -> int:
        """Return the number of skies of which the values are the mean."""
        return self.data.realizations

    @property
    def x(self) -> Vector:
        """Return the values of the table, shape (p,)."""
        return self.data.value

    def pair_extended(self, found: Sequence[config.Effect], skies: int) -> tuple[Matrix, Matrix]:
        """Return data vectors of skies without and with effects, of as many as it takes for their mean difference."""
        before, after = super().pair_extended(found, skies)
        analysis, kinds = self.context.analysis, dict(self.context.analysis.library)
        drawn = any(kinds[one.name].parametrization.stochastic for one in found)  # its scatter is its own
        most = MORE * len(after)
        while not drawn and len(after) < most and not self._is_known(after - before):
            more = range(len(after), min(2 * len(after), most))
            if more not in self._without:
                self._without[more] = np.concatenate(self.ask(after_jobs(analysis, (), more)))
            before = np.concatenate([before, self._without[more]])
            after = np.concatenate([after, *self.ask(after_jobs(analysis, found, more))])
        return before, after

    def typical(self, found: Sequence[config.Effect], skies: int, acting: Sequence[config.Effect]) -> Matrix:
        """Return the changes by effects in the skies of the reference alone, whatever number is asked for."""
        before, after = super().pair_extended(found, skies)
        return after - before

    def _is_known(self, changes: Matrix) -> bool:
        """Return True if the mean of changes, shape (skies, p), is known well beside the errors of the data.

        What scatters along it changes the amplitude; what scatters across it is fitted less by the data than it is
        large, and the amplitude is smaller by this part of the square.
        """
        null = self.context.null
        white = np.sqrt(null.hartlap_factor) * null.whiten_templates(changes.T)
        mean, scatter = white.mean(axis=1), white.var(axis=1, ddof=1).sum() / len(changes)
        size = max(float(np.linalg.norm(mean)), 1e-300)
        along = float(np.std(mean @ white, ddof=1)) / size / np.sqrt(len(changes))
        return bool(np.hypot(along, scatter / size) <= KNOWN and scatter <= KNOWN * np.sqrt(2.0 * null.dimension))

    def notes(self) -> list[str]:
        """Return a sentence if the table's errors are far from the scatter of the simulations."""
        ratios = self.data.error / self.context.ensemble.simulations.std(axis=0, ddof=1)
        ratios = ratios[np.isfinite(ratios)]
        if not len(ratios) or 0.5 < (ratio := np.median(ratios)) < 2.0:
            return []
        return [
            f"The table's errors are {ratio:.2g} times the scatter of simulations of the model for a mean of "
            f"{self.realizations} skies; the latter was used."
        ]

    @property
    def folds(self) -> tuple[str, str]:
        """Return words for the bins of fold 0, and for those of fold 1."""
        return "every other bin", "the bins between"

    def halves(self) -> tuple[Matrix, str]:
        """Return the matrix that subtracts from elements of fold 1 what those of fold 0 predict, and words."""
        ensemble = self.context.ensemble
        used, fresh = ensemble.folds
        count, size = len(ensemble.simulations), len(ensemble.elements)
        turn = np.eye(size)
        if not len(used) or not len(fresh):
            return turn, ""
        r = np.corrcoef(ensemble.simulations.T).reshape(size, size)[np.ix_(fresh, used)]
        rms, chance = float(np.sqrt(np.mean(r**2))), 1.0 / np.sqrt(count)
        words = f"alternate bins (frozen on the others; rms correlation {rms:.3f}, by chance {chance:.3f}"
        correlated = np.any(np.abs(r) > self.context.settings.correlated_sigma * chance, axis=0)
        if correlated.any():
            known = used[correlated]
            centred = ensemble.simulations - ensemble.simulations.mean(axis=0)
            slopes = np.linalg.lstsq(centred[:, known], centred[:, fresh], rcond=None)[0]
            turn[np.ix_(fresh, known)] = -slopes.T
            words += f"; what {len(known)} of them predict is subtracted"
        return turn, words + ")"

    def places(self) -> list[Place]:
        """Rank the numbers of the table, and their rotations to other frames."""
        measured, simulations = self.data, self.context.ensemble.simulations
        views = list(measured.views())
        matrix = np.stack([np.zeros(len(measured.rows)), *(row for _, row in views)])[1:]
        drawn = np.concatenate([simulations, simulations @ matrix.T], axis=1)
        elements = (*measured.elements, *(element for element, _ in views))
        values = np.concatenate([measured.value, matrix @ measured.value])
        return places(values, drawn, elements, self.context.settings.place_pvalue)

    def provenance(self) -> dict[str, str | int]:
        """Return the file of the table, the hash of its values, and the number of skies."""
        return {"table": self.data.path, DIGEST: digest([self.data.value]), "skies behind the mean": self.realizations}
