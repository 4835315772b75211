"""The mean spectrum of an isotropic sky that weights of pixels multiply."""

import ducc0
import numpy as np

from mcsim.bipolar.theory.harmonics import spin_functions
from mcsim.support.arrays import Cl

ROUNDING = 1e-14  #: error of a sum over its terms


def pseudo_spectrum(cl: Cl, weights: Cl, lmax: int) -> Cl:
    """Return sum_l' (2l'+1)/4pi C_l' sum_L (2L+1) W_L (l l' L; 0 0 0)^2, uK^2, shape (lmax + 1,).

    ``cl`` is the spectrum of the sky through the beam, uK^2, and ``weights`` that of the weights, or the cross spectrum
    of those of two maps, W_L = sum_M W_X,LM W_Y,LM* / (2L + 1). It is not divided by <W_X W_Y>.

    Notes
    -----
    The correlation function of a product is that of the sky times that of the weights (Hivon et al., ApJ 567, 2, 2002;
    Szapudi et al., ApJ 548, L115, 2001). The integral over angles is exact by Gauss and Legendre.
    """
    top, degrees = max(len(cl), len(weights), lmax + 1) - 1, len(cl) + len(weights) + lmax
    nodes = degrees // 2 + 1
    theta, share = ducc0.misc.GL_thetas(nodes), ducc0.misc.GL_weights(nodes, 1)  # of the sphere: they include 2 pi
    functions = spin_functions(0, top, theta)[0]
    norm = np.sqrt(4.0 * np.pi / (2.0 * np.arange(top + 1) + 1.0))
    sky, weight = ((one / norm[: len(one)]) @ functions[: len(one)] for one in (cl, weights))
    product = share * sky * weight
    found = norm[: lmax + 1] * (functions[: lmax + 1] @ product)
    # What is left of a sum by rounding has either sign.
    return np.where(np.abs(found) > ROUNDING * np.sum(np.abs(product)), found, 0.0)
