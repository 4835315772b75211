"""The whole survey sample by sample, effects and all: the time-ordered reference of each realization."""

from collections.abc import Iterator
from dataclasses import replace

import healpy
import numpy as np

from mcsim import config, systematics
from mcsim.errors import InputError
from mcsim.instrument.scan import MapGrid
from mcsim.simulation import simulate, tod
from mcsim.simulation.survey import Channel, Survey
from mcsim.sphere import rng
from mcsim.sphere.sky import dipole_alm
from mcsim.support.arrays import Map

EPSILON = 1e-7
"""Accuracy asked of the interpolation, relative to sky and dipole together: 0.3 nK. 1e-9 takes half as long again."""


def maps(survey: Survey, realization: int, nthreads: int = 1, epsilon: float = EPSILON) -> list[tuple[str, Map]]:
    """Return names and maps of one realization, each the plain mean of its samples, in the order of the survey's.

    The maps are in uK, shape (npix,), ``healpy.UNSEEN`` where nothing was observed. The sky and what effects draw are
    those of :func:`mcsim.simulation.simulate.maps`, the noise is a draw of its own, of samples or, where the run gives
    it for pixels, of the map. The threads of the interpolation do not change the result; its accuracy ``epsilon`` is
    relative to the dipole where there is one. InputError as of :func:`check`.

    Notes
    -----
    For every sample: its true pointing (moved, or earlier), the sky and the dipole through the true beam there, times
    one plus the error of the gain, less the dipole through the fiducial beam at the fiducial pointing, plus what
    effects add to samples, plus noise.
    An effect acts by its ``moved`` and ``lags`` where it has them, else by the beam that its ``pointing`` gives.
    """
    run, sky = survey.config, simulate.draw_sky(survey, realization)
    found = []
    for channel, spec in zip(survey.making.channels, run.channels, strict=True):
        check(channel)
        site, acting = channel.site, channel.effects
        seen = systematics.looked_at(acting, sky, site, run.ensemble.seed, realization)
        after: list[tod.Stage] = []
        if site.dipole_uk.any() and acting:
            seen = seen + dipole_alm(site.dipole_uk, site.lmax)
            fiducial = replace(site.beam, blm=site.beam.blm[:2, :2])
            after.append(tod.sky_signal(-dipole_alm(site.dipole_uk, 1), 1, fiducial, epsilon, nthreads))
        beam = systematics.seen_through(acting, site, [effect for effect in acting if not systematics.reach(effect)])
        observe = tod.sky_signal(seen, site.lmax, beam, epsilon, nthreads)
        for index, m in enumerate(channel.maps):
            grid = MapGrid(site.nside, site.frame, run.map.span(index))
            steady = systematics.shared_gain(acting, replace(site, split=run.map.each_split[index]))
            stages = [_gained(acting, site, steady), *after, _added(acting, site)]
            if (rings := run.map.rings(index)) is not None:
                stages.append(tod.every_ring(site.pointed("of rings").model.spin_period_s, *rings))
            draw = rng.generator(run.ensemble.seed, realization, f"noise/{m.name}")
            given = spec.noise_of(run.map.each_split[index])
            of_samples = isinstance(given, config.Noise) and given.hits is None
            if isinstance(given, config.Noise) and of_samples and given.sigma0_uk > 0.0:
                stages.append(tod.white_noise(given.sigma0_uk, draw, _noise_factor(channel)))
            for effect, own in systematics.disturbing(acting):
                draw = rng.generator(run.ensemble.seed, realization, f"{own}/noise/{m.name}")
                stages.append(_disturbed(effect, draw))
            stream = tod.through(_seen(channel, grid, observe), stages)
            map_uk = tod.bin_samples(stream, site.nside)[0]
            if not of_samples:
                noise = 0.0 if m.noise_uk is None else m.noise(run.ensemble.seed, realization)
                map_uk = np.where(m.moments.hits > 0, map_uk + noise, healpy.UNSEEN)
            found.append((m.name, map_uk if m.preparation is None else m.preparation.apply(map_uk)))
    return found


