"""From a two-dimensional beam map to b_lm, exact on the curved sky."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil, pi, sin
from pathlib import Path
from typing import Literal, Self, get_args

import ducc0
import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.beams.coefficients import check_lmax, check_mmax, unpacked
from mcsim.sphere.checks import check_finite, check_number
from mcsim.sphere.header import opened
from mcsim.support.folders import unreadable, user_path
from mcsim.support.npy import read_npy

Projection = Literal["equidistant", "orthographic", "equal_area"]
PEAK_BOX = 8
DEFAULT_CUT_DEG = 3.5
SMALLEST_CUT_PIXELS = 2
NARROWEST_DEG = 1 / 30  #: of a beam whose header gives no unit: a narrower one may be one of up to 2 deg, in radians
PEDESTAL = 0.01  #: response about the edge of a map over its peak from which on it is told of
HARDLY = 0.3  #: width in radians times lmax up to which a beam without a unit acts so little that it may be 57 times it
_UNITS = ("CUNIT1", "CUNIT2")


@dataclass(frozen=True, eq=False)
class BeamMap:
    """A beam map with what is needed to place it on the sky."""

    image: NDArray[np.float64]  #: response at the pixel centres in any unit; column = beam x (in-scan), row = beam y
    pixel_rad: float  #: side of a pixel in radians
    #: column and row of the beam's centre, from 0 (fractions allowed; pixel centres are at integers)
    centre: tuple[float, float]
    cut_rad: float  #: angle from the centre beyond which the map is not used, radians
    #: what a distance rho from the centre in the map is on the sky: theta = rho (``equidistant``), sin theta = rho
    #: (``orthographic``: the u, v grids of optics codes), 2 sin(theta/2) = rho (``equal_area``)
    projection: Projection = "equidistant"

    def __post_init__(self) -> None:
        """Raise InputError unless the image is finite and its centre and cut can be used."""
        image = self.image
        if not isinstance(image, np.ndarray) or image.ndim != 2 or image.dtype.kind not in "fiu":
            raise InputError(f"a beam map has shape {np.shape(image)}, but it must be a real two-dimensional array")
        check_finite(image, "the beam map")
        if not 0.0 < self.cut_rad <= pi / 2:
            raise InputError(f"cut_rad = {self.cut_rad:g} of a beam map must be above 0 and at most pi/2: give radians")
        _check_centre(image, self.centre)

    def blm(self, lmax: int, mmax: int | None = None) -> NDArray[np.complex128]:
        """Return the coefficients up to the largest order that the cut can hold, in the map's unit times sr."""
        check_lmax(lmax)
        if mmax is not None:
            check_mmax(mmax, lmax)
        # No order above lmax sin(cut) fits inside the cut, so that this holds the beam's whole power up to lmax.
        holds_all = min(lmax, ceil(lmax * sin(min(self.cut_rad, pi / 2))) + 32)
        return blm_of_map(self, lmax, max(holds_all, mmax or 0))

    def without_pixel_window(self) -> Self:
        """Return the map with the window of its pixels divided out, for values that are means over the pixels."""
        # A margin of zeros keeps what wraps around in the discrete transform off the other edge.
        rows, columns = self.image.shape
        shape = (rows + 2 * PEAK_BOX, columns + 2 * PEAK_BOX)
        window = np.outer(np.sinc(np.fft.fftfreq(shape[0])), np.sinc(np.fft.rfftfreq(shape[1])))
        return replace(self, image=np.fft.irfft2(np.fft.rfft2(self.image, shape) / window, shape)[:rows, :columns])

    @property
    def edge_over_peak(self) -> float:
        """Mean response of the last pixels about the centre that are used, over the largest one."""
        (rows, columns), (x, y) = self.image.shape, self.centre
        cut = float(_PROJECTIONS[self.projection][0](np.asarray(self.cut_rad))) / self.pixel_rad
        last = max(min(cut, x, y, columns - 1 - x, rows - 1 - y), 1.0)
        radius = np.hypot(np.arange(columns) - x, (np.arange(rows) - y)[:, None])
        return float(self.image[(radius > last - 1.0) & (radius <= last)].mean() / self.image.max())

    def values(self, theta: NDArray[np.float64], phi: NDArray[np.float64]) -> NDArray[np.float64]:
        """Interpolate the response (cubic) at angles from the centre and azimuths from x towards y; 0 outside."""
        from scipy.ndimage import map_coordinates  # here: it loads slowly, in every process, and few beams are maps

        radius = _PROJECTIONS[self.projection][0](theta) / self.pixel_rad
        column, row = self.centre
        position = [row + radius * np.sin(phi), column + radius * np.cos(phi)]
        values: NDArray[np.float64] = map_coordinates(self.image, position, order=3, mode="constant")
        return values


