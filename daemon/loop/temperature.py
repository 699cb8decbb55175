"""Temperature of one joint: what its drive told last by TPDO3, for as long as that is worth something. Pure.

TPDO3 comes by an event timer, not with SYNC, so it belongs to no cycle: a value holds from the cycle that took its frame
until the next one, or until it is LIFE_S old. Its age is counted in slots and not by stamps, because CLOCK_REALTIME may be
stepped, and so that the frames and cycle numbers of a log alone say what each cycle had.
"""

from __future__ import annotations

import struct
from math import nan

from drivers.devices import NOT_MEASURED, TEMPERATURE_C_PER_UNIT

LIFE_S = 2.0
"""Four frames in a row are missing then; a joint needs minutes to become noticeably warmer."""
_NEVER = 1 << 62
_FIELD = struct.Struct("<h")


class JointTemperature:
    """Last temperature of a joint.

    Args:
        cob_id: of TPDO3.
        node_id: of its drive.
        name: as it appears in counters and lines, e.g. "381h drive 1 TPDO3".
        life_cycles: slots after which a value is forgotten.

    Attributes:
        celsius: what the cycle may use; NaN where it is not known.
        lost: how often a value was forgotten because no other came.
        rejected: frames with this identifier and a wrong length, or 29-bit or remote frames.
    """

    __slots__ = ("_life", "_news", "_until", "celsius", "cob_id", "lost", "name", "node_id", "rejected")

    def __init__(self, cob_id: int, node_id: int, name: str, life_cycles: int) -> None:
        self.cob_id, self.node_id, self.name = cob_id, node_id, name
        self._life = life_cycles
        self._news = False
        self._until = _NEVER
        self.celsius = nan
        self.lost = self.rejected = 0

    def receive(self, frames: bytearray, offset: int) -> bool:
        """Take the frame (`struct can_frame`) at `offset`; False for a wrong length."""
        if frames[offset + 4] != _FIELD.size:
            self.rejected += 1
            return False
        (raw,) = _FIELD.unpack_from(frames, offset + 8)
        self.celsius = nan if raw == NOT_MEASURED else raw * TEMPERATURE_C_PER_UNIT
        self._news = True
        return True

    def at(self, cycle: int) -> None:
        """The inputs of slot number `cycle` have been taken: what is too old by then is not known any more."""
        if self._news:
            self._news = False
            self._until = cycle + self._life
        elif cycle > self._until:
            self._until = _NEVER
            self.celsius = nan
            self.lost += 1


UNKNOWN = JointTemperature(0, 0, "none", 0)
"""Of a joint whose drive tells none."""
