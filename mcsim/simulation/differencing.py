"""Maps of one sky from the differences of two beams: side maps, right-hand sides, conjugate gradients."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from mcsim import config
from mcsim.errors import RunError
from mcsim.simulation import convolve, mapmaking
from mcsim.simulation.channels import scan_model
from mcsim.simulation.survey import Channel, SideB, SurveyMap
from mcsim.sphere import rng
from mcsim.sphere.sky import dipole_alm
from mcsim.support.arrays import Alm, Map, Maps

Sides = tuple[mapmaking.SideMaps, mapmaking.SideMaps]

SECONDS_PER_SAMPLE = 1.5e-7
"""Time of one core for a difference: 100 ns for two right-hand sides, the rest for 26 iterations (W1, nside 128)."""

SECONDS_OF_PAIRS = 1.3e-7
"""Time of one core for a sample of one side when the pairs of pixels are made, once (:func:`mapmaking.prepare`)."""

FEW = 8
"""Iterations after which a map lacks some uK at the largest scales: where responses to stopping early are measured."""


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
    splits = run.map.each_split
    models = [
        (scan_model(channel, channel.scan, splits[0]), channel.scan.pair)
        for channel in run.channels
        if isinstance(channel.scan, config.ScanDifferencing)
    ]
    surveys = len(splits) if run.map.split_by == "sets" else 1
    return SECONDS_PER_SAMPLE * surveys * sum(model.samples(model.pair(pair)[0]) for model, pair in models)


def maps(
    channel: Channel, sky: Alm, dipole: Alm | None, seed: int, realization: int, nthreads: int = 1
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
    equal and there is no noise. A map-making that stops early is not linear: it starts from zeros, as one that does not
    know the sky, and is run for the control and for the whole.
    """
    short = _side_b(channel).iterations_short > 0
    whole = _side_maps(channel, sky, nthreads)
    circular = _circular(whole)
    start = None if short else _mean(circular)
    for m, (control, complete) in _rhs(channel, [circular, whole], dipole, (seed, realization), nthreads):
        smooth = _solve(m, channel, control, start, "the circular-beam control", nthreads)
        if short:
            yield m, smooth, _solve(m, channel, complete, None, "the whole beam", nthreads) - smooth
        else:
            yield m, smooth, _solve(m, channel, complete - control, None, "the non-circular part", nthreads)


def whole_maps(
    channel: Channel, sky: Alm, dipole: Alm | None, seed: int, realization: int, nthreads: int = 1
) -> Iterator[tuple[SurveyMap, Map]]:
    """Yield the sums of the two parts of :func:`maps`, solved for at once, in about half of the time.

    They differ by what the tolerance leaves: tests/integration/test_diagnosis_differencing.py. RunError says that the
    conjugate gradients do not converge.
    """
    whole = _side_maps(channel, sky, nthreads)
    start = None if _side_b(channel).iterations_short > 0 else _mean(whole)
    for m, (complete,) in _rhs(channel, [whole], dipole, (seed, realization), nthreads):
        try:
            yield m, _solve(m, channel, complete, start, "the whole beam", nthreads)
        except RuntimeError as error:
            raise RunError(f"{error}.") from error


def of_dipole(channel: Channel, imbalance: float) -> list[Map]:
    """Return what the dipole leaves in the maps where the true imbalance is another, uK, shape (npix,) each."""
    side_b = _side_b(channel)
    other = replace(channel, side_b=replace(side_b, imbalance=imbalance, sigma0_uk=0.0, iterations_short=0))
    dipole = dipole_alm(channel.site.dipole_uk, channel.site.lmax)
    return [map_uk for _, map_uk in whole_maps(other, dipole, dipole, 0, 0)]


def not_converged(channel: Channel, m: SurveyMap, sky_uk: Map) -> Map:
    """Return what the map of a sky, uK, shape (npix,), lacks after FEW iterations from zeros."""
    x, seen = _side_b(channel).scan.transmission_imbalance, m.moments.hits > 0.0
    map_uk = np.where(seen, sky_uk - (float(np.mean(sky_uk[seen])) if x == 0.0 else 0.0), 0.0)
    rule = mapmaking.StoppingRule(max_iterations=FEW)
    rhs = mapmaking.rhs_of_map(_pairs(m), map_uk, x)
    return np.where(seen, mapmaking.solve(_pairs(m), rhs, x, rule)[0] - map_uk, 0.0)


