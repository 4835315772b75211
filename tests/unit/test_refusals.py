"""Refusals are tested by type and by what they name, never by their wording."""

import ast
from pathlib import Path

import pytest

from refusals import refused, unnamed

TEXT = "configuration: map.nside = 100 in /tmp/x/run.toml (W1, W2) is above 10.5 uK at l = -3; lower sky.lmax."


def test_whole_names_alone_count():
    present = ("map.nside", 100, 10.5, "uK", "run.toml", "/tmp/x/run.toml", "W1, W2", -3, "l = -3", "sky.lmax")
    assert unnamed(TEXT, *present) == []
    absent = ("nside", 10, 10.0, 5, "map", "W", "run", "lmax", "sky", 1000)
    assert unnamed(TEXT, *absent) == [str(value) for value in absent]


@pytest.mark.parametrize("phrase", ["is above", "set it lower"])
def test_phrases_are_no_names(phrase):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - this is the helper that says more
        unnamed(TEXT, phrase)
    assert phrase in str(caught.value)


def test_other_exceptions_and_silence_are_failures():
    with pytest.raises(KeyError), refused("nside"):
        raise_(KeyError("nside"))
    with pytest.raises(AssertionError), refused("lmax", by=ValueError):
        raise_(ValueError("nside"))
    with pytest.raises(pytest.fail.Exception), refused("nside"):
        pass


def raise_(error: Exception) -> None:
    raise error


def test_no_test_matches_a_sentence():
    for path in Path(__file__).parents[1].rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "raises":
                assert "match" not in {keyword.arg for keyword in node.keywords}, (path.name, node.lineno)