def read_map(
    path: str | Path,
    *,
    pixel_deg: float | None = None,
    cut_deg: float = DEFAULT_CUT_DEG,
    centre: tuple[float, float] | None = None,
    plane: int = 0,
    projection: Projection = "equidistant",
    lmax: int | None = None,
) -> BeamMap:
    """Read a beam map from the first image of a FITS file.

    ``path``: FITS file (may be gzipped); column = beam x (in-scan), row = beam y. ``pixel_deg``, ``cut_deg``,
    ``centre``: as for :meth:`mcsim.instrument.beams.Beam.from_map`. ``plane``: plane of a three-dimensional image (a
    WMAP beam file has side A, its noise, side B, its noise). ``projection``: see :class:`BeamMap`. Values are those at
    the pixel centres; of means over the pixels take :meth:`BeamMap.without_pixel_window`. ``lmax``: highest degree
    of the maps that the beam is for, at which steps without a unit are doubted.

    Notes
    -----
    Projections differ at third order in the distance. For the WMAP-7 maps with a cut of 3.5 deg (projection not
    recorded), orthographic for equidistant changes B_l by at most 3e-5 of B_0 and b_l2 by at most 2e-4 of the largest
    |b_l2| in V and W, 8e-5 and 4e-4 in K. The plane of projection is taken to touch the sphere at the beam's centre;
    that the WMAP maps have the optic axis there, up to 3 deg away, is of the same order.
    """
    image, header = _read_image(user_path(path), plane)
    step_deg = _pixel_deg(header, path) if pixel_deg is None else pixel_deg
    beam_map = placed(image, step_deg, cut_deg=cut_deg, centre=centre, projection=projection, origin=str(path))
    if pixel_deg is None and not any(str(header.get(axis, "")).strip() for axis in _UNITS):
        _check_unit(beam_map, step_deg, path, lmax)
    return beam_map


def _check_unit(beam_map: BeamMap, step: float, path: str | Path, lmax: int | None) -> None:
    """Raise InputError if a header without a unit gives a beam so narrow in degrees that it may be in radians.

    Warn of one that is wider, but hardly acts up to ``lmax``.
    """
    pixels = 2.0 * np.sqrt(np.count_nonzero(beam_map.image > 0.5 * beam_map.image.max()) / pi)
    said = (
        f"{path} has steps of {step:g} without a unit (CDELT1, CUNIT1), and a beam {60.0 * pixels * step:.2g} arcmin "
        f"wide if they are in degrees, or {60.0 * np.degrees(pixels * step):.4g} arcmin if in radians"
    )
    remedy = f"give pixel_deg = {step:g} or {np.degrees(step):g}"
    if pixels * step < NARROWEST_DEG:
        raise InputError(f"{said}; {remedy}")
    if lmax is not None and np.radians(pixels * step) * lmax < HARDLY:
        warnings.warn(f"{said}; up to lmax = {lmax} the first hardly changes a map: {remedy}.", stacklevel=2)


def placed(
    image: NDArray[np.float64],
    pixel_deg: float,
    *,
    cut_deg: float = DEFAULT_CUT_DEG,
    centre: tuple[float, float] | None = None,
    projection: Projection = "equidistant",
    origin: str = "the beam map",
) -> BeamMap:
    """Return a beam map that is given as an array, shape (rows, columns); ``origin`` names it in messages.

    The other parameters, and what is refused, are those of :func:`read_map`.
    """
    if projection not in get_args(Projection):
        raise InputError(f"projection = {projection!r} is not one of {', '.join(get_args(Projection))}")
    if image.ndim != 2:
        raise InputError(f"{origin} has {image.ndim} dimensions where a beam map has 2: rows along y, columns along x")
    if not image.size:
        raise InputError(f"{origin} has shape {image.shape}, without a pixel: give a map of the peak and its wings")
    for name, value in (("pixel_deg", pixel_deg), ("cut_deg", cut_deg)):
        check_number(value, name, "degrees")
    pixel = np.radians(pixel_deg)
    if not 0 < pixel < np.radians(10):
        raise InputError(f"the pixel of a beam map, {np.degrees(pixel):g} deg, must lie between 0 and 10 deg")
    if not 0 < cut_deg <= 90:
        raise InputError(f"cut_deg = {cut_deg} of a beam map must be above 0 and at most 90")
    if np.radians(cut_deg) < SMALLEST_CUT_PIXELS * pixel:
        raise InputError(
            f"cut_deg = {cut_deg} is less than {SMALLEST_CUT_PIXELS} pixels of {np.degrees(pixel):g} deg: raise it"
        )
    if not np.all(np.isfinite(image)):
        raise InputError(
            f"{origin} has {np.count_nonzero(~np.isfinite(image))} values that are not finite: "
            "set pixels without data to 0"
        )
    if centre is None:
        centre = find_centre(image, origin)
    elif np.shape(centre) != (2,):
        raise InputError(f"centre = {centre!r} is no pair of numbers: give (column, row), counted from 0")
    return BeamMap(image, float(pixel), centre, float(np.radians(cut_deg)), projection)


