"""Products of a sky with smooth fields of the sphere, exactly."""

from collections.abc import Callable

import ducc0
import numpy as np

from mcsim.systematics.base import Alm
from mcsim.systematics.parametrization import Vector


def multiplied(alm: Alm, lmax: int, field: Callable[[Vector, Vector, Vector], Vector], degree: int) -> Alm:
    """Return the coefficients, up to ``lmax``, of a sky times a field.

    ``field`` is a function, of this highest ``degree``, of the components (x, y, z) of the direction, which broadcast.

    Notes
    -----
    Synthesis and analysis on Gauss-Legendre rings that hold degree lmax + degree: exact to round-off.
    """
    rings, columns = lmax + degree + 1, 2 * (lmax + degree) + 2
    theta = np.asarray(ducc0.misc.GL_thetas(rings))[:, None]
    phi = (np.arange(columns) * 2.0 * np.pi / columns)[None, :]
    where = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
    options = {"lmax": lmax, "spin": 0, "geometry": "GL", "nthreads": 1}
    sky = ducc0.sht.synthesis_2d(alm=alm[None], ntheta=rings, nphi=columns, **options)[0]
    return np.asarray(ducc0.sht.analysis_2d(map=(sky * field(*where))[None], **options))[0]
