"""Figures of a diagnosis: every word is on the picture, and no two rows have one name."""

from types import SimpleNamespace

import numpy as np
import pytest

from mcsim.datavector.summaries import Element
from mcsim.diagnosis import figures


@pytest.mark.parametrize("channels", [1, 2, 6])
@pytest.mark.parametrize("fitted", [False, True])
def test_the_words_of_the_table_of_blocks_are_on_the_picture(channels: int, fitted: bool) -> None:
    words = "beam sidelobe of channel 143, calibrated on the dipole"
    measured = [
        Element(f"{effect}/{channel}", "score", (f"M{channel}",), kind="matched", effect=effect)
        for channel in range(channels)
        for effect in (words, "calibration")
    ]
    z = np.ones(len(measured))
    figure = figures.blocks_figure(SimpleNamespace(elements=measured, z=z, z_after=z if fitted else None))
    figure.draw_without_rendering()
    for axes in figure.axes:
        box = axes.get_tightbbox()
        assert min(box.x0, box.y0) >= 0.0
        assert box.x1 <= figure.bbox.x1
        assert box.y1 <= figure.bbox.y1


def test_long_names_that_differ_in_their_middle_have_different_labels() -> None:
    ends = "a sidelobe of the beam of channel", "that is calibrated on the dipole of the sky"
    names = [f"{ends[0]} {name}, {ends[1]}" for name in ("planck_hfi_100", "planck_hfi_143")]
    candidates = [SimpleNamespace(label=name) for name in (*names, "a gain")]
    figure = figures.correlation_figure(SimpleNamespace(candidates=candidates, correlation=np.eye(3), sets=()))
    shown = {label.get_text() for label in figure.axes[0].get_yticklabels()}
    assert len(shown) == 3
    assert "a gain" in shown
