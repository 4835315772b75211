"""Read fits: the angles between two sides whose mean is one map, and text reports."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mcsim.beamfit.effective_beam import Fit, comparisons
from mcsim.errors import InputError
from mcsim.support.numbers import measured, number


@dataclass(frozen=True)
class Orientation:
    """Rotation angles of two copies of the configured beam whose mean gives the fitted map."""

    #: symmetric_deg, symmetric_error_deg: angle between the sides if each is rotated by half of it, in opposite senses:
    #: arccos of the modulus of c
    symmetric_deg: float
    symmetric_error_deg: float
    #: one_sided_deg, one_sided_error_deg: angle if only one side is rotated: arccos sqrt(Re c)
    one_sided_deg: float
    one_sided_error_deg: float
    #: common_deg, common_error_deg: rotation of both sides together, -arg(c)/2, modulo 180 degrees; None if the data do
    #: not constrain it
    common_deg: float | None
    common_error_deg: float | None


def orientation(fit: Fit) -> Orientation:
    """Read angles from the complex factor c of b_l2; InputError for a fit of a model other than ``orientation``.

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


def report(fits: Sequence[Fit]) -> str:
    """Return a text that describes fits of several models to the same data."""
    data = fits[0].measured
    modes = ", ".join(mode.name for mode in data.modes)
    first = min(row.ell_min for row in data.rows)
    of = "" if data.pair is None else f" of {data.pair}"
    lines = [
        f"{data.origin}: {data.kind} spectra {modes}{of}, ell = {first}-{data.lmax}, {len(data.rows)} bins",
        f"  {_order(fits)}",
        f"  {_tests(data.simulations)}",
    ]
    if data.unfitted:
        lines.append(f"  also detected in {data.origin}, and not fitted: {', '.join(data.unfitted)} (--mode adds them)")
    for one in fits:
        lines += _model(one)
    for small, large, test in comparisons(fits):
        falls = f"chi2 falls by {test.drop:.3g}" if data.simulations is None else f"F = {test.drop / test.added:.3g}"
        more = f"{test.added} more parameter{'s' if test.added > 1 else ''}"
        lines.append(f"  {large} over {small}: {falls} for {more}, p = {test.probability:.3g}")
    return "\n".join(lines)


def _order(fits: Sequence[Fit]) -> str:
    """Return a sentence on the order of the prediction in the beam, and its reason."""
    beyond = [one.beyond_leading for one in fits if one.beyond_leading is not None]
    text = "leading order in the beam" if fits[0].order == "leading" else "all orders in the beam"
    return f"{text} (those beyond the leading one: {max(beyond):.2g} sigma)" if beyond else text


def _tests(simulations: int | None) -> str:
    """Return a sentence on the definition of the p-values."""
    if simulations is None:
        return "the covariance is taken as known, p-values are chi^2 tests"
    return (
        f"the covariance comes from {simulations} realizations, so p-values are small-sample F tests and chi2 is "
        "scaled to expect its dof"
    )


def _model(one: Fit) -> list[str]:
    solution = one.solution
    values = ", ".join(
        f"{name} = {measured(value, error)}"
        for name, value, error in zip(one.model.parameters, solution.parameters, solution.errors, strict=True)
    )
    lines = [
        f"  {one.model.name}: {values}; chi2/dof = {solution.chi2:.1f}/{solution.dof} = "
        f"{solution.reduced_chi2:.2f}, p = {solution.probability:.3g}"
    ]
    if len(solution.parameters) == 2:
        lines.append(f"    correlation of {' and '.join(one.model.parameters)} {solution.correlation[0, 1]:.3f}")
    if one.model.name == "orientation":
        angles = orientation(one)
        lines.append(
            f"    two sides: {measured(angles.symmetric_deg, angles.symmetric_error_deg, ' deg')} apart, turned either "
            f"way by half; or {measured(angles.one_sided_deg, angles.one_sided_error_deg, ' deg')}, one as configured"
        )
        if angles.common_deg is not None and angles.common_error_deg is not None:
            turned = measured(angles.common_deg, angles.common_error_deg, " deg")
            if one.other is not None:
                angle = np.degrees(-0.5 * np.arctan2(one.other.parameters[1], one.other.parameters[0]))
                turned += f", or by {number(angle)} deg, where chi2 is {one.other.chi2 - solution.chi2:.1f} higher"
            lines.append(f"    both turned by {turned}")
        else:
            lines.append("    these spectra do not say by how much both are turned; those of odd parity may (L2M0d1)")
    if one.each:
        each = one.to_dict()["realizations"]
        pulls = ", ".join(f"{name} {width:.3f}" for name, width in each["pull_width"].items())
        lines.append(
            f"    {each['count']} single realizations: width of the pulls {pulls}; p-values uniform with p = "
            f"{each['probability_uniform']:.3g}"
        )
    return lines
