"""The sky that the maps of side A show: sharpened sample by sample, and freed of noise."""

from dataclasses import replace

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.comparison.pairs import ChannelPair
from mcsim.comparison.scene import Maps, Scene
from mcsim.comparison.sky_of_maps import WHOLE, averaged, circular_response, sky_in, wiener
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.support.arrays import Alm

NOISY = 0.02  #: noise over the sky from which on it is filtered out of the sky that maps show
UNSHOWN = 1e-3  #: the same where single samples are simulated: what is left then is noise, or of a sky that holes hide

SHARP = 1e-4
"""What a simulation leaves of side A, over the sky, from which on the sky is not corrected further.

Orientation moments leave more of maps of single samples.
"""

SHARPER = 0.5  #: share of the squares that a correction of the sky must leave at most to be followed by another one
FREE = 0.05  #: share of the pixels of a single map that its sky leaves free at least, if noise is told from it
MADE = 0.1  #: share of what a simulation leaves of side A that another one leaves at most if side A was made that way
ROUNDS = 2  #: how often the sky is corrected for what its simulation leaves of the maps


def with_shown_sky(pair: ChannelPair) -> ChannelPair:
    """Return a pair whose sky, if it is taken from side A, makes its maps as they were made, but for their noise."""
    return shown_skies(pair)[0]


def shown_skies(pair: ChannelPair) -> list[ChannelPair]:
    """Return a pair with the sky that side A shows; if moments made A, also with what single samples change in it.

    Which of the two side B is like, what explains the difference must say: that alone may be like single samples.
    """
    if pair.scene is None:
        return [pair]
    ways = _as_made(pair, _sharper(pair) if pair.sky_of_maps else pair)
    weights = [_weight(one) if pair.sky_of_maps else None for one in ways]
    return [one if own is None else _filtered(one, own) for one, own in zip(ways, weights, strict=True)]


def with_fewer_orders(pair: ChannelPair) -> tuple[ChannelPair, ChannelPair | None]:
    """Return a pair, and the same with the orders of the beam that a run takes; None if side A has all of them.

    Both have the sky of single samples where those were simulated to tell.
    """
    scene = pair.scene
    if scene is None or pair.orders is None or pair.orders >= scene.beam.mmax:
        return pair, None
    beam, limit = scene.beam.truncated(pair.orders), SHARP**2 * _sky(pair)
    cut = replace(pair, scene=replace(scene, beam=beam))
    cut = cut.with_sky_of_maps() if pair.sky_of_maps else cut
    found = [(_left(one, one.scene.maps()), one) for one in (pair, cut) if one.scene is not None]
    if min(left for left, _ in found) > limit:
        both = zip(found, _by_samples(pair, cut), strict=True)
        found = [moments if moments[0] < MADE * samples[0] else samples for moments, samples in both]
    (left, pair), (less, cut) = found
    return pair, cut if left > limit and less < MADE * left else None


def adds_orders(cut: ChannelPair, pair: ChannelPair) -> bool:
    """Return True if side B is like the orders of the beam that a pair has and side A lacks."""
    assert cut.scene is not None
    assert pair.scene is not None
    more = (replace(cut.scene, beam=pair.scene.beam).maps() - cut.scene.maps())[pair.seen]
    rest = (cut.b - cut.a)[pair.seen]
    return float(more @ rest) ** 2 > MADE * float(more @ more) * float(rest @ rest)


def _by_samples(pair: ChannelPair, cut: ChannelPair) -> list[tuple[float, ChannelPair]]:
    """Return the squares that single samples leave of side A of a pair, and of it with a cut beam, with their skies.

    The sky is corrected with the cut beam. What the whole one would leave then, orientation moments say.
    """
    if not pair.sky_of_maps:
        return [(_left(one, _made(one, scene)), one) for one in (pair, cut) if (scene := one.scene) is not None]
    for last in (False, True):
        assert pair.scene is not None
        assert cut.scene is not None
        scene, missing = replace(pair.scene, sky=cut.scene.sky), _missing(cut)
        less, fewer = _corrected(cut, missing)
        if last or fewer.unmade is not None:
            more = np.where(pair.shown, scene.maps() - cut.scene.maps(), 0.0)
            left, whole = _corrected(replace(pair, scene=scene), missing - more)
            if last or whole.unmade is not None:  # noise leaves so much of both that no more can be told
                break
        cut = replace(fewer, unmade=None)
    if less < MADE * left:
        assert fewer.scene is not None
        less = _left(fewer, _made(fewer, fewer.scene))
    return [(left, whole), (less, fewer)]


