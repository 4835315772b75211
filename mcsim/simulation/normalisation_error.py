"""Error of filtered estimates that all realizations share: that of their normalisation, by few random probes."""

import numpy as np
from numpy.typing import NDArray

from mcsim.simulation.filtering import Filtering


def normalisation_error(filtering: Filtering, mean: NDArray[np.complex128]) -> NDArray[np.float64]:
    r"""Return the standard deviation that random probes give to a mean of ``biposh_qml``.

    Parameters
    ----------
    filtering
        Filters of the maps, and their normalisation.
    mean
        The mean, uK^2, shape (pair, mode, bin): of the difference to the controls, or without a control.

    Returns
    -------
    array
        In uK^2, both parts together, shape (pair, mode, bin), NaN where there is no number; zero without probes.

    Notes
    -----
    It does not become smaller with more realizations, and the standard errors of a summary do not know it. For N pairs
    of probes and p numbers alpha, F^-1 has the scatter of an inverse Wishart matrix (Siskind 1972, Biometrika 59, 690):

    .. math:: [(N - p - 1) (F^{-1})_{pp} \alpha^t F \alpha + (N - p + 1) \alpha_p^2] / [(N - p) (N - p - 3)].

    That takes pairs for independent and their products for Gaussian: 30 % too small for 35 modes of the sky to a
    number, 5 % for a hundred (``tests/statistical/test_normalisation_error.py``).
    """
    found, drawn = np.full(mean.shape, np.nan), filtering.drawn
    matrices = zip(filtering.fisher(), filtering.inverses, strict=True)
    for row, bands, (x, y), given, (response, inverse) in zip(
        found, filtering.bands, filtering.pairs, mean, matrices, strict=True
    ):
        mode, place, part = bands.numbers
        numbers, size = np.where(part == 0, given.real[mode, place], given.imag[mode, place]), bands.size
        variances = np.zeros(size)
        if drawn:
            rest = drawn * (drawn - 1) / (2.0 if x == y else 1.0) - size
            square = (rest - 1.0) * np.diag(inverse) * (numbers @ response.matrix @ numbers) + (rest + 1.0) * numbers**2
            variances = square / (rest * (rest - 3.0)) if rest > 3.0 else np.full(size, np.inf)
        both = bands.spectra(variances)
        row[:] = np.sqrt(both.real + both.imag)
    return found
