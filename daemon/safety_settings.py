"""Section `safety` of the configuration: which faults are latched, and the thresholds of the checks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from daemon.shared import faults
from estimator.checked import Section
from estimator.plausibility import PlausibilityLimits

LATCHED_BY_DEFAULT: Final = faults.NOT_FINITE | faults.BITS["motor_jump"] | faults.BITS["link_jump"]
"""What leaves numbers behind that look right and are not: a broken estimator, an encoder that has lost its zero."""
_LIMITS: Final = PlausibilityLimits()


@dataclass(frozen=True, slots=True)
class SafetySettings:
    """How faults are found and which of them wait for a reset.

    latch: bits of `daemon/shared/faults.py`; stale_latch_cycles: so many cycles in a row without inputs, or without time,
    are the fault `stale` (None: never); deviation_sigmas, deviation_s: the fault `deviation`; plausibility: None for no
    checks.
    """

    latch: int = LATCHED_BY_DEFAULT
    stale_latch_cycles: int | None = None
    deviation_sigmas: float = 3.0
    deviation_s: float = 1.0
    plausibility: PlausibilityLimits | None = _LIMITS

    @classmethod
    def from_section(cls, section: Section | None) -> SafetySettings:
        """Read the mapping of a configuration file; every key is optional. Raises ConfigError."""
        if section is None:
            return cls()
        latch = _latch(section)
        stale = section.raw("stale_latch_cycles", None)
        if stale is not None:
            stale = section.integer("stale_latch_cycles", low=1, high=1_000_000)
            latch |= faults.STALE
        sigmas = section.number("deviation_sigmas", low=1.0, high=100.0, default=3.0)
        seconds = section.number("deviation_s", unit="s", low=0.01, high=60.0, default=1.0)
        limits: PlausibilityLimits | None = _LIMITS
        if section.raw("plausibility", None) is False:
            limits = None
        else:
            inner = section.section("plausibility", optional=True)
            limits = limits if inner is None else PlausibilityLimits.from_section(inner)
        section.finish()
        return cls(latch, stale, sigmas, seconds, limits)


def _latch(section: Section) -> int:
    names = [name for name in faults.BITS if name != "stale"]
    value: Any = section.raw("latch", None)
    if value is None:
        return LATCHED_BY_DEFAULT
    if not isinstance(value, list) or not all(isinstance(name, str) and name in names for name in value):
        raise section.error("latch", value, f"a list of {', '.join(names)}; [] for none")
    return sum({faults.BITS[name] for name in value})
