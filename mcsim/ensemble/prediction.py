"""From a configuration to what its ensemble should give: means, errors and detectability, without Monte Carlo."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from healpy import nside2pixarea
from numpy.typing import NDArray

from mcsim import config
from mcsim.bipolar import estimator
from mcsim.bipolar.theory import (
    Mode,
    ScannedBeam,
    cmb_biposh_exact,
    cmb_biposh_leading,
    existing,
    fisher_information,
    isotropic_variance,
    noise_biposh,
    orientation_harmonics,
    parallel_transport_harmonics,
    signal_to_noise,
)
from mcsim.bipolar.theory.harmonics import spin_functions
from mcsim.ensemble import plan, summary
from mcsim.errors import InputError
from mcsim.simulation import survey as survey_
from mcsim.simulation.rings import Rings
from mcsim.simulation.survey import Channel, Survey, SurveyMap
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.stats.streaming import Sums

Source = str | Path | Mapping[str, Any] | config.RunConfig | Survey

L_MOMENTS = 64
"""Highest degree of the orientation moments in predictions to all orders in the beam."""


@dataclass(frozen=True)
class _Pair:
    """Means of an ordered pair, shape (mode, lmax + 1): seen by the beams, by their circular parts, and of noise."""

    beam: NDArray[np.complex128]
    circular: NDArray[np.complex128]
    noise: NDArray[np.complex128]


def predict(
    source: Source, exact: bool = False, snr: bool = False, L_moments: int = L_MOMENTS, nthreads: int = 1
) -> xr.Dataset:
    """Predict the summary of an ensemble.

    Parameters
    ----------
    source
        Configuration: a TOML file, the name of a packaged workflow, a dict, or one that is loaded; or its survey.
    exact
        To all orders in the beam, instead of leading order in its non-circular part.
    snr
        Add the signal to noise of what the beam makes: ``signal_to_noise`` of each pair and mode, ``_binned`` the same
        per bin, and ``_total`` of all maps jointly.
    L_moments
        Highest degree of the orientation moments where ``exact``; see :func:`mcsim.predict.cmb_biposh_exact`.
    nthreads
        Threads.

    Returns
    -------
    xarray.Dataset
        Laid out like :func:`mcsim.open_summary`, so that the two subtract: ``{biposh, cl}{, _circular,
        _difference}_mean`` in uK^2, raw and binned. ``_standard_deviation`` and ``_standard_error`` are those of an
        isotropic sky, the error for ``ensemble.realizations`` of the configuration; of the difference to the
        circular-beam control, whose scatter is not that of an isotropic sky, they are NaN. Attributes say what is left
        out.

    Raises
    ------
    InputError
        For a configuration without a spectrum, or with files that cannot be used.

    Notes
    -----
    Signal: :mod:`mcsim.predict`, from b_lm, the spin harmonics of the moments w_s (exact ones for parallel transport)
    and C_l. The pixel window multiplies what enters a map and divides what its analysis gives: the scan couples
    degrees in between, so it cancels in part only. Noise of variance v(n) per pixel adds v_LM times the pixel area to
    the autos. Weights W(n) (masks, unobserved pixels) replace w_s by W^2 w_s: so they act on the beam's part where l is
    far above their own scales; what they make of an isotropic sky is left out, as in the paired difference. Variances
    are C_l1 C_l2 (1 + delta_l1l2) / f_sky, f_sky = <W_x W_y>^2 / <W_x^2 W_y^2>. Ensembles agree within their errors:
    tests/integration/test_prediction.py, and test_prediction_pairs.py for pairs, noise and masks.

    Examples
    --------
    >>> import mcsim
    >>> expected = mcsim.predict("tiny")
    >>> float(expected.biposh_mean.sel(mode="L2M0d0", pair="demo,demo", ell=20).real) > 0.0
    True
    """
    survey = survey_of(source, nthreads)
    if survey.cl is None:
        raise InputError(
            f"{survey.config.name} takes its skies from files and names no spectrum; add sky.spectrum for a prediction."
        )
    beams = scanned_beams(survey, L_moments if exact else survey.config.biposh.L_max, nthreads)
    found = {pair: _mean(survey, beams, pair, exact, nthreads) for pair in survey.pairs}
    result = _dataset(survey, found)
    result.attrs |= _attributes(survey, L_moments if exact else None)
    if not snr:
        return result
    # The information of all maps jointly needs every pair and both its orders, whatever pairs the ensemble keeps.
    every, whole = found, survey
    if len(beams) > 1 and survey.config.biposh.pairs != "all":
        whole = replace(survey, estimator=estimator(survey.config.biposh.L_max, survey.lmax, both_orders=True))
        pairs = [(x, y) for x in range(len(beams)) for y in range(x, len(beams))]
        every = {pair: _mean(whole, beams, pair, exact, nthreads) for pair in pairs}
    return result.assign(_detectability(survey, found, _joint_signal_to_noise(whole, every)))


def survey_of(source: Source, nthreads: int = 1) -> Survey:
    """The survey of a configuration in any form."""
    if isinstance(source, Survey):
        return source
    run = source if isinstance(source, config.RunConfig) else config.load(source)
    return survey_.survey(run, nthreads)


def scanned_beams(survey: Survey, L_max: int, nthreads: int = 1) -> tuple[ScannedBeam, ...]:
    """Beam, times the pixel window, and moments up to degree ``L_max`` of every map."""
    specs = {channel.name: channel.scan for channel in survey.config.channels}
    for name, scan in specs.items():
        if isinstance(scan, config.ScanDifferencing):
            raise InputError(
                f"Channel {name} reads two beams as a difference, which predictions do not cover; "
                "predict the same model with hit_averaged instead."
            )
    return tuple(
        ScannedBeam(channel.beam.blm * channel.window, _orientations(specs[channel.name], channel, m, L_max, nthreads))
        for channel in survey.channels
        for m in channel.maps
    )


def without_windows(
    survey: Survey, spectra: NDArray[np.complex128], modes: Sequence[Mode], pair: tuple[int, int]
) -> NDArray[np.complex128]:
    """Coefficients of maps as the analysis leaves them: over the pixel windows at l1 and l2."""
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
        return _orientations_on_rings(channel.rings, smax, L_max)
    if isinstance(scan, config.ScanParallelTransport) and m.weight is None:
        return parallel_transport_harmonics(smax, L_max, float(np.deg2rad(scan.psi0_deg)))
    w = np.asarray(m.moments.w[:smax])
    return orientation_harmonics(w if m.weight is None else w * m.weight**2, L_max, nthreads=nthreads)


def _orientations_on_rings(grid: tuple[Rings, ...], smax: int, L_max: int) -> NDArray[np.complex128]:
    """w_{s,LM} of moments that depend on colatitude alone, so M = 0; the rings integrate them without error."""
    result = np.zeros((smax + 1, L_max + 1, 2 * L_max + 1), dtype=np.complex128)
    result[0, 0, L_max] = np.sqrt(4.0 * np.pi)
    for rings in grid:
        harmonics = spin_functions(rings.s, L_max, rings.theta)[rings.s]
        result[rings.s, :, L_max] = rings.phase * (harmonics @ rings.weight)
    return result


def _mean(survey: Survey, beams: tuple[ScannedBeam, ...], pair: tuple[int, int], exact: bool, nthreads: int) -> _Pair:
    assert survey.cl is not None  # the caller has refused its absence
    x, y = beams[pair[0]], beams[pair[1]]
    modes, lmax = _modes(survey), survey.lmax
    signal = cmb_biposh_leading(modes, survey.cl, lmax, x, y)
    circular = np.where(np.array([L for L, _, _ in modes])[:, None] == 0, signal, 0.0 * signal)
    if exact:
        signal = cmb_biposh_exact(modes, survey.cl, lmax, x, x if pair[0] == pair[1] else y, nthreads=nthreads)
    signal, circular = (without_windows(survey, array, modes, pair) for array in (signal, circular))
    noise = np.zeros_like(signal)
    if pair[0] == pair[1]:
        noise = _noise(survey, pair[0])
        repeated = [row for row, mode in enumerate(survey.estimator.modes) if not mode.in_auto]
        for array in (signal, circular, noise):
            array[repeated] = np.nan
    return _Pair(signal, circular, noise)


def _modes(survey: Survey) -> list[Mode]:
    return [(mode.L, mode.M, mode.d) for mode in survey.estimator.modes]


def _noise(survey: Survey, number: int) -> NDArray[np.complex128]:
    """Mean BipoSH of the noise of a map."""
    m = [m for channel in survey.channels for m in channel.maps][number]
    L_max, modes, lmax = survey.config.biposh.L_max, _modes(survey), survey.lmax
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


def _cl(survey: Survey, monopole: NDArray[np.complex128]) -> NDArray[np.float64]:
    """C_l of A^{00}_ll."""
    ell = np.arange(survey.lmax + 1)
    return (-1.0) ** ell * monopole.real / np.sqrt(2.0 * ell + 1.0)


def _total_cl(survey: Survey, found: dict[tuple[int, int], _Pair], pair: tuple[int, int]) -> NDArray[np.float64]:
    monopole = _modes(survey).index((0, 0, 0))
    return _cl(survey, (found[pair].beam + found[pair].noise)[monopole])


def _sky_fraction(survey: Survey, pair: tuple[int, int]) -> float:
    """<W_x W_y>^2 / <W_x^2 W_y^2>."""
    maps = [m for channel in survey.channels for m in channel.maps]
    weights = [maps[i].weight for i in pair]
    if all(weight is None for weight in weights):
        return 1.0
    product = np.prod([np.ones(maps[pair[0]].moments.npix) if w is None else w for w in weights], axis=0)
    return float(product.mean() ** 2 / np.mean(product**2))


def _variance(survey: Survey, found: dict[tuple[int, int], _Pair], pair: tuple[int, int]) -> NDArray[np.float64]:
    """E|A - mean|^2 of an isotropic sky with these spectra, shape (mode, lmax + 1)."""
    x, y = pair
    spectra = [_total_cl(survey, found, p) for p in ((x, x), (y, y), pair)]
    modes = _modes(survey)
    variance = np.empty((len(modes), survey.lmax + 1))
    anisotropic = [row for row, (L, _, _) in enumerate(modes) if L > 0]
    variance[anisotropic] = isotropic_variance([modes[row] for row in anisotropic], *spectra)
    variance[modes.index((0, 0, 0))] = spectra[0] * spectra[1] + spectra[2] ** 2
    return np.where(np.isnan(found[pair].beam), np.nan, variance / _sky_fraction(survey, pair))


def _dataset(survey: Survey, found: dict[tuple[int, int], _Pair]) -> xr.Dataset:
    run = survey.config
    recipe = summary.Recipe(survey.pair_names, survey.estimator.modes, survey.lmax, run.biposh.summary_bin, paired=True)
    mean: dict[str, NDArray] = {
        "biposh": np.stack([found[pair].beam + found[pair].noise for pair in survey.pairs]),
        "biposh_circular": np.stack([found[pair].circular + found[pair].noise for pair in survey.pairs]),
        "biposh_difference": np.stack([found[pair].beam - found[pair].circular for pair in survey.pairs]),
    }
    monopole = _modes(survey).index((0, 0, 0))
    variance = np.stack([_variance(survey, found, pair) for pair in survey.pairs])
    scatter = {name: np.full_like(variance, np.nan) if name.endswith("difference") else variance for name in mean}
    comoment: dict[str, NDArray] = {}
    degrees = 2.0 * np.arange(survey.lmax + 1) + 1.0
    for name in list(mean):
        spectra = name.replace("biposh", "cl")
        mean[spectra] = _cl(survey, mean[name][:, monopole])
        scatter[spectra] = scatter[name][:, monopole] / degrees
        mean[f"{name}_binned"] = recipe.binned(mean[name])
        scatter[f"{name}_binned"] = _binned_variance(recipe, scatter[name])
        if not name.endswith("difference"):
            comoment[f"{name}_binned"] = scatter[f"{name}_binned"][..., None] * np.eye(len(recipe.edges) - 1)
    # The sums of two realizations with these variances, so that the summary's own code lays them out.
    result = summary.dataset(recipe, Sums(2, mean, scatter, comoment), plan.attributes(run))
    for name in mean:
        result[f"{name}_standard_error"].values[:] = np.sqrt(scatter[name] / run.ensemble.realizations)
    result["count"].values[...] = run.ensemble.realizations
    return result


def _binned_variance(recipe: summary.Recipe, variance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Variance of the mean over a bin of coefficients that are independent from ell to ell."""
    scaled = recipe.factor**2 * variance
    exists = np.isfinite(scaled)
    total = np.add.reduceat(np.where(exists, scaled, 0.0), recipe.edges[:-1], axis=-1)
    count = np.add.reduceat(exists, recipe.edges[:-1], axis=-1, dtype=np.int64)
    return np.divide(total, count.astype(float) ** 2, out=np.full(total.shape, np.nan), where=count > 0)


