"""Faint sources that no mask has found."""

from dataclasses import dataclass

import numpy as np

from mcsim.sphere import alm as alm_
from mcsim.sphere.sky import gaussian_alm
from mcsim.support.arrays import divided
from mcsim.systematics.base import Alm, Bound, Draw, Effect, Site, Wording
from mcsim.systematics.parametrization import Parametrization

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
    bounds = (
        Bound(
            "amplitude",
            0.0,
            10.0,
            "no power is negative; far beyond that of unresolved sources",
        ),
    )
    parametrization = Parametrization(sign=-1, stochastic=True, mean_response=True, matched_filter=False)

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Add the sources, or take their power away."""
        if self.amplitude > 0.0:
            return sky + gaussian_alm(np.full(site.lmax + 1, self.amplitude), draw("sources"))
        scale = divided(self.amplitude, _power_around(sky, site.lmax))
        return alm_.multiply(sky, np.sqrt(np.maximum(1.0 + scale, 0.0)), site.lmax)


def _power_around(alm: Alm, lmax: int) -> np.ndarray:
    """Mean |a_lm|^2 over all m of the degrees around each l, shape (lmax + 1,)."""
    weight = np.full(alm.size, 2.0)
    weight[: lmax + 1] = 1.0
    summed = np.bincount(alm_.degrees(lmax), weight * np.abs(alm) ** 2, lmax + 1)
    ell = np.arange(lmax + 1)
    reach = np.maximum(_NARROWEST, ell // 10)
    first, last = np.maximum(ell - reach, min(2, lmax)), np.minimum(ell + reach, lmax) + 1
    modes, total = np.append(0.0, np.cumsum(2.0 * ell + 1.0)), np.append(0.0, np.cumsum(summed))
    return np.asarray((total[last] - total[first]) / (modes[last] - modes[first]))
