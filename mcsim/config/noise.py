"""Noise of a channel: kinds of ``noise`` in a run. Each describes every map of the channel: every split by itself."""

from typing import Annotated, Any, Literal, get_args

from pydantic import Discriminator, Field, Tag
from pydantic.dataclasses import dataclass

from mcsim.config.values import STRICT, PathText

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


def _kind(given: Any) -> Any:
    """Return the kind of noise; a table without one is of white noise."""
    return given.get("kind", "white") if isinstance(given, dict) else getattr(given, "kind", None)


AnyNoise = Annotated[
    Annotated[Noise, Tag("white")] | Annotated[NoiseDepth, Tag("depth")] | Annotated[NoiseVariance, Tag("variance")],
    Discriminator(_kind),
]
NOISES: dict[str, Any] = {get_args(each)[0].kind: get_args(each)[0] for each in get_args(get_args(AnyNoise)[0])}
OF_SAMPLES = (Noise,)
"""Kinds that a differencing scan can have: their noise is per sample."""


def is_noise_free(noise: Any) -> bool:
    """Return True if the noise is zero everywhere."""
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
    line = getattr(channel.scan, "line_of_sight", None) or ""
    if "{split}" in line and not splits:
        raise ValueError(f"{key}.scan.line_of_sight = {line!r} contains {{split}}, but map.splits is empty; {known}")
