"""Two sets of maps of the same skies, read and brought into pairs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.comparison.description import (
    SAMPLES,
    check_splits,
    in_full,
    orders_of,
    quiet,
    with_known_offsets,
    with_own_beams,
)
from mcsim.comparison.frames import common_frame
from mcsim.comparison.missing import check_skies, not_compared, warn_of_effects
from mcsim.comparison.result import NotCompared
from mcsim.comparison.scene import Maps, PointingFiles, Scene, files_of, maps_of_files, scene_of
from mcsim.comparison.sky_of_maps import sky_in
from mcsim.ensemble.external import named_source, source_of
from mcsim.ensemble.maps import file_names, first_realization
from mcsim.errors import InputError
from mcsim.simulation import sampled, simulate
from mcsim.simulation.channels import with_all_orders
from mcsim.simulation.noise import of_map
from mcsim.simulation.survey import Channel, Survey, survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import header, healpix, map_files
from mcsim.sphere.checks import UNSEEN_BELOW, check_map, check_not_infinite
from mcsim.support import resources
from mcsim.support.arrays import Alm, Map, reals
from mcsim.systematics import if_possible
from mcsim.systematics.base import Pointing

Given = Sequence[Map] | Mapping[str, Map]
"""Maps as arrays, in the order of a run's or by name."""

HELD = 20_000_000  #: the same of samples in files, which are held in memory
CLOSER = 0.5  #: squares that all orders of a beam leave of a side, over those that a run's leave, at most

_STORED = (".fits", ".fit", ".gz", ".npy", ".npz", ".h5", ".hdf5", ".nc")  #: what a file of maps is called


@dataclass(frozen=True, eq=False)
class ChannelPair:
    """The maps of one channel on both sides."""

    #: name, splits: of the channel and of its maps
    name: str
    splits: tuple[str, ...]
    #: a, b: maps, uK, shape (split, npix)
    a: Maps
    b: Maps
    seen: NDArray[np.bool_]  #: what both sides observed, shape (split, npix)
    absent: tuple[str, ...] = ()  #: names of the maps that one side lacks, which are holes on both
    one_sided: int = 0  #: number of pixels that one side alone observed
    scene: Scene | None = None  #: what the model says of side A; None without a model
    #: the same with everything that effects need, before any preparation; None without a model
    channel: Channel | None = None
    hits: Maps | None = None  #: samples per pixel of the maps, of the model; None without one
    usable: NDArray[np.bool_] | None = None  #: where the model has samples, and its mask weight; None without one
    sky_of_maps: bool = False  #: True if the scene's sky was taken from side A, and not from the model
    files: PointingFiles | None = None  #: samples of the channel, if the model has them in files
    #: a draw of what noise hides of the sky that side A shows, coefficients as the scene's; None if it hides nothing
    doubt: Alm | None = None
    #: what single samples change in side A, uK, if it was made from orientation moments and ``a`` has it since; None
    spread: Maps | None = None
    #: of every pixel of the maps as the model has it, rms, shape (split, npix); None without one
    noise_uk: Maps | None = None
    turned: bool = False  #: True if the sides are exchanged: ``a`` is side B
    #: True if side A was made from orientation moments or at the pixels' centres, so that no single sample has a say
    by_moments: bool = False
    #: highest order of the beam in a run of the model, if that is not said and less than the scene's; None
    orders: int | None = None
    rounds: int = 0  #: how often the sky that was taken from side A was corrected for what single samples leave of it
    #: what they leave of side A, uK, as the last correction of its sky has it, if that is noise; None: to be made
    unmade: Maps | None = None

    def pointing(self, longest: float = SAMPLES) -> Pointing | PointingFiles | None:
        """Return the pointing, if it is known and has no more samples than the longest that is wanted."""
        if self.channel is None or self.hits is None or self.by_moments:
            return None
        known = self.channel.site.pointing
        if known is not None:
            return known if known.model.samples(known.line) <= longest else None
        number = sum(m.moments.hits.sum() for m in self.channel.maps)
        return self.files if number <= min(longest, HELD) else None

    @property
    def shown(self) -> NDArray[np.bool_]:
        """Where side A shows its sky, whatever side B observed (prepared maps: where both do); shape (split, npix)."""
        if self.hits is None or self.scene is None or self.scene.preparations:
            return self.seen
        return (self.a != healpy.UNSEEN) & (self.hits > 0)

    @property
    def nside(self) -> int:
        """Of the maps."""
        return healpy.npix2nside(self.a.shape[1])

    @property
    def differing(self) -> tuple[str, ...]:
        """Names of the maps that are compared."""
        return tuple(name for name, seen in zip(self.splits, self.seen, strict=True) if seen.any())

    def where_different(self, least: float) -> "ChannelPair":
        """Return the pair without maps whose difference has an rms of ``least`` uK at most, unless that are all."""
        rest = np.where(self.seen, self.b - self.a, 0.0)
        small = np.sum(rest**2, axis=1) <= least**2 * self.seen.sum(axis=1)
        return self if small.all() or not small.any() else replace(self, seen=self.seen & ~small[:, None])

    def exchanged(self) -> "ChannelPair":
        """Return the pair with side B as side A, and a sky that its maps show."""
        turned = replace(self, a=self.b, b=self.a, turned=not self.turned)
        return turned.with_sky_of_maps() if self.sky_of_maps else turned

    def with_sky_of_maps(self) -> "ChannelPair":
        """Return the pair with the sky that side A shows, by orientation moments."""
        assert self.scene is not None
        sky = sky_in(self.a, self.shown, self.scene.up_to_offsets(1))
        return replace(self, scene=replace(self.scene, sky=sky), rounds=0, unmade=None)


