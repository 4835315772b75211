"""Diagnose maps against a run: learn the model on a cluster, once, and judge the case."""

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim import config, systematics
from mcsim.diagnosis import knowledge, report, spectra
from mcsim.diagnosis.analysis import Analysis, analysis_of
from mcsim.diagnosis.batch import asking, batch
from mcsim.diagnosis.inference import Diagnosis, DiagnosisContext, context, diagnose_maps
from mcsim.diagnosis.observed_maps import checked, read_maps
from mcsim.errors import InputError
from mcsim.support import folders

METHOD = 7
"""Raised whenever the same model would teach something else."""


def diagnose(
    model: str | Path | Mapping[str, Any] | config.RunConfig,
    data: str | Path | Sequence[NDArray[np.float64]],
    output: str | Path | None = None,
    *,
    case: str | None = None,
    without: Sequence[str] = (),
    simulations: int | None = None,
    workers: int | None = None,
    quiet: bool = True,
) -> Diagnosis:
    """Diagnose the gap between a simulation and data.

    Parameters
    ----------
    model
        A run: what is believed about sky, beams, scan and noise.
    data
        Folder with ``{channel}.fits`` or ``{channel}_{split}.fits``, uK; or the maps themselves, shape (npix,) each, in
        the order channel by channel, split by split; or a table of measured spectra
        (:func:`mcsim.diagnosis.spectra.read_spectra`).
    output
        Folder for ``verdict.json``, ``evidence.zarr`` and ``report.html``; None: nothing is written.
    case
        Name; default: that of the run.
    without
        Effects of the library that are not to be proposed.
    simulations
        Number for the scatter of the evidence; default: ten for every number of it.
    workers
        Processes; default: the run's; 0: this one.
    quiet
        Report no progress.

    Returns
    -------
    Diagnosis
        Verdict, evidence, attribution.

    Raises
    ------
    InputError
        For a run or data that cannot be used.
    """
    run = model if isinstance(model, config.RunConfig) else config.load(model)
    for effect in without:
        systematics.get(effect)
    if output is not None:
        folders.writable(Path(output))
    name, workers = case or run.name, run.compute.workers if workers is None else workers
    if isinstance(data, str | Path) and Path(data).is_file():
        found = _of_table(run, data, name, without, simulations, workers, quiet)
    else:
        analysis = analysis_of(run, without, nthreads=os.cpu_count() or 1)
        maps = read_maps(analysis.model, data) if isinstance(data, str | Path) else checked(analysis.model, data)
        with batch(workers) as call:
            ask = asking(call, quiet)
            found = diagnose_maps(prepared(run, analysis, ask, simulations), name, maps, ask)
    if output is not None:
        found.save(output)
        report.write(found, Path(output) / "report.html")
    return found


def _of_table(
    run: config.RunConfig,
    path: str | Path,
    case: str,
    without: Sequence[str],
    simulations: int | None,
    workers: int,
    quiet: bool,
) -> Diagnosis:
    measured = spectra.read_spectra(path, run)
    run = spectra.estimator_for(run, measured)
    analysis = spectra.analysis_of_spectra(run, measured, without, nthreads=os.cpu_count() or 1)
    with batch(workers) as call:
        ask = asking(call, quiet, measured)
        known = _learned(run, analysis, simulations, ask, spectra.plan)
        return spectra.diagnose_maps(
            context(run, analysis, spectra.of_mean(known, measured.realizations)), case, measured, ask
        )


def prepared(
    run: config.RunConfig,
    analysis: Analysis,
    ask: knowledge.Ask,
    simulations: int | None = None,
) -> DiagnosisContext:
    """What every case of a run is judged with, learned or from the cache."""
    return context(run, analysis, _learned(run, analysis, simulations, ask))


def _learned(
    run: config.RunConfig,
    analysis: Analysis,
    simulations: int | None,
    ask: knowledge.Ask,
    planned: Callable[[config.RunConfig, Analysis, int | None], knowledge.Plan] = knowledge.plan,
) -> knowledge.Knowledge:
    if simulations is not None and simulations <= len(analysis.elements):
        raise InputError(
            f"{simulations} simulations are too few for the {len(analysis.elements)} numbers of the evidence; give at "
            f"least {2 * len(analysis.elements)}, better {knowledge.PER_ENTRY * len(analysis.elements)}."
        )

    def fill(scratch: Path) -> None:
        plan = planned(run, analysis, simulations)
        if simulations is None:
            plan, answers = knowledge.answered(plan, len(analysis.elements), ask)
        else:
            answers = ask(plan.jobs)
        knowledge.learned(analysis, plan, answers).save(scratch)

    name = f"diagnose/{_key(run, analysis, simulations)}.zarr"
    return knowledge.Knowledge.load(folders.cached(name, fill))


def _key(run: config.RunConfig, analysis: Analysis, simulations: int | None) -> str:
    """Hash of what the simulations of a model depend on; its name, seed and number of realizations are not among it."""
    science = config.science(run)
    science["ensemble"] = {}
    library = [[proposal.label, [repr(basis) for basis in proposal.basis]] for proposal in analysis.proposals]
    rest = [
        METHOD,
        simulations,
        library,
        [element.name for element in analysis.elements],
        version("ducc0"),
    ]
    return hashlib.sha256(json.dumps([science, rest], sort_keys=True).encode()).hexdigest()[:32]
