"""Progress of long work: a bar on a terminal, otherwise a line per minute; and a log beside the store."""

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

EVERY_S = 60.0  #: between lines of progress


class Reporter:
    """Count of finished units of work, of which ``expect`` may announce more; this one shows nothing."""

    def __init__(self, total: float, unit: str) -> None:
        self.total, self.unit, self.start = total, unit, time.monotonic()

    def __call__(self, finished: float, failed: int = 0) -> None:
        """Show that ``finished`` units are done, ``failed`` of them unsuccessfully."""

    def expect(self, more: float) -> None:
        """Add ``more`` units to the total."""
        self.total += more

    def rate(self, finished: float, failed: int) -> str:
        """Return units per second since the start as text."""
        rate = finished / max(time.monotonic() - self.start, 1e-9)
        speed = f"{rate:.3g} {self.unit}/s" if self.unit else ""
        return f"{speed}, {failed} failed" if failed else speed


@contextmanager
def reporting(label: str, total: float, unit: str, quiet: bool = False) -> Iterator[Reporter]:
    """Yield a function that reports progress on standard error: a bar on a terminal, or a line per minute.

    ``total`` is the number of units; 0 if :meth:`Reporter.expect` says later how many there are.
    """
    console = Console(stderr=True)
    if quiet:
        yield Reporter(total, unit)
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
        lines = _Lines(console, label, total, unit)
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


class _Bar(Reporter):
    def __init__(self, bar: Progress, label: str, total: float, unit: str) -> None:
        super().__init__(total, unit)
        self.bar, self.task = bar, bar.add_task(label, total=total, rate="")

    def __call__(self, finished: float, failed: int = 0) -> None:
        self.bar.update(self.task, completed=finished, rate=self.rate(finished, failed))

    def expect(self, more: float) -> None:
        super().expect(more)
        self.bar.update(self.task, total=self.total)


class _Lines(Reporter):
    def __init__(self, console: Console, label: str, total: float, unit: str) -> None:
        super().__init__(total, unit)
        self.console, self.label, self.grows = console, label, total == 0.0
        self.last, self.state = self.start, (0.0, 0)

    def __call__(self, finished: float, failed: int = 0) -> None:
        now, before, self.state = time.monotonic(), self.state, (finished, failed)
        ended = finished >= self.total and not self.grows and self.state != before
        if now - self.last >= EVERY_S or ended:
            self.last = now
            self._print(finished, failed)

    def close(self) -> None:
        if self.grows and self.total:
            self._print(*self.state)

    def _print(self, finished: float, failed: int) -> None:
        share = f"{finished:g}/{self.total:g} {self.unit}" if self.unit else f"{100 * finished / self.total:.0f} %"
        left_s = (time.monotonic() - self.start) * (self.total - finished) / finished if finished else 0.0
        parts = [share, self.rate(finished, failed), f"{left_s:.0f} s left" if left_s > 0.0 else ""]
        self.console.print(
            f"{self.label}: {', '.join(part for part in parts if part)}", highlight=False, soft_wrap=True
        )
