"""Galactic light that is brighter in one channel than its band says."""

from dataclasses import dataclass

from mcsim.systematics.base import Alm, Bound, Draw, Effect, Site, Wording
from mcsim.systematics.galaxy import morphology
from mcsim.systematics.parametrization import Parametrization


@dataclass(frozen=True, kw_only=True)
class BandpassMismatch(Effect):
    """A signal fixed to the sky, strongest in the Galactic plane, in one channel alone.

    Attributes
    ----------
    amplitude
        Root mean square over the full sky, uK; negative where the channel sees less than its band says.
    template
        Path of a HEALPix map to be used up to l = 2 nside, brought to rms 1; its frame is what its header says, or
        galactic. Left out, every realization draws its own, by the model of ``foreground_residual``.
    """

    name = "bandpass_mismatch"
    scope = "channel"
    unit = "uK rms"
    wording = Wording("{} rms", " µK")
    cause = "A band whose edges are not those of the colour correction, or that changes with temperature."
    signature = "Additive along the Galactic plane in one channel alone, also among channels of one frequency."
    source = "Planck 2013 results IX, A&A 571, A9 (colour corrections); Planck 2018 results III, A&A 641, A3 (mismatch)"
    step = 3.0
    bounds = (Bound("amplitude", -500.0, 500.0, "a prior of this library: less than the foreground itself"),)
    parametrization = Parametrization(stochastic=True, matched_filter=False)
    proposed = False

    template: str = ""

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Add the excess."""
        return sky + self.amplitude * morphology(self.template, site, draw)
