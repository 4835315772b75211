"""The figures of a beam that people compare: solid angle, widths, asymmetry, sidelobes, coefficients."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mcsim.instrument.beams.beam import Beam
from mcsim.instrument.beams.beammap import PEDESTAL, BeamMap, solid_angle_values

DEFAULT_ELLS = (2, 10, 20, 50, 100, 200, 300, 500, 700, 1000, 1500, 2000, 3000)
BAND_LIMITED_WINDOW = 1e-5
CIRCULAR_AXIS_RATIO = 1e-3
_LISTED_ORDERS = 6
_RADII = 400
_AZIMUTHS = 180
_ARCMIN = np.degrees(1.0) * 60


@dataclass(frozen=True, eq=False)
class BeamSummary:
    """Figures of a beam; from its map where there is one, else from its coefficients."""

    source: str  #: ``"map"`` or ``"blm"``
    beam: Beam
    solid_angle_sr: float  #: integral of the response over its peak, steradian
    fwhm_circular_arcmin: float  #: full width at half maximum of the mean over azimuth about the beam's centre
    #: fwhm_major_arcmin, fwhm_minor_arcmin, angle_deg: axes of the ellipse that fits the half-power contour about its
    #: own middle, and the direction of the major one, in degrees from the beam's x axis towards y, -90 to 90
    fwhm_major_arcmin: float
    fwhm_minor_arcmin: float
    angle_deg: float
    negative_over_positive: float  #: integral of the negative response over that of the positive (a number >= 0)
    centroid_arcmin: tuple[float, float]  #: mean offset of the response from the centre along x and y, from b_11
    ells: tuple[int, ...]  #: degrees at which the coefficients are listed
    edge_over_peak: float = 0.0  #: mean response about the edge of the map over its peak; 0 without a map

    @property
    def axis_ratio(self) -> float:
        """Return major over minor full width, >= 1."""
        return float(self.fwhm_major_arcmin / self.fwhm_minor_arcmin)

    @property
    def window(self) -> NDArray[np.float64]:
        """Return B_l at the listed degrees."""
        return self.beam.window[list(self.ells)]

    @property
    def ratios(self) -> NDArray[np.float64]:
        """Return |b_lm / b_l0| at the listed degrees, shape (mmax + 1, len(ells))."""
        blm = np.abs(self.beam.blm[:, list(self.ells)])
        with np.errstate(divide="ignore", invalid="ignore"):
            return blm / blm[0]


def summarize(beam: Beam, beam_map: BeamMap | None = None, ells: tuple[int, ...] = DEFAULT_ELLS) -> BeamSummary:
    """Measure a beam.

    ``beam_map``: the map that it comes from; without it the pattern is synthesised from the
    coefficients, and a beam whose window is not yet small at lmax is then measured broader than it is, with the rings
    of the cut among its negative response. ``ells``: degrees at which to list the coefficients; those above lmax are
    left out.

    Notes
    -----
    The half-power contour is where cubic interpolation first falls below half the peak, at 180 azimuths about the
    middle of the area inside; 1/r^2 = a + b cos 2 phi + c sin 2 phi is fitted to it. Widths of elliptical Gaussians
    come back within 0.1 %, also where they are off the centre (tests/unit/test_beams_summary.py).
    """
    # Half the width of a Gaussian of the same solid angle; sidelobes and elongation only make the search longer.
    response: _Response
    if beam_map is None:
        # Twice the rings and azimuths that the coefficients need: the negative part alone is not band-limited.
        rings = 2 * beam.lmax + 2
        weight = np.sin((np.arange(rings) + 0.5) * np.pi / rings)[:, None]
        on_rings, response = beam.on_rings(rings, 4 * beam.mmax + 4, "F1"), beam.values
        value, total = on_rings * weight, 1.0
        highest = max(float(on_rings.max()), float(beam.values(np.zeros(1), np.zeros(1))[0]))
        ring, column = np.unravel_index(np.argmax(on_rings), on_rings.shape)
        top = complex((ring + 0.5) * np.pi / rings * np.exp(2j * np.pi * column / on_rings.shape[1]))
    else:
        (value, theta, phi), response = solid_angle_values(beam_map), beam_map.values
        total, highest, largest = float(value.sum()), float(beam_map.image.max()), np.argmax(value)
        top = complex(theta[largest] * np.exp(1j * phi[largest]))
    reach = min(8 * np.sqrt(total / highest * np.log(2) / np.pi), np.pi)
    peak, circular, major, minor, angle_deg = _half_power(response, reach, top)
    # b_11 = -sqrt(3/8pi) <sin(theta) exp(-i phi)>
    offset = -np.sqrt(8 * np.pi / 3) * beam.blm[1, 1] if beam.mmax >= 1 else 0j
    return BeamSummary(
        source="blm" if beam_map is None else "map",
        beam=beam,
        solid_angle_sr=total / peak,
        fwhm_circular_arcmin=2 * circular * _ARCMIN,
        fwhm_major_arcmin=2 * major * _ARCMIN,
        fwhm_minor_arcmin=2 * minor * _ARCMIN,
        angle_deg=angle_deg,
        negative_over_positive=float(abs(value[value < 0].sum()) / value[value > 0].sum()),
        centroid_arcmin=(float(offset.real) * _ARCMIN, -float(offset.imag) * _ARCMIN),
        ells=tuple(ell for ell in ells if ell <= beam.lmax),
        edge_over_peak=0.0 if beam_map is None else beam_map.edge_over_peak,
    )


def format_summary(summary: BeamSummary) -> str:
    """Lay the figures of a beam out as plain text, one fact a line, then a table over l."""
    if summary.axis_ratio - 1 < CIRCULAR_AXIS_RATIO:
        orientation = "circular"
    else:
        orientation = f"major axis {round(summary.angle_deg, 1) + 0.0:+.1f} deg from x towards y"
    # Adding 0.0 turns a rounded -0.0 into 0.0.
    x, y = (round(offset, 3) + 0.0 for offset in summary.centroid_arcmin)
    beam, last = summary.beam, summary.beam.window[-1]
    square, share = summary.solid_angle_sr * _ARCMIN**2, summary.negative_over_positive
    negative = f"{share:.2g} of the positive" if share > _ROUNDED else "none"
    beyond = f": {beam.neglected_power:.1e} of the power beyond mmax" if beam.neglected_power > 0 else ""
    lines = [
        f"solid angle          {summary.solid_angle_sr:.4e} sr = {square:.{0 if square >= 1e4 else 2}f} arcmin^2",
        f"FWHM, circular part  {summary.fwhm_circular_arcmin:.2f} arcmin",
        f"FWHM, major x minor  {summary.fwhm_major_arcmin:.2f} x {summary.fwhm_minor_arcmin:.2f} arcmin",
        f"axis ratio           {summary.axis_ratio:.4f}, {orientation}",
        f"mean offset          ({x:+.3f}, {y:+.3f}) arcmin in (x, y)",
        f"negative response    {negative}",
        f"integral             {beam.integral:.6g} (unit of the source x sr), divided out so that B_0 = 1",
        f"lmax, mmax           {beam.lmax}, {beam.mmax}{beyond}",
    ]
    if summary.source == "blm" and abs(last) > BAND_LIMITED_WINDOW:
        lines.append(
            f"note                 B_l is still {last:.2g} at lmax = {beam.lmax}: widths, solid "
            "angle and negative response are those of the beam cut there"
        )
    if abs(summary.edge_over_peak) > PEDESTAL:
        lines.append(
            f"note                 the response is still {summary.edge_over_peak:.2g} of the peak at the edge of the "
            "map, or at its cut_deg: solid angle and B_l are those of all within; use more of it, or subtract what is "
            "no beam"
        )
    window, table = summary.window, summary.ratios
    orders = [m for m in range(1, min(beam.mmax, _LISTED_ORDERS) + 1) if np.any(table[m] > 0)]
    lines += ["", "     l          B_l" + "".join(f"{f'|b_l{m}/b_l0|':>14}" for m in orders)]
    for i, ell in enumerate(summary.ells):
        if abs(window[i]) < _LISTED_WINDOW and i > 1:
            lines.append(f"{ell:6d}  |B_l| is below {_LISTED_WINDOW:g} here and beyond")
            break
        ratios = "".join(f"{table[m, i]:14.3e}" if m <= ell else f"{'–':>14}" for m in orders)
        lines.append(f"{ell:6d} {window[i]:12.6f}{ratios}")
    return "\n".join(lines)


_ROUNDED = 1e-9  #: negative response over the positive that is a rounding error
_LISTED_WINDOW = 1e-9  #: smallest B_l that is listed: ratios to smaller ones are noise

_Response = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


def _half_power(response: _Response, reach: float, top: complex) -> tuple[float, float, float, float, float]:
    """Return peak, half widths of circular part, major and minor axis (radians), and the major axis' angle (deg).

    ``top``: where the response is nearly largest, theta e^{i phi}; the contour is sought within ``reach`` of it.
    """
    distance = np.linspace(0, reach, _RADII)
    phi = np.arange(_AZIMUTHS) * 2 * np.pi / _AZIMUTHS
    points = distance * np.exp(1j * phi)[:, None]

    def around(middle: complex) -> NDArray[np.float64]:
        places = middle + points
        return response(np.minimum(np.abs(places), np.pi), np.angle(places))

    def contour(middle: complex) -> tuple[float, NDArray[np.float64]]:
        values = around(middle)
        return float(values.max()), _first_crossing(distance, values, values.max() / 2)

    mean = around(0j).mean(axis=0)
    circular = _first_crossing(distance, mean[None], mean.max() / 2)[0]
    top += points.flat[np.argmax(around(top))]
    _, radius = contour(top)
    to_middle = 2 / 3 * np.sum(radius**3 * np.exp(1j * phi)) / np.sum(radius**2)
    peak, radius = contour(top + np.nan_to_num(to_middle))
    level = np.mean(radius**-2)
    wave = 2 * np.mean(radius**-2 * np.exp(2j * phi))
    minor, major = 1 / np.sqrt(level + abs(wave)), 1 / np.sqrt(level - abs(wave))
    # 1/r^2 is least along the major axis.
    angle_deg = np.degrees(np.angle(-wave)) / 2
    return peak, float(circular), float(major), float(minor), float(angle_deg)


def _first_crossing(theta: NDArray[np.float64], values: NDArray[np.float64], level: float) -> NDArray[np.float64]:
    """Return the angle at which each row of ``values`` first falls below ``level``, interpolated, or NaN."""
    below = values < level
    last = np.argmax(below, axis=1)
    row = np.arange(len(values))
    high, low = values[row, last - 1], values[row, last]
    step = theta[1] - theta[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = theta[last] - step * (level - low) / (high - low)
    return np.where(below.any(axis=1) & (last > 0), crossing, np.nan)
