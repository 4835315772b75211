"""Measured spectra as a data set: a table of binned BipoSH coefficients, or C_l, against simulations of the model."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mcsim import config, systematics
from mcsim.beamfit.data import parts
from mcsim.bipolar import Mode
from mcsim.diagnosis import campaign
from mcsim.diagnosis.analysis import Analysis, Job, analysis_of
from mcsim.diagnosis.campaign import Ask, Plan
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.diagnosis.places import Place, places
from mcsim.diagnosis.selection import Attribution
from mcsim.diagnosis.settings import DiagnosisSettings
from mcsim.diagnosis.spectra import Spectra
from mcsim.diagnosis.summaries import Block, Element
from mcsim.errors import InputError
from mcsim.sphere.rotation import FRAMES, rotate_biposh
from mcsim.systematics import Effect

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_SPECTRAL_HOOKS = ("sky", "beam", "pointing", "spread", "orientations", "noise")
"""Hooks that change spectra of a map. A drift of the gain does so in the lowest degrees only and is no candidate."""


def estimator_for(run: config.RunConfig, measured: Spectra) -> config.RunConfig:
    """Return the run with the estimator that a table needs: its L, its pairs, and no circular-beam control."""
    both = any(name.partition(",")[0] != name.partition(",")[2] for name in measured.pairs)
    biposh = replace(run.biposh, L_max=max(row.mode.L for row in measured.rows), pairs="all" if both else "auto")
    return replace(run, biposh=biposh, ensemble=replace(run.ensemble, paired=False, keep_maps=False))


def analysis_of_spectra(
    run: config.RunConfig,
    measured: Spectra,
    without: Sequence[str] = (),
    nthreads: int = 1,
    settings: DiagnosisSettings | None = None,
) -> Analysis:
    """Define the analysis of a table: effects that change spectra, and the numbers of the table as data vector."""
    excluded = [name for name, kind in systematics.catalogue().items() if not _changes_spectra(kind)]
    analysis = analysis_of(run, (*without, *excluded), nthreads, settings)
    return replace(analysis, blocks=(Block(measured.elements, lambda model, filtered: measured.value),))


def _changes_spectra(kind: type[Effect]) -> bool:
    return any(getattr(kind, hook) is not getattr(Effect, hook) for hook in _SPECTRAL_HOOKS)


def plan(run: config.RunConfig, analysis: Analysis, simulations: int | None = None) -> Plan:
    """List all simulations for a table: of the model, and of the same skies with every effect and without it."""
    whole = campaign.plan(run, analysis, simulations, time_ordered=False)
    count = analysis.settings.table_skies
    jobs = (
        replace(job, count=count) if purpose[0] == "response" else job
        for job, purpose in zip(whole.jobs, whole.purposes, strict=True)
    )
    return Plan(tuple(jobs), whole.purposes)


@dataclass(frozen=True)
class TableResponses:
    """Simulate responses of measured spectra to effects, over the skies with which templates are measured."""

    context: DiagnosisContext
    ask: Ask

    def __call__(self, found: Sequence[config.Effect], skies: int) -> Matrix:
        """Return changes of the data vector, shape (rows, p), in the skies of the reference, whatever ``skies`` is."""
        reference = self.context.ensemble.reference
        after = np.concatenate(self.ask(self._jobs(found)))
        changes: Matrix = after - reference[: len(after)]
        return changes

    def pair(self, found: Sequence[config.Effect]) -> None:
        """Return None: the errors of the fit are those of the table's simulations."""

    def _jobs(self, found: Sequence[config.Effect]) -> list[Job]:
        planned = plan(self.context.run, self.context.analysis, 0)
        return [
            replace(job, simulated=config.to_json(campaign.with_effects(config.from_json(job.simulated), found)))
            for job, purpose in zip(planned.jobs, planned.purposes, strict=True)
            if purpose[0] == "reference"
        ]


