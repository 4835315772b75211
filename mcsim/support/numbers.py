"""Numbers and names in text: a value with its error, three digits, powers of ten; the first of many names."""

import math
from collections.abc import Sequence

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def measured(value: float, sigma: float = 0.0, symbol: str = "") -> str:
    """Return a value with its error and the symbol of the unit behind each, rounded as the Particle Data Group does.

    The error has two digits where they are below 36, else one; digits before the point all stay.

    ``value``, ``sigma``: in the unit; without a positive, finite error the value has three digits. ``symbol``: of the
    unit, with the space before it where one belongs there.
    """
    if not (math.isfinite(value) and math.isfinite(sigma)) or sigma <= 0.0:
        return number(value) + symbol
    power = math.floor(math.log10(max(sigma, abs(value))))
    if -4 <= power <= 5:
        return _fixed(value, sigma, symbol)
    return f"({_fixed(value / 10.0**power, sigma / 10.0**power, '')}) × {_power(power)}{symbol}"


def _fixed(value: float, sigma: float, symbol: str) -> str:
    power = math.floor(math.log10(sigma))
    first = sigma / 10.0**power
    decimals = max(0, (0 if 3.55 <= first < 9.5 else 1) - power - (first >= 9.5))
    shown = f"{value:.{decimals}f}"
    # Zero has no sign.
    sign = "−" if value < 0.0 and float(shown) != 0.0 else ""
    return f"{sign}{shown.lstrip('-')}{symbol} ± {sigma:.{decimals}f}{symbol}"


def number(value: float, digits: int = 3) -> str:
    """Return a number with three digits; a dash for NaN."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0.0 else "−∞"
    return _typeset(f"{value:.{digits}g}")


def duration(seconds: float) -> str:
    """Return a time with three digits: seconds up to two minutes, minutes up to two hours, hours up to two days."""
    units = (("d", 86400.0, 2.0), ("h", 3600.0, 2.0), ("min", 60.0, 2.0), ("s", 1.0, 1.0), ("ms", 1e-3, 0.0))
    name, size = next((name, size) for name, size, least in units if seconds >= least * size)
    return f"{number(seconds / size)} {name}"


def some(names: Sequence[str], most: int) -> str:
    """Return the first names, and how many there are more."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def probability(value: float) -> str:
    """Return a p-value with two digits, tiny ones as powers of ten."""
    return "< 10⁻³⁰⁰" if value <= 0.0 else _typeset(f"{value:.2g}")


def p_equals(value: float) -> str:
    """Return ``p = ...``, or ``p < ...`` where the p-value is below what a number holds."""
    return f"p {probability(value)}" if value <= 0.0 else f"p = {probability(value)}"


def _typeset(text: str) -> str:
    digits, _, power = text.partition("e")
    return f"{digits.replace('-', '−')} × {_power(int(power))}" if power else digits.replace("-", "−")


def _power(exponent: int) -> str:
    return "10" + str(exponent).translate(_SUPERSCRIPTS)
