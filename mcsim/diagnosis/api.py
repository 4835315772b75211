"""Diagnose data against a run: simulate the model once, keep the result, and test each data set."""

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim import config, systematics
from mcsim.diagnosis import campaign, measured_spectra, null_ensemble, report
from mcsim.diagnosis.analysis import Analysis, Job, analysis_of, data_vectors
from mcsim.diagnosis.batch import asking, batch
from mcsim.diagnosis.context import DataSet, DiagnosisContext, context
from mcsim.diagnosis.inference import diagnose_data
from mcsim.diagnosis.null_ensemble import NullEnsemble
from mcsim.diagnosis.observed_maps import ObservedMaps, checked, read_maps
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.diagnosis.settings import DiagnosisSettings
from mcsim.diagnosis.spectra import read_spectra
from mcsim.diagnosis.templates import TemplateBank
from mcsim.ensemble.plan import cost
from mcsim.errors import InputError
from mcsim.simulation import power
from mcsim.support import folders
from mcsim.support.code import class_digest, package_digest

Plan = Callable[[config.RunConfig, Analysis, int | None], campaign.Plan]

CODE = ("config", "sphere", "stats", "instrument", "systematics", "bipolar", "simulation", "beamfit", "diagnosis")
LIBRARIES = ("ducc0", "healpy", "numpy", "scipy")
"""What the simulations of a model and their data vectors are computed with."""


def diagnose(
    model: str | Path | Mapping[str, Any] | config.RunConfig,
    data: str | Path | Sequence[NDArray[np.float64]],
    output: str | Path | None = None,
    *,
    case: str | None = None,
    without: Sequence[str] = (),
    simulations: int | None = None,
    settings: DiagnosisSettings | None = None,
    workers: int | None = None,
    quiet: bool = True,
) -> DiagnosisResult:
    """Diagnose the gap between a simulation and data.

    Parameters
    ----------
    model
        Fiducial model of sky, beams, scan and noise: a run.
    data
        Folder with ``{channel}.fits`` or ``{channel}_{split}.fits``, uK; or the maps themselves, shape (npix,) each, in
        the order channel by channel, split by split; or a table of measured spectra
        (:func:`mcsim.diagnosis.spectra.read_spectra`).
    output
        Folder for ``verdict.json``, ``diagnosis.zarr`` and ``report.html``; None: nothing is written.
    case
        Name; default: that of the run.
    without
        Effects of the library that are no candidates.
    simulations
        Number for the covariance of the data vector; default: ten for every independent element.
    settings
        Levels, cuts, bins and numbers of simulations; default: those of :class:`DiagnosisSettings`.
    workers
        Processes; default: the run's; 0: this one.
    quiet
        Report no progress.

    Returns
    -------
    DiagnosisResult
        Verdict, fits, tests, and the arrays behind them.

    Raises
    ------
    InputError
        If a run or data cannot be used.
    """
    run = model if isinstance(model, config.RunConfig) else config.load(model)
    for effect in without:
        systematics.get(effect)
    if output is not None:
        folders.writable(Path(output))
    threads = os.cpu_count() or 1
    task: Callable[[Job], NDArray[np.float64]] = data_vectors
    table = read_spectra(data, run) if isinstance(data, str | Path) and Path(data).is_file() else None
    if table is not None:
        run, task = measured_spectra.estimator_for(run, table), table
        analysis = measured_spectra.analysis_of_spectra(run, table, without, threads, settings)
    else:
        analysis = analysis_of(run, without, threads, settings)
    power.check(analysis.model.survey)
    maps: Sequence[NDArray[np.float64]] = ()
    if table is None:
        maps = read_maps(analysis.model, data) if isinstance(data, str | Path) else checked(analysis.model, data)
    with batch(run.compute.workers if workers is None else workers) as call:
        with asking(call, quiet, task, "simulations of the model and of each effect") as ask:
            plan = campaign.plan if table is None else measured_spectra.plan
            ensemble, bank = _learned(run, analysis, simulations, ask, plan)
        with asking(call, quiet, task, "simulations of fitted effects") as ask:
            known = context(run, analysis, ensemble if table is None else ensemble.of_mean(table.realizations), bank)
            found: DataSet
            if table is not None:
                found = measured_spectra.MeasuredSpectra(known, table, ask)
            else:
                found = ObservedMaps(known, maps, ask)
            diagnosis = diagnose_data(found, case or run.name)
    if table is None:
        diagnosis = replace(diagnosis, warnings=_warnings(analysis))
    if output is not None:
        diagnosis.save(output)
        report.write(diagnosis, Path(output) / "report.html")
    return diagnosis


