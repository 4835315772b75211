"""Localise a departure from the model: coefficients of residuals and sky, groups of them, and residual maps.

The bipolar scan has BipoSH coefficients of residuals and sky, of the sky itself, and power spectra. There are too many
numbers for a covariance: each is compared with its own scatter, and corrected for looking at all. Cosmic variance
cancels between a residual and the sky, so that noise limits the coefficients of one channel.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement, product

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim import bipolar
from mcsim.beamfit.data import parts
from mcsim.diagnosis.summaries import Element, bins, scales
from mcsim.diagnosis.wiener_filter import FilteredMaps, Model, by_degree
from mcsim.sphere import alm as alm_
from mcsim.sphere.rotation import FRAMES, rotate_biposh
from mcsim.stats.look_elsewhere import scan_pvalues
from mcsim.support.arrays import Map, Vector

NSIDE = 16
"""Of residual maps, if the data are not coarser: finer pixels show noise and little else."""


@dataclass(frozen=True)
class BipolarScan:
    """Compute the bipolar scan of one model."""

    model: Model

    @cached_property
    def tables(self) -> bipolar.Estimator:
        """Return the estimator, up to the L of the settings, or of the configuration if that is less."""
        model = self.model
        L_max = min(max(model.survey.config.biposh.L_max, 1), model.settings.scan_L_max, model.lmax)
        return bipolar.estimator(L_max, model.lmax, both_orders=True)

    @cached_property
    def elements(self) -> tuple[Element, ...]:
        """Return the description of each number, in the order of :meth:`values`."""
        return (*(element for element, _ in self._binned), *self._powers())

    def values(self, filtered: FilteredMaps) -> Vector:
        """Return all numbers of a set of maps, shape (numbers,)."""
        sums = self._sums(filtered)
        binned = np.stack([sums.real, sums.imag], axis=-1)[tuple(np.transpose([where for _, where in self._binned]))]
        powers = [by_degree(a, b, self.model.lmax) for a, b in combinations_with_replacement(filtered.adjoint, 2)]
        return np.array([*binned, *(p[low : high + 1].sum() for p in powers for low, high in scales(self.model.lmax))])

    @property
    def _bins(self) -> list[tuple[int, int]]:
        return bins(2, self.model.lmax, self.model.settings.scan_bins)

    @cached_property
    def _sources(self) -> list[tuple[Element, int | None, float]]:
        """Return what is correlated with the sky: itself, and sum and (sign -1) difference of a channel's residuals."""
        sky = Element("sky", "biposh", self.model.channels, kind="biposh")
        found: list[tuple[Element, int | None, float]] = [(sky, None, 1.0)]
        for channel, name in enumerate(self.model.channels):
            own = Element(name, "biposh", (name,), kind="biposh")
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
            for (number, (low, high)), imaginary in product(enumerate(self._bins), parts(mode)):
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
            for low, high in scales(model.lmax):
                yield replace(alike, name=f"{alike.name}/{low}-{high}", ell=(low, high), frame=model.frame)

    def _sums(self, filtered: FilteredMaps) -> NDArray[np.complex128]:
        """Return the sums of coefficients over bins, shape (sources, frames, modes, bins)."""
        model, lmax = self.model, self.model.lmax
        modes = [(mode.L, mode.M, mode.d) for mode in self.tables.modes]
        found = []
        for _, channel, sign in self._sources:
            if channel is None:
                left = alm_.multiply(filtered.sky, model.inverse_cl, lmax)
            else:
                total = sum(sign**place * filtered.adjoint[i] for place, i in enumerate(model.of(channel)))
                # A dipole beside the sky's quadrupole would look like L = 3; it has a place of its own.
                response = np.where(np.arange(lmax + 1) >= 2, model.response[channel], 0.0)
                left = alm_.multiply(np.asarray(total), response, lmax)
            own = np.nan_to_num(bipolar.estimate(self.tables, left, filtered.sky))
            found.append(np.stack([own[:, low : high + 1].sum(axis=1) for low, high in self._bins], axis=1))
        sums = np.stack(found)  # a rotation mixes modes of the same degrees: it may come after the sums
        views = [sums if to == model.frame else rotate_biposh(sums, modes, model.frame, to) for to in FRAMES]
        return np.stack(views, axis=1)


