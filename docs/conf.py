"""Configuration of the documentation; ``python -m sphinx -W --keep-going -b html docs docs/_build/html`` builds it.

Nothing is read from the network: the site has its own MathJax, the theme its own search, and no other index is read.
"""

import os
import re
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
# The kernels of the tutorials import the same package as this file, and find the command that is installed beside it.
os.environ["PYTHONPATH"] = os.pathsep.join([str(HERE.parent), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])

from numpy.typing import ArrayLike  # noqa: E402
from sphinx.util.typing import stringify_annotation  # noqa: E402

import mcsim  # noqa: E402
from mcsim import systematics  # noqa: E402

project = "mcsim"
author = "the mcsim authors"
copyright = "the mcsim authors; GPL-2.0-or-later"
html_title = "mcsim"

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "sphinx-mathjax-offline",  # MathJax itself, copied into the site
]
exclude_patterns = ["_build", "README.md", "tutorials/_*"]
templates_path = ["_templates"]

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["mcsim.css"]
html_theme_options = {"navigation_with_keys": True}

myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "colon_fence", "attrs_inline"]
myst_heading_anchors = 3
myst_dmath_double_inline = False
suppress_warnings = [
    "ref.python",  # a public name stands on two pages: where it is made, and where it is offered
]

# Tutorials: run when the site is built, kept until their text changes. A tutorial that fails fails the build.
nb_execution_mode = "cache"
nb_execution_cache_path = str(HERE / "_build" / "tutorials")
nb_execution_timeout = 900
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_execution_show_tb = True
nb_merge_streams = True

autosummary_generate = True
autosummary_ignore_module_all = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True}
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
python_maximum_signature_line_length = 88


def _public(app: Any, docname: str, source: list[str]) -> None:
    """Write names and effects into the pages that have a place for them, so that none is forgotten."""
    if "PUBLIC-NAMES" in source[0]:
        entries = []
        for name in sorted((name for name in mcsim.__all__ if not name.startswith("_")), key=str.lower):
            kind = "autoclass" if isinstance(getattr(mcsim, name), type) else "autofunction"
            entries.append(f".. {kind}:: mcsim.{name}\n")
        source[0] = source[0].replace("PUBLIC-NAMES", "\n".join(entries))
    if source[0].startswith("README-OF "):
        source[0] = _readme(docname, source[0].removeprefix("README-OF ").strip())
    if "EFFECTS-TABLE" in source[0]:
        source[0] = source[0].replace("EFFECTS-TABLE", "\n\n".join(_described(kind) for kind in _library()))


def _readme(docname: str, name: str) -> str:
    """Return the README of a folder of ``workflows``, its links made those of this site."""
    folder = HERE.parent / "workflows" / name
    pages = {str(path): page for page, path in _shown()}

    def link(match: re.Match[str]) -> str:
        path, _, section = match[1].partition("#")
        target = os.path.normpath(folder / path)
        if target in pages:
            return f"](/{pages[target]}.md{'#' + section if section else ''})"
        return f"]({os.path.relpath(target, (HERE / docname).parent)}{'#' + section if section else ''})"

    return re.sub(r"\]\(((?!https?:|#)[^)]+)\)", link, (folder / "README.md").read_text())


def _shown() -> list[tuple[str, Path]]:
    """Return the pages that show a README, with the path of that."""
    found = []
    for page in HERE.glob("*/*.md"):
        text = page.read_text()
        if text.startswith("README-OF "):
            path = HERE.parent / "workflows" / text.removeprefix("README-OF ").strip() / "README.md"
            found.append((page.relative_to(HERE).with_suffix("").as_posix(), path))
    return found


def _library() -> list[Any]:
    """Return the effects that come with mcsim, in the order of their names."""
    found = systematics.catalogue()
    return [kind for _, kind in sorted(found.items()) if kind.__module__.startswith("mcsim.")]


def _described(kind: Any) -> str:
    """Return a section on an effect, from what its class says."""
    settings = [f"`{field.name}` ({field.default!r})" for field in fields(kind) if field.name != "amplitude"]
    rows = [
        ("Scope", kind.scope),
        ("Amplitude", kind.unit),
        ("Other parameters", ", ".join(settings)),
        *(("Possible", f"`{one.parameter}` from {one.low:g} to {one.high:g}: {one.source}") for one in kind.bounds),
        ("Cause", kind.cause),
        ("Shows as", kind.signature),
        ("Source", kind.source),
        ("Proposed", "" if kind.proposed else "on request"),
    ]
    lines = "\n".join(f"- **{name}**: {text}" for name, text in rows if text)
    summary = str(kind.__doc__).split("\n\n")[0].replace("\n", " ")
    return f"## {kind.name}\n\n{summary}\n\n{lines}"


_UNPAIRED = re.compile(r"(?<!\w)\*(?=\S)(?=[^*]*$)")
"""A star that would begin an emphasis, but for which none ends it on the line."""


def _plain(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Keep bars of absolute values and lone stars from being read as markup, outside of quotes and literal blocks."""
    literal = -1  # indentation of the line that began a literal block
    for number, line in enumerate(lines):
        indentation = len(line) - len(line.lstrip())
        if literal >= 0 and line.strip() and indentation <= literal:
            literal = -1
        if literal < 0:
            parts = line.split("``")
            parts[::2] = [_UNPAIRED.sub(r"\*", part).replace("|", r"\|") for part in parts[::2]]
            lines[number] = "``".join(parts)
        if line.rstrip().endswith("::"):
            literal = indentation


_ARRAY_LIKE = stringify_annotation(ArrayLike, "smart")


def _named(
    app: Any, what: str, name: str, obj: Any, options: Any, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """Write ArrayLike by its name, which numpy's alias does not keep, in place of all that it stands for."""
    return signature and signature.replace(_ARRAY_LIKE, "~numpy.typing.ArrayLike"), returned


def _forget(app: Any) -> None:
    """Remove the pages of modules that are gone."""
    for page in (HERE / "reference" / "generated").glob("mcsim.*.rst"):
        parts = page.stem.split(".")[1:]
        place = HERE.parent.joinpath("mcsim", *parts)
        if not (place.is_dir() or place.with_suffix(".py").is_file()):
            page.unlink()


def setup(app: Any) -> None:
    """Connect the hooks."""
    app.connect("builder-inited", _forget, priority=1)
    app.connect("source-read", _public)
    app.connect("autodoc-process-docstring", _plain)
    app.connect("autodoc-process-signature", _named)
