"""Result of one estimate: torque, standard deviation and status.

The status codes are those published on the bus (low or high nibble of the estimate PDO).
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, Final, NamedTuple


class Status(IntEnum):
    """What may be known of a torque. The loop alone sets OFF, STALE and DRIVE_FAULT."""

    OFF = 0
    STARTING = 1
    VALID = 2
    DEGRADED = 3  # the network is not fully used: outside its envelope, far from physics, or no time for it
    STALE = 4  # an input of this cycle is missing
    DRIVE_FAULT = 5
    STANDSTILL = 6  # known to an interval only; sigma is its half width
    INVALID = 15


OFF, STARTING, VALID, DEGRADED, STALE, DRIVE_FAULT, STANDSTILL, INVALID = Status
NAMES: Final = {each.value: each.name.lower() for each in Status}

PUBLISHED: Final = frozenset((VALID, DEGRADED, STANDSTILL))
"""Only with these may a torque number leave the estimator."""

MOTOR_JUMP: Final = 0x04
LINK_JUMP: Final = 0x08
VELOCITY_MISMATCH: Final = 0x10
TORSION: Final = 0x20
CURRENT_FROZEN: Final = 0x40
REPEATED: Final = 0x400
"""Bits of faults that `jtqd.estimator.detection` finds."""

CONTACT_OFF, CONTACT_UNKNOWN, CONTACT_NONE, CONTACT_PRESENT = range(4)
"""Codes of a contact; off: not watched (docs/estimator.md)."""


class Estimate(NamedTuple):
    """Result of one step, whatever the method [Nm, joint side]; NaN where not computed or not to be published.

    torque_nm, sigma_nm are numbers with status VALID, DEGRADED and STANDSTILL only; tob_nm (classical
    observer), physics_nm (with losses, before any network) and network_nm are stages, for the record.
    """

    torque_nm: float
    sigma_nm: float
    status: Status
    tob_nm: float
    physics_nm: float
    network_nm: float


# What an estimator has learned ---------------------------------------------------------------------------------------

TRACKED, LEARNED, BEYOND, LEFT, APART = (1 << n for n in range(5))
"""Bits of `Zeros.flags`: the zeros are tracked; the link zero is learned; it is beyond the joint file's limit; what is known
of it is not yet taken off; the two views disagree now (also where nothing is tracked)."""


class Zeros(NamedTuple):
    """What is known of the zeros of a joint, and its standard deviations; 0 and the prior width where nothing is.

    link_rad, current_a: what the readings are off by; link_used_rad, current_used_a: what is taken off them; limit_rad: of
    the joint file, for a link zero that is plausible; flags: bits TRACKED to APART; jumps: how often a zero that was
    learned became unknown, because the views were apart for JUMP_S.
    """

    link_rad: float
    link_sigma_rad: float
    link_used_rad: float
    current_a: float
    current_sigma_a: float
    current_used_a: float
    limit_rad: float
    flags: int
    jumps: int

    @property
    def tracked(self) -> bool:
        """Return whether there is anything to tell."""
        return bool(self.flags & TRACKED)

    @property
    def learned(self) -> bool:
        """Return whether the link zero is known better than friction of the day alone would let it be."""
        return bool(self.flags & LEARNED)

    @property
    def plausible(self) -> bool:
        """Return whether the link zero is within the joint file's limit."""
        return not self.flags & BEYOND

    def content(self) -> dict[str, Any] | None:
        """Return plain values for JSON; None where nothing is tracked."""
        if not self.tracked:
            return None
        return self._asdict() | {"learned": self.learned, "plausible": self.plausible}

    @property
    def text(self) -> str:
        """Return what is known of the zeros for a reader; "" where they are not tracked."""
        if not self.tracked:
            return ""
        found = f"link {1e6 * self.link_rad:+.0f} µrad, sigma {1e6 * self.link_sigma_rad:.0f} µrad"
        used = (
            f"{1e6 * self.link_used_rad:+.0f} µrad taken off" if self.link_used_rad else "nothing taken off"
        )
        text = f"{found}, {used}" if self.learned else "link not learned yet: the joint has to move both ways"
        if self.current_used_a:
            text += f"; current {self.current_a:+.3f} A, {self.current_used_a:+.3f} A taken off"
        if self.jumps:
            text += f"; jumped {'once' if self.jumps == 1 else f'{self.jumps} times'}"
        return text if self.plausible else f"{text}; {self.implausible}"

    @property
    def implausible(self) -> str:
        """Return what a zero beyond the limit may be."""
        return (
            f"{1e3 * self.link_rad:+.2f} mrad, limit {1e3 * self.limit_rad:.2f} mrad: the encoder has slipped, was mounted "
            "again, or the joint file is another joint's"
        )


PAST_LAYOUT: Final = 16
"""Number of the layout of `past`, which logs hold: another one where its fields, their order or their meaning change.
`tests/estimator/test_path_difference.py` has the size that belongs to it."""


def learner_of(estimator: object) -> Any:
    """Return the `FusedEstimator` that learns zeros, which may stand behind the corrections of effects; None without one."""
    inner = getattr(estimator, "inner", estimator)
    return inner if getattr(inner, "zeros", None) is not None else None


def same_past(old: Any, new: Any) -> bool:
    """Return whether what `old` has learned is true for `new`; both track zeros then."""
    one, other = learner_of(old), learner_of(new)
    same_effects = old.joint.effects == new.joint.effects
    return one is not None and other is not None and same_effects and bool(other.shares_past(one))
