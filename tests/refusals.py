"""What a refusal must name: its values, keys and files, whatever its sentence says."""

import os
import re
from contextlib import AbstractContextManager
from types import TracebackType

import pytest

from mcsim.errors import InputError

PHRASE = re.compile(r"[a-z]{2,} +[a-z]{2,}")


def refused(
    *named: object, by: type[Exception] = InputError, errno: int | None = None
) -> AbstractContextManager[pytest.ExceptionInfo[Exception]]:
    """Expect an exception that names all of ``named``, each as a whole, and the system's reason ``errno``."""
    return _Refusal(named, by, errno)


def unnamed(text: str, *named: object) -> list[str]:
    """Return what ``text`` does not name of numbers, keys, units and files; a float may stand there as ``:g``."""
    return [str(value) for value in named if not any(_stands_in(text, form) for form in _forms(value))]


class _Refusal:
    """No generator: its frame would keep the exception alive after the test, and with it the files that it holds."""

    def __init__(self, named: tuple[object, ...], by: type[Exception], errno: int | None) -> None:
        self.named, self.reason = named, "" if errno is None else os.strerror(errno)
        self.raises = pytest.raises(by)

    def __enter__(self) -> pytest.ExceptionInfo[Exception]:
        return self.raises.__enter__()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        expected = self.raises.__exit__(kind, error, trace)
        missing = unnamed(str(error), *self.named) if expected else []
        assert not missing, f"{missing} not named: {error}"
        assert self.reason in str(error)
        return expected


def _forms(value: object) -> set[str]:
    forms = {str(value), f"{value:g}"} if isinstance(value, float) else {str(value)}
    if PHRASE.search(str(value)) and "/" not in str(value):
        raise ValueError(f"{value!r} is a phrase: name values, keys, units, options and files")
    return forms


def _stands_in(text: str, word: str) -> bool:
    """Return True if ``word`` stands in ``text`` as a whole: 10 is not in 100 or 10.5, sky not in sky.lmax."""
    before = r"(?<![\w.])" if re.match(r"\w", word) else ""
    after = r"(?![\w\[]|\.\w)" if re.search(r"\w$", word) else ""
    return re.search(before + re.escape(word) + after, text) is not None