@dataclass(frozen=True, eq=False)
class Comparison:
    """All channels of two sides, and the run that describes one of them, if one does.

    ``pairs`` have the side that the run describes for side A, exchanged if that is side B (``of_b``).
    """

    pairs: tuple[ChannelPair, ...]
    run: config.RunConfig | None
    not_compared: tuple[NotCompared, ...] = ()  #: maps that one side, or the model, lacks
    of_b: bool = False  #: True if the run is side B's own, and so describes that
    shown: str | None = None  #: frame of the maps; None if neither the run nor headers say one alone

    @property
    def frame(self) -> str:
        """Frame of the sky of the model."""
        return "ecliptic" if self.run is None else self.run.map.frame


def read(
    a: str | Path, b: str | Path, model: str | Path | config.RunConfig | None = None, nthreads: int = 1
) -> Comparison:
    """Read two sides: folders of FITS maps or configurations, with the run that describes side A, or is side B's own.

    Raises
    ------
    InputError
        If a side cannot be read, or the sides have no map in common.
    """
    for side in (a, b):
        _check_kind(side)
    if not Path(a).is_dir() and not Path(b).is_dir():
        check_skies(a, b)
    run, described, of_b = _model(a, b, model)
    whole: Survey | None = None
    orders: dict[str, int] = {}
    if run is not None:
        run, orders = in_full(run)
        run = with_own_beams(run)
        warn_of_effects(run)
        whole = survey(quiet(run), nthreads, orders=orders_of(run))
    sides = [_side(side, run, described, nthreads) for side in (a, b)]
    for own, other, side in ((0, 1, a), (1, 0, b)):
        if not Path(side).is_dir() and _made_elsewhere((b, a)[own]):
            sides[own] = _closer(sides[own], sides[other], side, nthreads)
    if run is None:
        groups = {name: [name] for name in sides[0] if name in sides[1]}
    else:
        groups = {c: names for c, names in _groups(run).items() if any(all(n in s for s in sides) for n in names)}
    if not groups:
        raise InputError(
            f"{a} and {b} have no channel in common; give both maps of the same names, CHANNEL.fits or "
            "CHANNEL_SPLIT.fits."
        )
    found = (_pair(name, maps, sides, whole, nthreads) for name, maps in groups.items())
    pairs = (replace(pair, orders=orders.get(pair.name)) for pair in found)
    drawn = run if run is None or any(map(_made_elsewhere, (a, b))) else quiet(run)
    noisy = (pair if drawn is None else _with_noise(pair, drawn) for pair in pairs)
    own_first = tuple(pair.exchanged() if of_b else pair for pair in noisy)
    return Comparison(own_first, run, not_compared((a, b), sides, run), of_b, common_frame(run, (a, b)))


