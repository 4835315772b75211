"""Effects that no library has, for challenges: what a diagnosis must call unknown."""

from dataclasses import dataclass, replace

import numpy as np

from mcsim.sphere import healpix
from mcsim.sphere.sky import dipole_alm
from mcsim.systematics import Effect, Parametrization


@dataclass(frozen=True, kw_only=True)
class SquareBeam(Effect):
    """A beam with corners: b_l4 = amplitude b_l0 (l sigma)^4 / 24, sigma of the Gaussian with the same b_l0."""

    name = "invented_square_beam"
    scope = "channel"
    unit = "corner"
    cause = "A square horn."
    signature = "m = 4, through w_4."
    step = 0.2

    def beam(self, beam, site):
        """With the corners."""
        if self.amplitude == 0.0:
            return beam
        ell = np.arange(beam.lmax + 1.0)
        window = beam.blm[0].real / np.sqrt((2 * ell + 1) / (4 * np.pi))
        half = int(np.argmin(np.abs(window - 0.5)))
        sigma = np.sqrt(2.0 * np.log(2.0)) / max(half, 1)
        blm = np.zeros((max(beam.mmax, 4) + 1, beam.lmax + 1), dtype=complex)
        blm[: beam.mmax + 1] = beam.blm
        blm[4, 4:] += (self.amplitude * beam.blm[0].real * (ell * sigma) ** 4 / 24.0)[4:]
        return replace(beam, blm=blm)


@dataclass(frozen=True, kw_only=True)
class Nonlinearity(Effect):
    """A gain that depends on the signal: T + amplitude T^2, the dipole in T."""

    name = "invented_nonlinearity"
    scope = "channel"
    unit = "1/uK"
    cause = "An amplifier near saturation."
    signature = "The square of the dipole, and the sky times the dipole."
    step = 1e-7
    parametrization = Parametrization(matched_filter=False)

    def sky(self, sky, site, draw):
        """With its square, up to the sky's own degree."""
        if self.amplitude == 0.0:
            return sky
        nside = 1 << int(np.ceil(np.log2(site.lmax)))
        whole = sky + dipole_alm(site.dipole_uk, site.lmax)
        squared = healpix.synthesis(whole[None], nside, site.lmax)[0] ** 2
        return sky + self.amplitude * healpix.analysis(squared, site.lmax)


@dataclass(frozen=True, kw_only=True)
class Crosstalk(Effect):
    """A fraction of what a horn 35 degrees ahead on the same circle saw, 12.6 s earlier: another channel's signal."""

    name = "invented_crosstalk"
    scope = "channel"
    unit = "fraction"
    cause = "Multiplexed readout."
    signature = "An echo of the sky along the scan."
    step = 0.002
    parametrization = Parametrization(matched_filter=False)

    def lags(self):
        """Now, and then."""
        return ((1.0, 0.0), (self.amplitude, 12.6))
