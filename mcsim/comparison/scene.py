"""What one channel of a simulation is made of, so that a part can be exchanged and the maps be made again."""

from collections import OrderedDict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import Moments, ScanModel
from mcsim.instrument.scan.geometry import MapGrid
from mcsim.simulation import convolve, tod
from mcsim.simulation.survey import Channel
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.systematics.base import Pointing

Alm = NDArray[np.complex128]
Maps = NDArray[np.float64]
"""Maps of one channel, uK, shape (split, npix)."""

KEPT = 4
"""Transforms that are kept: scenes with the same sky and beam differ in their moments alone."""

EPSILON = 1e-7
"""Accuracy of the interpolation of single samples."""

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
    psi
        Sign and offset in radians of the samples' orientation, beside that of the model.
    centred
        True if samples stand at their pixels' centres.
    motion
        Scan model in place of the channel's; None: that.
    kept
        Transforms of scenes made from this one.
    """

    sky: Alm
    beam: Beam
    window: NDArray[np.float64]
    moments: tuple[Moments, ...]
    nthreads: int = 1
    psi: tuple[int, float] = (1, 0.0)
    centred: bool = False
    motion: ScanModel | None = None
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

    def turned(self, angle: float) -> "Scene":
        """Return the scene with all samples turned by an angle, in radians."""
        orders = np.arange(1, self.moments[0].smax + 1)
        phases = np.exp(-1j * orders * angle)[:, None]
        moments = tuple(replace(m, w=phases * m.w) for m in self.moments)
        return replace(self, moments=moments, psi=(self.psi[0], self.psi[1] + angle))

    def reversed(self) -> "Scene":
        """Return the scene with all samples' orientations of the other sign."""
        moments = tuple(replace(m, w=np.conj(m.w)) for m in self.moments)
        return replace(self, moments=moments, psi=(-self.psi[0], -self.psi[1]))

    def sampled(self, pointing: Pointing, window: NDArray[np.float64]) -> Maps:
        """Return the maps sample by sample, without the approximations of :meth:`maps`.

        Parameters
        ----------
        pointing
            Of the channel.
        window
            Pixel window that the spread of the samples makes by itself, shape (lmax + 1,).
        """
        factor = self.window if self.centred else self.window / window
        sky = alm_.multiply(self.sky, factor, self.lmax)
        signal = tod.sky_signal(sky, self.lmax, self.beam, EPSILON, self.nthreads)
        model, count = self.motion or pointing.model, len(self.moments)
        made = []
        for i in range(count):
            grid = MapGrid(self.nside, self.moments[0].frame, (i / count, (i + 1) / count))
            made.append(tod.bin_samples(signal(self._pointed(tod.samples(model, pointing.line, grid))), self.nside)[0])
        return np.stack(made)

    def _pointed(self, samples: Iterable[tod.Samples]) -> Iterator[tod.Samples]:
        sign, offset = self.psi
        for chunk in samples:
            theta, phi = healpy.pix2ang(self.nside, chunk.pixel) if self.centred else (chunk.theta, chunk.phi)
            yield replace(chunk, theta=theta, phi=phi, psi=sign * chunk.psi + offset)


def scene_of(channel: Channel, sky: Alm, nthreads: int) -> Scene:
    """Return the scene of a channel of a survey, without its effects."""
    moments = tuple(m.moments for m in channel.maps)
    return Scene(sky, channel.site.beam, channel.window, moments, nthreads)


def sky_in(maps: Maps, seen: NDArray[np.bool_], empty: Scene, iterations: int = 3) -> Alm:
    """Return the sky that a channel's maps show: their mean, with beam and pixel window divided out.

    What a map of that nside cannot hold, above l = 3 nside - 1, is zero.

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
        shown = min(empty.lmax, 3 * empty.nside - 1)
        found = healpix.analysis(whole, shown, iterations=3, nthreads=empty.nthreads)
        sky = alm_.multiply(alm_.resize(found, shown, empty.lmax), inverse, empty.lmax)
        scene = replace(empty, sky=sky)
        smooth = scene._transforms.circular
    return sky
