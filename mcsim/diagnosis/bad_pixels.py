"""Bad pixels: places that stand out of residual maps as no effect lets them. Find them, leave them out, and say so."""

from collections.abc import Sequence
from dataclasses import dataclass

import healpy
import numpy as np

from mcsim.datavector.bipolar_scan import coarse_residuals
from mcsim.datavector.localisation import outstanding, standardised
from mcsim.datavector.map_checks import share_left_out
from mcsim.datavector.wiener_filter import wiener_filter
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.support.arrays import Map, Matrix, divided

STANDS_OUT = 1e-6  #: probability up to which what stands out of a residual map is no chance
NEARLY = 0.5  #: share of the size of the largest place from which on others are left out with it
SHOWN = 5  #: places of a map that a sentence has room for

LOOK_SO = "Glitches, sources and the Galaxy look so, and no effect on beam or gain does"
TOO_MANY = f"{LOOK_SO}: nothing is named before these pixels are left out; give the model a mask (map.mask)."


@dataclass(frozen=True, eq=False)
class BadPixels:
    """Hold places of maps that stand out."""

    places: dict[int, dict[int, float]]  #: their pixels by map, of coarse maps, and how far they stand out
    nside: int  #: of these pixels
    maps: list[Map] | None  #: the maps without them, uK; None if these are more than a diagnosis may leave out

    def sentences(self, names: Sequence[str], frame: str) -> list[str]:
        """Return a sentence on each map, of those called ``names``, that has such places."""
        said = list[str]()
        for number, pixels in sorted(self.places.items()):
            beside = {one: pixels.keys() & set(healpy.get_all_neighbours(self.nside, one).tolist()) for one in pixels}
            sizes = {one: size for one, size in pixels.items() if all(pixels[near] < size for near in beside[one])}
            each = [healpy.pix2ang(self.nside, pixel, lonlat=True) for pixel in sizes]
            where = [f"longitude {round(lon) % 360}°, latitude {round(lat)}°".replace("-", "−") for lon, lat in each]
            where[SHOWN:] = [f"{len(where) - SHOWN} more"] * (len(where) > SHOWN)
            size = f"{max(sizes.values()):.0f} times its scatter"
            start = f"One place of the residual of {names[number]} stands out, {size}"
            if len(sizes) > 1:
                start = f"{len(sizes)} places of the residual of {names[number]} stand out, up to {size}"
            said.append(f"{start}: {'; '.join(where)} ({frame}).")
        return said


def bad_pixels(context: DiagnosisContext, maps: Sequence[Map], cleaned: Sequence[Map]) -> BadPixels | None:
    """Return places of observed maps that stand out in maps ``cleaned`` of what effects add; None if none does.

    Notes
    -----
    A bad pixel of one map is in the sky that all maps share, and through it in the residuals of the others. So those
    that stand out most are left out first, and the rest is looked at again.
    """
    model, most = context.analysis.model, context.settings.missing_share
    places, left, seen = dict[int, dict[int, float]](), list(maps), list(cleaned)
    while True:
        coarse = coarse_residuals(model, wiener_filter(model, seen))
        found = _most(standing_out(context, coarse))
        npix = coarse.shape[1]
        new = {number: sizes.keys() - places.get(number, {}).keys() for number, sizes in found.items()}
        if not any(new.values()):
            return BadPixels(places, healpy.npix2nside(npix), left) if places else None
        for number, sizes in found.items():
            places[number] = {**sizes, **places.get(number, {})}
            hidden = healpy.ud_grade(np.isin(np.arange(npix), list(sizes)).astype(float), model.nside) > 0.0
            left[number], seen[number] = (np.where(hidden, healpy.UNSEEN, one[number]) for one in (left, seen))
        if max(map(share_left_out, model.parts, left)) > most:
            return BadPixels(places, healpy.npix2nside(npix), None)


def residual_maps(context: DiagnosisContext, coarse: Map) -> Matrix:
    """Return coarse residual maps over the scatter of those of simulations, shape (map, npix) both."""
    ensemble = context.ensemble
    return standardised(coarse, ensemble.residual_mean, ensemble.residual_scatter, len(ensemble.bipolar_scan))


def standing_out(context: DiagnosisContext, coarse: Map) -> dict[int, dict[int, float]]:
    """Return what stands out of residual maps, (map, npix): by map, pixels with how far they do.

    What nuisances scatter is large in some places, beside which others would stand out that have it not: then
    residuals count over the noise alone.
    """
    ensemble, maps = context.ensemble, residual_maps(context, coarse)
    if ensemble.nuisances is not None:
        precision = np.stack([part.precision for part in context.analysis.model.parts])
        weight = healpy.ud_grade(precision, healpy.npix2nside(coarse.shape[1])).reshape(coarse.shape)  # residuals'
        maps = (coarse - ensemble.residual_mean) * divided(1.0, np.sqrt(weight), np.nan)
    return outstanding(maps, len(ensemble.bipolar_scan), STANDS_OUT)


def _most(found: dict[int, dict[int, float]]) -> dict[int, dict[int, float]]:
    """Return what stands out nearly as far as the largest."""
    least = NEARLY * max((size for sizes in found.values() for size in sizes.values()), default=0.0)
    near = {number: {one: size for one, size in sizes.items() if size >= least} for number, sizes in found.items()}
    return {number: sizes for number, sizes in near.items() if sizes}
