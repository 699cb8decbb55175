"""Terms of the effect library: how an effect is fitted by linear regression, from coefficients to parameters.

Exact where the effect is linear. The combinations are small frozen values rather than closures, so that terms can be sent
to another process. numpy is loaded where an array comes: the supervisor checks joint files with this library and has none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

FALLBACK_C: Final = 25.0
"""Reference temperature of a joint file that names none."""

SPAN_K: Final = 10.0
"""Distance of the reference temperatures of the two columns of a temperature term."""

_FLAT: Final = 1e-9
"""Slopes below this part of the constant say nothing about the reference temperature."""


@dataclass(frozen=True, slots=True)
class Term:
    """A way to look for an effect by linear regression: the hooks at each of `basis` (less the hooks at the joint
    file's own values) are columns; `combine(coefficients)` of the columns gives the parameters.
    """

    basis: tuple[Mapping[str, float], ...]
    combine: Any  # Callable[[Sequence[float]], dict[str, float]]


def full(value: float, like: Any) -> Any:
    """Return the value for a float, an array [n] of it for an array [n]."""
    if isinstance(like, float):  # of the loop, in every cycle
        return value
    import numpy as np

    return np.full(like.shape, value) if isinstance(like, np.ndarray) else value


def above(temperature_c: Any, reference_c: float) -> Any:
    """Return temperature less reference, 0 where the temperature is not known (not finite)."""
    difference = temperature_c - reference_c
    if isinstance(difference, float | int):
        return difference if math.isfinite(difference) else 0.0
    import numpy as np

    return np.where(np.isfinite(difference), difference, 0.0)


def reference_of(provenance: Mapping[str, Any]) -> float:
    """Return the temperature [°C] of the joint file's values, from its provenance."""
    value = provenance.get("temperature_c")
    good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if good else FALLBACK_C  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class Linear:
    """parameter k = base_k + c_k step_k; the rest is fixed."""

    names: tuple[str, ...]
    base: tuple[float, ...]
    step: tuple[float, ...]
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __call__(self, c: Sequence[float]) -> dict[str, float]:
        """Return the parameters of coefficients c."""
        rows = zip(self.names, self.base, self.step, c, strict=True)
        return {name: base + float(k) * step for name, base, step, k in rows} | dict(self.fixed)

    def term(self) -> Term:
        """Return the term: one column per parameter, the others at their base."""
        count = range(len(self.names))
        return Term(tuple(self([float(row == column) for column in count]) for row in count), self)


def linear(name: str, step: float, base: float = 0.0, **fixed: float) -> Term:
    """Return the term of one parameter in which the hooks are linear; base: the joint file's value."""
    return Linear((name,), (base,), (step,), fixed).term()


@dataclass(frozen=True, slots=True)
class Wave:
    """c1 cos(a) - c2 sin(a), or c1 sin(a) + c2 cos(a), as amplitude >= 0 and phase in (-pi, pi].

    Both are c1 f(a) + c2 f(a + pi/2) = A f(a + phi) with A (cos phi, sin phi) = (c1, c2), f the cosine or the sine.
    """

    amplitude: str
    step: float
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __call__(self, c: Sequence[float]) -> dict[str, float]:
        """Return the parameters of coefficients c."""
        along, across = float(c[0]), float(c[1])
        phase = math.atan2(across, along)
        values = {
            self.amplitude: math.hypot(along, across) * self.step,
            "phase_rad": math.pi if phase == -math.pi else phase,
        }
        return values | dict(self.fixed)

    def term(self) -> Term:
        """Return the term: columns at phase 0 and at a quarter turn."""
        basis = tuple(
            {self.amplitude: self.step, "phase_rad": phase} | dict(self.fixed)
            for phase in (0.0, 0.5 * math.pi)
        )
        return Term(basis, self)


@dataclass(frozen=True, slots=True)
class Slope:
    """k (T - T0) with k = (c1 + c2) step and T0 from the constant part; T0 = reference_c where there is no slope."""

    name: str
    step: float
    reference_c: float
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __call__(self, c: Sequence[float]) -> dict[str, float]:
        """Return the parameters of coefficients c."""
        first, second = float(c[0]), float(c[1])
        slope = first + second
        reference = self.reference_c
        if abs(slope) > _FLAT * abs(second):
            reference += second * SPAN_K / slope
        return {self.name: slope * self.step, "reference_c": reference} | dict(self.fixed)

    def term(self) -> Term:
        """Return the term: columns at the reference and SPAN_K above; both together give slope and constant."""
        return Term(
            tuple(self.basis(self.step, self.reference_c + span) for span in (0.0, SPAN_K)),
            self,
        )

    def basis(self, size: float, reference_c: float) -> Mapping[str, float]:
        """Return the parameters of one column."""
        return {self.name: size, "reference_c": reference_c} | dict(self.fixed)
