"""Noise of a channel: kinds of ``noise`` in a run. Each describes every map of the channel: every split by itself."""

from typing import Annotated, Any, Literal, Self, get_args

from pydantic import Discriminator, Field, Tag, model_validator
from pydantic.dataclasses import dataclass

from mcsim.config.values import STRICT, PathText
from mcsim.errors import InputError

Level = Annotated[float, Field(ge=0.0)]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Noise:
    """White noise per sample; the variance of a pixel is sigma0_uk^2 / hits. Differencing: per difference.

    ``hits``: a map of the number of observations (N_OBS, HITS) in place of the scan's hits.
    """

    kind: Literal["white"] = "white"
    sigma0_uk: Level = 0.0
    hits: PathText | None = None


@dataclass(frozen=True, kw_only=True, config=STRICT)
class NoiseDepth:
    """White noise of the same level in every observed pixel, uK times arcmin."""

    kind: Literal["depth"] = "depth"
    depth_uk_arcmin: Level


@dataclass(frozen=True, kw_only=True, config=STRICT)
class NoiseVariance:
    """White noise with a map of variances per pixel (such as II_COV), uK^2 unless the file names another unit."""

    kind: Literal["variance"] = "variance"
    variance: PathText


@dataclass(frozen=True, kw_only=True, config=STRICT)
class NoiseDifference:
    """White noise whose level is estimated from the differences of observed splits ``maps``.

    The variance of a pixel is proportional to 1 / hits, or ``isotropic``. ``hits``: a map for each split; default:
    columns beside the temperatures. ``mask``: pixels to estimate from.
    """

    kind: Literal["difference"] = "difference"
    maps: tuple[PathText, ...]
    hits: tuple[PathText, ...] = ()
    isotropic: bool = False
    mask: PathText | None = None

    @model_validator(mode="after")
    def _as_many_hits(self) -> Self:
        if len(self.maps) < 2:
            raise ValueError(f"maps names {len(self.maps)} split, but a difference is of 2 or more; give their maps")
        if any("{split}" in path for path in self.hits):
            raise ValueError("hits contains {split}, but it lists the maps of all splits; name each")
        if self.hits and self.isotropic:
            raise ValueError("hits are given, but isotropic noise does not depend on them; remove one of them")
        if self.hits and len(self.hits) != len(self.maps):
            raise ValueError(f"hits has {len(self.hits)} maps for {len(self.maps)} splits; give one for each")
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class NoiseRealizations:
    """Noise maps from files, one for each realization: a template with {realization}."""

    kind: Literal["realizations"] = "realizations"
    files: PathText

    @model_validator(mode="after")
    def _one_each(self) -> Self:
        if "{realization" not in self.files:
            raise ValueError(
                f"files = {self.files!r} names one file for all realizations; put {{realization}} in the name, and "
                "give a file for each"
            )
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class NoiseCorrelated:
    """Noise of samples with a 1/f spectrum, brought into maps as the survey's were made.

    The power spectrum is that of white noise of ``sigma0_uk`` per sample times
    [(f^2 + f_knee^2) / (f^2 + f_min^2)]^(alpha / 2). ``map_making``: "binned" takes the means of the samples;
    "destriped" fits and subtracts an offset for every ``baseline_s`` (default: a turn of the spin) before.
    """

    kind: Literal["correlated"] = "correlated"
    sigma0_uk: Annotated[float, Field(gt=0.0)]
    f_knee_hz: Annotated[float, Field(gt=0.0)]
    f_min_hz: Annotated[float, Field(gt=0.0)]
    alpha: Annotated[float, Field(gt=0.0, le=2.0)] = 1.0
    map_making: Literal["binned", "destriped"] = "binned"
    baseline_s: Annotated[float, Field(gt=0.0)] | None = None

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.f_min_hz >= self.f_knee_hz:
            raise ValueError(
                f"f_min_hz = {self.f_min_hz:g} is not below f_knee_hz = {self.f_knee_hz:g}; lower f_min_hz"
            )
        if self.baseline_s is not None and self.map_making == "binned":
            raise ValueError('baseline_s is given, but map_making = "binned" has no baselines; set it to "destriped"')
        return self


def _kind(given: Any) -> Any:
    """Return the kind of noise; a table without one is of white noise."""
    return given.get("kind", "white") if isinstance(given, dict) else getattr(given, "kind", None)


AnyNoise = Annotated[
    Annotated[Noise, Tag("white")]
    | Annotated[NoiseDepth, Tag("depth")]
    | Annotated[NoiseVariance, Tag("variance")]
    | Annotated[NoiseDifference, Tag("difference")]
    | Annotated[NoiseRealizations, Tag("realizations")]
    | Annotated[NoiseCorrelated, Tag("correlated")],
    Discriminator(_kind),
]
NOISES: dict[str, Any] = {get_args(each)[0].kind: get_args(each)[0] for each in get_args(get_args(AnyNoise)[0])}


