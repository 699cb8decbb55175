"""Envelope of a fused network: what its training data covered, as its file says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from jtqd.estimator.onnx_graph import finite

MAX_CELLS: Final = 127
"""Cells of the map in each direction."""

_LEAST: Final = 1e-6
_MOST: Final = 1e6
"""Limits of steps and distance, far beyond any joint: their reciprocals stay numbers."""


@dataclass(frozen=True, slots=True)
class Envelope:
    """What the training data of a fused network covered.

    velocity_step_rad_s, torque_step_nm: distance of cell centres; known: [2 nv + 1][2 nt + 1] of 0 and 1 over velocity
    and motor torque, its middle cell at zero; distance_nm: largest |torsion - current path|; temperature_c: lowest
    and highest, None where the joint reports none.
    """

    velocity_step_rad_s: float
    torque_step_nm: float
    known: tuple[tuple[int, ...], ...]
    distance_nm: float
    temperature_c: tuple[float, float] | None

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

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "velocity_step_rad_s": self.velocity_step_rad_s,
            "torque_step_nm": self.torque_step_nm,
            "known": [list(row) for row in self.known],
            "distance_nm": self.distance_nm,
            "temperature_c": None if self.temperature_c is None else list(self.temperature_c),
        }


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
