"""One realization: sky -> beams under the scan -> maps -> a_lm -> BipoSH and power spectra."""

from dataclasses import dataclass
from pathlib import Path

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim import alm as alm_
from mcsim import biposh, config, convolve, differencing, healpix, rings, rng, tod
from mcsim.errors import InputError
from mcsim.sky import gaussian_alm
from mcsim.survey import Channel, Survey, SurveyMap

Alm = NDArray[np.complex128]


@dataclass(frozen=True)
class Observed:
    """What one map of a realization gives: its a_lm, those of its circular twin, and the map itself where asked for."""

    alm: Alm
    circular: Alm | None
    map_uk: NDArray[np.float64] | None


def realize(survey: Survey, realization: int, nthreads: int = 1) -> dict[str, NDArray]:
    """Spectra of one realization.

    Parameters
    ----------
    survey
        What all realizations share.
    realization
        Index, >= 0: with the run's seed it fixes every random number.
    nthreads
        Threads of the transforms.

    Returns
    -------
    dict
        ``biposh`` (pair, mode, lmax + 1) complex and ``cl`` (pair, lmax + 1), uK^2; with pairing the same of the
        circular twin, ``biposh_circular`` and ``cl_circular``; with kept maps ``map`` (map, npix), uK.
    """
    ensemble = survey.config.ensemble
    sky = draw_sky(survey, realization)
    observed = [
        result for channel in survey.channels for result in _observe(survey, channel, sky, realization, nthreads)
    ]
    result = _spectra(survey, [o.alm for o in observed], "")
    if ensemble.paired:
        result |= _spectra(survey, [o.circular for o in observed if o.circular is not None], "_circular")
    if ensemble.keep_maps:
        result["map"] = np.stack([o.map_uk for o in observed if o.map_uk is not None])
    return result


def draw_sky(survey: Survey, realization: int) -> Alm:
    """Coefficients of the sky of one realization up to the sky's lmax, uK: drawn, or read from the user's files."""
    sky = survey.config.sky
    if sky.alm is not None:
        return _read_alm(config.sky_path(sky.alm, realization), sky.lmax)
    if sky.map is not None:
        return _read_sky_map(config.sky_path(sky.map, realization), sky.lmax, survey.config.map.frame)
    assert survey.cl is not None  # the configuration holds at least one of the three sources
    return gaussian_alm(survey.cl, rng.generator(survey.config.ensemble.seed, realization, "sky"))


def _observe(survey: Survey, channel: Channel, sky: Alm, realization: int, nthreads: int) -> list[Observed]:
    """The channel's maps of one sky; transforms that splits share are made once."""
    run = survey.config
    nside, lmax_sky = run.map.resolution, run.sky.lmax
    if channel.rings is not None:
        return [_observe_on_rings(survey, channel, channel.rings, sky, realization, nthreads)]
    if channel.side_b is not None:
        return _observe_differences(survey, channel, sky, realization, nthreads)
    seen, dipole = _seen(survey, channel, sky, realization)
    circular = convolve.circular_alm(seen, channel.response)
    spins = convolve.spin_maps(seen, channel.response, nside, nthreads)
    gained = None
    if any(m.gain is not None for m in channel.maps):
        gained = healpix.synthesis(circular[None], nside, lmax_sky, nthreads=nthreads)[0]
    if dipole is not None:
        # The survey takes it off as believed: what an effect makes of it stays.
        believed = convolve.response(channel.site.beam, lmax_sky, channel.window)
        circular = circular - convolve.circular_alm(dipole, believed)
        for s, map_uk in convolve.spin_maps(dipole, believed, nside, nthreads).items():
            spins[s] = spins[s] - map_uk if s in spins else -map_uk
    smooth = None
    if run.ensemble.keep_maps or not all(_is_exact(survey, m) for m in channel.maps):
        smooth = healpix.synthesis(circular[None], nside, lmax_sky, nthreads=nthreads)[0]
    gradient = None
    if any(m.moments.dtheta is not None for m in channel.maps):
        gradient = healpix.gradient(circular, nside, lmax_sky, nthreads)

    results = []
    for m in channel.maps:
        # What the circular twin sees beyond its beam, and what the rest of the beam adds: they are analysed apart, so
        # that the quadrature error of the twin cancels in the paired difference.
        extra = None
        if m.moments.dtheta is not None and gradient is not None:
            extra = convolve.centroid_map(gradient, m.moments)
        if m.noise_uk is not None:
            noise = m.noise_uk * rng.generator(run.ensemble.seed, realization, f"noise/{m.name}").standard_normal(
                m.noise_uk.size
            )
            extra = noise if extra is None else extra + noise
        if m.gain is not None and gained is not None:
            extra = m.gain * gained if extra is None else extra + m.gain * gained
        difference = convolve.noncircular_map(spins, m.moments) if spins else None
        if _is_exact(survey, m):
            exact = alm_.multiply(circular, 1.0 / channel.window, lmax_sky)
            twin = exact if extra is None else exact + _analyse(survey, channel, extra, None, nthreads)
        else:
            assert smooth is not None
            twin = _analyse(survey, channel, smooth if extra is None else smooth + extra, m.weight, nthreads)
        alm = twin if difference is None else twin + _analyse(survey, channel, difference, m.weight, nthreads)
        kept = None
        if run.ensemble.keep_maps and smooth is not None:
            kept = sum((part for part in (extra, difference) if part is not None), start=smooth)
            kept = np.where(m.moments.hits > 0, kept, healpy.UNSEEN)
        results.append(Observed(alm, twin if run.ensemble.paired else None, kept))
    return results


