"""Effects on maps of a differencing scan: another imbalance, and too few iterations."""

from dataclasses import dataclass

from mcsim.errors import InputError
from mcsim.systematics.base import Bound, Effect, Wording
from mcsim.systematics.parametrization import Steps


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
        return imbalance + self.amplitude, iterations_short


@dataclass(frozen=True, kw_only=True)
class MapmakingConvergence(Effect):
    """The map-making, from a map of zeros, stops ``amplitude`` iterations (rounded) before it has converged.

    One iteration is done at least.
    """

    name = "mapmaking_convergence"
    scope = "channel"
    unit = "iterations short"
    title = "map-making convergence"
    wording = Wording("{} iterations short")
    cause = "Conjugate gradients ended by a count, not by their residual."
    signature = "Stripes in the frame of the scan, at the largest scales; acts on differencing scans only."
    source = "Hinshaw et al. 2003, ApJS 148, 63 (iterative map-making); Jarosik et al. 2007, ApJS 170, 263"
    step = 20.0
    bounds = (Bound("amplitude", 0.0, 1000.0, "a prior of this library: map-makings end after fewer iterations"),)
    # What is missing of W1's half years falls by 1.2 to 1.9 with each of the first iterations (nside 16 and 64).
    parametrization = Steps(sign=1, factor=1.5)

    def differencing(self, imbalance: float, iterations_short: int) -> tuple[float, int]:
        if self.amplitude < 0.0:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} iterations are more than it takes to converge; "
                "give 0 or more, and lower scan.tolerance for a map that has converged further."
            )
        return imbalance, iterations_short + round(self.amplitude)
