"""The limit of a model before any data: sigma of every effect, detectable amplitudes, what can be told apart."""

import os
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mcsim import config, systematics
from mcsim.datavector.analysis import Analysis, analysis_of, check_asked
from mcsim.datavector.candidate import Candidate, numbered
from mcsim.datavector.same_skies import makes_means
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.errors import InputError
from mcsim.information import figure
from mcsim.information.dense import dense, size_of
from mcsim.information.derivatives import derivatives
from mcsim.information.fisher import Information, Probes, group_of, stochastic
from mcsim.information.result import Limits, check_replaced, limits_of
from mcsim.information.settings import LimitSettings
from mcsim.simulation import convolve
from mcsim.simulation.channels import refuse_external
from mcsim.simulation.inverse_covariance import InverseCovariance, ObservedMap
from mcsim.simulation.map_filter import unknown_dipole
from mcsim.simulation.nuisance import nuisances_of
from mcsim.simulation.preparation import keeps_pixels, templates_of
from mcsim.simulation.survey import Channel, survey
from mcsim.support import folders, page
from mcsim.support.arrays import Cl, Vector, divided
from mcsim.support.numbers import duration
from mcsim.support.progress import reporting
from mcsim.support.settings import settings_of

DOTS_PER_INCH = 100

MOST = 3e6  #: rms of the sky over the noise of a pixel; at 3e7 sigma of a noise level is a sixth of what it is

RESPONSE = 3.0  #: cost of a response over that of the circular maps of a sky, on average over the library


def limit(
    model: str | Path | Mapping[str, Any] | config.RunConfig,
    output: str | Path | None = None,
    *,
    settings: LimitSettings | None = None,
    quiet: bool = True,
) -> Limits:
    """Compute what any analysis of a model's maps could measure at best, before any data.

    Parameters
    ----------
    model
        Fiducial model of sky, beams, scan, noise, mask and splits: a run.
    output
        Folder for ``limit.json``, ``limit.zarr`` and ``limit.png``, in place of earlier ones of the same model; None:
        nothing is written.
    settings
        Effects, nuisances, levels, random probes; default: those of :class:`mcsim.LimitSettings`.
    quiet
        Report no progress.

    Returns
    -------
    Limits
        For every effect the standard error of its amplitude, the amplitude that is detected, and that at which it is
        told apart from the most similar other one; and the Fisher matrix behind them.

    Raises
    ------
    InputError
        If the run has no white noise, no spectrum or no pixels, prepares its maps by more than fits that are
        subtracted and masks of zeros and ones, an effect is not known, or the folder has the limit of another model.

    Notes
    -----
    The Fisher information of all maps jointly, the sky common to them and unknown, F_ij = 1/2 Tr[C^-1 dC_i C^-1 dC_j] +
    dmu_i' C^-1 dmu_j (Tegmark, Taylor & Heavens 1997, ApJ 480, 22, eq. 15), by random probes
    (:mod:`mcsim.information.fisher`) or from whole matrices (:mod:`mcsim.information.dense`). No unbiased estimate has
    a smaller error (Cramer and Rao). Checked against numerical derivatives of the likelihood, and against the sum over
    BipoSH coefficients for one map: tests/unit/test_information.py.

    Examples
    --------
    >>> import mcsim
    >>> run = {
    ...     "schema": 1,
    ...     "name": "one map",
    ...     "sky": {"spectrum": "wmap7", "lmax": 8},
    ...     "map": {"nside": 4},
    ...     "channel": [
    ...         {
    ...             "name": "W1",
    ...             "frequency_ghz": 94.0,
    ...             "beam": {"kind": "gaussian", "fwhm_arcmin": 1200.0},
    ...             "noise": {"sigma0_uk": 10.0},
    ...             "scan": {"kind": "parallel_transport"},
    ...         }
    ...     ],
    ... }
    >>> found = mcsim.limit(run, settings=mcsim.LimitSettings(only=("noise_level",), dense=True))
    >>> found.effects[0].name, round(float(found.effects[0].sigma), 2)
    ('noise_level', 0.07)
    """
    run = config.load(model)
    settings = settings_of(settings, LimitSettings)
    if output is not None:
        output = folders.user_path(output)
        folders.writable(output)
        check_replaced(output, run.name)
    nthreads = os.cpu_count() or 1
    run, settings = _with_declared(run, settings)
    analysis, candidates = _candidates(run, settings, nthreads)
    filtered = inverse_covariance(analysis, run, settings, nthreads)
    total = sum(len(candidate.columns) for candidate in candidates)
    cl = analysis.model.survey.cl
    assert cl is not None  # a model of the analysis has one
    with reporting("derivatives of the maps", total, "components", quiet) as report:
        changes = []
        for number, derivative in enumerate(derivatives(analysis, candidates, filtered.observe, nthreads), 1):
            changes.append(derivative)
            report(number)
    if settings.dense:
        with reporting("whole matrices", total, "components", quiet) as report:
            information: Information = dense(filtered, changes, cl, report)
        method = "From whole matrices"
    else:
        steps = settings.probes * total
        with reporting("random probes", steps, "responses", quiet) as report:
            information = stochastic(filtered, changes, cl, Probes(settings.probes, settings.seed), report)
        method = f"From {settings.probes} random probes"
    if any(m.templates is not None for m in filtered.maps):
        method += ", marginalised over what [[preparation]] subtracts from the maps"
    tests = sum(not _is_nuisance(candidate, settings) for candidate in analysis.candidates)
    found = limits_of(candidates, information, tests, method, run.name, settings)
    if not cl[:2].any() and not settings.unknown_dipole_uk and all(m.templates is None for m in filtered.maps):
        site = analysis.model.survey.channels[0].site
        found = replace(found, no_dipole=tuple(c.title for c in candidates if makes_means(c.basis[0], site)))
    if output is not None:
        found.save(output, page.png(figure.limit_figure(found), DOTS_PER_INCH))
    return found


