"""What the channels of a configuration stand for: beams, scan models, pointing, and the effects that act in them."""

import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial

import healpy
import numpy as np

from mcsim import config, systematics
from mcsim.config.messages import standing
from mcsim.config.noise import NoiseCorrelated, is_noise_free
from mcsim.errors import InputError
from mcsim.instrument import beams, scan
from mcsim.instrument.beams.coefficients import power_by_order
from mcsim.instrument.scan.offsets import HIGHEST
from mcsim.simulation.timestream import nyquist_hz
from mcsim.sphere import rotation
from mcsim.support import resources
from mcsim.systematics.hooks import HOOKS

CIRCULAR = (config.BeamGaussian, config.BeamWindow)  #: beams that have no m_max
WHOLE = 4  #: orders that a beam has at least without its m_max, where its source has them

NEGLECTED = 1e-9
"""Share of a beam's power that its orders may leave out where maps are told apart by less than a run's own accuracy."""

LOST = 0.01  #: share of the power of a change of the beam that a file of moments may leave out in silence

MOST_ORDERS = 8
"""Highest order that is added for it: every one is a transform more, and noise of a measured beam has them all."""


def load_beam(channel: config.Channel, lmax: int) -> beams.Beam:
    """Return the beam of a channel, up to lmax; of a differencing scan that of side A."""
    return _beam(channel.name, channel.beam, lmax)


def load_beam_b(channel: config.Channel, lmax: int) -> beams.Beam:
    """Return the beam of side B of a differencing channel, up to lmax: its own, or side A's mirrored."""
    if channel.beam_b is None:
        return load_beam(channel, lmax).mirrored()
    return _beam(channel.name, channel.beam_b, lmax)


def _beam(channel: str, spec: config.Beam, lmax: int) -> beams.Beam:
    match spec:
        case config.BeamGaussian():
            return beams.Beam.gaussian(spec.fwhm_arcmin, lmax)
        case config.BeamEllipticalGaussian():
            major, minor = spec.fwhm_major_arcmin, spec.fwhm_minor_arcmin
            return beams.Beam.elliptical(major, minor, angle_deg=spec.angle_deg, lmax=lmax, mmax=spec.m_max)
        case config.BeamMap():
            beam_map = load_beam_map(channel, spec, lmax)
            if abs(beam_map.edge_over_peak) > beams.PEDESTAL:
                warnings.warn(
                    f"channel[{channel}].beam: the response is still {beam_map.edge_over_peak:.2g} of the peak where "
                    f"its map ends or is cut (cut_deg = {spec.cut_deg:g}), and nothing beyond is simulated; raise "
                    "cut_deg, or subtract what is no beam.",
                    stacklevel=1,
                )
            beam = beams.Beam.from_map(beam_map, lmax, spec.m_max)
            return beam.rotated(np.deg2rad(spec.angle_deg))
        case config.BeamBlm():
            file = config.channel_path(spec.path, channel)
            return beams.Beam.from_blm(file, lmax, mmax=spec.m_max).rotated(np.deg2rad(spec.angle_deg))
        case config.BeamWindow():
            file = config.channel_path(spec.path, channel)
            return beams.Beam.from_window(file, lmax, extension=spec.extension, column=spec.column)


def load_beam_map(channel: str, spec: config.BeamMap, lmax: int | None = None) -> beams.BeamMap:
    """Return the beam map of a channel whose maps have degrees up to ``lmax``."""
    return beams.read_map(
        config.channel_path(spec.path, channel),
        pixel_deg=spec.pixel_deg,
        cut_deg=spec.cut_deg,
        centre=spec.centre_pixel,
        plane=spec.plane,
        projection=spec.projection,
        lmax=lmax,
    )


def scan_model(
    spec: config.Channel, chosen: config.ScanHitAveraged | config.ScanDifferencing, split: str | None
) -> scan.ScanModel:
    """Return the scan model of a channel, at the sampling and with the line of sight that the channel asks for."""
    model = scan.ScanModel.load(str(config.channel_path(chosen.model, spec.name, split)))
    if isinstance(chosen, config.ScanHitAveraged) and chosen.line_of_sight is not None:
        model = model.with_lines_of_sight(chosen.line_of_sight.replace("{split}", str(split)))
    return model if chosen.sample_period_s is None else model.with_sampling(chosen.sample_period_s)


