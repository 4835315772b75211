"""The frame of the maps that are compared."""

from collections.abc import Sequence
from pathlib import Path

from mcsim import config
from mcsim.ensemble.maps import first_realization
from mcsim.errors import InputError
from mcsim.sphere.header import opened, stated_frame


def common_frame(run: config.RunConfig | None, sides: Sequence[str | Path]) -> str | None:
    """Return the frame of the maps of a run, or of folders without one: what headers say; None if none says it.

    Raise InputError if headers of maps that are compared say several.
    """
    if run is not None:
        return config.prepared_grid(run)[1]
    files = [{path.name: path for path in first_realization(Path(side)).glob("*.fits")} for side in sides]
    stated: dict[str, Path] = {}
    for side in files:
        for name in sorted(files[0].keys() & files[1].keys()):
            with opened(side[name]) as hdus:
                frame = stated_frame(hdus, str(side[name]))
            if frame is not None:
                stated.setdefault(frame, side[name])
    if len(stated) > 1:
        words = ", ".join(f"{path} is in {frame} coordinates" for frame, path in stated.items())
        raise InputError(f"{words}; rotate the maps to one frame, or correct the headers (COORDSYS).")
    return next(iter(stated), None)
