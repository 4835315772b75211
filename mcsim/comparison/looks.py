"""Say what a difference that has no name looks like: white, steep in l or like the sky, in few pixels."""

from itertools import pairwise

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.sphere import healpix

WHITE = 0.15  #: largest correlation of neighbouring pixels of a white map
STEEP = 1.0  #: power of l from which on the ratio of two amplitudes is called steep

HALF = 0.5
FEW = 0.1
"""Share of the pixels, or of the degrees, that is few for half of the variance; half a sky's is at least as much."""

ALIKE = 0.3  #: correlation with the sky, or its size, or hits, that is worth telling

_BANDS = 6


def look(
    left: NDArray[np.float64], a: NDArray[np.float64], seen: NDArray[np.bool_], hits: NDArray[np.float64] | None
) -> tuple[str, ...]:
    """Return what one map that is left looks like, in words, the most telling first.

    ``left``, ``a``: what is left, and side A, uK; ``seen``: where they are known; ``hits``: samples per pixel, None if
    they are not known; shape (npix,) each.
    """
    rest = np.where(seen, left, 0.0)
    if not rest.any():
        return ()
    words = []
    squares = np.sort(rest[seen] ** 2)[::-1]
    few = float(np.searchsorted(np.cumsum(squares), HALF * squares.sum()) + 1) / squares.size
    if few < FEW / 2.0:
        worst = int(np.argmax(np.abs(rest)))
        lon, lat = healpy.pix2ang(healpy.npix2nside(rest.size), worst, lonlat=True)
        where = f"longitude {lon:.0f}, latitude {lat:.0f} deg"
        words.append(f"half of it is in {100.0 * few:.2g} % of the pixels, most at {where}")
    white = abs(neighbours(rest, seen)) < WHITE
    if white:
        words.append("white in pixels, as an interpolation error or noise that the sides do not share")
    else:
        words.extend(_by_degree(rest, np.where(seen, a, 0.0)))
    if hits is not None and np.ptp(hits[seen]) > 0.0:
        size = np.corrcoef(np.log(rest[seen] ** 2 + 1e-300), np.log(hits[seen]))[0, 1]
        if abs(size) > ALIKE:
            words.append(f"{'larger' if size < 0.0 else 'smaller'} where there are few samples")
    for name, values in (("the sky", a[seen]), ("the square of the sky", (a[seen] - a[seen].mean()) ** 2)):
        alike = np.corrcoef(rest[seen], values)[0, 1]
        if abs(alike) > ALIKE:
            words.append(f"correlated with {name} ({alike:.2f})")
    return tuple(words)


def neighbours(rest: NDArray[np.float64], seen: NDArray[np.bool_]) -> float:
    """Return the correlation of pixels with their neighbours."""
    nside = healpy.npix2nside(rest.size)
    pixels = np.flatnonzero(seen)
    near = healpy.get_all_neighbours(nside, pixels)[::2]
    known = (near >= 0) & seen[near]
    products = np.where(known, rest[near], 0.0) * rest[pixels]
    return float(products.sum() / max(int(known.sum()), 1) / np.mean(rest[pixels] ** 2))


def _by_degree(rest: NDArray[np.float64], a: NDArray[np.float64]) -> list[str]:
    """Return how what is left is spread over degrees, by itself and over the sky's."""
    nside = healpy.npix2nside(rest.size)
    lmax = 2 * nside
    ell = np.arange(lmax + 1)
    own, sky = ((2 * ell + 1) * healpy.alm2cl(healpix.analysis(map_, lmax)) for map_ in (rest, a))
    half = int(np.searchsorted(np.cumsum(own), HALF * own.sum()))
    words = [f"of low degree: half of its variance is at l <= {half}"] if half < FEW * lmax else []
    edges = np.unique(np.geomspace(2, lmax + 1, _BANDS + 1).astype(int))
    bands = [slice(low, high) for low, high in pairwise(edges)]
    middle = np.array([ell[band].mean() for band in bands])
    ratio = np.array([own[band].sum() / max(sky[band].sum(), 1e-300) for band in bands])
    slope = float(np.polyfit(np.log(middle), 0.5 * np.log(ratio), 1)[0])
    if slope > STEEP:
        words.append(
            f"steep: its ratio to the sky grows as l^{slope:.1f}, as an interpolation error's or a window's does"
        )
    elif abs(slope) < STEEP / 4.0 and not words:
        words.append("spread over degrees as the sky is")
    return words