def effects_on(
    run: config.RunConfig, channel: str, library: systematics.Library | None = None
) -> tuple[systematics.Effect, ...]:
    """Return the effects of a run that act in a channel, in their order.

    InputError for an effect or a parameter that is not known, and for an effect that names a channel and is common to
    all, or the other way round.
    """
    acting = []
    for number, entry in enumerate(run.effects):
        with standing(run, f"effect[{number}]"):
            kind = systematics.get(entry.name, library)
            beside = ("name", "channel") if kind.scope == "channel" else ("name",)
            effect = systematics.build(kind, entry.parameters, beside=beside)
            check_scope(f"effect {entry.name}", kind, entry.channel, run)
        if "amplitude" not in entry.parameters:
            warnings.warn(f"effect {entry.name} has no amplitude, so that it does nothing; give one.", stacklevel=1)
        if entry.channel in (None, channel):
            acting.append(effect)
    return tuple(acting)


def check_scope(name: str, kind: type[systematics.Effect], channel: str | None, run: config.RunConfig) -> None:
    """Raise InputError for an effect that names a channel and is common to all, or the other way round."""
    if kind.scope == "channel" and channel is None:
        raise InputError(f'{name} acts in one channel; say which: channel = "{run.channels[0].name}".')
    if kind.scope == "common" and channel is not None:
        raise InputError(f"{name} is common to all channels; remove its channel = {channel!r}.")


def table_of(effect: systematics.Effect, channel: str | None) -> config.Effect:
    """Return an effect as an ``[[effect]]`` of a run; ``channel`` None: it acts in all."""
    parameters = {"amplitude": effect.amplitude, **effect.parameters()}
    return config.Effect(name=effect.name, channel=channel, parameters=parameters)


def refuse_external(run: config.RunConfig) -> None:
    """Raise InputError for a run whose maps another simulator makes."""
    if run.simulator is not None or run.ensemble.maps is not None:
        key = "ensemble.maps" if run.simulator is None else "simulator"
        given = run.simulator or run.ensemble.maps
        raise InputError(
            f"{run.name} has {key} = {given!r}, which only a diagnosis or a comparison of maps takes; remove it to "
            "simulate with mcsim, or take coefficients of its maps with mcsim.biposh (docs/howto/simulator.md)."
        )


def in_channel(run: config.RunConfig, spec: config.Channel) -> AbstractContextManager[None]:
    """Say of an InputError that it is about this channel of a run."""
    return standing(run, f"channel[{spec.name}]")


def check_beams(run: config.RunConfig) -> None:
    """Refuse a run with a beam in closed form that cannot be computed, as the run would."""
    for channel in run.channels:
        for beam in (channel.beam, channel.beam_b):
            if isinstance(beam, config.BeamGaussian | config.BeamEllipticalGaussian):
                with in_channel(run, channel):
                    _beam(channel.name, beam, run.sky.lmax)


def check_scans(run: config.RunConfig) -> None:
    """Refuse a run whose scan models cannot be read, or lack what a channel names, as the run would."""
    for spec in run.channels:
        with in_channel(run, spec):
            match spec.scan:
                case config.ScanHitAveraged():
                    for split in run.map.each_split:
                        scan_model(spec, spec.scan, split).select()
                case config.ScanDifferencing():
                    for split in run.map.each_split:
                        scan_model(spec, spec.scan, split).pair(spec.scan.pair)
                case config.ScanMoments():
                    described(spec)


def check_effects(run: config.RunConfig) -> None:
    """Refuse a run with an effect that is not known, or cannot act where it is put, as the run would; make no map."""
    for spec in run.channels:
        acting = effects_on(run, spec.name)
        if acting:
            with in_channel(run, spec):
                refuse_misplaced(run, spec, acting)
                site = site_of(run, spec)
                _warn_of_orders(run, spec, systematics.tried(acting, site), site.beam)
                for effect in acting:
                    _warn_of_nothing(effect, site)


