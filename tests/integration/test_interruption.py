"""Commands that are interrupted, and warnings of the command line: a sentence, and the exit code that is documented."""

import subprocess
import sys

import pytest

from mcsim.support import resources

INTERRUPTED = """
import signal, sys
import mcsim.cli
from mcsim.{package} import {module}

{module}.{function} = lambda *given, **named: signal.raise_signal(signal.{name})
sys.argv = ["mcsim", *{command!r}]
mcsim.cli.main()
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize(
    ("module", "function", "command", "kept"),
    [
        (
            "ensemble.maps",
            "write_maps",
            ["maps", "tiny", "-o", "here"],
            "finished maps are kept, and mcsim maps goes on",
        ),
        ("ensemble.prediction", "predict", ["predict", "tiny"], "call mcsim predict again"),
        ("ensemble.runner", "run", ["run", "tiny"], "finished realizations are kept, and mcsim run goes on"),
        (
            "benchmark.challenge",
            "make",
            ["challenge", "make", "tiny", "-o", "here"],
            "finished simulations and cases are kept, and mcsim challenge make goes on",
        ),
        (
            "benchmark.score",
            "score_draws",
            ["challenge", "draws", "tiny", "-o", "here"],
            "finished simulations of the model are kept, and mcsim challenge draws goes on",
        ),
    ],
)
def test_any_command_ends_in_a_sentence(tmp_path, module, function, command, kept, name) -> None:
    """The function that does the work is interrupted as soon as it is called."""
    package, _, module = module.partition(".")
    program = INTERRUPTED.format(package=package, module=module, function=function, command=command, name=name)
    found = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert found.returncode == 130
    [line] = found.stderr.splitlines()
    assert line.startswith(f"mcsim: interrupted; {kept}")


def test_a_warning_of_mcsim_is_a_sentence(tmp_path) -> None:
    text = resources.workflow("tiny").read_text() + '\n[[effect]]\nname = "beam_width"\nchannel = "demo"\n'
    (tmp_path / "run.toml").write_text(text)
    asked = [sys.executable, "-m", "mcsim.cli", "config", "run.toml"]
    found = subprocess.run(asked, cwd=tmp_path, capture_output=True, text=True, check=False)
    [line] = found.stderr.splitlines()
    assert line.startswith("mcsim: effect beam_width has no amplitude")