def _missing(pair: ChannelPair) -> Maps:
    """Return what its simulation by single samples leaves of side A, 0 where that shows nothing."""
    assert pair.scene is not None
    return np.where(pair.shown, pair.a - _made(pair, pair.scene), 0.0) if pair.unmade is None else pair.unmade


def _corrected(pair: ChannelPair, missing: Maps) -> tuple[float, ChannelPair]:
    """Return the pair whose sky makes what was missing as well, and first the squares that moments leave of that."""
    scene = pair.scene
    assert scene is not None
    empty = replace(scene.up_to_offsets(1), sky=np.zeros_like(scene.sky))
    more = replace(scene, sky=scene.sky + sky_in(missing, pair.shown, empty, 1e-2, scene.sky))
    rest = np.where(pair.shown, missing - more.maps() + scene.maps(), 0.0)
    left = float(np.sum(rest[pair.seen] ** 2))
    if left > SHARPER * np.sum(missing[pair.seen] ** 2):
        return left, replace(pair, scene=more, rounds=ROUNDS, unmade=rest)
    return left, replace(pair, scene=more, rounds=pair.rounds + 1)


def _left(pair: ChannelPair, made: Maps) -> float:
    """Return the squares that a simulation leaves of side A."""
    return float(np.sum((pair.a - made)[pair.seen] ** 2))


def _sky(pair: ChannelPair) -> float:
    """Return the squares of side A about its mean."""
    return float(np.var(pair.a[pair.seen]) * pair.seen.sum())


def _as_made(pair: ChannelPair, found: ChannelPair) -> list[ChannelPair]:
    """Return a pair as side A was made: by single samples, orientation moments, or at the pixels' centres.

    ``found`` has the sky of single samples, ``pair`` that of orientation moments. If side A was made from moments, no
    single samples are simulated. Side B may be made of these all the same: then comes the pair with what they change
    added to side A.
    """
    scene = pair.scene
    assert scene is not None
    assert found.scene is not None
    left = float(np.sum(_missing(found)[found.seen] ** 2))
    if left <= UNSHOWN**2 * _sky(pair):
        return [found]
    best = scene
    if _left(pair, scene.maps()) > SHARP**2 * _sky(pair):
        centred = [scene.at_centres(), replace(scene.at_centres(), beam=scene.beam.truncated(0))]
        if pair.sky_of_maps:
            centred = [replace(one, sky=sky_in(pair.a, pair.shown, one)) for one in centred]
        best = min([scene, *centred], key=lambda one: _left(pair, one.maps()))
    if _left(pair, best.maps()) > MADE * left:
        return [found]
    ways = [replace(pair, scene=best, by_moments=True, unmade=None)]
    if best is scene and pair.pointing() is not None:
        spread = np.where(pair.seen, _made(pair, scene) - scene.maps(), 0.0)
        ways.append(replace(pair, a=pair.a + spread, spread=spread, unmade=None))
    return ways


def _made(pair: ChannelPair, scene: Scene) -> Maps:
    pointing = pair.pointing()
    return scene.maps() if pointing is None else scene.sampled(pointing, scene.window)


def _sharper(pair: ChannelPair) -> ChannelPair:
    scene = pair.scene
    if scene is None or pair.rounds >= ROUNDS or (pair.pointing() is None and scene.offset_order < 2):
        return pair
    limit = SHARP**2 * _sky(pair)
    if _left(pair, scene.maps()) <= limit:
        return pair
    before = np.inf
    for _ in range(pair.rounds, ROUNDS):
        missing = _missing(pair)
        left = float(np.sum(missing**2))
        if left <= limit or left > SHARPER * before:
            break
        before, (_, pair) = left, _corrected(pair, missing)
    return pair


