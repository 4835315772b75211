"""The filtered sky that all maps of a data set share, in which responses are measured."""

from collections.abc import Sequence
from dataclasses import replace

from mcsim.datavector.filter_model import Model
from mcsim.datavector.wiener_filter import cleaned, filtered_sky, over_masks
from mcsim.support.arrays import Alm, Map


def shared_sky(model: Model, maps: Sequence[Map]) -> Alm:
    """Return the filtered sky s^ of a set of maps, up to the model's lmax, uK.

    Notes
    -----
    It is found to a hundredth of the tolerance of :func:`wiener_filter`. By quadrature alone, what leaks
    between degrees adds power to s^: skies that it constrains had 2 % too much at l > 2.2 nside, and responses in them
    were 0.8 % too large. One iteration of the analysis takes most of it away where the filter is isotropic.
    """
    # The inverse covariance of a mean takes the sky beyond for more noise of other degrees than it is: of a constrained
    # sky that is filtered so, a quarter of the power would be missing at the last degrees. Behind a mask it is as it
    # should be; the isotropic filter would leave up to twice too much.
    if model.pooled and not model.hides:
        model = replace(model, inverse=None, pooled=0.0)
    return filtered_sky(*over_masks(model, cleaned(model, maps)[0]), careful=True)
