"""Diagnose data against a run: simulate the model once, keep the result, and test each data set."""

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim import config, systematics
from mcsim.datavector import campaign, cost, null_ensemble, spectra_table
from mcsim.datavector.analysis import Analysis, Job, analysis_of, check_asked, data_vectors
from mcsim.datavector.campaign import asking, batch
from mcsim.datavector.candidate import TemplateBank
from mcsim.datavector.kept import Kept
from mcsim.datavector.map_checks import (
    check_pixels,
    check_splits_differ,
    check_subtracted,
    checked_maps,
    given_maps,
    of_pixel_means,
    warn_of_no_noise,
    warn_of_parts_of_pixels,
)
from mcsim.datavector.null_ensemble import NullEnsemble
from mcsim.datavector.seeds import Checked
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.spectra_table import read_spectra
from mcsim.diagnosis import controls, report, unlisted, words
from mcsim.diagnosis.agreement import agreement
from mcsim.diagnosis.context import DataSet, DiagnosisContext, context
from mcsim.diagnosis.measured_spectra import MeasuredSpectra
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.output import check_outside, check_replaced, digest
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.diagnosis.verdict import diagnosed
from mcsim.ensemble.external import ExternalModel, loaded
from mcsim.ensemble.external_maps import Source
from mcsim.ensemble.runner import Workers, load_ahead
from mcsim.errors import InputError
from mcsim.reconstruction import simulated_scores
from mcsim.simulation import power
from mcsim.support import folders
from mcsim.support.arrays import Map
from mcsim.support.code import LIBRARIES, class_digest, package_digest
from mcsim.support.settings import settings_of

CODE = ("config", "sphere", "stats", "instrument", "systematics", "bipolar", "simulation", "beamfit", "datavector")
"""What the simulations of a model and their data vectors are computed with."""

EXTERNAL = ("external", "external_maps")  #: modules of ``ensemble`` by which those of another simulator are read


