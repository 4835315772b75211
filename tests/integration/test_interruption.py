"""Commands that are interrupted, and warnings of the command line: a sentence, and the exit code that is documented."""

import os
import signal
import subprocess
import sys
import time

import pytest

from mcsim.support import resources


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("command", [["maps", "quickstart", "-o", "here"], ["predict", "quickstart", "--exact"]])
def test_any_command_ends_in_a_sentence(tmp_path, command, number) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "mcsim.cli", *command], cwd=tmp_path, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL
    )
    status, handled = f"/proc/{process.pid}/status", 0
    if not os.path.exists(status):
        process.kill()
        pytest.skip("no list of the signals that a process handles")
    for _ in range(600):  # until the command handles the signal
        time.sleep(0.05)
        with open(status) as stream:
            handled = int(next(line for line in stream if line.startswith("SigCgt")).split()[1], 16)
        if handled >> (signal.SIGTERM - 1) & 1:
            break
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert said.decode().splitlines()[-1].startswith("mcsim: interrupted")


def test_a_warning_of_mcsim_is_a_sentence(tmp_path) -> None:
    text = resources.workflow("tiny").read_text() + '\n[[effect]]\nname = "beam_width"\nchannel = "demo"\n'
    (tmp_path / "run.toml").write_text(text)
    asked = [sys.executable, "-m", "mcsim.cli", "config", "run.toml"]
    found = subprocess.run(asked, cwd=tmp_path, capture_output=True, text=True, check=False)
    [line] = found.stderr.splitlines()
    assert line.startswith("mcsim: effect beam_width has no amplitude")