def _warn_of_nothing(effect: systematics.Effect, site: systematics.Site) -> None:
    """Warn of an effect on one channel that can only change gain or noise there, and does not."""
    others = [hook for hook in HOOKS if hook not in ("gain", "noise")]
    if effect.scope != "channel" or effect.amplitude == 0.0 or systematics.acts_through(effect, *others):
        return
    year = 86400.0 * np.arange(366.0)  # a gain may begin on some day
    if effect.gain(year, site) is None and effect.noise(site) is None:
        warnings.warn(
            f"effect {effect.name} does nothing on channel {site.channel}: its hooks return None at amplitude = "
            f"{effect.amplitude:g}; if a return is missing, add it.",
            stacklevel=3,
        )


def refuse_misplaced(run: config.RunConfig, spec: config.Channel, acting: tuple[systematics.Effect, ...]) -> None:
    """Refuse effects on what a channel does not have: pixels, differences or single beams, noise or its memory."""
    if run.map.grid == "gl":
        refuse_pixel_effects(spec.name, acting)
    if isinstance(spec.scan, config.ScanDifferencing):
        refuse_excess(spec.name, acting)
    else:
        refuse_differences(spec.name, acting)
    _refuse_noise(run, spec, acting)


def _refuse_noise(run: config.RunConfig, spec: config.Channel, acting: tuple[systematics.Effect, ...]) -> None:
    """Refuse effects on noise alone in a channel that has none, and on its memory where it is white."""
    given = [spec.noise_of(split) for split in run.map.each_split]
    for effect in acting if not any(isinstance(one, NoiseCorrelated) for one in given) else ():
        if effect.amplitude != 0.0 and systematics.acts_through(effect, "knee"):
            raise InputError(
                f"effect {effect.name} on channel {spec.name} moves the knee of noise with memory, but the channel's "
                'noise has none; remove it, or give the channel noise of kind "correlated".'
            )
    for split, noise in zip(run.map.each_split, given, strict=True):
        if isinstance(noise, NoiseCorrelated) and isinstance(spec.scan, config.ScanHitAveraged):
            knee, model = noise.f_knee_hz, scan_model(spec, spec.scan, split)
            for effect in acting:
                knee = effect.knee(knee)
            if knee != noise.f_knee_hz and knee >= (nyquist := nyquist_hz(model)):
                raise InputError(
                    f"effects move the knee of the noise of channel {spec.name} to {knee:g} Hz, which is not below "
                    f"{nyquist:g} Hz, half the sampling rate of {model.name!r}; lower their amplitude or shorten "
                    "scan.sample_period_s."
                )
    for effect in acting if all(is_noise_free(one) for one in given) else ():
        if effect.amplitude != 0.0 and effect.parametrization.noise_alone:
            raise InputError(
                f"effect {effect.name} on channel {spec.name} acts on noise, but the channel has none; remove it, or "
                "give the channel noise."
            )


def _warn_of_orders(run: config.RunConfig, spec: config.Channel, beam: beams.Beam, fiducial: beams.Beam) -> None:
    """Warn of a change of the beam whose orders a file of moments does not have; refuse a file without its own."""
    if not isinstance(spec.scan, config.ScanMoments) or beam.mmax <= fiducial.mmax:
        return
    paths = [config.channel_path(spec.scan.path, spec.name, split) for split in run.map.each_split]
    smax = min(scan.read_moments(path, frame=run.map.frame).smax for path in paths)
    refuse_short(spec.name, smax, fiducial)
    change = beam.blm.copy()
    change[: fiducial.mmax + 1] -= fiducial.blm
    power = power_by_order(change)
    lost = float(power[smax + 1 :].sum() / power.sum())
    if lost > LOST:
        warnings.warn(
            f"effects give the beam of {spec.name} orders up to {beam.mmax}, but its moments end at s = {smax}, "
            f"which leaves out {100.0 * lost:.0f} % of the power of the change; give moments up to s = {beam.mmax}.",
            stacklevel=3,
        )


def refuse_short(channel: str, smax: int, fiducial: beams.Beam) -> None:
    """Refuse moments up to s = smax without orders of the model's own beam, whatever effects add to them."""
    if smax < fiducial.mmax:
        raise InputError(
            f"the moments of {channel} end at s = {smax}, but its beam has orders up to {fiducial.mmax}; give moments "
            "up to these, or lower its m_max."
        )


