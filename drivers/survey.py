"""Survey of a device by SDO or by its EDS: identity, scaling, the objects that jtqd maps, its TPDOs.

Reading changes nothing in a device and starts nothing. Objects: CiA 301 (1000h, 1008h to 100Ah, 1018h), CiA 402-2
(6075h, 6076h, 6077h, 608Fh, 6090h, 6091h, 60E6h, 60EBh, units by 6092h, 60A8h and 60A9h where there are such, and what the
TPDOs carry), CiA 404 (6131h, 6132h, 9130h, 6150h).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from jtqd.drivers.bus_socket import exact
from jtqd.drivers.drive import DRIVE_SCALING_OBJECTS, OTHER_SCALING_OBJECTS, drive_layout
from jtqd.drivers.frame import FRAME, FRAME_SIZE, pack
from jtqd.drivers.frame_socket import FrameSocket, open_frame_socket
from jtqd.drivers.object_dictionary import VISIBLE_STRING, EdsError, Entry, read_eds
from jtqd.drivers.pdo import SYNC_COB_ID, SYNC_LISTEN_S, TPDO_COUNT, Tpdo, read_tpdos, tpdo_parameters
from jtqd.drivers.sdo import (
    ANSWER_S,
    PATIENCE,
    REQUEST_ID,
    RESPONSE_ID,
    Key,
    SdoAbort,
    SdoAccess,
    SdoClient,
    SdoTimeout,
    Transfer,
    label,
)
from jtqd.drivers.sensor import DECIMALS_OBJECT, UNIT_OBJECT, sensor_tpdo1

DRIVE, SENSOR = 402, 404
"""Device profiles: low 16 bits of 1000h."""
TEXTS: Mapping[str, Key] = {"name": (0x1008, 0), "hardware": (0x1009, 0), "software": (0x100A, 0)}
IDENTITY: Mapping[str, Key] = {
    name: (0x1018, sub) for sub, name in enumerate(("vendor", "product", "revision", "serial"), 1)
}
RATED_CURRENT, RATED_TORQUE, TORQUE = (0x6075, 0), (0x6076, 0), (0x6077, 0)
MAPPED: Mapping[int, tuple[Key, ...]] = {
    DRIVE: tuple((each.index, each.subindex) for pdo in drive_layout(1) for each in pdo.objects),
    SENSOR: tuple((each.index, each.subindex) for each in sensor_tpdo1(1).objects),
}
"""Objects that jtqd maps into TPDOs, by profile; of a sensor the first channel."""
_READ: Mapping[int, tuple[Key, ...]] = {
    DRIVE: (*DRIVE_SCALING_OBJECTS, RATED_TORQUE, TORQUE, *MAPPED[DRIVE]),
    SENSOR: ((UNIT_OBJECT, 1), (DECIMALS_OBJECT, 1), *MAPPED[SENSOR]),
}
UNITS: tuple[Key, ...] = tuple(key for key in OTHER_SCALING_OBJECTS if key not in _READ[DRIVE])
"""Objects with the units in which a drive counts; a drive need not have them."""
_NODES = range(1, 128)
_PRESENT_S = 1.0
"""For the first answer of a node."""


class SurveyError(ValueError):
    """A device that cannot be read to the end; the message is one line."""


@dataclass(frozen=True)
class Survey:
    """One device.

    Attributes:
        source: where the values are from: "the bus", "defaults of NAME.eds", or "values of NAME.dcf".
        profile: 402, 404 or another device profile; 0: none.
        texts: 1008h to 100Ah by the names of TEXTS, where it has them.
        numbers: objects that it has, with their values (of an EDS: the defaults).
        missing: objects of its profile that it does not have.
        unmappable: objects that cannot be mapped by its EDS; empty when read on a bus, where this is not known.
        defaults: the numbers are defaults; the device itself may have others.
        tpdos: as they are configured, where they were read.
        eds_notes: what cannot be read of its EDS.
    """

    node: int
    source: str
    profile: int
    texts: Mapping[str, str]
    numbers: Mapping[Key, int]
    missing: frozenset[Key] = frozenset()
    unmappable: frozenset[Key] = frozenset()
    defaults: bool = False
    tpdos: tuple[Tpdo, ...] = ()
    eds_notes: tuple[str, ...] = ()

    @property
    def notes(self) -> list[str]:
        """What is odd in its EDS or its mapping, and is used as far as it can be."""
        return [*self.eds_notes, *(f"node {self.node}: {each.note}" for each in self.tpdos if each.note)]

    @property
    def title(self) -> str:
        """Its name, or its kind."""
        kinds = {DRIVE: "drive", SENSOR: "torque sensor"}
        return self.texts.get("name") or kinds.get(self.profile, f"device of profile {self.profile}")

    def number(self, key: Key) -> int | None:
        """Return a value that can scale: at least 1; None where there is none."""
        value = self.numbers.get(key)
        return value if value is not None and value >= 1 else None

    def scales_by(self, key: Key) -> bool:
        """Whether the device has the scaling object: with a value, or in its EDS, of which the value does not count."""
        return self.number(key) is not None or (self.defaults and key in self.numbers)


def tpdos(access: SdoAccess) -> tuple[Tpdo, ...]:
    """Read the TPDOs of the predefined connection set. Raises SurveyError."""
    return _tpdos(partial(_number, access))


def _tpdos(number_of: Callable[[Key], int | None]) -> tuple[Tpdo, ...]:
    timers = {number: (tpdo_parameters(number)[0], 5) for number in range(1, TPDO_COUNT + 1)}
    found = read_tpdos(number_of)
    return tuple(
        each if each.fault else replace(each, timer_ms=number_of(timers[each.number]) or 0) for each in found
    )


def _number(access: SdoAccess, key: Key) -> int | None:
    """Return a number of up to 32 bits, as the boot reads it; None when the device refuses it. Raises SurveyError."""
    try:
        return int.from_bytes(access.read(*key)[:4], "little")
    except SdoAbort:
        return None
    except SdoTimeout as silence:  # not to be taken for an object that is not there
        raise SurveyError(f"{label(*key)}: {silence}") from None


def survey(access: SdoAccess, node: int) -> Survey:
    """Read a device by SDO; one that refuses 1000h has profile 0.

    Raises:
        SdoTimeout: it does not answer.
        SurveyError: it has answered, but to an object that matters it does not.
    """
    try:
        device_type = int.from_bytes(access.read(0x1000, 0)[:4], "little")
    except SdoAbort:
        device_type = 0
    texts: dict[str, str] = {}
    for name, key in TEXTS.items():
        with suppress(SdoAbort, SdoTimeout):  # cosmetic
            texts[name] = _text(access.read(*key))
    profile = device_type & 0xFFFF
    needed = (*IDENTITY.values(), *_READ.get(profile, ()))
    optional = UNITS if profile == DRIVE else ()
    found = {key: _number(access, key) for key in (*needed, *optional)}
    return Survey(
        node,
        "the bus",
        profile,
        texts,
        {key: number for key, number in found.items() if number is not None},
        frozenset(key for key in needed if found[key] is None),
    )


def survey_of_eds(path: Path, node: int, more: Iterable[Key] = ()) -> Survey:
    """Read a device from its EDS or DCF; `more`: further objects that shall be among its numbers.

    Raises EdsError, also for one of its objects that cannot be read; the value of one that is only mapped does not matter.
    """
    eds, profile = read_eds(path, node), 0
    cosmetic = (*TEXTS.values(), IDENTITY["revision"], IDENTITY["serial"])
    every = {(each.index, each.subindex): each for each in eds.entries}
    entries = {key: each for key, each in every.items() if not (each.fault and key in cosmetic)}

    def number(key: Key) -> int:
        entry = entries[key]
        if entry.fault and not (entry.data_type and key in MAPPED.get(profile, ())):
            raise EdsError(entry.fault)
        return int.from_bytes(entry.default, "little") if entry.is_integer else 0

    profile = number((0x1000, 0)) & 0xFFFF if (0x1000, 0) in entries else 0
    wanted = (*IDENTITY.values(), *_READ.get(profile, ()), *more)
    optional = UNITS if profile == DRIVE else ()
    return Survey(
        node=node,
        source=f"{'values' if eds.configured else 'defaults'} of {path.name}",
        defaults=True,
        profile=profile,
        texts={
            name: text
            for name, key in TEXTS.items()
            if key in entries
            and entries[key].data_type == VISIBLE_STRING
            and (text := _text(entries[key].default))
        },
        numbers={key: number(key) for key in (*wanted, *optional) if key in entries},
        missing=frozenset(key for key in wanted if key not in entries),
        unmappable=frozenset(
            key for key in (*MAPPED.get(profile, ()), *more) if key in entries and not entries[key].mappable
        ),
        tpdos=tuple(
            _fixed_by(each, entries) for each in _tpdos(lambda key: number(key) if key in entries else None)
        ),
        eds_notes=eds.notes,
    )


def _fixed_by(pdo: Tpdo, entries: Mapping[Key, Entry]) -> Tpdo:
    """Return the TPDO with what its EDS has of mapping and transmission type: whether they can be written."""
    communication, mapping = tpdo_parameters(pdo.number)
    if pdo.fault:
        return pdo

    def fixed(*keys: Key) -> bool:
        return any(key in entries and not entries[key].writable for key in keys)

    entry_keys = ((mapping, sub) for sub in range(len(pdo.words) + 1))
    return replace(pdo, mapping_fixed=fixed(*entry_keys), type_fixed=fixed((communication, 2)))


class BusSurvey:
    """Surveys of a bus without a master. Raises BusError (open, and every call), ValueError: a bus in service.

    Requests and answers of an SDO server that another master uses would be mixed up, so a bus with SYNC is refused.
    """

    def __init__(self, bus: str) -> None:
        identifiers = [SYNC_COB_ID, *(RESPONSE_ID + node for node in _NODES)]
        self._socket: FrameSocket = open_frame_socket(bus, [exact(each) for each in identifiers])
        end = time.monotonic() + SYNC_LISTEN_S
        while (left := end - time.monotonic()) > 0.0:
            if SYNC_COB_ID in self._received(left):
                self._socket.close()
                raise ValueError(
                    f"{bus}: SYNC is on the bus: a master is running; end it first (jtqd, a PLC)"
                )

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def nodes(self, among: Iterable[int] = _NODES) -> list[int]:
        """Return the nodes that answer to a read of 1000h within a second, a few asked at a time."""
        found: set[int] = set()
        waiting = list(among)
        while waiting:
            asked, waiting = waiting[:16], waiting[16:]
            for node in asked:
                self._socket.send(pack(REQUEST_ID + node, Transfer(0x1000, 0).request))
            found |= self._answers(0.02)
        end = time.monotonic() + _PRESENT_S
        while (left := end - time.monotonic()) > 0.0:
            found |= self._answers(left)
        return sorted(found)

    def read(self, node: int) -> Survey | None:
        """Survey one node; None when it does not answer. Raises SurveyError."""
        try:
            with self._access(node) as access:
                return survey(access, node)
        except SdoTimeout as silence:
            if silence.refused:
                raise SurveyError(f"node {node}: {silence}") from None
            return None

    def numbers(self, node: int, keys: Iterable[Key]) -> dict[Key, int]:
        """Read further numbers of one node; those that it does not have are left out. Raises SurveyError."""
        with self._access(node) as access:
            found = {key: _number(access, key) for key in keys}
        return {key: number for key, number in found.items() if number is not None}

    def tpdos(self, node: int) -> tuple[Tpdo, ...]:
        """Read the TPDOs of one node. Raises SurveyError."""
        with self._access(node) as access:
            return tpdos(access)

    @contextmanager
    def _access(self, node: int) -> Iterator[SdoClient]:
        """Give the SDO client of one node, which repeats a request as the boot does; a SurveyError names the node."""
        try:
            yield SdoClient(self._socket, node, PATIENCE * ANSWER_S, ANSWER_S)
        except SurveyError as error:
            raise SurveyError(f"node {node}: {error}") from None

    def _answers(self, timeout_s: float) -> set[int]:
        return {can_id - RESPONSE_ID for can_id in self._received(timeout_s) if can_id > RESPONSE_ID}

    def _received(self, timeout_s: float) -> list[int]:
        socket = self._socket
        if not socket.wait(timeout_s):
            return []
        return [FRAME.unpack_from(socket.frames, FRAME_SIZE * at)[0] for at in range(socket.receive())]


def _text(raw: bytes) -> str:
    """Return a VISIBLE_STRING without control characters."""
    return "".join(each for each in raw.decode("ascii", "replace") if each.isprintable()).strip()
