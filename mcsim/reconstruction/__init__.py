"""Free-form reconstruction of what a simulation lacks: a small grammar, its search, and effects of its forms."""

from mcsim.reconstruction.forms import (
    AddedPattern,
    AddedToSamples,
    BeamOrder,
    BoostedSky,
    CompactSource,
    Elsewhere,
    GainOfOne,
    GainOfSplits,
    GainOverTime,
    GainPattern,
    NoisePattern,
    RotatedSky,
    SignalPower,
    SkyPower,
)  # fmt: skip

__all__ = [
    "AddedPattern", "AddedToSamples", "BeamOrder", "BoostedSky", "CompactSource", "Elsewhere", "GainOfOne",
    "GainOfSplits", "GainOverTime", "GainPattern", "NoisePattern", "RotatedSky", "SignalPower", "SkyPower",
]  # fmt: skip
