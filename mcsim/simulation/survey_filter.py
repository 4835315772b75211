"""The inverse-covariance filters of a survey's maps."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.bipolar import Estimator
from mcsim.simulation import convolve
from mcsim.simulation.filtering import TOLERANCE, Filtering, MapFilter, unknown_dipole
from mcsim.simulation.inverse_covariance import InverseCovariance, ObservedMap
from mcsim.support.arrays import divided


def filtering_of(
    run: config.RunConfig,
    channels: Sequence[Any],
    cl: NDArray[np.float64] | None,
    spectra_of: tuple[tuple[tuple[int, int], ...], Estimator],
    nthreads: int,
) -> Filtering | None:
    """Return the filters of the maps of a survey's channels: circular part of the fiducial beams, white noise.

    None: the run does not filter.
    """
    if not run.biposh.filtered:
        return None
    assert cl is not None  # the configuration refuses a filter without a spectrum
    filters = []
    for channel in channels:
        response = convolve.response(channel.site.beam.truncated(0), run.sky.lmax, channel.window)
        for m in channel.maps:
            assert m.noise_uk is not None  # as well as without noise
            weight = np.ones(m.noise_uk.size) if m.weight is None else m.weight / m.weight.max()
            precision = divided(np.where(m.moments.hits > 0, weight**2, 0.0), m.noise_uk**2)
            inverse = InverseCovariance(unknown_dipole(cl), [ObservedMap(response, precision)], TOLERANCE, nthreads)
            filters.append(MapFilter(m.name, inverse, channel.window, config.analysis_lmax(run)))
    pairs, tables = spectra_of
    return Filtering(tuple(filters), pairs, tables, run.biposh.summary_bin, run.biposh.probes)
