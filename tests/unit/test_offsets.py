"""Samples off their pixels' centres: against the sky at their own places."""

import ducc0
import healpy
import numpy as np
import pytest

from mcsim.instrument.scan import Moments
from mcsim.simulation import convolve
from mcsim.simulation.offsets import Expansion, expansion, offset_maps
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.sky import gaussian_alm

NSIDE, LMAX, SAMPLES = 8, 16, 5
NPIX = 12 * NSIDE**2


@pytest.fixture(scope="module")
def sky() -> np.ndarray:
    return gaussian_alm(np.ones(LMAX + 1), np.random.default_rng(1))


def tangent(nside: int) -> tuple[np.ndarray, ...]:
    """Centre, e_theta and e_phi of every pixel, shape (npix, 3)."""
    theta, phi = healpy.pix2ang(nside, np.arange(12 * nside**2))
    south = np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)], axis=1)
    east = np.stack([-np.sin(phi), np.cos(phi), 0.0 * phi], axis=1)
    return np.stack(healpy.pix2vec(nside, np.arange(len(theta))), axis=1), south, east


def scattered(shrunk: float) -> tuple[np.ndarray, ...]:
    """Theta, phi, psi of samples anywhere in all pixels, the poles' too, and their offsets shrunk by a factor."""
    rng = np.random.default_rng(2)
    vectors = rng.standard_normal((400 * NPIX, 3))
    vectors /= np.linalg.norm(vectors, axis=1)[:, None]
    pixel = healpy.vec2pix(NSIDE, *vectors.T)
    order = np.argsort(pixel, kind="stable")
    starts = np.searchsorted(pixel[order], np.arange(NPIX))
    chosen = (starts[:, None] + np.arange(SAMPLES)).ravel()
    vectors, pixel = vectors[order][chosen], pixel[order][chosen]
    np.testing.assert_array_equal(pixel, np.repeat(np.arange(NPIX), SAMPLES))
    centre, south, east = (each[pixel] for each in tangent(NSIDE))
    u = shrunk * np.sum(vectors * south, axis=1), shrunk * np.sum(vectors * east, axis=1)
    moved = np.sqrt(1.0 - u[0] ** 2 - u[1] ** 2)[:, None] * centre + u[0][:, None] * south + u[1][:, None] * east
    theta = np.arctan2(np.hypot(moved[:, 0], moved[:, 1]), moved[:, 2])
    return theta, np.arctan2(moved[:, 1], moved[:, 0]) % (2 * np.pi), rng.uniform(0, 6, pixel.size)


def moments_of(samples: tuple[np.ndarray, ...], order: int, tmp_path) -> Moments:
    np.save(tmp_path / "samples.npy", np.stack(samples, axis=1))
    return Moments.from_pointing_files(tmp_path / "samples.npy", NSIDE, 1, offset_order=order)


def at_places(alm: np.ndarray, theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """The sky at any directions, by ducc0's own interpolation-free sums over a grid of nonuniform points."""
    places = np.stack([theta, phi], axis=1)
    return ducc0.sht.synthesis_general(alm=alm[None], loc=places, spin=0, lmax=LMAX, epsilon=1e-13)[0]


@pytest.mark.parametrize("order", [2, 3, 4])
def test_error_falls_with_the_next_power_of_the_offsets(sky, order, tmp_path) -> None:
    """The largest error over all pixels, the poles' included."""
    r, weight = healpix.distances_from_centres(NSIDE)
    left = []
    for shrunk in (0.5, 0.25, 0.125):
        theta, phi, psi = scattered(shrunk)
        truth = at_places(sky, theta, phi).reshape(NPIX, SAMPLES).mean(axis=1)
        terms = Expansion(shrunk * r, weight, LMAX, order)
        smooth = healpix.synthesis(alm_.multiply(sky, terms.smooth, LMAX)[None], NSIDE, LMAX)[0]
        made = smooth + offset_maps(sky, terms, [moments_of((theta, phi, psi), order, tmp_path)])[0]
        left.append(np.abs(made - truth).max() / np.std(truth))
    falls = np.log2(np.divide(left[:-1], left[1:]))
    print(order, left, falls)
    assert np.all(np.abs(falls - (order + 1)) < 0.3)
