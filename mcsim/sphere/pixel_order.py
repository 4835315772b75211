"""Tell maps whose pixels are in another order than they are taken to be."""

from collections.abc import Callable

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere.checks import UNSEEN_BELOW
from mcsim.support.arrays import Map, Rows

SAMPLED = 20_000  #: pixels whose neighbours are looked at
LEAST = 16  #: nside from which on maps have enough of them
MORE = 0.15  #: by which neighbours in the right order correlate more than those in a wrong one
MOVED = (5, 7)  #: parts of the pixels by which an array is moved, so that blocks of NESTED pixels fall apart
LOST = 0.25  #: share of what neighbours in the order NESTED correlate more that a NESTED array loses by each at least


def check_ring(map_: Map, name: str) -> None:
    """Raise InputError for a map, shape (npix,), whose neighbours in RING order are less alike than in another one.

    The others are those of NESTED pixels that are called RING, and of RING ones that were called NESTED. NaN and
    ``healpy.UNSEEN`` are no neighbours. A sky, a mask and hits are smooth, and smoothest in their own order: of maps of
    WMAP and Planck, nside 32 to 512, neighbours correlate by 0.5 to 1 there, and by 0.2 to 0.4 less in a wrong one.
    White noise is smooth in none, and tells nothing; nor does noise whose neighbours have opposite signs, as without a
    beam that was divided out. The largest and smallest twentieth count as their limits, so that sources do not matter.

    Notes
    -----
    Stripes along rings, as of scans at one declination, are runs of the array, and a NESTED reading puts runs together.
    It does so wherever the runs begin, but NESTED pixels have blocks that begin at multiples of 4, 16, ...: of an array
    that is moved, neighbours correlate as before in the first case, and less in the second.
    """
    seen = np.isfinite(map_) & (map_ > UNSEEN_BELOW)
    if not healpy.isnsideok(healpy.npix2nside(map_.size), nest=True) or map_.size < 12 * LEAST**2:
        return
    shown = map_[seen]
    if shown.size < 12 * LEAST**2 // 10:
        return
    values = np.clip(map_, *np.quantile(shown[:: max(1, shown.size // SAMPLED)], [0.05, 0.95]))
    to_nested, to_ring = healpy.ring2nest, healpy.nest2ring
    ring = max(_correlation(values, seen, _same, _same), 0.0)
    nested, called_nested = (_correlation(values, seen, *one) for one in ((to_ring, to_nested), (to_nested, to_ring)))
    if nested > ring + MORE:
        moved = ((np.roll(values, map_.size // one), np.roll(seen, map_.size // one)) for one in MOVED)
        left = max(_correlation(*one, to_ring, to_nested) for one in moved)
        nested = nested if nested - left > LOST * (nested - ring) else ring
    if (other := max(nested, called_nested)) > ring + MORE:
        raise InputError(
            f"{name} is smoother with its pixels in another order (neighbours correlate by {other:.2f}, by "
            f"{ring:.2f} as they are), as a map that is NESTED and called RING, or the other way round; correct "
            "ORDERING in its header, or reorder them."
        )


_Order = Callable[[int, Rows], Rows]


def _same(nside: int, pixels: Rows) -> Rows:
    return pixels


def _correlation(values: Map, seen: NDArray[np.bool_], pixels_of: _Order, places_of: _Order) -> float:
    """Return the correlation of places of an array with the neighbours of the pixels that are there.

    ``pixels_of`` places, in RING order, and ``places_of`` pixels say in which order they are. It is 0 of values that
    are all alike.
    """
    nside, places = healpy.npix2nside(values.size), np.flatnonzero(seen)
    places = places[:: max(1, places.size // SAMPLED)]
    near = healpy.get_all_neighbours(nside, pixels_of(nside, places))
    there = places_of(nside, np.maximum(near, 0))
    both = (near >= 0) & seen[there]
    variance, squares = np.var(values[places]), (values[there] - values[places]) ** 2
    return float(1.0 - np.mean(squares[both]) / (2.0 * variance)) if variance > 0.0 and both.any() else 0.0
