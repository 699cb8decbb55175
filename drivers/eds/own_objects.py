"""Objects of jtqd's own node that are filled by position: one list for the data sheet and for the daemon."""

COUNTERS = (
    "cycles",
    "missed",
    "stale_inputs",
    "late_frames",
    "duplicate_frames",
    "rejected_frames",
    "foreign_sync",
    "tx_dropped",
    "rx_dropped",
    "network_fallbacks",
    "recorder_lost",
)
"""Sub-indices 1.. of 2200h, in order: the names of the loop's counters."""

JOINT_PARAMETERS = (
    "gear_ratio",
    "torque_constant_nm_per_a",
    "rotor_inertia_kgm2",
    "stiffness_nm_per_rad",
    "damping_nms_per_rad",
    "rated_torque_nm",
)
"""Sub-indices 1.. of 2202h (joint 1) and 2203h (joint 2): fields of the joint file."""
