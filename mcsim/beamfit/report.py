"""Text reports of fits."""

from collections.abc import Sequence

from mcsim.beamfit.effective_beam import Fit, comparisons
from mcsim.beamfit.orientation import orientation


def report(fits: Sequence[Fit]) -> str:
    """Return a text that describes fits of several models to the same data."""
    measured = fits[0].measured
    modes = ", ".join(mode.name for mode in measured.modes)
    first = min(row.ell_min for row in measured.rows)
    lines = [
        f"{measured.origin}: {measured.kind} spectra {modes}, ell = {first}-{measured.lmax}, {len(measured.rows)} bins",
        f"  {_order(fits)}",
        f"  {_tests(measured.simulations)}",
    ]
    for one in fits:
        lines += _model(one)
    for small, large, test in comparisons(fits):
        lines.append(
            f"  {large} over {small}: chi2 falls by {test.drop:.3g} for {test.added} more parameter"
            f"{'s' if test.added > 1 else ''}, p = {test.probability:.3g}"
        )
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
        f"{name} = {value:.5g} +- {error:.2g}"
        for name, value, error in zip(one.model.parameters, solution.parameters, solution.errors, strict=True)
    )
    lines = [
        f"  {one.model.name}: {values}; chi2/dof = {solution.chi2:.1f}/{solution.dof} = "
        f"{solution.reduced_chi2:.2f}, p = {solution.probability:.3g}"
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
            f"    {each['count']} single realizations: width of the pulls {pulls}; p-values uniform with p = "
            f"{each['probability_uniform']:.3g}"
        )
    return lines
