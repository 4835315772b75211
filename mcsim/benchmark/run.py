"""Diagnose all cases of a challenge as one batch."""

import json
from pathlib import Path

from mcsim import config
from mcsim.benchmark.learned_model import without_effects
from mcsim.benchmark.make import SETTINGS
from mcsim.benchmark.truth import MAPS, finished_cases
from mcsim.diagnosis.analysis import analysis_of
from mcsim.diagnosis.api import prepared
from mcsim.diagnosis.batch import asking, batch
from mcsim.diagnosis.inference import diagnose_maps
from mcsim.diagnosis.observed_maps import read_maps
from mcsim.errors import InputError
from mcsim.support.folders import appearing
from mcsim.support.progress import reporting

VERDICTS = "verdicts"


def run(folder: str | Path, *, workers: int | None = None, quiet: bool = True) -> int:
    """Diagnose the cases of a challenge that have no verdict yet.

    Parameters
    ----------
    folder
        As :func:`mcsim.benchmark.make` fills it; gets ``verdicts/case-NNN`` with ``verdict.json`` and ``answer.json``
        (the evidence and the fit behind it). Keys are not looked at.
    workers
        Processes; default: the model's; 0: this one.

    Returns
    -------
    int
        Number of cases that were diagnosed.
    """
    target = Path(folder)
    fiducial, simulations = settings_of(target)
    missing = [case for case in finished_cases(target) if not (target / VERDICTS / case).is_dir()]
    if not missing:
        return 0
    with batch(fiducial.compute.workers if workers is None else workers) as call:
        prepared(fiducial, analysis_of(fiducial), asking(call, quiet), simulations)
        text = config.to_json(fiducial)
        # Cases of one library follow each other, so that a worker seldom changes its court.
        analysis = sorted((_without(target, case), case) for case in missing)
        with reporting("cases", float(len(missing)), "cases", quiet) as report:
            tasks = ((text, simulations, str(target), case, names) for names, case in analysis)
            for done, _ in enumerate(call(judge_case, tasks)):
                report(float(done + 1))
    return len(missing)


def settings_of(folder: Path) -> tuple[config.RunConfig, int | None]:
    """What a challenge's cases are told to believe, and the number of simulations to learn from."""
    path = folder / SETTINGS
    try:
        plain = json.loads(path.read_text())
        return config.load(plain["model"]), plain["simulations"]
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path} cannot be read ({error}); make the challenge with mcsim challenge make.") from error


def judge_case(model: str, simulations: int | None, folder: str, case: str, names: tuple[str, ...]) -> str:
    """Task: verdict of one case; its folder appears complete or not at all."""
    target = Path(folder)
    learned = without_effects(model, simulations, names)
    found = diagnose_maps(
        learned.context, case, read_maps(learned.context.analysis.model, target / MAPS / case), learned.ask
    )
    said = found.attribution
    answer = {
        "evidence": [float(value) for value in found.evidence["data"].values],
        "maximum": said.gap.maximum,
        "explanations": [
            {
                "proposals": [learned.context.analysis.proposals[member].label for member in explanation.members],
                "amplitudes": explanation.fit.amplitudes.tolist(),
                "errors": explanation.fit.errors.tolist(),
            }
            for explanation in said.explanations
        ],
    }
    with appearing(target / VERDICTS / case) as scratch:
        (scratch / "verdict.json").write_text(json.dumps(found.verdict, indent=1, allow_nan=False) + "\n")
        (scratch / "answer.json").write_text(json.dumps(answer) + "\n")
    return case


def _without(folder: Path, case: str) -> tuple[str, ...]:
    return tuple(json.loads((folder / MAPS / case / "question.json").read_text())["without"])
