"""Differences that belong to single samples: baselines along the scan, and a sky that is looked up on a grid."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields, replace

import healpy
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import aslinearoperator, lsqr

from mcsim.comparison.differences import Difference, State
from mcsim.comparison.pairs import ChannelPair
from mcsim.comparison.scene import Maps, PointingFiles, Scene
from mcsim.simulation import convolve, tod
from mcsim.sphere import healpix
from mcsim.support.arrays import Vector
from mcsim.systematics.base import Pointing

PIXELS_PER_BASELINE = 4  #: pixels that are seen for every baseline at least: with fewer, baselines make any map
FEWEST = 16  #: baselines at least
PREDICTED = 0.5  #: share of half of the pixels' variance that baselines fitted to the other half must explain

SCREENING, FITTED = 1e-3, 1e-6
"""Accuracy of fits of baselines that are tried, and of those that are named: gradient over sizes of matrix and rest."""

SAMPLES = 30_000_000  #: samples of the longest survey whose single samples are fitted or looked up
FINEST = 4  #: largest power of two by which a grid's nside may exceed that of the maps
BAND = 0.02  #: share of the sky in which grids are tried
TELLING = 0.1  #: share of the rms there that a grid's errors must explain
FAR = 0.1  #: rms over the sky's of what is left from which on time stamps of another part of the sky may make it


class MapMaking(Difference):
    """Side B lacks offsets of the time line that side A has, or has others: baselines of a destriper."""

    name, unit = "map_making", "uK rms"
    met = "binned against destriped maps of the same noise, or baselines of another length"
    stage = 2
    enough = 0.8

    def __init__(self) -> None:
        self._made: dict[bytes, Maps] = {}

    def starts(self, state: State) -> list[Vector]:
        """Return rms and length in samples of the baselines that predict half of the pixels best from the others."""
        pair, pointing = state.pair, state.pair.pointing(SAMPLES)
        if pointing is None or state.scene is None or state.scene.preparations:
            return []
        rest = np.where(pair.seen, pair.b - state.maps, 0.0)
        number, total = sum(float(m.hits.sum()) for m in state.scene.moments), float(np.sum(rest**2))
        length = int(np.ceil(number * PIXELS_PER_BASELINE / pair.seen.sum()))
        shares = list(_shares(pair, pointing, length))
        # Longer baselines are sums of the shortest ones, which explain the most of the pixels that they are fitted to.
        if np.sum((rest - _all_fitted(shares, rest, pair.seen, SCREENING)) ** 2) > (1.0 - PREDICTED) * total:
            return []
        tried = [(1.0, length, shares)]
        while number / length > FEWEST * len(rest):
            lost = sum(_lost(p, r, s) for p, r, s in zip(shares, rest, pair.seen, strict=True) if s.any()) / total
            tried.append((lost, length, shares))
            length *= 2
            shares = [_merged(p) for p in shares]
        lost, length, shares = min(tried, key=lambda one: one[0])
        if lost > 1.0 - PREDICTED:
            return []
        made = _all_fitted(shares, rest, pair.seen, FITTED)
        value = np.array([np.sqrt(np.mean(made[pair.seen] ** 2)), length])
        self._made[value.tobytes()] = made
        return [value]

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return maps + self._made[value.tobytes()]

    def parameters(self, value: Vector) -> dict[str, float | str]:
        return {"baseline_samples": float(value[1])}


def _shares(pair: ChannelPair, pointing: Pointing | PointingFiles, length: int) -> Iterator[csc_array]:
    """Yield the share of every sample in its pixel, shape (npix, baseline), of each split."""
    assert pair.scene is not None
    for split, moments in enumerate(pair.scene.moments):
        pixels = np.concatenate([one.astype(np.int32) for one in pair.scene.pixels(pointing, split)])
        edges = np.append(np.arange(0, pixels.size, length), pixels.size).astype(np.int32)
        yield csc_array((1.0 / moments.hits[pixels], pixels, edges), shape=(moments.npix, edges.size - 1))


def _merged(share: csc_array) -> csc_array:
    """Return the same with two baselines in place of one."""
    edges = np.append(share.indptr[:-1:2], share.indptr[-1])
    return csc_array((share.data, share.indices, edges), shape=(share.shape[0], edges.size - 1))


def _made_by_baselines(
    share: csc_array, rest: NDArray[np.float64], fitted: NDArray[np.bool_], accuracy: float
) -> NDArray[np.float64]:
    """Return what baselines that are fitted to some pixels make of all, shape (npix,)."""
    own = aslinearoperator(diags_array(fitted.astype(float))) @ aslinearoperator(share)
    found = lsqr(own, np.where(fitted, rest, 0.0), atol=accuracy, btol=accuracy, iter_lim=100)[0]
    return np.asarray(share @ found)


def _lost(share: csc_array, rest: NDArray[np.float64], seen: NDArray[np.bool_]) -> float:
    """Return the squares that baselines fitted to either half of the pixels leave of the other."""
    half = np.random.default_rng(0).random(rest.size) < 0.5
    lost = 0.0
    for fitted in (seen & half, seen & ~half):
        held = seen & ~fitted
        lost += float(np.sum((rest - _made_by_baselines(share, rest, fitted, SCREENING))[held] ** 2))
    return lost


def _all_fitted(shares: Sequence[csc_array], rest: Maps, seen: NDArray[np.bool_], accuracy: float) -> Maps:
    """Return what baselines that are fitted to all pixels make of them, 0 where they are not seen."""
    made = [_made_by_baselines(*one, accuracy) for one in zip(shares, rest, seen, strict=True)]
    return np.where(seen, np.stack(made), 0.0)


class Interpolation(Difference):
    """Side B looks the smoothed sky up on a HEALPix grid: between four pixels, or in the nearest one."""

    name, unit = "interpolation", "nside of the grid"
    met = "healpy.get_interp_val, or the nearest pixel, of a smoothed map"
    stage = 2

    def __init__(self) -> None:
        self._made: dict[tuple[float | bytes, ...], Maps] = {}

    def starts(self, state: State) -> list[Vector]:
        """Return nside, and 1 for an interpolation or 0 for the nearest pixel, of grids whose errors are large enough.

        They fall with the square of nside, and with nside. The nearest pixel of the maps' own nside is its centre.
        Fine grids are large: those that explain nothing of a band of pixels are not made of the whole sky.
        """
        pair = state.pair
        if state.scene is None or pair.pointing(SAMPLES) is None:
            return []
        band = np.zeros_like(pair.seen)
        band[:, slice(None) if state.scene.preparations else _band(pair)] = True
        here, values = band & pair.seen, []
        free = np.zeros((0, int(here.sum()))) if state.free is None else state.free[:, band[pair.seen]]
        beside = np.linalg.qr(free.T)[0]

        def size(maps: Maps) -> float:
            rest = maps[here]
            return max(float(np.std(rest - beside @ (beside.T @ rest))), 1e-300)

        rest = pair.b - state.maps
        for linear, power in ((1.0, 2.0), (0.0, 1.0)):
            finer = (
                np.log2(size(self._response(np.array([state.scene.nside, linear]), pair, True)) / size(rest)) / power
            )
            for k in {int(np.floor(finer)), int(np.ceil(finer))}:
                value = np.array([2.0**k * state.scene.nside, linear])
                if not 1.0 - linear <= k <= FINEST:
                    continue
                if size(rest - self._response(value, pair, True)) < (1.0 - TELLING) * size(rest):
                    values.append(value)
        return values

    def _response(self, value: Vector, pair: ChannelPair, narrow: bool = False) -> Maps:
        scene, pointing = pair.scene, pair.pointing(SAMPLES)
        assert scene is not None
        assert pointing is not None
        pixels = _band(pair) if narrow and not scene.preparations else slice(0, 12 * scene.nside**2)
        # Also of a draw of the sky that noise hides: what a grid makes of that is not known either.
        key = (*value, pixels.start, pixels.stop, scene.sky.tobytes())
        if key not in self._made:
            grid = looked_up(scene, int(value[0]), bool(value[1]), pixels)
            self._made[key] = scene.sampled(pointing, scene.window, grid) - scene.sampled(pointing, scene.window)
        return self._made[key]

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        return maps + self._response(value, state.pair)

    def found(self, value: Vector) -> str:
        return "in side A"

    def parameters(self, value: Vector) -> dict[str, float | str]:
        return {"between": "four pixels" if value[1] else "the nearest pixel"}


def _band(pair: ChannelPair) -> slice:
    """Return the band of pixels, a share :data:`BAND` of the sky along its parallels, that is seen best."""
    known = np.append(0, np.cumsum(pair.seen.sum(axis=0)))
    width = int(np.ceil(BAND * pair.a.shape[1]))
    first = int(np.argmax(known[width:] - known[:-width]))
    return slice(first, first + width)


def looked_up(scene: Scene, nside: int, linear: bool, pixels: slice) -> tod.Stage:
    """Return a stage that adds the sky through the beam, looked up on a grid at the samples' directions.

    Samples outside ``pixels``, along the parallels of the maps, are dropped.
    """
    response = convolve.response(scene.beam, scene.lmax)
    circular = convolve.circular_alm(scene.sky, response)
    theta = healpy.pix2ang(scene.nside, np.array([pixels.start, pixels.stop - 1]))[0]
    theta = np.clip(theta + np.array([-1.0, 1.0]) * np.sqrt(np.pi) / scene.nside, 0.0, np.pi)
    rings = healpix.rings_between(nside, *theta)
    start = int(healpix.geometry(nside)["ringstart"][rings.start])
    smooth = healpix.synthesis(circular[None], nside, scene.lmax, nthreads=scene.nthreads, rings=rings)[0]
    spins = convolve.spin_maps(scene.sky, response, nside, scene.nthreads, rings)

    def stage(stream: Iterable[tod.Samples]) -> Iterator[tod.Samples]:
        for chunk in stream:
            inside = (chunk.pixel >= pixels.start) & (chunk.pixel < pixels.stop)
            kept = tod.Samples(**{each.name: getattr(chunk, each.name)[inside] for each in fields(chunk)})
            if linear:
                pixel, weight = healpy.get_interp_weights(nside, kept.theta, kept.phi)
            else:
                pixel, weight = healpy.ang2pix(nside, kept.theta, kept.phi)[None], np.ones(1)[:, None]
            pixel = pixel - start
            signal = np.sum(weight * smooth[pixel], axis=0)
            for s, (real, imaginary) in spins.items():
                turned = np.cos(s * kept.psi) * real[pixel] + np.sin(s * kept.psi) * imaginary[pixel]
                signal += 2.0 * np.sum(weight * turned, axis=0)
            yield replace(kept, signal_uk=kept.signal_uk + signal)

    return stage


class FarTimeShift(Difference):
    """The signal of side B is attributed to a pointing one sample earlier, or later, however far that is."""

    name, unit = "time_shift", "samples"
    met = "time stamps, or a file of pointings, off by one"
    stage = 2
    ways = (1.0, -1.0)
    mutual = True

    def __init__(self) -> None:
        self._made: dict[tuple[bytes, bytes], Maps] = {}

    def starts(self, state: State) -> list[Vector]:
        """Return a sample more, and less, if what is left is as large as another part of the sky makes it."""
        pair, seen = state.pair, state.pair.seen
        if state.scene is None or pair.channel is None or pair.channel.site.pointing is None:
            return []
        far = np.std((pair.b - state.maps)[seen]) > FAR * np.std(pair.a[seen])
        return super().starts(state) if far and pair.pointing(SAMPLES) is not None else []

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        scene, pointing = state.pair.scene, state.pair.pointing(SAMPLES)
        assert scene is not None
        assert pointing is not None
        key = value.tobytes(), scene.sky.tobytes()
        if key not in self._made:
            there = replace(scene, late=value[0]).sampled(pointing, scene.window)
            self._made[key] = there - scene.sampled(pointing, scene.window)
        return maps + self._made[key]
