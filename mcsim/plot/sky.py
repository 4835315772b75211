"""A map of the sky in Mollweide projection, inside a figure."""

from typing import Any

import healpy
import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import AxesImage
from numpy.typing import NDArray


def mollweide(axes: Axes, values: NDArray[np.float64], xsize: int, **style: Any) -> AxesImage:
    """Draw a RING map, ``xsize`` pixels wide, longitude 0 in the middle, increasing to the left; NaN stays empty."""
    nside = healpy.npix2nside(values.size)
    projector: Any = healpy.projector.MollweideProj(xsize=xsize)
    image = projector.projmap(values, lambda x, y, z: healpy.vec2pix(nside, x, y, z))
    image = np.ma.masked_invalid(np.where(np.isneginf(image), np.nan, image))
    axes.set_axis_off()
    return axes.imshow(image, origin="lower", extent=projector.get_extent(), **style)
