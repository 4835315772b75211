"""Bad pixels: places that stand out of residual maps as no effect lets them. Find them, leave them out, and say so."""

from collections.abc import Sequence
from dataclasses import dataclass

import healpy
import numpy as np

from mcsim.datavector.bipolar_scan import NSIDE, coarse_residuals
from mcsim.datavector.filter_model import Model
from mcsim.datavector.localisation import outstanding, standardised
from mcsim.datavector.map_checks import share_left_out
from mcsim.datavector.null_ensemble import NullEnsemble
from mcsim.datavector.wiener_filter import wiener_filter
from mcsim.support.arrays import Map, Matrix, divided

STANDS_OUT = 1e-6  #: probability up to which what stands out of a residual map is no chance
NEARLY = 0.5  #: share of the size of the largest place from which on others are left out with it
ALIKE = 0.9  #: share of what a place is in one map from which on it is as large in another, as in the only two maps
SHOWN = 5  #: places of a map that a sentence has room for


@dataclass(frozen=True, eq=False)
class BadPixels:
    """Hold places of maps that stand out."""

    places: dict[int, dict[int, float]]  #: their pixels by map, of coarse maps, and how far they stand out
    nside: int  #: of these pixels
    names: Sequence[str]  #: of the maps
    frame: str  #: of the maps

    @property
    def number(self) -> int:
        """Return the number of pixels."""
        return sum(map(len, self.places.values()))

    @property
    def left_out(self) -> str:
        """Return how many pixels are left out, in words."""
        many = "one pixel" if self.number == 1 else f"{self.number} pixels"
        return f"{many} of nside {self.nside} {'is' if self.number == 1 else 'are'} left out"

    @property
    def size(self) -> float:
        """Return how far the first stands out, in units of the scatter of its map."""
        return max(size for sizes in self.places.values() for size in sizes.values())

    @property
    def sentences(self) -> list[str]:
        """Return a sentence on each map that has such places."""
        said = list[str]()
        for number, pixels in sorted(self.places.items()):
            beside = {one: pixels.keys() & set(healpy.get_all_neighbours(self.nside, one).tolist()) for one in pixels}
            sizes = {one: size for one, size in pixels.items() if all(pixels[near] < size for near in beside[one])}
            each = [healpy.pix2ang(self.nside, pixel, lonlat=True) for pixel in sizes]
            where = [f"longitude {round(lon) % 360}°, latitude {round(lat)}°".replace("-", "−") for lon, lat in each]
            where[SHOWN:] = [f"{len(where) - SHOWN} more"] * (len(where) > SHOWN)
            size = f"{max(sizes.values()):.0f} times its scatter"
            start = f"One place of the residual of {self.names[number]} stands out, {size}"
            if len(sizes) > 1:
                start = f"{len(sizes)} places of the residual of {self.names[number]} stand out, up to {size}"
            said.append(f"{start}: {'; '.join(where)} ({self.frame}).")
        return said

    def without(self, maps: Sequence[Map], nside: int) -> list[Map]:
        """Return maps, (npix,) of an nside, with these places as UNSEEN."""
        left = list(maps)
        for number, sizes in self.places.items():
            there = np.isin(np.arange(healpy.nside2npix(self.nside)), list(sizes))
            hidden = healpy.ud_grade(there.astype(float), nside) > 0.0
            left[number] = np.where(hidden, healpy.UNSEEN, left[number])
        return left


def bad_pixels(model: Model, ensemble: NullEnsemble, maps: Sequence[Map]) -> BadPixels | None:
    """Return places of maps that stand out; None if none does.

    Notes
    -----
    A bad pixel of one map is in the sky that all maps share, and through it in the residuals of the others, where it
    may stand out as far over the scatter of the map, if an effect widens that of its own. So those that are largest
    over the scatter of simulations are left out first, and the rest is looked at again, until nothing new stands out
    or more is left out than may be.
    """
    places, left, most = dict[int, dict[int, float]](), list(maps), model.settings.missing_share
    found = BadPixels(places, min(NSIDE, model.nside), [part.name for part in model.parts], model.frame)
    while max(map(share_left_out, model.parts, left)) <= most:
        large = _largest(*standing_out(model, ensemble, coarse_residuals(model, wiener_filter(model, left))))
        before = found.number
        for number, sizes in large.items():
            places[number] = {**sizes, **places.get(number, {})}
        if found.number == before:
            break
        left = found.without(maps, model.nside)
    return found if places else None


def residual_maps(ensemble: NullEnsemble, coarse: Map) -> Matrix:
    """Return coarse residual maps over the scatter of those of simulations, shape (map, npix) both."""
    return standardised(coarse, ensemble.residual_mean, ensemble.residual_scatter, len(ensemble.bipolar_scan))


def standing_out(model: Model, ensemble: NullEnsemble, coarse: Map) -> tuple[dict[int, dict[int, float]], Matrix]:
    """Return what stands out of residual maps, (map, npix), and the maps in units of the scatter of simulations.

    By map, they are pixels with how far they stand out. What nuisances scatter is large in some places, beside which
    others would stand out that have it not: then residuals count over the noise alone.
    """
    maps = residual_maps(ensemble, coarse)
    if ensemble.nuisances is not None:
        precision = np.stack([part.precision for part in model.parts])
        # Coarse residuals are sums over fine pixels, and so is their weight.
        weight = healpy.ud_grade(precision, healpy.npix2nside(coarse.shape[1]), power=-2).reshape(coarse.shape)
        maps = (coarse - ensemble.residual_mean) * divided(1.0, np.sqrt(weight), np.nan)
    return outstanding(maps, len(ensemble.bipolar_scan), STANDS_OUT), maps


def _largest(found: dict[int, dict[int, float]], maps: Matrix) -> dict[int, dict[int, float]]:
    """Return those of pixels that stand out which are nearly as large in residual maps, (map, npix), as any of them.

    Of what stands out in several maps they are those of the map where it is largest, and of any where it is so alike.
    """
    values = {number: np.abs(maps[number] - np.nanmedian(maps[number])) for number in found}
    most: dict[int, float] = {}
    for number, sizes in found.items():
        for one in sizes:
            most[one] = max(float(values[number][one]), most.get(one, 0.0))
    least = NEARLY * max(most.values(), default=0.0)
    large = {
        number: {one: size for one, size in sizes.items() if values[number][one] >= max(least, ALIKE * most[one])}
        for number, sizes in found.items()
    }
    return {number: sizes for number, sizes in large.items() if sizes}
