"""Whether the samples of a survey fall on all phases of its spin."""

import math
import warnings

from mcsim.instrument.scan.geometry import MapGrid
from mcsim.instrument.scan.model import SECONDS_PER_DAY, ScanModel

FEW = 12  #: phases: more of them mix where the spin axis moves
APART = 4.0  #: pixels between the phases that are seen, from which on what lies between counts as missed
DENSE = 10.0  #: samples for each phase that is told apart, while the spin axis follows the Sun by one pixel


def warn_of_aliases(model: ScanModel, grid: MapGrid) -> None:
    """Warn if a sampling period is so near a simple multiple of the spin's that most phases of the spin are missed.

    Notes
    -----
    If q samples take nearly a whole number of turns, only q phases are seen until these have drifted by one turn. That
    matters if q is far below the number of pixels around a turn, and the drift takes longer than the Sun takes through
    a pixel.
    """
    pixel = math.sqrt(4.0 * math.pi / grid.npix)
    through = min(pixel / (2.0 * math.pi) * model.orbit_period_s, model.duration_days * SECONDS_PER_DAY)
    spin = abs(model.spin_period_s)
    for line in model.select():
        period = model.period_of_samples(line)
        around = 2.0 * math.pi * math.sin(math.radians(line.boresight_angle_deg)) / pixel
        number = through / period
        for phases in range(1, int(min(FEW, around / APART, max(number / DENSE, 1.0))) + 1):
            turns = phases * period / spin
            if round(turns) > 0 and abs(turns - round(turns)) * number < 1.0:
                warnings.warn(
                    f"samples of {line.name} every {period:g} s fall on {phases} phase{'s' if phases > 1 else ''} of "
                    f"the spin of {spin:g} s alone, and miss what lies between; choose another sample_period_s.",
                    stacklevel=1,
                )
                break