def describe(run: config.RunConfig, settings: LimitSettings) -> str:
    """Return a text on the cost of a limit: components, probes, transforms, memory and time."""
    run, settings = _with_declared(run, settings)
    analysis, candidates = _candidates(run, settings, nthreads := os.cpu_count() or 1)
    filtered = inverse_covariance(analysis, run, settings, nthreads)
    columns, count = sum(len(candidate.columns) for candidate in candidates), len(filtered.maps)
    head = f"{run.name}: {len(candidates)} effects of {columns} components, {count} map{'s' if count > 1 else ''}"
    if settings.dense:
        size = size_of(filtered, columns)
        return f"{head}\n  memory  {size.bytes / 1e9:.3g} GB for {size.pixels} pixels and {size.modes} modes of the sky"
    probes = Probes(settings.probes)
    memory = 8.0 * filtered.precision.size * (group_of(probes, filtered) + 4 * columns)
    start = time.perf_counter()
    filtered.wiener(filtered.observe(np.ones(filtered.size, dtype=complex)))
    solved_s = time.perf_counter() - start
    start = time.perf_counter()
    filtered.observe(np.ones(filtered.size, dtype=complex))
    made_s = time.perf_counter() - start
    solutions = probes.number + columns
    total_s = solutions * solved_s + RESPONSE * made_s * columns * probes.number
    return "\n".join(
        [
            head,
            f"  probes  {probes.number}: {columns * probes.number} responses, {solutions} solutions of the inverse "
            f"covariance of {solved_s:.3g} s each",
            f"  memory  {memory / 1e9:.2f} GB",
            f"  time    about {duration(total_s)} with {nthreads} threads",
        ]
    )


def widths(given: Iterable[str]) -> dict[str, float]:
    """Return nuisances from texts ``EFFECT=WIDTH`` or ``EFFECT:CHANNEL=WIDTH``; InputError for anything else."""
    found = {}
    for text in given:
        name, _, width = text.partition("=")
        try:
            found[name] = float(width)
        except ValueError:
            raise InputError(f"nuisance {text!r} says no width; give EFFECT=WIDTH, as in beam_width=0.01.") from None
    return found