def _attributes(survey: Survey, L_moments: int | None) -> dict[str, Any]:
    run = survey.config
    order = (
        "leading order in their non-circular part" if L_moments is None else f"all orders, w_s up to L = {L_moments}"
    )
    weighted = any(m.weight is not None for channel in survey.channels for m in channel.maps)
    return {
        "name": run.name,
        "prediction": f"from b_lm of the beams, {order}",
        "frame": run.map.frame,
        "digest": config.digest(run),
        "f_sky": min(_sky_fraction(survey, pair) for pair in survey.pairs),
        "mask": "weights W act as w_s -> W^2 w_s and on the errors; their own mode coupling is left out"
        if weighted
        else "full sky",
        "pixel_window": "divided out of a_lm by the analysis, so it cancels but for the noise"
        if run.map.grid == "healpix"
        else "none: rings without pixels",
        "left_out": "centroid offsets of the samples in a pixel, quadrature error of the analysis"
        if run.map.grid == "healpix"
        else "nothing",
    }


def _detectability(survey: Survey, found: dict[tuple[int, int], _Pair], joint: float) -> dict[str, tuple[Any, ...]]:
    """Signal to noise in one sky of what the beams add to their circular parts, L > 0; ``joint``: of all together."""
    modes, lmax = _modes(survey), survey.lmax
    rows = [row for row, (L, _, _) in enumerate(modes) if L > 0]
    anisotropic = [modes[row] for row in rows]
    first = np.arange(0, lmax + 1, survey.config.biposh.summary_bin)
    last = np.append(first[1:] - 1, lmax)
    each = np.full((len(survey.pairs), len(modes)), np.nan)
    binned = np.full((*each.shape, len(first)), np.nan)
    for number, (x, y) in enumerate(survey.pairs):
        signal = (found[x, y].beam - found[x, y].circular)[rows]
        xx, yy, xy = (_total_cl(survey, found, pair) for pair in ((x, x), (y, y), (x, y)))
        f_sky = _sky_fraction(survey, (x, y))
        each[number, rows] = signal_to_noise(signal, anisotropic, xx, yy, xy, f_sky)
        for b, ells in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
            binned[number, rows, b] = signal_to_noise(signal, anisotropic, xx, yy, xy, f_sky, ells)
    text = "signal to noise in one sky of what the beam adds to its circular part"
    return {
        "signal_to_noise": (("pair", "mode"), each, {"units": "1", "long_name": text}),
        "signal_to_noise_binned": (("pair", "mode", "bin"), binned, {"units": "1", "long_name": f"{text}, per bin"}),
        "signal_to_noise_total": (
            (),
            joint,
            {"units": "1", "long_name": f"{text}, all maps and modes jointly (exact Fisher information)"},
        ),
    }


