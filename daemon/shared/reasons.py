"""A joint in words: the reason of its status, of a missing input or sensor, and its contact. Pure: from a snapshot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Final

from jtqd.daemon.shared.cycle_record import (
    FLAG_CONTACT,
    FLAG_CONTACT_KNOWN,
    FLAG_MOTION,
    FLAG_NETWORK_SKIPPED,
    FLAG_POSITION,
    FLAG_SENSOR,
)
from jtqd.daemon.shared.faults import MEANINGS, NAMES
from jtqd.daemon.shared.runtime_dir import About, AboutJoint
from jtqd.daemon.shared.snapshot import NO_ZEROS, JointView, View
from jtqd.drivers import nmt
from jtqd.drivers.drive import State, state_of
from jtqd.estimator import status as st
from jtqd.estimator.status import APART, LEFT, Zeros

STATUS_OF_STATE: Final = {
    State.OPERATION_ENABLED: None,
    State.QUICK_STOP: None,
    State.FAULT_REACTION: st.DRIVE_FAULT,
    State.FAULT: st.DRIVE_FAULT,
}
"""Status that the state of its drive forces on a joint: None where the motor carries current; every other state is off."""
SILENT_AFTER = 3.0
"""Heartbeat periods without a heartbeat after which a node is silent."""
_FIRST_CYCLES = 20
_HELD = "waiting for enough consecutive good cycles"
"""Hysteresis of `jtqd.daemon.core.status`."""
_ON_THE_BUS = (
    ("bus_errors", "the bus is down"),
    ("foreign_sync", "another SYNC producer is on the bus"),
    ("sync_errors", "SYNC waits in the transmit queue, or is irregular"),
)
"""Counters whose rise makes every input of the bus doubtful, and what that means."""
_ON_THE_PDO = (
    ("late_frames", "late frames on the bus"),
    ("rejected_frames", "frames of a wrong format on the bus"),
)
_SENSOR_STATUS = {1: "not valid", 2: "positive overload", 4: "negative overload"}
"""6150h of CiA 404."""


def joint_reason(about: About, number: int, view: View, earlier: View) -> str:
    """Explain the status of joint `number`, from 1 on; "" where nothing needs a reason.

    earlier: a reading from a moment before; what has been counted since then points at a cause.
    """
    joint, seen = about.joints[number - 1], view.joints[number - 1]
    if seen.latched:
        return f"latched: {fault_meanings(seen.latched)}; `jtq control reset` releases it"
    match seen.status:
        case st.STALE:
            reason = _stale(about, joint, seen, view, earlier)
        case st.OFF | st.DRIVE_FAULT:
            reason = f"drive {joint.node}: {drive_reason(seen)}"
        case st.STARTING if view.cycle <= _FIRST_CYCLES:
            reason = "first cycles after the start"
        case st.STARTING:
            reason = "the observer restarts after a gap in the inputs"
        case st.STANDSTILL:
            reason = "below the standstill velocity: the torque is known to an interval, sigma is half of it"
        case st.DEGRADED:
            limit_nm = None if joint.network is None else joint.network_limit_nm
            reason = degraded_reason(seen, limit_nm, view.zeros[number - 1])
        case st.INVALID:
            faults = seen.input_flags >> 8
            reason = fault_meanings(faults) if faults else f"fault cleared; {_HELD}"
        case _:
            reason = ""
    return reason


def fault_meanings(faults: int, *, names: bool = False) -> str:
    """Return faults (`jtqd.daemon.shared.cycle_record`) in words, optionally with their names."""
    each = (f"{MEANINGS[bit]} ({NAMES[bit]})" if names else MEANINGS[bit] for bit in NAMES if faults & bit)
    return ", ".join(each) or "an unknown fault"


def drive_state(statusword: int) -> str:
    """Return the state of a CiA 402 drive by its statusword (6041h)."""
    state = state_of(statusword)
    if state is State.UNKNOWN:
        return f"statusword {statusword:04X}h"
    return "switched on, not enabled" if state is State.SWITCHED_ON else state.value


def drive_reason(seen: JointView) -> str:
    """Explain status 0 (off) or 5 (drive fault) by the drive's state."""
    word = seen.statusword
    state = f"{drive_state(word)} (6041h {word:04X}h)"
    now = STATUS_OF_STATE.get(state_of(word), st.OFF)
    return state if now == seen.status else f"{state}; {_HELD}"


def degraded_reason(seen: JointView, network_limit_nm: float | None, zeros: Zeros = NO_ZEROS) -> str:
    """Explain status 3 (degraded): what is wrong with physics, or why the network is not fully used.

    network_limit_nm: of the network against physics, None without a network; zeros: of the same cycle.
    """
    doubt = _doubt(zeros)
    if doubt:
        return doubt
    if network_limit_nm is None:
        return "outside of what the joint file was fitted to, or current and torsion disagree"
    if seen.input_flags & FLAG_NETWORK_SKIPPED:
        return "no time for the network in this cycle: physics only"
    if not isfinite(seen.network_nm):
        return "the network output is not finite: physics only"
    apart = abs(seen.network_nm - seen.physics_nm)
    if apart > network_limit_nm:
        return f"the network is {apart:.1f} Nm from physics, limit {network_limit_nm:.1f} Nm: physics only"
    return "outside the network's training range or the fit of the joint file: the network counts less, or sigma is wider"


