"""Schema 1 of a run: frozen dataclasses that check themselves, one definition for TOML and for Python.

Every key states the unit of its number. A failed check raises ValueError whose text follows ``key = value``;
:mod:`mcsim.config.messages` completes the sentence.
"""

from dataclasses import replace
from typing import Annotated, Any, Literal, NamedTuple, Self, get_args

from pydantic import AfterValidator, Field, GetCoreSchemaHandler, model_validator
from pydantic.dataclasses import dataclass
from pydantic_core import core_schema

from mcsim.config import arrays
from mcsim.config.beams import BEAMS, AnyBeam
from mcsim.config.consistency import check_filter, check_rings
from mcsim.config.noise import AnyNoise, Noise, check_differences, check_splits
from mcsim.config.preparation import Step, check_steps
from mcsim.config.values import STRICT, Degree, Frame, Label, Nside, PathText, Width, Widths, power_of_two, unique


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Sky:
    """Isotropic Gaussian skies from ``spectrum``, or skies given as a_lm or map files (a template: {realization}).

    ``dipole_uk`` (towards galactic ``dipole_lon_deg``, ``dipole_lat_deg``) is observed by the survey and subtracted
    with the fiducial beam and gain, so that only effects leave a trace of it. Default: that of the scan's description,
    or none.
    """

    lmax: Degree
    spectrum: PathText | None = None
    alm: PathText | None = None
    map: PathText | None = None
    dipole_uk: Annotated[float, Field(ge=0.0)] | None = None
    dipole_lon_deg: float = 264.0
    dipole_lat_deg: Annotated[float, Field(ge=-90.0, le=90.0)] = 48.24

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.alm is not None and self.map is not None:
            raise ValueError("both alm and map are given; keep one of them")
        if self.alm is None and self.map is None and self.spectrum is None:
            raise ValueError('none of spectrum, alm, map is given; add one, for example spectrum = "wmap7"')
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Map:
    """Pixels, frame, mask, splits and pixel window.

    ``grid``: "healpix", or "gl": Gauss quadrature on rings, several times faster and exact, for surveys whose
    orientation moments depend on colatitude alone. These are parallel transport, and the exact long-time limit of a
    scan model (``hit_averaged`` then means it) in the ecliptic frame. It has no pixels, so no ``nside``, mask, splits,
    noise or ``sample_period_s``.
    ``pixel_window``: "computed", "none" or a FITS file; default: "computed" for scans whose samples spread over the
    pixels, "none" for parallel transport, whose samples are at the centres.
    ``mask_frame``: frame of the mask; default: that of its file, or that of the maps. ``mask_apodisation_deg``: width
    of its soft edge.
    ``split_by``: "time": equal spans, one after the other; "rings": every n-th ring, in turn; "sets": each from the
    whole of its scan.
    ``offset_order``: highest power, 0 to 4, of the samples' offsets from their pixels' centres that counts; 1: the
    pixel window and the mean offset. Default: 1; in a comparison, as far as the scan is known.
    """

    nside: Nside | None = None
    grid: Literal["healpix", "gl"] = "healpix"
    frame: Frame = "ecliptic"
    mask: PathText | None = None
    mask_frame: Frame | None = None
    mask_apodisation_deg: Annotated[float, Field(ge=0.0, le=90.0)] = 0.0
    splits: Annotated[tuple[Label, ...], AfterValidator(unique)] = ()
    split_by: Literal["time", "rings", "sets"] = "time"
    pixel_window: PathText | None = None
    offset_order: Annotated[int, Field(ge=0, le=4)] | None = None

    @property
    def each_split(self) -> tuple[str | None, ...]:
        """Names of the splits; (None,) of a survey that is not split."""
        return self.splits or (None,)

    @property
    def resolution(self) -> int:
        """Value of nside, 0 on a grid without pixels."""
        return self.nside or 0

    def span(self, index: int) -> tuple[float, float]:
        """Return the share of the survey's time that a split covers, within 0 and 1."""
        count = len(self.splits) if self.split_by == "time" and self.splits else 1
        return index % count / count, (index % count + 1) / count

    def rings(self, index: int) -> tuple[int, int] | None:
        """Return every how many rings belong to a split, and the first one; None: all rings of its span."""
        return (len(self.splits), index) if self.split_by == "rings" else None

    @model_validator(mode="after")
    def _pixels_and_mask(self) -> Self:
        if self.grid == "healpix" and self.nside is None:
            raise ValueError("the key nside is missing; add it")
        for key in ("nside", "mask", "splits", "pixel_window") if self.grid == "gl" else ():
            if getattr(self, key) not in (None, (), "none"):
                raise ValueError(f'{key} is given, but grid = "gl" has no pixels; remove {key} or set grid = "healpix"')
        if (self.offset_order or 0) > 1 and (self.grid == "gl" or self.pixel_window == "none"):
            other = 'grid = "gl"' if self.grid == "gl" else 'pixel_window = "none"'
            raise ValueError(
                f"offset_order = {self.offset_order} spreads samples over pixels, but {other} has none that do; remove "
                "offset_order"
            )
        if self.split_by != "time" and not self.splits:
            raise ValueError(f'split_by = "{self.split_by}" is given without splits; name them, or remove split_by')
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ScanParallelTransport:
    """Parallel transport: one sample at every pixel centre, at the angle ``psi0_deg`` from e_theta."""

    kind: Literal["parallel_transport"] = "parallel_transport"
    psi0_deg: Annotated[float, Field(ge=-720.0, le=720.0)] = 0.0


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ScanHitAveraged:
    """Orientation moments of a scan model: a packaged name or a TOML file."""

    kind: Literal["hit_averaged"] = "hit_averaged"
    model: PathText
    sample_period_s: Annotated[float, Field(gt=0.0)] | None = None
    line_of_sight: PathText | None = None


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ScanMoments:
    """Orientation moments from a FITS file.

    ``model``: a scan model or a survey's description, for effects that depend on time; default: ``scan.toml`` beside
    the file, if it exists. ``line_of_sight``: by default the channel's name.
    """

    kind: Literal["moments"] = "moments"
    path: PathText
    model: PathText | None = None
    line_of_sight: PathText | None = None


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ScanPointing:
    """Orientation moments from a file of pointings: theta, phi, psi[, time]."""

    kind: Literal["pointing"] = "pointing"
    path: PathText


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ScanDifferencing:
    """A differencing pair of a scan model; maps are made from (1+x) T_A - (1-x) T_B, x the transmission imbalance.

    ``tolerance``: the relative residual that the map-making must reach within ``max_iterations``.
    """

    kind: Literal["differencing"] = "differencing"
    model: PathText
    pair: PathText
    sample_period_s: Annotated[float, Field(gt=0.0)] | None = None
    transmission_imbalance: Annotated[float, Field(gt=-1.0, lt=1.0)] = 0.0
    tolerance: Annotated[float, Field(ge=1e-14, lt=1.0)] = 1e-8
    max_iterations: Annotated[int, Field(ge=1, le=1_000_000)] = 500


