"""The frame of the maps that are compared."""

from collections.abc import Sequence
from pathlib import Path

from mcsim import config
from mcsim.ensemble.maps import first_realization
from mcsim.errors import InputError
from mcsim.sphere.header import opened, stated_frame


def common_frame(run: config.RunConfig | None, sides: Sequence[str | Path]) -> str | None:
    """Return the frame of the maps of a run, or of folders without one: what headers say; None if none says one alone.

    Raise InputError if the headers of two maps that are compared say two.
    """
    if run is not None:
        return config.prepared_grid(run)[1]
    a, b = ({path.name: path for path in first_realization(Path(side)).glob("*.fits")} for side in sides)
    every: set[str] = set()
    for name in sorted(a.keys() & b.keys()):
        stated = {frame: side[name] for side in (a, b) if (frame := _stated(side[name])) is not None}
        if len(stated) > 1:
            words = ", ".join(f"{path} is in {frame} coordinates" for frame, path in stated.items())
            raise InputError(f"{words}; rotate the maps to one frame, or correct the headers (COORDSYS).")
        every |= stated.keys()
    return every.pop() if len(every) == 1 else None


def _stated(path: Path) -> str | None:
    with opened(path) as hdus:
        return stated_frame(hdus, str(path))
