"""Errors of amplitudes where their effects act: a strong effect changes the scatter of the evidence itself."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mcsim.stats.gaussian import Fit, SimulatedGaussian, orthonormal


def with_scatter(
    null: SimulatedGaussian, t: NDArray[np.float64], found: Fit, before: NDArray[np.float64], after: NDArray[np.float64]
) -> Fit:
    """A fit with the errors that its amplitudes have where the effects act.

    Parameters
    ----------
    null, t, found
        Null, templates, shape (p_raw, K), and the fit of these.
    before, after
        Evidence of the same skies without the effects and with them at their amplitudes, shape (skies, p_raw).

    Notes
    -----
    The fit is linear in the evidence, so that it is applied to every sky. The variance of each amplitude grows by what
    it has among the skies with the effects beyond what it has without them: the same skies, whose common scatter
    cancels. Correlations stay; errors are not made smaller.
    """
    basis, back = orthonormal(null.whiten_templates(t))
    without, acting = (
        np.var(back @ basis.T @ null.whiten_templates(rows.T), axis=1, ddof=1) for rows in (before, after)
    )
    own = np.diag(found.covariance)
    factor = np.sqrt(1.0 + np.divide(np.maximum(acting - without, 0.0), own, out=np.zeros_like(own), where=own > 0.0))
    return replace(found, covariance=factor[:, None] * found.covariance * factor)
