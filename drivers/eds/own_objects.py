"""Sub-indices of jtqd's own objects 2201h..220Fh by name; those of 2200h stand in `jtqd.daemon.shared.counters`."""

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
"""Sub-indices 1.. of 2205h (`daemon/bus/errors.py`): state 0 error active, 1 warning, 2 passive, 3 bus-off, 4
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
"""Sub-indices 1.. of `ZEROS` (`jtqd.estimator.learned.Zeros`)."""

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
