"""What one channel of a simulation is made of, so that a part can be exchanged and the maps be made again."""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import Moments, ScanModel
from mcsim.instrument.scan.geometry import MapGrid
from mcsim.instrument.scan.user_pointing import blocks_of_files
from mcsim.simulation import convolve, sampled, simulate, tod
from mcsim.simulation.offsets import expansion, offset_maps
from mcsim.simulation.preparation import Preparation
from mcsim.simulation.survey import Channel, Survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.support.arrays import Alm
from mcsim.systematics.base import Pointing
from mcsim.systematics.shape import displaced

Maps = NDArray[np.float64]  #: maps of one channel, uK, shape (split, npix)
KEPT = 4  #: transforms that are kept: scenes with the same sky and beam differ in their moments alone
KEPT_BEAMS = 64  #: displaced beams that are kept: one for every time shift that is tried
WEAKEST = 1e-4  #: share of its largest value below which a beam's window is not divided out


@dataclass(frozen=True, eq=False)
class Transforms:
    """The sky through each order of the beam at the pixels' centres, and what the samples' offsets add to it, uK.

    ``circular`` is S_0, ``spins`` are S_s by s; ``offsets`` hold a map of every split.
    """

    circular: NDArray[np.float64]
    spins: dict[int, NDArray[np.float64]]
    offsets: list[NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class PointingFiles:
    """A user's own samples of a channel: a file for every split, and the frame they are in."""

    paths: tuple[Path, ...]
    frame: str

    @cached_property
    def angles(self) -> list[list[tuple[NDArray[np.float64], ...]]]:
        """Blocks of theta, phi, psi of every split, radians."""
        return [list(blocks_of_files([path], self.frame)) for path in self.paths]


@dataclass(frozen=True, eq=False)
class Scene:
    """Sky, beam, pixel window and scan of a channel."""

    sky: Alm  #: coefficients of the sky, uK, up to ``lmax``
    #: beam, window: beam, and pixel window of shape (lmax + 1,)
    beam: Beam
    window: NDArray[np.float64]
    moments: tuple[Moments, ...]  #: orientation moments of every split
    #: what is done to the map of every split after it is made; empty: nothing
    preparations: tuple[Preparation, ...] = ()
    nthreads: int = 1  #: threads of the transforms
    spans: tuple[tuple[float, float], ...] = ((0.0, 1.0),)  #: share of the survey's time that every split covers
    #: sign and offset in radians of the samples' orientation, beside that of the model
    psi: tuple[int, float] = (1, 0.0)
    centred: bool = False  #: True if samples stand at their pixels' centres
    motion: ScanModel | None = None  #: scan model in place of the channel's; None: that
    #: late, step: samples by which the signal of a pointing is attributed to an earlier one, and their distance in
    #: radians, of the sign of the spin
    late: float = 0.0
    step: float = 0.0
    #: makes of the scene without it what its maps have besides; None: nothing
    added: "Callable[[Scene], Maps] | None" = None
    #: kept, moved: transforms of scenes made from this one, and their displaced beams
    kept: OrderedDict[tuple[bytes, ...], Transforms] = field(default_factory=OrderedDict, repr=False)
    moved: OrderedDict[tuple[bytes, float, int], Beam] = field(default_factory=OrderedDict, repr=False)
    # By window and identity of a pointing, which is held so that no other one can have it.
    _made: dict[tuple[int, bytes], tuple[object, Maps]] = field(default_factory=dict, init=False, repr=False)

    @property
    def lmax(self) -> int:
        """Highest degree."""
        return self.window.size - 1

    @property
    def nside(self) -> int:
        """Of the maps, before any preparation."""
        return self.moments[0].nside

    @property
    def displaced_beam(self) -> Beam:
        """Return the beam about the pointing of samples that are not late."""
        beam = self.beam
        if self.late:
            way = self.late * self.step
            if self.motion is not None:  # the beam's axes are those of the body, whichever way it spins
                way = self.late * abs(self.step) * np.sign(self.motion.spin_period_s)
            orders = self.moments[0].smax
            key = (beam.blm.tobytes(), way, orders)
            if key not in self.moved:
                moved = displaced(beam, 0.0 if way >= 0.0 else np.pi, abs(way))
                keep(self.moved, key, moved.truncated(min(moved.mmax, orders)), KEPT_BEAMS)
            beam = self.moved[key]
        return beam

    @cached_property
    def response(self) -> convolve.Response:
        """Beam times pixel window."""
        return convolve.response(self.displaced_beam, self.lmax, self.window)

    @cached_property
    def _transforms(self) -> Transforms:
        places = (b"" if m.dtheta is None else m.dtheta.tobytes() for m in self.moments)
        key = (self.sky.tobytes(), self.response.factors.tobytes(), *places, bytes([self.offset_order]))
        if key not in self.kept:
            circular, offsets = self._circular()
            spins = convolve.spin_maps(self.sky, self.response, self.nside, self.nthreads)
            keep(self.kept, key, Transforms(circular, spins, offsets), KEPT)
        self.kept.move_to_end(key)
        return self.kept[key]

    @property
    def offset_order(self) -> int:
        """Highest power of the samples' offsets that counts."""
        return min(m.offset_order for m in self.moments)

    def up_to_offsets(self, order: int) -> "Scene":
        """Return the scene with lower powers of the samples' offsets alone."""
        return replace(self, moments=tuple(m.up_to_offsets(order) for m in self.moments))

    def _circular(self) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
        """Return S_0 and what the samples' offsets add to it in every split."""
        circular = convolve.circular_alm(self.sky, self.response)
        if self.offset_order > 1:
            terms = expansion(self.nside, self.lmax, self.offset_order)
            # The expansion has a window of its own; what a difference makes of the scene's remains.
            own = healpix.pixel_window(self.nside, self.lmax)
            circular = alm_.multiply(circular, 1.0 / own, self.lmax)
            offsets = offset_maps(circular, terms, self.moments, self.nthreads)
            circular = alm_.multiply(circular, terms.smooth, self.lmax)
        elif any(m.dtheta is not None for m in self.moments):
            gradient = healpix.gradient(circular, self.nside, self.lmax, self.nthreads)
            none = np.zeros(gradient.shape[1])
            offsets = [none if m.dtheta is None else convolve.centroid_map(gradient, m) for m in self.moments]
        else:
            offsets = []
        return healpix.synthesis(circular[None], self.nside, self.lmax, nthreads=self.nthreads)[0], offsets

    def noncircular(self) -> Maps:
        """Return what the non-circular part of the beam adds to each map."""
        return self._prepared(self._noncircular())

    def _noncircular(self) -> Maps:
        if self.late and self.psi != (1, 0.0):
            # Late samples move along the scan, however psi is counted; of the beam's shape that is left out.
            along = self.turned(-self.psi[1])
            along = replace(along if self.psi[0] > 0 else along.reversed(), beam=self.beam.truncated(0))
            return along._noncircular() + replace(self, late=0.0)._noncircular()
        return np.stack([convolve.noncircular_map(self._transforms.spins, m) for m in self.moments])

    def _prepared(self, made: Maps) -> Maps:
        """Return maps as they are after their preparation, 0 where they have no data."""
        if not self.preparations:
            return made
        seen = [np.where(m.hits > 0, one, healpy.UNSEEN) for one, m in zip(made, self.moments, strict=True)]
        done = np.stack([steps.apply(one) for steps, one in zip(self.preparations, seen, strict=True)])
        return np.where(done == healpy.UNSEEN, 0.0, done)

    def maps(self) -> Maps:
        """Return the maps, without noise; read-only."""
        return self._maps

    @cached_property
    def _maps(self) -> Maps:
        made = self._noncircular() + self._transforms.circular
        for own, added in zip(made, self._transforms.offsets, strict=False):
            own += added
        made = self._prepared(self._with_added(made))
        made.setflags(write=False)
        return made

    def _with_added(self, made: Maps) -> Maps:
        return made if self.added is None else made + self.added(replace(self, added=None))

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

    def at_centres(self) -> "Scene":
        """Return the scene with all samples at the centres of their pixels; its pixel window stays."""
        return replace(self.up_to_offsets(0), centred=True)

    def stream(self, pointing: Pointing | PointingFiles, split: int) -> Iterable[tod.Samples]:
        """Return the samples of a split, as the scan of the scene has them."""
        if isinstance(pointing, PointingFiles):
            blocks = pointing.angles[split]
            return (
                tod.Samples(0.0 * psi, theta, phi, psi, healpy.ang2pix(self.nside, theta, phi), 0.0 * psi)
                for theta, phi, psi in blocks
            )
        model, grid = self.motion or pointing.model, self._grid(split)
        here = tod.samples(model, pointing.line, grid)
        if not self.late:
            return here
        there = tod.samples(model.ahead(self.late * model.period_of_samples(pointing.line)), pointing.line, grid)
        return (replace(seen, pixel=binned.pixel) for binned, seen in zip(here, there, strict=True))

    def pixels(self, pointing: Pointing | PointingFiles, split: int) -> Iterator[NDArray[np.int64]]:
        """Yield the pixels of the samples of a split, in the order of time."""
        if isinstance(pointing, PointingFiles):
            yield from (healpy.ang2pix(self.nside, theta, phi) for theta, phi, _ in pointing.angles[split])
        else:
            model, grid = self.motion or pointing.model, self._grid(split)
            yield from (chunk.pixel for chunk in tod.samples(model, pointing.line, grid, angles=False))

    def _grid(self, split: int) -> MapGrid:
        return MapGrid(self.nside, self.moments[0].frame, self.spans[split])

    def sampled(
        self, pointing: Pointing | PointingFiles, window: NDArray[np.float64], signal: tod.Stage | None = None
    ) -> Maps:
        """Return the maps sample by sample, without the approximations of :meth:`maps`.

        ``window``: pixel window that the spread of the samples makes by itself, shape (lmax + 1,); ``signal``: how
        samples see the sky, in place of the beam's convolution.
        """
        own, key = signal is None, (id(pointing), window.tobytes())
        if own and key in self._made:
            return self._made[key][1]
        sky = self.sky_of_samples(window)
        signal = signal or tod.sky_signal(sky, self.lmax, self.beam, sampled.EPSILON, self.nthreads)
        streams = (self.stream(pointing, split) for split in range(len(self.moments)))
        binned = np.stack([tod.bin_samples(signal(self._pointed(s)), self.nside)[0] for s in streams])
        made = self._prepared(self._with_added(binned))
        made.setflags(write=False)
        if own:
            self._made[key] = pointing, made
        return made

    def sky_of_samples(self, window: NDArray[np.float64]) -> Alm:
        """Return the sky with what its pixel window has more than the samples' spread makes by itself."""
        return alm_.multiply(self.sky, self.window if self.centred else self.window / window, self.lmax)

    def _pointed(self, samples: Iterable[tod.Samples]) -> Iterator[tod.Samples]:
        sign, offset = self.psi
        for chunk in samples:
            theta, phi = healpy.pix2ang(self.nside, chunk.pixel) if self.centred else (chunk.theta, chunk.phi)
            yield replace(chunk, theta=theta, phi=phi, psi=sign * chunk.psi + offset)


def keep(kept: OrderedDict[Any, Any], key: object, value: object, most: int) -> None:
    """Keep a value, and forget the ones that were longest without use."""
    kept[key] = value
    while len(kept) > most:
        kept.popitem(last=False)


def scene_of(channel: Channel, grid: config.Map, sky: Alm, nthreads: int) -> Scene:
    """Return the scene of a channel of a survey, as its maps are made and without its effects; ``grid``: of its run."""
    moments = tuple(m.moments for m in channel.maps)
    spans = tuple(map(grid.span, range(len(moments))))
    preparations = tuple(m.preparation for m in channel.maps if m.preparation is not None)
    return Scene(sky, channel.site.beam, channel.window, moments, preparations, nthreads, spans)


def files_of(run: config.RunConfig, spec: config.Channel, frame: str) -> PointingFiles | None:
    """Return the samples of a channel whose scan is a file of them; None for other scans."""
    if not isinstance(spec.scan, config.ScanPointing):
        return None
    splits = run.map.splits or (None,)
    return PointingFiles(tuple(config.channel_path(spec.scan.path, spec.name, split) for split in splits), frame)


def maps_of_files(whole: Survey, longest: float, nthreads: int) -> dict[str, Maps] | None:
    """Return the maps of a survey sample by sample by name, if all samples are in files and there are no effects.

    None otherwise, with a preparation, and where a channel has more samples than ``longest``.
    """
    run = whole.config
    pairs = list(zip(run.channels, whole.channels, strict=True))
    files = [files_of(run, spec, channel.site.frame) for spec, channel in pairs]
    number = max(sum(m.moments.hits.sum() for m in channel.maps) for channel in whole.channels)
    if None in files or run.effects or run.preparation or number > longest:
        return None
    sky, found = simulate.draw_sky(whole, 0), {}
    for channel, own in zip(whole.channels, files, strict=True):
        assert own is not None
        scene = scene_of(channel, run.map, sky, nthreads)
        for m, made in zip(channel.maps, scene.sampled(own, scene.window), strict=True):
            found[m.name] = np.where(m.moments.hits > 0, made, healpy.UNSEEN)
    return found
