"""Shared parts of the commands: arguments, output, interruption, figures."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryFile
from types import FrameType
from typing import Annotated, Any

from typer import Argument, BadParameter, Exit, Option
from typer.core import TyperCommand, TyperGroup

from mcsim.errors import InputError
from mcsim.support.folders import outside_stores, unwritable, user_path, write_whole
from mcsim.support.loading import loaded


def _without_types(options: list[Any]) -> list[Any]:
    """Return options whose flags, which take no value, show no type in --help."""
    for option in options:
        if getattr(option, "is_bool_flag", False):
            option.metavar = ""
    return options


def _interrupt_once() -> None:
    """Interrupt at Ctrl-C or SIGTERM; ignore a second one."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        for name in (signal.SIGINT, signal.SIGTERM):
            signal.signal(name, signal.SIG_IGN)
        raise KeyboardInterrupt

    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, interrupt)


_KEPT = {
    "run": "realizations",
    "maps": "maps",
    "diagnose": "simulations",
    "challenge make": "simulations and cases",
    "challenge run": "simulations and verdicts",
    "challenge score": "simulations of the model",
    "challenge draws": "simulations of the model",
}
"""What commands keep of what they have finished, and go on with."""


def _name(ctx: Any) -> str:
    """Return the name of a command, behind that of its group."""
    names: list[str] = []
    while ctx.parent is not None:
        names.insert(0, ctx.info_name)
        ctx = ctx.parent
    return " ".join(names)


def _again(ctx: Any) -> str:
    """Return a clause on what an interrupted command does when it is called again."""
    command = _name(ctx)
    if command not in _KEPT:
        return f"call mcsim {command} again"
    return f"finished {_KEPT[command]} are kept, and mcsim {command} goes on with them when it is called again"


_UsageError: type[Any] = BadParameter.__mro__[1]  # where typer has it differs from version to version


@contextmanager
def _refusals(command: str) -> Iterator[None]:
    """Say in a sentence what words a command does not take: they are bad input as any other."""
    try:
        yield
    except _UsageError as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # no words at all: this shows the help
            raise
        help_ = f"{command} -h says what it takes."
        found = getattr(error.__cause__, "errors", None)  # of pydantic, with which typer reads values
        if found is None or error.param is None:
            text = error.format_message().rstrip(".").replace(". Did you mean", "; did you mean")
            raise InputError(f"{text[:1].lower()}{text[1:]}{' ' if text.endswith('?') else '; '}{help_}") from None
        first = found()[0]
        why = first["msg"][:1].lower() + first["msg"][1:]
        raise InputError(f"{error.param.opts[0]} {first['input']}: {why}; {help_}") from None


def _called(name: str | None, parent: Any) -> str:
    """Return what to call for the help of a command of a group; ``parent`` None: of all."""
    return " ".join(filter(None, ("mcsim", *(() if parent is None else (_name(parent), name)))))


class Command(TyperCommand):
    """A command whose flags show no type in --help, and that ends in order when it is interrupted."""

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        """Read the words of the command."""
        with _refusals(_called(info_name, parent)):
            return super().make_context(info_name, args, parent, **extra)

    def get_params(self, ctx: Any) -> Any:
        """Return the parameters of the command."""
        return _without_types(super().get_params(ctx))

    def invoke(self, ctx: Any) -> Any:
        """Run the command; Ctrl-C or a batch system's SIGTERM ends in a sentence and exit code 130."""
        _interrupt_once()
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            print(f"mcsim: interrupted; {_again(ctx)}.", file=sys.stderr)
            raise Exit(130) from None


class Group(TyperGroup):
    """A group of commands whose flags show no type in --help."""

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        """Read the options before the command."""
        with _refusals(_called(info_name, parent)):
            return super().make_context(info_name, args, parent, **extra)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command."""
        with _refusals(_called(None, ctx)):
            return super().resolve_command(ctx, args)

    def get_params(self, ctx: Any) -> Any:
        """Return the parameters of the group."""
        return _without_types(super().get_params(ctx))


Config = Annotated[str, Argument(metavar="CONFIG", help="TOML file, or a packaged workflow such as quickstart.")]
Workers = Annotated[int | None, Option(min=0, help="Processes; 0: this one; default: the model's.")]
Including = Annotated[
    list[str] | None,
    Option("--with", metavar="EFFECT", help="Propose an effect on request, or of FILE.py; repeatable."),
]
Simulations = Annotated[int | None, Option(min=50, help="For a sample covariance; default: three per element, shrunk.")]
Processes = Annotated[int | None, Option(min=1, help="Local processes; default: the configuration's.")]
Scheduler = Annotated[str | None, Option(metavar="ADDRESS", help="Running Dask scheduler, tcp://host:port.")]
Part = Annotated[str | None, Option(metavar="A:B", help="Only realizations A to B - 1; default: all.")]
Png = Annotated[
    Path | None,
    Option("-o", "--output", metavar="FILE", help=".png, .pdf, .svg or such; default: beside what it shows."),
]


DOTS_PER_INCH = 150  #: of pictures that are made of pixels

PICTURES = (".png", ".pdf", ".svg", ".eps", ".ps", ".jpg", ".jpeg", ".tif", ".tiff", ".webp")
"""Ends of the names of pictures; matplotlib would add .png to a name without one."""


def chosen(workers: int | None, scheduler: str | None) -> int | str | None:
    """Return the number of processes or the address of the scheduler that was asked for; None: neither."""
    if workers is not None and scheduler is not None:
        raise InputError("--workers and --scheduler exclude each other: workers of a running scheduler are its own.")
    return workers if scheduler is None else scheduler


def processes(where: int | str | None) -> int | None:
    """Return the number of processes that --workers asks for or a running scheduler has; None: neither is named."""
    return loaded("mcsim.ensemble.runner.cluster").threads_of(where) if isinstance(where, str) else where


def picture(asked: Path | None, shown: str | Path, end: str = "") -> Path:
    """Return the path of a picture: the one asked for, or a name with ``end`` beside the file or folder it shows.

    The picture of something packaged comes into the working folder. Raise InputError for a kind of picture that is not
    known, or if the folder cannot be written into: that is said before anything is computed.
    """
    if asked is not None and asked.suffix.lower() not in PICTURES:
        raise InputError(f"{asked} ends in {asked.suffix or 'nothing'}; choose one of {', '.join(PICTURES)}.")
    source = user_path(shown)
    folder = source.absolute().parent if source.name in ("", "..") else source.parent
    name = Path(source.absolute().name.removesuffix(".gz")).stem
    target = folder / f"{name}{end}.png" if asked is None else user_path(asked)
    outside_stores(target)
    with unwritable(target, "choose another file with -o"), TemporaryFile(dir=target.absolute().parent):
        pass
    return target


def save(figure, path: Path, aside: bool = False) -> None:  # type: ignore[no-untyped-def]
    """Save a figure and print its path, ``aside`` to standard error, where standard output is for programs.

    Raise InputError if the file cannot be written, RunError on a full disk.
    """
    buffer = BytesIO()
    try:
        figure.savefig(buffer, format=path.suffix[1:].lower(), dpi=DOTS_PER_INCH)
    except ValueError as error:
        raise InputError(f"{path} cannot be written ({error}); choose another file with -o.") from error
    with unwritable(path, "choose another file with -o"):
        write_whole(path, buffer.getvalue())
    print(f"wrote {path}", file=sys.stderr if aside else sys.stdout)
