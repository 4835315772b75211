"""The bipolar scan and coarse residual maps: many numbers that say where a departure from the model is.

The scan has BipoSH coefficients of residuals and sky, of the sky itself, and power spectra. There are too many numbers
for a covariance: each is compared with its own scatter, and corrected for looking at all. Cosmic variance cancels
between a residual and the sky, so that noise limits the coefficients of one channel.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement, product

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim import bipolar
from mcsim.bipolar import by_degree
from mcsim.datavector.filter_model import Model
from mcsim.datavector.summaries import Element, bins, scales
from mcsim.datavector.wiener_filter import FilteredMaps
from mcsim.sphere import alm as alm_
from mcsim.sphere.rotation import FRAMES, rotate_biposh
from mcsim.support.arrays import Map, Vector, divided

NSIDE = 16  #: of residual maps, if the data are not coarser: finer pixels show noise and little else


@dataclass(frozen=True)
class BipolarScan:
    """Compute the bipolar scan of one model."""

    model: Model

    @cached_property
    def tables(self) -> bipolar.Estimator:
        """Return the estimator, up to the L of the settings, or of the configuration if that is less."""
        model = self.model
        L_max = min(max(model.survey.config.biposh.L_max, 1), model.settings.scan_L_max, self.lmax)
        return bipolar.estimator(L_max, self.lmax, both_orders=True)

    @property
    def lmax(self) -> int:
        """Return the highest degree of the coefficients and powers, that of the configuration."""
        return self.model.survey.lmax

    @cached_property
    def elements(self) -> tuple[Element, ...]:
        """Return the description of each number, in the order of :meth:`values`."""
        return (*(element for element, _ in self._binned), *self._powers())

    def values(self, filtered: FilteredMaps) -> Vector:
        """Return all numbers of a set of maps, shape (numbers,)."""
        sums = self._sums(filtered)
        binned = np.stack([sums.real, sums.imag], axis=-1)[tuple(np.transpose([where for _, where in self._binned]))]
        powers = [by_degree(a, b, self.model.lmax) for a, b in combinations_with_replacement(filtered.adjoint, 2)]
        return np.array([*binned, *(p[low : high + 1].sum() for p in powers for low, high in scales(self.lmax))])

    @property
    def _bins(self) -> list[tuple[int, int]]:
        return bins(2, self.lmax, self.model.settings.scan_bins)

    @cached_property
    def _sources(self) -> list[tuple[Element, int | None, float]]:
        """Return what is correlated with the sky: itself, and sum and (sign -1) difference of a channel's residuals.

        But for the sum of the only channel under an inverse covariance: it is S^-1 s^, the sky once more.
        """
        sky = Element("sky", "biposh", self.model.channels, kind="biposh")
        found: list[tuple[Element, int | None, float]] = [(sky, None, 1.0)]
        alone = len(self.model.channels) == 1 and self.model.inverse is not None
        for channel, name in enumerate(self.model.channels):
            own = Element(name, "biposh", (name,), kind="biposh")
            if not alone:
                found.append((own, channel, 1.0))
            if len(self.model.of(channel)) > 1:
                found.append((replace(own, name=f"{name} difference", split="difference"), channel, -1.0))
        return found

    @cached_property
    def _binned(self) -> list[tuple[Element, tuple[int, ...]]]:
        """Return the sums over bins, each with its place in an array of source, frame, mode, bin and part.

        In other frames than that of the maps only coefficients with M = 0 are measured.
        """
        found: list[tuple[Element, tuple[int, ...]]] = []
        cells = product(range(len(self._sources)), enumerate(FRAMES), enumerate(self.tables.modes))
        for source, (view, frame), (row, mode) in cells:
            alike, channel, _ = self._sources[source]
            turned = frame != self.model.frame and mode.M > 0
            if mode.L == 0 or turned or (channel is None and not mode.in_auto):
                continue
            alike = replace(alike, L=mode.L, M=mode.M, parity=mode.parity, frame=frame)
            for (number, (low, high)), imaginary in product(enumerate(self._bins), mode.parts):
                part = "im" if imaginary else "re"
                name = f"biposh/{alike.name}/{frame}/{mode.name}{part}/{low}-{high}"
                where = (source, view, row, number, int(imaginary))
                found.append((replace(alike, name=name, ell=(low, high)), where))
        return found

    def _powers(self) -> Iterator[Element]:
        """Yield the descriptions of the cross powers of residuals; maps of two splits have no split in common."""
        model = self.model
        for one, two in combinations_with_replacement(model.parts, 2):
            channels = tuple(dict.fromkeys(model.channels[part.channel] for part in (one, two)))
            split = one.split if one.split == two.split else None
            alike = Element(f"cl/{one.name},{two.name}", "cl", channels, split, L=0, M=0, parity="even", kind="cross")
            for low, high in scales(self.lmax):
                yield replace(alike, name=f"{alike.name}/{low}-{high}", ell=(low, high), frame=model.frame)

    def _sums(self, filtered: FilteredMaps) -> NDArray[np.complex128]:
        """Return the sums of coefficients over bins, shape (sources, frames, modes, bins)."""
        model, lmax = self.model, self.lmax
        sky, *adjoint = (alm_.resize(alm, model.lmax, lmax) for alm in (filtered.sky, *filtered.adjoint))
        modes = [(mode.L, mode.M, mode.d) for mode in self.tables.modes]
        found = []
        for _, channel, sign in self._sources:
            if channel is None:
                left = alm_.multiply(sky, model.inverse_cl, lmax)
            else:
                total = sum(sign**place * adjoint[i] for place, i in enumerate(model.of(channel)))
                # A dipole beside the sky's quadrupole would look like L = 3; it has a place of its own.
                response = np.where(np.arange(model.lmax + 1) >= 2, model.response[channel], 0.0)
                left = alm_.multiply(np.asarray(total), response, lmax)
            own = np.nan_to_num(bipolar.estimate(self.tables, left, sky))
            found.append(np.stack([own[:, low : high + 1].sum(axis=1) for low, high in self._bins], axis=1))
        sums = np.stack(found)  # a rotation mixes modes of the same degrees: it may come after the sums
        views = [sums if to == model.frame else rotate_biposh(sums, modes, model.frame, to) for to in FRAMES]
        return np.stack(views, axis=1)


def coarse_residuals(model: Model, filtered: FilteredMaps) -> Map:
    """Return sum of N^-1 (d - P s^) over the fine pixels in each coarse one, RING, shape (map, 12 nside^2), uK^-1."""
    nside = min(NSIDE, model.nside)
    fine = healpy.ring2nest(model.nside, np.arange(12 * model.nside**2))
    coarse = healpy.nest2ring(nside, fine // (model.nside // nside) ** 2)
    return np.stack([np.bincount(coarse, weights=row, minlength=12 * nside**2) for row in filtered.residual])


def rms(drawn: Map) -> Map:
    """Return the rms of the maps of each simulation over their common scatter, shape (N, map), from (N, map, npix).

    Where the filter leaves much of the sky, pixels are correlated, and the rms of a single sky is not near 1.
    """
    if not drawn.size:
        return np.zeros(drawn.shape[:2])
    spread = drawn.std(axis=0, ddof=1)
    z = divided(drawn - drawn.mean(axis=0), spread, np.nan)
    return np.asarray(np.sqrt(np.nanmean(z**2, axis=2)))
