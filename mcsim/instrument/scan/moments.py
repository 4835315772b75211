"""Orientation moments of a survey: what a pixel's map value needs to know about the scan."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import healpy
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mcsim.errors import InputError
from mcsim.instrument.scan.accumulate import stream_sums
from mcsim.instrument.scan.geometry import MapGrid, check_frame
from mcsim.instrument.scan.limit import limit_moments
from mcsim.instrument.scan.model import NUMBERS, ScanModel
from mcsim.instrument.scan.offsets import HIGHEST, exponents, order_of, spin_moment
from mcsim.instrument.scan.user_pointing import blocks_of_files, checked_samples, sums_of_samples
from mcsim.sphere.checks import check_finite, check_nside, check_number, check_shape, check_whole
from mcsim.support import folders
from mcsim.support.arrays import divided, reals
from mcsim.support.code import package_digest
from mcsim.support.npy import write_npy

_META = "moments.json"
_ARRAYS = ("hits", "w", "dtheta", "dphi", "offset_moments")
_PIXELS = 1 << 18  #: whose centroids are computed at once, to save memory


@dataclass(frozen=True, repr=False)
class Moments:
    """Hits, orientation moments and centroids of every pixel, in RING order.

    Parameters
    ----------
    nside, frame
        HEALPix resolution, and "ecliptic", "galactic" or "equatorial".
    hits
        Number of samples, shape (npix,).
    w
        w[s - 1] = mean of e^{-i s psi} over the pixel's samples, shape (smax, npix); 0 where nothing was observed.
    dtheta, dphi
        Mean offset of the samples from the pixel's centre along e_theta and e_phi, in radians (components of the
        mean direction in the tangent plane at the centre), shape (npix,); None if zero or unknown.
    offset_moments
        Mean products dtheta^a dphi^b of the samples' own offsets: (a, b) = (2, 0), (1, 1), (0, 2), then (3, 0), (2, 1)
        and so on, in rad^(a + b). Shape (3, npix), (7, npix) or (12, npix), up to degree 2, 3 or 4; None if unknown.

    Examples
    --------
    >>> from mcsim import Moments
    >>> moments = Moments.parallel_transport(nside=16, psi0_deg=30.0)
    >>> moments.nside, moments.smax, moments.npix
    (16, 4, 3072)
    """

    nside: int
    frame: str
    hits: NDArray[np.float64]
    w: NDArray[np.complex128]
    dtheta: NDArray[np.float64] | None = None
    dphi: NDArray[np.float64] | None = None
    offset_moments: NDArray[np.float64] | None = None

    def __repr__(self) -> str:
        """Return resolution, frame and what is known, in a line; not the arrays."""
        return f"<Moments: nside = {self.nside}, {self.frame} frame, smax = {self.smax}, {self.hits.sum():.6g} hits>"

    def __post_init__(self) -> None:
        """Raise InputError unless frame, nside and the sizes of the arrays agree."""
        check_nside(self.nside)
        check_frame(self.frame)
        npix = 12 * self.nside**2
        check_shape(self.hits, (npix,), f"hits of moments of nside {self.nside}")
        check_shape(self.w, (max(np.shape(self.w)[:1], default=0), npix), f"w of moments of nside {self.nside}")
        if not np.iscomplexobj(self.w):
            raise InputError("w is real, but moments are complex, the means of e^(-i s psi).")
        if (self.dtheta is None) != (self.dphi is None):
            raise InputError("dtheta and dphi belong together; give both or neither.")
        for name, offset in (("dtheta", self.dtheta), ("dphi", self.dphi)):
            if offset is not None:
                check_shape(offset, (npix,), f"{name} of moments of nside {self.nside}")
        if self.offset_moments is not None:
            if self.dtheta is None:
                raise InputError("offset_moments are given without dtheta and dphi; give these as well.")
            rows = len(exponents(order_of(len(self.offset_moments)) or HIGHEST))
            check_shape(self.offset_moments, (rows, npix), f"offset_moments of nside {self.nside}")

    def _arrays(self) -> dict[str, NDArray]:
        """Return the arrays that there are, by name."""
        return {name: value for name in _ARRAYS if (value := getattr(self, name)) is not None}

    @classmethod
    def from_model(
        cls,
        model: ScanModel | str | Path,
        nside: int,
        smax: int = 4,
        frame: str = "ecliptic",
        time_range: tuple[float, float] = (0.0, 1.0),
        nthreads: int = 1,
    ) -> Self:
        """Return the moments of a survey, by streaming every sample of its default lines of sight.

        Parameters
        ----------
        model
            The survey, or what :meth:`ScanModel.load` reads one from. ``model.with_sampling`` and
            ``model.with_lines_of_sight`` choose its samples.
        nside, smax
            HEALPix resolution, and largest s of the moments (>= 1): at least the mmax of the beam.
        frame
            Frame of the pixels: "ecliptic", "galactic" or "equatorial".
        time_range
            Part of the survey, as fractions of its samples: (0, 0.5) is the first half.
        nthreads
            Number of threads. The result does not depend on it, bit for bit; the memory does: one accumulator of
            8 (4 + 2 smax) bytes per pixel for each thread and one for the sum.

        Raises
        ------
        InputError
            If nside is not a power of two, smax < 1, the frame is unknown, or the time range is empty.

        Examples
        --------
        >>> import numpy as np
        >>> from mcsim import Moments, ScanModel
        >>> moments = Moments.from_model(ScanModel.load("wmap").with_sampling(60.0), nside=8)
        >>> moments.w.shape
        (4, 768)
        >>> print(f"{np.mean(moments.w[1].real):.2f}")
        0.55
        """
        return cls.on_grid(model, MapGrid(nside, frame, time_range), smax, nthreads)

    @classmethod
    def on_grid(cls, model: ScanModel | str | Path, grid: MapGrid, smax: int = 4, nthreads: int = 1) -> Self:
        """Return the moments of a survey on a grid, with those of its samples' offsets up to ``grid.offset_order``.

        The rest is as in :meth:`from_model`.

        Examples
        --------
        >>> from mcsim import Moments, ScanModel
        >>> from mcsim.instrument.scan import MapGrid
        >>> model = ScanModel.load("wmap").with_sampling(60.0)
        >>> moments = Moments.on_grid(model, MapGrid(8, offset_order=2))
        >>> moments.offset_order, moments.offset_moments.shape
        (2, (3, 768))
        """
        survey = model if isinstance(model, ScanModel) else ScanModel.load(model)
        return cls._from_sums(stream_sums(survey, grid, smax, nthreads), grid)

    @classmethod
    def from_pointing(
        cls, theta: ArrayLike, phi: ArrayLike, psi: ArrayLike, nside: int, smax: int = 4, frame: str = "ecliptic"
    ) -> Self:
        """Return the moments of samples that are given one by one.

        Parameters
        ----------
        theta, phi
            Colatitude (0 to pi) and longitude of the samples in ``frame``, in radians, shape (n,).
        psi
            Angle of the beam's x axis from e_theta (south) towards e_phi (east), in radians, shape (n,).
        nside, smax
            HEALPix resolution, and largest s (>= 1).
        frame
            Frame of the pointing and of the maps.

        Raises
        ------
        InputError
            If the arrays are of different shape or empty, a value is not finite, theta lies outside 0 to pi, or phi or
            psi beyond two turns.

        Examples
        --------
        >>> import numpy as np
        >>> from mcsim import Moments
        >>> moments = Moments.from_pointing([1.0, 1.0], [2.0, 2.0], [0.0, np.pi / 2], nside=4)
        >>> seen = moments.hits > 0
        >>> moments.hits[seen], np.abs(moments.w[1, seen]).round(12)
        (array([2.]), array([0.]))
        """
        check_frame(frame)
        given = {"theta": theta, "phi": phi, "psi": psi}
        arrays = [np.atleast_1d(reals(angle, name)) for name, angle in given.items()]
        if [array.size for array in arrays] == [0, 0, 0]:
            raise InputError("theta, phi and psi hold no sample; give one at least.")
        if len(set(shapes := [array.shape for array in arrays])) > 1 or arrays[0].ndim != 1:
            raise InputError(f"theta, phi and psi have the shapes {shapes}; give three arrays of one length, (n,).")
        samples = checked_samples(arrays, "the pointing")
        return cls._from_sums(sums_of_samples([samples], nside, smax), MapGrid(nside, frame))

    @classmethod
    def from_pointing_files(
        cls,
        paths: str | Path | Sequence[str | Path],
        nside: int,
        smax: int = 4,
        frame: str = "ecliptic",
        offset_order: int = 1,
    ) -> Self:
        """Return the moments of samples that are given one by one in files.

        Parameters
        ----------
        paths
            One file or several, added up. Columns theta, phi, psi in radians (FITS: in the unit that TUNIT states, if
            it does), in the frame of the maps, and optionally time, which the moments do not need: a FITS binary table
            or a .npz file with these names, a .npy file (structured with these names, or of shape (n, 3) or (n, 4)), or
            text of 3 or 4 columns.
        nside, smax, frame
            As in :meth:`from_pointing`.
        offset_order
            Highest degree of the moments of the samples' offsets, 1 to 4.

        Raises
        ------
        InputError
            If a file cannot be read, lacks a column, has columns of several lengths or in another order, is in
            another frame, is empty, or has a value that is not real and finite, a theta outside 0 to pi, or a phi or
            psi beyond two turns.
        """
        grid = MapGrid(nside, frame, offset_order=offset_order)
        return cls._from_sums(sums_of_samples(blocks_of_files(paths, frame), nside, smax, offset_order), grid)

    @classmethod
    def _from_sums(cls, sums: NDArray[np.float64], grid: MapGrid) -> Self:
        """Return the moments of an accumulator of :func:`mcsim.instrument.scan.accumulate.pixel_sums`."""
        nside, powers = grid.nside, len(exponents(grid.offset_order))
        first_power = sums.shape[1] - powers
        smax = first_power // 2 - 2
        hits = sums[:, 0].copy()
        inverse = divided(1.0, hits)
        w = np.empty((smax, hits.size), dtype=np.complex128)
        for s in range(smax):
            w[s].real = sums[:, 4 + 2 * s] * inverse
            w[s].imag = sums[:, 5 + 2 * s] * inverse
        dtheta, dphi = np.empty_like(hits), np.empty_like(hits)
        for first in range(0, hits.size, _PIXELS):
            part = slice(first, min(first + _PIXELS, hits.size))
            theta, phi = healpy.pix2ang(nside, np.arange(part.start, part.stop))
            x, y, z = (sums[part, axis] * inverse[part] for axis in (1, 2, 3))
            dtheta[part] = np.cos(theta) * (x * np.cos(phi) + y * np.sin(phi)) - np.sin(theta) * z
            dphi[part] = y * np.cos(phi) - x * np.sin(phi)
        more = np.ascontiguousarray(sums[:, first_power:].T) * inverse if powers else None
        return cls(nside, grid.frame, hits, w, dtheta, dphi, more)

    @classmethod
    def parallel_transport(cls, nside: int, psi0_deg: float = 0.0, smax: int = 4, frame: str = "ecliptic") -> Self:
        """Return the moments of a survey that sees every pixel's centre once, at a fixed angle to the meridian.

        Parameters
        ----------
        nside
            HEALPix resolution.
        psi0_deg
            Angle of the beam's x axis from e_theta (south) towards e_phi (east), in degrees.
        smax
            Largest s (>= 1).
        frame
            "ecliptic", "galactic" or "equatorial".

        Returns
        -------
        Moments
            Read-only arrays that take no memory: hits 1, w_s = e^{-i s psi0}, no offsets.

        Raises
        ------
        InputError
            If nside is not a power of two, smax < 1, or the frame is unknown.

        Examples
        --------
        >>> from mcsim import Moments
        >>> Moments.parallel_transport(nside=4, psi0_deg=90.0, smax=2).w[:, 0].round(12)
        array([ 0.-1.j, -1.-0.j])
        """
        check_nside(nside)
        check_frame(frame)
        check_whole(smax, "smax", 1)
        check_number(psi0_deg, "psi0_deg", "degrees")
        check_finite(np.asarray(psi0_deg), "psi0_deg")
        npix = 12 * nside * nside
        w = np.exp(-1j * np.deg2rad(psi0_deg) * np.arange(1, smax + 1))[:, np.newaxis]
        return cls(nside, frame, np.broadcast_to(np.float64(1.0), npix), np.broadcast_to(w, (smax, npix)))

    @classmethod
    def limit(cls, model: ScanModel | str | Path, nside: int, smax: int = 4, line_of_sight: str | None = None) -> Self:
        """Return the exact long-time limit of a scan at the pixels' centres, in ecliptic coordinates.

        Parameters
        ----------
        model
            The survey, or what :meth:`ScanModel.load` reads one from.
        nside, smax
            HEALPix resolution, and largest s (>= 1).
        line_of_sight
            Name of the line of sight; None: the first of the model's default ones.

        Returns
        -------
        Moments
            Hits are 1 on the mean. Formula and accuracy: :func:`mcsim.instrument.scan.limit_moments`.

        Raises
        ------
        InputError
            If the precession is not much faster than the orbit, or the line of sight is unknown.

        Examples
        --------
        >>> import numpy as np
        >>> from mcsim import Moments
        >>> print(f"{np.mean(Moments.limit('wmap', nside=32).w[1].real):.2f}")
        0.55
        """
        check_nside(nside)
        survey = model if isinstance(model, ScanModel) else ScanModel.load(model)
        if line_of_sight is not None:
            survey = survey.with_lines_of_sight(line_of_sight)
        theta, _ = healpy.pix2ang(nside, np.arange(12 * nside * nside))
        rings, ring = np.unique(theta, return_inverse=True)
        density, w = limit_moments(survey, rings, smax)
        return cls(nside, "ecliptic", density[ring] / density[ring].mean(), w[:, ring])

    @property
    def smax(self) -> int:
        """Largest s."""
        return int(self.w.shape[0])

    @property
    def npix(self) -> int:
        """Number of pixels."""
        return int(self.hits.shape[0])

    @property
    def offset_order(self) -> int:
        """Highest degree of the moments of the samples' offsets that are known; 0: none."""
        if self.offset_moments is not None:
            return order_of(len(self.offset_moments)) or 0
        return 0 if self.dtheta is None else 1

    def up_to_offsets(self, order: int) -> Self:
        """Return the moments with those of the offsets up to a degree, and no higher ones; 0: none."""
        if order == 0:
            return replace(self, dtheta=None, dphi=None, offset_moments=None)
        if self.offset_moments is None or self.offset_order <= order:
            return self
        return replace(self, offset_moments=self.offset_moments[: len(exponents(order))] if order > 1 else None)

    def shrunk(self, factor: float) -> Self:
        """Return the moments with all offsets multiplied by a factor."""
        if self.dtheta is None or self.dphi is None:
            return self
        more = self.offset_moments
        if more is not None:
            more = np.array([factor ** (a + b) for a, b in exponents(self.offset_order)])[:, None] * more
        return replace(self, dtheta=factor * self.dtheta, dphi=factor * self.dphi, offset_moments=more)

    def spin_of_offsets(self, degree: int, spin: int) -> NDArray:
        """Return <rho^(n - s) (dtheta + i dphi)^s> for degree n and spin s, shape (npix,); real at spin 0."""
        if self.offset_order < degree or self.dtheta is None or self.dphi is None:
            raise InputError(f"the moments have offsets up to order {self.offset_order}, below {degree}; stream them.")
        if self.offset_moments is None or degree == 1:
            return spin_moment(np.stack([self.dtheta, self.dphi]), spin)
        first = len(exponents(degree - 1))
        return spin_moment(self.offset_moments[first : first + degree + 1], spin)

    def as_table(self, folder: Path) -> dict[str, str]:
        """Write the moments into a folder; return the table that stands for them in a run."""
        arrays: dict[str, Any] = self._arrays()
        np.savez(folder / "moments.npz", nside=self.nside, frame=self.frame, **arrays)
        return {"kind": "moments", "path": "moments.npz"}

    def save(self, folder: str | Path) -> None:
        """Write the arrays as .npy files into ``folder``, which is created; they take the place of moments in it."""
        with folders.unwritable(folder := folders.user_path(folder), "choose another, in MCSIM_CACHE for the cache"):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / _META).unlink(missing_ok=True)  # without it the folder holds none, until all is written
            for name, array in self._arrays().items():
                write_npy(folder / f"{name}.npy", array)
            meta = {"nside": self.nside, "frame": self.frame, "offsets": self.offset_order}
            (folder / _META).write_text(json.dumps(meta))

    @classmethod
    def load(cls, folder: str | Path, mmap: bool = True) -> Self:
        """Read what :meth:`save` wrote.

        Parameters
        ----------
        folder
            The folder.
        mmap
            Map the files into memory, read-only and shared by all processes that do so, instead of copying them.

        Raises
        ------
        InputError
            If the folder does not hold complete moments.
        """
        folder = folders.user_path(folder)
        mode: Any = "r" if mmap else None
        try:
            meta = json.loads((folder / _META).read_text())
            names = _ARRAYS[: (2, 4, 5)[min(meta["offsets"], 2)]]
            # As plain arrays: those of numpy's own class for mapped files are slow to slice.
            arrays = {name: np.asarray(np.load(folder / f"{name}.npy", mmap_mode=mode)) for name in names}
            return cls(nside=meta["nside"], frame=meta["frame"], **arrays)
        except (OSError, EOFError, ValueError, KeyError) as error:
            raise InputError(
                f"folder {str(folder)!r} does not hold complete moments ({error}); delete it and compute them again."
            ) from None


