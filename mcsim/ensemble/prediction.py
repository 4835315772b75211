"""Prediction of an ensemble's means, errors and detectability from its configuration, without Monte Carlo."""

from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from mcsim import config
from mcsim.bipolar import estimator
from mcsim.ensemble import detectability, plan, summary
from mcsim.ensemble.expectation import L_MOMENTS, Means, Source, means, scanned_beams, survey_of
from mcsim.simulation import power
from mcsim.simulation.survey import Survey
from mcsim.stats.streaming import Sums


def predict(
    source: Source, exact: bool = False, snr: bool = False, L_moments: int = L_MOMENTS, nthreads: int = 1
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
        per bin, and ``_total`` of all maps jointly.
    L_moments
        Highest degree of the orientation moments if ``exact``; see :func:`mcsim.bipolar.theory.cmb_biposh_exact`.
    nthreads
        Number of threads.

    Returns
    -------
    xarray.Dataset
        With the layout of :func:`mcsim.open_summary`, so that the two subtract: ``{biposh, cl}{, _circular,
        _difference}_mean`` in uK^2, raw and binned. ``_standard_deviation`` and ``_standard_error`` are those of an
        isotropic sky, the error for ``ensemble.realizations`` of the configuration; of the difference to the circular-
        beam control, whose scatter is not that of an isotropic sky, they are NaN. Attributes state what is neglected.

    Raises
    ------
    InputError
        For a configuration without a spectrum, or with files that cannot be used.

    Notes
    -----
    Signal: :mod:`mcsim.bipolar.theory`, from b_lm, the spin harmonics of the moments w_s (exact ones for parallel
    transport) and C_l. The pixel window multiplies the beam and divides the result of the analysis. The scan couples
    degrees in between, so it cancels only in part. Noise of variance v(n) per pixel adds v_LM times the pixel area to
    the autos. Weights W(n) (masks, unobserved pixels) replace w_s by W^2 w_s, which holds for l far above their own
    scales; their own BipoSH of an isotropic sky is neglected, as in the paired difference.
    Variances are C_l1 C_l2 (1 + delta_l1l2) / f_sky, f_sky = <W_x W_y>^2 / <W_x^2 W_y^2>. Ensembles agree within their
    errors: tests/integration/test_prediction.py, and test_prediction_pairs.py for pairs, noise and masks.

    Examples
    --------
    >>> import mcsim
    >>> expected = mcsim.predict("tiny")
    >>> float(expected.biposh_mean.sel(mode="L2M0d0", pair="demo,demo", ell=20).real) > 0.0
    True
    """
    survey = survey_of(source, nthreads)
    power.check(survey)
    beams = scanned_beams(survey, L_moments if exact else survey.config.biposh.L_max, nthreads)
    found = {pair: means(survey, beams, pair, exact, nthreads) for pair in survey.pairs}
    result = _dataset(survey, found)
    result.attrs |= _attributes(survey, L_moments if exact else None)
    if not snr:
        return result
    # The joint information of all maps needs every pair in both orders, whatever pairs the ensemble keeps.
    every, whole = found, survey
    if len(beams) > 1 and survey.config.biposh.pairs != "all":
        whole = replace(survey, estimator=estimator(survey.config.biposh.L_max, survey.lmax, both_orders=True))
        pairs = [(x, y) for x in range(len(beams)) for y in range(x, len(beams))]
        every = {pair: means(whole, beams, pair, exact, nthreads) for pair in pairs}
    return result.assign(detectability.variables(survey, found, detectability.joint_signal_to_noise(whole, every)))


def _dataset(survey: Survey, found: dict[tuple[int, int], Means]) -> xr.Dataset:
    run, layout = survey.config, plan.layout(survey)
    mean: dict[str, NDArray] = {
        "biposh": np.stack([found[pair].beam + found[pair].noise for pair in survey.pairs]),
        "biposh_circular": np.stack([found[pair].circular + found[pair].noise for pair in survey.pairs]),
        "biposh_difference": np.stack([found[pair].beam - found[pair].circular for pair in survey.pairs]),
    }
    monopole = survey.estimator.modes.index(detectability.MONOPOLE)
    variance = np.stack([detectability.variance_of(survey, found, pair) for pair in survey.pairs])
    scatter = {name: np.full_like(variance, np.nan) if name.endswith("difference") else variance for name in mean}
    comoment: dict[str, NDArray] = {}
    degrees = 2.0 * np.arange(survey.lmax + 1) + 1.0
    for name in list(mean):
        spectra = name.replace("biposh", "cl")
        mean[spectra] = detectability.cl_of(survey, mean[name][:, monopole])
        scatter[spectra] = scatter[name][:, monopole] / degrees
        mean[f"{name}_binned"] = summary.binned(layout, mean[name])
        scatter[f"{name}_binned"] = variances = summary.binned(layout, scatter[name], power=2)
        if not name.endswith("difference"):
            comoment[f"{name}_binned"] = variances[..., None] * np.eye(variances.shape[-1])
    # Build the sums of two realizations with these variances, so that the summary's own code makes the dataset.
    result = summary.dataset(layout, Sums(2, mean, scatter, comoment), plan.attributes(run))
    for name in mean:
        result[f"{name}_standard_error"].values[:] = np.sqrt(scatter[name] / run.ensemble.realizations)
    result["count"].values[...] = run.ensemble.realizations
    return result


def _attributes(survey: Survey, L_moments: int | None) -> dict[str, Any]:
    run = survey.config
    order = "leading order in their non-circular part"
    if L_moments is not None:
        order = f"all orders, w_s up to L = {L_moments}"
    mask = "full sky"
    if any(m.weight is not None for channel in survey.channels for m in channel.maps):
        mask = "weights W act as w_s -> W^2 w_s and on the errors; their own mode coupling is left out"
    window, left_out = "none: rings without pixels", "nothing"
    if run.map.grid == "healpix":
        window = "divided out of a_lm by the analysis, so it cancels but for the noise"
        left_out = "centroid offsets of the samples in a pixel, quadrature error of the analysis"
    return {
        "name": run.name,
        "prediction": f"from b_lm of the beams, {order}",
        "frame": survey.frame,
        "digest": config.digest(run),
        "f_sky": min(detectability.sky_fraction(survey, pair) for pair in survey.pairs),
        "mask": mask,
        "pixel_window": window,
        "left_out": left_out,
    }
