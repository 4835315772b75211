"""Prediction of an ensemble's means, errors and detectability from its configuration, without Monte Carlo."""

import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from mcsim import config
from mcsim.bipolar import estimator
from mcsim.bipolar.theory import ScannedBeam
from mcsim.ensemble import detectability, plan, summary
from mcsim.ensemble.expectation import (
    Means,
    Source,
    beyond_moments,
    dipoles_left,
    held,
    means,
    moments_needed,
    scanned_beams,
    survey_of,
)
from mcsim.ensemble.tasks import packages, shared_survey
from mcsim.simulation import power
from mcsim.simulation.survey import Survey
from mcsim.sphere.checks import check_truth, check_whole
from mcsim.stats.streaming import Sums
from mcsim.support.arrays import divided

if TYPE_CHECKING:
    from mcsim.ensemble.runner import Workers

Pairs = Iterable[tuple[int, int]]

COARSE = 0.95  #: share of the square of weights that a prediction must hold not to warn
LOWEST, SCATTERED, LEFT_OUT = 6, 0.3, 0.1
"""Degree from which errors behind masks hold, and the shares of a spectrum that a mask may scatter there: in all, and
from further than a prediction follows in modes other than C_l."""


def predict(
    source: Source,
    exact: bool = False,
    snr: bool = False,
    L_moments: int | None = None,
    nthreads: int = 1,
    workers: "Workers | None" = None,
) -> xr.Dataset:
    """Predict the summary of an ensemble.

    Parameters
    ----------
    source
        Configuration: a TOML file, the name of a packaged workflow, a dict, or a loaded one; or its survey.
    exact
        To all orders in the beam, instead of leading order in its non-circular part.
    snr
        Add the signal to noise of the beam's BipoSH: ``signal_to_noise`` of each pair and mode, ``_binned`` the same
        per bin, and ``_total`` of all maps jointly; of l1, l2 >= 2, for the model's sky has no monopole and dipole.
    L_moments
        Highest degree of the orientation moments if ``exact``, and of weights of pixels, such as masks; see
        :func:`mcsim.bipolar.theory.cmb_biposh_exact`. At least biposh.L_max, which is enough without these two, and
        then taken whatever is given. Default: 64; with weights up to 192, until it holds 99 % of their square, and
        what they scatter from further is at most 1 % of C_l.
    nthreads
        Number of threads.
    workers
        Number of processes, the address of a running Dask scheduler, or a ``distributed.Client``, among whose workers
        the pairs of maps are shared out; default: this process.

    Returns
    -------
    xarray.Dataset
        With the layout of :func:`mcsim.open_summary`, so that the two subtract: ``{biposh, cl}{, _circular,
        _difference}_mean`` in uK^2, raw and binned. ``_standard_deviation`` and ``_standard_error`` are those of an
        isotropic sky with even noise, the error for ``ensemble.realizations`` of the configuration; uneven hits and
        the anisotropy that the beam makes change them by some per cent, up to 10 % for an axis ratio of 1.33 (Notes).
        Of the difference to the circular-beam control, whose scatter is not that of an isotropic sky, they are NaN.
        Attributes state what is neglected.

    Raises
    ------
    InputError
        For a configuration without a spectrum, or with files that cannot be used.

    Notes
    -----
    Signal: :mod:`mcsim.bipolar.theory`, from b_lm, the spin harmonics of the moments w_s (exact ones for parallel
    transport) and C_l. The pixel window multiplies the beam and divides the result of the analysis. The scan couples
    degrees in between, so it cancels only in part. Noise of variance v(n) per pixel adds v_LM times the pixel area to
    the autos. Weights W(n) (masks, unobserved pixels) replace w_0 = 1 by W and w_s by W w_s in the sum over L1 and L2,
    divided by <W_x W_y>: the BipoSH that they give an isotropic sky are those of the circular-beam control. Degrees of
    weights beyond ``L_moments`` count in C_l, and with it in errors, but not in the means of L > 0: a warning says
    where these lack more than a tenth of the spectrum (behind a sharp mask, where the beam ends it). Steps of a
    preparation in harmonics multiply the noise before them by their windows at l1 and l2, or, where the maps are
    masked after them, make it an isotropic sky that the weights couple; noise that is uneven there is refused. Filtered
    maps have the means of the full sky without the mean field, and the noise of the pixels as the filter weights them.
    Variances are C_l1 C_l2 (1 + delta_l1l2), of pairs C^XX_l1 C^YY_l2 + (-1)^L delta_l1l2 (C^XY_l)^2, each term times
    what the weights make of it (:func:`mcsim.bipolar.theory.overlap`), of bins with the correlation of degrees.
    They lack what uneven hits and the beam's own anisotropy make: of 1,000 skies at nside 16, l = 8 to 38, variances of
    modes with L = 2 were 0.94 to 1.08 of the predicted ones through a round beam with the hits of a WMAP-like year, and
    0.88 to 1.18 through an ellipse of 480 by 360 arcmin.
    Behind masks errors of single modes were right within 4 % rms, 14 % at l < 6 and in bins with these, where some were
    0.6 to 1.7 of the prediction; over all M variances within 5 % and 20 %. Where a sharp mask scatters power into a
    degree they are too small: 1.1, 1.3, 1.5 and 2 times where that is 0.2, 0.4, 0.5 and 0.7 of its spectrum, 3 to 4
    times where it is all; a warning says so from 0.3 on. Signal to noise is that of independent degrees of a fraction
    f_sky = <W_x W_y>^2 / <W_x^2 W_y^2> of the sky, on which two maps with different masks have less in common. Errors
    of filtered maps are of this kind, too, and the same for all M.
    Ensembles agree within their errors: tests/integration/test_prediction.py, and test_prediction_pairs.py for pairs,
    noise and masks.

    Examples
    --------
    >>> import mcsim
    >>> expected = mcsim.predict("tiny")
    >>> float(expected.biposh_mean.sel(mode="L2M0d0", pair="demo,demo", ell=20).real) > 0.0
    True
    """
    check_truth(exact, "exact")
    check_truth(snr, "snr")
    if L_moments is not None:
        check_whole(L_moments, "L_moments", 1)
    check_whole(nthreads, "nthreads", 1)
    survey = survey_of(source, nthreads)
    power.check(survey)
    power.check_not_empty(survey, survey.cl)
    L_moments = moments_needed(survey, exact, L_moments)
    beams = scanned_beams(survey, L_moments, nthreads)

    def found_for(whole: Survey, pairs: Pairs) -> dict[tuple[int, int], Means]:
        if workers is None:
            return {pair: means(whole, beams, pair, exact, nthreads) for pair in pairs}
        return _shared_out(whole, list(pairs), exact, L_moments, workers)

    found = found_for(survey, survey.pairs)
    result = _dataset(survey, found)
    result.attrs |= _attributes(survey, exact, L_moments)
    _warn_of_scattered(survey, found, L_moments)
    if not snr:
        return result
    # The joint information of all maps needs every pair in both orders, whatever pairs the ensemble keeps.
    every, whole = found, survey
    if len(beams) > 1 and survey.config.biposh.pairs != "all":
        whole = replace(survey, estimator=estimator(survey.config.biposh.L_max, survey.lmax, both_orders=True))
        every = found_for(whole, [(x, y) for x in range(len(beams)) for y in range(x, len(beams))])
    return result.assign(
        detectability.variables(survey, found, detectability.joint_signal_to_noise(whole, beams, every))
    )


