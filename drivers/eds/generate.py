"""Writes drive.eds, torque_sensor.eds and jtqd.eds beside this file: `python -m drivers.eds.generate`.

The files are what ships and what a configuration tool reads; these tables are how they are kept right, and a
test compares the two. The vendor number is an emulation's, not one that CiA has assigned: a real drive or
sensor brings its own EDS.
"""

from __future__ import annotations

import sys
from pathlib import Path

from drivers.eds import communication as comm
from drivers.eds.own_objects import BUS_FIELDS, COUNTERS, JOINT_PARAMETERS, NODES, VERSION
from drivers.eds.schema import (
    ARRAY,
    I8,
    I16,
    I32,
    REAL32,
    TEXT,
    U8,
    U16,
    U32,
    Entries,
    Sheet,
    Var,
    array,
    record,
    render,
)

VENDOR = 0x07A1
REVISION = 0x0001_0000  # major 1 (CANopen behaviour), minor 0
FOLDER = Path(__file__).parent


def drive() -> Sheet:
    """CiA 402 servo drive with encoders on both sides of the gear."""
    objects: dict[int, Var | Entries] = {
        **comm.device(0x0002_0192, "emulated joint drive", "1.0", "1.0"),
        **comm.errors(),
        **comm.heartbeat(consumed=2),  # the master's, and that of a node which commands beside it
        **comm.verify_configuration("rw"),
        **comm.identity(VENDOR, 0x402, REVISION),
        **comm.sync_consumer(),
        **comm.sdo_server(),
        **comm.rpdo(1, 0x200, [0x6040_0010, 0x6071_0010]),
        **comm.rpdo(2, 0x300, [0x60FF_0020]),
        **comm.tpdo(1, 0x180, [0x6041_0010]),
        **comm.tpdo(2, 0x280, [0x6064_0020, 0x606C_0020]),
        **comm.tpdo(3, 0x380, [0x3001_0010], event_ms=500),
        0x3001: Var("Joint temperature", I16, "ro", 0, pdo=True, comment="0.1 degC; 8000h: not measured"),
        0x603F: Var("Error code", U16, "ro", 0, pdo=True),
        0x6040: Var("Controlword", U16, "rww", 0, pdo=True),
        0x6041: Var("Statusword", U16, "ro", 0, pdo=True),
        0x6060: Var("Modes of operation", I8, "rww", 0, pdo=True),
        0x6061: Var("Modes of operation display", I8, "ro", 0, pdo=True),
        0x6064: Var(
            "Position actual value", I32, "ro", 0, pdo=True, comment="increments of 608Fh, motor side"
        ),
        0x606C: Var("Velocity actual value", I32, "ro", 0, pdo=True, comment="units of 6090h, motor side"),
        0x6071: Var("Target torque", I16, "rww", 0, pdo=True, comment="1/1000 of 6076h"),
        0x6075: Var("Motor rated current", U32, "rw", 5000, low=1, comment="mA"),
        0x6076: Var("Motor rated torque", U32, "rw", 500, low=1, comment="mNm, motor side"),
        0x6077: Var("Torque actual value", I16, "ro", 0, pdo=True, comment="1/1000 of 6076h"),
        0x6078: Var("Current actual value", I16, "ro", 0, pdo=True, comment="1/1000 of 6075h"),
        0x608F: array(
            "Position encoder resolution",
            U32,
            "ro",
            [("Encoder increments", 65536), ("Motor revolutions", 1)],
        ),
        0x6090: array(
            "Velocity encoder resolution",
            U32,
            "ro",
            [("Encoder increments per second", 65536), ("Motor revolutions per second", 1)],
        ),
        0x6091: array(
            "Gear ratio", U32, "ro", [("Motor shaft revolutions", 100), ("Driving shaft revolutions", 1)]
        ),
        0x60C2: record(
            "Interpolation time period",
            Var("Interpolation time period value", U8, "rw", 1, low=1, high=255),
            Var("Interpolation time index", I8, "rw", -3, low=-128, high=63),
        ),
        0x60E4: array("Additional position actual value", I32, "ro", [("Link position", 0)], pdo=True),
        0x60E6: array(
            "Additional position encoder resolution - encoder increments",
            U32,
            "ro",
            [("Link encoder increments", 524288)],
        ),
        0x60EB: array(
            "Additional position encoder resolution - motor revolutions", U32, "ro", [("Link revolutions", 1)]
        ),
        0x60FF: Var("Target velocity", I32, "rww", 0, pdo=True, comment="units of 6090h, motor side"),
        0x6502: Var("Supported drive modes", U32, "ro", 0x300, comment="csv (bit 8), cst (bit 9)"),
    }
    note = "Defaults of TPDO1 and TPDO2 are not those jtqd uses: it writes its own mapping at boot."
    return Sheet(
        "drive.eds",
        "CiA 402 joint drive",
        "emulated joint drive",
        0x402,
        REVISION,
        "JTQ-DRIVE",
        objects,
        [note],
    )