@dataclass(frozen=True, eq=False)
class MeasuredSpectra:
    """Offer a table of spectra as a data set; see :class:`mcsim.diagnosis.context.DataSet`.

    Attributes
    ----------
    context
        Model, simulations, contracted by :meth:`~mcsim.diagnosis.null_ensemble.NullEnsemble.of_mean`, and templates.
    measured
        The table.
    ask
        Runs further simulations, with effects at the amplitudes that are found.

    Raises
    ------
    InputError
        If the numbers cannot be in the unit, or the mean of as many skies, as the table says.

    Notes
    -----
    The covariance is always that of simulations of the model, over the number of skies behind the mean: errors in a
    table say nothing of correlations. They are only compared with it, in a note. The reduction is fitted to every other
    bin and tested with the others. What the former predict of the latter, where simulations find them correlated, is
    subtracted; the correlation that remains is stated. Rotated to other frames are only spectra with every M, real and
    imaginary.
    """

    context: DiagnosisContext
    measured: Spectra
    ask: Ask

    def __post_init__(self) -> None:
        """Refuse what the table cannot be."""
        _check(self.measured, self.context)

    @property
    def realizations(self) -> int:
        """Return the number of skies of which the values are the mean."""
        return self.measured.realizations

    @property
    def x(self) -> Vector:
        """Return the values of the table."""
        return self.measured.value

    @cached_property
    def respond(self) -> TableResponses:
        """Return what simulates responses."""
        return TableResponses(self.context, self.ask)

    def templates(self) -> Matrix:
        """Return the templates."""
        return self.context.templates

    def exchanged(self, found: Attribution) -> list[str]:
        """Return nothing: a table has no maps to exchange."""
        return []

    def notes(self) -> list[str]:
        """Return a sentence if the table's errors are far from the scatter of the simulations."""
        ratio = float(np.median(self.measured.error / self.context.ensemble.simulations.std(axis=0, ddof=1)))
        if not np.isfinite(ratio) or 0.5 < ratio < 2.0:
            return []
        return [
            f"The table's errors are {ratio:.2g} times the scatter of simulations of the model for a mean of "
            f"{self.realizations} skies; the latter was used."
        ]

    def halves(self) -> tuple[Matrix, str]:
        """Return the matrix that subtracts from elements of fold 1 what those of fold 0 predict, and words."""
        ensemble = self.context.ensemble
        folds = np.array([element.fold for element in ensemble.elements])
        used, fresh = np.flatnonzero(folds == 0), np.flatnonzero(folds == 1)
        count, size = len(ensemble.simulations), len(folds)
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
        measured, simulations = self.measured, self.context.ensemble.simulations
        views = list(_views(measured))
        matrix = np.stack([np.zeros(len(measured.rows)), *(row for _, row in views)])[1:]
        drawn = np.concatenate([simulations, simulations @ matrix.T], axis=1)
        elements = (*measured.elements, *(element for element, _ in views))
        values = np.concatenate([measured.value, matrix @ measured.value])
        return places(values, drawn, elements, self.context.settings.place_pvalue)

    def residual_maps(self) -> None:
        """Return None: there are no maps."""

    def provenance(self) -> dict[str, str | int]:
        """Return the file of the table, and the number of skies."""
        return {"table": self.measured.path, "skies behind the mean": self.realizations}


def _check(measured: Spectra, context: DiagnosisContext) -> None:
    limits = context.settings
    power = np.array([row.mode.L == 0 for row in measured.rows])
    size = np.abs(measured.value) / np.sqrt(np.mean(context.ensemble.simulations**2, axis=0))
    unit = "is the unit in its header the right one, and the scaling?"
    if power.any() and not 1.0 / limits.cl_ratio < np.median(size[power]) < limits.cl_ratio:
        raise InputError(
            f"{measured.path}: C_l are {np.median(size[power]):.2g} times the model's, beyond {limits.cl_ratio:g}; "
            f"{unit}"
        )
    if not power.all() and np.median(size[~power]) > limits.biposh_ratio:
        raise InputError(
            f"{measured.path}: BipoSH are {np.median(size[~power]):.2g} times as large as the simulations', beyond "
            f"{limits.biposh_ratio:g}; {unit}"
        )
    if 1.0 - context.null.pvalue(measured.value) < limits.small_chi2_pvalue:
        raise InputError(
            f"{measured.path} departs from the model by chi^2 = {context.null.chi2(measured.value):.2g} in "
            f"{context.null.dimension} numbers, far less than a mean of {measured.realizations} skies can; say of how "
            "many in its meta (realizations), or correct its unit."
        )


def _views(measured: Spectra) -> Iterator[tuple[Element, Vector]]:
    """Yield M = 0 in other frames, if the table has every M: its description, and its weights of the values."""
    at = {(pair, row): i for i, (pair, row) in enumerate(zip(measured.pairs, measured.rows, strict=True))}
    for (pair, row), number in at.items():
        mode = row.mode
        if mode.L == 0 or mode.M > 0:
            continue
        family = [Mode(mode.L, M, mode.d) for M in range(mode.L + 1)]
        needed = [(m, part, at.get((pair, row._replace(mode=m, imaginary=part)))) for m in family for part in parts(m)]
        if any(i is None for _, _, i in needed):
            continue
        unit = np.zeros((len(measured.rows), len(family), 1), dtype=np.complex128)
        for m, part, i in needed:
            unit[i, m.M, 0] = 1j if part else 1.0
        for frame in FRAMES:
            if frame != measured.frame:
                turned = rotate_biposh(unit, [(m.L, m.M, m.d) for m in family], measured.frame, frame)[:, 0, 0]
                own = measured.elements[number]
                yield (
                    replace(own, name=f"{own.name} {frame}", frame=frame),
                    turned.imag if row.imaginary else turned.real,
                )
