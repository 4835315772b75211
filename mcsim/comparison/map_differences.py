"""Differences of the maps themselves: units, calibration, monopole and dipole, order of pixels, exchanged files."""

import healpy
import numpy as np

from mcsim.comparison.differences import Difference, State, Vector
from mcsim.comparison.scene import Maps
from mcsim.sphere import header


class Calibration(Difference):
    """The maps of side B are those of side A times a factor."""

    name, unit = "calibration", "fraction"
    met = "a beam that is not normalised, or another calibration"
    needs_scene = False

    def starts(self, state: State) -> list[Vector]:
        return [state.fit([state.maps])]

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return (1.0 + value[0]) * maps


class Unit(Difference):
    """The maps of side B are in another unit."""

    name, unit = "unit", "factor"
    met = "K taken for uK, or antenna for CMB temperature"
    needs_scene = False

    def starts(self, state: State) -> list[Vector]:
        factors = [1e-6, 1e-3, 1e3, 1e6]
        frequency = None if state.pair.channel is None else state.pair.channel.site.frequency_ghz
        if frequency is not None:
            x = 0.047992430 * frequency / header.T_CMB_K  # h nu/(k T)
            to_cmb = np.expm1(x) ** 2 / (x**2 * np.exp(x))
            factors += [to_cmb, 1.0 / to_cmb]
        found = 1.0 + float(state.fit([state.maps])[0])
        return [np.array([f]) for f in factors if found > 0.0 and abs(np.log(f / found)) < 2e-3]

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return value[0] * maps

    def equivalent(self, value: Vector) -> list[tuple[str, float, str]]:
        return [("calibration", float(value[0]) - 1.0, "fraction")]


class Monopole(Difference):
    """Side B has a monopole that side A has not."""

    name, unit = "monopole", "uK"
    met = "a mean that one map-maker subtracts"
    needs_scene = False

    def starts(self, state: State) -> list[Vector]:
        return [state.fit([np.ones_like(state.maps)])]

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return maps + value[0]


class Dipole(Difference):
    """Side B has a dipole that side A has not."""

    name, unit = "dipole", "uK"
    met = "the solar dipole left in, or subtracted, on one side"
    needs_scene = False

    def starts(self, state: State) -> list[Vector]:
        return [state.fit([np.broadcast_to(axis, state.maps.shape) for axis in _axes(state.pair.nside)])]

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return maps + value @ _axes(state.pair.nside)

    def amplitude(self, value: Vector) -> float:
        return float(np.linalg.norm(value))

    def parameters(self, value: Vector) -> dict[str, float | str]:
        lon, lat = healpy.vec2ang(value, lonlat=True)
        return {"lon_deg": float(lon[0]), "lat_deg": float(lat[0])}


def _axes(nside: int) -> Vector:
    return np.array(healpy.pix2vec(nside, np.arange(12 * nside**2)))


class Ordering(Difference):
    """Pixels of side B are NESTED where RING is said, or the other way round."""

    name, unit = "ordering", "1 = NESTED for RING"
    met = "a header that does not say what the pixels are"
    needs_scene = False

    def starts(self, state: State) -> list[Vector]:
        return [np.array([1.0]), np.array([-1.0])]

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        order = {"r2n": True} if value[0] > 0 else {"n2r": True}
        return np.stack([healpy.reorder(one, **order) for one in maps])


class SplitExchanged(Difference):
    """Two splits are exchanged in side B."""

    name, unit = "split_exchanged", "1 = exchanged"
    met = "files of halves that were renamed"
    needs_scene = False

    def starts(self, state: State) -> list[Vector]:
        count = len(state.maps)
        return [np.array([float(i), float(j)]) for i in range(count) for j in range(i)]

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        i, j = value.astype(int)
        order = list(range(len(maps)))
        order[i], order[j] = order[j], order[i]
        return maps[order]

    def amplitude(self, value: Vector) -> float:
        return 1.0


class ChannelExchanged(Difference):
    """Side B has another channel's maps."""

    name, unit = "channel_exchanged", "1 = exchanged"
    met = "detectors listed in another order"
    needs_scene = False

    def starts(self, state: State) -> list[Vector]:
        return [np.array([float(i)]) for i, m in enumerate(state.others.values()) if m.shape == state.maps.shape]

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return list(state.others.values())[int(value[0])]

    def amplitude(self, value: Vector) -> float:
        return 1.0


class NoiseShared(Difference):
    """A later split of side B has noise in common with the first one, instead of its own."""

    name, unit = "noise_shared", "correlation"
    met = "random seeds that do not depend on the detector or the split"
    needs_scene = False

    def starts(self, state: State) -> list[Vector]:
        return [state.fit([self._other(state.maps)])] if len(state.maps) > 1 else []

    @staticmethod
    def _other(maps: Maps) -> Maps:
        difference = maps[0] - maps
        difference[0] = 0.0
        return difference

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return maps + value[0] * self._other(maps)
