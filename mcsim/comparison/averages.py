"""A pixel window made by averaging: maps of a finer grid, of which every pixel is the mean of its sub-pixels."""

from collections import OrderedDict
from dataclasses import replace

import healpy
import numpy as np

from mcsim.comparison.differences import Difference, State
from mcsim.comparison.pairs import ChannelPair
from mcsim.comparison.scene import Maps, Scene
from mcsim.instrument.scan import Moments
from mcsim.sphere import healpix
from mcsim.support.arrays import Vector

FINEST = 2048
"""Largest nside of the sub-pixels that are tried, but for the first two powers of two."""

LEVELS = 4
"""Powers of two by which they are finer."""

TELLING = 0.5
"""Correlation with what is left that the mean of 16 sub-pixels has at least, if others are tried."""

KEPT = 12
"""Responses that are kept."""


class PixelAverage(Difference):
    """Pixels of side B are means of sub-pixels, those of side A are not; or the other way round (-1).

    The mean differs from the pixel window by the shapes of the pixels, which change over the sky.
    """

    name, unit = "pixel_window", "times too often"
    met = "healpy.ud_grade of a finer map, beside a map that was made at this nside"
    stage = 1

    def __init__(self) -> None:
        self._made: OrderedDict[tuple[bytes, ...], Maps] = OrderedDict()

    def starts(self, state: State) -> list[Vector]:
        """Return sign, power of two, and 1 if the other side's sky has the pixel window, where one tells something."""
        if state.scene is None or state.scene.preparations:
            return []
        nside, values = state.scene.nside, []
        levels = [k for k in range(1, LEVELS + 1) if k <= 2 or 2**k * nside <= FINEST]
        rest = state.rest(state.maps)
        for sign in (1.0, -1.0):
            for windowed in (0.0, 1.0):
                made = state.beside(self._response(np.array([sign, 2.0, windowed]), state.scene))
                if made @ rest > TELLING * np.linalg.norm(made) * np.linalg.norm(rest):
                    values += [np.array([sign, k, windowed]) for k in levels]
        return values

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        return replace(scene, added=lambda bare: self._response(value, bare))

    def _response(self, value: Vector, scene: Scene) -> Maps:
        key = (value.tobytes(), scene.sky.tobytes(), scene.response.factors.tobytes())
        if key not in self._made:
            sign, level, windowed = value[0], int(value[1]), bool(value[2])
            own, mean = healpix.pixel_window(scene.nside, scene.lmax), _mean_window(scene, level)
            # The window that the sky of the scene has on top of that of the sky that is averaged.
            before = mean if sign < 0 else own if windowed else np.ones_like(own)
            centred = replace(scene.at_centres(), window=scene.window / before)
            there = replace(centred, window=centred.window * own) if windowed else centred
            self._made[key] = sign * (averaged(centred, level) - there.maps())
            while len(self._made) > KEPT:
                self._made.popitem(last=False)
        return self._made[key]

    def inverse(self, value: Vector) -> Vector:
        return value * np.array([-1.0, 1.0, 1.0])

    def parameters(self, value: Vector) -> dict[str, float | str]:
        by = f"the mean of {4 ** int(value[1])} sub-pixels"
        return {"by": by + (" in place of the isotropic window" if value[2] else "")}


def _mean_window(scene: Scene, level: int) -> Vector:
    """Return the window of the mean of 4^level sub-pixels; its square tends to the pixel window's as 4^-level."""
    few = healpix.mean_window(scene.nside, 2 ** min(level, 2), scene.lmax)
    if level <= 2:
        return few
    whole = healpix.pixel_window(scene.nside, scene.lmax)
    return np.asarray(np.sqrt(whole**2 + (few**2 - whole**2) / 4.0 ** (level - 2)))


def averaged(scene: Scene, level: int) -> Maps:
    """Return maps of a scene whose pixels are means over 4^level sub-pixels, seen with the pixels' orientations."""
    fine = scene.nside * 2**level
    base = np.arange(12 * fine**2)
    parent = healpy.nest2ring(scene.nside, healpy.ring2nest(fine, base) >> 2 * level)
    moments = tuple(Moments(fine, m.frame, m.hits[parent], m.w[:, parent]) for m in scene.moments)
    there = replace(scene, moments=moments, kept=OrderedDict())
    return np.stack([np.bincount(parent, one, 12 * scene.nside**2) / 4**level for one in there.maps()])
