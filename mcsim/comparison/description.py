"""The run that describes side A: without noise and effects, and with all that its files say of samples and beams."""

from dataclasses import replace
from typing import Any

from mcsim import config, systematics
from mcsim.ensemble.external import named_source
from mcsim.errors import InputError
from mcsim.simulation.channels import described, effects_on, known_offsets, load_beam, site_of, with_all_orders

SAMPLES = 100_000_000  #: samples of the longest survey that is simulated sample by sample
STAGES = ("sky", "beam", "pointing", "gain", "steady_gain", "signal", "spread", "orientations")
"""Where an effect must act to change a map without noise."""

EXTRA_ORDERS = 3  #: moments beyond the beam's orders: a displaced beam has them


def quiet(run: config.RunConfig) -> config.RunConfig:
    """Return the run without noise and effects, and with nothing to estimate; InputError without pixels, for rings."""
    check_splits(run)
    if run.map.grid != "healpix":
        raise InputError(f'{run.name} has map.grid = "{run.map.grid}" and so no pixels; set map.grid = "healpix".')
    run = named_source(run)[0]
    channels = tuple(channel.without_noise() for channel in run.channels)
    biposh = replace(run.biposh, L_max=0, pairs="auto", filter="none", probes=None)
    return replace(run, channels=channels, effects=(), biposh=biposh)


def with_known_offsets(run: config.RunConfig) -> config.RunConfig:
    """Return a run with all powers of the samples' offsets that its scans know, unless it says how many.

    Where every sample can be simulated by itself, that takes their place.
    """
    if run.map.offset_order is not None or run.map.grid != "healpix" or run.map.pixel_window == "none":
        return run
    known = [1 if _has_samples(spec) else known_offsets(run, spec) for spec in run.channels]
    order = min((order for order in known if order > 1), default=1)
    whole = [known_offsets(run, spec) >= order for spec in run.channels]
    return replace(run, map=replace(run.map, offset_order=order)) if order > 1 and all(whole) else run


def _has_samples(spec: config.Channel) -> bool:
    if isinstance(spec.scan, config.ScanPointing):
        return True
    pointing = described(spec)[0]
    return pointing is not None and pointing.model.samples(pointing.line) <= SAMPLES


def check_splits(run: config.RunConfig) -> None:
    """Raise InputError for splits by rings."""
    if run.map.split_by == "rings":
        raise InputError(
            f'{run.name} has map.split_by = "rings", but the samples of a map that is compared follow each other in '
            'time; use splits by "time", "sets", or none.'
        )


def in_full(run: config.RunConfig) -> tuple[config.RunConfig, dict[str, int]]:
    """Return a run with all that its files say of samples and beams, and by channel the fewer orders that it takes."""
    full = with_all_orders(with_known_offsets(run))
    pairs = zip(run.channels, full.channels, strict=True)
    return full, {own.name: load_beam(own, run.sky.lmax).mmax for own, whole in pairs if own.beam != whole.beam}


def with_own_beams(run: config.RunConfig) -> config.RunConfig:
    """Return a run whose beams have the shape that its effects give them, and which keeps its other effects alone."""
    channels, done = [], set[str]()
    for spec in run.channels:
        acting = [effect for effect in effects_on(run, spec.name) if _shapes(effect)]
        if acting:
            found = systematics.seen_through(acting, site_of(run, spec))
            table: Any = found  # an object stands for a file
            kept_beam: Any = replace(spec, beam=table).beam
            spec = replace(spec, beam=replace(kept_beam, m_max=found.mmax))
            done |= {effect.name for effect in acting}
        channels.append(spec)
    kept = tuple(one for one in run.effects if systematics.get(one.name).name not in done)
    return replace(run, channels=tuple(channels), effects=kept)


def _shapes(effect: systematics.Effect) -> bool:
    """Return True for an effect that changes the shape of a beam, and leaves its integral and all else alone."""
    changed = [stage for stage in STAGES if systematics.acts_through(effect, stage)]
    return changed == ["beam"] and effect.name not in ("calibration", "beam_noncircularity")


def orders_of(run: config.RunConfig) -> int:
    """Return the highest order of the moments that a comparison needs."""
    return max((getattr(c.beam, "m_max", None) or 2) for c in run.channels) + EXTRA_ORDERS
