"""Rows of a table, printed and kept in a file as they are made, so that a run that was ended goes on where it was."""

import json
from collections.abc import Callable
from pathlib import Path


class Rows:
    """Rows by what they are of, as lines of JSON; without a path they are only printed."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        lines = path.read_text(encoding="utf-8").splitlines() if path is not None and path.is_file() else []
        self._kept: dict[str, list[str]] = {key: row for key, *row in map(json.loads, lines)}

    def made(self, key: str, make: Callable[[], tuple[str, str]]) -> str:
        """Print the row of a key, made unless it is kept; return what was judged, which ``make`` returns first."""
        if key not in self._kept:
            self._kept[key] = list(make())
            if self.path is not None:
                with self.path.open("a", encoding="utf-8") as file:
                    file.write(json.dumps([key, *self._kept[key]]) + "\n")
        judged, row = self._kept[key]
        print(row, flush=True)
        return judged
