"""Differences of the maps themselves: units, calibration, monopole and dipole, order of pixels, exchanged files."""

from dataclasses import replace
from pathlib import Path

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.comparison.differences import Difference, State
from mcsim.comparison.looks import neighbours
from mcsim.comparison.pairs import ChannelPair
from mcsim.comparison.scene import Maps, Scene
from mcsim.sphere import alm as alm_
from mcsim.sphere import header, healpix
from mcsim.support.arrays import Vector, divided

SCREENED = 50_000  #: pixels on which orders of pixels are compared at most
ALIKE = 0.5  #: correlation of neighbouring pixels from which on maps are no noise

OWN = 0.3
"""Rms by which the sides of a channel that was not exchanged differ at most.

It is counted over that by which its side B differs from side A of the channel whose maps it might have.
"""

BROUGHT = 0.5
"""Share of another channel's noise, over that of a map's own that is gone, which has to be there to be shared."""

MORE_ALIKE = 0.2
"""By how much mirrored maps must correlate more with side B: maps of different skies do so by chance, or a little."""

TOLD = 0.5  #: share of the pixels that are compared in which maps that may have been exchanged must have data

LEAST, MOST = 0.1, 10.0  #: factors that a calibration is between; others are a unit's


class Calibration(Difference):
    """The maps of side B are those of side A times a factor."""

    name, unit = "calibration", "fraction"
    met = "a beam that is not normalised, or another calibration"
    needs_scene = False
    proportional = True
    moved = 1

    def starts(self, state: State) -> list[Vector]:
        """Return the fraction, and 0 for maps with their noise or 1 for the sky alone, where they have noise.

        Maps that share less than half of their variance are not each other's times a factor.
        """
        found, seen = [np.array([*state.fit([state.maps]), 0.0])], state.pair.seen
        if not LEAST < 1.0 + found[0][0] < MOST or 2.0 * np.sum(((1.0 + found[0][0]) * state.maps[seen]) ** 2) < np.sum(
            state.pair.b[seen] ** 2
        ):
            return []
        if state.scene is not None and state.pair.doubt is not None:
            found.append(np.array([*state.fit([state.scene.maps()]), 1.0]))
        return found

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        return replace(scene, sky=(1.0 + value[0]) * scene.sky) if value[1] else scene

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return maps if value[1] else (1.0 + value[0]) * maps

    def within(self, value: Vector) -> Vector:
        return np.array([np.clip(value[0], LEAST - 1.0, MOST - 1.0), value[1]])

    def inverse(self, value: Vector) -> Vector:
        return np.array([-value[0] / (1.0 + value[0]), value[1]])


class Unit(Difference):
    """The maps of side B are in another unit, or have the other sign."""

    name, unit = "unit", "factor"
    met = "K taken for uK, antenna for CMB temperature, or model less data for data less model"
    needs_scene = False
    exchanges = True

    def starts(self, state: State) -> list[Vector]:
        found = 1.0 + float(state.fit([state.maps])[0])
        size = float(np.std(state.pair.b[state.pair.seen]) / np.std(state.maps[state.pair.seen]))
        # Factors of ten are exact, whatever else differs; antenna temperature depends on the band and on T_CMB.
        near = {f for f in (1e-6, 1e-3, 1e3, 1e6) for x in (size, found) if 0.1 < x / f < 10.0}
        near |= {-f for f in (1e-6, 1e-3, 1.0, 1e3, 1e6) if 0.1 < -found / f < 10.0}
        tens = [np.array([f]) for f in sorted(near)]
        if found <= 0.0:
            return tens
        frequency = None if state.pair.channel is None else state.pair.channel.site.frequency_ghz
        bands = []
        for unit in ("uK_RJ", "MJy/sr", "Jy/sr") if frequency else ():
            factor = header.to_uk(unit, Path("map"), frequency)
            bands += [1.0 / factor, factor]
        return tens + [np.array([found]) for f in bands if abs(np.log(f / found)) < 2e-3]

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return value[0] * maps

    def undone(self, maps: Maps, value: Vector) -> Maps:
        return np.where(maps == healpy.UNSEEN, maps, maps / value[0])

    def inverse(self, value: Vector) -> Vector:
        return 1.0 / value

    def size(self, value: Vector) -> float:
        return min(1.0, abs(float(value[0])))

    def said(self, value: Vector) -> str:
        """Return words for a negative factor."""
        return "the other sign" if value[0] < 0.0 else ""

    def equivalent(self, value: Vector) -> list[tuple[str, float, str]]:
        """Return the calibration that does the same, if it could be one."""
        return [("calibration", float(value[0]) - 1.0, "fraction")] if LEAST < value[0] < MOST else []


