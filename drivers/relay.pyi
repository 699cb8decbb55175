import socket
from collections.abc import Callable, Iterable

from jtqd.drivers.hub import WireModel

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
