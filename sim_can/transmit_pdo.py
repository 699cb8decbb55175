"""One TPDO of an emulated device, compiled once from its mapping: packing it is a few getters and one
`struct` call. Pure.
"""

from collections.abc import Callable, Mapping, Set

from drivers.frame import FRAME
from drivers.object_dictionary import ObjectStore
from drivers.pdo import PdoMap
from drivers.pdo_parameters import PdoParameters

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
        "timed_only",
        "type",
    )

    def __init__(
        self, pdo: PdoMap, getters: tuple[Getter, ...], start: int, period_ms: int, timed_only: bool
    ) -> None:
        self.cob_id = pdo.cob_id
        self.type = pdo.transmission_type
        self.length = pdo.length
        self.pack = pdo.layout.pack
        self.getters = getters
        self.start = start  # wait for this SYNC counter first (18xxh:6); 0: no waiting
        self.count = 0
        self.last = b""
        self.period_ns = period_ms * 1_000_000  # event timer, types 254 and 255
        self.timed_only = timed_only  # no change of its values is an event
        self.due_ns = NEVER_NS

    def frame(self) -> bytes:
        """The PDO with its present values."""
        return FRAME.pack(self.cob_id, self.length, self.pack(*[get() for get in self.getters]))


def compile_tpdos(
    store: ObjectStore,
    pdos: PdoParameters,
    getters: Mapping[tuple[int, int], Getter],
    quiet: Set[tuple[int, int]] = frozenset(),
) -> list[TransmitPdo]:
    """All TPDOs that exist and map something; objects without a getter are read from the store.

    quiet: objects whose change is no event; a TPDO that maps nothing else is sent by its event timer alone.
    """

    def getter(index: int, subindex: int) -> Getter:
        return getters.get((index, subindex)) or (lambda: store.number(index, subindex))

    compiled = []
    for index in pdos.tpdo_indices:
        pdo = pdos.active_map(index)
        if pdo is not None:
            found = tuple(getter(mapped.index, mapped.subindex) for mapped in pdo.objects)
            timed_only = all((mapped.index, mapped.subindex) in quiet for mapped in pdo.objects)
            start, period_ms = store.number(index, 6), store.number(index, 5)
            compiled.append(TransmitPdo(pdo, found, start, period_ms, timed_only))
    return compiled