class Monopole(Difference):
    """Side B has a monopole that side A has not."""

    name, unit = "monopole", "uK"
    met = "a mean that one map-maker subtracts"
    needs_scene = False
    proportional = True

    def starts(self, state: State) -> list[Vector]:
        return [state.fit([np.ones_like(state.maps)])]

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return maps + value[0]


class Dipole(Difference):
    """Side B has a dipole that side A has not."""

    name, unit = "dipole", "uK"
    met = "the solar dipole left in, or subtracted, on one side"
    needs_scene = False
    proportional = True

    def starts(self, state: State) -> list[Vector]:
        return [state.fit([np.broadcast_to(axis, state.maps.shape) for axis in healpix.centres(state.pair.nside)])]

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return maps + value @ healpix.centres(state.pair.nside)

    def amplitude(self, value: Vector) -> float:
        return float(np.linalg.norm(value))

    def parameters(self, value: Vector) -> dict[str, float | str]:
        lon, lat = healpy.vec2ang(value, lonlat=True)
        return {"lon_deg": float(lon[0]), "lat_deg": float(lat[0])}


class Ordering(Difference):
    """Pixels of side B are NESTED where RING is said, or the other way round."""

    name, unit = "ordering", "1 = NESTED for RING"
    met = "a header that does not say what the pixels are"
    needs_scene = False
    exchanges = mutual = True
    ways = (1.0, -1.0)

    def starts(self, state: State) -> list[Vector]:
        """Return both ways, if side B is more like the prediction then, dipoles aside."""
        bare = _alike(state.maps, state)
        return [way for way in super().starts(state) if _alike(self.maps(state.maps, way, state), state) > bare]

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        if state.pair.usable is not None:  # side B may have anything elsewhere
            usable = self.undone(np.where(state.pair.usable, maps, healpy.UNSEEN), -value)
            if _tells(usable != healpy.UNSEEN, state.pair.seen):
                return _complete(usable, state)
        return _complete(self.undone(maps, -value), state)

    def undone(self, maps: Maps, value: Vector) -> Maps:
        order = {"n2r": True} if value[0] > 0 else {"r2n": True}
        return np.stack([healpy.reorder(one, **order) for one in maps])


