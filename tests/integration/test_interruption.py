"""Commands that are interrupted, and warnings of the command line: a sentence, and the exit code that is documented."""

import subprocess
import sys

import pytest

from mcsim.support import resources

INTERRUPTED = """
import signal, sys
import mcsim.cli
from mcsim.ensemble import {module}

{module}.{function} = lambda *given, **named: signal.raise_signal(signal.{name})
sys.argv = ["mcsim", *{command!r}]
mcsim.cli.main()
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize(
    ("module", "function", "command"),
    [
        ("maps", "write_maps", ["maps", "tiny", "-o", "here"]),
        ("prediction", "predict", ["predict", "tiny"]),
        ("runner", "run", ["run", "tiny"]),
    ],
)
def test_any_command_ends_in_a_sentence(tmp_path, module, function, command, name) -> None:
    """The function that does the work is interrupted as soon as it is called."""
    program = INTERRUPTED.format(module=module, function=function, command=command, name=name)
    found = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert found.returncode == 130
    [line] = found.stderr.splitlines()
    assert line.startswith("mcsim: interrupted; what is finished is kept")


def test_a_warning_of_mcsim_is_a_sentence(tmp_path) -> None:
    text = resources.workflow("tiny").read_text() + '\n[[effect]]\nname = "beam_width"\nchannel = "demo"\n'
    (tmp_path / "run.toml").write_text(text)
    asked = [sys.executable, "-m", "mcsim.cli", "config", "run.toml"]
    found = subprocess.run(asked, cwd=tmp_path, capture_output=True, text=True, check=False)
    [line] = found.stderr.splitlines()
    assert line.startswith("mcsim: effect beam_width has no amplitude")