def check(channel: Channel) -> None:
    """Raise InputError for a channel that cannot be simulated sample by sample.

    That is one without known pointing, of a differencing scan, or with an effect on orientation moments.
    """
    if channel.side_b is not None or channel.site.pointing is None:
        raise InputError(
            f"channel {channel.name} cannot be simulated sample by sample: its scan differences two beams, or when it "
            'pointed where is not known; give it a scan of kind "hit_averaged", or moments with a scan model.'
        )
    for effect in channel.effects:
        if systematics.acts_through(effect, "orientations"):
            raise InputError(
                f"effect {effect.name} on channel {channel.name} acts on orientation moments, which samples do not "
                "have; leave it out where the survey is simulated sample by sample."
            )


def _fiducial(channel: Channel, grid: MapGrid, delay_s: float = 0.0) -> Iterator[tod.Samples]:
    """Yield the channel's samples at their fiducial pointing, or at that of ``delay_s`` before."""
    pointing = channel.site.pointed("of sampled maps")
    return tod.samples(pointing.model.ahead(-delay_s), pointing.line, grid)


def _seen(channel: Channel, grid: MapGrid, observe: tod.Stage) -> Iterator[tod.Samples]:
    """Yield the signal at the true pointings, on samples that keep the fiducial ones."""
    lags = [(1.0, 0.0)]
    for effect in channel.effects:
        more = effect.lags()
        if more is not None:
            lags = [(weight * w, delay + d) for weight, delay in lags for w, d in more]
    in_place = systematics.spread_of(channel.effects) == 1.0 and not any(map(systematics.reach, channel.effects))
    if len(lags) == 1 and in_place:
        yield from observe(_fiducial(channel, grid))
        return
    streams = [observe(_true(channel, grid, delay)) for _, delay in lags]
    for chunk, *true in zip(_fiducial(channel, grid), *streams, strict=True):
        signal = sum((w * each.signal_uk for (w, _), each in zip(lags, true, strict=True)), start=0.0)
        yield replace(_spread(channel, chunk, chunk), signal_uk=np.asarray(signal))


def _true(channel: Channel, grid: MapGrid, delay_s: float) -> Iterator[tod.Samples]:
    """Yield true directions and orientations."""
    references = None
    if delay_s != 0.0 and systematics.spread_of(channel.effects) != 1.0:
        references = _fiducial(channel, grid)
    for chunk in _fiducial(channel, grid, delay_s):
        theta, phi, psi = chunk.theta, chunk.phi, chunk.psi
        for effect in reversed(channel.effects):  # the first one is the nearest to the beam
            moved = effect.moved(theta, phi, psi)
            if moved is not None:
                theta, phi, psi = moved
        reference = chunk if references is None else next(references)
        yield _spread(channel, replace(chunk, theta=theta, phi=phi, psi=psi), reference)


def _spread(channel: Channel, chunk: tod.Samples, reference: tod.Samples) -> tod.Samples:
    """Move samples as an effect on their spread moves the reference towards the centres of its pixels."""
    return tod.shrunk(chunk, channel.site.nside, systematics.spread_of(channel.effects), reference)


def _gained(acting: tuple[systematics.Effect, ...], site: systematics.Site, steady: float) -> tod.Stage:
    """Return a stage that multiplies the signal by one plus the errors of the gain, one of which is ``steady``."""

    def gained(chunk: tod.Samples) -> Map:
        gain = np.full(chunk.time_s.size, 1.0 + steady)
        for effect in acting:
            error = effect.gain(chunk.time_s, site)
            if error is not None:
                gain = gain + error
        return gain * chunk.signal_uk

    return tod.with_signal(gained)


def _added(acting: tuple[systematics.Effect, ...], site: systematics.Site) -> tod.Stage:
    """Return a stage that adds the signals of effects."""
    found = systematics.adding(acting)

    def added(chunk: tod.Samples) -> Map:
        signals = (effect.signal(chunk.time_s, chunk.theta, chunk.phi, chunk.psi, site) for effect in found)
        return sum(signals, start=chunk.signal_uk)

    return tod.with_signal(added)


def _disturbed(effect: systematics.Effect, draw: np.random.Generator) -> tod.Stage:
    """Return a stage that adds an effect's noise to every sample."""
    return tod.with_signal(lambda chunk: chunk.signal_uk + effect.excess(np.ones(chunk.time_s.size), draw))


def _noise_factor(channel: Channel) -> Map | None:
    """Return the factor of the noise per sample in every pixel, shape (npix,); None: one."""
    factor = systematics.variance_factor(channel.effects, channel.site)
    return None if factor is None else np.sqrt(factor)