def _check_kind(side: str | Path) -> None:
    path = Path(side)
    if (path.is_dir() and (path / "zarr.json").is_file()) or (path.is_file() and path.suffix in _STORED):
        raise InputError(
            f"{side} is no folder of FITS maps; give a configuration of the survey that names it, [ensemble] maps = "
            '"PATH" (a Zarr store, .npy, or FITS files with {realization}), or write CHANNEL.fits into a folder.'
        )
    if not path.exists() and path.suffix != ".toml" and str(side) not in resources.names("workflows"):
        raise InputError(f"{side} is neither a folder of maps nor a configuration; give the path of one.")


def _made_elsewhere(side: str | Path) -> bool:
    """Return True for maps that another program made, or may have made."""
    return Path(side).is_dir() or named_source(config.load(side))[1] is not None


def given(a: Given, b: Given, run: config.RunConfig, nthreads: int = 1) -> Comparison:
    """Compare maps given as arrays, by name or in the order of the run's, uK."""
    names = config.map_names(run)
    a, b = (_in_order(side, names) for side in (a, b))
    run, orders = in_full(run)
    run = with_own_beams(run)
    warn_of_effects(run)
    whole = survey(quiet(run), nthreads, orders=orders_of(run))
    sides = [dict(zip(names, side, strict=True)) for side in (a, b)]
    found = (_pair(name, maps, sides, whole, nthreads) for name, maps in _groups(run).items())
    pairs = (replace(pair, orders=orders.get(pair.name)) for pair in found)
    return Comparison(tuple(_with_noise(pair, run) for pair in pairs), run, shown=common_frame(run, ()))


def _groups(run: config.RunConfig) -> dict[str, list[str]]:
    """Return the names of the maps of each channel."""
    return {channel.name: [one.name for one in run.each_map if one.channel is channel] for channel in run.channels}


def _in_order(side: Given, names: Sequence[str]) -> Sequence[Map]:
    """Return the maps of a side, plain numbers with UNSEEN for masked ones, in the order of the names."""
    if isinstance(side, Mapping):
        if set(side) != set(names):
            raise InputError(f"the maps {', '.join(map(str, side))} were given, the model has {', '.join(names)}.")
        side = [side[name] for name in names]
    if len(side) != len(names):
        raise InputError(f"{len(side)} maps were given, the model has {len(names)}; give one for each.")
    return [reals(one, f"map {name}", healpy.UNSEEN) for name, one in zip(names, side, strict=True)]


def _model(
    a: str | Path, b: str | Path, model: str | Path | config.RunConfig | None
) -> tuple[config.RunConfig | None, str, bool]:
    """Return the run that describes a side, if one does, its name in messages, and True if it is side B's own.

    A side's own description without effects comes before one that has some.
    """
    if isinstance(model, config.RunConfig):
        return model, model.name, False
    found: str | Path | None = model
    own = [Path(side) / "model.toml" if Path(side).is_dir() else side for side in (a, b)]
    if found is None:
        beside = Path(a).absolute().parent / "model.toml"
        found = next((one for one in (*own, beside) if one in (a, b) or Path(one).is_file()), None)
    if found is None:
        return None, "", False
    run = config.load(found)
    if run.effects and model is None and found == own[0] and (own[1] == b or Path(own[1]).is_file()):
        other = config.load(own[1])
        found, run = (found, run) if other.effects else (own[1], other)  # a description has none
    return run, str(found), model is None and found == own[1] != own[0]


def _side(side: str | Path, run: config.RunConfig | None, described: str, nthreads: int) -> dict[str, Map]:
    """Return the maps of a side by name, uK; ``described`` is the model's name in messages."""
    path = Path(side)
    if path.is_dir():
        return _folder(path, run, described)
    own, external = _named(side)
    check_splits(own)
    wanted = own_frame = config.prepared_grid(own)[1]
    if run is not None:
        wanted = config.prepared_grid(run)[1]
    if own_frame != wanted:
        raise InputError(
            f"{side} makes maps in {own_frame} coordinates, the model {described} in {wanted}; give both the same "
            "map.frame, or the model of these maps with --model."
        )
    if external is not None:
        return _external(quiet(own), external, nthreads)
    shared = survey(with_known_offsets(own), nthreads)
    return dict(zip(shared.map_names, simulate.maps(shared, 0, nthreads), strict=True))


def _named(side: str | Path) -> tuple[config.RunConfig, str | None]:
    """Return the run that a side is, without noise, and the simulator or stored maps that it names, if any."""
    run, external = named_source(config.load(side))
    return replace(run, channels=tuple(channel.without_noise() for channel in run.channels)), external


