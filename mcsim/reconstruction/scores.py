"""Scores of elementary structures in filtered maps: how strongly each looks to be there, before any fit.

The score of a structure t_i, what it adds to map i, is sum_i <r_i, t_i> with r_i the residual over its noise variance:
the derivative of the log-likelihood in its amplitude. Structures that act on the sky are computed from the filtered
sky. Scores of variances and powers are such derivatives too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, pairwise

import healpy
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.special import poch

from mcsim.datavector.wiener_filter import FilteredMaps
from mcsim.reconstruction import sources
from mcsim.reconstruction.choices import Choice
from mcsim.reconstruction.forms import REFERENCE_GHZ
from mcsim.reconstruction.periods import TimeLine
from mcsim.reconstruction.sky_changes import boosts, rotations
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, real
from mcsim.sphere.sky import dipole_alm
from mcsim.support.arrays import Alm, Cl, Map, Matrix, Vector, divided
from mcsim.systematics.spacecraft import axes

ADDED, GAIN = 8, 4  #: highest degree of patterns that are added, and of those that multiply
ORDERS = 4  #: highest order of a beam, and of what follows its orientation
MODULATION = 2  #: highest degree of patterns that multiply the sky itself
TURNED = {1: 3, 2: 4}  #: highest degree of patterns on the sky that turn with the beam, by their spin
MOVING = ("year 1", "spin 1", "spin 2")  #: waves that a beam follows
SUN = "Sun"  #: name of what follows its direction, and that of the Earth's velocity
MOVED = 2  #: highest order of a beam that follows a wave
ELONGATION = 6  #: highest harmonic of the spin phase in what depends on the distance from the Sun
MONTH = (12, 14)  #: harmonics of the year that a month is made of, from 26 to 30 days
HARMONICS = 4  #: highest harmonic of spin phase, year and orientation that is said by itself
BINS = 4  #: ranges of degrees of a profile in l, equal in log l
ACTED_ON = ("sky and dipole", "sky", "dipole")  #: what a wave multiplies, if it is not added
PERIODIC = ("", ACTED_ON[0])  #: what a wave multiplies whose period is not known, or what steps or decays
INDICES = (-3.0, -2.0, 1.5)
"""Power of the frequency, in thermodynamic units, of signals of several channels: synchrotron, free-free, dust."""
GROWTH = 2.0
"""Power of the frequency of changes of gains or beams of several channels: phase errors of a surface (Ruze, Proc. IEEE
54, 633, 1966) and the continuum of water vapour grow so."""
HISTORY = 16  #: equal parts of the survey's time, in which steps and decays are known
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
    #: means of cos and sin of a wave times exp(-i s psi), shape (2, npix), by the wave and s from 1 on; of the Sun
    #: those of the Earth's velocity, and of that turned towards the Sun, south less i times east
    moving: Mapping[tuple[str, int], NDArray[np.complex128]]
    #: means over the samples of every coarse pixel of what they see elsewhere, shape (pixels, pixels), by name
    elsewhere: Mapping[str, csr_matrix]
    #: periods, sources: what the data choose: means of waves, and what compact sources of unit flux add, by their kind
    periods: Mapping[str, tuple[Map, ...]]
    sources: Mapping[str, Map]
    precision: Map  #: one over the variance of the noise
    response: Cl  #: B_l w_l of the channel, shape (lmax + 1,)
    kernel: Cl  #: b_l0 of its beam, shape (lmax + 1,)

    @property
    def spins(self) -> tuple[int, ...]:
        """Return the spins of patterns that turn with the beam, as far as its orientations are known."""
        return tuple(s for s in TURNED if s <= len(self.w))

    @property
    def moves(self) -> tuple[tuple[str, int, int], ...]:
        """Return what a beam may follow, if times are known: waves and the Sun, orders, and numbers of coordinates."""
        waves = [(wave, s, 4 if s else 2) for wave in MOVING for s in range(MOVED + 1)]
        return (*waves, (SUN, 1, 2)) if self.moving else ()


@dataclass(frozen=True, eq=False)
class Scene:
    """Describe the maps of a survey, and name their scores."""

    #: channels, frequencies, splits: names, GHz or None, names ("" for the only one)
    channels: tuple[str, ...]
    frequencies: tuple[float | None, ...]
    splits: tuple[str, ...]
    foregrounds: tuple[bool, ...]  #: False: the maps of a channel are those of a component separation
    #: frame, nside, lmax: of the maps and of the filtered sky; scan_frame: whose meridian waves in psi count from
    frame: str
    scan_frame: str
    nside: int
    lmax: int
    dipole_uk: Vector  #: that the survey sees besides, shape (3,)
    cl: Cl  #: spectrum of the sky, shape (lmax + 1,)
    split_orders: int  #: highest order of a beam that is measured in each map by itself
    views: tuple[View, ...]  #: maps, channel by channel
    #: directions elsewhere in the frame of each channel's beam (x, y, outward) with weights, shape (n, 4), by what
    #: is there, if it is known when and how every sample was pointed, and splits are no sets; else none
    elsewhere: tuple[Mapping[str, Matrix], ...]
    by_rings: bool  #: True if splits are every n-th ring, and not parts of the survey's time
    time_lines: tuple[TimeLine, ...]  #: of every channel, if the pointing of every sample is known; else none
    #: variance of the score of a source in every pixel, of the maps in which it is looked for together
    spreads: tuple[Map, ...] = ()

    @property
    def timed(self) -> bool:
        """Return True if the pointing of every sample is known."""
        return bool(self.elsewhere)

    @property
    def degree(self) -> int:
        """Return the highest degree of patterns that are added."""
        return min(ADDED, self.lmax)

    @cached_property
    def shared(self) -> tuple[int, ...]:
        """Return the maps that may have a signal by their frequencies; none if these are alike or not known."""
        there = tuple(i for i, view in enumerate(self.views) if self.foregrounds[view.channel])
        known = {self.frequencies[self.views[i].channel] for i in there}
        return there if None not in known and len(known) > 1 else ()

    @property
    def scalings(self) -> dict[float, Vector]:
        """Return how strong such a signal is in each of the maps that share it, by the power of the frequency.

        Beside a map of separated components, what all others have alike is no part of the sky itself: the power 0.
        """
        indices = INDICES if all(self.foregrounds) else (0.0, *INDICES)
        return {index: self.scaling(index) for index in (indices if self.shared else ())}

    def scaling(self, index: float) -> Vector:
        """Return a power of the frequency over 94 GHz in each of the maps that share signals by their frequencies."""
        known = [self.frequencies[self.views[i].channel] or REFERENCE_GHZ for i in self.shared]
        return (np.array(known) / REFERENCE_GHZ) ** index

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
        return self.dipole_uk @ healpix.centres(self.nside)

    @cached_property
    def keys(self) -> tuple[Key, ...]:
        """Name the scores in the order of :meth:`values`."""
        found: list[Key] = []
        for i, view in enumerate(self.views):
            found += [("added", i, j) for j in range((self.degree + 1) ** 2)]
            for kind in ("gain of the sky", "gain"):
                found += [(kind, i, j) for j in range((min(GAIN, self.lmax) + 1) ** 2)]
            found += [(kind, i) for kind in ("dipole", "square of the sky", "square", "cube")]
            for s in view.spins:
                found += [("turned", i, s, p, j) for p in (0, 1) for j in range(s**2, (TURNED[s] + 1) ** 2)]
            found += [("lobe", i, 0), ("lobe", i, 1), *(("rotation", i, axis) for axis in range(3))]
            found += _keys_of(i, view.waves)
            found += [("elsewhere", i, name, on) for on in ACTED_ON[1::-1] for name in view.elsewhere]
            found += [("moving", i, wave, s, c) for wave, s, size in view.moves for c in range(size)]
            found += [("history", i, on, k) for on in PERIODIC for k in range(HISTORY if self.timed else 0)]
            found += [("noise", i, j) for j in range(9)]
            for s in range(min(ORDERS, len(view.w)) + 1):
                if s <= self.split_orders or i == self.of(view.channel)[0]:
                    ranges = range(len(self.edges(max(s, 1))) - 1)
                    found += [("beam", i, s, b, c) for b in ranges for c in ((0, 1) if s else (0,))]
        for channel in range(len(self.channels)):
            if len(self.of(channel)) > 1:
                found += [(kind, channel, b) for kind in ("difference", "common") for b in range(len(self.fine) - 1)]
        ranges = range(len(self.fine) - 1)
        found += [("summed", k, b) for k in range(len(self.scalings)) for b in ranges]
        found += [("power", b) for b in ranges]
        found += [("modulation", j) for j in range((MODULATION + 1) ** 2)] + [("boost", axis) for axis in range(3)]
        for i, view in enumerate(self.views):
            found += [*_keys_of(i, view.periods), *(("source", i, kind) for kind in view.sources)]
        return tuple(found)

    @cached_property
    def place(self) -> dict[Key, int]:
        """Return the place of every score."""
        return {key: row for row, key in enumerate(self.keys)}

    @cached_property
    def _patterns(self) -> NDArray[np.float64]:
        """Return the real harmonics up to degree GAIN in every pixel, shape ((GAIN + 1)^2, npix)."""
        n = healpix.centres(self.nside)
        return np.stack([real.field(unit, *n) for unit in np.eye((GAIN + 1) ** 2)])

    @cached_property
    def continua(self) -> list[tuple[int, float]]:
        """Return of each of :meth:`peaks` its coordinates, and among how many independent ones it is chosen."""
        periods = [(2, self.time_lines[c].tried) for c, _ in self._periodic]
        return periods + [(1, self.places) for _ in self._groups]

    @property
    def _periodic(self) -> list[tuple[int, str]]:
        """Return channel and what a wave multiplies of each periodogram; none of surveys too short for any period."""
        return [(c, on) for c, line in enumerate(self.time_lines) if line.tried >= 1.0 for on in PERIODIC]

    @property
    def places(self) -> float:
        """Return the number of independent places of a compact source."""
        return (self.lmax + 1.0) ** 2

    @property
    def _groups(self) -> list[tuple[int, ...]]:
        """Return the maps in which a source is looked for together: those of a channel, and each by itself."""
        channels = [self.of(c) for c in range(len(self.channels))]
        return [*channels, *((i,) for own in channels if len(own) > 1 for i in own)]

    def peaks(self, filtered: FilteredMaps) -> list[Choice]:
        """Return what stands out most of every continuum: periods of a channel, added and of its gain, and sources."""
        residual, whole = filtered.residual, filtered.expected + self.dipole
        products = dict(zip(PERIODIC, (residual, residual * whole), strict=True))
        found = [self.time_lines[c].peak(on, [products[on][i] for i in self.of(c)]) for c, on in self._periodic]
        return found + list(map(sources.brightest, self.bright(filtered), self.spreads))

    def bright(self, filtered: FilteredMaps) -> list[Map]:
        """Return the score of a source in every pixel, in the maps in which it is looked for together."""
        seen = (alm_.multiply(one, v.response, self.lmax) for one, v in zip(filtered.adjoint, self.views, strict=True))
        maps = [healpix.synthesis(one[None], self.nside, self.lmax)[0] for one in seen]
        return [np.sum([maps[i] for i in group], axis=0) for group in self._groups]

    def with_spreads(self, drawn: Sequence[FilteredMaps]) -> "Scene":
        """Return the scene with the variances of the scores of sources, by simulations of the model."""
        each = [sources.variance(view.precision, view.response, self.nside, self.lmax) for view in self.views]
        noise = [np.sum([each[i] for i in group], axis=0) for group in self._groups]
        scores = zip(*map(self.bright, drawn), strict=True)
        return replace(self, spreads=tuple(map(sources.simulated_variance, noise, scores)))

    def values(self, filtered: FilteredMaps) -> Vector:
        """Return the scores, shape (len(keys),)."""
        return np.concatenate([self.listed_values(filtered), self.chosen_values(filtered)])

    def chosen_values(self, filtered: FilteredMaps) -> Vector:
        """Return the scores of what the data choose, the last of :meth:`values`."""
        found: list[NDArray[np.float64]] = [np.zeros(0)]
        for i, view in enumerate(self.views):
            found += self._waves(filtered, i, view.periods)
            found.append(np.array([filtered.residual[i] @ one for one in view.sources.values()]))
        return np.concatenate(found)

    def listed_values(self, filtered: FilteredMaps) -> Vector:
        """Return the scores of the grammar without choices, the first of :meth:`values`."""
        found: list[NDArray[np.float64]] = []
        looked_at = filtered.sky + dipole_alm(self.dipole_uk, self.lmax)
        turned = rotations(looked_at, self.lmax)
        bent = [self._derivatives(looked_at, self.views[self.of(c)[0]].response) for c in range(len(self.channels))]
        for i, view in enumerate(self.views):
            r, sky, adjoint = filtered.residual[i], filtered.expected[i], filtered.adjoint[i]
            whole = sky + self.dipole
            found.append(real.coefficients(adjoint, self.lmax, self.degree))
            top = min(GAIN, self.lmax)
            found += [self._without_dipole(r, sky, adjoint, top), _low(r * whole, top)]
            found.append(np.array([r @ self.dipole, r @ sky**2, r @ whole**2, r @ whole**3]))
            found += [*_turned(r, view), np.array(self._lobe(r, view))]
            through = (alm_.multiply(one, view.response, self.lmax) for one in turned)
            found.append(np.array([_product(adjoint, one, self.lmax) for one in through]))
            found += self._waves(filtered, i, view.waves)
            found += self._elsewhere(r, filtered.sky, i)
            found += [_moving(r, view, wave, bent[view.channel][s], s) for wave, s, _ in view.moves]
            for product in (r, r * whole) if self.timed else ():
                found.append(self.time_lines[view.channel].history(view.split, product, HISTORY))
            found.append(0.5 * self._patterns[:9] @ divided(r**2, view.precision))
            found += list(self._orders(view, filtered.orders[i], i))
        for channel in range(len(self.channels)):
            if len(own := self.of(channel)) > 1:
                pairs = list(combinations([filtered.adjoint[i] for i in own], 2))
                apart = np.sum([self._powers(a - b, a - b) for a, b in pairs], axis=0)
                found += [2.0 / len(own) * apart, np.sum([self._powers(a, b) for a, b in pairs], axis=0)]
        for scaling in self.scalings.values():
            each = ((i, f * filtered.adjoint[i]) for i, f in zip(self.shared, scaling, strict=True))
            total = np.sum([alm_.multiply(one, self.views[i].response, self.lmax) for i, one in each], axis=0)
            found.append(0.5 * self._powers(total, total))
        return np.concatenate([*found, self._of_sky(filtered.sky)])

    def _lobe(self, r: Map, view: View) -> tuple[float, float]:
        """Return the scores of the dipole along the beam's x and y, as a lobe far from the beam sees it."""
        south, east = self._tangent
        c, s = view.w[0].real, -view.w[0].imag  # means of cos psi and sin psi
        return float(r @ (c * south + s * east)), float(r @ (c * east - s * south))

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

    def _waves(self, filtered: FilteredMaps, i: int, waves: Mapping[str, tuple[Map, ...]]) -> list[Vector]:
        """Return the scores of waves in a map: added, and times what they act on."""
        r, sky, every = filtered.residual[i], filtered.expected[i], [one for maps in waves.values() for one in maps]
        on_sky = r * sky - self._leak(filtered.adjoint[i]) * sky
        fields = (r, r * (sky + self.dipole), on_sky, r * self.dipole)
        return [np.array([field @ one for one in every]) for field in fields]

    @cached_property
    def _dipole_elsewhere(self) -> list[list[Map]]:
        """Return the dipole in the directions of samples elsewhere, of every map and of all names, uK."""
        dipole = self.dipole_uk @ healpix.centres(coarse(self.nside))
        return [[one @ dipole for one in view.elsewhere.values()] for view in self.views]

    def _elsewhere(self, r: Map, sky: Alm, i: int) -> list[Vector]:
        """Return the scores of the sky alone, and of sky and dipole, in the directions of samples elsewhere."""
        view = self.views[i]
        if not view.elsewhere:
            return []
        top, nside = min(ELSEWHERE, self.lmax), coarse(self.nside)
        seen = alm_.resize(alm_.multiply(sky, view.response, self.lmax), self.lmax, top)
        alone = healpix.synthesis(seen[None], nside, top)[0]
        summed = healpy.ud_grade(r, nside, power=-2)
        of_sky = np.array([summed @ (one @ alone) for one in view.elsewhere.values()])
        return [of_sky, of_sky + np.array([summed @ one for one in self._dipole_elsewhere[i]])]

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

    def moved(self, wave: str, s: int, theta: Vector, sky: Alm) -> NDArray[np.float64]:
        """Return what a derivative of a sky adds to every map that follows a wave, uK, shape (maps, npix).

        ``theta``: coordinates of the structure, of cosine and then of sine, for s > 0 along and across the beam's x; of
        the Sun along the Earth's velocity and towards the Sun.
        """
        added, pairs = np.zeros((len(self.views), 12 * self.nside**2)), np.reshape(theta, (2, -1))
        along = pairs[:, 0] if s == 0 or wave == SUN else pairs @ [1.0, -1j]
        looked_at = sky + dipole_alm(self.dipole_uk, self.lmax)
        for c in range(len(self.channels)):
            field = self._derivatives(looked_at, self.views[self.of(c)[0]].response)[s]
            for i in self.of(c):
                if s == 0:
                    means = np.tensordot(along, self.views[i].waves[wave], axes=1)
                    added[i] = field[0] * means
                else:
                    turned = along @ self.views[i].moving[wave, s]
                    added[i] = field[0] * turned.real - field[1] * turned.imag
        return added

    def _derivatives(self, alm: Alm, response: Cl) -> list[NDArray[np.float64]]:
        """Return derivatives of a sky through a beam: l (l + 1), and E of spins up to MOVED, shape (1 or 2, npix)."""
        ell = np.arange(self.lmax + 1.0)
        found = []
        for s in range(MOVED + 1 if self.timed else 0):
            shape = np.sqrt(poch(np.maximum(ell - s + 1.0, 0.0), 2 * s)) if s else ell * (ell + 1.0)
            electric = alm_.multiply(alm, response * shape, self.lmax)[None]
            both = np.concatenate([electric, np.zeros_like(electric)]) if s else electric
            found.append(healpix.synthesis(both, self.nside, self.lmax, spin=s) / self.lmax ** (s or 2))
        return found

    def _powers(self, a: Alm, b: Alm) -> Vector:
        """Return the power in ranges of degrees."""
        products = alm_.multiplicity(self.lmax) * (a * b.conj()).real
        power = np.bincount(alm_.degrees(self.lmax), products, self.lmax + 1)
        return np.array([power[low:high].sum() for low, high in pairwise(self.fine)])

    def _of_sky(self, sky: Alm) -> Vector:
        """Return the scores of the sky's power, of patterns that multiply it, and of its motion.

        For what acts on the sky itself the residuals of all maps together are S^-1 s^, without monopole and dipole.
        """
        power = 0.5 * divided(1.0, self.cl) * alm_.power(sky, self.lmax)
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