def scan_key(model: ScanModel, grid: MapGrid, smax: int = 0) -> str:
    """Return the SHA-256 of all code and all numbers that the samples of a model's default lines of sight depend on.

    Names and citations are left out. ``smax``: largest s of what is computed from them.
    """
    lines = [[line.boresight_angle_deg, line.azimuth_deg, model.period_of_samples(line)] for line in model.select()]
    everything = [
        package_digest(["mcsim.instrument.scan"], ["healpy", "numpy"]),
        {name: float(getattr(model, name)) for name in NUMBERS},
        lines,
        [grid.nside, grid.frame, *(float(edge) for edge in grid.time_range), grid.offset_order],
        smax,
    ]
    return hashlib.sha256(json.dumps(everything, sort_keys=True).encode()).hexdigest()


def cached_moments(
    model: ScanModel, grid: MapGrid, smax: int, nthreads: int = 1, progress: Callable[[float], None] | None = None
) -> Path:
    """Return the folder, for :meth:`Moments.load`, with the moments of a survey's default lines of sight.

    They are streamed (:func:`mcsim.instrument.scan.accumulate.stream_sums`) if they are not in the cache yet. The
    folder appears whole or not; InputError if it cannot be written.
    """

    def fill(folder: Path) -> None:
        Moments._from_sums(stream_sums(model, grid, smax, nthreads, progress), grid).save(folder)

    return folders.cached(f"moments-{scan_key(model, grid, smax)}", fill)
