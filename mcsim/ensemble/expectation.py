"""Mean BipoSH of a survey's maps: of their signal, of their circular-beam control, and of their noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from healpy import nside2pixarea
from numpy.typing import NDArray

from mcsim import config, systematics
from mcsim.bipolar import by_degree
from mcsim.bipolar.modes import Indices, existing
from mcsim.bipolar.theory import (
    ScannedBeam,
    cmb_biposh_exact,
    cmb_biposh_leading,
    map_harmonics,
    noise_biposh,
    orientation_harmonics,
    parallel_transport_harmonics,
    pseudo_spectrum,
)
from mcsim.bipolar.theory.harmonics import spin_functions
from mcsim.config import preparation as declared
from mcsim.errors import InputError
from mcsim.simulation import convolve
from mcsim.simulation import survey as survey_
from mcsim.simulation.channels import refuse_unseen
from mcsim.simulation.survey import Channel, Survey, SurveyMap
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.checks import nside_of
from mcsim.support.arrays import Alm, Cl, Map, divided

Source = str | Path | Mapping[str, Any] | config.RunConfig | Survey

L_MOMENTS = 64  #: highest degree of the orientation moments in predictions to all orders in the beam

L_WEIGHTS, SHARE, SCATTERED = range(64, 193, 32), 0.99, 0.01
"""Highest degrees of moments times weights, of which the first is taken that holds a share of the weights' square, and
beyond which weights scatter at most another share of the spectrum into any degree."""

ROUNDING = 1e-14  #: of the power of a weight, or of a spectrum: what is less is an error of the analysis

FOLDED = 0.1  #: of prepared noise at the highest l: what averages fold into it from beyond the degrees of their pixels
EVEN, MOVED = 1e-6, 0.01
"""Variation of the power of noise that counts as none, and the share that a filter may move over the edge of a mask."""

NEGLIGIBLE = 1e-3  #: dipole that is left in samples, over the rms of the sky, that a prediction may not have

_LEFT_OUT = ("sky", "gain", "steady_gain", "signal", "excess")  #: hooks of effects that no prediction follows


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
    for channel in survey.channels:
        _check_covered(channel)
    return tuple(
        ScannedBeam(
            channel.beam.blm * channel.window * nearer(survey, channel),
            _orientations(spec.scan, channel, _weighted(survey, m), L_max, nthreads),
        )
        for spec, channel in zip(survey.config.channels, survey.channels, strict=True)
        for m in channel.maps
    )


def nearer(survey: Survey, channel: Channel) -> Cl:
    """Return the factor of the pixel window of samples that stand nearer to the centres, shape (lmax + 1,).

    That of a preparation, which is in the window of the channel too, is not of samples and stays.
    """
    made = next(one for one in survey.making.channels if one.name == channel.name)
    return np.asarray(made.seen_window / made.window)


def _check_covered(channel: Channel) -> None:
    """Raise InputError for an effect that changes more than the beam, its orientations and the noise."""
    refuse_unseen(channel.name, channel.effects)
    for effect in channel.effects:
        changed = [hook for hook in _LEFT_OUT if systematics.acts_through(effect, hook)]
        if effect.amplitude != 0.0 and changed:
            raise InputError(
                f"effect {effect.name} on channel {channel.name} acts on the {changed[0]}, which predictions do not "
                "cover; remove it, or simulate it with mcsim run."
            )


def dipoles_left(survey: Survey) -> dict[str, float]:
    """Return the dipole, uK, that effects on the beam leave in the samples of channels, where it is not negligible.

    Effects on the beam change the dipole of the sky, of which the fiducial one is subtracted. It is negligible below
    ``NEGLIGIBLE`` of the rms of the sky, or where the maps' own dipole is subtracted afterwards.
    """
    steps = survey.config.preparation
    subtracted = [one for one in steps if isinstance(one, declared.SubtractDipole | declared.Templates) and one.dipole]
    cl = spectrum(survey)
    rms_uk = float(np.sqrt(np.sum((2.0 * np.arange(cl.size) + 1.0) * cl) / (4.0 * np.pi)))
    found = {}
    for channel in survey.channels:
        window = channel.window * nearer(survey, channel)
        fiducial = convolve.response(channel.site.beam, channel.site.lmax, window).factors[:2, 1]
        change = np.zeros(2, dtype=np.complex128)
        change[: channel.response.mmax + 1] += channel.response.factors[:2, 1]
        change[: fiducial.size] -= fiducial
        # Of the orders -1, 0 and 1 of the beam.
        left_uk = float(np.linalg.norm(channel.site.dipole_uk) * np.linalg.norm([1.0, np.sqrt(2.0)] * change))
        kept = not any(channel.name in (step.channels or (channel.name,)) for step in subtracted)
        if channel.effects and kept and left_uk > NEGLIGIBLE * rms_uk:
            found[channel.name] = left_uk
    return found


def _weighted(survey: Survey, m: SurveyMap) -> SurveyMap:
    """Return a map with the weights that its estimates are of: before masks if their normalisation takes these out."""
    if survey.filtering is None:
        return m
    made = next(one for one in survey.making.maps if one.name == m.name)
    return replace(made, weight=None)


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
    turned = any(systematics.acts_through(one, "orientations") for one in channel.effects)
    plain = m.weight is None and m.preparation is None and not turned
    if isinstance(scan, config.ScanParallelTransport) and plain:
        return parallel_transport_harmonics(smax, L_max, float(np.deg2rad(scan.psi0_deg)))
    return orientation_harmonics(np.asarray(m.moments.w[:smax]), L_max, nthreads, m.weight)


def moments_needed(survey: Survey, exact: bool, L_moments: int | None = None) -> int:
    """Return the degree up to which a prediction needs the moments: ``L_moments`` to all orders, and with weights.

    Raise InputError for one below biposh.L_max, from where on there would be no signal.
    """
    L_max = survey.config.biposh.L_max
    weighted = [(m, c) for c in survey.channels for m in c.maps if _weighted(survey, m).weight is not None]
    if L_moments is not None and L_moments < L_max:
        raise InputError(f"L_moments = {L_moments} is below biposh.L_max = {L_max}; give L_moments >= {L_max}.")
    if not (exact or weighted):
        return L_max
    if L_moments is not None:
        return L_moments
    return max(L_max, max((_degrees_for(survey, m, channel) for m, channel in weighted), default=L_MOMENTS))


def _degrees_of(weight: Map) -> int:
    """Return the first of ``L_WEIGHTS`` up to which a weight has nearly all of its square."""
    share = held(weight, L_WEIGHTS[-1])
    return next((L for L in L_WEIGHTS if share[L] >= SHARE), L_WEIGHTS[-1])


def _degrees_for(survey: Survey, m: SurveyMap, channel: Channel) -> int:
    """Return the first of ``L_WEIGHTS`` from ``_degrees_of`` on beyond which a map's weight scatters little power."""
    assert m.weight is not None  # the caller looked
    cl = circular_spectrum(survey, channel)
    whole = _scattered(cl, m.weight, m.weight, survey.lmax)
    least = ROUNDING * whole.max()
    near = range(_degrees_of(m.weight), L_WEIGHTS[-1], L_WEIGHTS.step)
    beyond = ((L, _scattered(cl, m.weight, m.weight, survey.lmax, L)) for L in near)
    return next((L for L, less in beyond if np.all(less <= SCATTERED * whole + least)), L_WEIGHTS[-1])


