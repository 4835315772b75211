"""Relative orientation of two sides whose mean is one map, from a fit with the model ``orientation``."""

from dataclasses import dataclass

import numpy as np

from mcsim.beamfit.effective_beam import Fit
from mcsim.errors import InputError


@dataclass(frozen=True)
class Orientation:
    """Rotation angles of two copies of the configured beam whose mean gives the fitted map.

    Attributes
    ----------
    symmetric_deg, symmetric_error_deg
        Angle between the sides if each is rotated by half of it, in opposite senses: arccos of the modulus of c.
    one_sided_deg, one_sided_error_deg
        Angle if only one side is rotated: arccos sqrt(Re c).
    common_deg, common_error_deg
        Rotation of both sides together, -arg(c)/2, modulo 180 degrees; None if the data do not constrain it.
    """

    symmetric_deg: float
    symmetric_error_deg: float
    one_sided_deg: float
    one_sided_error_deg: float
    common_deg: float | None
    common_error_deg: float | None


def orientation(fit: Fit) -> Orientation:
    """Read angles from the complex factor c of b_l2.

    Raises
    ------
    InputError
        For a fit of another model.

    Notes
    -----
    A beam rotated by an angle a, from x towards y, has b_ls e^{-i s a}. Two sides at phi - delta/2 and phi + delta/2
    have the mean b_l2 e^{-2 i phi} (e^{i delta} + e^{-i delta})/2 = c b_l2 with c = e^{-2 i phi} cos(delta): |c| gives
    the angle between them, arg c the rotation of both. One side at 0 and the other at delta is phi = delta/2: c = (1 +
    e^{-2 i delta})/2, Re c = cos^2(delta). Under a scan that treats both senses of rotation alike (w_2 real) Im c acts
    on odd parity alone; even parity cannot distinguish the two cases. A factor above 1 gives the angle 0, with the
    error arccos(1 - error of the factor). Angles are ambiguous in sign.
    """
    if fit.model.name != "orientation":
        raise InputError(f"angles are read from a fit with the model orientation, not {fit.model.name}; fit that one.")
    values, covariance = fit.solution.parameters, fit.solution.covariance
    real, imaginary = float(values[0]), float(values[1]) if len(values) > 1 else 0.0
    modulus = float(np.hypot(real, imaginary))
    direction = np.array([real, imaginary][: len(values)]) / modulus
    width = float(np.sqrt(direction @ covariance @ direction))
    common = common_error = None
    if len(values) > 1:
        across = np.array([-imaginary, real]) / modulus
        common = float(np.degrees(-0.5 * np.arctan2(imaginary, real)))
        common_error = float(np.degrees(0.5 * np.sqrt(across @ covariance @ across) / modulus))
    symmetric = _arccos(modulus, width)
    error_real = float(np.sqrt(covariance[0, 0]))
    root = float(np.sqrt(max(real, 0.0)))
    one_sided = _arccos(root, 0.5 * error_real / root if root > 0.0 else np.inf)
    return Orientation(*symmetric, *one_sided, common, common_error)


def _arccos(cosine: float, error: float) -> tuple[float, float]:
    """Return the angle and its error in degrees; for a cosine >= 1 the error is arccos(1 - error)."""
    if cosine >= 1.0:
        return 0.0, float(np.degrees(np.arccos(max(1.0 - error, -1.0))))
    return float(np.degrees(np.arccos(cosine))), float(np.degrees(error / np.sqrt(1.0 - cosine**2)))
