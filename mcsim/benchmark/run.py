"""Diagnose all cases of a challenge as one batch."""

import json
from pathlib import Path

from mcsim.benchmark.folder import MAPS, VERDICTS, Settings, finished_cases, read_json
from mcsim.benchmark.learned import each_case, learned_model, workers_of
from mcsim.errors import InputError
from mcsim.support.folders import appearing


def run(folder: str | Path, *, workers: int | None = None, quiet: bool = True) -> int:
    """Diagnose the cases of a challenge that have no verdict yet, without looking at the keys.

    Parameters
    ----------
    folder
        As :func:`mcsim.benchmark.make.make` fills it. It gets ``verdicts/case-NNN`` with ``verdict.json`` and
        ``answer.json`` (the data vector and the fits behind the verdict).
    workers
        Number of processes; default: the model's; 0: this process.
    quiet
        Report no progress.

    Returns
    -------
    int
        Number of cases that were diagnosed.

    Raises
    ------
    InputError
        If the folder holds no challenge.
    """
    target = Path(folder)
    missing = [case for case in finished_cases(target) if not (target / VERDICTS / case).is_dir()]
    settings = Settings.read(target)
    if missing:
        # Cases of one library follow each other, so that a worker seldom changes its library.
        ordered = sorted((_without(target, case), case) for case in missing)
        with workers_of(settings, workers, quiet) as call:
            each_case(call, diagnose_case, [(settings, str(target), case, names) for names, case in ordered], quiet)
    return len(missing)


def diagnose_case(settings: Settings, folder: str, case: str, without: tuple[str, ...]) -> None:
    """Write the verdict of one case; its folder appears complete or not at all."""
    target, model = Path(folder), learned_model(settings, without)
    found = model.diagnose(case, target / MAPS / case)
    answer = {
        "evidence": [float(value) for value in found.data],
        "maximum": found.test.maximum,
        "explanations": [
            {
                "proposals": [model.library.candidates[member].label for member in one.candidates],
                "amplitudes": list(one.coordinates),
                "errors": list(one.errors),
            }
            for one in found.sets
        ],
    }
    with appearing(target / VERDICTS / case) as scratch:
        (scratch / "verdict.json").write_text(json.dumps(found.to_json(), indent=1, allow_nan=False) + "\n")
        (scratch / "answer.json").write_text(json.dumps(answer) + "\n")


def _without(folder: Path, case: str) -> tuple[str, ...]:
    path = folder / MAPS / case / "question.json"
    try:
        return tuple(read_json(path, "restore it")["without"])
    except (KeyError, TypeError) as error:
        raise InputError(f"{path} does not say which effects are left out ({error}); restore it.") from error
