"""The folder of a comparison: what is not written over."""

import json
from collections.abc import Iterable
from pathlib import Path

from mcsim.ensemble.maps import first_realization
from mcsim.errors import InputError

RESULT, REPORT = "compare.json", "report.html"


def check_output(folder: Path | None, sides: Iterable[Path], case: str) -> None:
    """Raise InputError for an output that is the folder of a side, or has the report of another case or of a diagnosis.

    What cannot be read is no comparison.
    """
    if folder is None or not folder.is_dir():
        return
    for side in sides:
        maps = (side, first_realization(side)) if side.is_dir() else ()
        if any(folder.samefile(one) for one in maps):
            raise InputError(
                f"{folder} is the folder of maps that are compared, among which a report would be written; choose "
                "another folder with -o."
            )
    if (folder / "verdict.json").is_file():
        raise InputError(
            f"{folder} holds the {REPORT} of a diagnosis (verdict.json), which would be replaced; choose another "
            "folder with -o."
        )
    former = _case(folder / RESULT)
    if former not in (None, case):
        raise InputError(
            f"{folder} holds the comparison of case {former}, and this is case {case}; choose another folder with -o, "
            "or delete that one."
        )


def _case(path: Path) -> str | None:
    try:
        former = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    case = former.get("case") if isinstance(former, dict) else None
    return case if isinstance(case, str) else None