def _external(own: config.RunConfig, given: str, nthreads: int) -> dict[str, Map]:
    """Return the first stored maps of another program, or those that its simulator makes of the run's sky."""
    source, sky = source_of(own, given), None
    if source.count is None:
        if not source.takes_sky:
            raise InputError(
                f"{source.label} draws a sky of its own, so that no other side has the same; give its simulate an "
                "argument sky."
            )
        sky = simulate.draw_sky(survey(own, nthreads), 0)
    return dict(zip(config.map_names(own), source.maps(own.ensemble.seed, 0, sky=sky), strict=True))


def _closer(made: dict[str, Map], wanted: dict[str, Map], side: str | Path, nthreads: int) -> dict[str, Map]:
    """Return the maps of a run as they were made, or closer ones, but for a factor, a monopole and a dipole.

    Orientation moments spread samples over their pixels otherwise than another simulator does, which may have all
    orders of a beam too: these are taken where they are clearly closer, for beside another difference chance decides.
    """
    run, external = _named(side)
    if external is not None:
        return made
    exact, full = _by_samples(run, nthreads), with_all_orders(run)
    own, ways = [made] if exact is None else [made, exact], []
    if full != run:
        whole, exact = survey(with_known_offsets(full), nthreads), _by_samples(full, nthreads)
        ways = [dict(zip(whole.map_names, simulate.maps(whole, 0, nthreads), strict=True))]
        ways += [] if exact is None else [exact]

    def distance(maps: dict[str, Map]) -> float:
        total = 0.0
        for name in maps.keys() & wanted.keys():
            there = wanted[name]
            if there.size == maps[name].size:
                both = (maps[name] > UNSEEN_BELOW) & (there > UNSEEN_BELOW) & np.isfinite(there)
                axes = healpix.centres(healpy.npix2nside(there.size))
                free = np.vstack([maps[name], np.ones(there.size), axes])[:, both].T
                rest = there[both] - free @ np.linalg.lstsq(free, there[both], rcond=None)[0]
                total += float(rest @ rest)
        return total

    best = min(own, key=distance)
    closest = min(ways, key=distance, default=best)
    return closest if distance(closest) < CLOSER * distance(best) else best


def _by_samples(run: config.RunConfig, nthreads: int) -> dict[str, Map] | None:
    """Return the maps of a run sample by sample; None if samples are not known, too many, or not all."""
    whole = survey(run, nthreads)
    pointings = [channel.site.pointing for channel in whole.making.channels]
    if any(p is None or p.model.samples(p.line) > SAMPLES for p in pointings):
        return maps_of_files(whole, HELD, nthreads)
    with if_possible():  # not with an effect on orientation moments, say
        return dict(sampled.maps(whole, 0, nthreads))
    return None


def _folder(folder: Path, run: config.RunConfig | None, described: str) -> dict[str, Map]:
    folder = first_realization(folder)
    names = {path.stem: path for path in sorted(folder.glob("*.fits"))}
    frequencies: dict[str, float | None] = {}
    if run is not None:
        own = file_names(run)
        names = {name: folder / file for name, file in own.items() if (folder / file).is_file()}
        frequencies = {one.name: one.channel.frequency_ghz for one in run.each_map}
    if not names:
        expected = "any FITS map" if run is None else ", ".join(file_names(run).values())
        raise InputError(f"{folder} holds no map to compare; give {expected}.")
    found = {}
    for name, path in names.items():
        map_, frame, unit = map_files.read_map(path, any_order=True)
        if run is not None and frame not in (None, config.prepared_grid(run)[1]):
            raise InputError(
                f"{path} is in {frame} coordinates, the model {described} in {config.prepared_grid(run)[1]}; set its "
                "map.frame, or give the model of these maps with --model."
            )
        factor = header.to_uk(unit, path, frequencies.get(name))
        found[name] = np.where((map_ > UNSEEN_BELOW) | np.isinf(map_), factor * map_, healpy.UNSEEN)
    return found


def _without_holes(map_uk: Map) -> Map:
    """Return a map with UNSEEN for whatever stands for a pixel without data: NaN, UNSEEN in any unit, zeros.

    Two pixels of a simulated sky are not exactly 0.
    """
    known = np.isfinite(map_uk) & (map_uk > 1e-9 * UNSEEN_BELOW)
    zero = map_uk == 0.0
    if 1 < zero.sum() < known.sum():
        known &= ~zero
    return np.where(known, map_uk, healpy.UNSEEN)


