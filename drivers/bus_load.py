"""Bus load of a configuration, before it runs: in the worst case and without stuff bits. Pure.

The worst case of a data frame is 55 + 10 n bits (Davis et al. 2007, Real-Time Systems 35:239). A
configuration above 95 % of it is refused: what is left must carry SDO, EMCY and a retransmission.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from jtqd.drivers.drive import EVENT_MS, drive_layout, drive_tpdo3
from jtqd.drivers.frame import unstuffed_bits, worst_case_bits
from jtqd.drivers.nmt import HEARTBEAT_BASE
from jtqd.drivers.own_objects import JTQD_NODE, contact_tpdos, estimate_tpdos
from jtqd.drivers.pdo import ACYCLIC, LAST_SYNC_TYPE, SYNC_COB_ID, PdoMap
from jtqd.drivers.sensor import sensor_tpdo1, sensor_tpdo2

LIMIT = 0.95
BITRATE = 1_000_000
PERIOD_S = 1e-3
HEARTBEAT_BYTES = 1
_ESTIMATES = ("jtqd estimate", "jtqd estimate 3, 4")
_CONTACTS = ("jtqd contact", "jtqd contact 3, 4")


class BusLoadError(ValueError):
    """The configuration does not fit the bus, or its load has no bound."""


@dataclass(frozen=True)
class Row:
    """One identifier: `per_cycle` frames of `length` bytes in each cycle."""

    cob_id: int
    who: str
    length: int
    per_cycle: float = 1.0

    @property
    def worst_bits(self) -> float:
        """Bits per cycle with every possible stuff bit, intermission included."""
        return worst_case_bits(self.length) * self.per_cycle


@dataclass(frozen=True)
class BusLoad:
    """The sum over all rows, as share of the bits that a cycle of `period_s` holds."""

    rows: tuple[Row, ...]
    bitrate: int = BITRATE
    period_s: float = PERIOD_S

    @property
    def capacity_bits(self) -> float:
        """Bits in one cycle."""
        return self.bitrate * self.period_s

    @property
    def worst(self) -> float:
        """Worst-case share, 1.0 = full."""
        return sum(row.worst_bits for row in self.rows) / self.capacity_bits

    @property
    def unstuffed(self) -> float:
        """Share without stuff bits: the load is never below it."""
        return sum(unstuffed_bits(row.length) * row.per_cycle for row in self.rows) / self.capacity_bits

    def table(self) -> list[dict[str, object]]:
        """Return the rows in the order of priority: cob_id, who, bytes, per_cycle, worst_bits, share (of a cycle)."""
        return [
            {
                "cob_id": f"{row.cob_id:03X}h",
                "who": row.who,
                "bytes": row.length,
                "per_cycle": row.per_cycle,
                "worst_bits": row.worst_bits,
                "share": row.worst_bits / self.capacity_bits,
            }
            for row in sorted(self.rows, key=lambda row: row.cob_id)
        ]


def pdo_row(who: str, pdo: PdoMap) -> Row:
    """Return the row of a synchronous PDO. Raises BusLoadError for an event-driven one, which has no bound."""
    kind = pdo.transmission_type
    if not 1 <= kind <= LAST_SYNC_TYPE:
        where = f"PDO {pdo.cob_id:X}h of {who}"
        raise BusLoadError(f"{where}: transmission type {kind} is not bound to SYNC, its load has no bound")
    return Row(pdo.cob_id, who, pdo.length, 1.0 / kind)


def heartbeat_row(who: str, node: int, heartbeat_ms: int, period_s: float = PERIOD_S) -> Row:
    """Return the row of one node's heartbeat."""
    if heartbeat_ms < 1:
        raise BusLoadError(f"heartbeat of {who}: {heartbeat_ms} ms, expected at least 1")
    return Row(HEARTBEAT_BASE + node, f"heartbeat {who}", HEARTBEAT_BYTES, period_s * 1e3 / heartbeat_ms)


def configured_load(
    drives: Iterable[int] | Mapping[int, Sequence[PdoMap]],
    sensors: Mapping[int, tuple[int, ...]],
    *,
    sync_counter: bool = False,
    temperatures: Iterable[int] = (),
    contacts: bool = False,
    heartbeat_ms: int = 100,
    master: int = JTQD_NODE,
    extra: Iterable[Row] = (),
    bitrate: int = BITRATE,
    period_s: float = PERIOD_S,
) -> BusLoad:
    """Add up drives (node numbers), sensors (node -> channels), SYNC, estimates, heartbeats and `extra`.

    `drives` may hold their TPDOs by node; without, they are as jtqd maps them. `sync_counter`: SYNC has a counter byte
    (1019h). `temperatures`: nodes among the drives that send their joint's temperature. `contacts`: jtqd sends
    the contact PDOs.
    """
    layouts = drives if isinstance(drives, Mapping) else {node: drive_layout(node) for node in drives}
    own = dict(zip(_ESTIMATES, estimate_tpdos(len(layouts), master), strict=False))
    if contacts:
        own |= zip(_CONTACTS, contact_tpdos(len(layouts), master), strict=False)
    rows = [Row(SYNC_COB_ID, "SYNC", 1 if sync_counter else 0)]
    rows += [pdo_row(who, pdo) for who, pdo in own.items()]
    rows.append(heartbeat_row("jtqd", master, heartbeat_ms, period_s))
    for node, tpdos in layouts.items():
        for pdo in tpdos:
            who = f"drive {node} TPDO{pdo.number}"
            # one that the drive sends by itself is counted once per SYNC: an inhibit time must keep it so
            acyclic = pdo.transmission_type in ACYCLIC
            rows.append(Row(pdo.cob_id, who, pdo.length) if acyclic else pdo_row(who, pdo))
        rows.append(heartbeat_row(f"drive {node}", node, heartbeat_ms, period_s))
    for node in temperatures:  # the boot's event timer and inhibit time let one come in EVENT_MS
        pdo = drive_tpdo3(node)
        rows.append(Row(pdo.cob_id, f"drive {node} TPDO3", pdo.length, period_s * 1e3 / EVENT_MS))
    for node, channels in sensors.items():
        pdos = sensor_tpdo1(node), sensor_tpdo2(node)
        rows += [pdo_row(f"sensor {node} channel {channel}", pdos[channel - 1]) for channel in channels]
        rows.append(heartbeat_row(f"sensor {node}", node, heartbeat_ms, period_s))
    return BusLoad((*rows, *extra), bitrate, period_s)


def check_bus_load(load: BusLoad, limit: float = LIMIT) -> BusLoad:
    """Return the load itself when it fits. Raises BusLoadError above `limit` or when two rows share an identifier."""
    seen: dict[int, str] = {}
    for row in load.rows:
        if row.cob_id in seen:
            raise BusLoadError(f"COB-ID {row.cob_id:X}h is used twice: {seen[row.cob_id]} and {row.who}")
        seen[row.cob_id] = row.who
    if load.worst > limit:
        raise BusLoadError(
            f"bus load {load.worst:.1%} in the worst case, expected at most {limit:.0%} "
            f"of {load.bitrate} bit/s at a period of {load.period_s * 1e3:g} ms"
        )
    return load
