"""DBC text of the bus from the PDO maps and the scaling in force: for cantools, SavvyCAN and others.

Only integers with a factor are written, no float signals: some readers take those for integers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from jtqd.daemon.core.estimate_pdo import (
    CODE_NAMES,
    NO_RATE,
    NO_TORQUE,
    RATE_UNIT_NM_S,
    SIGMA_UNIT_NM,
    SIGMA_UNKNOWN,
    TORQUE_UNIT_NM,
)
from jtqd.drivers.drive import NOT_MEASURED, drive_tpdo3, places
from jtqd.drivers.emcy import EMCY_BASE
from jtqd.drivers.nmt import HEARTBEAT_BASE, STATES
from jtqd.drivers.own_objects import contact_tpdos, estimate_tpdos
from jtqd.drivers.pdo import SYNC_COB_ID, PdoMap
from jtqd.drivers.sensor import sensor_tpdo1, sensor_tpdo2
from jtqd.estimator.status import NAMES

if TYPE_CHECKING:
    from jtqd.daemon.config import Config

_RECEIVER = "Vector__XXX"  # the format's word for "nobody in particular"
_DRIVE_QUANTITIES = {
    "motor_position": ("motor_rad_per_count", "rad"),
    "link_position": ("link_rad_per_count", "rad"),
    "motor_velocity": ("motor_rad_s_per_unit", "rad/s"),
    "current": ("ampere_per_unit", "A"),
}
_PDO_NUMBER = {0x180: 1, 0x280: 2, 0x380: 3, 0x480: 4}


@dataclass(frozen=True)
class Quantity:
    """How the integer of a mapped object is read: physical value = factor * integer.

    Attributes:
        factor: unit per count.
        unit: SI unit, empty for a plain number.
        values: names of single integers.
        fields: (name, bits) from the lowest bit on, where the object holds several numbers; each is then a
            signal of its own, and `values` are those of every one.
    """

    factor: float = 1.0
    unit: str = ""
    values: Mapping[int, str] = field(default_factory=dict)
    fields: tuple[tuple[str, int], ...] = ()


@dataclass(frozen=True)
class _Signal:
    name: str
    start: int
    bits: int
    signed: bool
    quantity: Quantity

    def line(self) -> str:
        sign, factor = "-" if self.signed else "+", self.quantity.factor
        return (
            f' SG_ {self.name} : {self.start}|{self.bits}@1{sign} ({factor!r},0) [0|0] "{self.quantity.unit}"'
            f" {_RECEIVER}"
        )


Key = tuple[int, int, int]
"""COB-ID, index, sub-index."""
_PLAIN = Quantity()


def dbc_of(
    pdo_maps: Sequence[PdoMap],
    quantities: Mapping[Key, Quantity],
    node_names: Mapping[int, str],
    *,
    sync_producer: int,
    sync_counter: bool = False,
) -> str:
    """DBC with SYNC, every PDO, and heartbeat and EMCY of every node.

    Args:
        pdo_maps: TPDOs on the identifiers of the predefined connection set (180h, 280h, 380h, 480h + node).
        quantities: by (COB-ID, index, sub-index); a mapped object without one is a plain integer.
        node_names: node-ID -> name, an identifier of C.
        sync_producer: node-ID of who sends SYNC.
        sync_counter: it has a counter byte (1019h).

    Raises:
        ValueError: a PDO is on no identifier of the set, or its node has no name.
    """
    counter = [_Signal("sync_counter", 0, 8, False, _PLAIN)] if sync_counter else []
    messages = [(SYNC_COB_ID, "SYNC", len(counter), sync_producer, counter)]
    for pdo in pdo_maps:
        base, node = pdo.cob_id & 0x780, pdo.cob_id & 0x07F
        if base not in _PDO_NUMBER or node not in node_names:
            raise ValueError(
                f"PDO {pdo.cob_id:X}h: expected 180h, 280h, 380h or 480h + one of {sorted(node_names)}"
            )
        name = f"{node_names[node]}_TPDO{_PDO_NUMBER[base]}"
        messages.append((pdo.cob_id, name, pdo.length, node, _pdo_signals(pdo, quantities)))
    states = Quantity(values={state: name.replace("-", "_") for state, name in STATES.items()})
    for node, name in node_names.items():
        emergency = [
            _Signal("error_code", 0, 16, False, _PLAIN),
            _Signal("error_register", 16, 8, False, _PLAIN),
            _Signal("manufacturer_error", 24, 40, False, _PLAIN),
        ]
        messages.append((EMCY_BASE + node, f"{name}_EMCY", 8, node, emergency))
        heartbeat = [_Signal("nmt_state", 0, 8, False, states)]
        messages.append((HEARTBEAT_BASE + node, f"{name}_heartbeat", 1, node, heartbeat))
    messages.sort(key=lambda message: message[0])
    lines = ['VERSION ""', "", "NS_ :", "", "BS_:", "", "BU_: " + " ".join(node_names.values()), ""]
    values = []
    for can_id, name, length, node, signals in messages:
        lines.append(f"BO_ {can_id} {name}: {length} {node_names[node]}")
        lines += [signal.line() for signal in signals]
        lines.append("")
        for signal in signals:
            if signal.quantity.values:
                entries = " ".join(f'{value} "{text}"' for value, text in signal.quantity.values.items())
                values.append(f"VAL_ {can_id} {signal.name} {entries} ;")
    return "\n".join([*lines, *values, ""])


def _pdo_signals(pdo: PdoMap, quantities: Mapping[Key, Quantity]) -> list[_Signal]:
    signals, start = [], 0
    for mapped in pdo.objects:
        quantity = quantities.get((pdo.cob_id, mapped.index, mapped.subindex), _PLAIN)
        name = mapped.name or f"object_{mapped.index:04X}_{mapped.subindex}"
        at = start
        for part, bits in quantity.fields or ((name, mapped.bits),):
            signals.append(_Signal(part, at, bits, mapped.signed, quantity))
            at += bits
        start += mapped.bits
    return signals


def _own_quantities(pdo: PdoMap, first: int) -> dict[Key, Quantity]:
    """Return the objects of jtqd's estimate or contact PDO that begins with joint `first` (`daemon.core`)."""
    pair = (first, first + 1)
    torque = Quantity(TORQUE_UNIT_NM, "Nm", {NO_TORQUE: "no_torque"})
    sigma = Quantity(SIGMA_UNIT_NM, "Nm", {SIGMA_UNKNOWN: "unknown"})
    status = Quantity(values=NAMES, fields=tuple((f"status_{joint}", 4) for joint in pair))
    rate = Quantity(RATE_UNIT_NM_S, "Nm/s", {NO_RATE: "no_rate"})
    contact = Quantity(values=CODE_NAMES, fields=tuple((f"contact_{joint}", 4) for joint in pair))
    by_index = {0x2100: torque, 0x2101: sigma, 0x2102: status, 0x2105: status}
    by_index |= {0x2106: rate, 0x2107: contact, 0x2108: contact}
    return {
        (pdo.cob_id, each.index, each.subindex): by_index[each.index]
        for each in pdo.objects
        if each.index in by_index
    }