@dataclass(frozen=True)
class _Job:
    """What the means of all pairs have in common: the configuration as JSON, its digest, the driver's packages."""

    text: str
    digest: str
    packages: tuple[tuple[str, str], ...]
    both_orders: bool
    exact: bool
    L_moments: int


def _shared_out(
    survey: Survey, pairs: list[tuple[int, int]], exact: bool, L_moments: int, workers: "Workers"
) -> dict[tuple[int, int], Means]:
    """Return the means of pairs of maps, computed by workers."""
    from mcsim.ensemble import runner  # dask takes long to load

    run, both = survey.config, any(not mode.in_auto for mode in survey.estimator.modes)
    job = _Job(config.to_json(run), config.digest(run), packages(), both, exact, L_moments)
    with runner.connected(workers) as client:
        done = dict(runner.completed(client, pair_means, [(job, pair) for pair in pairs]))
    return {pair: done[index] for index, pair in enumerate(pairs)}


def pair_means(job: _Job, pair: tuple[int, int]) -> Means:
    """Return the means of a pair of maps; the task of a worker."""
    survey, beams = _scanned(job)
    return means(survey, beams, pair, job.exact)


@lru_cache(maxsize=2)
def _scanned(job: _Job) -> tuple[Survey, tuple[ScannedBeam, ...]]:
    survey = shared_survey(job.text, job.digest, job.packages)
    tables = estimator(survey.config.biposh.L_max, survey.lmax, both_orders=job.both_orders)
    return replace(survey, estimator=tables), scanned_beams(survey, job.L_moments)