def _alike(maps: Maps, state: State) -> float:
    """Return the correlation of side B with maps, dipoles aside, in some of the pixels."""
    some = np.arange(maps.shape[1]) % max(1, maps.shape[1] // SCREENED) == 0
    seen = state.pair.seen & (maps != healpy.UNSEEN) & some
    axes = np.hstack([healpix.centres(state.pair.nside)[:, one] for one in seen])
    known = np.vstack([np.ones(axes.shape[1]), axes]).T
    one, other = (v - known @ np.linalg.lstsq(known, v, rcond=None)[0] for v in (maps[seen], state.pair.b[seen]))
    return float(np.corrcoef(one, other)[0, 1])


class FrameReversed(Difference):
    """Longitudes, or latitudes, of side B have the other sign: of its sky, or of its pixels."""

    name, unit = "frame_reversed", "1 = mirrored"
    met = "longitudes that count to the west, or colatitudes taken for latitudes"
    needs_scene = counted = False
    exchanges = True

    def starts(self, state: State) -> list[Vector]:
        """Return the mirrored coordinate (0 longitude, 1 latitude), and 1 for the sky alone, where B is more alike."""
        bare = _alike(state.maps, state) + MORE_ALIKE
        ways = [axis for axis in (0, 1) if _alike(_complete(_mirrored(state.maps, axis), state), state) > bare]
        levels = [0] if state.scene is None or state.scene.preparations else [0, 1]
        return [np.array([axis, level], dtype=float) for axis in ways for level in levels]

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        if not value[1]:
            return scene
        signs = (-1.0) ** (alm_.degrees(scene.lmax) + alm_.orders(scene.lmax))
        return replace(scene, sky=signs * scene.sky if value[0] else np.conj(scene.sky))

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return maps if value[1] else _complete(_mirrored(maps, int(value[0])), state)

    def undone(self, maps: Maps, value: Vector) -> Maps | None:
        return None if value[1] else _mirrored(maps, int(value[0]))

    def parameters(self, value: Vector) -> dict[str, float | str]:
        return {"coordinate": ("longitude", "latitude")[int(value[0])], "of": "the sky" if value[1] else "the pixels"}


def _mirrored(maps: Maps, axis: int) -> Maps:
    """Return maps with longitudes (0) or latitudes (1) of the other sign."""
    nside = healpy.npix2nside(maps.shape[1])
    theta, phi = healpy.pix2ang(nside, np.arange(maps.shape[1]))
    there = (np.pi - theta, phi) if axis else (theta, 2.0 * np.pi - phi)
    return maps[:, healpy.ang2pix(nside, *there)]


class SplitExchanged(Difference):
    """Two splits are exchanged in side B."""

    name, unit = "split_exchanged", "1 = exchanged"
    met = "files of halves that were renamed"
    needs_scene = counted = False
    exchanges = True

    def starts(self, state: State) -> list[Vector]:
        """Return all pairs of splits that both differ."""
        seen, data = state.pair.seen, state.pair.a != healpy.UNSEEN
        differing = np.flatnonzero(seen.any(axis=1)).tolist()
        both = [[i, j] for i in differing for j in differing if j < i]
        return [np.array(pair, dtype=np.float64) for pair in both if _tells(data[pair[::-1]], seen[pair])]

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return _complete(self.undone(maps, value), state)

    def undone(self, maps: Maps, value: Vector) -> Maps:
        i, j = value.astype(int)
        order = list(range(len(maps)))
        order[i], order[j] = order[j], order[i]
        return maps[order]


def _tells(data: NDArray[np.bool_], seen: NDArray[np.bool_]) -> bool:
    """Return True if exchanged maps have data in enough of the pixels that are compared."""
    return int(np.sum(data & seen)) > TOLD * int(seen.sum())


def _complete(exchanged: Maps, state: State) -> Maps:
    """Return exchanged maps, and side B where they have no data and so nothing to say."""
    return np.where(exchanged == healpy.UNSEEN, state.pair.b, exchanged)


class ChannelExchanged(Difference):
    """Side B has another channel's maps."""

    name, unit = "channel_exchanged", "1 = exchanged"
    met = "detectors listed in another order"
    needs_scene = counted = False

    def starts(self, state: State) -> list[Vector]:
        """Return the numbers of the channels whose sides differ, if one of all may have this channel's maps."""
        alike = [(i, other) for i, other in enumerate(state.others) if other.a.shape == state.maps.shape]
        if all(_kept(other, state.pair) for _, other in alike):
            return []
        differing = [(i, other) for i, other in alike if _rms(other.b - other.a, other.seen) > state.floor]
        return [np.array([float(i)]) for i, other in differing if _tells(other.a != healpy.UNSEEN, state.pair.seen)]

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return _complete(state.others[int(value[0])].a, state)


def _kept(other: ChannelPair, pair: ChannelPair) -> bool:
    """Return True if another channel's side B is its own side A rather than that of a pair."""
    seen = other.seen & pair.shown
    return _rms(other.b - other.a, seen) < OWN * _rms(other.b - pair.a, seen)


def _rms(maps: Maps, seen: NDArray[np.bool_]) -> float:
    return float(np.sqrt(np.mean(maps[seen] ** 2))) if seen.any() else 0.0


def _is_noise(maps: Maps, state: State) -> bool:
    """Return True unless neighbouring pixels are alike, as what a wrong beam leaves of a sky is and noise is not."""
    if state.scene is not None and state.scene.preparations:
        return True
    alike = [neighbours(one, one != 0.0) for one in maps if one.any()]
    return bool(alike) and min(alike) < ALIKE


def _has_noise(pair: ChannelPair) -> bool:
    return pair.noise_uk is not None and bool(pair.noise_uk.any())


def _of_both(noise: Maps, value: Vector, state: State) -> bool:
    """Return True if other noise less a map's own is not that alone, as it is where one side has none."""
    pair, (changed, source) = state.pair, value[1:3].astype(int)
    assert pair.noise_uk is not None
    there = state.others[source].noise_uk if changed < 0 else pair.noise_uk[[source]]
    own = pair.noise_uk if changed < 0 else pair.noise_uk[[changed]]
    assert there is not None
    expected = np.sum(own**2) / (np.sum(own**2) + np.sum(there**2))
    rest = pair.a - (0.0 if pair.scene is None else pair.scene.maps())
    return -float(np.sum(noise * rest)) < 0.5 * (1.0 + expected) * float(np.sum(noise**2))


def _is_brought(noise: Maps, way: Vector, state: State) -> bool:
    """Return True if another channel's noise less a map's own explains side B by what it brings.

    What noise hides of the sky is in both of what the sky leaves of the channels, and what a beam makes of it in side B
    is like the difference of these. It is not in the noise of the other channel about the sky of its own maps.
    """
    if way[0] >= 0:
        return True
    pair, there = state.pair, state.others[int(way[1])]
    if pair.scene is None or there.scene is None:
        return True
    own = pair.a - pair.scene.maps()
    skies = there.scene.maps() - replace(there.scene, sky=pair.scene.sky).maps()
    [exchanged] = state.fit([noise])
    brought, *_ = state.fit([noise, *(np.where(noise != 0.0, one, 0.0) for one in (own, skies))])
    return bool(brought * exchanged > BROUGHT * exchanged**2)


class NoiseShared(Difference):
    """One split of side B has noise in common with another one, or all have with another channel."""

    name, unit = "noise_shared", "correlation"
    met = "random seeds that do not depend on the detector or the split"
    needs_scene = False
    enough = 0.8  # the sky is known no better than the noise lets it be
    moved = 1

    def starts(self, state: State) -> list[Vector]:
        """Return share that fits, split that is changed (-1: all), split or channel that it is shared with, and how.

        Noise of the same samples, or of the same deviates and other hits; from maps, or less the sky simulated. Only
        what the model says to be noise is shared.
        """
        if not _has_noise(state.pair):
            return []
        count = len(state.maps)
        splits = [(j, i) for j in range(count) for i in range(count) if i != j]
        alike = [(k, other) for k, other in enumerate(state.others) if other.a.shape == state.maps.shape]
        channels = [(-1, k) for k, other in alike if _has_noise(other)]
        simulated = [] if state.pair.scene is None else [(1, 0), (1, 1)]
        ways = [(*pair, *manner) for pair in splits for manner in [(0, 0), (0, 1), *simulated]]
        ways += [(*pair, *manner) for pair in channels for manner in simulated]  # as they are, they are exchanged
        made = [(np.array([0.0, *way]), self._exchanged(np.array([0.0, *way]), state)) for way in ways]
        return [
            value + np.eye(5)[0] * state.fit([maps])
            for value, maps in made
            if _is_noise(maps, state) and _of_both(maps, value, state) and _is_brought(maps, value[1:], state)
        ]

    def _exchanged(self, way: Vector, state: State) -> Maps:
        """Return other noise less a map's own: the difference of the maps, less that of the sky in them."""
        pair, (changed, source, simulated, scaled) = state.pair, way[1:].astype(int)
        zero = np.zeros_like(pair.a)
        scene = pair.scene
        own = zero if scene is None else scene.maps()
        if changed < 0:
            there = state.others[source]
            sky = zero
            if scene is not None and there.scene is not None:
                sky = replace(there.scene, sky=scene.sky).maps()
            other, seen, hits = there.a, there.seen & pair.seen, there.hits
        else:
            order = np.arange(len(pair.a))
            order[changed] = source
            other, seen, sky = pair.a[order], pair.seen & (pair.a[order] != healpy.UNSEEN), own[order]
            hits = None if pair.hits is None else pair.hits[order]
        noise = other - pair.a - (sky - own if simulated else zero)
        if scaled and hits is not None and pair.hits is not None:
            ratio = np.sqrt(divided(hits, pair.hits, 1.0))
            noise = noise + (ratio - 1.0) * (other - sky)
        return np.where(seen, noise, 0.0)

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return maps + value[0] * self._exchanged(value, state)

    def amplitude(self, value: Vector) -> float:
        """Return the correlation c with which noise of the same size has this share of the other noise less its own.

        Of sqrt(1 - c^2) own + c other, less own, the share that fits is (1 + c - sqrt(1 - c^2))/2.
        """
        twice = np.clip(2.0 * value[0] - 1.0, -np.sqrt(2.0), 1.0)
        return float(twice + np.sqrt(max(2.0 - twice**2, 0.0))) / 2.0

    def found(self, value: Vector) -> str:
        return "in side A"
