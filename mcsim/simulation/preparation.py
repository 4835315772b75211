"""Preparation of maps, ``[[preparation]]``: one implementation for simulated maps and for data.

Inside, a map is NaN where it was not observed. Each step changes a map and says what it makes of the sky's window,
of white noise, and of what belongs to the samples of a pixel (hits, orientation moments).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.config import preparation as declared
from mcsim.config.messages import standing
from mcsim.errors import InputError
from mcsim.instrument.beams import Beam, read_window
from mcsim.instrument.scan import Moments
from mcsim.simulation.channels import load_beam
from mcsim.simulation.steps import NEGLIGIBLE, Average, Filled, Filter, Regression, Rotated, Step, Weighted
from mcsim.sphere import healpix, map_files, rotation
from mcsim.sphere.checks import UNSEEN_BELOW, check_complete, check_map
from mcsim.sphere.mask import kept_mask
from mcsim.support.arrays import Map
from mcsim.systematics import Site

LARGEST_GAIN = 10.0  #: of B_l by a change of the beam: a target that asks for more is narrower than the beam


@dataclass(frozen=True)
class Preparation:
    """All steps on the maps of one channel and split, and the nside and frame that they end in."""

    steps: tuple[Step, ...]
    nside: int
    frame: str

    @property
    def transforms(self) -> int:
        """Return the number of scalar transforms of one map."""
        return sum(step.transforms for step in self.steps)

    @property
    def subtracts(self) -> bool:
        """Return True if all steps fit and subtract templates, or mask whole pixels: the rest of the map stays."""
        return all(
            one.coefficients is None if isinstance(one, Regression) else isinstance(one, Weighted) and one.whole
            for one in self.steps
        )

    @property
    def keeps_noise_white(self) -> bool:
        """Return True if no step is in harmonics, or weights pixels otherwise than as a whole."""
        return not self.transforms and all(one.whole for one in self.steps if isinstance(one, Weighted))

    def apply(self, map_uk: Map) -> Map:
        """Return the prepared map, uK, ``healpy.UNSEEN`` where nothing was observed, before as after."""
        check_map(map_uk)
        prepared = np.where(map_uk > UNSEEN_BELOW, map_uk, np.nan)
        for step in self.steps:
            prepared = step.apply(prepared)
        return np.where(np.isfinite(prepared), prepared, healpy.UNSEEN)

    def check(self, hits: Map) -> None:
        """Raise InputError if a step cannot be applied to maps of these hits."""
        seen = np.where(hits > 0, 1.0, np.nan)
        for step in self.steps:
            seen = step.check(seen)

    def beam_window(self, lmax: int) -> NDArray[np.float64]:
        """Return what the steps multiply B_l with, shape (lmax + 1,)."""
        return np.asarray(np.prod([np.ones(lmax + 1), *(step.beam_window(lmax) for step in self.steps)], axis=0))

    def pixel_window(self, lmax: int) -> NDArray[np.float64]:
        """Return what the steps multiply the pixel window with, shape (lmax + 1,)."""
        return np.asarray(np.prod([np.ones(lmax + 1), *(step.pixel_window(lmax) for step in self.steps)], axis=0))

    @property
    def filtering(self) -> int:
        """Return the number of steps before the first in harmonics: they leave white noise white."""
        return next((number for number, step in enumerate(self.steps) if step.transforms), len(self.steps))

    def noise_window(self, lmax: int) -> NDArray[np.float64]:
        """Return what the steps multiply the a_lm of white noise with, but for its local power, shape (lmax + 1,).

        Means over pixels that share no pixel leave white noise white: their windows count after a filter alone.
        """
        later = Preparation(self.steps[self.filtering :], self.nside, self.frame)
        return later.beam_window(lmax) * later.pixel_window(lmax)

    @property
    def masked_between(self) -> bool:
        """Return True if a mask stands between two steps in harmonics."""
        masks = [number for number, step in enumerate(self.steps) if isinstance(step, Weighted)]
        last = max((number for number, step in enumerate(self.steps) if step.transforms), default=0)
        return any(self.filtering < number < last for number in masks)

    def filtered_weight(self) -> Map | None:
        """Return the product of the masks after the first step in harmonics, as :meth:`weight` does."""
        return Preparation(self.steps[self.filtering :], self.nside, self.frame).weight()

    def used(self, npix: int) -> NDArray[np.bool_]:
        """Return the pixels of given maps, shape (npix,), whose values count: not those that are hidden first."""
        hidden, used = np.zeros((2, npix), dtype=bool)
        for step in self.steps:
            match step:
                case Weighted():
                    hidden = hidden | (step.mask == 0.0)
                case Filled():
                    hidden = hidden | step.masked
                case Regression():
                    used = used | ((step.weight > 0.0) & ~hidden)
                case _:
                    break
        return used | ~hidden

    def noise_band(self, fine: int) -> float:
        """Return the variance of the noise over its local power, 1/sr, of maps made at nside ``fine``."""
        if not self.transforms:
            return 1.0 / healpy.nside2pixarea(self.nside)
        ell = np.arange(3 * fine)
        return float(np.sum((2 * ell + 1) / (4 * np.pi) * self.noise_window(ell[-1]) ** 2))

    def noise_uk(self, noise_uk: Map, hits: Map) -> Map:
        """Return the standard deviation of white noise after the steps, uK, 0 without data.

        Filters leave correlated noise; this is its standard deviation where the noise changes slowly over their kernel.
        """
        fine = healpy.npix2nside(hits.size)
        power = np.where(hits > 0, noise_uk**2, np.nan) * healpy.nside2pixarea(fine)
        for number, step in enumerate(self.steps):
            # Fewer pixels in a mean of correlated noise leave its variance as it is.
            correlated = number > self.filtering and isinstance(step, Average)
            power = step.local(power) if correlated else step.noise(power)
        return np.sqrt(np.nan_to_num(self.noise_band(fine) * power))

    def local(self, values: Map) -> Map:
        """Return the means, in prepared pixels, of what belongs to the pixels of maps as they are made, NaN without."""
        for step in self.steps:
            values = step.local(values)
        return values

    def regressions(self) -> list[tuple[NDArray[np.float64], Map]]:
        """Return what is fitted and subtracted, shape (K, npix), and with which weights, as prepared maps show it."""
        found: list[tuple[NDArray[np.float64], Map]] = []
        for step in self.steps:
            if isinstance(step, Regression):
                found += [(step.columns, step.weight)] if step.coefficients is None else []
            else:
                found = [(np.stack(list(map(step.apply, one))), step.local(weight)) for one, weight in found]
        return [(np.nan_to_num(columns), np.nan_to_num(weight)) for columns, weight in found]

    def weight(self) -> Map | None:
        """Return the product of the masks of the steps in the prepared pixels; None without one."""
        return self._weight()[0]

    def smeared(self) -> Map:
        """Return the largest change of that weight by a step in harmonics, shape (npix,); 0 without a mask."""
        return self._weight()[1]

    def _weight(self) -> tuple[Map | None, Map]:
        weight: Map | None = None
        smeared = np.zeros(12 * self.nside**2)
        for step in self.steps:
            if isinstance(step, Weighted):
                weight = step.mask if weight is None else weight * step.mask
            elif weight is not None and not isinstance(step, Filled):
                before, weight = weight, step.local(weight)
                smeared = step.local(smeared) if smeared.any() else np.zeros(weight.size)
                if step.transforms:
                    smeared = np.maximum(smeared, np.abs(step.apply(before) - weight))
        return weight, smeared

    def moments(self, moments: Moments) -> Moments:
        """Return hits, sums over the prepared pixels, and orientation moments, plain means as of the temperatures."""
        hits, w = moments.hits, np.where(moments.hits > 0, moments.w, np.nan)
        for step in self.steps:
            # A filled pixel counts in a mean of temperatures, but nothing was observed there.
            hits = np.nan_to_num(step.local(hits)) if isinstance(step, Filled) else step.local(hits)
            # A file of moments has no orders for a beam that is circular.
            w = step.orientations(w) if len(w) else np.zeros((0, hits.size), dtype=np.complex128)
        hits = hits * (moments.nside / self.nside) ** 2
        moved = self.nside != moments.nside or self.frame != moments.frame
        found = Moments(self.nside, self.frame, np.nan_to_num(hits), np.nan_to_num(w))
        if moved:
            return found
        return replace(found, dtheta=moments.dtheta, dphi=moments.dphi, offset_moments=moments.offset_moments)

    def site(self, site: Site) -> Site:
        """Return what effects may know of a channel whose maps are prepared."""
        turn = rotation.rotation_matrix(site.frame, self.frame)
        beam, dipole = self.beam(site.beam), turn @ site.dipole_uk
        return replace(site, nside=self.nside, frame=self.frame, beam=beam, dipole_uk=dipole)

    def beam(self, beam: Beam) -> Beam:
        """Return a beam after the change of beams, the same for every order.

        That is exact where orientations change slowly over the target beam.
        """
        return replace(beam, blm=beam.blm * self.beam_window(beam.lmax))


def keeps_pixels(preparations: Sequence[Preparation | None]) -> bool:
    """Return True if no map is prepared but by fits that are subtracted and by masks: its pixels and noise stay."""
    return all(one is None or one.subtracts for one in preparations)


def regressions(preparations: Sequence[Preparation | None]) -> list[list[tuple[NDArray[np.float64], Map]]]:
    """Return what is fitted and subtracted from every map, with which weights; what is the same is kept once."""
    known, found = list[tuple[NDArray[np.float64], Map]](), []
    for preparation in preparations:
        own = []
        for one in () if preparation is None else preparation.regressions():
            same = (other for other in known if all(map(np.array_equal, one, other)))
            own.append(next(same, one))
            known.append(own[-1])
        found.append(own)
    return found


def templates_of(preparations: Sequence[Preparation | None]) -> list[NDArray[np.float64] | None]:
    """Return all that is fitted and subtracted from every map, shape (K, npix); None: nothing."""
    made: dict[tuple[int, ...], NDArray[np.float64] | None] = {(): None}
    found = []
    for columns in ([one for one, _ in own] for own in regressions(preparations)):
        key = tuple(map(id, columns))  # equal ones are the same
        if key not in made:
            made[key] = columns[0] if len(columns) == 1 else np.concatenate(columns)
        found.append(made[key])
    return found


def preparation(
    run: config.RunConfig, spec: config.Channel, split: str | None, observed: bool = False
) -> Preparation | None:
    """Return the preparation of the maps of a channel and split; None if the run declares none.

    ``observed``: of data, from which templates with given coefficients are subtracted. InputError for files that cannot
    be used, and a target beam that is narrower than the map's own.
    """
    if not run.preparation:
        return None
    nside, frame = run.map.resolution, str(run.map.frame)
    steps: list[Step] = []
    smoothed: NDArray[np.float64] | None = None
    for number, step in enumerate(run.preparation):
        of_data = isinstance(step, declared.Templates) and bool(step.coefficients) and not step.simulated
        if spec.name in (getattr(step, "channels", ()) or (spec.name,)) and (observed or not of_data):
            with standing(run, f"preparation[{number}]"):
                if isinstance(step, declared.Smooth):
                    change, smoothed = _change_of_beam(step, spec, 3 * nside - 1, smoothed)
                    steps.append(Filter("smooth", nside, nside, change, np.ones(change.size)))
                else:
                    steps.append(_step(step, spec, split, nside, frame))
        nside, frame = declared.grid_after([step], nside, frame)
    return Preparation(tuple(steps), nside, frame)


def check_preparations(run: config.RunConfig) -> None:
    """Raise InputError for steps that cannot be applied to the maps of a run, observed or simulated."""
    for one in run.each_map:
        preparation(run, one.channel, one.split, observed=True)


def _step(step: declared.OtherStep, spec: config.Channel, split: str | None, nside: int, frame: str) -> Step:
    def mask(path: str | None, mask_frame: str | None) -> Map:
        if path is None:
            return np.ones(12 * nside**2)
        kept = kept_mask(config.channel_path(path, spec.name, split), nside, frame, mask_frame)
        if not kept.any():
            raise InputError(f"the mask {path!r} is 0 in every pixel, which leaves nothing; give another one.")
        return kept

    match step:
        case declared.Degrade(method="average"):
            return Average(nside, step.nside)
        case declared.Degrade():
            lmax = 3 * step.nside - 1
            pixels = healpix.pixel_window(step.nside, lmax) / healpix.pixel_window(nside, lmax)
            return Filter("degrade", nside, step.nside, np.ones(lmax + 1), pixels)
        case declared.SubtractDipole():
            return Regression(_harmonics(nside, step.monopole, step.dipole), mask(step.mask, step.mask_frame))
        case declared.Templates():
            read = [_template(config.channel_path(path, spec.name), nside, frame, spec) for path in step.templates]
            columns = np.concatenate([np.stack(read), _harmonics(nside, step.monopole, step.dipole)])
            given = None if step.coefficients is None else np.array(step.coefficients)
            return Regression(columns, mask(step.mask, step.mask_frame), given)
        case declared.Fill():
            value = None if step.method == "diffuse" else step.value_uk
            return Filled(mask(step.mask, step.mask_frame) == 0.0, value)
        case declared.Mask():
            return Weighted(mask(step.mask, step.mask_frame))
        case declared.Rotate():
            return Rotated(frame, step.frame, nside)


def _change_of_beam(
    step: declared.Smooth, spec: config.Channel, lmax: int, smoothed: NDArray[np.float64] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return target B_l over own B_l, and the target, up to where the target or what is left of the beam is negligible.

    ``smoothed``: the target of a step before, which is then the map's own beam; None: there was none.
    """
    if step.fwhm_arcmin is not None:
        target = healpy.gauss_beam(np.deg2rad(step.fwhm_arcmin / 60.0), lmax)
    else:
        found = read_window(config.channel_path(str(step.window), spec.name))
        target = _up_to(lmax, found, f"the target beam of {spec.name}")
    if step.own_fwhm_arcmin is not None:
        own = healpy.gauss_beam(np.deg2rad(step.own_fwhm_arcmin / 60.0), lmax)
    elif step.own_window is not None:
        found = read_window(config.channel_path(step.own_window, spec.name))
        own = _up_to(lmax, found, f"own_window of {spec.name}")
    elif smoothed is not None:
        own = np.pad(smoothed, (0, max(lmax + 1 - smoothed.size, 0)))[: lmax + 1]
    else:
        own = _up_to(lmax, _own_window(spec, lmax), f"the beam of {spec.name}")
    end = int(np.argmin(np.append(np.minimum(np.abs(target), np.abs(own)) > NEGLIGIBLE, False)))
    change: NDArray[np.float64] = target[:end] / own[:end]
    if end == 0 or np.abs(change).max() > LARGEST_GAIN:
        raise InputError(
            f"the target beam is narrower than the beam that the maps of {spec.name} have there, and would amplify "
            f"them more than {LARGEST_GAIN:g} times; choose a wider target."
        )
    return change, target[:end]


