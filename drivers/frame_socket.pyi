import socket
from collections.abc import Callable, Iterable, Sequence

from jtqd.drivers.bus_socket import BusDown as BusDown
from jtqd.drivers.bus_socket import BusError as BusError
from jtqd.drivers.bus_socket import BusGone as BusGone
from jtqd.drivers.bus_socket import CanFilter
from jtqd.drivers.hub import WireModel

CAPACITY: int

class FrameReceiver:
    frames: bytearray
    overflow: int
    closed: bool
    def __init__(self, capacity: int = 32) -> None: ...
    @property
    def lengths(self) -> Sequence[int]: ...
    @property
    def flags(self) -> Sequence[int]: ...
    @property
    def stamps_ns(self) -> Sequence[int]: ...
    def receive(self, fd: int) -> int: ...

def open_frame_socket(
    bus: str,
    filters: Iterable[CanFilter] | None,
    *,
    receive_own: bool = False,
    error_frames: bool = False,
    capacity: int = 32,
) -> FrameSocket: ...

class FrameSocket:
    bus: str
    fd: int
    frames: bytearray
    tx_dropped: int
    rx_dropped: int
    def __init__(
        self,
        sock: socket.socket,
        bus: str,
        *,
        unix: bool,
        receive_own: bool,
        error_frames: bool,
        capacity: int,
    ) -> None: ...
    @property
    def stamps_ns(self) -> Sequence[int]: ...
    @property
    def own(self) -> Sequence[bool]: ...
    @property
    def lengths(self) -> Sequence[int]: ...
    def send(self, frame16: bytes) -> bool: ...
    def receive(self) -> int: ...
    def wait(self, timeout_s: float | None) -> bool: ...
    def set_filters(self, filters: Iterable[CanFilter] | None) -> None: ...
    def close(self) -> None: ...

MAX_CLIENTS: int
BACKLOG: int
TX_QUEUE: int

class HubCounters:
    frames: int
    malformed: int
    dropped: int
    refused: int
    tx_full: int

class Member: ...

class LocalPort(Member):
    def send(self, frame16: bytes) -> bool: ...
    def detach(self) -> None: ...

class Client(Member): ...

class Relay:
    counters: HubCounters
    wire: WireModel | None
    _listener: socket.socket
    _clients: dict[int, Client]
    _answering_ns: int | None
    def __init__(self, listener: socket.socket, wire: WireModel | None = None) -> None: ...
    def attach(
        self, on_frame: Callable[[bytes, int], None], wanted: Iterable[int] | None = None
    ) -> LocalPort: ...
    def remove(self, member: Member) -> None: ...
    @property
    def clients(self) -> int: ...
    def serve(self, timeout_s: float) -> None: ...
    def run_once(self, timeout_s: float | None) -> None: ...