def circular_spectrum(survey: Survey, channel: Channel) -> Cl:
    """Return the spectrum of the sky through the round part of a channel's beam and its pixels, uK^2."""
    cl = spectrum(survey)
    beam = channel.beam.blm[:1] * channel.window * nearer(survey, channel)
    none = np.zeros((1, 1, 1), dtype=np.complex128)
    return np.asarray(cl * ScannedBeam(beam, none).response(len(cl) - 1)[0].real ** 2)


def _scattered(cl: Cl, x: Map, y: Map, lmax: int, beyond: int = -1, nthreads: int = 1) -> Cl:
    """Return the cross spectrum of an isotropic sky in two weights, (lmax + 1,), by their degrees beyond a given one.

    It is not divided by <W_x W_y>.
    """
    top = min(3 * nside_of(x.size, "a weight") - 1, lmax + len(cl) - 1)
    one, two = (_harmonics(_Weight.of(weight), top, nthreads) for weight in (x, y))
    weights = by_degree(one, two, top) / (2.0 * np.arange(top + 1) + 1.0)
    weights[np.abs(weights) < ROUNDING * np.abs(weights).max()] = 0.0
    weights[: beyond + 1] = 0.0
    return pseudo_spectrum(cl, weights, lmax)


@dataclass(frozen=True)
class _Weight:
    """A weight of pixels, known by its content: many maps have the same."""

    digest: bytes
    values: Map = field(compare=False)

    @classmethod
    def of(cls, weight: Map) -> "_Weight":
        return cls(blake2b(np.ascontiguousarray(weight).data).digest(), weight)


