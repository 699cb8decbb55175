"""Why an estimate has the status it has, in words, from what the snapshot and `about.json` hold. Pure."""

from __future__ import annotations

from math import isfinite

from daemon.loop.joint_cycle import FLAG_MOTION, FLAG_POSITION
from daemon.loop.joint_rules import drive_status
from daemon.loop.joint_tally import FLAG_NETWORK_SKIPPED
from daemon.shared.about import About, AboutJoint
from daemon.shared.faults import MEANINGS
from daemon.shared.snapshot import JointView, View
from daemon.supervisor.input_watch import stale_cause
from estimator import status as st

NMT_STATES = {0: "boot-up", 4: "stopped", 5: "operational", 127: "pre-operational"}
"""Heartbeat states of CiA 301."""
SILENT_AFTER = 3.0
"""Heartbeat periods without a heartbeat after which a node is silent."""
_FIRST_CYCLES = 20
_HELD = "held until enough cycles in a row were good"
"""Hysteresis of `daemon/loop/joint_status.py`."""
_STATE_WORD = {
    0x00: "not ready to switch on",
    0x40: "switch on disabled",
    0x21: "ready to switch on",
    0x23: "switched on, not enabled",
    0x27: "operation enabled",
    0x07: "quick stop active",
    0x0F: "fault reaction active",
    0x08: "fault",
}


def drive_state(statusword: int) -> str:
    """State of a CiA 402 drive by its statusword (6041h)."""
    if statusword & 0x4F in (0x00, 0x40, 0x0F, 0x08):  # bit 5 does not count in these
        return _STATE_WORD[statusword & 0x4F]
    return _STATE_WORD.get(statusword & 0x6F, f"statusword {statusword:04X}h")


def silent_s(view: View, node: int, heartbeat_ms: int) -> float | None:
    """For how long a node has been silent [s]; None while its heartbeats come, or none has ever come."""
    heard = view.node_heard_ns[node]
    age_s = (view.sync_realtime_ns - heard) * 1e-9
    return age_s if heard and age_s > SILENT_AFTER * heartbeat_ms * 1e-3 else None


def reason(about: About, number: int, view: View, earlier: View) -> str:
    """Why joint 1 or 2 has its status; "" where nothing needs a reason.

    Args:
        about: of the daemon.
        number: 1 or 2.
        view: the reading.
        earlier: one from a moment before; what has been counted since then points at a cause.
    """
    joint, seen = about.joints[number - 1], view.joints[number - 1]
    if seen.latched:
        return f"latched: {_meanings(seen.latched)}; `jtq control reset` releases it"
    match seen.status:
        case st.STALE:
            found = _stale(about, joint, seen, view, earlier)
        case st.OFF | st.DRIVE_FAULT:
            state = f"drive {joint.node}: {drive_state(seen.statusword)} (6041h {seen.statusword:04X}h)"
            found = state if drive_status(seen.statusword) == seen.status else f"{state}; {_HELD}"
        case st.STARTING if view.cycle <= _FIRST_CYCLES:
            found = "the first cycles"
        case st.STARTING:
            found = "the observer starts again after a gap in the inputs"
        case st.STANDSTILL:
            found = (
                "slower than the standstill velocity: friction hides the torque, sigma is half the interval"
            )
        case st.DEGRADED:
            found = _degraded(joint, seen)
        case st.INVALID:
            faults = seen.input_flags >> 8
            found = _meanings(faults) if faults else f"a fault is over; {_HELD}"
        case _:
            found = ""
    return found


def _meanings(faults: int) -> str:
    return ", ".join(MEANINGS[bit] for bit in MEANINGS if faults & bit) or "an unknown fault"


def _stale(about: About, joint: AboutJoint, seen: JointView, view: View, earlier: View) -> str:
    silence = silent_s(view, joint.node, about.heartbeat_ms)
    if silence is not None:
        return f"node {joint.node} is silent: no heartbeat for {silence:.1f} s"
    both = FLAG_POSITION | FLAG_MOTION
    if seen.input_flags & both == both and view.counters["overruns"] == earlier.counters["overruns"]:
        return f"the inputs are back; {_HELD}"
    return stale_cause(joint.node, joint.inputs, seen, view, earlier.counters)


def _degraded(joint: AboutJoint, seen: JointView) -> str:
    if seen.input_flags & FLAG_NETWORK_SKIPPED:
        return "no time for the network in this cycle: physics only"
    if not isfinite(seen.network_nm):
        return "the network's answer is not a number: physics only"
    apart, trusted = abs(seen.network_nm - seen.physics_nm), joint.network_limit_nm
    if apart > trusted:
        return f"the network is {apart:.1f} Nm from physics, trusted to {trusted:.1f} Nm: physics only"
    return "outside what the network was trained on: physics, with less or nothing of the network"
