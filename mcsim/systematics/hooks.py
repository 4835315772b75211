"""The hooks by which an effect acts, and what those of a user's effect may return."""

import functools
import inspect
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from types import TracebackType
from typing import Any

import numpy as np

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import Moments

HOOKS = (
    *("sky", "beam", "pointing", "gain", "steady_gain", "signal", "noise", "knee", "excess"),
    *("spread", "orientations", "differencing", "moved", "lags"),
)

_OTHERS = ("__post_init__", "variants_in", "format_amplitude", "direction", "inverse")  #: that a class may define, too

_RETURNED = {
    "sky": "one complex coefficient for each of the sky",
    "beam": "a mcsim.Beam",
    "pointing": "a mcsim.Beam",
    "gain": "one real value for each of the times",
    "steady_gain": "a number",
    "signal": "one real value for each of the times",
    "noise": "one real value for each pixel",
    "knee": "a frequency",
    "excess": "one real value for each of the counts",
    "spread": "a number",
    "orientations": "mcsim.Moments",
    "differencing": "an imbalance and a number of iterations",
    "moved": "theta, phi and psi of each sample",
    "lags": "pairs of weight and delay",
}
"""What a hook returns, in words."""

_OBJECTS = {"beam": Beam, "pointing": Beam, "orientations": Moments}
_OPTIONAL = ("gain", "noise", "moved", "lags")  #: hooks that may return None
ROUNDING = 1e-9  #: relative size of what may be wrong with numbers that a hook returns


class HookError(InputError):
    """A hook of an effect that fails, or returns what it should not: never a reason to leave the effect out."""


class _IfPossible(AbstractContextManager[None, bool]):
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        return isinstance(error, InputError) and not isinstance(error, HookError)


def if_possible() -> AbstractContextManager[None, bool]:
    """Leave a block where an effect cannot have what it is given; a hook that fails stays a :class:`HookError`."""
    return _IfPossible()


def guard(kind: type) -> None:
    """Let the hooks that a class defines say in a sentence if they fail, or return what they should not."""
    for hook in HOOKS:
        if hook in vars(kind):
            setattr(kind, hook, _guarded(hook, vars(kind)[hook]))
    for name in _OTHERS:
        own = vars(kind).get(name)
        if isinstance(own, classmethod):
            setattr(kind, name, classmethod(_telling(kind, name, own.__func__)))
        elif inspect.isfunction(own):
            setattr(kind, name, _telling(kind, name, own))


def _telling(kind: type, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def call(*given: Any, **named: Any) -> Any:
        try:
            return function(*given, **named)
        except InputError:
            raise
        except (Exception, SystemExit) as error:  # whatever a user's code does
            title = getattr(kind, "name", kind.__name__)
            raised = "let it raise mcsim.InputError for what cannot be, or "
            remedy = f"{raised if name == '__post_init__' else ''}mend it"
            raise HookError(f"effect {title}: its {name} fails ({type(error).__name__}: {error}); {remedy}.") from error

    return call


def _guarded(hook: str, function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def call(effect: Any, *given: Any, **named: Any) -> Any:
        what = f"effect {effect.name}: its {hook}"
        try:
            found = function(effect, *map(_read_only, given), **{key: _read_only(one) for key, one in named.items()})
            flaw = _flaw(hook, found, (*given, *named.values()))
        except InputError:
            raise
        except (Exception, SystemExit) as error:  # whatever a user's code does
            remedy = "let it change a copy" if "read-only" in str(error) else "mend it"
            raise HookError(f"{what} fails ({type(error).__name__}: {error}); {remedy}.") from error
        if flaw is not None:
            raise HookError(f"{what} returns {flaw}; let it return {_RETURNED[hook]}.")
        if hook == "noise" and found is not None and (least := float(np.min(found))) < -ROUNDING:
            raise InputError(
                f"{what} makes a variance negative at amplitude = {effect.amplitude:g} ({least:.3g} times that of the "
                "model); choose a smaller one, or let the effect have a bound."
            )
        return found

    return call


def _read_only(value: Any) -> Any:
    """Return an array that a hook cannot write to: other channels, and the control, have the same one."""
    if not isinstance(value, np.ndarray):
        return value
    view = value.view()
    view.flags.writeable = False
    return view


def _flaw(hook: str, found: Any, given: Sequence[Any]) -> str | None:
    """Say what a hook returns that it should not; None: nothing."""
    if found is None:
        return None if hook in _OPTIONAL else "None"
    if hook in _OBJECTS:
        return None if isinstance(found, _OBJECTS[hook]) else f"a {type(found).__name__}"
    values = np.asarray(found)
    if values.dtype.kind not in "bciuf":
        return f"values of type {values.dtype}"
    if not np.all(np.isfinite(values)):
        return "values that are not finite"
    wanted = _shape(hook, values, given)
    if values.shape != wanted:
        return f"an array of shape {values.shape}, where {wanted} is needed"
    if values.dtype.kind not in ("c" if hook == "sky" else "fiu"):
        return f"values of type {values.dtype}"
    zonal = next((one.lmax + 1 for one in given if hasattr(one, "lmax")), 0)
    if hook == "sky" and np.any(np.abs(values[:zonal].imag) > ROUNDING * np.max(np.abs(values))):
        return "coefficients of m = 0 that are not real"
    return None


def _shape(hook: str, values: np.ndarray, given: Sequence[Any]) -> tuple[int, ...]:
    """Return the shape that numbers from a hook should have."""
    match hook:
        case "noise":
            return (12 * given[0].nside ** 2,)
        case "spread" | "knee" | "steady_gain":
            return ()
        case "differencing":
            return (2,)
        case "lags":
            return (*values.shape[:1], 2)
        case "moved":
            return (3, *np.shape(given[0]))
    return np.shape(given[0])