@dataclass(frozen=True)
class Place:
    """Describe a group of numbers that belong together, and how far it departs from the model."""

    element: Element  # the number of the group that departs most
    z: float  # normal deviate of the group
    p: float  # global p-value: that the largest departure of all groups is as large


def places(x: Vector, simulations: Vector, elements: Sequence[Element], level: float = 0.01) -> list[Place]:
    """Rank groups of numbers, shape (B,), by their departure from simulations, shape (N, B).

    Elements that share statistic, channels, split, frame, L, M and parity are a group. One group of each kind comes
    before the others of it if its global p-value is at most ``level``.

    Notes
    -----
    A kind is a frame, an L and a parity: one effect shows in every channel and split that it acts on, and a list of
    these would hide all else. Groups that are not significant stay in the order of their deviates. The cube root of a
    group's sum of squared deviates is nearly normal (Wilson & Hilferty, PNAS 17, 684, 1931); it is compared with those
    of the simulations, each taken against the others.
    """
    mean, spread = simulations.mean(axis=0), simulations.std(axis=0, ddof=1)
    spread = np.where(spread > 0, spread, np.inf)
    deviates = (x - mean) / spread / np.sqrt(1.0 + 1.0 / len(simulations))
    others = (simulations - mean) / spread
    groups: dict[tuple[object, ...], list[int]] = {}
    for number, e in enumerate(elements):
        groups.setdefault((e.statistic, e.channels, e.split, e.frame, e.L, e.M, e.parity), []).append(number)
    rows = list(groups.values())
    found = np.array([np.mean(deviates[row] ** 2) for row in rows])
    drawn = np.stack([np.mean(others[:, row] ** 2, axis=1) for row in rows], axis=1)
    z, p = scan_pvalues(np.cbrt(found), np.cbrt(drawn))
    # A group with too small deviates is no departure.
    p = np.where(z > 0, p, 1.0)
    firsts: list[Place] = []
    rest: list[Place] = []
    seen: set[tuple[object, ...]] = set()
    for group in np.argsort(-z):
        most = max(rows[group], key=lambda number: abs(deviates[number]))
        place = Place(elements[most], float(z[group]), float(p[group]))
        kind = (place.element.frame, place.element.L, place.element.parity)
        new = kind not in seen and (place.p <= level or not seen)
        (firsts if new else rest).append(place)
        seen.add(kind)
    return firsts + rest


def coarse_residuals(model: Model, filtered: FilteredMaps) -> Map:
    """Return sum of N^-1 (d - P s^) over the fine pixels in each coarse one, RING, shape (map, 12 nside^2), uK^-1."""
    nside = min(NSIDE, model.nside)
    fine = healpy.ring2nest(model.nside, np.arange(12 * model.nside**2))
    coarse = healpy.nest2ring(nside, fine // (model.nside // nside) ** 2)
    return np.stack([np.bincount(coarse, weights=row, minlength=12 * nside**2) for row in filtered.residual])


def standardised(x: Map, mean: Map, scatter: Map, count: int) -> Map:
    """Return coarse residuals of data less the mean and over the scatter of ``count`` > 3 simulations.

    All have the shape (map, npix). The variance is one in every pixel where the model is right; NaN where nothing was
    observed.

    Notes
    -----
    The filter leaves a part of the sky in the residual (at high l, behind a mask), so that noise alone is not the
    scatter. x less the mean of N, over their scatter, is Student's t with N - 1 degrees of freedom times
    sqrt(1 + 1/N), of variance (1 + 1/N) (N - 1)/(N - 3), by which it is divided.
    Rms of simulated data: tests/integration/test_diagnosis.py.
    """
    seen = scatter > 0.0
    scale = np.sqrt((1.0 + 1.0 / count) * (count - 1.0) / (count - 3.0))
    return np.where(seen, (x - mean) / np.where(seen, scatter, 1.0) / scale, np.nan)


def rms(drawn: Map) -> Map:
    """Return the rms of the maps of each simulation over their common scatter, shape (N, map), from (N, map, npix).

    Where the filter leaves much of the sky, pixels are correlated, and the rms of a single sky is not near 1.
    """
    if not drawn.size:
        return np.zeros(drawn.shape[:2])
    spread = drawn.std(axis=0, ddof=1)
    z = np.divide(drawn - drawn.mean(axis=0), spread, out=np.full_like(drawn, np.nan), where=spread > 0.0)
    return np.asarray(np.sqrt(np.nanmean(z**2, axis=2)))
