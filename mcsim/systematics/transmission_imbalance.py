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
    source = "Jarosik et al. 2003, ApJS 145, 413; Hinshaw et al. 2003, ApJS 148, 63"
    step = 1e-3
    bounds = (
        Bound(
            "amplitude",
            -0.1,
            0.1,
            "WMAP's are at most 0.02 (Jarosik et al. 2003, ApJS 145, 413)",
        ),
    )

    def differencing(self, imbalance: float, iterations_short: int) -> tuple[float, int]:
        """Add to the imbalance."""
        return imbalance + self.amplitude, iterations_short
