"""Light that is not of the cosmic background: of the Galaxy, and of unresolved sources."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mcsim.errors import InputError
from mcsim.sphere import alm as alm_
from mcsim.sphere.sky import gaussian_alm
from mcsim.support.arrays import divided
from mcsim.support.numbers import measured
from mcsim.systematics.base import Alm, Bound, Draw, Effect, Site, Wording
from mcsim.systematics.galaxy import morphology
from mcsim.systematics.parametrization import Parametrization, PowerLaw

REFERENCE_GHZ = 94.0
STEEPEST = 50.0  #: spectral index, in absolute value: ten times that of any foreground


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
        if abs(self.spectral_index) > STEEPEST:
            raise InputError(
                f"effect {self.name}: spectral_index = {self.spectral_index:g} is no foreground's; keep it within "
                f"+-{STEEPEST:g}."
            )
        if not site.foregrounds:
            return sky
        scale = self.amplitude * (site.frequency(self.name) / REFERENCE_GHZ) ** self.spectral_index
        return sky + scale * morphology(self.template, site, draw)


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
        return sky + self.amplitude * morphology(self.template, site, draw)


_NARROWEST = 5


@dataclass(frozen=True, kw_only=True)
class PointSources(Effect):
    """A Gaussian sky with C_l = amplitude, the same in every channel.

    Notes
    -----
    A negative amplitude, which no sources have, takes the power away, for templates: the sky's own coefficients are
    scaled by sqrt(1 + amplitude / C_l), C_l being the sky's own power around l (+-5, or a tenth of l). Its response is
    not the negative of that of sources, which are a sky of their own, but has the mean of it, and no scatter.
    """

    name = "point_sources"
    scope = "common"
    unit = "uK^2 sr"
    wording = Wording("C_ℓ = {}", " µK² sr")
    cause = "Radio galaxies below the limit of the catalogue."
    signature = "Flat C_l, in autos and crosses of all channels alike."
    source = "Tegmark & Efstathiou 1996, MNRAS 281, 1297; Wright et al. 2009, ApJS 180, 283"
    step = 1e-4
    bounds = (Bound("amplitude", 0.0, 10.0, "no power is negative; far beyond that of unresolved sources"),)
    parametrization = Parametrization(sign=-1, stochastic=True, mean_response=True, matched_filter=False)

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Add the sources, or take their power away."""
        if self.amplitude > 0.0:
            return sky + gaussian_alm(np.full(site.lmax + 1, self.amplitude), draw("sources"))
        scale = divided(self.amplitude, _power_around(sky, site.lmax))
        return alm_.multiply(sky, np.sqrt(np.maximum(1.0 + scale, 0.0)), site.lmax)


def _power_around(alm: Alm, lmax: int) -> np.ndarray:
    """Mean |a_lm|^2 over all m of the degrees around each l, shape (lmax + 1,)."""
    ell = np.arange(lmax + 1)
    reach = np.maximum(_NARROWEST, ell // 10)
    first, last = np.maximum(ell - reach, min(2, lmax)), np.minimum(ell + reach, lmax) + 1
    modes, total = np.append(0.0, np.cumsum(2.0 * ell + 1.0)), np.append(0.0, np.cumsum(alm_.power(alm, lmax)))
    return np.asarray((total[last] - total[first]) / (modes[last] - modes[first]))
