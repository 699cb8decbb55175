"""Boot of one node by SDO, in the order of CiA 302-2: device type, identity, configuration, heartbeat.

Written against `SdoAccess`, so that a node in memory boots as one on a wire does. Every value written is read back and
compared; the values read make the node's configuration hash. No bus, no clock.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from jtqd.drivers.boot_error import BootError, mismatch
from jtqd.drivers.boot_tpdos import TpdoSetup
from jtqd.drivers.devices import (
    OPERATING_MODE_OBJECT,
    SYNC_COB_ID,
    DriveProfile,
    DriveScaling,
    Profile,
    SensorScaling,
    drive_scaling,
    sensor_scaling,
)
from jtqd.drivers.pdo import CAN_ID, INVALID, PdoMap
from jtqd.drivers.sdo import Key, label
from jtqd.drivers.sdo_client import NodeObjects, SdoAccess
from jtqd.drivers.units import ScalingError

_IDENTITY = (
    ("vendor", "vendor-ID", "D"),
    ("product", "product code", "M"),
    ("revision", "revision number", "N"),
    ("serial", "serial number", "O"),
)
_PDO_PARAMETERS = range(0x1800, 0x1C00)  # communication and mapping parameters of TPDOs
_SOFTWARE: Key = (0x100A, 0)
VERIFY_CONFIGURATION = 0x1020
_ERROR_BEHAVIOUR: Key = (0x1029, 1)
_ABORT_OPTION: Key = (0x6007, 0)
_SYNC_PRODUCER = 1 << 30  # of 1005h


@dataclass(frozen=True)
class BusSettings:
    """Settings that are the same for all nodes.

    Attributes:
        master_node: node number of jtqd, whose heartbeat the drives watch for `master_timeout_ms` (1016h:1).
        heartbeat_ms: 1017h.
        sync_cob_id: 1005h must hold it.
        counter_overflow: 1019h (0: SYNC without counter); None: left alone.
        error_behaviour: 1029h:1, what a node does when it misses the master's heartbeat: 0 pre-operational, 1 nothing,
            2 stopped; None: left alone.
    """

    master_node: int
    master_timeout_ms: int = 500
    heartbeat_ms: int = 100
    sync_cob_id: int = SYNC_COB_ID
    counter_overflow: int | None = None
    error_behaviour: int | None = None


@dataclass(frozen=True)
class BootedNode:
    """A node as it was identified and configured.

    Attributes:
        serial: 1018h:4; 0: the device has none.
        gear_ratio: 6091h; None for a sensor.
        configuration_sha256: of all that the boot has read (`configuration_sha256`).
        signed: 1020h holds the signature of this configuration.
        watched: objects that its PDOs and scaling depend on (`watched_objects`).
        notes: what the operator should know although nothing is wrong.
        boot_ups: its boot-up messages before it was configured: the reset of the boot is one.
    """

    node_id: int
    name: str
    device_type: int
    serial: int
    scaling: DriveScaling | SensorScaling
    gear_ratio: float | None
    tpdos: tuple[PdoMap, ...]
    configuration_sha256: str
    signed: bool = False
    watched: tuple[tuple[int, int, int], ...] = ()
    notes: tuple[str, ...] = ()
    boot_ups: int = 0


class NodeBoot:
    """The procedure for one node. Each step raises BootError with its own letter."""

    def __init__(self, access: SdoAccess, profile: Profile, settings: BusSettings) -> None:
        self._profile, self._settings = profile, settings
        self._node = profile.node_id
        self._objects = NodeObjects(access, self._node)
        self._notes: list[str] = []

    def run(self, device_type: int) -> BootedNode:
        """Do all steps between `check_device_type`, whose result it takes, and error control and NMT start."""
        serial = self.check_identity()
        self.check_temperature()
        tpdos = self.configure_pdos()
        self.configure_sync()
        self.configure_heartbeat()
        self.configure_error_behaviour()
        scaling, gear_ratio = self.read_scaling()
        watched = watched_objects(self._objects.values, self._profile.scaling_objects)
        sha256 = configuration_sha256(self._objects.values)
        signed = self.sign(sha256)
        name = self._objects.best_effort((0x1008, 0)) or b""
        return BootedNode(
            node_id=self._node,
            name=printable(name),
            device_type=device_type,
            serial=serial,
            scaling=scaling,
            gear_ratio=gear_ratio,
            tpdos=tpdos,
            configuration_sha256=sha256,
            signed=signed,
            watched=watched,
            notes=tuple(self._notes),
        )

    def check_device_type(self) -> int:
        """Check 1000h, whose low word is the number of the device profile (402, 404), and return it."""
        found = self._objects.number((0x1000, 0), 4, letter="B")
        number = self._profile.profile_number
        if found & 0xFFFF != number:
            expected = f"profile {number} (0x....{number:04X})"
            raise mismatch(
                self._node, (0x1000, 0), "device type", expected=expected, found=f"0x{found:08X}", letter="C"
            )
        return found

    def check_identity(self) -> int:
        """Check 1018h:1..4 and 100Ah against the profile; return the serial number (0: the device has none)."""
        serial = 0
        for subindex, (field, name, letter) in enumerate(_IDENTITY, 1):
            expected = getattr(self._profile.identity, field)
            if expected is None and field != "serial":
                continue
            key = (0x1018, subindex)
            found = self._objects.optional_number(key, 4)
            if expected is not None and found != expected:
                text = "no such object" if found is None else f"0x{found:08X}"
                raise mismatch(self._node, key, name, expected=f"0x{expected:08X}", found=text, letter=letter)
            serial = found or 0
        self._check_software()
        return serial

    def _check_software(self) -> None:
        """Check 100Ah; jtqd loads no programs into its nodes, so another version is refused and not replaced."""
        expected = self._profile.identity.software
        if expected is None:
            return
        raw, key, name = self._objects.read(_SOFTWARE), _SOFTWARE, "software version"
        if raw is None:
            raise mismatch(self._node, key, name, expected=expected, found="no such object", letter="G")
        found = printable(raw)
        if found != expected:
            raise mismatch(self._node, key, name, expected=expected, found=found, letter="H")

    def check_temperature(self) -> None:
        """Require the object of a drive whose temperature is asked for; its value does not matter here."""
        profile = self._profile
        wanted = profile.temperature if isinstance(profile, DriveProfile) else None
        if wanted is not None and self._objects.read(wanted.key) is None:
            expected = "a value (required by the configuration)"
            what = "joint temperature"
            raise mismatch(
                self._node, wanted.key, what, expected=expected, found="no such object", letter="J"
            )

    def configure_pdos(self) -> tuple[PdoMap, ...]:
        """Set up the TPDOs and return those that are used (`TpdoSetup`)."""
        return TpdoSetup(self._objects, self._profile, self._notes).run()

    def configure_sync(self) -> None:
        """Check that 1005h is jtqd's SYNC; make 1019h tell whether it has a counter byte."""
        wanted = self._settings.sync_cob_id
        found = self._objects.optional_number((0x1005, 0), 4)
        if found is None:  # as some have it that list no 1005h
            self._notes.append(f"no 1005h: its SYNC is taken to be the default {wanted:03X}h")
            found = wanted
        if found & CAN_ID != wanted:
            raise mismatch(
                self._node, (0x1005, 0), "COB-ID SYNC", expected=f"{wanted:03X}h", found=f"0x{found:08X}"
            )
        if found & _SYNC_PRODUCER:
            self._objects.put((0x1005, 0), found & ~_SYNC_PRODUCER, 4, "COB-ID SYNC")
            self._notes.append("1005h: it was a SYNC producer, which jtqd is")
        overflow, key = self._settings.counter_overflow, (0x1019, 0)
        if overflow is None:
            return
        counts = self._objects.optional_number(key, 1)
        if counts is None and overflow:
            expected = f"{overflow} (sync.counter_overflow; 0 for SYNC without a counter)"
            name = "SYNC counter overflow"
            raise mismatch(self._node, key, name, expected=expected, found="no such object", letter="J")
        if counts not in (None, overflow):  # some refuse any write while 1006h is set
            self._objects.put(key, overflow, 1, "SYNC counter overflow")

    def configure_heartbeat(self) -> None:
        """Set the node's heartbeat, and on drives the supervision of the master's, whose loss must stop them."""
        settings = self._settings
        if isinstance(self._profile, DriveProfile):
            consumer = settings.master_node << 16 | settings.master_timeout_ms
            why = self._try((0x1016, 1), consumer, 4, "consumer heartbeat time")
            if why:
                self._notes.append(f"{why}: the drive does not notice when jtqd's heartbeat ends")
        self._objects.put((0x1017, 0), settings.heartbeat_ms, 2, "producer heartbeat time")
        emcy = self._objects.best_effort((0x1014, 0))
        if emcy is not None:
            cob_id, expected = int.from_bytes(emcy[:4], "little"), 0x080 + self._node
            if cob_id & (INVALID | CAN_ID) != expected:
                self._notes.append(
                    f"1014h COB-ID EMCY: expected {expected:03X}h, found 0x{cob_id:08X}: its EMCY messages are not read"
                )

    def _try(self, key: Key, value: int, size: int, name: str) -> str:
        """Write and read back what a node can do without; return why it does, "" where it has it."""
        if self._objects.best_effort(key) is None:
            return f"{label(*key)} {name}: no such object"
        try:
            self._objects.put(key, value, size, name)
        except BootError as error:
            if not error.letter:
                raise
            return error.detail
        return ""

    def configure_error_behaviour(self) -> None:
        """Set 1029h:1 where the node has it; note a drive whose 6007h lets it run on without its master."""
        behaviour = self._settings.error_behaviour
        if behaviour is None:
            return
        if self._objects.best_effort(_ERROR_BEHAVIOUR) is not None:
            why = self._try(_ERROR_BEHAVIOUR, behaviour, 1, "error behaviour")
            if why:
                self._notes.append(why)
        if isinstance(self._profile, DriveProfile):
            option = self._objects.best_effort(_ABORT_OPTION)
            if option is not None and not any(option):
                self._notes.append(
                    "6007h abort connection option is 0: the drive does not stop when jtqd's heartbeat ends"
                )

    def sign(self, sha256: str) -> bool:
        """Write the signature to 1020h where the node has it; it holds until the configuration is changed (CiA 301)."""
        if self._objects.read((VERIFY_CONFIGURATION, 1)) is None:
            return False
        for subindex, word in enumerate(signature(sha256), 1):
            self._objects.put((VERIFY_CONFIGURATION, subindex), word, 4, "configuration signature")
        return True

    def read_scaling(self) -> tuple[DriveScaling | SensorScaling, float | None]:
        """Read the scaling objects and check them for plausibility; return (scaling, gear ratio)."""
        profile = self._profile
        values = {key: self._objects.number(key, 4) for key in profile.scaling_objects}
        try:
            if isinstance(profile, DriveProfile):
                return drive_scaling(profile, values)
            for channel in profile.channels:
                self._check_channel((OPERATING_MODE_OBJECT, channel))
            return sensor_scaling(profile, values), None
        except ScalingError as error:
            found = error.found
            raise mismatch(self._node, error.key, error.name, expected=error.expected, found=found) from None

    def _check_channel(self, key: Key) -> None:
        found = self._objects.optional_number(key, 1)
        if found not in (None, 1):
            expected = "1 (normal operation)"
            raise mismatch(self._node, key, "channel operating mode", expected=expected, found=str(found))


