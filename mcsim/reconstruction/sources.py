"""Compact sources that nobody named: residuals through the beam, their brightest point, and what the choice costs.

A source of unit flux adds the beam about its place, b(n), to a map. Its score is the residual (over its noise variance)
times that, for all places at once one transform. In white noise the variance of the score is the sum over pixels of
b^2 over the noise variance, which is one more; what a filter leaves of the sky adds to it.
"""

from collections.abc import Sequence

import ducc0
import healpy
import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.special import eval_legendre

from mcsim.reconstruction.choices import Choice
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.support.arrays import Alm, Cl, Map, Matrix, Vector, divided

COARSE = 4  #: pixels across over which a variance is smoothed
SEEN = 0.05  #: share of the median variance of the score below which a place is hardly observed


def points(n: Matrix, weights: Vector, lmax: int) -> Alm:
    """Return the coefficients of point sources: sums of weights times Y*_lm(n), directions of shape (3, k)."""
    theta, phi = healpy.vec2dir(*n)
    angles = np.stack([np.ravel(theta), np.ravel(phi) % (2.0 * np.pi)], axis=1)
    options = {"spin": 0, "lmax": lmax, "epsilon": 1e-10, "nthreads": 1}
    return np.asarray(ducc0.sht.adjoint_synthesis_general(map=weights[None], loc=angles, **options)[0])


def at(place: tuple[float, ...], lmax: int) -> Alm:
    """Return the coefficients of a source of unit flux; ``place``: longitude and latitude, degrees."""
    return points(healpy.ang2vec(*place, lonlat=True)[:, None], np.ones(1), lmax)


def variance(precision: Map, response: Cl, nside: int, lmax: int) -> Map:
    """Return the variance in white noise of the score of a source in every pixel, shape (npix,); not observed: inf."""
    ell, (x, weight) = np.arange(lmax + 1), leggauss(2 * lmax + 1)
    legendre = eval_legendre(ell[:, None], x)
    profile = ((2.0 * ell + 1.0) / (4.0 * np.pi) * response) @ legendre
    squared = 2.0 * np.pi * legendre @ (weight * profile**2)
    found = healpix.synthesis(alm_.multiply(healpix.adjoint(precision, lmax), squared, lmax)[None], nside, lmax)[0]
    seen = precision > 0
    return np.where(seen & (found > SEEN * np.median(found[seen])), found, np.inf)


def simulated_variance(noise: Map, scores: Sequence[Map]) -> Map:
    """Return the variance of scores from simulations of them, its ratio to that in noise smoothed over COARSE pixels.

    Where noise is uneven the filter leaves more of the sky in some parts of it than in others.
    """
    nside = healpy.npix2nside(noise.size)
    ratio = np.where(np.isfinite(noise), np.mean(np.square(scores), axis=0) / noise, healpy.UNSEEN)
    smooth = healpy.ud_grade(healpy.ud_grade(ratio, max(nside // COARSE, 1)), nside)
    return np.where(np.isfinite(noise), smooth * noise, np.inf)


def brightest(scores: Map, variance_: Map) -> Choice:
    """Return the source that stands out most in a map of scores."""
    fall = divided(scores**2, variance_, 0.0)
    pixel = int(np.argmax(fall))
    lon_deg, lat_deg = healpy.pix2ang(healpy.npix2nside(fall.size), pixel, lonlat=True)
    return Choice(f"source {float(lon_deg)!r} {float(lat_deg)!r}", float(fall[pixel]))
