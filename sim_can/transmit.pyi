from collections.abc import Callable
from typing import Final

from jtqd.drivers.pdo import PdoMap
from jtqd.sim_can.drives import ChannelSignal, DriveSignals

NEVER_NS: Final[int]
NOT_VALID: Final[int]
POSITIVE_OVERLOAD: Final[int]
NEGATIVE_OVERLOAD: Final[int]
MAX_16: Final[int]
MAX_32: Final[int]

class Value:
    def __call__(self) -> int: ...

class DriveValue(Value):
    def __init__(self, signals: DriveSignals, quantity: str, units: float) -> None: ...

class Channel:
    signal: ChannelSignal | None
    zero_nm: float
    def __init__(self, signal: ChannelSignal | None, decimals: int) -> None: ...
    def set_decimals(self, decimals: int) -> None: ...
    def autozero(self) -> None: ...

class ChannelValue(Value):
    def __init__(self, channel: Channel, bits: int, status: bool = False) -> None: ...

class TransmitPdo:
    cob_id: int
    length: int
    type: int
    start: int
    count: int
    period_ns: int
    timed_only: bool
    last: bytes
    due_ns: int
    def __init__(
        self,
        pdo: PdoMap,
        getters: tuple[Callable[[], int], ...],
        start: int,
        period_ms: int,
        timed_only: bool,
    ) -> None: ...
    def frame(self) -> bytes: ...
    def on_sync(self, counter: int) -> bytes | None: ...
