"""Fit effective beams in one call."""

import os
from collections.abc import Sequence
from pathlib import Path

from mcsim.beamfit.data import EVERYTHING, Measurement, Selection
from mcsim.beamfit.effective_beam import Fit, fit_models, measurement
from mcsim.beamfit.report import report
from mcsim.beamfit.templates import Order
from mcsim.ensemble.expectation import Source, survey_of


class Fits(tuple[Fit, ...]):
    """Fits of several models to the same data; printed as ``mcsim fit`` prints them."""

    __slots__ = ()

    def __repr__(self) -> str:
        """Return the text that ``mcsim fit`` prints."""
        return report(self)


def fit(
    data: str | Path | Measurement,
    config: Source,
    models: Sequence[str] = ("constant", "linear"),
    *,
    selection: Selection = EVERYTHING,
    order: Order = "auto",
) -> Fits:
    """Fit effective beams b_l2 f_l to measured or simulated BipoSH.

    Parameters
    ----------
    data
        Store of an ensemble, whose mean is fitted; or ECSV table of binned spectra; or a result of
        :func:`mcsim.beamfit.measurement`, which has further options.
    config
        Run whose spectrum and scan are used and whose beams are rescaled: often the beam of the data under parallel
        transport. A TOML file, the name of a packaged workflow, a dict, or a loaded configuration.
    models
        Models of f_l: "constant", "linear" (alpha + beta l), "spline", "orientation".
    selection
        Modes, multipoles, kind of spectra and pair of maps; by default A^20 at d = 0 and 2 of the first pair.
    order
        "leading" or "exact" (to all orders in the beam); "auto": exact if the data distinguish the two.

    Returns
    -------
    Fits
        One :class:`mcsim.beamfit.Fit` per model, in order, with ``solution.parameters``, ``solution.errors``,
        ``solution.chi2`` and ``factor()``.

    Raises
    ------
    InputError
        For data that do not match the configuration or the models, too few realizations, or circular beams.

    Examples
    --------
    >>> import mcsim
    >>> store = mcsim.run("tiny", "tiny.zarr").store
    >>> fits = mcsim.fit(store, "tiny", ["constant"])
    >>> fits[0].model.parameters
    ('alpha',)
    >>> bool(abs(fits[0].solution.parameters[0] - 1.0) < 0.1)  # the beam and scan are those of the data
    True
    """
    nthreads = os.cpu_count() or 1
    survey = survey_of(config, nthreads)
    measured = measurement(data, survey, selection)
    return Fits(fit_models(measured, survey, models, order=order, nthreads=nthreads))
