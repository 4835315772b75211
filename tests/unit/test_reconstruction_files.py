"""What the Python files of reconstructed effects say of their use."""

import ast
import tomllib

import pytest

from mcsim.reconstruction.plugin import Plugin


@pytest.mark.parametrize("channel", ["V1", 'é "1"', 'W """ 1'])
def test_a_file_says_how_it_is_used_whatever_the_channel_is_called(channel):
    for base, values in (("BeamOrder", {"order": 0}), ("BoostedSky", {"velocity": (0.0, 0.0, 0.1)})):
        text = Plugin("unlisted_1", base, channel, values).source(f"Of {channel}.")
        (said, *_) = ast.parse(text).body
        (table,) = tomllib.loads(said.value.value.split("\n\n")[2])["effect"]
        assert table.get("channel") == (channel if base == "BeamOrder" else None)
