"""Is a node still configured as it was at its boot? Its objects are read again in service, one at a time. Pure.

A node with 1020h says itself whether anybody has written to its configuration: the object holds the signature that the boot
wrote, until somebody does (CiA 301). It need not cover the scaling, and a value may change by other ways than an SDO. So all
objects are read, one after the other and again from the beginning, that the meaning of its PDOs depends on
(`drivers/watched_objects.py`): COB-ID, transmission type and mapping of the TPDOs, rated current, encoder resolutions, gear
ratio, the sensor's unit and decimals. The signature is read between them, in every `SIGNATURE_EVERY`th reading.

A signature that is gone while these are unchanged is somebody else's business (the commander maps RPDOs) and is said once.
The mode of operation that a drive displays (6061h) means nothing for the estimate; a change of it is said.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from drivers.boot_procedure import VERIFY_CONFIGURATION
from drivers.configuration_hash import signature
from drivers.sdo_abort import NO_OBJECT, NO_SUBINDEX

SIGNATURE_EVERY = 4
_CAN_ID, _INVALID, _ALL = 0x7FF, 0x8000_0000, 0xFFFF_FFFF
_COB_IDS = range(0x1800, 0x1A00)
_PROFILE, _UNIT = 0x6000, 0x6131
_MODE_DISPLAY = 0x6061


@dataclass(frozen=True)
class Check:
    """One object, the bits of it that count, and what they must be (None: whatever they are at first)."""

    index: int
    subindex: int
    mask: int
    expected: int | None

    def text(self, value: int) -> str:
        """A value as people know it: bit fields in hexadecimal digits, numbers of the profile in decimal ones."""
        return str(value) if self.index >= _PROFILE and self.index != _UNIT else f"0x{value:X}"


class Finding(NamedTuple):
    """What a reading has shown: with `changed`, the node is not to be used before a new boot; else it is only told."""

    changed: bool
    text: str


def checks_of(node: Mapping[str, Any]) -> list[Check]:
    """The objects of one node of a boot report that the meaning of its PDOs depends on, and a drive's mode."""
    checks = []
    for index, subindex, value in node["watched"]:
        mask = _ALL
        if (
            index in _COB_IDS and subindex == 1
        ):  # bit 30 is the device's own; of a PDO that is off nothing else matters
            mask = _INVALID if value & _INVALID else _CAN_ID | _INVALID
        checks.append(Check(index, subindex, mask, value & mask))
    if node["gear_ratio"] is not None:
        checks.append(Check(_MODE_DISPLAY, 0, 0xFF, None))
    return checks


class ConfigurationWatch:
    """One node. `next` says what to read, `result` takes it.

    Args:
        report: the node's part of the boot report.
    """

    def __init__(self, report: Mapping[str, Any]) -> None:
        self._objects = checks_of(report)
        first, _ = signature(report["configuration_sha256"])
        self._signature = Check(VERIFY_CONFIGURATION, 1, _ALL, first) if report["signed"] else None
        self._position = self._turn = 0
        self._mode: int | None = None

    def next(self) -> Check:
        """The object to be read now; the same until `result` is called."""
        if self._signature is not None and self._turn % SIGNATURE_EVERY == 0:
            return self._signature
        return self._objects[self._position]

    def result(self, value: bytes | None, refusal: int | None = None) -> Finding | None:
        """What was read from the object that `next` named; None: as it should be.

        Args:
            value: of the object; None where there was none.
            refusal: abort code of a node that refused; None with `value` None: no answer.
        """
        check = self.next()
        self._turn += 1
        if check is not self._signature:
            self._position = (self._position + 1) % len(self._objects)
        if value is None:
            return self._missing(check) if refusal in (NO_OBJECT, NO_SUBINDEX) else None
        found = int.from_bytes(value[:4], "little")
        if check.expected is None:
            return self._mode_now(found)
        if found & check.mask == check.expected:
            return None
        return self._finding(check, check.text(found))

    def _finding(self, check: Check, found: str) -> Finding:
        assert check.expected is not None
        text = f"{check.index:04X}h:{check.subindex}: expected {check.text(check.expected)}, found {found}"
        if check is not self._signature:
            return Finding(True, f"its configuration was changed ({text})")
        self._signature, self._position = None, 0
        return Finding(False, f"its configuration was written to by somebody else ({text})")

    def _missing(self, check: Check) -> Finding | None:
        if check.expected is not None:
            return self._finding(check, "no such object")
        self._objects.remove(check)
        self._position = 0
        return None

    def _mode_now(self, found: int) -> Finding | None:
        before, self._mode = self._mode, found
        if before is None or found == before:
            return None
        now, then = (int.from_bytes(bytes([mode & 0xFF]), signed=True) for mode in (found, before))
        return Finding(False, f"its mode of operation (6061h) is {now} now, {then} before")