def _dataset(survey: Survey, found: dict[tuple[int, int], Means]) -> xr.Dataset:
    run, layout = survey.config, plan.layout(survey)
    mean: dict[str, NDArray] = {
        "biposh": np.stack([found[pair].beam + found[pair].noise for pair in survey.pairs]),
        "biposh_circular": np.stack([found[pair].circular + found[pair].noise for pair in survey.pairs]),
        "biposh_difference": np.stack([found[pair].beam - found[pair].circular for pair in survey.pairs]),
    }
    monopole = survey.estimator.modes.index(detectability.MONOPOLE)
    control = {pair: replace(one, beam=one.circular) for pair, one in found.items()}
    variances = {}
    overlaps = [detectability.overlap_of(survey, pair) for pair in survey.pairs]
    for name, spectra in (("biposh", found), ("biposh_circular", control)):
        each = [
            detectability.variances_of(survey, spectra, pair, weights)
            for pair, weights in zip(survey.pairs, overlaps, strict=True)
        ]
        variances[name] = tuple(np.stack(arrays) for arrays in zip(*each, strict=True))
    # Its scatter is not that of an isotropic sky.
    variances["biposh_difference"] = tuple(np.nan * array for array in variances["biposh"])
    scatter: dict[str, NDArray] = {}
    comoment: dict[str, NDArray] = {}
    degrees = 2.0 * np.arange(survey.lmax + 1) + 1.0
    for name, (variance, of_bins) in variances.items():
        scatter[name], scatter[f"{name}_binned"] = variance, np.diagonal(of_bins, axis1=-2, axis2=-1)
        cl = name.replace("biposh", "cl")
        mean[cl] = detectability.cl_of(survey, mean[name][:, monopole])
        scatter[cl] = variance[:, monopole] / degrees
        mean[f"{name}_binned"] = summary.binned(layout, mean[name])
        if not name.endswith("difference"):
            comoment[f"{name}_binned"] = of_bins
    if survey.filtering is not None:
        for name in ("biposh", "biposh_circular", "biposh_difference"):
            numbers, bins = name.replace("biposh", summary.QML), survey.filtering.band_powers(mean[name])
            mean[numbers], scatter[numbers] = bins, np.full(bins.shape, np.nan)
    # Build the sums of two realizations with these variances, so that the summary's own code makes the dataset.
    result = summary.dataset(layout, Sums(2, mean, scatter, comoment), plan.attributes(run))
    for variable in result.data_vars.values():
        if "_standard_error" in str(variable.name):  # of both parts too
            variable.values[:] *= np.sqrt(2.0 / run.ensemble.realizations)
    result["count"].values[...] = run.ensemble.realizations
    return result


