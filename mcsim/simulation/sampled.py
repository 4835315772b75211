"""The whole survey sample by sample, effects and all: the time-ordered reference of each realization."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim import systematics
from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import ScanModel
from mcsim.instrument.scan.geometry import MapGrid
from mcsim.simulation import simulate, tod
from mcsim.simulation.survey import Channel, Survey
from mcsim.sphere import rng
from mcsim.sphere.sky import dipole_alm

Map = NDArray[np.float64]

EPSILON = 1e-9
"""Accuracy asked of the interpolation, relative to sky and dipole together."""


def maps(
    survey: Survey, realization: int, nthreads: int = 1, epsilon: float = EPSILON
) -> list[tuple[str, NDArray[np.float64]]]:
    """Return the maps of one realization, each the plain mean of its samples.

    Parameters
    ----------
    survey
        With channels whose pointing is known and whose scans do not difference.
    realization
        Index: the sky and what effects draw are those of :func:`mcsim.simulation.simulate.maps`, the noise is a draw
        of its own.
    nthreads
        Threads of the interpolation; they do not change the result.
    epsilon
        Accuracy of the interpolation, relative to the dipole where there is one.

    Returns
    -------
    list
        (name, map in uK, shape (npix,), ``healpy.UNSEEN`` where nothing was observed), in the order of
        ``survey.map_names``.

    Raises
    ------
    InputError
        For a channel without known pointing, a differencing scan, or an effect on orientation moments, which
        samples do not have.

    Notes
    -----
    For every sample: its true pointing (moved, or earlier), the sky and the dipole through the true beam there, times
    one plus the error of the gain, less the dipole through the fiducial beam at the fiducial pointing, plus noise.
    An effect acts by its ``moved`` and ``lags`` where it has them, else by the beam that its ``pointing`` gives.
    """
    sky = simulate.draw_sky(survey, realization)
    return [
        found
        for channel in survey.making.channels
        for found in _channel(survey, channel, sky, realization, nthreads, epsilon)
    ]


def _channel(
    survey: Survey, channel: Channel, sky: NDArray[np.complex128], realization: int, nthreads: int, epsilon: float
) -> Iterator[tuple[str, Map]]:
    run, site, acting = survey.config, channel.site, channel.effects
    check(channel)
    seed, nside = run.ensemble.seed, site.nside
    seen = systematics.looked_at(acting, sky, site, seed, realization)
    known = None
    if site.dipole_uk.any() and acting:
        seen = seen + dipole_alm(site.dipole_uk, site.lmax)
        known = tod.sky_signal(-dipole_alm(site.dipole_uk, 1), 1, _cut(site.beam, 1), epsilon, nthreads)
    observe = tod.sky_signal(seen, site.lmax, _beam(acting, site), epsilon, nthreads)
    sigma0 = next(spec.noise.sigma0_uk for spec in run.channels if spec.name == channel.name)
    for index, m in enumerate(channel.maps):
        share = (index / len(channel.maps), (index + 1) / len(channel.maps))
        stream = _gained(_seen(channel, share, observe), channel)
        if known is not None:
            stream = known(stream)
        if sigma0 > 0.0:
            stream = _noisy(stream, channel, sigma0, rng.generator(seed, realization, f"noise/{m.name}"))
        map_uk = tod.bin_samples(stream, nside)[0]
        yield m.name, map_uk if m.preparation is None else m.preparation.apply(map_uk)


def check(channel: Channel) -> None:
    """Raise InputError for a channel that cannot be simulated sample by sample."""
    if channel.side_b is not None or channel.site.pointing is None:
        raise InputError(
            f"channel {channel.name} cannot be simulated sample by sample: its scan differences two beams, or when it "
            'pointed where is not known; give it a scan of kind "hit_averaged", or moments with a scan model.'
        )
    for effect in channel.effects:
        if type(effect).orientations is not systematics.Effect.orientations:
            raise InputError(
                f"effect {effect.name} on channel {channel.name} acts on orientation moments, which samples do not "
                "have; leave it out where the survey is simulated sample by sample."
            )


def _cut(beam: Beam, lmax: int) -> Beam:
    return replace(beam, blm=beam.blm[: lmax + 1, : lmax + 1])


def _beam(acting: tuple[systematics.Effect, ...], site: systematics.Site) -> Beam:
    """Return the beam about the true line of sight."""
    beam = site.beam
    for effect in acting:
        beam = effect.beam(beam, site)
    for effect in acting:
        if not _moves(effect):
            beam = effect.pointing(beam, site)
    return beam


def _moves(effect: systematics.Effect) -> bool:
    nowhere = np.zeros(1)
    return effect.lags() is not None or effect.moved(nowhere, nowhere, nowhere) is not None


def _fiducial_samples(channel: Channel, share: tuple[float, float], delay_s: float = 0.0) -> Iterator[tod.Samples]:
    """Yield the channel's samples at their fiducial pointing, or at that of ``delay_s`` before."""
    site = channel.site
    pointing = site.pointed("of sampled maps")
    model = pointing.model if delay_s == 0.0 else _earlier(pointing.model, delay_s)
    return tod.samples(model, pointing.line, MapGrid(site.nside, site.frame, share))


