"""Figures and pictures of beams whose figures are known."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from mcsim.instrument.beams import Beam, BeamMap, format_summary, summarize
from mcsim.plot.beam import beam_figure

SIGMA_PER_FWHM = 1 / np.sqrt(8 * np.log(2))
PIXEL = np.radians(0.04)


def drawn(major, minor, angle_deg, size=151, centre=(74.6, 75.3), offset=(0.0, 0.0)) -> BeamMap:
    sigma = np.radians(np.array([major, minor]) / 60) * SIGMA_PER_FWHM
    x, y = (np.arange(size) - centre[0])[None, :] * PIXEL, (np.arange(size) - centre[1])[:, None] * PIXEL
    x, y = x - offset[0], y - offset[1]
    cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    image = np.exp(-(((x * cos + y * sin) / sigma[0]) ** 2 + ((y * cos - x * sin) / sigma[1]) ** 2) / 2)
    return BeamMap(5.0 * image, PIXEL, centre, np.radians(2.8))


@pytest.mark.parametrize("known_as", ["map", "blm"])
@pytest.mark.parametrize(("major", "minor", "angle_deg"), [(30.0, 24.0, 20.0), (40.0, 20.0, -65.0)])
def test_ellipse_is_measured(known_as, major, minor, angle_deg) -> None:
    # At lmax 3000 and mmax 60 nothing of these beams is cut, so that no rings are measured as negative response.
    beam = Beam.elliptical(major, minor, angle_deg=angle_deg, lmax=3000, mmax=60)
    beam_map = drawn(major, minor, angle_deg) if known_as == "map" else None
    summary = summarize(beam, beam_map)
    sigma = np.radians(np.array([major, minor]) / 60) * SIGMA_PER_FWHM
    assert summary.source == known_as
    # Peak and contour are read off a grid of 1/50 of the half width, linear in between: 1e-4; twice that in area.
    assert summary.solid_angle_sr == pytest.approx(2 * np.pi * sigma.prod(), rel=1e-3)
    assert summary.fwhm_major_arcmin == pytest.approx(major, rel=1e-3)
    assert summary.fwhm_minor_arcmin == pytest.approx(minor, rel=1e-3)
    assert summary.axis_ratio == pytest.approx(major / minor, rel=1e-3)
    assert summary.angle_deg == pytest.approx(angle_deg, abs=0.1)
    assert summary.negative_over_positive < 1e-6


@pytest.mark.parametrize("known_as", ["map", "blm"])
@pytest.mark.parametrize("offset_arcmin", [(9.0, -6.0), (-40.0, 30.0)])
def test_ellipse_off_the_centre_has_the_same_axes(known_as, offset_arcmin) -> None:
    # The second is farther from the centre than the width of the beam, where there is no half-power contour about it.
    beam_map = drawn(30.0, 24.0, 20.0, offset=np.radians(np.array(offset_arcmin) / 60))
    # Orders up to 48 hold all of a beam so far off the centre at these degrees.
    beam = Beam.from_map(beam_map, 1500, 48)
    summary = summarize(beam, beam_map if known_as == "map" else None)
    assert summary.centroid_arcmin == pytest.approx(offset_arcmin, abs=0.01)
    assert summary.fwhm_major_arcmin == pytest.approx(30.0, rel=1e-3)
    assert summary.fwhm_minor_arcmin == pytest.approx(24.0, rel=1e-3)
    assert summary.angle_deg == pytest.approx(20.0, abs=0.1)
    sigma = np.radians(np.array([30.0, 24.0]) / 60) * SIGMA_PER_FWHM
    assert summary.solid_angle_sr == pytest.approx(2 * np.pi * sigma.prod(), rel=1e-3)


def test_circular_beam() -> None:
    summary = summarize(Beam.gaussian(30, 1500))
    assert summary.fwhm_circular_arcmin == pytest.approx(30, rel=1e-3)
    assert summary.axis_ratio == pytest.approx(1, abs=1e-6)
    assert "circular" in format_summary(summary)


def test_coefficients_at_the_listed_degrees() -> None:
    beam = Beam.elliptical(30, 24, angle_deg=20, lmax=600, mmax=4)
    summary = summarize(beam, ells=(100, 400, 601))
    assert summary.ells == (100, 400)
    np.testing.assert_allclose(summary.window, beam.window[[100, 400]], rtol=1e-15)
    np.testing.assert_allclose(summary.ratios[2], np.abs(beam.blm[2, [100, 400]] / beam.blm[0, [100, 400]]), rtol=1e-14)


def test_negative_response_and_mean_offset_of_a_map() -> None:
    # A negative copy of a tenth of the strength, 1.2 deg away along y: the mean moves by -0.1 x 72' / 0.9.
    beam_map = drawn(20.0, 20.0, 0.0)
    lower = drawn(20.0, 20.0, 0.0, offset=(0.0, np.radians(1.2)))
    both = BeamMap(beam_map.image - 0.1 * lower.image, PIXEL, beam_map.centre, beam_map.cut_rad)
    summary = summarize(Beam.from_map(both, 500), both)
    # A pixel at 1.2 deg has theta^2/6 = 7e-5 less solid angle than one at the centre, and the lobe's own width adds.
    assert summary.negative_over_positive == pytest.approx(0.1, rel=2e-4)
    # sin(theta) for theta, and the lobes' own curvature: 1e-4 of 8'.
    assert summary.centroid_arcmin == pytest.approx((0.0, -0.1 * 72 / 0.9), abs=2e-3)


def test_text_names_what_matters() -> None:
    beam_map = drawn(30.0, 24.0, 20.0)
    text = format_summary(summarize(Beam.from_map(beam_map, 1000), beam_map))
    for fragment in (
        "arcmin^2",
        "30.0",
        "24.0",
        "axis ratio           1.25",
        "+20.0 deg",
        "|b_l2/b_l0|",
        "beyond mmax",
        "negative response    none",
    ):
        assert fragment in text
    assert "note" not in text


def test_text_warns_of_a_pedestal() -> None:
    """A tenth of the peak everywhere makes the solid angle many times what it is."""
    beam_map = drawn(30.0, 30.0, 0.0)
    beam = Beam.elliptical(30.0, 30.0, lmax=500)
    raised = replace(beam_map, image=beam_map.image + 0.5)
    assert "at the edge of the map" not in format_summary(summarize(beam, beam_map))
    assert "0.091 of the peak at the edge of the map" in format_summary(summarize(beam, raised))


def test_text_warns_of_a_beam_cut_at_lmax() -> None:
    assert "B_l is still" in format_summary(summarize(Beam.gaussian(10, 500)))


def test_a_beam_that_ends_early_has_rows_and_no_coefficients_beyond_its_degree() -> None:
    rows = format_summary(summarize(Beam.elliptical(400, 300, lmax=10, mmax=4))).splitlines()[-2:]
    assert [row.split()[0] for row in rows] == ["2", "10"]
    assert [row.split().count("–") for row in rows] == [1, 0]


@pytest.mark.parametrize(("width", "unit"), [(50.0, "arcmin"), (400.0, "deg")])
def test_axes_of_a_wide_beam_are_in_degrees(width, unit) -> None:
    figure = beam_figure(Beam.gaussian(width, 300))
    assert unit in next(axes for axes in figure.axes if axes.get_title().startswith("Peak")).get_xlabel()


@pytest.mark.parametrize("known_as", ["map", "blm", "circular"])
def test_figure_has_its_panels(tmp_path, known_as) -> None:
    beam_map = drawn(30.0, 24.0, 20.0)
    beam = Beam.gaussian(30, 800) if known_as == "circular" else Beam.elliptical(30, 24, angle_deg=20, lmax=800)
    figure = beam_figure(beam, beam_map if known_as == "map" else None, "a$_$b")
    assert isinstance(figure, Figure)
    panels = [axes for axes in figure.axes if axes.get_title()]
    assert len(panels) == 3
    peak = panels[0].images[0].get_array()
    assert peak.max() == 1
    assert len(panels[2].lines) == (1 if known_as == "circular" else 2)
    figure.savefig(tmp_path / "beam.png", dpi=40)
    assert (tmp_path / "beam.png").stat().st_size > 10_000