def inverse_covariance(
    analysis: Analysis, run: config.RunConfig, settings: LimitSettings, nthreads: int = 1
) -> InverseCovariance:
    """Return the inverse covariance of the maps of an analysis, masked and fitted as the preparation of a run does it.

    InputError for a channel without noise, and for other preparations.
    """
    shared = analysis.model.survey
    prepared = survey(run, nthreads=nthreads, library=dict(analysis.library)) if run.preparation else shared
    if not keeps_pixels(prepared.preparations):
        raise InputError(
            "the limit is that of white noise in the pixels of maps, which [[preparation]] changes; leave out its "
            "steps but for templates and dipoles that are fitted and subtracted, and masks of zeros and ones."
        )
    assert shared.cl is not None  # a model of the analysis has one
    cl = unknown_dipole(shared.cl, settings.unknown_dipole_uk)
    made = [(channel, m) for channel in shared.channels for m in channel.maps]
    maps = []
    for (channel, m), analysed, templates in zip(made, prepared.maps, templates_of(prepared.preparations), strict=True):
        if channel.side_b is not None:
            raise InputError(
                f"channel {channel.name} reads differences of two beams, whose maps have noise that is not white; "
                'describe the map by a scan of kind "hit_averaged" or "moments".'
            )
        if m.drawn is not None:
            raise InputError(
                f"the noise of map {m.name} is not white, and the limit is that of white noise; give channel "
                f'{channel.name} noise of kind "white", "depth", "variance" or "difference".'
            )
        if m.noise_uk is None:
            raise InputError(
                f"map {m.name} has no noise, so that nothing limits it; give channel {channel.name} noise "
                "(noise.sigma0_uk or noise.depth_uk_arcmin above 0)."
            )
        _refuse_lost_in_rounding(channel, m.name, m.noise_uk[m.moments.hits > 0], cl)
        seen = m.moments.hits > 0 if analysed.weight is None else (m.moments.hits > 0) & (analysed.weight > 0.0)
        response = convolve.Response(channel.response.factors[: settings.orders + 1])
        moments = m.moments if settings.orders else None
        maps.append(ObservedMap(response, divided(seen, m.noise_uk**2), moments, templates))
    return InverseCovariance(cl, maps, settings.tolerance, nthreads)


def _refuse_lost_in_rounding(channel: Channel, name: str, noise_uk: Vector, cl: Cl) -> None:
    """Raise InputError for a map whose sky is so far above its noise that sums of both have lost that."""
    seen = np.abs(channel.response.factors[0]) ** 2 * cl
    rms = float(np.sqrt((2 * np.arange(cl.size) + 1) @ seen / (4.0 * np.pi)))
    if rms > MOST * (least := float(np.min(noise_uk[noise_uk > 0.0], initial=np.inf))):
        raise InputError(
            f"map {name} has noise of {least:.2g} uK in a pixel under a sky of {rms:.2g} uK, a ratio of "
            f"{rms / least:.2g}, and beyond {MOST:g} rounding is more than the noise; give channel {channel.name} more "
            "(noise.sigma0_uk or noise.depth_uk_arcmin)."
        )


def _with_declared(run: config.RunConfig, settings: LimitSettings) -> tuple[config.RunConfig, LimitSettings]:
    """Return a run without its nuisances, and settings with them; InputError for one that settings cannot hold."""
    found = {}
    library = dict(systematics.catalogue() if settings.library is None else systematics.checked(settings.library))
    for one in nuisances_of(run, library):
        library[one.effect.name] = one.effect
        name = one.effect.name if one.channel is None else f"{one.effect.name}:{one.channel}"
        if one.settings or one.parameter_widths or len(set(one.widths)) > 1:
            every = ", which is one for each split" if "split" in one.settings else ""
            raise InputError(
                f"nuisance {name} of the run has parameters, or several widths, and a limit knows one width for an "
                f"effect; leave the table out, and give --nuisance {name}={max(one.widths):g}{every}."
            )
        found[name] = float(one.sigma[0])
    for text, width in settings.nuisances.items():
        name, colon, channel = text.partition(":")
        if name.endswith(".py"):
            kind = systematics.get(name)
            name, library[kind.name] = kind.name, kind
        found[f"{name}{colon}{channel}"] = width
    return replace(run, nuisances=()), replace(settings, library=library, nuisances=found)


