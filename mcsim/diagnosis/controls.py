"""Controls: data drawn from the model at higher fidelity than it simulates with, and diagnosed as the data are."""

import hashlib
import json
import os
import shutil
from dataclasses import asdict
from pathlib import Path

from mcsim import config
from mcsim.datavector.analysis import Analysis
from mcsim.datavector.campaign import Batch, asking
from mcsim.datavector.faithful import draw, fidelity
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.diagnosis.control_result import Control, Controls
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.ensemble.plan import cost
from mcsim.errors import InputError, RunError
from mcsim.support import folders
from mcsim.support.code import class_digest, package_digest
from mcsim.support.npy import read_npy
from mcsim.support.numbers import duration
from mcsim.support.progress import reporting

SAMPLE_S = 1e-6  #: seconds that one sample takes on one core, for estimates


def check(count: int, of_maps: bool, external: bool = False) -> None:
    """Raise InputError for a number of controls that cannot be drawn for these data and this simulator."""
    if count < 0:
        raise InputError(f"controls = {count} is no number of data sets; give 0 or more, better 20.")
    if count and not of_maps:
        raise InputError(f"controls = {count}, but they are maps and the data a table; give controls = 0.")
    if count and external:
        raise InputError(
            f"controls = {count}, but mcsim draws them, and the model is simulated by another program; give "
            "controls = 0: the result says if mcsim agrees with that program."
        )


def diagnose_controls(known: DiagnosisContext, key: str, count: int, call: Batch, quiet: bool = True) -> Controls:
    """Draw and diagnose controls, each once: their verdicts are kept in the cache.

    ``key`` is the hash of all that ``known``, what the data are tested with, follows from. More controls than before go
    on where those ended. ``call`` runs the draws, and the simulations of effects that are fitted to controls. RunError
    if workers have another cache than this process.
    """
    with reporting("orientation moments of the controls", 1.0, "", quiet) as report:
        drawn = fidelity(known.analysis, os.cpu_count() or 1)
        report(1.0)
    code = [package_digest(["mcsim.diagnosis", "mcsim.datavector.faithful"])]
    # Effects that are proposed on request alone are no part of the key, and may be what a control is called.
    code += [class_digest(kind) for _, kind in known.analysis.library]
    text = json.dumps([key, config.science(drawn.run), drawn.sample_by_sample, code], sort_keys=True)
    folder = folders.default_cache_dir().absolute() / "controls" / hashlib.sha256(text.encode()).hexdigest()[:32]
    verdicts = {number: one for number in range(count) if (one := _read(folder, number)) is not None}
    missing = [number for number in range(count) if number not in verdicts]
    absent = [number for number in missing if not (_maps(folder, number) / "maps.npy").is_file()]
    files = config.digest(drawn.run, "nuisance")
    fixed = config.to_json(drawn.run), files, known.analysis.library, drawn.sample_by_sample
    with reporting("controls", float(count), "controls", quiet) as report, asking(call, quiet=True) as ask:

        def finish(number: int) -> None:
            """Diagnose a control that is drawn, unless another process has; its maps are not needed again."""
            path = _maps(folder, number) / "maps.npy"
            present, control = path.is_file(), _read(folder, number)
            if control is None:
                if not present:
                    raise RunError(f"A worker drew {path}, and it is not there; let all workers share one cache.")
                maps = read_npy(path, "f", (2,))
                found = diagnose_data(ObservedMaps(known, list(maps), ask), f"control {number}")
                control = Control(found.test.pvalue, found.kind, tuple(effect.label for effect in found.effects))
                folders.write_whole(_maps(folder, number).with_suffix(".json"), json.dumps(asdict(control)) + "\n")
            verdicts[number] = control
            shutil.rmtree(path.parent, ignore_errors=True)
            report(float(len(verdicts)))

        report(float(len(verdicts)))
        for number in sorted({*missing} - {*absent}):
            finish(number)
        for index, _ in call(draw, ((*fixed, number, str(_maps(folder, number))) for number in absent)):
            finish(absent[index])
    members = tuple(verdicts[number] for number in range(count))
    return Controls(members, drawn.words, known.settings.alpha, known.null.n_sims)


def _maps(folder: Path, number: int) -> Path:
    return folder / f"{number:05d}"


def _read(folder: Path, number: int) -> Control | None:
    """Return the verdict on a control; None if there is none, or a computer stopped as it was written."""
    try:
        plain = json.loads(_maps(folder, number).with_suffix(".json").read_text())
    except (FileNotFoundError, ValueError):
        return None
    return Control(**plain | {"effects": tuple(plain["effects"])})


def describe(analysis: Analysis, count: int, workers: int) -> list[str]:
    """Return lines on the cost of controls: how they are drawn, memory, time, and disk for a moment."""
    drawn = fidelity(analysis, os.cpu_count() or 1)
    found, dense = cost(drawn.run), f", {drawn.samples:.2g} samples each" if drawn.samples else ""
    each_s, size = found.each_s + SAMPLE_S * drawn.samples, 96.0 * drawn.survey.nside**2 * len(drawn.survey.map_names)
    return [
        f"  control {count} data sets with {drawn.words}{dense}; {found.memory / 1e9:.2f} GB per worker,"
        f" {duration(each_s)} each, {duration(each_s * count / workers)} on {workers} core{'s' if workers > 1 else ''},"
        f" {size / 1e6:.2f} MB of disk for each in work; those that depart from the model cost a diagnosis each",
    ]
