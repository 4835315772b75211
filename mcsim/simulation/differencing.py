"""Maps of one sky from the differences of two beams: side maps, right-hand sides, conjugate gradients."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.simulation import convolve, mapmaking
from mcsim.simulation.channels import scan_model
from mcsim.simulation.survey import Channel, SideB, SurveyMap
from mcsim.sphere import rng

Map = NDArray[np.float64]

SECONDS_PER_SAMPLE = 1.5e-7
"""Time of one core for a difference: 100 ns for two right-hand sides, the rest for 26 iterations (W1, nside 128)."""


def sides(run: config.RunConfig) -> dict[str, str]:
    """Say in words what stands for the beam of side B of every differencing channel."""
    return {
        channel.name: "side A's beam mirrored, x -> -x, b_lm -> (-1)^m conj(b_lm)"
        if channel.beam_b is None
        else "its own beam (beam_b)"
        for channel in run.channels
        if isinstance(channel.scan, config.ScanDifferencing)
    }


def seconds(run: config.RunConfig) -> float:
    """Estimate the time that one realization of all differencing channels takes one core."""
    splits = run.map.splits or (None,)
    models = [
        (scan_model(channel, channel.scan, splits[0]), channel.scan.pair)
        for channel in run.channels
        if isinstance(channel.scan, config.ScanDifferencing)
    ]
    surveys = len(splits) if run.map.split_by == "sets" else 1
    return SECONDS_PER_SAMPLE * surveys * sum(model.samples(model.pair(pair)[0]) for model, pair in models)


def maps(
    channel: Channel,
    sky: NDArray[np.complex128],
    dipole: NDArray[np.complex128] | None,
    seed: int,
    realization: int,
    nthreads: int = 1,
) -> Iterator[tuple[SurveyMap, Map, Map]]:
    """Yield the maps of a differencing channel, in two parts, for every split of its survey.

    The first is what the circular parts of both beams see, each side its own, and the noise; the second what the rest
    of the beams adds: uK, shape (npix,), 0 where nothing was observed. ``sky`` has coefficients up to its lmax, uK, and
    of ``dipole`` in it the fiducial beams take off the differences what they see. Seed and realization fix the noise.
    A RuntimeError says that the conjugate gradients do not converge.

    Notes
    -----
    Map-making is linear, so the circular-beam control and what the rest of the beams adds are solved for apart, each to
    the tolerance asked for relative to itself: the paired difference does not inherit the residual of the much larger
    control. The control starts from the mean of the two circular maps, which is the solution itself where these are
    equal and there is no noise.
    """
    side_b, nside = channel.side_b, channel.site.nside
    assert side_b is not None  # the caller has told the channels apart
    whole_a, whole_b = (mapmaking.side_maps(sky, r, nside, nthreads) for r in (channel.response, side_b.response))
    circular_a, circular_b = whole_a[:, :1], whole_b[:, :1]
    start = 0.5 * (circular_a[:, 0] + circular_b[:, 0])
    skies, x = [(circular_a, circular_b), (whole_a, whole_b)], side_b.scan.transmission_imbalance
    removed = None
    if dipole is not None:
        fiducial = [
            convolve.response(b, channel.site.lmax, channel.window) for b in (channel.site.beam, side_b.fiducial)
        ]
        dipole_a, dipole_b = (mapmaking.side_maps(dipole, response, nside, nthreads) for response in fiducial)
        removed = [(dipole_a, dipole_b)]
    for m in channel.maps:
        assert m.pairs is not None  # as of every map of such a channel
        noise = mapmaking.DifferenceNoise(side_b.sigma0_uk, rng.generator(seed, realization, f"noise/{m.name}"))
        imbalance = mapmaking.Imbalance(side_b.imbalance, x)
        control, complete = mapmaking.rhs_from_maps(m.pairs, skies, imbalance, noise, nthreads)
        if removed is not None:
            known = mapmaking.rhs_from_maps(m.pairs, removed, mapmaking.Imbalance(x), nthreads=nthreads)[0]
            control, complete = control - known, complete - known
        circular = _solve(m, side_b, control, start, "the circular-beam control", nthreads)
        yield m, circular, _solve(m, side_b, complete - control, None, "the non-circular part", nthreads)


def _solve(m: SurveyMap, side_b: SideB, rhs: Map, start: Map | None, what: str, nthreads: int) -> Map:
    assert m.pairs is not None  # as of every map of such a channel
    chosen = side_b.scan
    x, rule = chosen.transmission_imbalance, mapmaking.StoppingRule(chosen.tolerance, chosen.max_iterations)
    map_uk, report = mapmaking.solve(m.pairs, rhs, x, rule, start, nthreads)
    if side_b.iterations_short > 0 and report.converged:
        short = replace(rule, max_iterations=max(report.iterations - side_b.iterations_short, 0))
        map_uk, _ = mapmaking.solve(m.pairs, rhs, x, short, start, nthreads)
    if not report.converged:
        raise RuntimeError(
            f"map {m.name}, {what}: the map-making reached a relative residual of {report.relative_residual:.2g} in "
            f"{report.iterations} iterations, not the tolerance {chosen.tolerance:g}; raise max_iterations, or "
            "lengthen the survey until it connects the whole sky"
        )
    return np.where(m.moments.hits > 0.0, map_uk, 0.0)
