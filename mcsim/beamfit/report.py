"""Fits in words."""

from collections.abc import Sequence

from mcsim.beamfit.effective_beam import Fit, comparisons
from mcsim.beamfit.orientation import orientation


def report(fits: Sequence[Fit]) -> str:
    """Text about fits of several models to the same data."""
    measured = fits[0].measured
    known = f"covariance of {measured.simulations} realizations" if measured.simulations else "independent errors"
    modes = ", ".join(mode.name for mode in measured.modes)
    first = min(row.ell_min for row in measured.rows)
    lines = [
        f"{measured.origin}: {measured.kind} spectra {modes}, ell = {first}-{measured.lmax}, "
        f"{len(measured.rows)} bins, {known}"
    ]
    for one in fits:
        lines += _model(one)
    for small, large, test in comparisons(fits):
        lines.append(
            f"  {large} over {small}: chi2 falls by {test.drop:.4g} for {test.added} more, by chance with probability "
            f"{test.probability:.3g}"
        )
    return "\n".join(lines)


def _model(one: Fit) -> list[str]:
    solution = one.solution
    values = ", ".join(
        f"{name} = {value:.5g} +- {error:.2g}"
        for name, value, error in zip(one.model.parameters, solution.parameters, solution.errors, strict=True)
    )
    lines = [
        f"  {one.model.name}: {values}; chi2 = {solution.chi2:.4g} for {solution.dof} degrees of freedom "
        f"(reduced {solution.reduced_chi2:.3g}), probability {solution.probability:.3g}"
    ]
    if len(solution.parameters) == 2:
        lines.append(f"    correlation {solution.correlation[0, 1]:.3f}")
    if one.model.name == "orientation":
        angles = orientation(one)
        lines.append(
            f"    two sides: {angles.symmetric_deg:.3g} +- {angles.symmetric_error_deg:.2g} deg apart, turned either "
            f"way by half; or {angles.one_sided_deg:.3g} +- {angles.one_sided_error_deg:.2g} deg, one as configured"
        )
        if angles.common_deg is not None:
            lines.append(f"    both turned by {angles.common_deg:.3g} +- {angles.common_error_deg:.2g} deg")
    if one.each:
        each = one.to_dict()["realizations"]
        pulls = ", ".join(f"{name} {width:.3f}" for name, width in each["pull_width"].items())
        lines.append(
            f"    {each['count']} single realizations: width of the pulls {pulls}; probabilities uniform with p = "
            f"{each['probability_uniform']:.3g}"
        )
    return lines
