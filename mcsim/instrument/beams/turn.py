"""The same beam in another attitude: turned about its axis, or seen in a mirror."""

from dataclasses import replace

import numpy as np

from mcsim.instrument.beams.beam import Beam
from mcsim.sphere.checks import check_angle


def rotated(beam: Beam, angle: float) -> Beam:
    """Return the beam turned about its own axis by ``angle`` radians, from x towards y.

    Notes
    -----
    B'(theta, phi) = B(theta, phi - angle), so that b_lm becomes e^{-i m angle} b_lm.
    """
    check_angle(angle, "the angle of a beam")
    if angle == 0.0:
        return beam
    phases = np.exp(-1j * angle * np.arange(beam.mmax + 1))
    return replace(beam, blm=phases[:, None] * beam.blm)


def mirrored(beam: Beam) -> Beam:
    r"""Return the beam of an instrument's other side, a mirror image in a plane through the spin axis.

    Notes
    -----
    A mirror plane through the spin axis s sends side A's boresight n to side B's, and s to itself. A cross product
    changes sign in a mirror: x_A = s x n_A goes to -x_B, and y_A, which points towards s, to y_B. So side B is side A
    with x -> -x in the beam's own frame, B'(theta, phi) = B(theta, pi - phi), and b_lm becomes (-1)^m conj(b_lm):
    what leads in the scan on one side trails on the other. WMAP is built so: the azimuths of its horns about the spin
    axis are a on side A and 180 deg - a on side B to 0.2 deg (scan_models/wmap_focal_plane.toml), where a half turn
    about the spin axis would have made them a and 180 deg + a.
    """
    signs = (-1.0) ** np.arange(beam.mmax + 1)
    return replace(beam, blm=signs[:, None] * beam.blm.conj())