def _checked(map_uk: Map, name: str) -> int:
    """Return nside of a map; raise InputError if that is none, or if pixels are infinite."""
    nside = check_map(map_uk, name=name)
    check_not_infinite(map_uk, name)
    return nside


def _pair(
    name: str, maps: Sequence[str], sides: Sequence[dict[str, Map]], whole: Survey | None, nthreads: int
) -> ChannelPair:
    absent = tuple(m for m in maps if not all(m in side for side in sides))
    labelled = tuple(zip("AB", sides, strict=True))
    found = {_checked(side[m], f"map {m} on side {label}") for label, side in labelled for m in maps if m not in absent}
    if len(found) > 1:
        nsides = " and ".join(str(nside) for nside in sorted(found))
        raise InputError(f"the maps of {name} have nside {nsides}; bring them to the same.")
    hole, there = np.full(12 * min(found) ** 2, healpy.UNSEEN), np.array([m not in absent for m in maps])
    whole_sides = (np.stack([hole if m in absent else side[m] for m in maps]).astype(np.float64) for side in sides)
    a, b = (np.stack([_without_holes(one) for one in side]) for side in whole_sides)
    observed = [side != healpy.UNSEEN for side in (a, b)]
    for side, here in zip("AB", observed, strict=True):
        if not here.any(axis=1)[there].all():
            raise InputError(
                f"a map of {name} on side {side} has no data: all of it is NaN or UNSEEN; give its values."
            )
    seen, one_sided = observed[0] & observed[1], int(np.sum(observed[0] != observed[1]))
    if not seen.any(axis=1)[there].all():
        raise InputError(f"the maps of {name} have no pixel in common; give both sides the same part of the sky.")
    if whole is None:
        return ChannelPair(name, tuple(maps), a, b, seen, absent, one_sided)
    finished, channel = (next(c for c in one.channels if c.name == name) for one in (whole, whole.making))
    if channel.side_b is not None:
        raise InputError(
            f"channel {name} has a differencing scan, whose map-making a comparison does not repeat; compare maps of "
            'one side, described by a scan of kind "hit_averaged", or compare without a model.'
        )
    if a.shape[1] != 12 * whole.nside**2:
        raise InputError(
            f"the maps of {name} have nside {healpy.npix2nside(a.shape[1])}, the model {whole.nside}; "
            "set map.nside to that of the maps."
        )
    hits = np.stack([m.moments.hits for m in finished.maps])
    usable = np.stack([m.moments.hits * (1.0 if m.weight is None else m.weight) > 0.0 for m in finished.maps])
    seen &= usable
    if not seen.any(axis=1)[there].all():
        raise InputError(f"the maps of {name} have no pixel in common with each other and the model; check the scan.")
    sky = whole.config.sky
    named = sky.alm is not None or sky.map is not None
    truth = simulate.draw_sky(whole, 0) if named else np.zeros(alm_.size(sky.lmax), complex)
    scene = scene_of(channel, whole.config.map, truth, nthreads)
    spec = next(c for c in whole.config.channels if c.name == name)
    files = files_of(whole.config, spec, channel.site.frame)
    pair = ChannelPair(name, tuple(maps), a, b, seen, absent, one_sided, scene, channel, hits, usable, not named, files)
    # Parallel transport is said of pixels' centres: there are no samples that a simulator could have elsewhere.
    pair = replace(pair, by_moments=isinstance(spec.scan, config.ScanParallelTransport))
    return pair if named else pair.with_sky_of_maps()


def _with_noise(pair: ChannelPair, run: config.RunConfig) -> ChannelPair:
    """Return the pair with the noise that a run describes in its maps."""
    assert pair.scene is not None  # a run describes it
    spec = next(c for c in run.channels if c.name == pair.name)
    splits, moments = run.map.splits or (None,), pair.scene.moments
    drawn = [of_map(run, spec, split, m)[1] for split, m in zip(splits, moments, strict=True)]
    levels = [np.zeros(m.npix) if own is None else own for own, m in zip(drawn, moments, strict=True)]
    if pair.scene.preparations:
        prepared = zip(pair.scene.preparations, levels, moments, strict=True)
        levels = [steps.noise_uk(own, m.hits) for steps, own, m in prepared]
    return replace(pair, noise_uk=np.stack(levels))