def diagnose(
    model: str | Path | Mapping[str, Any] | config.RunConfig | ExternalModel,
    data: str | Path | Sequence[NDArray[np.float64]] | Mapping[str, NDArray[np.float64]],
    output: str | Path | None = None,
    *,
    case: str | None = None,
    settings: DiagnosisSettings | None = None,
    quiet: bool = True,
    workers: Workers | None = None,
) -> DiagnosisResult:
    """Diagnose the gap between a simulation and data.

    Parameters
    ----------
    model
        Fiducial model of sky, beams, scan and noise: a run. With a simulator of another program, or its stored maps, in
        place of mcsim's: an :class:`mcsim.ExternalModel`, or a run with ``simulator`` or ``ensemble.maps``.
    data
        Folder with ``{channel}.fits`` or ``{channel}_{split}.fits``, uK; or the maps themselves, shape (npix,) each, by
        name ("W1:half1") or channel by channel, split by split; or a table of measured spectra
        (:func:`mcsim.datavector.spectra_table.read_spectra`).
    output
        Folder for ``verdict.json``, ``diagnosis.zarr`` and ``report.html``, in place of those of an earlier diagnosis
        of this case and these data; None: nothing is written.
    case
        Name; default: that of the run.
    settings
        Library of effects, those that are no candidates, levels, cuts, bins, numbers of simulations and of controls;
        default: those of :class:`~mcsim.datavector.settings.DiagnosisSettings`.
    quiet
        Report no progress.
    workers
        Number of processes that simulate, 0 for this one; default: the ``compute.workers`` of the run. Or the address
        of a running Dask scheduler, or a ``distributed.Client``, whose workers share the file system.

    Returns
    -------
    DiagnosisResult
        Verdict (``kind``), fits, tests, and the arrays behind them. ``test.pvalue`` is the global p-value; the effects
        of ``sets[0]`` have ``name``, ``channel``, ``amplitude``, ``sigma`` and ``unit``. Its ``open(output)`` reads it
        again.

    Raises
    ------
    InputError
        If a run, data or settings cannot be used.
    RunError
        If a simulator of another program fails; the same call goes on where it ended.
    """
    if data is None:
        raise InputError("the data are None; give a folder with the observed maps, the maps, or a table of spectra.")
    run, source = loaded(model)
    settings = settings_of(settings, DiagnosisSettings)
    wanted, (settings, library, asked) = settings.controls, _with_library(settings, run)
    if output is not None:
        output = folders.user_path(output)
        folders.writable(output)
        check_outside(output, data)
    processes = run.compute.workers if workers is None else workers
    load_ahead(processes)
    run, analysis, table, given = _analysed(run, source, data, settings, library, wanted)
    _check_candidates(analysis, asked)
    task: Callable[[Job], NDArray[np.float64]] = data_vectors if table is None else table
    maps = checked_maps(analysis.model, given) if given else []
    if output is not None:
        check_replaced(output, str(case or run.name), digest(maps if table is None else [table.value]))
    means = source is None and bool(given) and isinstance(data, str | Path) and of_pixel_means(analysis.model, data)
    key = _key(run, analysis)
    with batch(processes) as call:
        whole = task if source is None else Checked(task)
        stage = "simulations of the model and of each effect"
        with asking(call, quiet, whole, stage, kept(run, analysis)) as ask:
            ensemble, bank = _learned(key, run, analysis, ask)
        known = context(analysis, ensemble if table is None else ensemble.of_mean(table.realizations), bank)
        drawn = controls.diagnose_controls(known, key, wanted, call, quiet) if wanted else None
        with asking(call, quiet, task, "simulations of fitted effects") as ask:
            known = known.of_pixel_means if means else known
            found: DataSet = ObservedMaps(known, maps, ask) if table is None else MeasuredSpectra(known, table, ask)
            if source is not None:
                campaign.check_data(found.x, ensemble, source)
            left, diagnosis = diagnosed(found, str(case or run.name))
        if diagnosis.kind == "unknown" and isinstance(left, ObservedMaps) and source is None and not diagnosis.orders:
            with asking(call, quiet, simulated_scores.scores, "simulations of what is not listed") as ask:
                diagnosis = unlisted.reconstructed(diagnosis, left, ask)
    if means:
        diagnosis = replace(diagnosis, notes=(words.PIXEL_MEANS, *diagnosis.notes))
    if source is not None:
        told = agreement(known)
        said = (words.agreement(told),)
        notes, warnings = ((*said, *diagnosis.notes), ()) if told.agrees else (diagnosis.notes, said)
        diagnosis = replace(diagnosis, agreement=told, notes=notes, warnings=warnings)
    elif table is None:
        diagnosis = replace(diagnosis, warnings=_warnings(analysis))
    if drawn is not None:
        first, done = (*drawn.warnings, *diagnosis.warnings), replace(diagnosis.settings, controls=wanted)
        diagnosis = replace(diagnosis, controls=drawn, warnings=first, settings=done)
    if output is not None:
        with folders.filling(output):
            diagnosis.save(output, report.page(diagnosis))
    return diagnosis


def _with_library(
    settings: DiagnosisSettings, run: config.RunConfig
) -> tuple[DiagnosisSettings, systematics.Library, tuple[str, ...]]:
    """Return settings that name effects of a library, that library, and what is asked for; refuse other names.

    What ``only`` does not name is in ``without``, nuisances of the run among it that are in no library.
    """
    known = systematics.catalogue() if settings.library is None else systematics.checked(settings.library)
    asked = (*settings.only, *settings.including, *(() if settings.library is None else known))
    kinds = {name: systematics.get(name, known) for name in (*settings.without, *asked)}
    only, including, without = (
        {kinds[name].name for name in names} for names in (settings.only, settings.including, settings.without)
    )
    for option, names in (("--only", only), ("--with", including)):
        if both := names & without:
            raise InputError(f"{min(both)} is asked for and left out ({option} and --without); choose one of them.")
    if only and (others := including - only):
        raise InputError(
            f"{min(others)} is asked for (--with), but is none of those that alone are proposed (--only); name it "
            "with --only."
        )
    known = {**known, **{kinds[name].name: kinds[name] for name in asked}}
    if only:
        without = {*known, *(systematics.called(one.effect) for one in run.nuisances)} - only
    on_request = {kinds[name].name for name in asked if not kinds[name].proposed}
    named = replace(settings, without=tuple(sorted(without)), including=tuple(sorted(on_request)), only=())
    return replace(named, library=None, controls=0), known, tuple(only | including)