def _weight(pair: ChannelPair) -> Maps | None:
    """Return the inverse variance of the noise of every pixel, 1/uK^2, shape (split, npix); None without noise.

    It is that of the difference of two splits, or of what the sky that it shows leaves of a single map, or of splits
    without a common pixel, which have the degrees of freedom that the sky's coefficients leave; shared out as 1 over
    samples or evenly, whichever is more likely.
    """
    if pair.scene is None or pair.hits is None or pair.scene.preparations:
        return None
    first = np.flatnonzero(pair.seen.any(axis=1))[:2]
    whole = first.size > 1 and bool(pair.seen[first].all(axis=0).any())
    first = first[: 1 + whole]
    seen = pair.seen[first].all(axis=0)
    rest = _missing(pair)[first][:, seen]
    mean = pair.a[first][:, seen].mean(axis=0)
    freedom = 1.0 if whole else 1.0 - _coefficients(pair.scene, pair.nside) / max(int(pair.seen.sum()), 1)
    if freedom < FREE:
        return None
    noise = (rest[0] - rest[1]) if whole else rest[0] / np.sqrt(freedom)
    least = NOISY if pair.pointing() is None else UNSHOWN
    if (0.5 if whole else 1.0) * noise.std() < least * mean.std():
        return None
    found = []
    for power in (1.0, 0.0):
        shape = np.maximum(pair.hits, 1.0) ** power
        spread = np.sum(1.0 / shape[first][:, seen], axis=0)
        variance = float(np.mean(noise**2 / spread))
        found.append((float(np.mean(np.log(variance * spread))), np.where(pair.seen, shape / variance, 0.0)))
    return min(found, key=lambda one: one[0])[1]


def _coefficients(scene: Scene, nside: int) -> int:
    """Return the number of real coefficients of the sky that maps of a scene show."""
    return int((2 * np.flatnonzero(circular_response(scene, nside)[1]) + 1).sum())


def _filtered(pair: ChannelPair, weight: Maps) -> ChannelPair:
    """Return a pair whose sky is the mean of what it may be, its noise given, with a draw of how far off that may be.

    Notes
    -----
    A Wiener filter with weights of every pixel (Gaussian constrained realizations: Hoffman & Ribak 1991, ApJ 380, L5).
    The power of the sky is that of the maps less that of the noise.
    """
    scene = pair.scene
    assert scene is not None
    factor, known, inverse = circular_response(scene, pair.nside)
    lmax = factor.size - 1
    total = weight.sum(axis=0)
    noise = healpy.nside2pixarea(pair.nside) / np.mean(total[total > 0.0])
    shown = healpy.alm2cl(alm_.multiply(alm_.resize(scene.sky, scene.lmax, lmax), factor, lmax))
    power = np.maximum(averaged(shown) - noise, 1e-3 * noise) * known

    def sky_of(values: NDArray[np.float64]) -> Alm:
        smooth = wiener(values, total, power, scene.nthreads)
        return alm_.resize(alm_.multiply(smooth, inverse, lmax), lmax, scene.lmax)

    def seen_by_circle(sky: Alm) -> NDArray[np.float64]:
        smooth = alm_.multiply(alm_.resize(sky, scene.lmax, lmax), factor, lmax)
        return healpix.synthesis(smooth[None], pair.nside, lmax, nthreads=scene.nthreads)[0]

    sky = sky_of(np.sum(weight * _missing(pair), axis=0) + total * seen_by_circle(scene.sky))
    draw = np.random.default_rng(0)
    other = _draw(power, draw)
    values = total * healpix.synthesis(other[None], pair.nside, lmax, nthreads=scene.nthreads)[0]
    other = alm_.resize(alm_.multiply(other, inverse, lmax), lmax, scene.lmax)
    doubt = other - sky_of(values + np.sqrt(total) * draw.standard_normal(total.size))
    return replace(pair, scene=replace(scene, sky=sky), doubt=doubt, unmade=None)


def unshown(pair: ChannelPair) -> Alm | None:
    """Return a draw of what holes hide of the sky of side A, coefficients as the scene's; None if they hide nothing."""
    scene, share = pair.scene, float(pair.shown.any(axis=0).mean())
    if scene is None or not pair.sky_of_maps or scene.preparations or share > WHOLE:
        return None
    sky = _draw(healpy.alm2cl(scene.sky) / share, np.random.default_rng(0))
    alone = replace(scene.up_to_offsets(1), sky=sky)
    return sky - sky_in(np.where(pair.shown, alone.maps(), 0.0), pair.shown, replace(alone, sky=np.zeros_like(sky)))


def _draw(power: NDArray[np.float64], draw: np.random.Generator) -> Alm:
    """Return Gaussian coefficients with a power spectrum."""
    lmax = power.size - 1
    real, imaginary = draw.standard_normal((2, alm_.size(lmax)))
    alm = np.where(alm_.orders(lmax) == 0, real, (real + 1j * imaginary) / np.sqrt(2.0))
    return alm_.multiply(alm, np.sqrt(power), lmax)
