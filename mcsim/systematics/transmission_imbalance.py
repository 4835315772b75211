"""Two sides of a radiometer that do not let through the same."""

from dataclasses import dataclass

from mcsim.systematics.base import Bound, Effect, Wording


@dataclass(frozen=True, kw_only=True)
class TransmissionImbalance(Effect):
    """The true imbalance x of (1 + x) T_A - (1 - x) T_B is the fiducial one plus amplitude."""

    name = "transmission_imbalance"
    scope = "channel"
    unit = "x"
    wording = Wording("x = {}")
    cause = "Losses in the two arms of a differencing radiometer, measured with an error."
    signature = "Stripes of the dipole along the scan; acts on differencing scans only."
    source = "Hinshaw et al. 2003, ApJS 148, 63; Jarosik et al. 2007, ApJS 170, 263"
    step = 1e-3
    bounds = (
        Bound(
            "amplitude",
            -0.1,
            0.1,
            "a prior of this library: some are 0.01 for WMAP (Hinshaw et al. 2003, ApJS 148, 63)",
        ),
    )

    def differencing(self, imbalance: float, iterations_short: int) -> tuple[float, int]:
        """Add to the imbalance."""
        return imbalance + self.amplitude, iterations_short
