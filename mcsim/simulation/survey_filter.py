"""The inverse-covariance filters of a survey's maps."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.bipolar import Estimator
from mcsim.errors import InputError
from mcsim.simulation import convolve
from mcsim.simulation.filtering import Filtering
from mcsim.simulation.inverse_covariance import InverseCovariance, ObservedMap
from mcsim.simulation.map_filter import TOLERANCE, MapFilter, unknown_dipole
from mcsim.simulation.preparation import keeps_pixels, templates_of
from mcsim.support.arrays import divided


def filtering_of(
    run: config.RunConfig,
    channels: tuple[Sequence[Any], Sequence[Any]],
    cl: NDArray[np.float64] | None,
    spectra_of: tuple[tuple[tuple[int, int], ...], Estimator],
    nthreads: int,
) -> Filtering | None:
    """Return the filters of a survey's maps: circular part of the fiducial beams, white noise, whatever was subtracted.

    ``channels``: before their maps are prepared, and after. None: the run does not filter. InputError for a preparation
    that does more than fit and subtract, and mask.
    """
    if not run.biposh.filtered:
        return None
    assert cl is not None  # the configuration refuses a filter without a spectrum
    made, prepared = ([(channel, m) for channel in one for m in channel.maps] for one in channels)
    preparations = [m.preparation for _, m in prepared]
    if not keeps_pixels(preparations):
        raise InputError(
            'a mask of [[preparation]] has weights between 0 and 1, which biposh.filter = "inverse_covariance" would '
            "not know of the noise; give it as map.mask, or as zeros and ones in the nside of the maps."
        )
    filters = []
    for (channel, m), (_, analysed), templates in zip(made, prepared, templates_of(preparations), strict=True):
        response = convolve.response(channel.site.beam.truncated(0), run.sky.lmax, channel.window)
        assert m.noise_uk is not None  # as well as without noise
        weight = np.ones(m.noise_uk.size) if analysed.weight is None else analysed.weight / analysed.weight.max()
        precision = divided(np.where(m.moments.hits > 0, weight**2, 0.0), m.noise_uk**2)
        observed = ObservedMap(response, precision, templates=templates)
        inverse = InverseCovariance(unknown_dipole(cl), [observed], TOLERANCE, nthreads)
        filters.append(MapFilter(m.name, inverse, channel.window, config.analysis_lmax(run)))
    pairs, tables = spectra_of
    return Filtering(tuple(filters), pairs, tables, run.biposh.summary_bin, run.biposh.probes)
