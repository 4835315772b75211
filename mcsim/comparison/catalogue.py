"""The library of differences of implementation."""

from mcsim.comparison.averages import PixelAverage
from mcsim.comparison.differences import Difference
from mcsim.comparison.map_differences import (
    Calibration,
    ChannelExchanged,
    Dipole,
    FrameReversed,
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
    Smoothing,
    SmoothingWithDipole,
    SpinSign,
    TimeShift,
)
from mcsim.comparison.time_differences import FarTimeShift, Interpolation, MapMaking


def library(frame: str) -> tuple[Difference, ...]:
    """Return all differences of implementation, for skies in a frame."""
    return (
        Unit(), Calibration(), Monopole(), Dipole(), Ordering(), FrameReversed(), SplitExchanged(), ChannelExchanged(),
        NoiseShared(),
        PsiOffset(), PsiSign(), BeamConjugated(), MmaxCut(), LmaxCut(), PixelWindow(), BeamWindow(), Smoothing(),
        SmoothingWithDipole(), PixelCentres(), PixelAverage(),
        TimeShift(), FrameRotated(frame), SpinSign(), PrecessionSign(),
        FarTimeShift(), MapMaking(), Interpolation(),
    )  # fmt: skip
