"""What scores are made of, and that it is made once."""

from dataclasses import replace

import numpy as np
import pytest

from mcsim import systematics
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import ScanModel
from mcsim.simulation import pixel_means
from mcsim.simulation.pixel_means import mean_gain

HALVES = ((0.0, 0.5), (0.5, 1.0))


@pytest.mark.slow
def test_gain_of_every_half_is_kept_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    model = replace(ScanModel.load("wmap"), sample_period_s=61.0, duration_days=365.0)
    line = model.line_of_sight("A")
    site = systematics.Site(
        channel="W1",
        frequency_ghz=94.0,
        frame="ecliptic",
        nside=8,
        lmax=8,
        beam=Beam.elliptical(330.0, 300.0, angle_deg=20.0, lmax=8),
        pointing=systematics.Pointing(model, replace(line, sample_period_s=None)),
        dipole_uk=np.zeros(3),
    )
    drifts = [systematics.get("gain_drift")(amplitude=0.01, phase_deg=phase) for phase in (0.0, 90.0)]
    passes = []
    monkeypatch.setattr(pixel_means, "mean_gain", lambda *args: passes.append(args) or mean_gain(*args))
    for _ in range(2):
        for drift in drifts:
            for share in HALVES:
                np.testing.assert_array_equal(pixel_means.gain_of(drift, site, share), mean_gain((drift,), site, share))
    assert len(passes) == 4
    # A sine of the year is positive in its first half and as negative in its second.
    first, second = (pixel_means.gain_of(drifts[1], site, share).mean() for share in HALVES)
    assert first == pytest.approx(0.01 * 2 / np.pi, rel=0.1)
    assert second == pytest.approx(-first, rel=0.1)
