from collections.abc import Callable
from typing import Final

from jtqd.drivers.pdo import PdoMap
from jtqd.sim_can.signals import ChannelSignal, DriveSignals

NEVER_NS: Final = 1 << 62
NOT_VALID: Final = 1
POSITIVE_OVERLOAD: Final = 2
NEGATIVE_OVERLOAD: Final = 4
MAX_16: Final = 0x7FFF
MAX_32: Final = 0x7FFF_FFFF

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