def describe(
    model: str | Path | config.RunConfig | ExternalModel, settings: DiagnosisSettings, data: str | Path | None = None
) -> str:
    """Return a text on the cost of a diagnosis: simulations, memory, disk, time, and that of preparing the maps.

    Data that are named are read, and refused as :func:`diagnose` refuses them. It ends with what the verdict of real
    maps would be warned of: sky power that the model lacks.
    """
    run, source = loaded(model)
    count, (settings, library, asked) = settings.controls, _with_library(settings, run)
    run, analysis, table, maps = _analysed(run, source, data, settings, library, count)
    _check_candidates(analysis, asked)
    if maps:
        checked_maps(analysis.model, maps)
    campaign.check_count(analysis, settings.simulations)
    planned, size = campaign.plan(analysis, settings.simulations), len(analysis.elements)
    jobs = planned.values()
    number = sum(job.count for job in jobs if job.source is None)
    head = f"{run.name}: at most {number} simulations before data, for a data vector of {size}"
    if source is not None:
        given = sum(job.count for job in jobs if job.source is not None)
        stored = "" if source.count is None else f", of {source.count} that are stored"
        head += f"; and at most {given} of {source.label}{stored}, whose own cost is not in what follows"
    priors = [f"nuisance: {line}" for one in analysis.nuisances for line in one.lines]
    lines, held = [head, *priors, *cost.lines(analysis, planned)], kept(run, analysis)
    if folders.is_cached(f"diagnose/{_key(run, analysis)}.zarr"):
        lines.append("  cache   has what these simulations tell: none of them is left to do")
    elif done := sum(len(held.found(job)) for job in jobs):
        lines.append(f"  cache   has {done} of these simulations")
    lines.append(
        "if the data depart from the model: hundreds more simulations, of effects that are fitted to them, "
        "and thousands where many act"
    )
    if source is None and table is None:
        more = simulated_scores.SIMULATIONS
        lines.append(
            f"if the verdict is unknown: {more} more, each a few times as long, once, "
            "and again if a period or source is found"
        )
    if count:
        lines += controls.describe(analysis, count, run.compute.workers)
    if source is None and table is None:
        lines += [f"warning: {sentence}" for sentence in _warnings(analysis)]
    return "\n".join(lines)


def _analysed(
    run: config.RunConfig,
    source: Source | None,
    data: str | Path | Sequence[NDArray[np.float64]] | Mapping[str, NDArray[np.float64]] | None,
    settings: DiagnosisSettings,
    library: systematics.Library,
    wanted: int,
) -> tuple[config.RunConfig, Analysis, spectra_table.Spectra | None, dict[str, Map]]:
    """Return the run, with the statistics of a table that the data may be, the analysis of the data, table and maps.

    InputError is raised for ``wanted`` controls, a simulator or a sky that do not suit the data, and before all else
    for data that cannot be read.
    """
    threads = os.cpu_count() or 1
    data = folders.user_path(data) if isinstance(data, str | Path) else data
    table = read_spectra(data, run) if isinstance(data, Path) and data.is_file() else None
    given = {} if data is None or table is not None else given_maps(run, data)
    controls.check(wanted, of_maps=table is None, external=source is not None)
    if table is not None:
        if source is not None:
            raise InputError(
                f"{data} is a table, but the model is of maps, {source.label}; give maps, or a run of mcsim."
            )
        run = spectra_table.estimator_for(run, table)
        analysis = spectra_table.analysis_of_spectra(run, table, settings.without, threads, settings, library)
    else:
        analysis = analysis_of(run, settings.without, threads, settings, library, source)
    if table is None:
        check_pixels(analysis.model, analysis.elements)
    if table is None and source is None:
        check_splits_differ(analysis.model)
    power.check(analysis.model.survey)
    if given and source is None:
        check_subtracted(analysis.model, given)
        warn_of_no_noise(analysis.model)
    if table is None:
        warn_of_parts_of_pixels(analysis.model)
    return run, analysis, table, given