def iterations_to_spare(channel: Channel, sky: Alm) -> int:
    """Return how many iterations more than FEW the first map of a sky takes to converge, >= 1."""
    scan, m = _side_b(channel).scan, channel.maps[0]
    x, rule = scan.transmission_imbalance, mapmaking.StoppingRule(scan.tolerance, scan.max_iterations)
    sky_uk = convolve.circular_map(sky, channel.response, channel.site.nside)
    rhs = mapmaking.rhs_of_map(_pairs(m), np.where(m.moments.hits > 0.0, sky_uk, 0.0), x)
    return max(mapmaking.solve(_pairs(m), rhs, x, rule)[1].iterations - FEW, 1)


def _side_b(channel: Channel) -> SideB:
    assert channel.side_b is not None  # the caller has told the channels apart
    return channel.side_b


def _pairs(m: SurveyMap) -> mapmaking.DifferencingScan:
    assert m.pairs is not None  # as of every map of such a channel
    return m.pairs


def _side_maps(channel: Channel, sky: Alm, nthreads: int) -> Sides:
    a, b = channel.response, _side_b(channel).response
    return mapmaking.side_maps(sky, a, channel.site.nside, nthreads), mapmaking.side_maps(
        sky, b, channel.site.nside, nthreads
    )


def _circular(sides: Sides) -> Sides:
    """Return what the circular parts of both beams see."""
    return sides[0][:, :1], sides[1][:, :1]


def _mean(sides: Sides) -> Map:
    """Return the mean of what the circular parts of both beams see."""
    return np.asarray(0.5 * (sides[0][:, 0] + sides[1][:, 0]))


def _rhs(
    channel: Channel, skies: list[Sides], dipole: Alm | None, draw: tuple[int, int], nthreads: int
) -> Iterator[tuple[SurveyMap, Maps]]:
    """Yield every map with its right-hand sides, shape (skies, npix); ``draw`` has seed and realization.

    ``skies``: through the whole beams, and before that, if at all, through their circular parts.
    """
    side_b, nside = _side_b(channel), channel.site.nside
    x = side_b.scan.transmission_imbalance
    removed = None
    if dipole is not None:
        fiducial = [
            convolve.response(b, channel.site.lmax, channel.seen_window) for b in (channel.site.beam, side_b.fiducial)
        ]
        dipole_a, dipole_b = (mapmaking.side_maps(dipole, response, nside, nthreads) for response in fiducial)
        removed = [_circular((dipole_a, dipole_b)), (dipole_a, dipole_b)][-len(skies) :]
    for m in channel.maps:
        generator = rng.generator(*draw, f"noise/{m.name}")
        noise = mapmaking.DifferenceNoise(side_b.sigma0_uk, generator, side_b.noise_factor)
        imbalance = mapmaking.Imbalance(side_b.imbalance, x)
        found = mapmaking.rhs_from_maps(_pairs(m), skies, imbalance, noise, nthreads)
        if removed is not None:
            found = found - mapmaking.rhs_from_maps(_pairs(m), removed, mapmaking.Imbalance(x), nthreads=nthreads)
        yield m, found


def _solve(m: SurveyMap, channel: Channel, rhs: Map, start: Map | None, what: str, nthreads: int) -> Map:
    side_b = _side_b(channel)
    chosen = side_b.scan
    x, rule = chosen.transmission_imbalance, mapmaking.StoppingRule(chosen.tolerance, chosen.max_iterations)
    map_uk, report = mapmaking.solve(_pairs(m), rhs, x, rule, start, nthreads)
    if side_b.iterations_short > 0 and report.converged:
        short = replace(rule, max_iterations=max(report.iterations - side_b.iterations_short, 1))
        map_uk, _ = mapmaking.solve(_pairs(m), rhs, x, short, start, nthreads)
    if not report.converged:
        raise RuntimeError(
            f"map {m.name}, {what}: the map-making reached a relative residual of {report.relative_residual:.2g} in "
            f"{report.iterations} iterations, not the tolerance {chosen.tolerance:g}; raise max_iterations, or "
            "lengthen the survey until it connects the whole sky"
        )
    return np.where(m.moments.hits > 0.0, map_uk, 0.0)
