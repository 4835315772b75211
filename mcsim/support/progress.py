"""Progress of long work: a bar on a terminal, otherwise a line per minute; and a log beside the store."""

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


class Reporter(Protocol):
    """Function that shows the progress."""

    def __call__(self, finished: float, failed: int = 0) -> None:
        """Show that ``finished`` units are done, ``failed`` of them unsuccessfully."""

    def expect(self, more: float) -> None:
        """Add ``more`` units to the total."""


@contextmanager
def reporting(label: str, total: float, unit: str, quiet: bool = False, every_s: float = 60.0) -> Iterator[Reporter]:
    """Yield a function that reports progress on standard error.

    Parameters
    ----------
    label, unit
        Name of the work, and of what is counted.
    total
        Number of units; 0 if :meth:`Reporter.expect` says later how many there are.
    quiet
        Report nothing.
    every_s
        Seconds between lines if standard error is not a terminal.
    """
    console = Console(stderr=True)
    if quiet:
        yield _Silent()
    elif console.is_terminal:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn() if unit else TextColumn("{task.percentage:3.0f} %"),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=console) as bar:
            yield _Bar(bar, label, total, unit)
    else:
        lines = _Lines(console, label, total, unit, every_s)
        yield lines
        lines.close()


@dataclass(frozen=True)
class Journal:
    """Log of the runs on one store: ``{store}.log`` beside it, a line per event, appended."""

    store: Path
    quiet: bool = True

    def write(self, text: str, aloud: bool = False) -> None:
        """Append a line; print it on standard error too if ``aloud``, unless quiet. Ignore a full disk."""
        line = " ".join(text.split())
        with suppress(OSError), self.store.with_name(f"{self.store.name}.log").open("a") as stream:
            now = datetime.now(UTC).isoformat(timespec="seconds")
            stream.write(f"{now} {socket.gethostname()} {os.getpid()} {line}\n")
        if aloud and not self.quiet:
            Console(stderr=True, highlight=False, soft_wrap=True).print(line, markup=False)


class _Silent:
    def __call__(self, finished: float, failed: int = 0) -> None:
        pass

    def expect(self, more: float) -> None:
        pass


class _Rate:
    """Units per second since the start, and the time left."""

    def __init__(self, total: float, unit: str) -> None:
        self.total, self.unit, self.start = total, unit, time.monotonic()

    def text(self, finished: float, failed: int) -> str:
        rate = finished / max(time.monotonic() - self.start, 1e-9)
        speed = f"{rate:.3g} {self.unit}/s" if self.unit else ""
        return f"{speed}, {failed} failed" if failed else speed

    def left_s(self, finished: float) -> float:
        elapsed = time.monotonic() - self.start
        return elapsed * (self.total - finished) / finished if finished else float("inf")


class _Bar:
    def __init__(self, bar: Progress, label: str, total: float, unit: str) -> None:
        self.bar, self.rate = bar, _Rate(total, unit)
        self.task = bar.add_task(label, total=total, rate="")

    def __call__(self, finished: float, failed: int = 0) -> None:
        self.bar.update(self.task, completed=finished, rate=self.rate.text(finished, failed))

    def expect(self, more: float) -> None:
        self.rate.total += more
        self.bar.update(self.task, total=self.rate.total)


class _Lines:
    def __init__(self, console: Console, label: str, total: float, unit: str, every_s: float) -> None:
        self.console, self.label, self.unit, self.every_s, self.grows = console, label, unit, every_s, total == 0.0
        self.rate, self.last, self.state = _Rate(total, unit), time.monotonic(), (0.0, 0)

    def __call__(self, finished: float, failed: int = 0) -> None:
        now, self.state = time.monotonic(), (finished, failed)
        if now - self.last >= self.every_s or (finished >= self.rate.total and not self.grows):
            self.last = now
            self._print(finished, failed)

    def expect(self, more: float) -> None:
        self.rate.total += more

    def close(self) -> None:
        if self.grows and self.rate.total:
            self._print(*self.state)

    def _print(self, finished: float, failed: int) -> None:
        total = self.rate.total
        share = f"{finished:g}/{total:g} {self.unit}" if self.unit else f"{100 * finished / total:.0f} %"
        speed, left = self.rate.text(finished, failed), self.rate.left_s(finished)
        parts = [share, speed, f"{left:.0f} s left" if 0 < left < float("inf") else ""]
        self.console.print(
            f"{self.label}: {', '.join(part for part in parts if part)}", highlight=False, soft_wrap=True
        )