def _earlier(model: ScanModel, delay_s: float) -> ScanModel:
    """Return the same survey with all its angles as they were ``delay_s`` before."""
    return replace(
        model,
        spin_phase_deg=model.spin_phase_deg - 360.0 * delay_s / model.spin_period_s,
        precession_phase_deg=model.precession_phase_deg - 360.0 * delay_s / model.precession_period_s,
        orbit_phase_deg=model.orbit_phase_deg - 360.0 * delay_s / model.orbit_period_s,
    )


def _seen(channel: Channel, share: tuple[float, float], observe: tod.Stage) -> Iterator[tod.Samples]:
    """Yield the signal at the true pointings, on samples that keep the fiducial ones."""
    lags = [(1.0, 0.0)]
    for effect in channel.effects:
        more = effect.lags()
        if more is not None:
            lags = [(weight * w, delay + d) for weight, delay in lags for w, d in more]
    streams = [observe(_moved(channel, _fiducial_samples(channel, share, delay), share, delay)) for _, delay in lags]
    for fiducial, *true in zip(_drawn_in(channel, _fiducial_samples(channel, share)), *streams, strict=True):
        signal = sum((w * chunk.signal_uk for (w, _), chunk in zip(lags, true, strict=True)), start=0.0)
        yield replace(fiducial, signal_uk=np.asarray(signal))


def _moved(
    channel: Channel, stream: Iterable[tod.Samples], share: tuple[float, float], delay_s: float
) -> Iterator[tod.Samples]:
    """Yield true directions and orientations."""
    spread = _spread(channel)
    fiducial = stream if delay_s == 0.0 or spread == 1.0 else _fiducial_samples(channel, share)
    pairs = ((chunk, chunk) for chunk in stream) if fiducial is stream else zip(stream, fiducial, strict=True)
    for chunk, reference in pairs:
        theta, phi, psi = chunk.theta, chunk.phi, chunk.psi
        for effect in channel.effects:
            moved = effect.moved(theta, phi, psi)
            if moved is not None:
                theta, phi, psi = moved
        if spread != 1.0:
            step = (spread - 1.0) * _offset(channel, reference)
            theta, phi = _angles(_vector(theta, phi) + step)
        yield replace(chunk, theta=theta, phi=phi, psi=psi)


def _spread(channel: Channel) -> float:
    return float(np.prod([effect.spread() for effect in channel.effects]))


def _drawn_in(channel: Channel, stream: Iterable[tod.Samples]) -> Iterator[tod.Samples]:
    """Yield fiducial samples, as near to the centres of their pixels as an effect on their spread puts them."""
    spread = _spread(channel)
    for chunk in stream:
        if spread == 1.0:
            yield chunk
        else:
            theta, phi = _angles(_vector(chunk.theta, chunk.phi) + (spread - 1.0) * _offset(channel, chunk))
            yield replace(chunk, theta=theta, phi=phi)


def _vector(theta: Map, phi: Map) -> Map:
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def _angles(vector: Map) -> tuple[Map, Map]:
    x, y, z = vector
    return np.arctan2(np.hypot(x, y), z), np.arctan2(y, x) % (2.0 * np.pi)


def _offset(channel: Channel, chunk: tod.Samples) -> Map:
    """Return the vector from the centre of each sample's pixel to the sample, shape (3, n)."""
    centres = np.stack(healpy.pix2vec(channel.site.nside, chunk.pixel))
    return np.asarray(_vector(chunk.theta, chunk.phi) - centres)


def _gained(stream: Iterable[tod.Samples], channel: Channel) -> Iterator[tod.Samples]:
    for chunk in stream:
        gain = np.ones(chunk.time_s.size)
        for effect in channel.effects:
            error = effect.gain(chunk.time_s, channel.site)
            if error is not None:
                gain = gain + error
        yield replace(chunk, signal_uk=gain * chunk.signal_uk)


def _noisy(
    stream: Iterable[tod.Samples], channel: Channel, sigma0_uk: float, draw: np.random.Generator
) -> Iterator[tod.Samples]:
    factor = None
    for effect in channel.effects:
        own = effect.noise(channel.site)
        if own is not None:
            factor = own if factor is None else factor * own
    for chunk in stream:
        noise = sigma0_uk * draw.standard_normal(chunk.pixel.size)
        if factor is not None:
            noise = noise * np.sqrt(np.clip(factor, 0.0, None))[chunk.pixel]
        yield replace(chunk, signal_uk=chunk.signal_uk + noise)
