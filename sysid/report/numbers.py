"""Numbers of a report page: as many digits as the interval supports, units, a true minus and narrow spaces."""

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
_PLAIN_FROM: Final = 1e-3
_PLAIN_TO: Final = 1e6


def number(value: float, digits: int = 3) -> str:
    """Return the value to `digits` significant digits, a dash where it is not finite."""
    if not math.isfinite(value):
        return DASH
    if value == 0.0:
        return "0"
    return _text(value, max(0, digits - 1 - _order(value)))


def fixed(value: float, decimals: int = 3) -> str:
    """Return the value to `decimals` places, a dash where it is not finite."""
    return _text(value, decimals) if math.isfinite(value) else DASH


def percent(share: float, decimals: int = 0) -> str:
    """Return a share in percent with the sign, a dash where it is not finite."""
    return f"{fixed(100.0 * share, decimals)}{SPACE}%" if math.isfinite(share) else DASH


def with_unit(value: float, unit: str, digits: int = 3) -> str:
    """Return a quantity, e.g. "40 µrad"."""
    if not math.isfinite(value):
        return DASH
    scale, name = _scale(unit, abs(value))
    return f"{_text(value * scale, max(0, digits - 1 - _order(value * scale)))}{SPACE}{name}".rstrip()


def with_interval(value: float, ci95: tuple[float, float], unit: str) -> tuple[str, str]:
    """Return value and 95 % interval, e.g. ("0.421 Nm", "0.401 to 0.441"); "" for a value that has none.

    The digits are those that half the interval's width allows: two of its own.
    """
    low, high = ci95
    if not math.isfinite(value):
        return DASH, ""
    scale, name = _scale(unit, abs(value))
    if math.isfinite(low) and math.isfinite(high) and high > low:
        decimals = max(0, 1 - _order(0.5 * (high - low) * scale))
        ends = f"{_text(low * scale, decimals)} to {_text(high * scale, decimals)}"
    elif low == high:  # given, not fitted
        return f"{value:g}{SPACE}{unit_name(unit)}".rstrip(), ""
    else:
        decimals = max(0, 2 - _order(value * scale))
        ends = "not bounded by these runs"
    return f"{_text(value * scale, decimals)}{SPACE}{name}".rstrip(), ends


def unit_name(unit: str) -> str:
    """Return a unit as it is written: "degC" is "°C"."""
    return _UNITS.get(unit, unit)


def _scale(unit: str, magnitude: float) -> tuple[float, str]:
    """Factor and name of the unit in which a magnitude is handy."""
    if unit in _PREFIXED and 0.0 < magnitude < 0.1:
        return (1e6, f"µ{unit}") if magnitude < _PLAIN_FROM else (1e3, f"m{unit}")
    if magnitude and not _PLAIN_FROM <= magnitude < _PLAIN_TO:
        power = _order(magnitude)
        return 10.0**-power, f"×\u00a010{_raised(power)}{SPACE}{unit_name(unit)}".rstrip()
    return 1.0, unit_name(unit)


def _order(value: float) -> int:
    """Power of ten of the first digit."""
    return math.floor(math.log10(abs(value))) if value else 0


def _text(value: float, decimals: int) -> str:
    """Fixed notation with a true minus, thousands apart by a thin space."""
    text = f"{value:,.{min(decimals, 9)}f}".replace(",", "\u202f")
    if float(text.replace("\u202f", "")) == 0.0:
        text = text.lstrip("-")
    return text.replace("-", "−")


def _raised(power: int) -> str:
    return str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