class _OrObject:
    """Accept an object in place of a table in Python; JSON accepts the table only."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        table = handler(source)
        return core_schema.json_or_python_schema(
            table, core_schema.no_info_before_validator_function(self._table, table)
        )

    @staticmethod
    def _table(value: Any) -> Any:
        if not isinstance(value, arrays.Tabled):
            return value
        table = arrays.table_of(value)
        return (BEAMS | SCANS)[table["kind"]](**table)


AnyScan = ScanParallelTransport | ScanHitAveraged | ScanMoments | ScanPointing | ScanDifferencing
Beam = Annotated[AnyBeam, Field(discriminator="kind"), _OrObject()]
Scan = Annotated[AnyScan, Field(discriminator="kind"), _OrObject()]
SCANS: dict[str, Any] = {each.kind: each for each in get_args(AnyScan)}


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Channel:
    """One detector or band: a beam under a scan, with noise.

    ``beam_b``: beam of side B of a differencing scan; default: ``beam`` mirrored. ``split_noise``: noise of splits that
    have their own, by name. ``mask``: in place of the run's. ``foregrounds``: False for a map of the cosmic microwave
    background alone, which a component separation made.
    """

    name: Label
    beam: Beam
    scan: Scan
    beam_b: Beam | None = None
    frequency_ghz: Annotated[float, Field(gt=0.0, le=10_000.0)] | None = None  # more is probably MHz or Hz
    noise: AnyNoise = Noise()
    split_noise: dict[Label, AnyNoise] = Field(default_factory=dict)
    mask: PathText | None = None
    foregrounds: bool = True

    @model_validator(mode="after")
    def _one_or_two_beams(self) -> Self:
        if self.beam_b is not None and not isinstance(self.scan, ScanDifferencing):
            raise ValueError(
                f'beam_b is given, but a scan of kind "{self.scan.kind}" has one beam; remove beam_b or choose '
                'kind = "differencing"'
            )
        if isinstance(self.scan, ScanDifferencing):
            check_differences(self.noise, self.split_noise)
        return self

    def noise_of(self, split: str | None) -> AnyNoise:
        """Return the noise of the map of a split, None: of the only map."""
        return self.noise if split is None else self.split_noise.get(split, self.noise)

    def without_noise(self) -> Self:
        """Return the channel without any noise."""
        return replace(self, noise=Noise(), split_noise={})


class MapOf(NamedTuple):
    """Say which map of a run one is: of which channel, and of which split; None: of the only one."""

    channel: Channel
    split: str | None

    @property
    def name(self) -> str:
        """Return "channel", or "channel:split"."""
        return self.channel.name if self.split is None else f"{self.channel.name}:{self.split}"


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Biposh:
    """Settings of the estimator; ``lmax``: by default the sky's; ``iterations``: Jacobi iterations of the analysis.

    ``filter``: "inverse_covariance" estimates from maps filtered by their inverse covariance, which needs noise, and
    normalises by ``probes`` random maps (default: as many as the real numbers of all bins need).
    """

    L_max: Annotated[int, Field(ge=0)] = 2
    lmax: Degree | None = None
    summary_bin: Annotated[int, Field(ge=1)] = 50
    weighting: Literal["uniform", "hits"] = "uniform"
    iterations: Annotated[int, Field(ge=0, le=20)] = 0
    pairs: Literal["all", "auto"] = "all"
    filter: Literal["none", "inverse_covariance"] = "none"
    probes: Annotated[int, Field(ge=8, le=10_000)] | None = None

    @property
    def filtered(self) -> bool:
        """Return True if maps are filtered by their inverse covariance."""
        return self.filter == "inverse_covariance"


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Ensemble:
    """Realizations 0 .. realizations - 1 of the seed; ``paired`` adds the circular-beam control of each.

    ``maps``: stored maps of another simulator, with which a diagnosis compares data: a template of FITS files with
    {realization}, {channel} and {split}, or a Zarr store.
    """

    realizations: Annotated[int, Field(ge=1, le=10_000_000)] = 100
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 0
    paired: bool = True
    keep_maps: bool = False
    maps: PathText | None = None


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Compute:
    """Settings of the computation; no result depends on them. ``chunk``: realizations per task (default: chosen)."""

    workers: Annotated[int, Field(ge=1, le=100_000)] = 2
    chunk: Annotated[int, Field(ge=1, le=2**20), AfterValidator(power_of_two)] | None = None


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Effect:
    """Named change of the simulation; in TOML its ``parameters`` are keys of the table ``[[effect]]``."""

    name: PathText
    channel: Label | None = None
    parameters: dict[str, float | str | tuple[float, ...]] = Field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Nuisance:
    """Effect of unknown size that a diagnosis marginalises: normal about zero, with a prior width in its unit.

    ``width``: that of the amplitude or, of an effect with several linear components, of each of them. ``parameters``
    are the others, ``parameter_widths`` prior widths of those among them that are not known either.
    """

    effect: PathText
    width: Widths
    channel: Label | None = None
    parameters: dict[str, float | str | tuple[float, ...]] = Field(default_factory=dict)
    parameter_widths: dict[str, Width] = Field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RunConfig:
    """Configuration of a run, from :func:`mcsim.load_config`; frozen: ``dataclasses.replace`` makes another one.

    Parameters
    ----------
    schema_version
        Always 1; in TOML ``schema``.
    name
        Name of the run and of its store.
    sky, map
        The skies, and the pixels and frame of the maps.
    channels
        Beams under scans; in TOML the tables ``[[channel]]``.
    effects, preparation
        Changes of the simulation, such as :func:`mcsim.effects` lists, and of its maps before the analysis; in TOML
        the tables ``[[effect]]`` and ``[[preparation]]``.
    simulator
        Simulator of another program, ``package.module:name`` or ``file.py:name``, whose maps a diagnosis takes.
    nuisances
        Effects that a diagnosis marginalises; in TOML the tables ``[[nuisance]]``.
    biposh, ensemble, compute
        Settings of the estimator, of the realizations and seed, and of the computation.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import mcsim
    >>> run = mcsim.load_config("tiny")
    >>> isinstance(run, mcsim.RunConfig), run.sky.lmax
    (True, 48)
    >>> replace(run, ensemble=replace(run.ensemble, realizations=200)).ensemble.realizations
    200
    """

    schema_version: Annotated[int, Field(alias="schema", ge=1, le=1)] = 1
    name: Label
    sky: Sky
    map: Map
    channels: Annotated[tuple[Channel, ...], Field(alias="channel", min_length=1)]
    effects: Annotated[tuple[Effect, ...], Field(alias="effect")] = ()
    preparation: tuple[Step, ...] = ()
    simulator: PathText | None = None
    nuisances: Annotated[tuple[Nuisance, ...], Field(alias="nuisance")] = ()
    biposh: Biposh = Biposh()
    ensemble: Ensemble = Ensemble()
    compute: Compute = Compute()

    @property
    def each_map(self) -> tuple[MapOf, ...]:
        """Maps of one realization, channel by channel, split by split."""
        return tuple(MapOf(channel, split) for channel in self.channels for split in self.map.each_split)

    def of_channels(self, *names: str) -> Self:
        """Return the run with these of its channels alone, and with what acts in them."""
        steps = []
        for step in self.preparation:
            own = getattr(step, "channels", ())
            kept = tuple(name for name in own if name in names)
            if kept or not own:
                steps.append(replace(step, channels=kept) if own else step)  # type: ignore[arg-type]
        return replace(
            self,
            channels=tuple(channel for channel in self.channels if channel.name in names),
            effects=tuple(one for one in self.effects if one.channel in (None, *names)),
            nuisances=tuple(one for one in self.nuisances if one.channel in (None, *names)),
            preparation=tuple(steps),
        )

    def unfiltered(self) -> Self:
        """Return the run with an estimator that does not filter."""
        return replace(self, biposh=replace(self.biposh, filter="none", probes=None))

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        names = tuple(channel.name for channel in self.channels)
        limit, of = check_steps(self.preparation, self.map.resolution, self.map.frame, names)
        lmax = analysis_lmax(self)
        key = "biposh.lmax" if self.biposh.lmax is not None else "biposh.lmax (by default sky.lmax)"
        if lmax > self.sky.lmax:
            raise ValueError(f"{key} = {lmax} is above sky.lmax = {self.sky.lmax}; lower it or raise sky.lmax")
        if self.map.grid == "gl":
            check_rings(self)
        elif lmax > limit:
            raise ValueError(
                f"{key} = {lmax} is above 3 nside - 1 = {limit} of {of}; "
                f"set biposh.lmax to at most {limit} or raise nside"
            )
        check_filter(self)
        if self.simulator is not None and self.ensemble.maps is not None:
            raise ValueError("both simulator and ensemble.maps are given; keep one of them")
        if self.biposh.L_max > lmax:
            raise ValueError(f"biposh.L_max = {self.biposh.L_max} is above the lmax of the analysis, {lmax}; lower it")
        try:
            unique(names)
        except ValueError as error:
            raise ValueError(f"channel {error}") from None
        acting = [(f"effect {one.name}", one.channel) for one in self.effects]
        acting += [(f"nuisance {one.effect}", one.channel) for one in self.nuisances]
        for what, where in acting:
            if where is not None and where not in names:
                raise ValueError(f"{what}: channel = {where!r} is no channel of the run; use one of {', '.join(names)}")
        masked = self.map.mask is not None or any(channel.mask is not None for channel in self.channels)
        if not masked and (self.map.mask_frame is not None or self.map.mask_apodisation_deg > 0.0):
            key = "mask_frame" if self.map.mask_frame is not None else "mask_apodisation_deg"
            raise ValueError(f"map: {key} is given without a mask; add mask or remove {key}")
        for channel in self.channels:
            check_splits(channel, self.map.splits, self.map.split_by)
            for key in ("beam", "beam_b"):
                m_max = getattr(getattr(channel, key), "m_max", None)
                if m_max is not None and m_max > self.sky.lmax:
                    where = f"channel[{channel.name}].{key}.m_max = {m_max}"
                    raise ValueError(f"{where} is above sky.lmax = {self.sky.lmax}; lower m_max")
        return self


def analysis_lmax(config: RunConfig) -> int:
    """Return the highest degree of the analysis of the maps."""
    return config.sky.lmax if config.biposh.lmax is None else config.biposh.lmax


def pixel_window(config: RunConfig, channel: Channel) -> str:
    """Return the pixel window of a channel: "computed", "none" or the path of a FITS file."""
    if config.map.grid == "gl":
        return "none"
    if config.map.pixel_window is not None:
        return config.map.pixel_window
    return "none" if isinstance(channel.scan, ScanParallelTransport) else "computed"


def map_names(config: RunConfig) -> tuple[str, ...]:
    """Return the names of the maps of one realization: "channel", or "channel:split" for each split."""
    return tuple(one.name for one in config.each_map)
