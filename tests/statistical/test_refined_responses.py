"""Responses in skies that maps with the very effect constrain are those of the true sky, in the mean: k sigma."""

from functools import lru_cache

import numpy as np
import pytest

from instruments import ask, data_of, learned, two_channels
from mcsim import systematics
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.simulation import simulate

SKIES, DRAWS = 16, 8


@lru_cache(maxsize=1)
def known(sigma0_uk: float) -> DiagnosisContext:
    """Return what is learned of two channels of a scan that transports the beam along meridians."""
    table = two_channels("transported", sigma0_uk=sigma0_uk)
    for channel in table["channel"]:
        channel["scan"] = {"kind": "parallel_transport"}
    return learned(table, "beam_width", "calibration")


@pytest.mark.parametrize(
    ("sigma0_uk", "name", "amplitude"),
    [
        (1.0, "beam_width", 0.03),
        (1.0, "beam_width", -0.03),
        (9.0, "beam_ellipticity", 0.4),
        (9.0, "calibration", 0.02),
    ],
)
def test_a_fit_by_the_response_has_the_amplitude(sigma0_uk, name, amplitude):
    """In skies that lacked what a beam takes, up to a tenth at some degree, 0.03 was 0.0315 and -0.03 was -0.0286."""
    context = known(sigma0_uk)
    null, channel = context.null, context.run.channels[0].name
    (own,) = [one for one in context.candidates if one.identity == (name, channel)]
    effect = own.table(systematics.get(name)(amplitude=amplitude))
    surveys, found = (data_of(context.run), data_of(context.run, name, channel, amplitude=amplitude)), []
    for realization in range(SKIES):
        before, after = (list(simulate.maps(one, realization)) for one in surveys)
        data = ObservedMaps(context, after, ask)
        true = null.whiten_templates((data.x - context.analysis.data_vector(before))[:, None])[:, 0]
        each = null.whiten_templates(data.respond([effect], DRAWS).T)
        mean = each.mean(axis=1)
        # The fitted amplitude over the true one, and by how much single draws move it.
        found.append(1.0 + (true - each.T) @ mean / (mean @ mean))
    ratio = np.array(found)
    skies, draws = ratio.mean(axis=1), ratio.mean(axis=0)  # all skies have the same draws
    variance = np.var(skies, ddof=1) / SKIES + np.var(draws, ddof=1) / DRAWS
    assert variance < 0.006**2
    assert abs(ratio.mean() - 1.0) < 4.0 * np.sqrt(variance)
