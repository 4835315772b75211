"""The library of differences of implementation."""

from mcsim.comparison.differences import Difference
from mcsim.comparison.map_differences import (
    Calibration,
    ChannelExchanged,
    Dipole,
    Monopole,
    NoiseShared,
    Ordering,
    SplitExchanged,
    Unit,
)
from mcsim.comparison.scene_differences import (
    BeamConjugated,
    BeamWindow,
    FrameRotated,
    LmaxCut,
    MmaxCut,
    PixelCentres,
    PixelWindow,
    PrecessionSign,
    PsiOffset,
    PsiSign,
    SpinSign,
    TimeShift,
)


def library(frame: str) -> tuple[Difference, ...]:
    """Return all differences of implementation, for maps in a frame."""
    return (
        Unit(), Calibration(), Monopole(), Dipole(), Ordering(), SplitExchanged(), ChannelExchanged(), NoiseShared(),
        PsiOffset(), PsiSign(), BeamConjugated(), MmaxCut(), LmaxCut(), PixelWindow(), BeamWindow(), PixelCentres(),
        TimeShift(), FrameRotated(frame), SpinSign(), PrecessionSign(),
    )  # fmt: skip
