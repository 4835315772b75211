"""The run that describes side A: without noise and effects, and with all that its files say of samples and beams."""

from dataclasses import replace

from mcsim import config
from mcsim.ensemble.external import named_source
from mcsim.errors import InputError
from mcsim.simulation.channels import described, known_offsets, load_beam, with_all_orders

SAMPLES = 100_000_000  #: samples of the longest survey that is simulated sample by sample
EXTRA_ORDERS = 3  #: moments beyond the beam's orders: a displaced beam has them


def quiet(run: config.RunConfig) -> config.RunConfig:
    """Return the run without noise and effects, and with nothing to estimate; InputError without times of splits."""
    check_splits(run)
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
    """Raise InputError for splits whose samples have no time of their own."""
    if run.map.split_by != "time":
        raise InputError(
            f'{run.name} has map.split_by = "{run.map.split_by}", but the samples of maps that are compared are found '
            'by their time; use splits by "time", or none.'
        )


def in_full(run: config.RunConfig) -> tuple[config.RunConfig, dict[str, int]]:
    """Return a run with all that its files say of samples and beams, and by channel the fewer orders that it takes."""
    full = with_all_orders(with_known_offsets(run))
    pairs = zip(run.channels, full.channels, strict=True)
    return full, {own.name: load_beam(own, run.sky.lmax).mmax for own, whole in pairs if own.beam != whole.beam}


def orders_of(run: config.RunConfig) -> int:
    """Return the highest order of the moments that a comparison needs."""
    return max((getattr(c.beam, "m_max", None) or 2) for c in run.channels) + EXTRA_ORDERS
