"""Pages: what comes from outside is escaped, what a template lacks is an error, pictures are inside."""

import base64

import jinja2
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from mcsim.support import page


@given(st.text(max_size=50))
def test_what_comes_from_outside_is_escaped(tmp_path_factory, text):
    template = tmp_path_factory.mktemp("page") / "page.j2"
    template.write_text("<p>{{ text | twice }}</p>")
    inside = page.render(template, {"twice": lambda value: 2 * value}, text=text)[3:-4]
    assert not set(inside) & set("<>\"'")
    assert inside.count("&") == 2 * sum(text.count(sign) for sign in "&<>\"'")


def test_a_name_that_a_template_lacks_is_an_error(tmp_path):
    (tmp_path / "page.j2").write_text("{{ nothing }}")
    with pytest.raises(jinja2.UndefinedError):
        page.render(tmp_path / "page.j2", {})


def test_the_same_figure_is_the_same_picture():
    first, second = (page.png(Figure(figsize=(1.0, 1.0)), 50) for _ in range(2))
    assert first == second
    assert first.startswith(b"\x89PNG")
    assert base64.b64decode(page.embedded(first)) == first