def torque_sensor() -> Sheet:
    """CiA 404 measuring device with two torque channels."""

    def channels(name: str, data_type: int, access: str, *defaults: int, pdo: bool = False) -> Entries:
        return array(
            name, data_type, access, [(f"{name} {n}", d) for n, d in enumerate(defaults, 1)], pdo=pdo
        )

    objects: dict[int, Var | Entries] = {
        **comm.device(0x0002_0194, "emulated torque sensor", "1.0", "1.0"),
        **comm.errors(),
        **comm.heartbeat(),
        **comm.identity(VENDOR, 0x404, REVISION),
        **comm.sync_consumer(),
        **comm.sdo_server(),
        **comm.tpdo(1, 0x180, [0x7130_0110]),
        **comm.tpdo(2, 0x280, [0x7130_0210]),
        0x6110: channels("AI sensor type", U16, "rw", 0, 0),
        0x6112: channels("AI operating mode", U8, "rw", 1, 1),
        0x6114: channels("AI ADC sample rate", U32, "rw", 1000, 1000),
        0x6125: Entries(
            "AI autozero",
            ARRAY,
            {n: Var(f"AI autozero {n}", U32, "wo", comment='write 0x6F72657A ("zero")') for n in (1, 2)},
        ),
        # SI prefix 10^0, numerator 23h joule = Nm, no denominator (CiA 303-2)
        0x6131: channels("AI physical unit process value", U32, "rw", 0x0023_0000, 0x0023_0000),
        # Two digits keep the second channel's 16-bit value within +-327 Nm
        0x6132: channels("AI decimal digits process value", U8, "rw", 3, 2),
        0x6150: channels("AI status", U8, "ro", 0, 0, pdo=True),
        0x7130: channels("AI input process value 16-bit", I16, "ro", 0, 0, pdo=True),
        0x9130: channels("AI input process value 32-bit", I32, "ro", 0, 0, pdo=True),
    }
    note = "Default TPDOs are not those jtqd uses: it writes its own mapping at boot."
    return Sheet(
        "torque_sensor.eds",
        "CiA 404 torque sensor, two channels",
        "emulated torque sensor",
        0x404,
        REVISION,
        "JTQ-SENSOR",
        objects,
        [note],
    )


