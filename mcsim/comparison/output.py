"""The folder of a comparison: what is not written over."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mcsim.ensemble.maps import first_realization
from mcsim.errors import InputError

RESULT, REPORT = "compare.json", "report.html"


def place(side: str | Path) -> str:
    """Return the absolute path of a side; the name of a packaged configuration as it is."""
    return os.path.abspath(side) if os.path.exists(side) else str(side)


def check_output(folder: Path | None, sides: Sequence[str | Path], case: str) -> None:
    """Raise InputError for an output that is the folder of a side, or has another report that would be replaced.

    That is one of another case, of other sides (none: arrays), or of a diagnosis. What cannot be read is no comparison,
    and those of earlier versions do not say their sides.
    """
    if folder is None or not folder.is_dir():
        return
    for side in map(Path, sides):
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
    former, remedy = _former(folder / RESULT), "choose another folder with -o, or delete that one."
    if former.get("case", case) != case:
        raise InputError(f"{folder} holds the comparison of case {former['case']}, and this is case {case}; {remedy}")
    own = [place(side) for side in sides]
    for label, before, now in zip("AB", former.get("sides", own), own, strict=False):
        if before != now:
            raise InputError(
                f"{folder} holds the comparison of case {case} with {before} as side {label}, and this has {now}; "
                f"{remedy}"
            )


def _former(path: Path) -> dict[str, Any]:
    """Return the case and the sides of the comparison of a file, as far as it says them."""
    try:
        former = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    said = former if isinstance(former, dict) else {}
    return {key: said[key] for key, kind in (("case", str), ("sides", list)) if isinstance(said.get(key), kind)}
