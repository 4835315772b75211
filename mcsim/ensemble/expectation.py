"""Mean BipoSH of a survey's maps: of their signal, of their circular-beam control, and of their noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from healpy import nside2pixarea
from numpy.typing import NDArray

from mcsim import config
from mcsim.bipolar.modes import Indices, existing
from mcsim.bipolar.theory import (
    ScannedBeam,
    cmb_biposh_exact,
    cmb_biposh_leading,
    noise_biposh,
    orientation_harmonics,
    parallel_transport_harmonics,
)
from mcsim.bipolar.theory.harmonics import spin_functions
from mcsim.errors import InputError
from mcsim.simulation import survey as survey_
from mcsim.simulation.survey import Channel, Survey, SurveyMap
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix

Source = str | Path | Mapping[str, Any] | config.RunConfig | Survey

L_MOMENTS = 64  #: highest degree of the orientation moments in predictions to all orders in the beam


@dataclass(frozen=True)
class Means:
    """Means of an ordered pair of maps, uK^2, shape (mode, lmax + 1), NaN where one map repeats another mode.

    They are those of the signal through the beams and through their circular parts, and of the noise.
    """

    beam: NDArray[np.complex128]
    circular: NDArray[np.complex128]
    noise: NDArray[np.complex128]


def survey_of(source: Source, nthreads: int = 1) -> Survey:
    """Return the survey of a configuration in any form."""
    if isinstance(source, Survey):
        return source
    return survey_.survey(config.load(source), nthreads)


def scanned_beams(survey: Survey, L_max: int, nthreads: int = 1) -> tuple[ScannedBeam, ...]:
    """Return the beam, times the pixel window, and the moments up to degree ``L_max`` of every map."""
    for spec in survey.config.channels:
        if isinstance(spec.scan, config.ScanDifferencing):
            raise InputError(
                f"Channel {spec.name} reads two beams as a difference, which predictions do not cover; "
                "predict the same model with hit_averaged instead."
            )
    return tuple(
        ScannedBeam(
            channel.beam.blm * channel.window, _orientations(spec.scan, channel, _weighted(survey, m), L_max, nthreads)
        )
        for spec, channel in zip(survey.config.channels, survey.channels, strict=True)
        for m in channel.maps
    )


def _weighted(survey: Survey, m: SurveyMap) -> SurveyMap:
    """Return a map with the weights that its estimates are of: none if their normalisation takes them out."""
    return m if survey.filtering is None else replace(m, weight=None)


def without_windows(
    survey: Survey, spectra: NDArray[np.complex128], modes: Sequence[Indices], pair: tuple[int, int]
) -> NDArray[np.complex128]:
    """Return the coefficients of maps divided by the pixel windows at l1 and l2, as the analysis does."""
    windows = [channel.window for channel in survey.channels for _ in channel.maps]
    result = spectra.copy()
    for row, (L, _, d) in zip(result, modes, strict=True):
        l2 = np.flatnonzero(existing(L, d, survey.lmax))
        row[l2] /= windows[pair[0]][l2 - d] * windows[pair[1]][l2]
    return result


def _orientations(
    scan: config.Scan, channel: Channel, m: SurveyMap, L_max: int, nthreads: int
) -> NDArray[np.complex128]:
    smax = channel.beam.mmax
    if channel.rings is not None:
        # The moments depend on colatitude alone; the quadrature on rings is exact.
        result = np.zeros((smax + 1, L_max + 1, 2 * L_max + 1), dtype=np.complex128)
        result[0, 0, L_max] = np.sqrt(4.0 * np.pi)
        for rings in channel.rings:
            harmonics = spin_functions(rings.s, L_max, rings.theta)[rings.s]
            result[rings.s, :, L_max] = rings.phase * (harmonics @ rings.weight)
        return result
    if isinstance(scan, config.ScanParallelTransport) and m.weight is None and m.preparation is None:
        return parallel_transport_harmonics(smax, L_max, float(np.deg2rad(scan.psi0_deg)))
    w = np.asarray(m.moments.w[:smax])
    return orientation_harmonics(w if m.weight is None else w * m.weight**2, L_max, nthreads=nthreads)


def means(
    survey: Survey, beams: tuple[ScannedBeam, ...], pair: tuple[int, int], exact: bool, nthreads: int = 1
) -> Means:
    """Return the means of a pair of maps (indices) in all modes of the survey, whose beams are :func:`scanned_beams`.

    They are of leading order in the non-circular part of the beams, or of all orders if ``exact``.
    """
    cl = spectrum(survey)
    x, y = beams[pair[0]], beams[pair[1]]
    modes, lmax = survey.estimator.modes, survey.lmax
    signal = cmb_biposh_leading(modes, cl, lmax, x, y)
    circular = np.where(np.array([L for L, _, _ in modes])[:, None] == 0, signal, 0.0 * signal)
    if exact:
        signal = cmb_biposh_exact(modes, cl, lmax, x, x if pair[0] == pair[1] else y, nthreads=nthreads)
    signal, circular = (without_windows(survey, array, modes, pair) for array in (signal, circular))
    noise = np.zeros_like(signal)
    if pair[0] == pair[1]:
        noise = noise_mean(survey, pair[0], modes)
        repeated = [row for row, mode in enumerate(modes) if not mode.in_auto]
        for array in (signal, circular, noise):
            array[repeated] = np.nan
    return Means(signal, circular, noise)


def spectrum(survey: Survey) -> NDArray[np.float64]:
    """Return C_l of the sky; raise InputError for a survey without a spectrum."""
    if survey.cl is None:
        raise InputError(
            f"{survey.config.name} takes its skies from files and names no spectrum; add sky.spectrum for a prediction."
        )
    return survey.cl


def noise_mean(survey: Survey, number: int, modes: Sequence[Indices]) -> NDArray[np.complex128]:
    """Return the mean BipoSH of the noise of a map, uK^2, shape (mode, lmax + 1)."""
    m = _weighted(survey, survey.maps[number])
    L_max, lmax = max(L for L, _, _ in modes), survey.lmax
    if m.drawn is not None:
        raise InputError(
            f"the noise of map {m.name} is not white, and predictions are of white noise; simulate it with mcsim run, "
            'or give the channel noise of kind "white", "depth" or "variance".'
        )
    if m.noise_uk is None:
        return np.zeros((len(modes), lmax + 1), dtype=np.complex128)
    power = m.noise_uk**2 * nside2pixarea(m.moments.nside)
    alm = healpix.analysis(power if m.weight is None else power * m.weight**2, L_max, iterations=3)
    variance = np.zeros((L_max + 1, 2 * L_max + 1), dtype=np.complex128)
    for M in range(L_max + 1):
        column = alm[alm_.start(L_max, M) + M : alm_.start(L_max, M) + L_max + 1]
        variance[M:, L_max - M] = (-1) ** M * column.conj()
        variance[M:, L_max + M] = column
    return without_windows(survey, noise_biposh(modes, variance, lmax), modes, (number, number))
