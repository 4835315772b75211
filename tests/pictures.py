"""Pictures of reports that are drawn once and small, for tests of what stands around them."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import pytest

from mcsim.support import page

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@contextmanager
def quick_pictures(empty: bool = False) -> Iterator[None]:
    """Draw the pictures of pages with 30 dots per inch and no layout engine, which draws a figure twice.

    Or leave them ``empty``: their figures are made, and not drawn.
    """
    png = page.png

    def quick(figure: "Figure", dpi: int) -> bytes:
        figure.set_layout_engine(None)
        return b"" if empty else png(figure, 30)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "png", quick)
        yield
