"""Write self-contained HTML pages: templates filled in, pictures inside."""

import base64
import io
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2

if TYPE_CHECKING:  # matplotlib loads slowly
    from matplotlib.figure import Figure


def png(figure: "Figure", dpi: int) -> bytes:
    """Return a figure as PNG, the same bytes for the same figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, facecolor="white", metadata={"Software": None})
    return buffer.getvalue()


def embedded(picture: bytes) -> str:
    """Return a PNG as base64, for ``src="data:image/png;base64,..."``."""
    return base64.b64encode(picture).decode("ascii")


def render(template: Path, filters: Mapping[str, Callable[..., Any]], **values: Any) -> str:
    """Fill in a jinja2 template: values by name, and the ``version`` of mcsim.

    Whatever comes from outside it is escaped, and a name that it lacks is an error.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(template.parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= filters
    return environment.get_template(template.name).render(version=version("mcsim"), **values)
