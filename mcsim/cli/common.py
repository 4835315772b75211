"""Shared parts of the commands: arguments, output, interruption, figures."""

import signal
from pathlib import Path
from types import FrameType
from typing import Annotated

from typer import Argument, Option

from mcsim.errors import InputError
from mcsim.support.folders import user_path

Config = Annotated[str, Argument(metavar="CONFIG", help="TOML file, or a packaged workflow such as quickstart.")]
Workers = Annotated[int | None, Option(min=0, help="Processes; 0: this one; default: the model's.")]
Including = Annotated[
    list[str] | None,
    Option("--with", metavar="EFFECT", help="Propose an effect on request, or of FILE.py; repeatable."),
]
Simulations = Annotated[int | None, Option(min=50, help="For a sample covariance; default: five per element, shrunk.")]
Processes = Annotated[int | None, Option(min=1, help="Local processes; default: the configuration's.")]
Scheduler = Annotated[str | None, Option(metavar="ADDRESS", help="Running Dask scheduler, tcp://host:port.")]
Part = Annotated[str | None, Option(metavar="A:B", help="Only realizations A to B - 1; default: all.")]
Png = Annotated[Path | None, Option("-o", "--output", metavar="PNG", help="Picture to write.")]


def chosen(workers: int | None, scheduler: str | None) -> int | str | None:
    """Return the number of processes or the address of the scheduler that was asked for; None: neither."""
    if workers is not None and scheduler is not None:
        raise InputError("--workers and --scheduler exclude each other: workers of a running scheduler are its own.")
    return workers if scheduler is None else scheduler


def interrupt_once() -> None:
    """End a run in order at Ctrl-C or a batch system's SIGTERM; ignore a second one."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        for name in (signal.SIGINT, signal.SIGTERM):
            signal.signal(name, signal.SIG_IGN)
        raise KeyboardInterrupt

    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, interrupt)


def save(figure, path: Path) -> None:  # type: ignore[no-untyped-def]
    """Save a figure and print its path; raise InputError if the file cannot be written."""
    try:
        figure.savefig(user_path(path))
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be written ({why}); choose another file with -o.") from error
    print(f"wrote {path}")
