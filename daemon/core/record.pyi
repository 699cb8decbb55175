from jtqd.daemon.shared.ring import Ring

class RecordRing:
    def __init__(self, ring: Ring) -> None: ...

class CycleFrames:
    carried: tuple[str, ...]
    state: bytes
    @property
    def count(self) -> int: ...
    @property
    def left_out(self) -> int: ...
    @property
    def slot(self) -> bytes: ...
