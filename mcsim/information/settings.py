"""What the limit of a model is computed of, and how."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

from mcsim.errors import InputError
from mcsim.support.settings import check_settings
from mcsim.systematics import Library


@dataclass(frozen=True)
class LimitSettings:
    """Set effects, nuisances, levels and random probes of :func:`mcsim.limit`.

    Attributes
    ----------
    only
        Names of the effects to compute; empty: all that apply. The look-elsewhere correction is for all in any case.
    without
        Names of effects that are left out, of the look-elsewhere correction too.
    library
        Effects by name, as :func:`mcsim.effects` returns them; None: all of these.
    nuisances
        Width of the Gaussian prior, in the effect's unit, of every coordinate of effects that are unknown but not
        looked for: ``{"beam_width": 0.01}`` in every channel, ``{"beam_width:W1": 0.01}`` in one; ``"FILE.py"`` or
        ``"FILE.py:W1"`` for the effect of a file. The limits of the others are marginalised over them, and over the
        nuisances of the run.
    unknown_dipole_uk
        Rms over the sky, in uK, of a monopole and of a dipole that all maps share and of which nothing is known; 0: the
        model's spectrum says all of the sky. A model without power there knows them, but for noise, and so knows what
        modulations make of a quadrupole.
    alpha, power
        Global level of the test, and its power, above it, at the amplitudes that are called detected.
    separation
        Probability, above a half, that the right one of two effects is chosen where they are called told apart.
    orders
        Highest azimuthal order of the fiducial beams in the inverse covariance, the centroids of the samples included;
        0: circular beams at pixel centres. What an effect changes has all orders in any case.
    probes
        Number of random probes, 3 or more; the relative error of sigma is about 1/probes. Where so many sets of maps
        exceed 1 GB, groups of them that fit are paired, and it is one over the root of twice the number of pairs.
    dense
        Compute whole matrices, without random probes: the reference for small maps.
    tolerance
        Relative residual at which the conjugate gradients end. What the sky is above the noise, squared, multiplies it
        in the largest scales, so that 1e-4 is too much there; behind a mask 1e-6 changed a limit by 0.2 %, 1e-7 none
        by 1e-4.
    seed
        Of the random probes.

    Examples
    --------
    >>> import mcsim
    >>> mcsim.LimitSettings(only=("beam_width",), nuisances={"gain_drift": 1e-4}).probes
    64
    """

    only: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    library: Library | None = None
    nuisances: Mapping[str, float] = field(default_factory=dict)
    unknown_dipole_uk: float = 0.0
    alpha: float = 0.05
    power: float = 0.9
    separation: float = 0.95
    orders: int = 0
    probes: int = 64
    dense: bool = False
    tolerance: float = 1e-7
    seed: int = 0

    def __post_init__(self) -> None:
        """Raise InputError for settings of another kind, negative numbers, levels and widths that mean nothing."""
        check_settings(self)
        if not isinstance(self.nuisances, Mapping):
            raise InputError(f"nuisances = {self.nuisances!r} is no dict; give widths, as {{'calibration': 0.01}}.")
        given: Mapping[str, Any] = self.nuisances
        for name, width in given.items():
            if not isinstance(width, Real) or not 0.0 < float(width) < math.inf:
                raise InputError(f"nuisance {name} has a width of {width!r}; give that of its prior, a number above 0.")
        if self.tolerance == 0.0:
            raise InputError("tolerance = 0 is never reached; give a relative residual above 0, such as 1e-7.")
        for name in ("alpha", "power", "separation"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise InputError(f"{name} = {getattr(self, name):g} is no probability; give one between 0 and 1.")
        if self.power <= self.alpha:
            raise InputError(
                f"power = {self.power:g} is not above alpha = {self.alpha:g}, which maps without any effect reach; "
                "raise power, or lower alpha."
            )
        if self.separation <= 0.5:
            raise InputError(
                f"separation = {self.separation:g} is no more than a guess of one out of two has; give one above 0.5."
            )