def dbc_text(config: Config, report: Mapping[str, Any] | None) -> str:
    """DBC of a configured bus with the scaling that the boot read from its devices.

    Args:
        config: names the nodes; with a report that after the boot (`as_booted`).
        report: boot report; `nodes[n].scaling` of each drive and of the sensor. None: the devices are not known, what
            they send is plain integers.
    """
    count, names = len(config.joints), {config.node_id: "jtqd"}
    maps: list[PdoMap] = []
    quantities: dict[Key, Quantity] = {}
    with_contacts = config.contact is not None and config.contact.pdo
    for own in (estimate_tpdos, contact_tpdos) if with_contacts else (estimate_tpdos,):
        for pair, pdo in enumerate(own(count, config.node_id)):
            maps.append(pdo)
            quantities |= _own_quantities(pdo, 2 * pair + 1)
    for joint in config.joints:
        node = joint.node_id
        names[node] = f"drive_{joint.number}"
        maps += joint.tpdos
        scaling = _scaling(report, node)
        if scaling is not None:
            found = places(joint.objects, joint.tpdos)
            for name, (factor, unit) in _DRIVE_QUANTITIES.items():
                if name in found:
                    pdo = joint.tpdos[found[name].pdo]
                    mapped = pdo.objects[found[name].entry]
                    quantities[pdo.cob_id, mapped.index, mapped.subindex] = Quantity(scaling[factor], unit)
        if joint.temperature is not None:
            pdo3 = drive_tpdo3(node, joint.temperature)
            maps.append(pdo3)
            degrees = Quantity(joint.temperature.c_per_unit, "degC", {NOT_MEASURED: "not_measured"})
            quantities[pdo3.cob_id, *joint.temperature.key] = degrees
    if config.sensor is not None:
        node = config.sensor.node_id
        names[node] = "torque_sensor"
        # JSON keys are text: the report holds {"1": factor, ...}.
        found = _scaling(report, node)
        factors = None if found is None else found["nm_per_unit"]
        for channel, (make, index) in {1: (sensor_tpdo1, 0x9130), 2: (sensor_tpdo2, 0x7130)}.items():
            if channel in config.sensor.channels:
                pdo = make(node)
                maps.append(pdo)
                if factors is not None:
                    quantities[pdo.cob_id, index, channel] = Quantity(factors[str(channel)], "Nm")
    return dbc_of(
        maps,
        quantities,
        names,
        sync_producer=config.node_id,
        sync_counter=config.counter_overflow > 0,
    )


def _scaling(report: Mapping[str, Any] | None, node: int) -> Any:
    """Return what the boot read from a node; None without a report, or of an optional node that was absent."""
    booted = None if report is None else report["nodes"].get(str(node))
    return None if booted is None else booted["scaling"]
