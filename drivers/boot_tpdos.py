"""TPDOs of one node at its boot: as wanted where they are so or can be written, else as they are, if that is enough.

What is as wanted is read and not written. The first write that the drive refuses (its mapping is fixed, or some of it)
ends the attempt: what was changed is put back, and all four TPDOs are read. Where they carry every quantity
(`layout.chosen`) they are used as they are. Of those jtqd writes COB-ID bit 31 (valid) and the transmission type, each only
where it must.

Order of the writes, of CiA 301, 7.5.2.36: COB-ID with bit 31 set, number of entries 0, entries, number of entries,
transmission type, COB-ID. All of it is read back.
"""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

from jtqd.drivers.boot_error import BootError
from jtqd.drivers.devices import EVENT_DRIVEN, EVENT_MS, DriveProfile, Profile
from jtqd.drivers.layout import BY_ITSELF, EVERY_SYNC, LayoutError, chosen, pdo_of_words
from jtqd.drivers.pdo import CAN_ID, EXTENDED, INVALID, NO_RTR, PdoError, PdoMap
from jtqd.drivers.sdo import Key, label
from jtqd.drivers.sdo_client import NodeObjects

_TPDO_COUNT = 4
"""TPDOs of the predefined connection set: those not used are switched off."""
_PARAMETERS = range(0x1800, 0x1C00)
"""Communication and mapping parameters of TPDOs."""
_MAPPING = 0x200
"""1800h -> 1A00h."""
_INHIBIT_TIME, _EVENT_TIMER = 3, 5
"""Sub-indices of a PDO's communication parameter."""
_MOST_ENTRIES = 8
"""Whole objects in a frame."""


class _Change(NamedTuple):
    """One write, and what the object had before it."""

    key: Key
    before: int
    size: int


