from collections.abc import Sequence

from jtqd.daemon.config import Config

class ContactWatch:
    def __init__(
        self,
        thresholds_nm: Sequence[float],
        *,
        opposed: bool = False,
        sends: bool = True,
        period_s: float = 0.001,
    ) -> None: ...
    @property
    def count(self) -> int: ...
    @property
    def sends(self) -> bool: ...

def contacts_of(config: Config) -> ContactWatch | None: ...