@lru_cache(maxsize=4)
def _harmonics(weight: _Weight, top: int, nthreads: int) -> Alm:
    """Return a_lm of a weight; the last ones are kept.

    Those beyond 2 nside have errors of 1e-5, and are none where the weight has ended before.
    """
    clean = min(top, 2 * nside_of(weight.values.size, "a weight"))
    alm = healpix.analysis(weight.values, clean, iterations=3, nthreads=nthreads)
    power = by_degree(alm, alm, clean)
    if power[clean - clean // 4 :].max() < ROUNDING * power.max():
        return alm_.resize(alm, clean, top)
    return healpix.analysis(weight.values, top, iterations=3, nthreads=nthreads)


def held(weight: Map, L_max: int) -> Cl:
    """Return the share of the mean square of weights in degrees up to 0, 1, ..., L_max."""
    power = np.sum(np.abs(map_harmonics(weight, L_max)) ** 2, axis=1) / (4.0 * np.pi)
    return np.asarray(np.cumsum(power) / np.mean(weight**2))


def signal(
    survey: Survey,
    beams: tuple[ScannedBeam, ScannedBeam],
    pair: tuple[int, int],
    modes: Sequence[Indices],
    exact: bool,
    nthreads: int = 1,
) -> NDArray[np.complex128]:
    """Return the mean of the sky seen through beams by a pair of maps (indices), uK^2, shape (mode, lmax + 1).

    It is of leading order in their non-circular part, or of all orders if ``exact``, normalised as the estimates are.
    What weights scatter by degrees beyond those of the moments is in C_l alone, of the round parts of the beams.
    """
    x, y = beams
    y = x if pair[0] == pair[1] else y
    summed = cmb_biposh_exact if exact else cmb_biposh_leading
    found = summed(modes, spectrum(survey), survey.lmax, x, y, nthreads=nthreads)
    weights = [np.ones(1) if (w := _weighted(survey, survey.maps[i]).weight) is None else w for i in pair]
    if (0, 0, 0) in modes and x.weighted and y.weighted:
        ell = np.arange(survey.lmax + 1)
        further = _further(survey, (x, y), pair, min(x.L_max, y.L_max), nthreads)
        found[list(modes).index((0, 0, 0))] += (-1.0) ** ell * np.sqrt(2.0 * ell + 1.0) * further
    return without_windows(survey, found / np.mean(weights[0] * weights[1]), modes, pair)


def _further(
    survey: Survey, beams: tuple[ScannedBeam, ScannedBeam], pair: tuple[int, int], beyond: int, nthreads: int
) -> Cl:
    """Return the cross spectrum that two weights scatter by degrees beyond those of the moments."""
    cl = spectrum(survey)
    for beam in beams:
        cl = cl * beam.circular.response(len(cl) - 1)[0].real
    weights = [w for i in pair if (w := survey.maps[i].weight) is not None]
    return _scattered(cl, weights[0], weights[-1], survey.lmax, beyond, nthreads)


def beyond_moments(survey: Survey, number: int, L_moments: int) -> Cl:
    """Return the spectrum of a map (index) that its weights scatter by degrees beyond ``L_moments``, uK^2, (lmax + 1,).

    It is normalised as the estimates are; of a map without weights it is zero.
    """
    weight = _weighted(survey, m := survey.maps[number]).weight
    if weight is None:
        return np.zeros(survey.lmax + 1)
    channel = next(one for one in survey.channels if m in one.maps)
    further = _scattered(circular_spectrum(survey, channel), weight, weight, survey.lmax, L_moments)
    return np.asarray(further / np.mean(weight**2) / channel.window[: survey.lmax + 1] ** 2)


def means(
    survey: Survey, beams: tuple[ScannedBeam, ...], pair: tuple[int, int], exact: bool, nthreads: int = 1
) -> Means:
    """Return the means of a pair of maps (indices) in all modes of the survey, whose beams are :func:`scanned_beams`.

    They are of leading order in the non-circular part of the beams, or of all orders if ``exact``.
    """
    modes, both = survey.estimator.modes, (beams[pair[0]], beams[pair[1]])
    seen = signal(survey, both, pair, modes, exact, nthreads)
    circular = signal(survey, (both[0].circular, both[1].circular), pair, modes, exact=False, nthreads=nthreads)
    noise = np.zeros_like(seen)
    if pair[0] == pair[1]:
        noise = noise_mean(survey, pair[0], modes, nthreads)
        repeated = [row for row, mode in enumerate(modes) if not mode.in_auto]
        for array in (seen, circular, noise):
            array[repeated] = np.nan
    return Means(seen, circular, noise)


def spectrum(survey: Survey) -> Cl:
    """Return C_l of the sky; raise InputError for a survey without a spectrum."""
    if survey.cl is None:
        raise InputError(
            f"{survey.config.name} takes its skies from files and names no spectrum; add sky.spectrum for a prediction."
        )
    return survey.cl


def noise_mean(survey: Survey, number: int, modes: Sequence[Indices], nthreads: int = 1) -> NDArray[np.complex128]:
    """Return the mean BipoSH of the noise of a map, uK^2, shape (mode, lmax + 1).

    Of a filtered map without the mean field, of which it is a part: for L = 0 alone. InputError for noise that is not
    white, and for prepared noise that :func:`_of_steps_in_harmonics` does not follow.
    """
    m = survey.maps[number]
    L_max, lmax = max(L for L, _, _ in modes), survey.lmax
    if m.drawn is not None:
        raise InputError(
            f"the noise of map {m.name} is not white, and predictions are of white noise; simulate it with mcsim run, "
            'or give the channel noise of kind "white", "depth" or "variance".'
        )
    found = np.zeros((len(modes), lmax + 1), dtype=np.complex128)
    if m.noise_uk is None:
        return found
    if m.preparation is not None and m.preparation.transforms:
        found = _of_steps_in_harmonics(survey, m, m.noise_uk**2, modes, nthreads)
        return without_windows(survey, found, modes, (number, number))
    power = m.noise_uk**2 * nside2pixarea(m.moments.nside)
    if survey.filtering is not None:
        ell, isotropic = np.arange(lmax + 1), [L == 0 for L, _, _ in modes]
        cl = survey.filtering.filters[number].noise(power)[: lmax + 1]
        found[isotropic] = (-1.0) ** ell * np.sqrt(2.0 * ell + 1.0) * cl
        return found
    weight = m.left_to_apply
    variance = map_harmonics(power if weight is None else power * weight**2, L_max)
    return without_windows(survey, noise_biposh(modes, variance, lmax), modes, (number, number))


def _of_steps_in_harmonics(
    survey: Survey, m: SurveyMap, variance: Map, modes: Sequence[Indices], nthreads: int
) -> NDArray[np.complex128]:
    """Return the BipoSH of noise of a variance (uK^2) that steps in harmonics have left correlated, windows included.

    Notes
    -----
    White noise of local power V(n) that filters multiply with w_l has the BipoSH of V times w_l1 w_l2. Where V is even,
    it is an isotropic sky of spectrum V w_l^2, which weights W(n) after the filters couple as they do the CMB. No such
    form is known where both V and W are uneven.
    """
    assert m.preparation is not None  # the caller looked
    steps, lmax, fine = m.preparation, survey.lmax, survey.config.map.resolution
    masks, weight = steps.filtered_weight(), m.left_to_apply
    if masks is not None:
        variance = divided(variance, masks**2)
        weight = masks if weight is None else weight * masks
    power, window = variance / steps.noise_band(fine), steps.noise_window(max(3 * fine - 1, lmax))
    _check_folded(m, window, lmax)
    if weight is None:
        found = noise_biposh(modes, map_harmonics(power, max(L for L, _, _ in modes)), lmax)
        for row, (L, _, d) in zip(found, modes, strict=True):
            l2 = np.flatnonzero(existing(L, d, lmax))
            row[l2] *= window[l2 - d] * window[l2]
        return found
    _check_even(m, power, window, weight)
    ell, L_max = np.arange(window.size), max(_degrees_of(weight), *(L for L, _, _ in modes))
    w = map_harmonics(weight, L_max)
    even = ScannedBeam(np.sqrt((2.0 * ell + 1.0) / (4.0 * np.pi))[None], w[None])
    return cmb_biposh_leading(modes, power[weight != 0.0].mean() * window**2, lmax, even, nthreads=nthreads)


def _check_folded(m: SurveyMap, window: Cl, lmax: int) -> None:
    """Raise InputError for filtered noise that goes on beyond the degrees of the pixels that it is averaged in."""
    end, ell = 3 * m.moments.nside - 1, np.arange(window.size)
    beyond = float(np.sum(((2 * ell + 1) * window**2)[end + 1 :])) / (12 * m.moments.nside**2)
    if beyond > FOLDED * window[lmax] ** 2:
        raise InputError(
            f"the noise of map {m.name} goes on beyond l = {end} where it is averaged after a step in harmonics: spread"
            f" over all l this is {beyond / window[lmax] ** 2:.2g} of its power at l = {lmax}, and predictions take at "
            f'most {FOLDED:g}; degrade before that step, or with method = "harmonics", or simulate it with mcsim run.'
        )


def _check_even(m: SurveyMap, power: Map, window: Cl, weight: Map) -> None:
    """Raise InputError for noise that filters do not leave even where the weights after them are, or masks between."""
    assert m.preparation is not None  # the caller looked
    masked = f"map {m.name} is masked after a step in harmonics"
    remedy = "simulate it with mcsim run, or leave the step or the mask out"
    if m.preparation.masked_between:
        raise InputError(f"{masked} and before another, which predictions of noise do not cover; {remedy}.")
    seen = power[weight != 0.0]
    if np.ptp(seen) > EVEN * seen.max():
        lowest, highest = np.sqrt([seen.min(), seen.max()]) * 60.0 * np.degrees(1.0)
        raise InputError(
            f"{masked}, where its noise is {lowest:.3g} to {highest:.3g} uK arcmin, and predictions cover even noise "
            f"there; {remedy}."
        )
    lmax = min(3 * m.moments.nside, window.size) - 1
    filtered = alm_.multiply(healpix.analysis(power, lmax, 1), window[: lmax + 1], lmax)
    after = healpix.synthesis(filtered[None], m.moments.nside, lmax)[0]
    moved = abs(1.0 - float(np.mean(weight**2 * after) / np.mean(weight**2 * power)))
    if moved > MOVED:
        raise InputError(
            f"{masked}, which moves {100 * moved:.2g} % of its noise between pixels that are seen and others with "
            f"other noise, and predictions take at most {100 * MOVED:g} %; widen the mask of the analysis, or simulate "
            "it with mcsim run."
        )
