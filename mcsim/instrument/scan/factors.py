"""What a scan makes of a beam's m = 2 part: sky means of the moments, and three factors over parallel transport."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import ducc0
import healpy
import numpy as np
from numpy.typing import NDArray
from scipy.special import eval_jacobi

from mcsim.errors import InputError
from mcsim.instrument.scan.limit import limit_moments, limit_quadrature
from mcsim.instrument.scan.model import ScanModel
from mcsim.instrument.scan.moments import Moments
from mcsim.support.arrays import Vector

LATITUDE_EDGES_DEG = tuple(range(0, 91, 10))
ELLS = (50, 100, 200, 400)


@dataclass(frozen=True)
class ScanFactors:
    """Three answers to how much of the parallel-transport effect of m = 2 a scan leaves."""

    #: L = 2, M = 0 BipoSH of the hit average over that of parallel transport with psi = 0, at every l (leading order,
    #: real b_l2): int w_2 sin^2(theta) / int sin^2(theta) over the sphere
    quadrupole_ratio: float
    sky_mean: float  #: mean of Re w_2 over the sky: the factor that a least-squares fit over isotropic skies finds
    #: ell, f_ell: the paper's f_l = (2l+1)/2 int (d^l_22)^2 Re w_2 dcos(theta), shape (n,)
    ell: NDArray[np.int64]
    f_ell: Vector


def sky_means(moments: Moments) -> NDArray[np.complex128]:
    """Return the means of w_s over the observed pixels, shape (smax,)."""
    seen = _seen(moments)
    return np.array([w[seen].mean() for w in moments.w])


def latitude_means(
    moments: Moments, edges_deg: Sequence[float] = LATITUDE_EDGES_DEG
) -> tuple[Vector, NDArray[np.complex128]]:
    """Return hits over their mean over the sky, shape (n,), and moments, shape (smax, n), in bins of |latitude|.

    The latitude is that of the moments' frame, the edges are n + 1 in degrees. Unobserved pixels count for the hits
    alone; w is nan where a bin has no other.
    """
    from scipy.stats import binned_statistic  # half a second, which no run should wait for

    seen = _seen(moments)
    latitude = np.abs(90.0 - np.degrees(healpy.pix2ang(moments.nside, np.arange(moments.npix))[0]))
    hits = binned_statistic(latitude, moments.hits, bins=edges_deg).statistic
    w = binned_statistic(latitude[seen], moments.w[:, seen], bins=edges_deg).statistic
    return hits / moments.hits.mean(), w


def ring_means(moments: Moments) -> tuple[Vector, Vector, NDArray[np.complex128]]:
    """Return colatitudes of the HEALPix rings, their mean hits over those of the sky, and mean w_s of observed pixels.

    From north to south: theta in radians and hits, shape (4 nside - 1,); w, shape (smax, 4 nside - 1), 0 in rings that
    were not observed.
    """
    first, size, *_ = healpy.ringinfo(moments.nside, np.arange(1, 4 * moments.nside))
    theta = healpy.pix2ang(moments.nside, first)[0]
    seen = np.asarray(moments.hits > 0.0, dtype=np.float64)
    observed = np.maximum(np.add.reduceat(seen, first), 1.0)
    w = np.array([np.add.reduceat(w * seen, first) / observed for w in moments.w])
    return theta, np.add.reduceat(moments.hits, first) / size / moments.hits.mean(), w


def scan_factors(moments: Moments, ell: Sequence[int] = ELLS) -> ScanFactors:
    """Return the three factors of a survey's moments (smax >= 2), f_l at the multipoles ``ell`` (>= 2).

    Those of L = 2, M = 0 are meant for ecliptic maps. Pixels that were not observed are left out: parallel transport
    with psi = 0 has the factors 1, whatever it sees.

    Notes
    -----
    The first two are pixel sums. f_l is a Gauss-Legendre sum of w_2 interpolated between the means of the rings; where
    pixels were not observed, over that of their observed share.
    For the WMAP-like scan they agree with the reference figures 0.6575, 0.555 and 0.46 within 0.001
    (tests/unit/test_scan_factors.py checks them against the exact limit).
    """
    if moments.smax < 2:
        raise InputError(f"the moments end at s = {moments.smax}, but the factors need s = 2; use smax >= 2.")
    seen = _seen(moments)
    colatitude = healpy.pix2ang(moments.nside, np.arange(moments.npix))[0][seen]
    rings, _, w = ring_means(moments)
    first, size, *_ = healpy.ringinfo(moments.nside, np.arange(1, 4 * moments.nside))
    share = np.add.reduceat(seen.astype(np.float64), first) / size
    w2 = moments.w[1].real[seen]
    found = _factors(colatitude, np.ones(w2.size), w2, ell, lambda theta: np.interp(theta, rings, share * w[1].real))
    if seen.all():
        return found
    whole = _factors(colatitude, np.ones(w2.size), w2, ell, lambda theta: np.interp(theta, rings, share))
    return replace(found, f_ell=found.f_ell / whole.f_ell)


def limit_factors(model: ScanModel, ell: Sequence[int] = ELLS) -> ScanFactors:
    """Return the three factors in the exact long-time limit; where nothing is observed w_2 counts as 0."""

    def w2(theta: Vector) -> Vector:
        return limit_moments(model, theta, 2)[1][1].real

    theta, weights = limit_quadrature(model)
    return _factors(theta, weights, w2(theta), ell, w2)


def _factors(
    theta: Vector, weights: Vector, w2: Vector, ell: Sequence[int], w2_at: Callable[[Vector], Vector]
) -> ScanFactors:
    """Return the factors of Re w_2 at colatitudes with weights; f_l by Gauss-Legendre quadrature of a function of them.

    d^l_22 = ((1 + z)/2)^2 P^(0,4)_{l-2}(z), z = cos(theta).
    """
    if min(ell) < 2:
        raise InputError(f"f_l is asked for at l = {min(ell)}, but it needs l >= 2.")
    # Twice the nodes that (d^l_22)^2 needs, for the kinks of w_2 at the caustics.
    size = 2 * max(ell) + 512
    nodes = ducc0.misc.GL_thetas(size)
    z = np.cos(nodes)
    weighted = ducc0.misc.GL_weights(size, 1) / (2.0 * math.pi) * w2_at(nodes) * ((1.0 + z) / 2.0) ** 4
    f_ell = [math.fsum(weighted * eval_jacobi(n - 2, 0, 4, z) ** 2) * (2 * n + 1) / 2.0 for n in ell]
    weighting = weights * np.sin(theta) ** 2
    return ScanFactors(
        quadrupole_ratio=float(np.sum(weighting * w2) / np.sum(weighting)),
        sky_mean=float(np.sum(weights * w2) / np.sum(weights)),
        ell=np.array(ell),
        f_ell=np.array(f_ell),
    )


def summary(title: str, moments: Moments) -> str:
    """Return what ``mcsim scan`` prints: hits, sky means, w_2 by |latitude|, and the three factors."""
    hits = moments.hits
    means = sky_means(moments)
    lines = [
        f"{title}: nside {moments.nside}, {moments.frame} frame, {hits.sum():.6g} samples",
        f"hits per pixel: min {hits.min():.0f}, median {np.median(hits):.0f}, max {hits.max():.0f}; "
        f"unobserved: {np.mean(hits == 0.0):.4%} of the sky",
        "sky means of w_s = <exp(-i s psi)>: "
        + ", ".join(f"w_{s} = {_complex_text(mean)}" for s, mean in enumerate(means, start=1)),
    ]
    if moments.smax < 2:
        return "\n".join(lines)
    w2 = latitude_means(moments)[1][1].real
    bins = zip(LATITUDE_EDGES_DEG, LATITUDE_EDGES_DEG[1:], w2, strict=False)
    factors = scan_factors(moments)
    f_text = ", ".join(f"{value:.3f} at l = {ell}" for ell, value in zip(factors.ell, factors.f_ell, strict=True))
    lines += [
        "Re w_2 by |latitude| in degrees: " + ", ".join(f"{low}-{high}: {value:.3f}" for low, high, value in bins),
        "three factors of an m = 2 beam over parallel transport (psi = 0):",
        f"  {factors.quadrupole_ratio:.4f}  BipoSH L = 2, M = 0: int w_2 sin^2 / int sin^2, the same at every l",
        f"  {factors.sky_mean:.4f}  least squares over isotropic skies: the sky mean of Re w_2",
        f"  f_l = {f_text}: (2l+1)/2 int (d^l_22)^2 Re w_2 dcos(theta), the paper's",
    ]
    return "\n".join(lines)


def _seen(moments: Moments) -> NDArray[np.bool_]:
    seen = np.asarray(moments.hits > 0.0)
    if not seen.any():
        raise InputError("the moments have no hits at all; check the survey's duration and time range.")
    return seen


def _complex_text(value: complex) -> str:
    # Adding 0.0 after rounding turns -0.0 into 0.0.
    return f"{round(value.real, 4) + 0.0:.4f}{round(value.imag, 4) + 0.0:+.4f}i"
