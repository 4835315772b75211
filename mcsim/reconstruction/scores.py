"""Scores of elementary structures in filtered maps: how strongly each looks to be there, before any fit.

The score of a structure t_i, what it adds to map i, is sum_i <r_i, t_i> with r_i the residual over its noise variance:
the derivative of the log-likelihood in its amplitude. Structures that act on the sky are computed from the filtered
sky. Scores of variances and powers are such derivatives too.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import healpy
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from mcsim.datavector.wiener_filter import FilteredMaps
from mcsim.reconstruction.forms import boosts, rotations
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, real
from mcsim.sphere.rotation import rotation_matrix
from mcsim.sphere.sky import dipole_alm
from mcsim.support.arrays import Alm, Cl, Map, Matrix, Vector, divided
from mcsim.systematics.spacecraft import axes

ADDED, GAIN = 8, 4  #: highest degree of patterns that are added, and of those that multiply
ORDERS = 4  #: highest order of a beam, and of what follows its orientation
MODULATION = 2  #: highest degree of patterns that multiply the sky itself
ELONGATION = 6  #: highest harmonic of the spin phase in what depends on the distance from the Sun
MONTH = (12, 14)  #: harmonics of the year that a month is made of, from 26 to 30 days
HARMONICS = 4  #: highest harmonic of spin phase, year and orientation that is said by itself
BINS = 4  #: ranges of degrees of a profile in l, equal in log l
ACTED_ON = ("sky and dipole", "sky", "dipole")  #: what a wave multiplies, if it is not added
ELSEWHERE = 32  #: highest degree of a signal from elsewhere: a lobe has as many orders, and what is finer averages out

Key = tuple[str | int, ...]


@dataclass(frozen=True, eq=False)
class View:
    """Describe one map."""

    #: channel, split: indices
    channel: int
    split: int
    w: NDArray[np.complex128]  #: orientation moments, shape (smax, npix)
    #: means over the samples of every pixel of what follows time or orientation: cosine and sine, and so on, by name
    waves: Mapping[str, tuple[Map, ...]]
    #: means over the samples of every coarse pixel of what they see elsewhere, shape (pixels, pixels), by name
    elsewhere: Mapping[str, csr_matrix]
    precision: Map  #: one over the variance of the noise
    response: Cl  #: B_l w_l of the channel, shape (lmax + 1,)
    kernel: Cl  #: b_l0 of its beam, shape (lmax + 1,)


@dataclass(frozen=True, eq=False)
class Scene:
    """Describe the maps of a survey, and name their scores."""

    #: channels, frequencies, splits: names, GHz or None, names ("" for the only one)
    channels: tuple[str, ...]
    frequencies: tuple[float | None, ...]
    splits: tuple[str, ...]
    #: frame, nside, lmax: of the maps and of the filtered sky
    frame: str
    nside: int
    lmax: int
    dipole_uk: Vector  #: that the survey sees besides, shape (3,)
    #: cl, sky_power: spectrum of the sky, and that of the filtered sky over it, shape (lmax + 1,)
    cl: Cl
    sky_power: Cl
    split_orders: int  #: highest order of a beam that is measured in each map by itself
    views: tuple[View, ...]  #: maps, channel by channel
    #: directions elsewhere in the frame of each channel's beam (x, y, outward) with weights, shape (n, 4), by what
    #: is there, if it is known when and how every sample was pointed, and splits are spans of time; else none
    elsewhere: tuple[Mapping[str, Matrix], ...]

    @property
    def timed(self) -> bool:
        """Return True if the pointing of every sample is known."""
        return bool(self.elsewhere)

    @property
    def degree(self) -> int:
        """Return the highest degree of patterns that are added."""
        return min(ADDED, self.lmax)

    def edges(self, first: int) -> tuple[int, ...]:
        """Return where ranges of degrees from ``first`` on start, and lmax + 1."""
        inner = np.geomspace(max(first, 2), self.lmax + 1, BINS + 1).round().astype(int)
        return tuple(sorted({first, *map(int, inner)}))

    @property
    def fine(self) -> tuple[int, ...]:
        """Return the ranges of powers: degrees whose patterns are not measured one by one, if there are enough."""
        return self.edges(ADDED + 1 if self.lmax >= 2 * ADDED else 2)

    def of(self, channel: int) -> tuple[int, ...]:
        """Return the maps of a channel."""
        return tuple(i for i, view in enumerate(self.views) if view.channel == channel)

    @cached_property
    def dipole(self) -> Map:
        """Return the dipole in every pixel, uK."""
        return self.dipole_uk @ np.stack(healpy.pix2vec(self.nside, np.arange(12 * self.nside**2)))

    @cached_property
    def keys(self) -> tuple[Key, ...]:
        """Name the scores in the order of :meth:`values`."""
        found: list[Key] = []
        for i, view in enumerate(self.views):
            found += [("added", i, j) for j in range((self.degree + 1) ** 2)]
            for kind in ("gain of the sky", "gain"):
                found += [(kind, i, j) for j in range((min(GAIN, self.lmax) + 1) ** 2)]
            found += [(kind, i) for kind in ("dipole", "square of the sky", "square", "cube")]
            found += [("Galaxy", i, k) for k in range(5 if len(view.w) > 1 else 0)]
            found += [("lobe", i, 0), ("lobe", i, 1), *(("rotation", i, axis) for axis in range(3))]
            every = [(name, c) for name, maps in view.waves.items() for c in range(len(maps))]
            found += [(on, i, name, c) for on in ("", *ACTED_ON) for name, c in every]
            found += [("elsewhere", i, name, on) for name in view.elsewhere for on in ACTED_ON[:2]]
            found += [("noise", i, j) for j in range(9)]
            for s in range(min(ORDERS, len(view.w)) + 1):
                if s <= self.split_orders or i == self.of(view.channel)[0]:
                    ranges = range(len(self.edges(max(s, 1))) - 1)
                    found += [("beam", i, s, b, c) for b in ranges for c in ((0, 1) if s else (0,))]
        for channel in range(len(self.channels)):
            if len(self.of(channel)) > 1:
                found += [(kind, channel, b) for kind in ("difference", "common") for b in range(len(self.fine) - 1)]
        found += [("power", b) for b in range(len(self.fine) - 1)]
        found += [("modulation", j) for j in range((MODULATION + 1) ** 2)] + [("boost", axis) for axis in range(3)]
        return tuple(found)

    @cached_property
    def place(self) -> dict[Key, int]:
        """Return the place of every score."""
        return {key: row for row, key in enumerate(self.keys)}

    @cached_property
    def _patterns(self) -> NDArray[np.float64]:
        """Return the real harmonics up to degree GAIN in every pixel, shape ((GAIN + 1)^2, npix)."""
        n = healpy.pix2vec(self.nside, np.arange(12 * self.nside**2))
        return np.stack([real.field(unit, *n) for unit in np.eye((GAIN + 1) ** 2)])

    def values(self, filtered: FilteredMaps) -> Vector:
        """Return the scores, shape (len(keys),)."""
        found: list[NDArray[np.float64]] = []
        looked_at = filtered.sky + dipole_alm(self.dipole_uk, self.lmax)
        turned = rotations(looked_at, self.lmax)
        for i, view in enumerate(self.views):
            r, sky, adjoint = filtered.residual[i], filtered.expected[i], filtered.adjoint[i]
            whole = sky + self.dipole
            found.append(real.coefficients(adjoint, self.lmax, self.degree))
            top = min(GAIN, self.lmax)
            found += [self._without_dipole(r, sky, adjoint, top), _low(r * whole, top)]
            found.append(np.array([r @ self.dipole, r @ sky**2, r @ whole**2, r @ whole**3]))
            found += [self._galaxy(r, view), np.array(self._lobe(r, view))]
            through = (alm_.multiply(one, view.response, self.lmax) for one in turned)
            found.append(np.array([_product(adjoint, one, self.lmax) for one in through]))
            every = [one for maps in view.waves.values() for one in maps]
            found += [np.array([field @ one for one in every]) for field in (r, r * whole)]
            lost = self._leak(adjoint) * sky
            found += [np.array([(r * sky - lost) @ one for one in every])]
            found += [np.array([(r * self.dipole) @ one for one in every])]
            found += self._elsewhere(r, filtered.sky, view)
            found.append(0.5 * self._patterns[:9] @ divided(r**2, view.precision))
            found += list(self._orders(view, filtered.orders[i], i))
        for channel in range(len(self.channels)):
            if len(own := self.of(channel)) > 1:
                a, b = filtered.adjoint[own[0]], filtered.adjoint[own[1]]
                found += [self._powers(a - b, a - b), self._powers(a, b)]
        return np.concatenate([*found, self._of_sky(filtered.sky)])

    def _lobe(self, r: Map, view: View) -> tuple[float, float]:
        """Return the scores of the dipole along the beam's x and y, as a lobe far from the beam sees it."""
        south, east = self._tangent
        c, s = view.w[0].real, -view.w[0].imag  # means of cos psi and sin psi
        return float(r @ (c * south + s * east)), float(r @ (c * east - s * south))

    def _galaxy(self, r: Map, view: View) -> Vector:
        """Return the scores of the quadrupole about the galactic pole, as a lobe that turns with the beam sees it."""
        if len(view.w) < 2:
            return np.zeros(0)
        frame = axes(*healpy.pix2ang(self.nside, np.arange(12 * self.nside**2)))
        pole = rotation_matrix(self.frame, "galactic")[2]
        outward, south, east = (pole @ one for one in frame)
        (c, c2), (s, s2) = view.w[:2].real, -view.w[:2].imag
        plus, cross = south**2 - east**2, 2.0 * south * east
        turned = [c2 * plus + s2 * cross, c2 * cross - s2 * plus]
        turned += [outward * (c * south + s * east), outward * (c * east - s * south), outward**2 - 1.0 / 3.0]
        return np.array(turned) @ r

    @cached_property
    def _tangent(self) -> tuple[Map, Map]:
        """Return the dipole's vector along e_theta and e_phi in every pixel, uK."""
        _, south, east = axes(*healpy.pix2ang(self.nside, np.arange(12 * self.nside**2)))
        return self.dipole_uk @ south, self.dipole_uk @ east

    def _without_dipole(self, r: Map, sky: Map, adjoint: Alm, top: int) -> Vector:
        """Return the scores of patterns times the sky, without what these products have of monopole and dipole.

        The model's sky has none, so that they would be most of the score, and follow few modes of this very sky.
        """
        patterns = self._patterns[: (top + 1) ** 2]
        return _low(r * sky, top) - patterns @ (self._leak(adjoint) * sky)

    def _leak(self, adjoint: Alm) -> Map:
        """Return the map whose product with a map is the score of the monopole and dipole of that."""
        low = real.coefficients(adjoint, self.lmax, 1) @ self._patterns[:4]
        return np.asarray(4.0 * np.pi / low.size * low)

    def _elsewhere(self, r: Map, sky: Alm, view: View) -> list[Vector]:
        """Return the scores of sky and dipole, and of the sky alone, in the directions of samples elsewhere."""
        if not view.elsewhere:
            return []
        top, nside = min(ELSEWHERE, self.lmax), coarse(self.nside)
        seen = alm_.resize(alm_.multiply(sky, view.response, self.lmax), self.lmax, top)
        alone = healpix.synthesis(seen[None], nside, top)[0]
        whole = alone + self.dipole_uk @ np.stack(healpy.pix2vec(nside, np.arange(12 * nside**2)))
        summed = healpy.ud_grade(r, nside, power=-2)
        return [np.array([summed @ (one @ whole), summed @ (one @ alone)]) for one in view.elsewhere.values()]

    def _orders(self, view: View, orders: NDArray[np.complex128], i: int) -> list[Vector]:
        ell, found = np.arange(self.lmax + 1), []
        for s in range(min(ORDERS, len(view.w)) + 1):
            if s > self.split_orders and i != self.of(view.channel)[0]:
                continue
            edges = self.edges(max(s, 1))
            profile = orders[s] * view.kernel * (ell / self.lmax) ** max(s, 1)
            for low, high in pairwise(edges):
                total = profile[low:high].sum()
                found.append(np.array([total.real, total.imag] if s else [total.real]))
        return found

    def _powers(self, a: Alm, b: Alm) -> Vector:
        """Return the power in ranges of degrees."""
        power = np.bincount(alm_.degrees(self.lmax), _twice(self.lmax) * (a * b.conj()).real, self.lmax + 1)
        edges = self.fine
        return np.array([power[low:high].sum() for low, high in pairwise(edges)])

    def _of_sky(self, sky: Alm) -> Vector:
        """Return the scores of the sky's power, of patterns that multiply it, and of its motion.

        For what acts on the sky itself the residuals of all maps together are S^-1 s^: the uneven noise that the
        isotropic filter leaves in them would drown it.
        """
        weight = _twice(self.lmax) * np.abs(sky) ** 2
        power = 0.5 * divided(1.0, self.cl) * np.bincount(alm_.degrees(self.lmax), weight, self.lmax + 1)
        expected = alm_.multiply(sky, divided(1.0, self.cl), self.lmax)
        first, second = (healpix.synthesis(one[None], self.nside, self.lmax)[0] for one in (sky, expected))
        area = 4.0 * np.pi / first.size
        return np.concatenate(
            [
                [power[low:high].sum() for low, high in pairwise(self.fine)],
                area * _low(first * second, MODULATION),
                [_product(expected, moved, self.lmax) for moved in boosts(sky, self.lmax)],
            ]
        )


def coarse(nside: int) -> int:
    """Return the nside of the pixels of what is seen elsewhere."""
    return min(nside, ELSEWHERE // 2)


def _low(product: Map, top: int) -> Vector:
    return real.coefficients(healpix.adjoint(product, top), top, top)


def _twice(lmax: int) -> Vector:
    return np.where(alm_.orders(lmax) == 0, 1.0, 2.0)


def _product(a: Alm, b: Alm, lmax: int) -> float:
    return float(np.sum(_twice(lmax) * (a.real * b.real + a.imag * b.imag)))
