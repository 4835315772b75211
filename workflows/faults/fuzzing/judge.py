"""How an input may end: in a result or in one sentence, soon."""

import contextlib
import faulthandler
import io
import signal
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

from mcsim.errors import InputError, RunError

LIMIT_S = 10.0


class Slow(BaseException):
    """An input took longer than the limit; no ``except Exception`` swallows it."""


@dataclass
class Outcome:
    """How many inputs ended how, and what went wrong."""

    ends: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    slowest_s: float = 0.0


@contextlib.contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raise :class:`Slow` in what takes longer."""

    def late(number: int, frame: FrameType | None) -> None:
        raise Slow

    before = signal.signal(signal.SIGPROF, late)  # processor time: other work on the machine is not this input's
    faulthandler.dump_traceback_later(30.0 * seconds, exit=True)  # a call that waits, or never comes back from C
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def judge(name: str, call: Callable[[], object], outcome: Outcome) -> None:
    """Call, and note how it ends; the exit codes are those that the command line gives such errors."""
    start = time.process_time()
    try:
        with limited(LIMIT_S), contextlib.redirect_stderr(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            call()
        end = "result"
    except (InputError, RunError) as error:
        end, text = f"a sentence and exit code {2 if isinstance(error, InputError) else 1}", str(error)
        if "\n" in text or not text.strip() or len(text) > 2000:
            outcome.faults.append(f"{name}: no sentence: {text[:300]!r}")
    except Slow:
        end = "slow"
        outcome.faults.append(f"{name}: took more than {LIMIT_S:g} s of the processor")
    except BaseException as error:
        end = "traceback"
        where = traceback.extract_tb(error.__traceback__)
        own = next((f"{Path(f.filename).name}:{f.lineno}" for f in reversed(where) if "/mcsim/" in f.filename), "?")
        outcome.faults.append(f"{name}: {type(error).__name__}: {str(error)[:200]} ({own})")
    outcome.ends[end] += 1
    outcome.slowest_s = max(outcome.slowest_s, time.process_time() - start)