def _candidates(
    run: config.RunConfig, settings: LimitSettings, nthreads: int
) -> tuple[Analysis, tuple[Candidate, ...]]:
    """Return the analysis with every effect that applies, and those that are asked for, nuisances included."""
    refuse_external(run)
    if settings.probes < 3:
        raise InputError(f"probes = {settings.probes} are too few to tell an error; give 3 or more.")
    if not 0.0 <= settings.unknown_dipole_uk < np.inf:
        raise InputError(f"unknown_dipole_uk = {settings.unknown_dipole_uk:g} is no rms; give 0 or more.")
    library = systematics.catalogue() if settings.library is None else settings.library
    asked = {name: systematics.get(name, library) for name in (*settings.only, *settings.without)}
    library = {**library, **{kind.name: kind for kind in asked.values()}}
    only, without = ([asked[name].name for name in names] for names in (settings.only, settings.without))
    if both := {*only} & {*without}:
        raise InputError(f"{min(both)} is asked for and left out (--only and --without); choose one of them.")
    settings = replace(settings, only=tuple(only), without=tuple(without))
    named = dict.fromkeys((*settings.only, *(name.partition(":")[0] for name in settings.nuisances)))
    for name in named:
        if name in library and systematics.acts_through(library[name], "excess"):
            raise InputError(
                f"{name} adds noise at random to samples, of which the limit knows nothing; ask for noise_level, whose "
                "response is nearly the same."
            )
    # The survey has the orientation moments of as many orders as a diagnosis measures.
    usual = DiagnosisSettings(including=tuple(name for name in named if name in library))
    more = max(0, settings.orders - usual.beam_orders)
    fits = replace(usual, beam_orders=usual.beam_orders + more, beam_bins=(*usual.beam_bins, *(1,) * more))
    # What is subtracted from maps is marginalised: derivatives are those of maps as they are made.
    analysis = analysis_of(replace(run, preparation=()), settings.without, nthreads, fits, library)
    known = {c.name for c in analysis.candidates}
    known |= {f"{c.name}:{c.channel}" for c in analysis.candidates if c.channel is not None}
    for name in settings.nuisances:
        if name not in known:
            raise InputError(f"nuisance {name!r} is no effect of this model; choose from {', '.join(sorted(known))}.")
    check_asked(analysis, settings.only)
    priors: dict[tuple[str, str | None], list[Candidate]] = {}
    wanted = []
    for candidate in analysis.candidates:
        if _is_nuisance(candidate, settings):
            priors.setdefault(candidate.identity, []).append(candidate)
        elif not settings.only or candidate.name in settings.only:
            wanted.append(candidate)
    wanted += [one for variants in priors.values() for one in _of_prior(variants)]
    for candidate in wanted:
        fit = candidate.parametrization
        if fit.stochastic and fit.mean_response and fit.sign >= 0:
            raise InputError(
                f"{candidate.name} changes the power of maps by fields that are drawn, and maps are not linear in its "
                "amplitude: they have no derivative at 0, of which a limit could be made; leave it out."
            )
    if all(_is_nuisance(candidate, settings) for candidate in wanted):
        raise InputError(
            f"no effect is left to compute a limit of (asked for: {', '.join(settings.only) or 'all'}), for all of "
            "them are nuisances; ask for one of "
            f"{', '.join(sorted({candidate.name for candidate in analysis.candidates}))}."
        )
    return analysis, numbered(wanted)


def _of_prior(variants: Sequence[Candidate]) -> list[Candidate]:
    """Return a nuisance in the coordinates of its prior: with the effect's own parameters, none of them fitted.

    One that acts in single splits is there in each of them.
    """
    columns = tuple(range(len(variants[0].effect.parametrization.basis())))
    own = variants if "split" in variants[0].settings else [replace(variants[0], settings={})]
    return [replace(one, columns=columns, fit=None) for one in own]


def _is_nuisance(candidate: Candidate, settings: LimitSettings) -> bool:
    return bool({candidate.name, f"{candidate.name}:{candidate.channel}"} & set(settings.nuisances))