def describe(
    model: str | Path | Mapping[str, Any] | config.RunConfig,
    without: Sequence[str] = (),
    simulations: int | None = None,
    workers: int | None = None,
) -> str:
    """Return a text on the cost of a diagnosis of maps: simulations, memory, time, and that of preparing the maps."""
    run = model if isinstance(model, config.RunConfig) else config.load(model)
    analysis = analysis_of(run, without, os.cpu_count() or 1)
    power.check(analysis.model.survey)
    count = sum(job.count for job in campaign.plan(run, analysis, simulations).jobs)
    each, processes = cost(run, range(count)), workers or run.compute.workers
    hours = count * each.seconds_per_realization / 3600.0
    lines = [
        f"{run.name}: at most {count} simulations before data, for a data vector of {len(analysis.elements)}",
        f"  memory  {each.worker_bytes / 1e9:.2f} GB per worker, {processes} workers",
        *([f"  prepare {each.preparation}"] if each.preparation else []),
        f"  time    {each.seconds_per_realization:.3g} s per simulation and core, {hours:.3g} core-hours,"
        f" {60.0 * hours / processes:.3g} minutes with {processes} workers on as many idle cores",
    ]
    return "\n".join(lines)


def _warnings(analysis: Analysis) -> tuple[str, ...]:
    """Return a sentence on sky power that maps of a real sky hold and the simulations lack, if there is any."""
    found = power.neglected(analysis.model.survey)
    return () if found is None else (f"{found} Simulated data whose own sky ends there are not concerned.",)


def prepared(
    run: config.RunConfig,
    analysis: Analysis,
    ask: campaign.Ask,
    simulations: int | None = None,
) -> DiagnosisContext:
    """Return what every set of maps is tested with, simulated or from the cache."""
    return context(run, analysis, *_learned(run, analysis, simulations, ask))


def _learned(
    run: config.RunConfig,
    analysis: Analysis,
    simulations: int | None,
    ask: campaign.Ask,
    planned: Plan = campaign.plan,
) -> tuple[NullEnsemble, TemplateBank]:
    size = len(analysis.elements)
    if simulations is not None and simulations <= size:
        raise InputError(
            f"{simulations} simulations are too few for the {size} elements of the data vector; give at least "
            f"{2 * size}, better {analysis.settings.sims_per_element * size}."
        )

    def fill(scratch: Path) -> None:
        plan = planned(run, analysis, simulations)
        if simulations is None:
            plan, results = campaign.simulated(plan, analysis, ask)
        else:
            results = ask(plan.jobs)
        null_ensemble.save(scratch, *campaign.learned(analysis, plan, results))

    return null_ensemble.load(folders.cached(f"diagnose/{_key(run, analysis, simulations)}.zarr", fill))


def _key(run: config.RunConfig, analysis: Analysis, simulations: int | None) -> str:
    """Return a hash of all that the simulations of a model depend on, the code that makes them included.

    Its name, its seed and its number of realizations do not count.
    """
    science = config.science(run)
    science["ensemble"] = {}
    effects = {candidate.effect for candidate in analysis.candidates}
    effects |= {systematics.get(effect.name) for effect in run.effects}
    rest = [
        simulations,
        [[candidate.label, [repr(basis) for basis in candidate.basis]] for candidate in analysis.candidates],
        asdict(analysis.settings),
        [element.name for element in analysis.elements],
        sorted(class_digest(kind) for kind in effects),
        package_digest((f"mcsim.{name}" for name in CODE), LIBRARIES),
    ]
    return hashlib.sha256(json.dumps([science, rest], sort_keys=True).encode()).hexdigest()[:32]