def _keys_of(i: int, waves: Mapping[str, tuple[Map, ...]]) -> list[Key]:
    """Name the scores of waves in a map."""
    return [(on, i, name, c) for on in ("", *ACTED_ON) for name, maps in waves.items() for c in range(len(maps))]


def coarse(nside: int) -> int:
    """Return the nside of the pixels of what is seen elsewhere."""
    return min(nside, ELSEWHERE // 2)


def _turned(r: Map, view: View) -> list[Vector]:
    """Return the scores of Q cos s psi + U sin s psi, of E and then B of every spin s."""
    found = []
    for s in view.spins:
        both = healpix.adjoint(r * np.stack([view.w[s - 1].real, -view.w[s - 1].imag]), TURNED[s], spin=s)
        found += [real.coefficients(one, TURNED[s], TURNED[s])[s**2 :] for one in both]
    return found


def _moving(r: Map, view: View, wave: str, field: NDArray[np.float64], s: int) -> Vector:
    """Return the scores of a derivative of the sky along and across the beam's x axis, times cosine and sine.

    Of the Sun they are those of the gradient along the Earth's velocity, and towards the Sun.
    """
    if s == 0:
        return np.array([(r * field[0]) @ one for one in view.waves[wave]])
    q, u, w = r * field[0], r * field[1], view.moving[wave, s]
    if wave == SUN:
        return np.array([q @ one.real - u @ one.imag for one in w])
    return np.array([f for one in w for f in (q @ one.real - u @ one.imag, u @ one.real + q @ one.imag)])


def _low(product: Map, top: int) -> Vector:
    return real.coefficients(healpix.adjoint(product, top), top, top)


def _product(a: Alm, b: Alm, lmax: int) -> float:
    return float(np.sum(alm_.multiplicity(lmax) * (a.real * b.real + a.imag * b.imag)))
