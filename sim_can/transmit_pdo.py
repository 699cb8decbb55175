"""One TPDO of an emulated device, compiled once from its mapping: packing it is a few getters and one
`struct` call. Pure.
"""

from collections.abc import Callable

from drivers.frame import FRAME
from drivers.pdo import PdoMap

NEVER_NS = 1 << 62

Getter = Callable[[], int]


class TransmitPdo:
    """One TPDO with everything that its packing needs."""

    __slots__ = (
        "cob_id",
        "count",
        "due_ns",
        "getters",
        "last",
        "length",
        "pack",
        "period_ns",
        "start",
        "type",
    )

    def __init__(self, pdo: PdoMap, getters: tuple[Getter, ...], start: int, period_ms: int) -> None:
        self.cob_id = pdo.cob_id
        self.type = pdo.transmission_type
        self.length = pdo.length
        self.pack = pdo.layout.pack
        self.getters = getters
        self.start = start  # wait for this SYNC counter first (18xxh:6); 0: no waiting
        self.count = 0
        self.last = b""
        self.period_ns = period_ms * 1_000_000  # event timer, types 254 and 255
        self.due_ns = NEVER_NS

    def frame(self) -> bytes:
        """The PDO with its present values."""
        return FRAME.pack(self.cob_id, self.length, self.pack(*[get() for get in self.getters]))