def is_noise_free(noise: Any) -> bool:
    """Return True if the noise is zero everywhere."""
    if isinstance(noise, NoiseDepth):
        return noise.depth_uk_arcmin == 0.0
    return isinstance(noise, Noise) and noise.sigma0_uk == 0.0


def in_words(noise: Any) -> str:
    """Return key and value that give a channel noise, for messages."""
    if isinstance(noise, Noise):
        return f"noise.sigma0_uk = {noise.sigma0_uk:g}"
    return f'noise.kind = "{noise.kind}"'


def check_differences(noise: Any, split_noise: dict[str, Any]) -> None:
    """Raise ValueError unless noise is of the samples of a differencing scan, the same for all splits."""
    if isinstance(noise, Noise) and noise.hits is None and not split_noise:
        return
    key = "split_noise" if split_noise else "noise.hits" if isinstance(noise, Noise) else in_words(noise)
    raise ValueError(
        f"{key} is given, but the maps of a differencing scan are made from differences; give their noise as "
        "noise.sigma0_uk alone"
    )


def check_own_files(run: Any, where: str) -> None:
    """Raise InputError for maps of a run that share their noise, and splits whose hits or variances are one file.

    Each map has noise of its own, and ``noise`` describes every split by itself: hits of a whole survey are not those
    of its parts. A ``split_noise`` for each split may name one file.
    """
    of_realizations: dict[str, str] = {}
    for one in run.each_map:
        noise, key = one.channel.noise_of(one.split), f"channel[{one.channel.name}].noise"
        if isinstance(noise, NoiseRealizations):
            files = noise.files.replace("{channel}", one.channel.name).replace("{split}", str(one.split))
            if files in of_realizations:
                raise InputError(
                    f"{where}: {key}.files = {noise.files!r} gives the maps {of_realizations[files]} and {one.name} "
                    "one and the same noise; name files of their own, with {channel} or {split} in the name."
                )
            of_realizations[files] = one.name
        shared = [name for name in run.map.splits if name not in one.channel.split_noise]
        field = "variance" if isinstance(noise, NoiseVariance) else "hits"
        file = getattr(noise, field, None)
        if one.split in shared[1:] and isinstance(noise, Noise | NoiseVariance) and file and "{split}" not in file:
            raise InputError(
                f"{where}: {key}.{field} = {file!r} is one file for the splits {', '.join(shared)}, but each has "
                f"{field if field == 'hits' else 'variances'} of its own; put {{split}} in the name, or give each its "
                "file in split_noise."
            )


def check_splits(channel: Any, splits: tuple[str, ...], split_by: str) -> None:
    """Raise ValueError for splits that the scan or the noise of a channel does not have."""
    key = f"channel[{channel.name}]"
    known = f"use one of {', '.join(splits)}" if splits else "name the splits in map.splits"
    for name in channel.split_noise:
        if name not in splits:
            raise ValueError(f"{key}.split_noise.{name} is no split of the run; {known}")
    if split_by == "rings" and channel.scan.kind == "differencing":
        raise ValueError(
            f'map.split_by = "rings" needs rings of one beam, but {key}.scan is of kind "differencing"; split by "time"'
        )
    path = str(getattr(channel.scan, "path", "{split}"))
    if splits and split_by == "time" and "{split}" not in path:
        raise ValueError(
            f"{key}.scan.path is one file of the whole survey, but map.splits are parts of its time; give each a file, "
            'with {split} in the path, or set map.split_by = "rings" (a share of every pixel\'s hits)'
        )
    for name, noise in (("noise", channel.noise), *((f"split_noise.{k}", n) for k, n in channel.split_noise.items())):
        if isinstance(noise, NoiseCorrelated) and channel.scan.kind != "hit_averaged":
            raise ValueError(
                f'{key}.{name}.kind = "correlated" needs the times of the samples, but {key}.scan is of kind '
                f'"{channel.scan.kind}"; give a scan of kind "hit_averaged"'
            )
        if isinstance(noise, NoiseDifference) and splits and len(noise.maps) != len(splits):
            raise ValueError(
                f"{key}.{name}.maps names {len(noise.maps)} maps, but map.splits has {len(splits)}; give the map of "
                "each, in their order"
            )
    line = getattr(channel.scan, "line_of_sight", None) or ""
    if "{split}" in line and not splits:
        raise ValueError(f"{key}.scan.line_of_sight = {line!r} contains {{split}}, but map.splits is empty; {known}")