def refuse_excess(channel: str, acting: tuple[systematics.Effect, ...]) -> None:
    """Refuse effects in a differencing scan that its samples, which are differences, do not have."""
    for effect in acting:
        if effect.amplitude != 0.0 and systematics.acts_through(effect, "orientations"):
            raise InputError(
                f"effect {effect.name} on channel {channel} acts on orientation moments, but the scan takes "
                'differences, which have none; remove it, or give a scan of kind "hit_averaged".'
            )
    for effect in acting:
        if effect.amplitude != 0.0 and systematics.acts_through(effect, "steady_gain"):
            raise InputError(
                f"effect {effect.name} on channel {channel} acts on maps of one beam, but the scan takes differences; "
                'remove it, or give a scan of kind "hit_averaged".'
            )
    for effect, _ in systematics.disturbing(acting):
        raise InputError(
            f"effect {effect.name} on channel {channel} adds noise to samples of one beam, but the scan takes "
            "differences; remove it, or use noise.sigma0_uk."
        )


def refuse_differences(channel: str, acting: tuple[systematics.Effect, ...]) -> None:
    """Refuse effects on the differences of two beams where the scan takes none."""
    for effect in acting:
        if effect.amplitude != 0.0 and systematics.acts_through(effect, "differencing"):
            raise InputError(
                f"effect {effect.name} on channel {channel} acts on differences of two beams, but the scan takes none; "
                'remove it, or give a scan of kind "differencing".'
            )


def refuse_unseen(channel: str, acting: tuple[systematics.Effect, ...]) -> None:
    """Refuse effects that say what single samples see, and nothing else, for maps that are not made of samples."""
    for effect in acting:
        alone = systematics.acts_through(effect, "moved", "lags") and not systematics.acts_through(effect, "pointing")
        if effect.amplitude != 0.0 and alone:
            raise InputError(
                f"effect {effect.name} on channel {channel} acts on single samples by moved or lags, and has no hook "
                "pointing, by which maps of the default route have it; define that too, or simulate sample by sample."
            )


def with_offsets(moments: scan.Moments, order: int, spec: config.Channel) -> scan.Moments:
    """Return moments with those of the samples' offsets that a run asks for, and no others.

    InputError if they are not known; where samples stand at the centres of their pixels there are none.
    """
    found = moments.up_to_offsets(order)
    if 1 < order != found.offset_order and not isinstance(spec.scan, config.ScanParallelTransport):
        remedy = f"lower it, or give columns DTHETA, DPHI and OFFSET_a_b up to a + b = {order}"
        if isinstance(spec.scan, config.ScanDifferencing):
            remedy = "remove it, since a differencing scan has none"
        raise InputError(
            f"map.offset_order = {order}, but the moments of channel {spec.name} have offsets up to order "
            f"{found.offset_order}; {remedy}."
        )
    return found


def known_offsets(run: config.RunConfig, spec: config.Channel) -> int:
    """Return the highest power of the samples' offsets that the moments of a channel can have."""
    match spec.scan:
        case config.ScanMoments():
            paths = [config.channel_path(spec.scan.path, spec.name, split) for split in run.map.each_split]
            return min(scan.read_moments(path, frame=run.map.frame).offset_order for path in paths)
        case config.ScanDifferencing():
            return 1
    return HIGHEST


def refuse_pixel_effects(channel: str, acting: tuple[systematics.Effect, ...]) -> None:
    """Refuse effects that act on pixels, for a grid of rings."""
    hooks = ("gain", "steady_gain", "signal", "noise", "excess", "spread", "orientations")
    for effect in acting:
        if systematics.acts_through(effect, *hooks):
            raise InputError(
                f'effect {effect.name} on channel {channel} acts on pixels, but grid = "gl" has none; remove it or set '
                'map.grid = "healpix".'
            )


