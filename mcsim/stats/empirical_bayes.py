"""Estimates of many numbers that are of one size, each with an error of its own."""

import numpy as np

from mcsim.support.arrays import Matrix, Vector

EXACT = 1e-12  #: variance over the largest of what is known exactly, or not at all


def shrunk(estimates: Vector, covariance: Matrix) -> tuple[Vector, Matrix]:
    """Return numbers and their covariance by estimates of them, shape (K,) and (K, K), and a size that all have.

    Notes
    -----
    With a Gaussian prior of mean 0 and one variance tau^2 for all of them, that which makes the estimates most likely,
    combinations with a small error keep their estimate, and those with a large one are near zero (Efron & Morris, JASA
    68, 117, 1973). Their squared error is less than that of the estimates for any tau^2 near the truth. All are then
    multiplied by one factor, with which they are nearest to the estimates: the size of the whole is not less.
    """
    errors, axes = np.linalg.eigh(covariance)
    along, kept = axes.T @ estimates, errors > EXACT * errors.max(initial=0.0)
    x, own = along[kept], errors[kept]
    if not x.any():
        return estimates, covariance
    largest = float(np.max(x**2))
    sizes = np.geomspace(min(0.01 * float(own.min()), largest), 10.0 * largest, 200)
    total = own[:, None] + sizes
    likelihood = -0.5 * np.sum(np.log(total) + x[:, None] ** 2 / total, axis=0)
    size = sizes[int(np.argmax(likelihood))]
    share = size / (size + own)
    factor = float(np.sum(share * x**2 / own) / np.sum((share * x) ** 2 / own))
    along[kept], errors[kept] = factor * share * x, factor**2 * share * own
    return axes @ along, (axes * np.maximum(errors, 0.0)) @ axes.T
