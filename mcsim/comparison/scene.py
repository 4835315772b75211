"""What one channel of a simulation is made of, so that a part can be exchanged and the maps be made again."""

from collections import OrderedDict
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import Moments
from mcsim.simulation import convolve
from mcsim.simulation.survey import Channel
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix

Alm = NDArray[np.complex128]
Maps = NDArray[np.float64]
"""Maps of one channel, uK, shape (split, npix)."""

KEPT = 4
"""Transforms that are kept: scenes with the same sky and beam differ in their moments alone."""

WEAKEST = 1e-4
"""Share of its largest value below which a beam's window is not divided out."""


@dataclass(frozen=True, eq=False)
class Transforms:
    """The sky through each order of the beam at the pixels' centres: S_0, its gradient, and S_s by s, uK."""

    circular: NDArray[np.float64]
    gradient: NDArray[np.float64]
    spins: dict[int, NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class Scene:
    """Sky, beam, pixel window and scan of a channel.

    Attributes
    ----------
    sky
        Coefficients of the sky, uK, up to ``lmax``.
    beam, window
        Beam, and pixel window of shape (lmax + 1,).
    moments
        Orientation moments of every split.
    nthreads
        Threads of the transforms.
    kept
        Transforms of scenes made from this one.
    """

    sky: Alm
    beam: Beam
    window: NDArray[np.float64]
    moments: tuple[Moments, ...]
    nthreads: int = 1
    kept: OrderedDict[tuple[bytes, ...], Transforms] = field(default_factory=OrderedDict, repr=False)

    @property
    def lmax(self) -> int:
        """Highest degree."""
        return self.window.size - 1

    @property
    def nside(self) -> int:
        """Of the maps."""
        return self.moments[0].nside

    @cached_property
    def response(self) -> convolve.Response:
        """Beam times pixel window."""
        return convolve.response(self.beam, self.lmax, self.window)

    @property
    def _transforms(self) -> Transforms:
        key = (self.sky.tobytes(), self.response.factors.tobytes())
        if key not in self.kept:
            circular = convolve.circular_alm(self.sky, self.response)
            self.kept[key] = Transforms(
                healpix.synthesis(circular[None], self.nside, self.lmax, nthreads=self.nthreads)[0],
                healpix.gradient(circular, self.nside, self.lmax, self.nthreads),
                convolve.spin_maps(self.sky, self.response, self.nside, self.nthreads),
            )
            while len(self.kept) > KEPT:
                self.kept.popitem(last=False)
        self.kept.move_to_end(key)
        return self.kept[key]

    def noncircular(self) -> Maps:
        """Return what the non-circular part of the beam adds to each map."""
        return np.stack([convolve.noncircular_map(self._transforms.spins, m) for m in self.moments])

    def maps(self) -> Maps:
        """Return the maps, without noise."""
        made = self.noncircular() + self._transforms.circular
        for own, m in zip(made, self.moments, strict=True):
            if m.dtheta is not None:
                own += convolve.centroid_map(self._transforms.gradient, m)
        return made

    def with_moments(self, change: NDArray[np.complex128] | None) -> "Scene":
        """Return the scene with w_s times ``change[s - 1]``, or with conj(w_s) for None."""
        moments = [replace(m, w=np.conj(m.w) if change is None else change[: m.smax, None] * m.w) for m in self.moments]
        return replace(self, moments=tuple(moments))


def scene_of(channel: Channel, sky: Alm, nthreads: int) -> Scene:
    """Return the scene of a channel of a survey, without its effects."""
    moments = tuple(m.moments for m in channel.maps)
    return Scene(sky, channel.site.beam, channel.window, moments, nthreads)


def sky_in(maps: Maps, seen: NDArray[np.bool_], empty: Scene, iterations: int = 3) -> Alm:
    """Return the sky that a channel's maps show: their mean, with beam and pixel window divided out.

    Parameters
    ----------
    maps, seen
        Shape (split, npix) each; what is not seen is filled with the sky itself.
    empty
        Scene of the channel; its sky is not used.
    iterations
        Each takes off what the scene adds to the smoothed sky, and fills holes.
    """
    factor = empty.response.factors[0].real
    inverse = np.divide(1.0, factor, out=np.zeros_like(factor), where=factor > WEAKEST * factor.max())
    count = np.maximum(seen.sum(axis=0), 1)
    holes = ~seen.any(axis=0)
    sky = np.zeros(alm_.size(empty.lmax), dtype=np.complex128)
    smooth = np.zeros(maps.shape[1])
    scene = empty
    for _ in range(iterations + (20 if holes.any() else 0)):
        extra = scene.maps() - smooth if sky.any() else np.zeros_like(maps)
        mean = np.where(seen, maps - extra, 0.0).sum(axis=0) / count
        whole = np.where(holes, smooth, mean)
        found = healpix.analysis(whole, empty.lmax, iterations=3, nthreads=empty.nthreads)
        sky = alm_.multiply(found, inverse, empty.lmax)
        scene = replace(empty, sky=sky)
        smooth = scene._transforms.circular
    return sky
