"""What a beam is to the rest of the package: its harmonic coefficients, normalised and cut in m."""

from dataclasses import dataclass, replace
from math import pi
from pathlib import Path
from typing import Self

import ducc0
import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.beams.beammap import DEFAULT_CUT_DEG, BeamMap, placed, read_map
from mcsim.instrument.beams.coefficients import check_mmax, choose_mmax, cut, power_by_order
from mcsim.instrument.beams.files import checked_blm
from mcsim.instrument.beams.gaussian import check_fwhm, elliptical_blm
from mcsim.instrument.beams.window import read_window
from mcsim.sphere.checks import check_angle, check_finite, check_shape, check_whole
from mcsim.support.arrays import reals
from mcsim.support.folders import unwritable, user_path
from mcsim.support.npy import read_npz

LEAST_NORMALISED = 1e-6  #: largest departure of B_0 from 1: that of coefficients in single precision is smaller
DEFAULT_LMAX = 2048  #: largest degree of a beam where none is asked for
LARGEST_WINDOW = 2.0  #: of |B_l| over B_0: reached if negative response is a third of the positive one, or more


@dataclass(frozen=True, eq=False, repr=False)
class Beam:
    """Harmonic coefficients of a beam that points at the pole.

    Parameters
    ----------
    blm
        b_lm at ``blm[m, l]``, complex, shape (mmax + 1, lmax + 1), zero for l < m; b_l0 = sqrt((2l+1)/4pi) B_l
        with B_0 = 1.
    neglected_power
        Sum of |b_lm|^2 over |m| > mmax and l <= lmax, over the same sum for all m.
    integral
        Integral over the sphere before the normalisation to B_0 = 1, in the units of the source times sr (a beam map
        in mK: mK sr; a file of coefficients: sqrt(4pi) b_00; closed forms: 1).

    Notes
    -----
    The beam is B(n) = sum_lm b_lm Y_lm(n) in sr^-1, with b_{l,-m} = (-1)^m conj(b_lm) and the azimuth counted from the
    beam's x axis, the direction of the scan (spin axis) x (boresight), towards y; (x, y, outward) is right-handed.

    Examples
    --------
    >>> from mcsim import Beam
    >>> beam = Beam.elliptical(60.0, 50.0, lmax=300)
    >>> beam.lmax, beam.mmax
    (300, 2)
    >>> print(f"{beam.window[100]:.4f}")
    0.7909
    """

    blm: NDArray[np.complex128]
    neglected_power: float = 0.0
    integral: float = 1.0

    def __repr__(self) -> str:
        """Return the highest degree and order."""
        return f"<Beam: lmax = {self.lmax}, mmax = {self.mmax}>"

    def __post_init__(self) -> None:
        """Raise InputError unless finite coefficients stand at ``blm[m, l]``, zero for l < m."""
        blm = self.blm
        if not isinstance(blm, np.ndarray) or not np.iscomplexobj(blm) or blm.ndim != 2 or not blm.size:
            raise InputError(f"blm has shape {np.shape(blm)}, but it must be complex, (mmax + 1, lmax + 1).")
        check_mmax(self.mmax, self.lmax)
        check_finite(blm, "blm")
        if any(blm[m, :m].any() for m in range(1, len(blm))):
            raise InputError("blm has coefficients with l < m, which do not exist: give blm[m, l].")

    def check_normalised(self) -> None:
        """Raise InputError unless B_0 = 1, as of a beam that a user gives."""
        if abs(self.blm[0, 0] * np.sqrt(4 * np.pi) - 1.0) > LEAST_NORMALISED:
            raise InputError(f"the beam has b_00 = {self.blm[0, 0]:g}, not 1/sqrt(4 pi); use Beam.from_blm(blm).")

    @classmethod
    def gaussian(cls, fwhm_arcmin: float, lmax: int = DEFAULT_LMAX) -> Self:
        """Return the circular Gaussian beam B_l = exp(-l(l+1) sigma^2 / 2).

        Parameters
        ----------
        fwhm_arcmin
            Full width at half maximum in arcmin, positive, at most 1200.
        lmax
            Largest degree, >= 1.

        Raises
        ------
        InputError
            If the width or lmax is out of range.

        Examples
        --------
        >>> from mcsim import Beam
        >>> print(f"{Beam.gaussian(30.0, lmax=200).window[200]:.4f}")
        0.7588
        """
        check_fwhm(fwhm_arcmin, "fwhm_arcmin")
        return cls.elliptical(fwhm_arcmin, fwhm_arcmin, lmax=lmax, mmax=0)

    @classmethod
    def elliptical(
        cls,
        fwhm_major_arcmin: float,
        fwhm_minor_arcmin: float,
        *,
        angle_deg: float = 0.0,
        lmax: int = DEFAULT_LMAX,
        mmax: int | None = None,
    ) -> Self:
        """Return an elliptical Gaussian beam.

        Parameters
        ----------
        fwhm_major_arcmin, fwhm_minor_arcmin
            Full widths at half maximum along the axes in arcmin, major >= minor > 0, at most 1200.
        angle_deg
            Direction of the major axis, in degrees from the beam's x axis towards y; b_l2 is positive at 0.
        lmax
            Largest degree, >= 1.
        mmax
            Largest order; ``None`` chooses it (:func:`mcsim.instrument.beams.choose_mmax`). Odd orders vanish.

        Raises
        ------
        InputError
            If a width, the angle, lmax or mmax is out of range.

        Notes
        -----
        Formula and accuracy: :func:`mcsim.instrument.beams.gaussian.elliptical_blm`.

        Examples
        --------
        >>> from mcsim import Beam
        >>> beam = Beam.elliptical(13.9, 12.7, angle_deg=30.0, lmax=1024)
        >>> print(f"{abs(beam.blm[2, 600] / beam.blm[0, 600]):.3f}")
        0.022
        """
        blm = elliptical_blm(fwhm_major_arcmin, fwhm_minor_arcmin, angle_deg, lmax, mmax)
        whole = cls.normalized(blm, mmax, f"an elliptical Gaussian of {fwhm_major_arcmin} x {fwhm_minor_arcmin} arcmin")
        return cls(whole.blm, whole.neglected_power)

    @classmethod
    def from_map(
        cls,
        source: NDArray | BeamMap | str | Path,
        lmax: int | None = None,
        mmax: int | None = None,
        *,
        pixel_deg: float | None = None,
        cut_deg: float = DEFAULT_CUT_DEG,
        centre: tuple[float, float] | None = None,
    ) -> Self:
        """Return the beam of a two-dimensional map, exact on the curved sky.

        Parameters
        ----------
        source
            Response at the pixel centres in any unit, shape (rows, columns), column = beam x (in-scan), row = beam y;
            or the FITS file of one; or what :func:`mcsim.instrument.beams.read_map` made of a file with several planes
            or another projection (pixel_deg, cut_deg and centre are then in it).
        lmax
            Largest degree; ``None``: 2048, or what the pixels resolve if that is less.
        mmax
            Largest order; ``None`` chooses it (:func:`mcsim.instrument.beams.choose_mmax`).
        pixel_deg
            Side of a pixel in degrees; needed for an array, ``None`` takes a file's from its header.
        cut_deg
            Angle from the centre beyond which the map is not used, degrees.
        centre
            Column and row of the beam's centre, from 0; ``None`` takes the intensity centroid about the peak.

        Raises
        ------
        InputError
            If the file, the pixel size, the cut, the centre or the image cannot be used.

        Examples
        --------
        >>> import numpy as np
        >>> from mcsim import Beam
        >>> y, x = np.mgrid[-30:31, -30:31] * 0.1
        >>> image = np.exp(-(x**2) / 2 / 0.5**2 - y**2 / 2 / 0.4**2)
        >>> beam = Beam.from_map(image, 200, pixel_deg=0.1)
        >>> print(f"{abs(beam.blm[2, 100] / beam.blm[0, 100]):.4f}")
        0.0346
        """
        if isinstance(source, BeamMap):
            beam_map = source
        elif isinstance(source, str | Path):
            beam_map = read_map(source, pixel_deg=pixel_deg, cut_deg=cut_deg, centre=centre)
        elif pixel_deg is None:
            raise InputError("pixel_deg is not given, but an array does not say it; give the side of a pixel in deg")
        else:
            if tuple(getattr(source, "dims", ())) == ("x", "y"):
                raise InputError("the beam map has the dimensions (x, y), but its rows are y; transpose it")
            image = reals(source, "the beam map")
            beam_map = placed(image, pixel_deg, cut_deg=cut_deg, centre=centre)
        lmax = min(DEFAULT_LMAX, int(pi / beam_map.pixel_rad)) if lmax is None else lmax
        return cls.normalized(beam_map.blm(lmax, mmax), mmax, "the beam map")

    @classmethod
    def from_blm(cls, source: NDArray | str | Path, lmax: int | None = None, mmax: int | None = None) -> Self:
        """Return the beam of given coefficients.

        Parameters
        ----------
        source
            b_lm in healpy's m-major order with every m up to lmax, or [m, l] of shape (mmax + 1, lmax + 1); or a FITS
            file as healpy reads it, whose first table is the temperature beam. The beam points at the pole. Or what
            :meth:`save` wrote, which is taken as it is.
        lmax
            Largest degree, no more than the source's; ``None``: the source's.
        mmax
            Largest order, no more than the source's; ``None`` chooses it
            (:func:`mcsim.instrument.beams.choose_mmax`).

        Returns
        -------
        Beam
            Normalised to B_0 = 1; its ``integral`` says by how much: sqrt(4pi) b_00 of the source.

        Raises
        ------
        InputError
            If the source cannot be read, stops before lmax or mmax, has a complex b_l0, an integral that is not
            positive, or is not pointed at the pole.

        Notes
        -----
        Coefficients are those of B = sum b_lm Y_lm, b_lm = int B conj(Y_lm), with the Condon-Shortley phase, as optics
        codes in the Planck pipelines write them. In that convention b_00 of a beam that is normalised to 1 is
        1/sqrt(4pi), or half of it for one polarisation; either is divided out. Coefficients cannot show whether their
        azimuth starts at the scan direction: multiply by exp(-i m angle) before use if it does not.

        Examples
        --------
        >>> import healpy
        >>> from mcsim import Beam
        >>> blm = healpy.blm_gauss(0.02, lmax=100)
        >>> Beam.from_blm(blm).mmax
        0
        """
        if isinstance(source, str | Path) and Path(source).suffix == ".npz":
            return cls._saved(source, lmax, mmax)
        blm, origin = checked_blm(source, lmax)
        return cls.normalized(blm, mmax, origin)

    @classmethod
    def from_window(
        cls,
        source: NDArray | str | Path,
        lmax: int | None = None,
        *,
        extension: str | None = None,
        column: str | None = None,
    ) -> Self:
        """Return the circular beam of a window B_l.

        Parameters
        ----------
        source
            B_l from l = 0; or a file of them: text with B_l, or with ell, B_l and more (WMAP's ampl_bl tables), a FITS
            table (Planck's instrument models, beam windows and CMB maps), or .npy.
        lmax
            Largest degree, no more than the source's; ``None``: the source's.
        extension, column
            Name of the FITS table (its number, from 0, where it has none of its own), and of its column; ``None``:
            the only ones that can be B_l.

        Returns
        -------
        Beam
            Normalised to B_0 = 1; its ``integral`` is B_0 of the source.

        Raises
        ------
        InputError
            If the source cannot be read, stops before lmax, does not start at 1, exceeds it, or leaves a choice.

        Examples
        --------
        >>> import numpy as np
        >>> from mcsim import Beam
        >>> ell = np.arange(101)
        >>> beam = Beam.from_window(np.exp(-0.5 * ell * (ell + 1) * 0.01**2))
        >>> beam.mmax, f"{beam.window[100]:.3f}"
        (0, '0.604')
        """
        window = read_window(source, lmax, extension, column)
        blm = np.sqrt((2 * np.arange(window.size) + 1) / (4 * np.pi)) * window
        return cls.normalized(blm[None].astype(np.complex128), 0, "the window B_l")

    @classmethod
    def _saved(cls, path: str | Path, lmax: int | None, mmax: int | None) -> Self:
        arrays = read_npz(user_path(path))
        try:
            beam = cls(arrays["blm"], float(arrays["neglected_power"]), float(arrays["integral"]))
        except (KeyError, TypeError) as error:
            raise InputError(f"{path} holds no beam ({error}): write it with Beam.save") from None
        if beam.mmax < (mmax or 0):
            raise InputError(f"{path} stops at mmax = {beam.mmax}, below the mmax = {mmax} asked for: lower mmax")
        try:
            beam.check_normalised()
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        beam = replace(beam, blm=cut(beam.blm, lmax, str(path)).copy())
        return beam if mmax is None else beam.truncated(mmax)

    def save(self, path: str | Path) -> None:
        """Write the beam as a .npz file, from which :meth:`from_blm` reads the same beam, bit for bit."""
        if Path(path).suffix != ".npz":
            raise InputError(f"{path} does not end in .npz, by which the beam is read again; give such a name.")
        with unwritable(path, "choose another file"):
            np.savez(user_path(path), blm=self.blm, neglected_power=self.neglected_power, integral=self.integral)

    def as_table(self, folder: Path) -> dict[str, str]:
        """Write the beam into a folder; return the table that stands for it in a run."""
        self.check_normalised()
        self.save(folder / "beam.npz")
        return {"kind": "blm", "path": "beam.npz"}

    @classmethod
    def normalized(cls, blm: NDArray[np.complex128], mmax: int | None, origin: str) -> Self:
        """Return a beam with B_0 = 1 from coefficients in any unit.

        ``blm`` has the shape (>= mmax + 1, lmax + 1), to the largest order that is known; ``mmax`` is the order to cut
        at (None: that of :func:`choose_mmax`), ``origin`` says in messages what they are of. Raise InputError if a
        coefficient is not finite, the integral of the beam is not positive or so small that some B_l is above
        ``LARGEST_WINDOW``, or it has no order ``mmax``.
        """
        if not np.all(np.isfinite(blm)):
            raise InputError(f"{origin} has coefficients that are not finite: repair it before use")
        integral = float(blm[0, 0].real * np.sqrt(4 * np.pi))
        if integral <= 0:
            raise InputError(f"{origin} integrates to {integral:.3g} over the sphere where a beam must be positive")
        if mmax is not None:
            check_mmax(mmax, blm.shape[1] - 1)
            if mmax >= len(blm):
                raise InputError(f"mmax = {mmax} exceeds the largest order {len(blm) - 1} of {origin}: lower mmax")
        whole = cls(blm / integral, integral=integral)
        degree = int(np.argmax(np.abs(whole.window)))
        if abs(whole.window[degree]) > LARGEST_WINDOW:
            raise InputError(
                f"{origin} has B_l = {whole.window[degree]:.3g} B_0 at l = {degree}, where at most {LARGEST_WINDOW:g} "
                "can be a beam's: its negative response nearly cancels the positive one; take off no mean"
            )
        return whole.truncated(choose_mmax(blm) if mmax is None else mmax)

    @property
    def lmax(self) -> int:
        """Return the largest degree."""
        return int(self.blm.shape[1]) - 1

    @property
    def mmax(self) -> int:
        """Return the largest order."""
        return int(self.blm.shape[0]) - 1

    @property
    def window(self) -> NDArray[np.float64]:
        """Return the window B_l of the circular part, shape (lmax + 1,)."""
        return np.asarray(self.blm[0].real * np.sqrt(4 * np.pi / (2 * np.arange(self.lmax + 1) + 1)))

    def truncated(self, mmax: int) -> Self:
        """Return the beam without its orders above ``mmax``; what it loses is added to ``neglected_power``."""
        check_mmax(mmax, self.lmax)
        if mmax >= self.mmax:
            return self
        power = power_by_order(self.blm)
        lost = (1 - self.neglected_power) * power[mmax + 1 :].sum() / power.sum()
        return replace(self, blm=self.blm[: mmax + 1].copy(), neglected_power=float(self.neglected_power + lost))

    def circular(self) -> Self:
        """Return the m = 0 part."""
        return self.truncated(0)

    def packed(self) -> NDArray[np.complex128]:
        """Return the coefficients in healpy's m-major order, m up to mmax only."""
        return np.concatenate([self.blm[m, m:] for m in range(self.mmax + 1)])

    def rotated(self, angle: float) -> Self:
        """Return the beam turned about its own axis by ``angle`` radians, from x towards y: e^{-i m angle} b_lm."""
        check_angle(angle, "the angle of a beam")
        if angle == 0.0:
            return self
        return replace(self, blm=np.exp(-1j * angle * np.arange(self.mmax + 1))[:, None] * self.blm)

    def mirrored(self) -> Self:
        """Return the beam of an instrument's other side, a mirror image in a plane through the spin axis.

        Notes
        -----
        A mirror plane through the spin axis s sends side A's boresight n to side B's, and s to itself. A cross product
        changes sign in a mirror: x_A = s x n_A goes to -x_B, and y_A, which points towards s, to y_B. So side B is side
        A with x -> -x in the beam's own frame, B'(theta, phi) = B(theta, pi - phi), and b_lm becomes (-1)^m conj(b_lm):
        what leads in the scan on one side trails on the other. WMAP is built so: the azimuths of its horns about the
        spin axis are a on side A and 180 deg - a on side B to 0.2 deg (scan_models/wmap_focal_plane.toml), where a half
        turn about the spin axis would have made them a and 180 deg + a.
        """
        return replace(self, blm=(-1.0) ** np.arange(self.mmax + 1)[:, None] * self.blm.conj())

    def on_rings(self, rings: int, columns: int, geometry: str) -> NDArray[np.float64]:
        """Return the values in sr^-1 on the rings of one of ducc0's geometries, shape (rings, columns)."""
        shape = {"lmax": self.lmax, "mmax": self.mmax, "ntheta": rings, "nphi": columns, "geometry": geometry}
        return np.asarray(ducc0.sht.synthesis_2d(alm=self.packed()[None], spin=0, nthreads=1, **shape))[0]

    def values(self, theta: NDArray[np.float64], phi: NDArray[np.float64], nthreads: int = 1) -> NDArray[np.float64]:
        """Return the beam in sr^-1, as far as its lmax and mmax resolve it, in the shape of ``theta``.

        ``theta``, ``phi``: angle from the beam's centre and azimuth from its x axis towards y, radians, of one shape.
        """
        theta, phi = reals(theta, "theta"), reals(phi, "phi")
        check_shape(phi, theta.shape, "phi")
        check_finite(theta, "theta")
        check_finite(phi, "phi")
        check_whole(nthreads, "nthreads")
        if np.any((theta < 0.0) | (theta > np.pi)):
            raise InputError("theta must lie between 0 and pi radians: give the angle from the centre of the beam.")
        direction = np.stack([np.ravel(theta), np.ravel(phi) % (2 * np.pi)], axis=1)
        values = ducc0.sht.synthesis_general(
            alm=self.packed()[None],
            lmax=self.lmax,
            mmax=self.mmax,
            spin=0,
            loc=direction,
            epsilon=1e-12,
            nthreads=nthreads,
        )
        return np.asarray(values[0].reshape(np.shape(theta)))
