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
from mcsim.diagnosis import knowledge, report, tables
from mcsim.diagnosis.batch import asking, batch
from mcsim.diagnosis.case import Court, Diagnosis, court, judge
from mcsim.diagnosis.data import checked, read_maps
from mcsim.diagnosis.evidence import Questions, questions
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
        (:func:`mcsim.diagnosis.tables.read_spectra`).
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
        asked = questions(run, without, nthreads=os.cpu_count() or 1)
        maps = read_maps(asked.model, data) if isinstance(data, str | Path) else checked(asked.model, data)
        with batch(workers) as call:
            ask = asking(call, quiet)
            found = judge(prepared(run, asked, ask, simulations), name, maps, ask)
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
    measured = tables.read_spectra(path, run)
    run = tables.listening(run, measured)
    asked = tables.questions_of(run, measured, without, nthreads=os.cpu_count() or 1)
    with batch(workers) as call:
        ask = asking(call, quiet, measured)
        known = _learned(run, asked, simulations, ask, tables.plan)
        return tables.judge(court(run, asked, tables.of_mean(known, measured.realizations)), case, measured, ask)


def prepared(
    run: config.RunConfig,
    asked: Questions,
    ask: knowledge.Ask,
    simulations: int | None = None,
) -> Court:
    """What every case of a run is judged with, learned or from the cache."""
    return court(run, asked, _learned(run, asked, simulations, ask))


def _learned(
    run: config.RunConfig,
    asked: Questions,
    simulations: int | None,
    ask: knowledge.Ask,
    planned: Callable[[config.RunConfig, Questions, int | None], knowledge.Plan] = knowledge.plan,
) -> knowledge.Knowledge:
    if simulations is not None and simulations <= len(asked.entries):
        raise InputError(
            f"{simulations} simulations are too few for the {len(asked.entries)} numbers of the evidence; give at "
            f"least {2 * len(asked.entries)}, better {knowledge.PER_ENTRY * len(asked.entries)}."
        )

    def fill(scratch: Path) -> None:
        plan = planned(run, asked, simulations)
        if simulations is None:
            plan, answers = knowledge.answered(plan, len(asked.entries), ask)
        else:
            answers = ask(plan.jobs)
        knowledge.learned(asked, plan, answers).save(scratch)

    name = f"diagnose/{_key(run, asked, simulations)}.zarr"
    return knowledge.Knowledge.load(folders.cached(name, fill))


def _key(run: config.RunConfig, asked: Questions, simulations: int | None) -> str:
    """Hash of what the simulations of a model depend on; its name, seed and number of realizations are not among it."""
    science = config.science(run)
    science["ensemble"] = {}
    library = [[proposal.label, [repr(basis) for basis in proposal.basis]] for proposal in asked.proposals]
    rest = [
        METHOD,
        simulations,
        library,
        [entry.name for entry in asked.entries],
        version("ducc0"),
    ]
    return hashlib.sha256(json.dumps([science, rest], sort_keys=True).encode()).hexdigest()[:32]
