"""Effects that change nothing are no candidates, and the reason is said."""

import numpy as np
import pytest

from instruments import two_channels
from mcsim import config, systematics
from mcsim.datavector.analysis import Analysis, analysis_of, check_asked
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from refusals import refused


def analysis(scan: str, window: str, *effects: dict[str, object]) -> Analysis:
    table = two_channels("centred", lmax=16, nside=8, fwhm_arcmin=900.0)
    table["map"]["pixel_window"] = window
    table["effect"] = list(effects)
    if scan == "parallel_transport":
        table["channel"] = [one | {"scan": {"kind": scan}} for one in table["channel"]]
    settings = DiagnosisSettings(beam_orders=1, split_beam_orders=1)
    others = tuple(name for name in systematics.catalogue() if name not in ("pixelization", "calibration"))
    return analysis_of(config.load(table), others, settings=settings)


@pytest.mark.parametrize(
    ("scan", "window", "changed"),
    [("parallel_transport", "none", False), ("parallel_transport", "computed", True), ("hit_averaged", "none", True)],
)
def test_samples_at_the_centres_of_their_pixels_cannot_come_closer(scan: str, window: str, changed: bool) -> None:
    found = analysis(scan, window)
    assert ("pixelization" in {one.name for one in found.candidates}) == changed
    closer = {"name": "pixelization", "channel": "W1", "amplitude": 0.5}
    before, after = (simulate.maps(survey(one.run), 0) for one in (found, analysis(scan, window, closer)))
    assert np.array_equal(before, after) != changed
    if changed:
        check_asked(found, ["pixelization"])
    else:
        with refused("pixelization"):
            check_asked(found, ["pixelization"])