def _check_centre(image: NDArray[np.float64], centre: tuple[float, float]) -> None:
    """Raise InputError for a centre outside the map, or one that is far from the peak until row and column change."""
    rows, columns = image.shape
    column, row = centre
    if not (0 <= column <= columns - 1 and 0 <= row <= rows - 1):
        raise InputError(
            f"centre = {tuple(centre)} lies outside the {columns} columns and {rows} rows of the map: give "
            "(column, row), counted from 0"
        )
    peak = float(image.max())
    here = image[round(row), round(column)]
    if column < rows and row < columns and here < 0.01 * peak and image[round(column), round(row)] > 0.5 * peak:
        raise InputError(
            f"centre = {tuple(centre)} of a beam map has less than 1 % of the peak, and {(row, column)} more than "
            "half of it: give (column, row), in this order"
        )


def find_centre(image: NDArray[np.float64], origin: str = "the beam map") -> tuple[float, float]:
    """Return the intensity centroid around the peak as (column, row).

    The centroid is over the 15 x 15 pixels less than 8 pixels from the peak in row and column: the choice that the
    reference spectra of the WMAP-7 beam maps were made with (one more pixel on each side moves the binned A^{20}_ll of
    W1 by up to 1.8 of 477 uK^2, and that of V2 by 2 of 265 uK^2). A beam with wings beyond these pixels has no centre
    that all rules agree on: for the WMAP maps 0.1 pixel is at stake, which is 1 to 5 % of the even orders but all of
    b_l1. Where odd orders matter, give the centre that the pointing refers to.

    Raise InputError if nothing in the image is positive, or the peak is less than 8 pixels from an edge.
    """
    row, column = (int(i) for i in np.unravel_index(np.argmax(image), image.shape))
    if not image[row, column] > 0:
        raise InputError(f"{origin} has no positive value: it is empty, or its sign is reversed")
    reach = PEAK_BOX - 1
    if min(row, column, image.shape[0] - 1 - row, image.shape[1] - 1 - column) < reach:
        raise InputError(
            f"the peak of {origin} at row {row}, column {column} is less than {PEAK_BOX} pixels from an edge of its "
            f"{image.shape} pixels: give centre_pixel (centre) as (column, row), or a larger map"
        )
    box = image[row - reach : row + reach + 1, column - reach : column + reach + 1]
    total = box.sum()
    if not total > 0:
        raise InputError(
            f"{origin} sums to {total:.3g} around its peak, where it must be positive: give centre_pixel (centre)"
        )
    offset = np.arange(-reach, reach + 1)
    return float(column + box.sum(axis=0) @ offset / total), float(row + box.sum(axis=1) @ offset / total)


def blm_of_map(beam_map: BeamMap, lmax: int, mmax: int) -> NDArray[np.complex128]:
    """Sum a beam map into its harmonic coefficients, in the map's unit times sr.

    Return b_lm, shape (mmax + 1, lmax + 1); raise InputError if the pixels are too coarse for lmax, or nothing but
    zeros lies inside the cut.

    Notes
    -----
    b_lm = sum_p B_p dOmega_p conj(Y_lm(theta_p, phi_p)) over the pixels, each at its own direction and with the solid
    angle that the projection gives it, by a transform for arbitrary directions (relative accuracy 1e-12): every order,
    odd ones and imaginary parts included. For a beam that the pixels resolve the sum is the integral to round-off: an
    elliptical Gaussian agrees with its closed form to 1e-10 at 5 pixels per FWHM, to 2e-7 at 2.3
    (tests/unit/test_beams_beammap.py).
    """
    if lmax * beam_map.pixel_rad > pi:
        raise InputError(
            f"lmax = {lmax} is beyond what pixels of {np.degrees(beam_map.pixel_rad):g} deg resolve: "
            f"at most {int(pi / beam_map.pixel_rad)}"
        )
    value, theta, phi = solid_angle_values(beam_map)
    if not np.any(value):
        cut_deg = np.degrees(beam_map.cut_rad)
        raise InputError(f"the beam map is zero within {cut_deg:g} deg of its centre: check centre and cut")
    where = np.stack([theta, phi], axis=1)
    alm = ducc0.sht.adjoint_synthesis_general(
        map=value[None], lmax=lmax, mmax=mmax, spin=0, loc=where, epsilon=1e-12, nthreads=1
    )[0]
    return unpacked(alm, lmax, mmax)