def _joint_signal_to_noise(survey: Survey, found: dict[tuple[int, int], _Pair]) -> float:
    """Square root of the Fisher information of all maps, infinite where noiseless maps leave nothing to hide behind."""
    size, lmax = len(survey.map_names), survey.lmax
    stored = _modes(survey)
    modes = [
        mode for mode in stored if mode[0] > 0 and mode[2] >= 0 and not (mode[2] == 0 and mode[0] % 2 and size == 1)
    ]
    cl = np.empty((size, size, lmax + 1))
    signal = np.zeros((size, size, len(modes), lmax + 1), dtype=np.complex128)
    for x, y in found:
        cl[x, y] = cl[y, x] = _total_cl(survey, found, (x, y))
        beam = np.nan_to_num(found[x, y].beam - found[x, y].circular)
        for row, (L, M, d) in enumerate(modes):
            signal[x, y, row] = beam[stored.index((L, M, d))]
            if x != y:
                # A^{LM}_{l1 l2} of the exchanged pair is (-1)^{l1+l2+L} A^{LM}_{l2 l1}.
                l2 = np.flatnonzero(existing(L, d, lmax))
                signal[y, x, row, l2] = (-1) ** (L + d) * beam[stored.index((L, M, -d)), l2 - d]
    if size > 1:
        diagonal = np.sqrt(np.einsum("xxl->xl", cl))
        seen = (diagonal > 0.0).all(axis=0)
        correlation = (cl / np.where(seen, diagonal[:, None] * diagonal, 1.0))[:, :, seen]
        if np.any(np.linalg.eigvalsh(np.moveaxis(correlation, -1, 0))[:, 0] < 1e-12):
            return float("inf")
    f_sky = min(_sky_fraction(survey, pair) for pair in found)
    return float(np.sqrt(fisher_information(signal, modes, cl, f_sky)))
