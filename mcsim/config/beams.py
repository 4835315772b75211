"""Beams of a channel: kinds of ``beam`` and ``beam_b`` in a run."""

from typing import Annotated, Any, Literal, Self, get_args

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from mcsim.config.values import STRICT, BeamOrder, Fwhm, PathText


@dataclass(frozen=True, kw_only=True, config=STRICT)
class BeamGaussian:
    """Circular Gaussian."""

    kind: Literal["gaussian"] = "gaussian"
    fwhm_arcmin: Fwhm


@dataclass(frozen=True, kw_only=True, config=STRICT)
class BeamEllipticalGaussian:
    """Elliptical Gaussian; ``angle_deg`` is that of the major axis, from the beam's x axis towards y."""

    kind: Literal["elliptical_gaussian"] = "elliptical_gaussian"
    fwhm_major_arcmin: Fwhm
    fwhm_minor_arcmin: Fwhm
    angle_deg: float = 0.0
    m_max: BeamOrder = None

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.fwhm_major_arcmin < self.fwhm_minor_arcmin:
            raise ValueError(
                f"fwhm_major_arcmin = {self.fwhm_major_arcmin:g} is smaller than "
                f"fwhm_minor_arcmin = {self.fwhm_minor_arcmin:g}; exchange them and add 90 to angle_deg"
            )
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class BeamMap:
    """Two-dimensional beam map in FITS.

    ``pixel_deg``: by default from the file. ``centre_pixel`` (column, row): by default the intensity centroid.
    ``plane``: one image of a cube. ``angle_deg``: rotation of the beam about its axis, from x towards y.
    """

    kind: Literal["map"] = "map"
    path: PathText
    pixel_deg: Annotated[float, Field(gt=0.0, le=10.0)] | None = None
    cut_deg: Annotated[float, Field(gt=0.0, le=90.0)] = 3.5
    centre_pixel: tuple[float, float] | None = None
    plane: Annotated[int, Field(ge=0)] = 0
    projection: Literal["equidistant", "orthographic", "equal_area"] = "equidistant"
    angle_deg: float = 0.0
    m_max: BeamOrder = None


@dataclass(frozen=True, kw_only=True, config=STRICT)
class BeamBlm:
    """File of b_lm; ``angle_deg`` rotates the beam about its axis, from x towards y."""

    kind: Literal["blm"] = "blm"
    path: PathText
    angle_deg: float = 0.0
    m_max: BeamOrder = None


@dataclass(frozen=True, kw_only=True, config=STRICT)
class BeamWindow:
    """Circular beam from a table of B_l: text, .npy or FITS (``extension`` and ``column`` if it leaves a choice)."""

    kind: Literal["window"] = "window"
    path: PathText
    extension: str | None = None
    column: str | None = None


AnyBeam = BeamGaussian | BeamEllipticalGaussian | BeamMap | BeamBlm | BeamWindow
BEAMS: dict[str, Any] = {each.kind: each for each in get_args(AnyBeam)}
