"""Galactic light that the cleaning left."""

from collections.abc import Mapping
from dataclasses import dataclass

from mcsim.support.numbers import measured
from mcsim.systematics.base import Alm, Bound, Draw, Effect, Site, Wording
from mcsim.systematics.galaxy import morphology
from mcsim.systematics.parametrization import PowerLaw

REFERENCE_GHZ = 94.0


@dataclass(frozen=True, kw_only=True)
class ForegroundResidual(Effect):
    """A signal fixed to the sky, strongest in the Galactic plane, growing as a power of frequency.

    Attributes
    ----------
    amplitude
        Root mean square over the full sky at 94 GHz, uK; negative where the cleaning took too much.
    spectral_index
        The signal grows as (nu / 94 GHz)^index, in thermodynamic temperature; 2 is near that of dust.
    template
        Path of a HEALPix map to be used up to l = 2 nside, brought to rms 1; its frame is what its header says, or
        galactic. Left out, every realization draws its own.

    Notes
    -----
    Channels with ``foregrounds = false`` have none of it. A diagnosis fits the index to three or more
    frequencies, or to two beside such a channel.

    Drawn: p(b) (1 + g), p = 1 / (1 + (sin b / 0.15)^2), g a Gaussian field of C_l ~ l^-2.5, l > 0, and unit variance,
    scaled to rms 1 over the full sky; a model of our own that is bright in the plane and patchy off it, no more.
    """

    name = "foreground_residual"
    scope = "common"
    unit = "uK rms at 94 GHz"
    title = "residual foreground"
    wording = Wording("{} rms at 94 GHz", " µK")
    cause = "Synchrotron, free-free or dust emission that the templates of the cleaning do not follow."
    signature = (
        "Additive and fixed to the sky, along the Galactic plane, different from channel to channel in size alone."
    )
    source = "Bennett et al. 2013, ApJS 208, 20 (residuals of cleaned bands); the morphology is a model"
    step = 5.0
    bounds = (
        Bound("amplitude", -500.0, 500.0, "a prior of this library: less than the foreground itself"),
        Bound("spectral_index", -4.0, 4.0, "from synchrotron to dust"),
    )
    parametrization = PowerLaw(
        stochastic=True, matched_filter=False, parameter="spectral_index", reference_ghz=REFERENCE_GHZ
    )

    spectral_index: float = 2.0
    template: str = ""

    def describe(self, sigma: float = 0.0, errors: Mapping[str, float] | None = None) -> str:
        """Return amplitude and index, and whether this was fitted."""
        error = (errors or {}).get("spectral_index")
        index = measured(self.spectral_index, error or 0.0)
        return f"{super().describe(sigma)}, index {index}" + (" (not fitted)" if error is None else "")

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Add the residual, but to maps that a component separation made."""
        if not site.foregrounds:
            return sky
        scale = self.amplitude * (site.frequency(self.name) / REFERENCE_GHZ) ** self.spectral_index
        return sky + scale * morphology(self.template, site, draw)