def printable(raw: bytes) -> str:
    """Return a text of a device as lines can show it: what is no printable ASCII character is replaced."""
    text = raw.rstrip(b"\0").decode("ascii", "replace")
    return "".join(each if " " <= each <= "~" else "?" for each in text)


def reset_during_boot(node: int) -> BootError:
    """Return the error for a boot-up message after the configuration: the mapping is the default one again."""
    detail = "the node restarted during boot (boot-up message): its configuration is lost"
    return BootError(node, "1000h:0", expected="no restart", found="boot-up message", detail=detail)


def configuration_sha256(values: Mapping[Key, int]) -> str:
    """Return the SHA-256 over every value, in the order of the objects."""
    lines = [f"{index:04X}h:{subindex}={value}\n" for (index, subindex), value in sorted(values.items())]
    import hashlib  # in the boot process alone: it loads OpenSSL, 3.4 MB

    return hashlib.sha256("".join(lines).encode()).hexdigest()


def signature(sha256: str) -> tuple[int, int]:
    """Return the two words of 1020h for a configuration: the first 64 bits of its hash, never zero (not configured).

    CiA 301 calls them date and time; CiA 302-2 compares them with what the master expects and nothing else.
    """
    words = int(sha256[:8], 16), int(sha256[8:16], 16)
    return words[0] or 1, words[1] or 1


def watched_objects(values: Mapping[Key, int], scaling: Collection[Key]) -> tuple[tuple[int, int, int], ...]:
    """Return (index, sub-index, value) of all that the meaning of a node's numbers depends on.

    These are the parameters of its TPDOs, its `scaling` objects, and the operating mode of a channel. They are read again in
    service (`daemon/bus/nodes.py`): where one has changed, the node's numbers mean something else than before.
    """
    return tuple(
        (*key, value)
        for key, value in sorted(values.items())
        if key[0] in _PDO_PARAMETERS or key[0] == OPERATING_MODE_OBJECT or key in scaling
    )