def site_of(run: config.RunConfig, spec: config.Channel) -> systematics.Site:
    """Return what effects may know of a channel."""
    pointing, dipole = described(spec)
    amplitude = run.sky.dipole_uk if run.sky.dipole_uk is not None else dipole or 0.0
    towards = healpy.ang2vec(run.sky.dipole_lon_deg, run.sky.dipole_lat_deg, lonlat=True)
    return systematics.Site(
        channel=spec.name,
        frequency_ghz=spec.frequency_ghz,
        frame=run.map.frame,
        nside=run.map.resolution,
        lmax=run.sky.lmax,
        beam=load_beam(spec, run.sky.lmax),
        pointing=pointing,
        dipole_uk=amplitude * (rotation.rotation_matrix("galactic", run.map.frame) @ towards),
        whole=partial(_whole, load_beam, spec, run.sky.lmax) if _is_cut(spec.beam) else None,
        foregrounds=spec.foregrounds,
        splits=run.map.splits,
    )


def site_b_of(site: systematics.Site, spec: config.Channel) -> systematics.Site:
    """Return what effects may know of side B of a differencing channel, from that of side A."""
    whole = partial(_whole, load_beam_b, spec, site.lmax) if _is_cut(spec.beam_b or spec.beam) else None
    return replace(site, beam=load_beam_b(spec, site.lmax), whole=whole)


def _is_cut(spec: config.Beam) -> bool:
    return not isinstance(spec, CIRCULAR) and spec.m_max is not None


def _whole(load: Callable[[config.Channel, int], beams.Beam], spec: config.Channel, lmax: int) -> beams.Beam:
    """Return a beam of a channel without its m_max."""
    chosen = load(_with_m_max(spec, None), lmax)
    if chosen.mmax >= WHOLE:
        return chosen
    try:
        return load(_with_m_max(spec, WHOLE), lmax)
    except InputError:  # a file of coefficients with fewer orders
        return chosen


def _with_m_max(spec: config.Channel, m_max: int | None) -> config.Channel:
    """Return a channel whose beams have another m_max."""
    beam, beam_b = (
        each if each is None or isinstance(each, CIRCULAR) else replace(each, m_max=m_max)
        for each in (spec.beam, spec.beam_b)
    )
    return replace(spec, beam=beam or spec.beam, beam_b=beam_b)


def with_all_orders(run: config.RunConfig) -> config.RunConfig:
    """Return a run whose beams, where no m_max is given, have all orders that a map without noise shows."""

    def full(spec: config.Channel) -> config.Channel:
        of_all = partial(_with_all_orders, spec.name, lmax=run.sky.lmax)
        return replace(spec, beam=of_all(spec.beam), beam_b=None if spec.beam_b is None else of_all(spec.beam_b))

    return replace(run, channels=tuple(map(full, run.channels)))


def _with_all_orders(channel: str, spec: config.Beam, lmax: int) -> config.Beam:
    if isinstance(spec, CIRCULAR) or spec.m_max is not None:
        return spec
    own = beam = _beam(channel, spec, lmax)
    for orders in range(min(MOST_ORDERS, lmax), own.mmax, -1) if own.neglected_power > NEGLECTED else ():
        try:
            beam = _beam(channel, replace(spec, m_max=orders), lmax)
        except InputError:  # a file of fewer orders
            continue
        break
    while beam.mmax > own.mmax and (cut := beam.truncated(beam.mmax - 1)).neglected_power <= NEGLECTED:
        beam = cut
    return replace(spec, m_max=beam.mmax)


def described(spec: config.Channel) -> tuple[systematics.Pointing | None, float | None]:
    """Return how a channel was pointed, if one line of sight says it all, and the dipole that its description names."""
    match spec.scan:
        case config.ScanMoments() if spec.scan.model is not None:
            file = resources.scan_model(str(config.channel_path(spec.scan.model, spec.name)))
            model, dipole_uk = scan.read_described(file)
            name = spec.scan.line_of_sight or spec.name
            if spec.scan.line_of_sight is None and name not in [line.name for line in model.lines_of_sight]:
                return None, dipole_uk
            return systematics.Pointing(model, model.line_of_sight(name)), dipole_uk
        case config.ScanHitAveraged() if "{split}" in f"{spec.scan.model}{spec.scan.line_of_sight}":
            return None, None  # splits were pointed in different ways
        case config.ScanHitAveraged():
            model = scan_model(spec, spec.scan, None)
            lines = model.select()
            return (systematics.Pointing(model, lines[0]) if len(lines) == 1 else None), None
    return None, None