def _own_window(spec: config.Channel, lmax: int) -> NDArray[np.float64]:
    """Return B_l of a channel's beam, up to lmax or to the end of its file."""
    if isinstance(spec.beam, config.BeamWindow):
        file = config.channel_path(spec.beam.path, spec.name)
        return read_window(file, None, spec.beam.extension, spec.beam.column)
    if isinstance(spec.beam, config.BeamBlm):
        file = config.channel_path(spec.beam.path, spec.name)
        return Beam.from_blm(file, mmax=0).window
    return load_beam(spec, lmax).window


def _up_to(lmax: int, window: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    """Return B_l up to lmax; raise InputError, with what helps, if they end below."""
    if window.size > lmax:
        return window[: lmax + 1]
    coarser = 1 << (window.size // 3).bit_length() >> 1
    degraded = f', or degrade the maps to nside {coarser} before the step "smooth"' if coarser else ""
    raise InputError(
        f"{name} ends at l = {window.size - 1}, but maps of nside {(lmax + 1) // 3} are smoothed up to l = {lmax} "
        f"(3 nside - 1); give a longer table{degraded}."
    )


def _harmonics(nside: int, monopole: bool, dipole: bool) -> NDArray[np.float64]:
    """Return 1 and x, y, z at the pixels' centres, as wanted, shape (K, npix)."""
    rows = np.stack([np.ones(12 * nside**2), *healpix.centres(nside)])
    return rows[np.array([monopole, dipole, dipole, dipole])]


def _template(path: Path, nside: int, frame: str, spec: config.Channel) -> Map:
    """Read a template in uK, at the nside and in the frame of the maps that it is taken off."""
    template = map_files.read_uk(path, frame, spec.frequency_ghz)
    check_map(template, nside, f"template {path}")
    check_complete(template, f"template {path}")
    return template
