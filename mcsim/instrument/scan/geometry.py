"""The pixels of a map, and the part of a survey that falls into them."""

from dataclasses import dataclass

import numpy as np

from mcsim.errors import InputError
from mcsim.instrument.scan.model import LineOfSight, ScanModel
from mcsim.instrument.scan.offsets import HIGHEST
from mcsim.sphere.checks import check_nside
from mcsim.sphere.rotation import FRAMES


def check_frame(frame: str) -> None:
    """Raise InputError unless ``frame`` is known."""
    if frame not in FRAMES:
        raise InputError(f"frame is {frame!r}, but it must be one of {', '.join(FRAMES)}.")


@dataclass(frozen=True)
class MapGrid:
    """HEALPix resolution and frame of a map, and its part of a survey: (0, 0.5) is the first half of the samples.

    ``offset_order``: highest degree, 1 to 4, of the moments of the samples' offsets from their pixels' centres.
    """

    nside: int
    frame: str = "ecliptic"
    time_range: tuple[float, float] = (0.0, 1.0)
    offset_order: int = 1

    def __post_init__(self) -> None:
        """Raise InputError for an nside that is no power of two, an unknown frame, or no increasing time range."""
        if self.offset_order not in range(1, HIGHEST + 1):
            raise InputError(f"offset_order is {self.offset_order}, but it must be a whole number from 1 to {HIGHEST}.")
        check_nside(self.nside)
        check_frame(self.frame)
        if np.shape(self.time_range) != (2,):
            raise InputError(f"time_range is {self.time_range!r}, but it must be an increasing pair within 0 and 1.")
        start, stop = self.time_range
        if not 0.0 <= start < stop <= 1.0:
            raise InputError(f"time_range is ({start:g}, {stop:g}), but it must be an increasing pair within 0 and 1.")

    @property
    def npix(self) -> int:
        """Number of pixels."""
        return 12 * self.nside * self.nside

    def sample_range(self, model: ScanModel, line: LineOfSight) -> tuple[int, int]:
        """Return the first sample and the one after the last of a line of sight; InputError if there is none."""
        start, stop = self.time_range
        number = model.samples(line)
        first, last = round(start * number), round(stop * number)
        if first == last:
            raise InputError(f"time_range ({start:g}, {stop:g}) of {model.name!r} contains no sample; widen it.")
        return first, last