def _observe_on_rings(
    survey: Survey, channel: Channel, grid: tuple[rings.Rings, ...], sky: Alm, realization: int, nthreads: int
) -> Observed:
    """The channel's a_lm of one sky where no map is needed for them."""
    lmax_sky, lmax = survey.config.sky.lmax, survey.lmax
    seen, dipole = _seen(survey, channel, sky, realization)
    circular = convolve.circular_alm(seen, channel.response)
    difference = rings.noncircular_alm(seen, channel.response, grid, lmax, nthreads)
    if dipole is not None:
        believed = convolve.response(channel.site.beam, lmax_sky)
        circular = circular - convolve.circular_alm(dipole, believed)
        difference = difference - rings.noncircular_alm(dipole, believed, grid, lmax, nthreads)
    twin = alm_.resize(circular, lmax_sky, lmax)
    return Observed(twin + difference, twin if survey.config.ensemble.paired else None, None)


def _seen(survey: Survey, channel: Channel, sky: Alm, realization: int) -> tuple[Alm, Alm | None]:
    """The sky that the channel looks at, and the dipole in it that is taken off again; None where none shows."""
    for effect in channel.effects:

        def draw(stage: str, name: str = effect.name) -> np.random.Generator:
            return rng.generator(survey.config.ensemble.seed, realization, f"effect/{name}/{stage}")

        sky = effect.sky(sky, channel.site, draw)
    if not channel.effects or not channel.site.dipole_uk.any():
        return sky, None
    dipole = tod.dipole_alm(channel.site.dipole_uk, channel.site.lmax)
    return sky + dipole, dipole


def _observe_differences(survey: Survey, channel: Channel, sky: Alm, realization: int, nthreads: int) -> list[Observed]:
    """The channel's maps of one sky where two beams are read as a difference."""
    run = survey.config
    results = []
    seen, dipole = _seen(survey, channel, sky, realization)
    seed = run.ensemble.seed
    for m, solved in differencing.maps(channel, seen, dipole, run.map.resolution, seed, realization, nthreads):
        # The two are analysed apart like those of other scans.
        twin = _analyse(survey, channel, solved.circular, m.weight, nthreads)
        alm = twin + _analyse(survey, channel, solved.difference, m.weight, nthreads)
        kept = None
        if run.ensemble.keep_maps:
            kept = np.where(m.moments.hits > 0, solved.circular + solved.difference, healpy.UNSEEN)
        results.append(Observed(alm, twin if run.ensemble.paired else None, kept))
    return results


def _analyse(
    survey: Survey, channel: Channel, map_uk: NDArray[np.float64], weight: NDArray[np.float64] | None, nthreads: int
) -> Alm:
    """Coefficients of a weighted map, with the pixel window divided out."""
    weighted = map_uk if weight is None else weight * map_uk
    alm = healpix.analysis(weighted, survey.lmax, survey.config.biposh.iterations, nthreads)
    return alm_.multiply(alm, 1.0 / channel.window[: survey.lmax + 1], survey.lmax)


def _is_exact(survey: Survey, m: SurveyMap) -> bool:
    """Whether the twin's a_lm are known without making its map: all sky, no noise, no power beyond the analysis."""
    return m.weight is None and m.noise_uk is None and survey.config.sky.lmax == survey.lmax


def _spectra(survey: Survey, alms: list[Alm], suffix: str) -> dict[str, NDArray]:
    modes, lmax = len(survey.estimator.modes), survey.lmax
    coefficients = np.empty((len(survey.pairs), modes, lmax + 1), dtype=np.complex128)
    cl = np.empty((len(survey.pairs), lmax + 1))
    for row, ((x, y), norm) in enumerate(zip(survey.pairs, survey.pair_norm, strict=True)):
        coefficients[row] = norm * biposh.estimate(survey.estimator, alms[x], None if x == y else alms[y])
        cl[row] = norm * biposh.power_spectrum(alms[x], alms[y], lmax)
    return {f"biposh{suffix}": coefficients, f"cl{suffix}": cl}


def _read_alm(path: Path, lmax: int) -> Alm:
    try:
        alm, mmax = healpy.read_alm(path, return_mmax=True)
    except (OSError, ValueError, TypeError, KeyError, IndexError) as error:
        raise InputError(
            f"{path} cannot be read as a_lm ({error}); give a FITS file as healpy.write_alm makes it."
        ) from error
    found = healpy.Alm.getlmax(alm.size, mmax)
    if mmax != found or found < lmax:
        raise InputError(f"{path} holds a_lm up to l = {found}, m = {mmax}; the sky needs both up to {lmax}.")
    if not np.all(np.isfinite(alm)):
        raise InputError(f"{path} holds a_lm that are not finite; repair the file.")
    return alm_.resize(alm.astype(np.complex128), found, lmax)


def _read_sky_map(path: Path, lmax: int, frame: str) -> Alm:
    map_, found, unit = healpix.read_map(path)
    nside = healpy.npix2nside(map_.size)
    if nside & (nside - 1):
        raise InputError(f"{path} has nside {nside}, which is not a power of two; bring the sky to one that is.")
    if found not in (None, frame):
        raise InputError(f"{path} is in {found} coordinates, the run's maps in {frame}; rotate the sky first.")
    if not np.all(np.isfinite(map_)) or np.any(map_ == healpy.UNSEEN):
        raise InputError(f"{path} has pixels that are not finite or unseen; a sky must be complete.")
    if lmax > 3 * nside - 1:
        raise InputError(f"{path} has nside {nside}, good to l = {3 * nside - 1}; the sky's lmax {lmax} is above it.")
    return healpix.analysis(healpix.to_uk(unit, path) * map_, lmax, iterations=3)
