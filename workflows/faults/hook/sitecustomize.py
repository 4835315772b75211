"""For the fault campaign: each process writes its stack to $MCSIM_TRACE/PID when it receives SIGUSR1."""

import faulthandler
import os
import signal

_folder = os.environ.get("MCSIM_TRACE")
_held = []


def _register() -> None:
    stream = open(os.path.join(_folder, str(os.getpid())), "w")  # noqa: SIM115 (open as long as the process lives)
    _held.append(stream)
    faulthandler.register(signal.SIGUSR1, file=stream, all_threads=True)


if _folder:
    _register()
    os.register_at_fork(after_in_child=_register)
