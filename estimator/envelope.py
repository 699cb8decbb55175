"""Envelope: what the data covered that a fused network was trained on, or a joint's section `fused` was fitted to."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Final

from jtqd.estimator.checked import Verbatim
from jtqd.estimator.decoder import FieldError, limits, parsed

MAX_CELLS: Final = 127
"""Cells of the map in each direction."""

_LEAST: Final = 1e-6
_MOST: Final = 1e6
"""Limits of steps and distance, far beyond any joint: their reciprocals stay numbers."""


def finite(value: object) -> bool:
    """Return whether a value from JSON is a finite number; a bool is none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _checked_map(known: Any) -> tuple[tuple[int, ...], ...]:
    """Return the map; ValueError unless it is a table with a middle cell, of 0 and 1."""
    if not (isinstance(known, list) and known and all(isinstance(row, list) for row in known)):
        raise ValueError(f"known: found {str(known)[:40]}, expected a list of rows")
    widths = {len(row) for row in known}
    if len(widths) != 1 or len(known) % 2 == 0 or min(widths) % 2 == 0:
        found = f"{len(known)} rows of {', '.join(map(str, sorted(widths)))} cells"
        raise ValueError(f"known: found {found}, expected odd numbers of rows and of cells in each row")
    if not all(finite(cell) and cell in (0, 1) for row in known for cell in row):
        raise ValueError("known: found other cells, expected 0 and 1")
    return tuple(tuple(int(cell) for cell in row) for row in known)


def _checked_range(value: Any) -> tuple[float, float] | None:
    """Return the range of temperatures; ValueError unless it is None or two numbers that do not fall."""
    if value is None:
        return None
    if isinstance(value, list) and len(value) == 2 and all(map(finite, value)) and value[0] <= value[1]:
        return float(value[0]), float(value[1])
    raise ValueError(f"temperature_c: found {str(value)[:40]}, expected null or [lowest, highest]")


def _rows(value: Any) -> tuple[tuple[int, ...], ...]:
    """Return the map of a joint file, in which a row is a text such as "0110"."""
    if not (isinstance(value, list) and all(isinstance(row, str) and row.strip("01") == "" for row in value)):
        raise ValueError("found no texts of 0 and 1")
    known = _checked_map([[int(cell) for cell in row] for row in value])
    if max(len(known), len(known[0])) > MAX_CELLS:
        found = Verbatim(f"{len(known)} rows of {len(known[0])} cells")
        raise FieldError("envelope", "", found, f"at most {MAX_CELLS} of either")
    return known


_Torque = Annotated[float, limits("Nm", ge=_LEAST, le=_MOST)]


@dataclass(frozen=True, slots=True)
class Envelope:
    """What the training data of a fused network, or the runs of a fit, covered.

    velocity_step_rad_s, torque_step_nm: distance of cell centres; known: [2 nv + 1][2 nt + 1] of 0 and 1 over velocity
    and motor torque, its middle cell at zero; distance_nm: largest |torsion - current path|; temperature_c: lowest
    and highest, None where the joint reports none; load_nm: largest |joint torque|, None where that is not known (networks).
    """

    velocity_step_rad_s: Annotated[float, limits("rad/s", ge=_LEAST, le=_MOST)]
    torque_step_nm: _Torque
    known: Annotated[
        tuple[tuple[int, ...], ...],
        parsed(_rows, 'odd numbers of rows and of cells in each, rows as texts such as "0110"'),
    ]
    distance_nm: _Torque
    temperature_c: (
        Annotated[tuple[float, float], parsed(_checked_range, "[lowest, highest] in degC, or none")] | None
    )
    load_nm: _Torque | None = None

    @classmethod
    def from_mapping(cls, mapping: Any) -> Envelope:
        """Build from the network's metadata; raises ValueError with what was found and expected."""
        keys = ("velocity_step_rad_s", "torque_step_nm", "known", "distance_nm", "temperature_c")
        if not isinstance(mapping, dict) or set(mapping) != set(keys):
            raise ValueError(f"found {str(mapping)[:80]}, expected the keys {', '.join(keys)}")
        for key in ("velocity_step_rad_s", "torque_step_nm", "distance_nm"):
            if not finite(mapping[key]) or not _LEAST <= mapping[key] <= _MOST:
                raise ValueError(f"{key}: found {mapping[key]!r}, expected {_LEAST:g} to {_MOST:g}")
        return cls(
            float(mapping["velocity_step_rad_s"]),
            float(mapping["torque_step_nm"]),
            _checked_map(mapping["known"]),
            float(mapping["distance_nm"]),
            _checked_range(mapping["temperature_c"]),
        )

    def as_section(self) -> dict[str, Any]:
        """Return `fused.envelope` of a joint file."""
        rows = ["".join(map(str, row)) for row in self.known]
        values = self.to_mapping() | {"known": rows, "load_nm": self.load_nm}
        return {key: value for key, value in values.items() if value is not None}

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for a network's JSON, which knows no load."""
        return {
            "velocity_step_rad_s": self.velocity_step_rad_s,
            "torque_step_nm": self.torque_step_nm,
            "known": [list(row) for row in self.known],
            "distance_nm": self.distance_nm,
            "temperature_c": None if self.temperature_c is None else list(self.temperature_c),
        }
