"""Errors of a survey's BipoSH under isotropy, and the signal to noise of the beams' BipoSH."""

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim.bipolar.modes import Mode, existing
from mcsim.bipolar.theory import (
    FULL_SKY,
    Overlap,
    ScannedBeam,
    Spectra,
    fisher_information,
    isotropic_variance,
    overlap,
    signal_to_noise,
)
from mcsim.ensemble import plan, summary
from mcsim.ensemble.expectation import L_WEIGHTS, Means, circular_spectrum
from mcsim.simulation.filtering import LOWEST
from mcsim.simulation.survey import Survey
from mcsim.support.arrays import divided

MONOPOLE = Mode(0, 0, 0)

BESIDE = 24
"""Degrees beyond the width of a bin up to which weights are taken to correlate it with others."""


def cl_of(survey: Survey, monopole: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return C_l of A^{00}_ll."""
    ell = np.arange(survey.lmax + 1)
    return (-1.0) ** ell * monopole.real / np.sqrt(2.0 * ell + 1.0)


def total_cl(survey: Survey, found: dict[tuple[int, int], Means], pair: tuple[int, int]) -> NDArray[np.float64]:
    """Return C_l of a pair of maps with their noise, uK^2, shape (lmax + 1,)."""
    monopole = survey.estimator.modes.index(MONOPOLE)
    return cl_of(survey, (found[pair].beam + found[pair].noise)[monopole])


def sky_fraction(survey: Survey, pair: tuple[int, int]) -> float:
    """Return <W_x W_y>^2 / <W_x^2 W_y^2> of the weights W: the modes that are left."""
    weights = [np.ones(1) if m.weight is None else m.weight for m in survey.maps]
    x, y = (weights[index] for index in pair)
    return float(np.mean(x * y) ** 2 / np.mean((x * y) ** 2))


def overlap_of(survey: Survey, pair: tuple[int, int]) -> Overlap:
    """Return how the weights of a pair of maps correlate the degrees of a bin and those beside it, for each M."""
    return _overlap(
        survey, pair, min(plan.layout(survey).bin_width - 1 + BESIDE, survey.lmax), survey.config.biposh.L_max
    )


def _overlap(survey: Survey, pair: tuple[int, int], reach: int = 0, d_max: int | None = None) -> Overlap:
    """Return how the weights of a pair of maps correlate degrees, up to ``reach`` apart.

    Filtered maps count as of independent degrees of the observed sky.
    """
    weights = [survey.maps[index].weight for index in pair]
    if survey.filtering is not None:
        return Overlap(*np.full((2, 1, 1), 1.0 / sky_fraction(survey, pair)))
    if weights[0] is None and weights[1] is None:
        return FULL_SKY
    npix = next(weight.size for weight in weights if weight is not None)
    x, y = (np.ones(npix) if weight is None else weight for weight in weights)
    return overlap(x, y, reach, L_WEIGHTS[-1], d_max)


def scattered(survey: Survey, found: dict[tuple[int, int], Means], number: int) -> NDArray[np.float64]:
    """Return the share of the mean spectrum of a map (index) that its weights scatter into each degree, (lmax + 1,).

    It is what the spectrum has above that of the full sky; negative where weights take more away than they bring.
    """
    channel = next(one for one in survey.channels if survey.maps[number] in one.maps)
    full = circular_spectrum(survey, channel)[: survey.lmax + 1] / channel.window[: survey.lmax + 1] ** 2
    own = found[number, number]
    monopole = survey.estimator.modes.index(MONOPOLE)
    there = cl_of(survey, own.circular[monopole])
    return divided(there - full, there + cl_of(survey, own.noise[monopole]))


def variances_of(
    survey: Survey, found: dict[tuple[int, int], Means], pair: tuple[int, int], weights: Overlap
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return variances for an isotropic sky, shape (mode, lmax + 1), and the covariance of bins, (mode, bin, bin).

    ``weights`` are those of :func:`overlap_of`.
    """
    layout = plan.layout(survey)
    spectra = _spectra(survey, found, pair)
    absent = np.isnan(found[pair].beam)
    shifted = [
        np.where(absent, np.nan, isotropic_variance(survey.estimator.modes, spectra, weights, shift))
        for shift in range(len(weights.autos))
    ]
    return shifted[0], summary.binned_covariance(layout, shifted)


def _spectra(survey: Survey, found: dict[tuple[int, int], Means], pair: tuple[int, int], share: float = 1.0) -> Spectra:
    """Return the total spectra of a pair, with a share of the square of the cross spectrum."""
    x, y = pair
    xx, yy, xy = (total_cl(survey, found, one) for one in ((x, x), (y, y), pair))
    return Spectra(xx, yy, np.sqrt(share) * xy)


def variables(survey: Survey, found: dict[tuple[int, int], Means], joint: float) -> dict[str, tuple[Any, ...]]:
    """Return the signal-to-noise variables of a summary for one sky, L > 0; ``joint`` is that of all maps."""
    modes, layout = survey.estimator.modes, plan.layout(survey)
    rows = [row for row, (L, _, _) in enumerate(modes) if L > 0]
    anisotropic = [modes[row] for row in rows]
    bins = list(zip(layout.first_ells().tolist(), layout.last_ells().tolist(), strict=True))
    each = np.full((len(survey.pairs), len(modes)), np.nan)
    binned = np.full((*each.shape, len(bins)), np.nan)
    for number, (x, y) in enumerate(survey.pairs):
        signal = _added(survey, found[x, y])[rows]
        spectra = _spectra(survey, found, (x, y), _overlap(survey, (x, y)).shared)
        f_sky = sky_fraction(survey, (x, y))
        each[number, rows] = signal_to_noise(signal, anisotropic, spectra, f_sky)
        for b, ells in enumerate(bins):
            binned[number, rows, b] = signal_to_noise(signal, anisotropic, spectra, f_sky, ells)
    text = "signal to noise in one sky of what the beam adds to its circular part, l >= 2"
    jointly = "all maps and modes jointly (exact Fisher information)"
    return {
        "signal_to_noise": (("pair", "mode"), each, {"units": "1", "long_name": text}),
        "signal_to_noise_binned": (("pair", "mode", "bin"), binned, {"units": "1", "long_name": f"{text}, per bin"}),
        "signal_to_noise_total": ((), joint, {"units": "1", "long_name": f"{text}, {jointly}"}),
    }


def _added(survey: Survey, found: Means) -> NDArray[np.complex128]:
    """Return what the beam adds to the mean of its circular part, without l1 or l2 below those of the model's sky."""
    added = found.beam - found.circular
    ell = np.arange(survey.lmax + 1)
    for row, mode in zip(added, survey.estimator.modes, strict=True):
        row[(ell < LOWEST) | (ell - mode.d < LOWEST)] = 0.0
    return added


def joint_signal_to_noise(survey: Survey, beams: Sequence[ScannedBeam], found: dict[tuple[int, int], Means]) -> float:
    """Return the root of the Fisher information of all maps, whose beams are ``beams``.

    Degrees at which masks and the orders of beams that are left out leave no covariance are left out.

    Notes
    -----
    Maps without noise have the covariance C_l = c c^t over maps, c the circular beams times the root of the sky's
    spectrum, and an effect changes it by dc c^t + c dc^t. Where dc is c times a factor that all maps share, this stays
    in the range of C, and the information is Tr[C^+ dC C^+ dC]/2: that of one of the maps, of which each other is a
    multiple at every l. Otherwise combinations without power get some, and it is infinite. So one counts of the maps
    without noise that share weights, orientations and b_ls/b_l0 (or have circular beams), and nothing hides other
    orientations or shapes where both maps see the sky.
    """
    quiet = [index for index, m in enumerate(survey.maps) if m.noise_uk is None or not m.noise_uk.any()]
    repeated = set()
    for x, y in combinations(quiet, 2):
        if not _seen_alike(survey, beams, x, y):
            return float("inf")
        here, there = (np.ones(1) if (w := survey.maps[i].weight) is None else w for i in (x, y))
        if np.array_equal(here, there):
            repeated.add(y)
    place = {index: n for n, index in enumerate(index for index in range(len(survey.maps)) if index not in repeated)}
    stored, size, lmax = survey.estimator.modes, len(place), survey.lmax
    modes = [mode for mode in stored if mode.L > 0 and mode.d >= 0]
    cl = np.empty((size, size, lmax + 1))
    signal = np.zeros((size, size, len(modes), lmax + 1), dtype=np.complex128)
    kept = [pair for pair in found if place.keys() >= set(pair)]
    for pair in kept:
        x, y = (place[index] for index in pair)
        share = _overlap(survey, pair).shared
        cl[x, y] = cl[y, x] = np.sqrt(share) * total_cl(survey, found, pair)
        beam = np.nan_to_num(_added(survey, found[pair]))
        for row, (L, M, d) in enumerate(modes):
            signal[x, y, row] = beam[stored.index(Mode(L, M, d))]
            if x != y:
                # A^{LM}_{l1 l2} of the exchanged pair is (-1)^{l1+l2+L} A^{LM}_{l2 l1}.
                l2 = np.flatnonzero(existing(L, d, lmax))
                signal[y, x, row, l2] = (-1) ** (L + d) * beam[stored.index(Mode(L, M, -d)), l2 - d]
    f_sky = min(sky_fraction(survey, pair) for pair in kept)
    return float(np.sqrt(fisher_information(signal, modes, cl, f_sky)))


def _seen_alike(survey: Survey, beams: Sequence[ScannedBeam], x: int, y: int) -> bool:
    """Return True if two maps see the same in a sky, but for factors of l, wherever both see it."""
    orders = range(max(len(beams[x].blm), len(beams[y].blm)))
    absent = np.zeros_like(beams[x].blm[:1])
    for s in orders[1:]:
        one, other = (beams[i].blm[s : s + 1] if s < len(beams[i].blm) else absent for i in (x, y))
        if not np.allclose(one * beams[y].blm[0], other * beams[x].blm[0], rtol=1e-10, atol=0.0):
            return False
        here, there = (_orientations(survey, beams, i, s, (x, y)) if one.any() else absent for i in (x, y))
        if not np.array_equal(here, there):
            return False
    return True


def _orientations(
    survey: Survey, beams: Sequence[ScannedBeam], number: int, s: int, pair: tuple[int, int]
) -> NDArray[np.complex128]:
    """Return w_s of a map of a pair in the pixels that both weigh; where none has weights, its harmonics."""
    weights = [survey.maps[index].weight for index in pair]
    seen = [weight > 0.0 for weight in weights if weight is not None]
    if not seen:
        return beams[number].w[s]
    return np.asarray(survey.maps[number].moments.w[s - 1, np.all(seen, axis=0)])
