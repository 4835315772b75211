"""Equations as MathML, which browsers draw by themselves: no script, no font and no network is needed."""

import re
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.locale import __
from sphinx.util import logging

logger = logging.getLogger(__name__)


def _rendered(self: Any, node: nodes.Element, as_block: bool) -> str:
    """Return MathML of a node, and warn where its LaTeX is beyond docutils."""
    try:
        return tex2mathml(node.astext(), as_block=as_block)
    except (MathError, ExtensionError, SyntaxError, ValueError, KeyError, IndexError) as error:
        logger.warning(__("equation not understood: %s: %s"), error, node.astext(), location=node)
        return f"<code>{self.encode(node.astext())}</code>"


def _inline(self: Any, node: nodes.Element) -> None:
    self.body.append(_rendered(self, node, as_block=False))
    raise nodes.SkipNode


def _display(self: Any, node: nodes.Element) -> None:
    anchor = f' id="{node["ids"][0]}"' if node.get("ids") else ""
    number = ""
    if node.get("number"):
        number = f'<span class="eqno">({node["number"]})</span>'
    body = re.sub(r"\s*\n\s*", " ", _rendered(self, node, as_block=True))
    self.body.append(f'<div class="equation"{anchor}>{body}{number}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the renderer."""
    app.add_html_math_renderer("mathml", (_inline, None), (_display, None))
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