def jtqd() -> Sheet:
    """The daemon's own node: SYNC producer with the estimate as its only PDO."""
    joints = [("Joint 1", 0), ("Joint 2", 0)]
    nodes = [(name, 0) for name in ("Joint 1", "Joint 2", "Sensor")]
    objects: dict[int, Var | Entries] = {
        **comm.device(0, "jtqd", "none", VERSION),
        **comm.errors(behaviour_access="const", behaviour=1, inhibit=100),
        0x1005: Var("COB-ID SYNC message", U32, "const", comm.SYNC_PRODUCER + 0x80),
        0x1006: Var("Communication cycle period", U32, "const", 1000, comment="us"),
        0x1016: array("Consumer heartbeat time", U32, "ro", [(f"Node {n}", 0) for n in range(1, NODES + 1)]),
        0x1017: Var("Producer heartbeat time", U16, "const", 100, comment="ms"),
        **comm.identity(VENDOR, 0x001, REVISION),
        0x1019: Var("Synchronous counter overflow value", U8, "const", 240, low=0, high=240),
        **comm.verify_configuration("ro"),
        **comm.sdo_server(),
        **comm.tpdo(
            1,
            0x180,
            [0x2100_0110, 0x2100_0210, 0x2101_0108, 0x2101_0208, 0x2102_0008, 0x2103_0008],
            transmission=1,
            fixed=True,
        ),
        0x2100: array("Estimated torque", I16, "ro", joints, pdo=True),
        0x2101: array("Standard deviation", U8, "ro", [("Joint 1", 255), ("Joint 2", 255)], pdo=True),
        0x2102: Var(
            "Estimate status", U8, "ro", 0, pdo=True, comment="low nibble joint 1, high nibble joint 2"
        ),
        0x2103: Var("Estimate sequence", U8, "ro", 0, pdo=True, comment="SYNC counter of the inputs, 1..240"),
        0x2104: array("Latched faults", U16, "ro", [("Joint 1", 0), ("Joint 2", 0)]),
        0x2110: Var(
            "Reset latched faults", U8, "rw", 0, low=0, high=1, comment="write 1; read: 1 not done yet"
        ),
        0x2200: array("Counters", U32, "ro", [(name, 0) for name in COUNTERS]),
        0x2201: array("Cycle time", U32, "ro", [("p50_us", 0), ("p99_us", 0), ("max_us", 0)]),
        0x2202: array("Parameters of joint 1", REAL32, "ro", [(name, 0.0) for name in JOINT_PARAMETERS]),
        0x2203: array("Parameters of joint 2", REAL32, "ro", [(name, 0.0) for name in JOINT_PARAMETERS]),
        0x2204: Var("Configuration hash", TEXT, "ro", ""),
        0x2205: array("Bus state", U32, "ro", [(name, 0) for name in BUS_FIELDS]),
        0x2206: array("Nodes", U32, "ro", nodes),
        0x2207: array("Last EMCY of nodes", U32, "ro", nodes),
    }
    note = [
        "2100h in 0.01 Nm, 8000h: no estimate. 2101h in 0.05 Nm, 255: more or unknown.",
        "2104h: bits 0 not finite, 1 out of range, 2 motor jump, 3 link jump, 4 velocity mismatch,",
        "5 torsion, 6 current frozen, 7 deviation, 8 drive fault, 9 stale. 2110h: 1 releases them.",
        "2205h:1 0 error active, 1 warning, 2 passive, 3 bus-off, 4 interface down.",
        "2206h: NMT state, heartbeat (1 awaited, 2 heard, 3 lost), configured, node-ID; from the lowest byte.",
        "2207h: error code (2 bytes), error register, number of messages.",
    ]
    return Sheet("jtqd.eds", "joint torque estimator daemon", "jtqd", 0x001, REVISION, "JTQD", objects, note)


SHEETS = (drive, torque_sensor, jtqd)


def main() -> int:
    """Write the three files; takes no argument."""
    if len(sys.argv) > 1:
        print(
            "usage: python -m drivers.eds.generate   (writes the data sheets beside this file)",
            file=sys.stderr,
        )
        return 0 if sys.argv[1] in ("-h", "--help") else 2
    for sheet in (make() for make in SHEETS):
        (FOLDER / sheet.file_name).write_text(render(sheet), encoding="ascii", newline="\n")
        print(FOLDER / sheet.file_name, file=sys.stderr)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