def _doubt(zeros: Zeros) -> str:
    """Explain what is wrong with the physics of method fused; "" where nothing is."""
    if not zeros.plausible:
        return f"the link encoder's zero is {zeros.implausible}"
    if zeros.flags & LEFT:
        left = 1e6 * (zeros.link_rad - zeros.link_used_rad)
        return f"a zero of the link encoder has been found, {left:+.0f} µrad of it are not yet taken off"
    apart = "current and torsion disagree beyond their sigmas: one of them is not what the joint file states"
    return apart if zeros.flags & APART else ""


def _stale(about: About, joint: AboutJoint, seen: JointView, view: View, earlier: View) -> str:
    silence = silent_s(view, joint.node, about.heartbeat_ms)
    if silence is not None:
        return f"node {joint.node} is silent: no heartbeat for {silence:.1f} s"
    both = FLAG_POSITION | FLAG_MOTION
    if seen.input_flags & both == both and view.counters["overruns"] == earlier.counters["overruns"]:
        return f"the inputs are back; {_HELD}"
    return stale_reason(joint.node, joint.inputs, seen, view, earlier.counters)


def stale_reason(
    node: int, names: Sequence[str], seen: JointView, view: View, earlier: Mapping[str, int]
) -> str:
    """Explain status 4 (stale) of the joint with this drive, the likeliest cause first.

    names: of its PDOs with positions, and of those with its other quantities (joined by "and"); earlier: counters of an
    earlier reading; what has risen since then may be the cause.
    """

    def rose(name: str) -> bool:
        return view.counters[name] > earlier[name]

    unready = unready_reason(node, view)
    if unready:
        return unready
    if view.node_states[node] in nmt.NOT_OPERATIONAL:
        return f"node {node} is {nmt.STATES[view.node_states[node]]}"
    for counter, meaning in _ON_THE_BUS:
        if rose(counter):
            return meaning
    flags = (FLAG_POSITION, FLAG_MOTION)
    missing = [name for name, flag in zip(names, flags, strict=True) if not seen.input_flags & flag]
    if not missing:
        return "the estimate is not ready before the next SYNC"
    each = dict.fromkeys(name for names in missing for name in names.split(" and "))
    what = f"{' and '.join(each)} not received in time"
    hints = [meaning for counter, meaning in _ON_THE_PDO if rose(counter)]
    return f"{what} ({', '.join(hints)})" if hints else what


def unready_reason(node: int, view: View) -> str:
    """Explain why a node is not used: restarted, changed configuration, or absent; "" for the others."""
    if node not in view.unconfigured:
        return ""
    if not view.node_heard_ns[node] and not view.node_states[node]:
        return f"node {node} is absent"
    if view.node_states[node] == nmt.OPERATIONAL:
        return f"node {node} has a changed configuration"
    return f"node {node} has restarted and is not configured yet"


def sensor_reason(node: int | None, name: str, seen: JointView, view: View) -> str:
    """Explain why there is no torque of the sensor `node`, whose input PDO is `name`."""
    if not seen.input_flags & FLAG_SENSOR:
        unready = "" if node is None else unready_reason(node, view)
        return unready or f"{name} not received in time"
    reasons = [text for bit, text in _SENSOR_STATUS.items() if seen.sensor_status & bit]
    return f"{name} reports {', '.join(reasons) or 'no number'}"


def silent_s(view: View, node: int, heartbeat_ms: int) -> float | None:
    """Return how long a node has been silent [s]; None while its heartbeats arrive, or if none ever arrived."""
    heard = view.node_heard_ns[node]
    age_s = (view.sync_realtime_ns - heard) * 1e-9
    return age_s if heard and age_s > SILENT_AFTER * heartbeat_ms * 1e-3 else None


# Contact ---------------------------------------------------------------------------------------------------------------


def contact_of(seen: JointView) -> bool | None:
    """Return whether the joint is pushed from outside; None where that is not known or not watched."""
    return bool(seen.input_flags & FLAG_CONTACT) if seen.input_flags & FLAG_CONTACT_KNOWN else None


def contact_text(seen: JointView) -> str:
    """Return the contact for a cell of a table: its size, "none" or "unknown"."""
    contact = contact_of(seen)
    if contact is None:
        return "unknown"
    return f"{seen.contact_nm:+.1f} Nm" if contact else "none"


def contact_line(seen: JointView, threshold_nm: float) -> str:
    """Return the contact with what it is judged by: residual and threshold [Nm], torque rate [Nm/s]."""
    contact = contact_of(seen)
    if contact is None:
        return "unknown"
    word = "CONTACT" if contact else "none"
    rate = f", torque rate {seen.torque_rate_nm_s:+.0f} Nm/s" if isfinite(seen.torque_rate_nm_s) else ""
    return f"{word}: {seen.contact_nm:+.2f} Nm from outside (threshold {threshold_nm:.2f}){rate}"
