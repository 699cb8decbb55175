"""What a snapshot says of a joint's contact, in words. Pure; `docs/estimator.md` says what it is worth."""

from __future__ import annotations

from math import isfinite

from jtqd.daemon.shared.cycle_record import FLAG_CONTACT, FLAG_CONTACT_KNOWN
from jtqd.daemon.shared.snapshot import JointView


def contact_of(seen: JointView) -> bool | None:
    """Return whether the joint is pushed from outside; None where that is not known or not watched."""
    return bool(seen.input_flags & FLAG_CONTACT) if seen.input_flags & FLAG_CONTACT_KNOWN else None


def contact_text(seen: JointView) -> str:
    """Return the contact for a cell of a table: its size, "none" or "unknown"."""
    told = contact_of(seen)
    return "unknown" if told is None else f"{seen.contact_nm:+.1f} Nm" if told else "none"


def contact_line(seen: JointView, threshold_nm: float) -> str:
    """Return the contact with what it is judged by: residual and threshold [Nm], torque rate [Nm/s]."""
    told = contact_of(seen)
    if told is None:
        return "unknown"
    word = "CONTACT" if told else "none"
    rate = f", torque rate {seen.torque_rate_nm_s:+.0f} Nm/s" if isfinite(seen.torque_rate_nm_s) else ""
    return f"{word}: {seen.contact_nm:+.2f} Nm from outside (threshold {threshold_nm:.2f}){rate}"
