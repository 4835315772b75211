"""The hooks by which an effect acts, and what those of a user's effect may return."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from mcsim.errors import InputError

HOOKS = (
    *("sky", "beam", "pointing", "gain", "signal", "noise", "excess"),
    *("spread", "orientations", "differencing", "moved", "lags"),
)

_OF_THE_SHAPE_OF = {"sky": "the sky", "gain": "the times", "signal": "the times", "excess": "the counts"}
"""What the first argument of a hook is, where what it returns has the same shape."""

_NUMBERS = {*_OF_THE_SHAPE_OF, "noise", "spread"}


class HookError(InputError):
    """A hook of an effect that fails, or returns what is no number: never a reason to leave the effect out."""


def guard(kind: type) -> None:
    """Let the hooks that a class defines say in a sentence if they fail, or return what is no number."""
    for hook in HOOKS:
        if hook in vars(kind):
            setattr(kind, hook, _guarded(hook, vars(kind)[hook]))


def _guarded(hook: str, function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def call(effect: Any, *given: Any, **named: Any) -> Any:
        what = f"effect {effect.name}: its {hook}"
        try:
            found = function(effect, *given, **named)
            values = np.asarray(0.0 if found is None or hook not in _NUMBERS else found)
            finite = bool(np.all(np.isfinite(values)))
        except InputError:
            raise
        except Exception as error:  # whatever a user's code does
            raise HookError(f"{what} fails ({type(error).__name__}: {error}); mend it.") from error
        if not finite:
            raise HookError(f"{what} returns values that are not finite; let it return numbers.")
        if hook in _OF_THE_SHAPE_OF and found is not None and given and values.shape != np.shape(given[0]):
            raise HookError(
                f"{what} returns an array of shape {values.shape} where {_OF_THE_SHAPE_OF[hook]} have "
                f"{np.shape(given[0])}; let it return one value for each."
            )
        return found

    return call
