"""The exceptions that users are meant to read."""

import re

_GIVEN = re.compile(
    r"""(?:(?:power spectrum|moments file|pointing file) )?['"]?[^\s'"(]*/given-[0-9a-f]{64}/(\w+)(?:\.\w+)?['"]?"""
)
"""File of the cache that holds what a user gave as an array or object; its name is that of the key or object."""


class InputError(ValueError):
    """Input that mcsim cannot use.

    The message is one sentence that names the value, the limit and the remedy; the command line prints it
    without a traceback and exits with code 2.

    Examples
    --------
    >>> import mcsim
    >>> try:
    ...     mcsim.Beam.gaussian(-5.0)
    ... except mcsim.InputError as error:
    ...     print("refused:", "-5.0" in str(error))
    refused: True
    """

    stands_in: str | None = None  #: key of the table of a run that it is about, once the message says it

    def __init__(self, message: str) -> None:
        """Make one line of what a library said of a broken file; name what was given as an array, not its file."""
        super().__init__(_GIVEN.sub(r"the given \1", " ".join(message.split()) if "\n" in message else message))


class RunError(RuntimeError):
    """What could not go on, though its input was right; what a run has finished is stored. Exit code 1.

    Examples
    --------
    >>> import mcsim
    >>> try:
    ...     result = mcsim.run("tiny", "tiny.zarr")
    ... except mcsim.RunError as error:
    ...     print(error)  # the scheduler is lost, say: call it again to go on
    """
