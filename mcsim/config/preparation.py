"""Steps of ``[[preparation]]``: what was done to the maps of the data after map-making, in its order."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from mcsim.config.values import STRICT, Frame, Fwhm, Label, Nside, PathText


@dataclass(frozen=True, kw_only=True, config=STRICT)
class _Masked:
    """Keys of steps that may have a mask, and be of some channels only."""

    mask: PathText | None = None
    mask_frame: Frame | None = None
    channels: tuple[Label, ...] = ()

    @model_validator(mode="after")
    def _frame_of_a_mask(self) -> Self:
        if self.mask is None and self.mask_frame is not None:
            raise ValueError("mask_frame is given without a mask; name the mask, or remove mask_frame")
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Degrade:
    """Coarser pixels, with ``nside`` below that of the maps so far.

    ``method``: "average" takes the mean of the observed pixels, as ``healpy.ud_grade`` does; "harmonics" takes a_lm up
    to 3 nside - 1 and exchanges the pixel window for that of the coarse pixels, as Planck did (arXiv:1506.07135).
    """

    kind: Literal["degrade"] = "degrade"
    nside: Nside
    method: Literal["average", "harmonics"] = "average"


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Smooth:
    """From the map's own beam to a target beam, in harmonics.

    ``fwhm_arcmin`` or ``window``: the target, a Gaussian or a file of B_l. ``own_fwhm_arcmin`` (0: none) or
    ``own_window``: the map's own; default: the target of the step "smooth" before, or else the circular part of the
    channel's beam. ``channels``: default: all.
    """

    kind: Literal["smooth"] = "smooth"
    fwhm_arcmin: Fwhm | None = None
    window: PathText | None = None
    own_fwhm_arcmin: Annotated[float, Field(ge=0.0, le=10800.0)] | None = None
    own_window: PathText | None = None
    channels: tuple[Label, ...] = ()

    @model_validator(mode="after")
    def _one_target(self) -> Self:
        if (self.fwhm_arcmin is None) == (self.window is None):
            raise ValueError("the target beam is not one: give either fwhm_arcmin or window")
        if self.own_fwhm_arcmin is not None and self.own_window is not None:
            raise ValueError("both own_fwhm_arcmin and own_window are given; keep one of them")
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SubtractDipole(_Masked):
    """Monopole and dipole, fitted by least squares with the weights of ``mask``, subtracted everywhere."""

    kind: Literal["subtract_dipole"] = "subtract_dipole"
    monopole: bool = True
    dipole: bool = True

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not (self.monopole or self.dipole):
            raise ValueError("neither monopole nor dipole is subtracted; set one of them to true")
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Templates(_Masked):
    """Maps ``templates`` (uK), fitted by least squares with the weights of ``mask``, or times given ``coefficients``.

    ``monopole``, ``dipole``: fitted along, and subtracted too. With ``coefficients`` the data are taken to hold this
    foreground and the simulated skies not, so nothing is subtracted from simulated maps, unless ``simulated`` says
    that their skies (``sky.map``, ``sky.alm``, an effect) hold it as well.
    """

    kind: Literal["templates"] = "templates"
    templates: Annotated[tuple[PathText, ...], Field(min_length=1)]
    coefficients: tuple[float, ...] | None = None
    simulated: bool = False
    monopole: bool = False
    dipole: bool = False

    @model_validator(mode="after")
    def _fitted_or_given(self) -> Self:
        if self.coefficients is None:
            return self
        if len(self.coefficients) != len(self.templates):
            raise ValueError(
                f"coefficients has {len(self.coefficients)} numbers for {len(self.templates)} templates; "
                "give one for each"
            )
        if self.monopole or self.dipole or self.mask is not None:
            raise ValueError("coefficients are given, so nothing is fitted; remove mask, monopole and dipole")
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Fill(_Masked):
    """Values for pixels that were not observed or where ``mask`` is 0.

    ``method``: "diffuse" gives every such pixel the mean of its neighbours; "constant" gives it ``value_uk``.
    """

    kind: Literal["fill"] = "fill"
    method: Literal["diffuse", "constant"] = "diffuse"
    value_uk: float = 0.0

    @model_validator(mode="after")
    def _value_of_a_constant(self) -> Self:
        if self.method == "diffuse" and self.value_uk != 0.0:
            raise ValueError('value_uk is given, but method = "diffuse" takes means; set method = "constant"')
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Mask:
    """Product with a map of weights between 0 and 1, apodised or not as the file is."""

    kind: Literal["mask"] = "mask"
    mask: PathText
    mask_frame: Frame | None = None
    channels: tuple[Label, ...] = ()


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Rotate:
    """Rotation into another frame, in harmonics up to 2 nside."""

    kind: Literal["rotate"] = "rotate"
    frame: Frame


OtherStep = Degrade | SubtractDipole | Templates | Fill | Mask | Rotate  #: those that leave the beam as it is
Step = Annotated[OtherStep | Smooth, Field(discriminator="kind")]
STEPS = (Degrade, Smooth, SubtractDipole, Templates, Fill, Mask, Rotate)


def may_keep_pixels(step: Step) -> bool:
    """Return True for a step that fits and subtracts, or masks: the rest of a map stays, but for soft masks."""
    return isinstance(step, SubtractDipole | Mask) or (isinstance(step, Templates) and step.coefficients is None)


def grid_after(steps: Sequence[Step], nside: int, frame: str) -> tuple[int, str]:
    """Return nside and frame of maps after the steps."""
    for step in steps:
        if isinstance(step, Degrade):
            nside = step.nside
        elif isinstance(step, Rotate):
            frame = step.frame
    return nside, frame


def frame_of(plain: Mapping[str, Any]) -> str:
    """Return the frame of prepared maps from a configuration as a plain dict, such as a store's attribute."""
    steps = plain.get("preparation", ())
    return str([plain["map"]["frame"], *(step["frame"] for step in steps if step["kind"] == "rotate")][-1])


def check_steps(steps: Sequence[Step], nside: int, frame: str, channels: Sequence[str]) -> tuple[int, str]:
    """Return 3 nside - 1 of prepared maps and their nside in words; raise ValueError for a step that fits badly."""
    made = nside
    for number, step in enumerate(steps):
        key = f"preparation[{number}]"
        if isinstance(step, Degrade) and step.nside >= nside:
            raise ValueError(
                f"{key}.nside = {step.nside} is not below the {nside} of the maps before it; map.nside is that of the "
                "maps that are made, so raise map.nside or lower this one"
            )
        if isinstance(step, Rotate) and step.frame == frame:
            raise ValueError(f'{key}.frame = "{step.frame}" is the frame of the maps before it; remove the step')
        unknown = [name for name in getattr(step, "channels", ()) if name not in channels]
        if unknown:
            raise ValueError(
                f"{key}.channels names {unknown[0]!r}, which is no channel of the run; use {', '.join(channels)}"
            )
        nside, frame = grid_after([step], nside, frame)
    return 3 * nside - 1, f"{'map.nside' if nside == made else 'the prepared maps, nside'} = {nside}"