def _warn_of_scattered(survey: Survey, found: dict[tuple[int, int], Means], L_moments: int) -> None:
    """Warn of degrees whose power is mostly that of others, and has the scatter of theirs, or is not in all modes."""
    for number, (m, name) in enumerate(zip(survey.maps, survey.map_names, strict=True)):
        if m.weight is None or survey.filtering is not None or (number, number) not in found:
            continue
        left = divided(
            beyond_moments(survey, number, L_moments), detectability.total_cl(survey, found, (number, number))
        )
        if left.max() > LEFT_OUT:
            first, worst = int(np.argmax(left > LEFT_OUT)), int(np.argmax(left))
            warnings.warn(
                f"the mask of {name} scatters power over more than {L_moments} degrees, {100.0 * left[first]:.0f} % of "
                f"the spectrum at l = {first} and {100.0 * left[worst]:.0f} % at l = {worst}: C_l has it, but means of "
                f"L > 0 lack it; give more than L_moments = {L_moments}, apodise the mask, lower biposh.lmax, or take "
                "the means of an ensemble.",
                stacklevel=3,
            )
        share = detectability.scattered(survey, found, number)[LOWEST:]
        if share.size and share.max() > SCATTERED:
            first, worst = LOWEST + int(np.argmax(share > SCATTERED)), LOWEST + int(np.argmax(share))
            warnings.warn(
                f"the mask of {name} scatters power of other degrees into l >= {first}, {100.0 * share.max():.0f} % of "
                f"the spectrum at l = {worst}: behind a sharp edge errors of the prediction are too small there, 1.3 "
                "times where it is 40 %, 3 and more where it is nearly all; apodise the mask, lower biposh.lmax, or "
                "take the errors of an ensemble.",
                stacklevel=3,
            )


def _attributes(survey: Survey, exact: bool, L_moments: int) -> dict[str, Any]:
    run = survey.config
    order = f"all orders, w_s up to L = {L_moments}" if exact else "leading order in their non-circular part"
    mask, weights = "full sky", [m.weight for m in survey.maps if m.weight is not None]
    errors = "of an isotropic sky with even noise"
    if survey.filtering is not None:
        mask = "filtered by the inverse covariance: as on the full sky, but for the errors"
        errors += ", of independent degrees of the part that is observed, the same for all M"
    elif weights:
        errors += f", of each M behind the weights as at high l: some 14 % rms off at l < {LOWEST}"
        share = min(held(weight, L_moments)[L_moments] for weight in weights)
        mask = f"weights W up to L = {L_moments}, which hold {share:.3f} of their square; all of them in C_l"
        if share < COARSE:
            warnings.warn(
                f"the weights of the maps have {100.0 * (1.0 - share):.0f} % of their square beyond L = {L_moments}, "
                "which the prediction leaves out of all but C_l; apodise the mask, or give more L_moments.",
                stacklevel=3,
            )
    window, left_out = "none: rings without pixels", "nothing"
    if run.map.grid == "healpix":
        window = "divided out of a_lm by the analysis, so it cancels but for the noise"
        left_out = "centroid offsets of the samples in a pixel, quadrature error of the analysis"
    if dipoles := dipoles_left(survey):
        left = ", ".join(f"{name}: {left_uk:.3g} uK" for name, left_uk in dipoles.items())
        own = f"dipole that effects leave in samples ({left})"
        left_out = own if left_out == "nothing" else f"{own}, {left_out}"
        warnings.warn(
            f"effects on the beam leave some of the dipole in samples ({left}), which predictions leave out: an "
            "ensemble has more power at the lowest degrees; compare it with sky.dipole_uk = 0 in both.",
            stacklevel=3,
        )
    return {
        "name": run.name,
        "prediction": f"from b_lm of the beams, {order}",
        "frame": survey.frame,
        "digest": config.digest(run),
        "f_sky": min(detectability.sky_fraction(survey, pair) for pair in survey.pairs),
        "mask": mask,
        "errors": errors,
        "pixel_window": window,
        "left_out": left_out,
    }