class TpdoSetup:
    """TPDOs of one node. `run` raises BootError for what the node lacks, refuses or does not keep.

    Args:
        objects: of the node; the values in force are in its `values` afterwards.
        profile: says which TPDOs are wanted.
        notes: takes what the operator should know although nothing is wrong.
    """

    def __init__(self, objects: NodeObjects, profile: Profile, notes: list[str]) -> None:
        self._objects, self._profile, self._notes = objects, profile, notes
        self._cob_ids: dict[int, int] = {}
        """Of TPDOs that are to be mapped anew, before it."""
        self._changes: list[_Change] = []
        self._now: dict[Key, int] = {}
        """What was written last."""

    def run(self) -> tuple[PdoMap, ...]:
        """Set up the TPDOs and return those that are used."""
        wanted = {pdo.number: pdo for pdo in self._profile.tpdos}
        try:
            for number in range(1, _TPDO_COUNT + 1):
                pdo = wanted.get(number)
                if pdo is None:
                    self._switch_off(number)
                elif not self._as_wanted(pdo):
                    self._write(pdo)
        except BootError as refused:
            if not _is_refused_write(refused):
                raise
            return self._use_as_found(refused)
        return self._profile.tpdos

    # As wanted ------------------------------------------------------------------------------------------------------

    def _as_wanted(self, pdo: PdoMap) -> bool:
        """Return whether a TPDO is valid and as wanted; remember what it had otherwise."""
        objects, communication = self._objects, 0x1800 + pdo.number - 1
        mapping = communication + _MAPPING
        cob_id = objects.number((communication, 1), 4)
        count = objects.number((mapping, 0), 1)
        self._cob_ids[pdo.number] = cob_id
        return (
            cob_id & ~NO_RTR == pdo.cob_id
            and count == len(pdo.words)
            and all(objects.number((mapping, n), 4) == word for n, word in enumerate(pdo.words, 1))
            and objects.number((communication, 2), 1) == pdo.transmission_type
            and (not _is_temperature(pdo) or self._timers_as_wanted(communication))
        )

    def _timers_as_wanted(self, communication: int) -> bool:
        inhibit = self._objects.optional_number((communication, _INHIBIT_TIME), 2)
        timer = self._objects.optional_number((communication, _EVENT_TIMER), 2)
        return inhibit in (None, 10 * EVENT_MS) and timer == EVENT_MS

    def _write(self, pdo: PdoMap) -> None:
        """Map a TPDO anew."""
        objects, communication = self._objects, 0x1800 + pdo.number - 1
        mapping = communication + _MAPPING
        cob_id = self._cob_ids[pdo.number]
        self._change((communication, 1), cob_id | INVALID, 4)
        self._change((mapping, 0), 0, 1)
        for entry, word in enumerate(pdo.words, 1):
            self._change((mapping, entry), word, 4)
        self._change((mapping, 0), len(pdo.words), 1)
        self._change((communication, 2), pdo.transmission_type, 1)
        if _is_temperature(pdo):
            self._set_timers(communication)
        # the device's own RTR bit is kept: some accept one value only
        valid = cob_id & NO_RTR | pdo.cob_id
        self._change((communication, 1), valid, 4)
        # read back at the end and not after each write: a later write may undo an earlier one
        for entry in range(len(pdo.words) + 1, _MOST_ENTRIES + 1):
            objects.values.pop((mapping, entry), None)  # of the mapping before, and none of this one
        objects.require((mapping, 0), len(pdo.words), 1, "number of mapped objects")
        for entry, word in enumerate(pdo.words, 1):
            objects.require((mapping, entry), word, 4, "mapping entry")
        objects.require((communication, 2), pdo.transmission_type, 1, "transmission type")
        objects.require((communication, 1), valid, 4, "COB-ID")

    def _set_timers(self, communication: int) -> None:
        """Set event timer, and inhibit time where the node has one: a value that flickers must not fill the bus."""
        inhibit, timer = (communication, _INHIBIT_TIME), (communication, _EVENT_TIMER)
        if self._objects.read(inhibit) is not None:
            self._change(inhibit, 10 * EVENT_MS, 2)
            self._objects.require(inhibit, 10 * EVENT_MS, 2, "inhibit time in 100 us")
        self._change(timer, EVENT_MS, 2)
        self._objects.require(timer, EVENT_MS, 2, "event timer in ms")

    def _change(self, key: Key, value: int, size: int) -> None:
        """Write a number, and remember what was there before it."""
        before = self._now.get(key, self._objects.values.get(key))
        if before is None:
            raw = self._objects.read(key)
            before = None if raw is None else int.from_bytes(raw[:size], "little")
        self._objects.write(key, value, size)
        self._now[key] = value
        if before is not None:
            self._changes.append(_Change(key, before, size))

    def _switch_off(self, number: int) -> None:
        key = (0x1800 + number - 1, 1)
        cob_id = self._objects.optional_number(key, 4)
        if cob_id is not None and not cob_id & INVALID:
            self._change(key, cob_id | INVALID, 4)
            self._objects.require(key, cob_id | INVALID, 4, "COB-ID")

    # As found -------------------------------------------------------------------------------------------------------

    def _use_as_found(self, refused: BootError) -> tuple[PdoMap, ...]:
        """Put back what was changed and use the TPDOs as they are; raises `refused`, and why they are not enough."""
        self._put_back()
        values = self._objects.values
        for key in [key for key in values if key[0] in _PARAMETERS]:
            del values[key]  # of the attempt
        found, unusable = self._found()
        try:
            used = self._chosen(found)
        except LayoutError as error:
            raise refused.explained("; ".join((str(error), *unusable))) from refused
        for number in range(1, _TPDO_COUNT + 1):
            if number not in {pdo.number for pdo in used}:
                self._try_to_switch_off(number)
        used = tuple(self._valid(pdo) for pdo in used)
        names = ", ".join(f"TPDO{pdo.number} ({pdo.cob_id:03X}h)" for pdo in used)
        self._notes.append(f"its mapping is used as it is: {names} ({refused.detail})")
        return used

    def _put_back(self) -> None:
        """Undo what the attempt has written, the last first: that is the order of CiA 301 again.

        What the drive does not take back will show when its TPDOs are read.
        """
        for change in reversed(self._changes):
            with suppress(BootError):
                self._objects.write(change.key, change.before, change.size)
        self._changes.clear()
        self._now.clear()

    def _found(self) -> tuple[list[PdoMap], list[str]]:
        """Read all TPDOs that there are; return those that can be used, and why others cannot."""
        maps, unusable = [], []
        for number in range(1, _TPDO_COUNT + 1):
            communication = 0x1800 + number - 1
            objects = NodeObjects(self._objects.access, self._profile.node_id)
            cob_id = objects.optional_number((communication, 1), 4)
            if cob_id is None:
                continue
            count = objects.number((communication + _MAPPING, 0), 1)
            words = [
                objects.number((communication + _MAPPING, entry), 4)
                for entry in range(1, min(count, _MOST_ENTRIES) + 1)
            ]
            kind = objects.number((communication, 2), 1)
            try:
                if cob_id & EXTENDED:
                    raise PdoError(f"TPDO{number} has a 29-bit COB-ID")
                maps.append(self._map_of(number, cob_id & CAN_ID, words, kind))
            except PdoError as error:
                if count:
                    unusable.append(f"TPDO{number}: {error}")
        return maps, unusable

    def _map_of(self, number: int, cob_id: int, words: list[int], kind: int) -> PdoMap:
        """Return the map of a TPDO that was found; of a sensor by the objects of its own profile."""
        profile = self._profile
        if isinstance(profile, DriveProfile):
            return pdo_of_words(profile.node_id, number, cob_id, words, kind, profile.objects)
        for pdo in profile.tpdos:
            if (pdo.number, pdo.cob_id, list(pdo.words)) == (number, cob_id, words):
                return PdoMap(cob_id, pdo.objects, kind, number)
        raise PdoError(f"it maps {', '.join(f'0x{word:08X}' for word in words)}")

    def _chosen(self, found: list[PdoMap]) -> tuple[PdoMap, ...]:
        """Return the TPDOs that carry all that the profile wants. Raises LayoutError."""
        profile = self._profile
        if not isinstance(profile, DriveProfile):
            carried = {pdo.cob_id for pdo in found}
            if missing := [f"{pdo.cob_id:03X}h" for pdo in profile.tpdos if pdo.cob_id not in carried]:
                raise LayoutError(f"no TPDO is that of {', '.join(missing)}")
            return tuple(found)
        used = chosen(profile.objects, found)
        if profile.temperature is None:
            return used
        (wanted,) = filter(_is_temperature, profile.tpdos)
        same = [pdo for pdo in found if (pdo.cob_id, pdo.words) == (wanted.cob_id, wanted.words)]
        if not same:
            raise LayoutError(
                f"no TPDO with COB-ID {wanted.cob_id:03X}h carries {label(*profile.temperature.key)} alone (temperature)"
            )
        return (*used, PdoMap(wanted.cob_id, wanted.objects, same[0].transmission_type, same[0].number))

    def _try_to_switch_off(self, number: int) -> None:
        """Switch off a TPDO that nobody needs; one that cannot be costs bus load and no more."""
        try:
            self._switch_off(number)
        except BootError as error:
            self._notes.append(f"TPDO{number} is not needed and stays on ({error.detail})")

    def _asked_for(self, pdo: PdoMap) -> tuple[int, ...]:
        """Return the types that the profile itself wants for a TPDO of this number."""
        return tuple(
            each.transmission_type
            for each in self._profile.tpdos
            if each.number == pdo.number and each.transmission_type in BY_ITSELF
        )

    def _by_itself(self, pdo: PdoMap, refused: BootError) -> bool:
        """Accept a TPDO that the drive sends by itself, where the profile allows it; raises `refused`."""
        profile = self._profile
        if pdo.transmission_type not in BY_ITSELF:
            raise refused.explained(
                f"TPDO{pdo.number} has transmission type {pdo.transmission_type}"
            ) from refused
        if not (isinstance(profile, DriveProfile) and profile.by_itself):
            text = f"TPDO{pdo.number} has transmission type {pdo.transmission_type}: joint_N.max_age_ms allows it"
            raise refused.explained(text) from refused
        self._notes.append(f"TPDO{pdo.number} keeps transmission type {pdo.transmission_type}")
        return True

    def _valid(self, pdo: PdoMap) -> PdoMap:
        """Make a TPDO valid, and sent at each SYNC, where it is not; return it as it then is, read once more."""
        objects, communication = self._objects, 0x1800 + pdo.number - 1
        cob_id = objects.number((communication, 1), 4)
        event = _is_temperature(pdo) or pdo.transmission_type in self._asked_for(pdo)
        if pdo.transmission_type != EVERY_SYNC and not event:
            with suppress(BootError):
                if not cob_id & INVALID:
                    objects.write((communication, 1), cob_id | INVALID, 4)
            try:
                objects.write((communication, 2), EVERY_SYNC, 1)
            except BootError as refused:
                event = self._by_itself(pdo, refused)
        if objects.number((communication, 1), 4) & INVALID:
            objects.put((communication, 1), cob_id & NO_RTR | pdo.cob_id, 4, "COB-ID")
        mapping = communication + _MAPPING
        objects.require((mapping, 0), len(pdo.words), 1, "number of mapped objects")
        for entry, word in enumerate(pdo.words, 1):
            objects.require((mapping, entry), word, 4, "mapping entry")
        kind = pdo.transmission_type if event else EVERY_SYNC
        objects.require((communication, 2), kind, 1, "transmission type")
        return PdoMap(pdo.cob_id, pdo.objects, kind, pdo.number)


def _is_temperature(pdo: PdoMap) -> bool:
    """Return whether this is the event-driven TPDO with the temperature, whose timers jtqd sets."""
    return pdo.transmission_type in EVENT_DRIVEN and pdo.names[0] == "temperature"


def _is_refused_write(error: BootError) -> bool:
    """Return whether the node has refused a write of its TPDOs' parameters."""
    written = error.letter == "J" and error.expected.endswith(" accepted")
    return written and error.object.startswith(("18", "19", "1A", "1B"))
