from jtqd.daemon.shared.cycle_record import Ring

class RecordRing:
    def __init__(self, ring: Ring, joints: int = 2, shadow: bool = False) -> None: ...