def _check_candidates(analysis: Analysis, asked: Sequence[str]) -> None:
    """Raise InputError if an effect that is asked for is no candidate, or nothing is."""
    check_asked(analysis, asked)
    if not analysis.candidates:
        raise InputError(
            "no effect of the library can be found in these data: none applies to the model and is not left out; leave "
            "fewer out (--without), or give others (library)."
        )


def _warnings(analysis: Analysis) -> tuple[str, ...]:
    """Return a sentence on sky power that maps of a real sky hold and the simulations lack, if there is any."""
    found = power.neglected(analysis.model.survey)
    return () if found is None else (f"{found} Simulated data whose own sky ends there are not concerned.",)


def kept(run: config.RunConfig, analysis: Analysis) -> Kept:
    """Return where the simulations of a model are kept until it is learned."""
    key = _key(run, analysis, analysis.settings.of_a_simulation())
    folder = folders.default_cache_dir().absolute() / f"diagnose/{key}.parts"
    return Kept.of(folder, analysis.model.nside, campaign.PER_TASK)


def prepared(run: config.RunConfig, analysis: Analysis, ask: campaign.Ask) -> DiagnosisContext:
    """Return what every set of maps is tested with, simulated or from the cache."""
    return context(analysis, *_learned(_key(run, analysis), run, analysis, ask))


def _learned(
    key: str, run: config.RunConfig, analysis: Analysis, ask: campaign.Ask
) -> tuple[NullEnsemble, TemplateBank]:
    """Simulate a model or load it from the cache; single simulations stay for the verdict after a first one alone."""
    simulations = analysis.settings.simulations
    campaign.check_count(analysis, simulations)

    def fill(scratch: Path) -> None:
        null_ensemble.save(scratch, *campaign.learned(analysis, ask, simulations))

    found = null_ensemble.load(folders.cached(f"diagnose/{key}.zarr", fill))
    if analysis.settings.sims_per_element >= DiagnosisSettings().sims_per_element:
        shutil.rmtree(kept(run, analysis).folder, ignore_errors=True)
    return found


def _key(run: config.RunConfig, analysis: Analysis, settings: DiagnosisSettings | None = None) -> str:
    """Return a hash of all that the simulations of a model depend on, the code that makes them included.

    ``settings``: in place of those of the analysis. Its name, its seed and its number of realizations do not count.
    """
    science = config.science(run, *(("nuisance",) if run.nuisances else ()))
    science["ensemble"] = {}
    effects = {candidate.effect for candidate in analysis.candidates} | analysis.acting
    rest = [
        [[candidate.label, [repr(basis) for basis in candidate.basis]] for candidate in analysis.candidates],
        asdict(settings or analysis.settings),
        [element.name for element in analysis.elements],
        sorted(class_digest(kind) for kind in effects),
        package_digest((f"mcsim.{name}" for name in CODE), LIBRARIES),
    ]
    if analysis.source is not None:
        rest += [analysis.source.identity(), package_digest(f"mcsim.ensemble.{name}" for name in EXTERNAL)]
    return hashlib.sha256(json.dumps([science, rest], sort_keys=True).encode()).hexdigest()[:32]
