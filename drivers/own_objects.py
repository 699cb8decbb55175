"""jtqd's own node in the object dictionary: node-IDs, its PDOs, and the sub-indices of 2201h..220Fh by name.

Those of 2200h stand in `jtqd.daemon.shared.counters`.
"""

from jtqd.drivers.nmt import HEARTBEAT_BASE
from jtqd.drivers.pdo import MappedObject, PdoMap

_SEQUENCE = MappedObject(0x2103, 0, 8, False, "sequence")
JTQD_NODE = 0x20
COMMANDER_NODE = 0x21
"""Node that may command the drives beside jtqd; they watch its heartbeat by 1016h:2."""
ESTIMATE_BASES = (0x180, 0x280)
CONTACT_BASES = (0x380, 0x480)
"""Of jtqd's PDOs with the estimates of joints 1 and 2, and of joints 3 and 4."""


def loop_cob_ids(node: int) -> tuple[int, ...]:
    """Return the COB-IDs that only the loop sends with, echoes of which it receives: estimates, contacts, heartbeat."""
    return tuple(base + node for base in (*ESTIMATE_BASES, *CONTACT_BASES, HEARTBEAT_BASE))


BUS_FIELDS = (
    "state",
    "tx_errors",
    "rx_errors",
    "warnings",
    "passives",
    "bus_offs",
    "restarts",
    "no_acknowledge",
    "arbitration_lost",
    "protocol_errors",
    "overruns",
    "transceiver",
    "tx_timeouts",
    "downs",
)
"""Sub-indices 1.. of 2205h (`daemon/bus/service.py`): state 0 error active, 1 warning, 2 passive, 3 bus-off, 4
interface down; the controller's two error counters as last reported; then how often each error has occurred."""

ROOM = (2, 4)
"""Joints for which a data sheet of jtqd has room: jtqd.eds and jtqd4.eds."""


def room_for(joints: int) -> int:
    """Return the room of the data sheet for a bus with so many joints."""
    return min(room for room in ROOM if room >= joints)


def own_sheet(joints: int) -> str:
    """Return the file name of the data sheet for a bus with so many joints."""
    return "jtqd.eds" if room_for(joints) == ROOM[0] else f"jtqd{room_for(joints)}.eds"


PARAMETERS = (0x2202, 0x2203, 0x2208, 0x2209)
"""Objects with the parameters of joint 1, 2, 3, 4. Nodes (1016h, 2206h, 2207h) stand in this order: joints, sensor."""
VERSION = "0.2.0"
"""100Ah."""

ZEROS = (0x220A, 0x220B, 0x220C, 0x220D)
"""Objects with what has been learned of the zeros of joint 1, 2, 3, 4; 220Eh and 220Fh: flags and jumps of all."""

ZERO_FIELDS = (
    "link_rad",
    "link_sigma_rad",
    "link_used_rad",
    "current_a",
    "current_sigma_a",
    "current_used_a",
    "limit_rad",
)
"""Sub-indices 1.. of `ZEROS` (`jtqd.estimator.status.Zeros`)."""

JOINT_PARAMETERS = (
    "gear_ratio",
    "torque_constant_nm_per_a",
    "rotor_inertia_kgm2",
    "stiffness_nm_per_rad",
    "damping_nms_per_rad",
    "rated_torque_nm",
    "age_ms",
)
"""Sub-indices 1.. of `PARAMETERS`: fields of the joint file, and the age of its estimate."""


def estimate_tpdos(joints: int, node: int = JTQD_NODE) -> tuple[PdoMap, ...]:
    """180h+20h: the estimate of joints 1 and 2; with more than two joints also 280h+20h: of joints 3 and 4.

    2100h..2103h and 2105h of jtqd.eds and jtqd4.eds. The second half of an odd joint's PDO is that of no joint.
    """
    pdos = []
    for base, status, pair in ((ESTIMATE_BASES[0], 0x2102, (1, 2)), (ESTIMATE_BASES[1], 0x2105, (3, 4))):
        torques = [MappedObject(0x2100, joint, 16, True, f"torque_{joint}") for joint in pair]
        sigmas = [MappedObject(0x2101, joint, 8, False, f"sigma_{joint}") for joint in pair]
        pdos.append(
            PdoMap(base + node, (*torques, *sigmas, MappedObject(status, 0, 8, False, "status"), _SEQUENCE))
        )
    return tuple(pdos[: (joints + 1) // 2])


def contact_tpdos(joints: int, node: int = JTQD_NODE) -> tuple[PdoMap, ...]:
    """380h+20h: torque rate and contact of joints 1 and 2; with more than two joints also 480h+20h: of joints 3 and 4.

    2106h..2108h and 2103h of jtqd.eds and jtqd4.eds. Four bytes each: a bus of two joints with sensor has room for them.
    """
    pdos = []
    for base, contact, pair in ((CONTACT_BASES[0], 0x2107, (1, 2)), (CONTACT_BASES[1], 0x2108, (3, 4))):
        rates = [MappedObject(0x2106, joint, 8, True, f"torque_rate_{joint}") for joint in pair]
        pdos.append(PdoMap(base + node, (*rates, MappedObject(contact, 0, 8, False, "contact"), _SEQUENCE)))
    return tuple(pdos[: (joints + 1) // 2])