def solid_angle_values(beam_map: BeamMap) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return response times solid angle, theta and phi of the pixels within the cut that are not zero."""
    image, pixel_rad = beam_map.image, beam_map.pixel_rad
    x = (np.arange(image.shape[1]) - beam_map.centre[0])[None, :] * pixel_rad
    y = (np.arange(image.shape[0]) - beam_map.centre[1])[:, None] * pixel_rad
    radius = np.hypot(x, y)
    radius_of_cut, theta_of, stretch = _PROJECTIONS[beam_map.projection]
    inside = (radius <= radius_of_cut(np.asarray(beam_map.cut_rad))) & (image != 0)
    phi = np.arctan2(*np.broadcast_arrays(y, x))[inside] % (2 * pi)
    radius = radius[inside]
    return image[inside] * pixel_rad**2 * stretch(radius), theta_of(radius), phi


_Function = Callable[[NDArray[np.float64]], NDArray[np.float64]]
# For each: radius of theta, theta of radius, solid angle per area of the map.
_PROJECTIONS: dict[Projection, tuple[_Function, _Function, _Function]] = {
    "equidistant": (lambda theta: theta, lambda radius: radius, lambda radius: np.sinc(radius / pi)),
    "orthographic": (np.sin, np.arcsin, lambda radius: 1 / np.sqrt(1 - radius**2)),
    "equal_area": (lambda theta: 2 * np.sin(theta / 2), lambda radius: 2 * np.arcsin(radius / 2), np.ones_like),
}


def holds_image(path: str | Path) -> bool:
    """Return True if a FITS file holds an image, as beam maps do, and not just tables; InputError for no FITS."""
    with unreadable(path, "a beam", "give a beam map or b_lm as FITS, or B_l as .txt"), opened(Path(path)) as hdus:
        return any(hdu.is_image and hdu.header.get("NAXIS", 0) >= 2 for hdu in hdus)


def _read_image(path: Path, plane: int) -> tuple[NDArray[np.float64], fits.Header]:
    if not path.is_file():
        raise InputError(f"beam map {path} does not exist: give the path of a FITS image")
    if path.suffix == ".npy":
        image, header = read_npy(path, "iuf", (2,)).astype(np.float64), fits.Header()
    else:
        with unreadable(path, "a FITS image", "give a whole one, or an array as .npy"), opened(path) as hdus:
            images = [hdu for hdu in hdus if hdu.is_image and hdu.data is not None]
            image = np.array(images[0].data, dtype=np.float64) if images else np.zeros(0)
            header = images[0].header.copy() if images else fits.Header()
    if not image.size:
        raise InputError(f"{path} holds no image: a beam map is a two-dimensional FITS image")
    if str(header.get("BUNIT", "")).strip().lower().startswith("db"):
        raise InputError(f"{path} is in {header['BUNIT']!r}: give the response itself, 10^(dB/10), not its logarithm")
    planes = image if image.ndim == 3 else image[None]
    if not 0 <= plane < len(planes):
        raise InputError(f"plane = {plane} of {path} does not exist: it has planes 0 to {len(planes) - 1}")
    image = planes[plane]
    if image.ndim != 2:
        raise InputError(f"{path} has an image of {image.ndim} dimensions where a beam map has 2, or 3 with planes")
    return image, header


def _pixel_deg(header: fits.Header, path: str | Path) -> float:
    if any(f"CDELT{axis}" not in header and f"CD{axis}_{axis}" not in header for axis in (1, 2)):
        raise InputError(f"{path} has no CDELT1 and CDELT2: give pixel_deg, the side of a pixel in degrees")
    # A matrix CD takes the place of CDELT, and a matrix PC multiplies it: astropy writes steps there, and CDELT = 1.
    step_x, step_y = (
        float(header.get(f"CD{axis}_{axis}", header.get(f"CDELT{axis}", 0.0) * header.get(f"PC{axis}_{axis}", 1.0)))
        for axis in (1, 2)
    )
    for axis in _UNITS:
        unit = str(header.get(axis, "deg")).strip().lower()
        if unit not in ("", "deg", "degree", "degrees"):
            raise InputError(f"{path} has {axis} = {unit!r} where degrees are expected: give pixel_deg")
    if not (step_x > 0 and abs(step_y - step_x) <= 1e-6 * step_x):
        raise InputError(
            f"{path} has steps of {step_x:g} and {step_y:g} deg (CDELT1, CDELT2), which must be equal and positive: "
            "resample or flip the image so that columns follow the beam's x, or give pixel_deg if they do and pixels "
            "are square"
        )
    for key in ("CROTA1", "CROTA2", "PC1_2", "PC2_1", "CD1_2", "CD2_1"):
        if header.get(key):
            raise InputError(
                f"{path} has {key} = {header[key]}, but its columns must follow the beam's x: turn the image, or give "
                "pixel_deg if they do"
            )
    return step_x
