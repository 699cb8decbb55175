"""Numbers of a report: as many digits as the interval supports, units; on a page alone a true minus and narrow spaces."""

from __future__ import annotations

import math
from typing import Final

DASH: Final = "–"
SPACE: Final = "\u00a0"
"""Between number and unit: no line ends there."""
_PREFIXED: Final = ("rad", "s", "A")
"""Units that come with milli and micro; torque stays in Nm."""
_UNITS: Final = {
    "kgm2": "kg\u00a0m²",
    "kg m2": "kg\u00a0m²",
    "Nm/rad3": "Nm/rad³",
    "Nms/rad": "Nm\u00a0s/rad",
    "degC": "°C",
    "1": "",
    "1/rev": "per revolution",
    "-": "",
}
_RAISED: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_PLAIN_FROM: Final = 1e-3
"""Numbers below it, and those from the next two on, alone or beside others, have a power of ten."""
_PLAIN_TO: Final = 1e6
_PLAIN_TO_BESIDE: Final = 1e5


def number(value: float, digits: int = 3) -> str:
    """Return the value to `digits` significant digits, a dash where it is not finite."""
    if not math.isfinite(value):
        return DASH
    if value == 0.0:
        return "0"
    return _text(value, max(0, digits - 1 - _order(value)))


def percent(share: float, decimals: int = 0) -> str:
    """Return a share in percent with the sign, a dash where it is not finite."""
    return f"{_text(100.0 * share, decimals)}{SPACE}%" if math.isfinite(share) else DASH


def with_unit(value: float, unit: str, digits: int = 3) -> str:
    """Return a quantity, e.g. "40 µrad"."""
    if not math.isfinite(value):
        return DASH
    scale, name, power = _scale(unit, abs(value), _PLAIN_TO)
    if power:
        name = f"×{SPACE}10{str(power).translate(_RAISED)}{SPACE}{name}"
    return f"{_text(value * scale, max(0, digits - 1 - _order(value * scale)))}{SPACE}{name}".rstrip()


def with_interval(
    value: float, ci95: tuple[float, float], unit: str, before: float | None = None
) -> tuple[str, str]:
    """Return value and 95 % interval for page and terminal, e.g. ("4.00 -> 5.30 Nm", "[5.20, 5.40]"); "" without one.

    before: the same quantity before, None without one. All have one power of ten and as many places, by two digits of half
    the interval's width.
    """
    low, high = ci95
    ends = [low, high] if math.isfinite(low + high) and high > low else []
    factor, name, power = _scale(unit, max(abs(x) for x in (value, *ends, before or 0.0)), _PLAIN_TO_BESIDE)
    half = 0.5 * (high - low) * factor if ends else 0.0
    places = 1 - _order(half) if half else 2 - _order(value * factor)
    least = 0.5 * 10.0**-places if half else 0.0
    found, *interval = (
        _at(x * factor if abs(x * factor) > least else 0.0, places, power) for x in (value, *ends)
    )
    old = "" if before is None else f"{_at(before * factor, places, power)} -> "
    return f"{old}{found} {name}".rstrip(), f"[{', '.join(interval)}]" if interval else ""


def rounded(value: float, unit: str, before: float | None = None) -> str:
    """Return a quantity with two digits, e.g. "5.3 Nm", for page and terminal; with a value before "4.0 -> 5.3 Nm", with as
    many digits as it takes to see the difference.
    """
    factor, name, power = _scale(unit, max(abs(value), abs(before or 0.0)), _PLAIN_TO_BESIDE)
    value *= factor
    if before is None:
        return f"{_at(value, 1 - _order(value), power)} {name}".rstrip()
    return f"{' -> '.join(pair(before * factor, value, power))} {name}".rstrip()


def pair(old: float, new: float, power: int = 0) -> tuple[str, str]:
    """Return two numbers with as many places as it takes to see the difference, two digits at least."""
    apart = -_order(new - old) if new != old else 0
    places = max(1 - _order(max(abs(old), abs(new))), apart)
    return _at(old, places, power), _at(new, places, power)


def short(value: float) -> str:
    """Return a number with two digits, "-" where it is not finite."""
    return _at(value, 1 - _order(value)) if math.isfinite(value) else "-"


def unit_name(unit: str) -> str:
    """Return a unit as it is written: "degC" is "°C"."""
    return _UNITS.get(unit, unit)


def _scale(unit: str, size: float, plain_to: float) -> tuple[float, str, int]:
    """Return factor and name of the unit in which a size is handy, and the power of ten that the factor takes out."""
    if unit in _PREFIXED and 0.0 < size < 0.1:
        return (1e6, f"µ{unit}", 0) if size < _PLAIN_FROM else (1e3, f"m{unit}", 0)
    if size and not _PLAIN_FROM <= size < plain_to:
        power = _order(size)
        return 10.0**-power, unit_name(unit), power
    return 1.0, unit_name(unit), 0


def _order(value: float) -> int:
    """Power of ten of the first digit; of 0.9999999999 that of 1."""
    return math.floor(math.log10(abs(value)) + 1e-9) if value else 0


def _text(value: float, decimals: int) -> str:
    """Fixed notation with a true minus, thousands apart by a thin space."""
    text = f"{value:,.{min(decimals, 9)}f}".replace(",", "\u202f")
    if float(text.replace("\u202f", "")) == 0.0:
        text = text.lstrip("-")
    return text.replace("-", "−")


def _at(value: float, places: int, power: int = 0) -> str:
    """Fixed notation of a terminal with a power of ten; one digit at least of what is not zero."""
    if value and abs(value) < 0.5 * 10.0 ** -max(places, 0):
        places = -_order(value)
    exponent = f"e{power:+03d}" if power else ""
    return f"{value:.{min(max(places, 0), 9)}f}{exponent}" if value else "0"
