"""A pixel window made by averaging: maps of a finer grid, of which every pixel is the mean of its sub-pixels."""

from collections import OrderedDict
from dataclasses import replace

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.comparison.differences import Difference, State
from mcsim.comparison.pairs import ChannelPair
from mcsim.comparison.scene import Maps, Scene, keep
from mcsim.simulation import convolve
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.support.arrays import Vector

FINEST = 2048  #: largest nside of the sub-pixels that are tried, but for the first two powers of two
LEVELS = 4  #: powers of two by which they are finer
TELLING = 0.5  #: correlation with what is left that the mean of 4 sub-pixels has at least, if others are tried
KEPT = 12  #: responses that are kept


class PixelAverage(Difference):
    """Pixels of side B are means of sub-pixels, those of side A are not; or the other way round (-1).

    The mean differs from the pixel window by the shapes of the pixels, which change over the sky. What it does to the
    non-circular part of the beam, a small part of a small part, is left out.
    """

    name, unit = "pixel_window", "times too often"
    met = "healpy.ud_grade of a finer map, beside a map that was made at this nside"
    stage = 1

    def __init__(self) -> None:
        self._made: OrderedDict[tuple[bytes, ...], NDArray[np.float64]] = OrderedDict()

    def starts(self, state: State) -> list[Vector]:
        """Return sign, power of two, and 1 if the other side's sky has the pixel window, where one tells something."""
        if state.scene is None or state.scene.preparations:
            return []
        nside, rest, values = state.scene.nside, state.rest(state.maps), []
        levels = [k for k in range(1, LEVELS + 1) if k <= 2 or 2**k * nside <= FINEST]
        for windowed in (0.0, 1.0):
            made = state.beside(self._response(np.array([1.0, 1.0, windowed]), state.scene))
            told = float(made @ rest) / max(float(np.linalg.norm(made) * np.linalg.norm(rest)), 1e-300)
            if abs(told) > TELLING:
                values += [np.array([np.sign(told), k, windowed]) for k in levels]
        return values

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        return replace(scene, added=lambda bare: self._response(value, bare))

    def _response(self, value: Vector, scene: Scene) -> Maps:
        circular = convolve.circular_alm(scene.sky, scene.response)
        key = (value.tobytes(), circular.tobytes())
        if key not in self._made:
            sign, level, nside, lmax = value[0], int(value[1]), scene.nside, scene.lmax
            own = healpix.pixel_window(nside, lmax) if value[2] else np.ones(lmax + 1)
            # The window that the scene has on top of the sky that is averaged.
            before = _mean_window(scene, level) if sign < 0 else own
            sky = alm_.multiply(circular, 1.0 / before, lmax)
            here = alm_.multiply(sky, own, lmax)
            fine, there = (
                healpix.synthesis(alm[None], n, lmax, nthreads=scene.nthreads)[0]
                for alm, n in ((sky, 2**level * nside), (here, nside))
            )
            keep(self._made, key, sign * (healpy.ud_grade(fine, nside) - there), KEPT)
        return np.stack([self._made[key]] * len(scene.moments))

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
