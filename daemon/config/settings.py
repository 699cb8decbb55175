"""Sections that other modules take as they are: safety, recording, real time, contact, ROS 2."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Final

from jtqd.daemon.shared import faults
from jtqd.estimator.decoder import FieldError, Text, check, limits, parsed
from jtqd.estimator.settings import CONTACT_THRESHOLD, PlausibilityLimits

LATCHED_BY_DEFAULT: Final = faults.NOT_FINITE | faults.BITS["motor_jump"] | faults.BITS["link_jump"]
"""What leaves numbers behind that look right and are not: a broken estimator, an encoder that has lost its zero."""
LOOPBACK: Final = "lo"
"""Network interface that no other machine reaches."""
HIGHEST_DOMAIN: Final = 232
"""Of DDS: ports of a higher one are beyond 65535 (DDSI-RTPS, 9.6.1)."""
_INTERFACE: Final = re.compile(r"[\w.@-]{1,15}", re.ASCII)


_LATCHABLE: Final = tuple(name for name in faults.BITS if name != "stale")


def _latch(names: Any) -> int:
    """Return the bits of a list of names in the file."""
    if names is None:
        return LATCHED_BY_DEFAULT
    if not isinstance(names, list) or not all(isinstance(name, str) and name in _LATCHABLE for name in names):
        raise ValueError("found other names")
    return sum({faults.BITS[name] for name in names})


@dataclass(frozen=True, slots=True)
class SafetySettings:
    """Section `safety`: how faults are found and which of them wait for a reset.

    latch: bits of `shared/cycle_record.py`, in the file a list of their names; stale_latch_cycles: so many cycles in a
    row without inputs, or without time, are the fault `stale` (None: never); deviation_sigmas, deviation_s: the fault
    `deviation`; plausibility: None (in the file: false) for no checks.
    """

    latch: Annotated[int, parsed(_latch, f"a list of {', '.join(_LATCHABLE)}; [] for none")] = (
        LATCHED_BY_DEFAULT
    )
    stale_latch_cycles: Annotated[int, limits(ge=1, le=1_000_000)] | None = None
    deviation_sigmas: Annotated[float, limits(ge=1.0, le=100.0)] = 3.0
    deviation_s: Annotated[float, limits("s", ge=0.01, le=60.0)] = 1.0
    plausibility: PlausibilityLimits | None = field(default_factory=PlausibilityLimits)

    def __post_init__(self) -> None:
        check(self, "safety")
        if self.stale_latch_cycles is not None:
            object.__setattr__(self, "latch", self.latch | faults.STALE)


@dataclass(frozen=True)
class RecordingSettings:
    """Section `recording`; megabytes are of 1 000 000 bytes.

    Attributes:
        ring_cycles: cycles that shared memory holds for the recorder: for so long it may be stopped.
        chunk_s: length of a chunk [s]; a crash costs at most this and 0.1 s.
        rotate_s, rotate_mb: a file is ended and the next one begun after this time, or at this size.
        budget_mb: all files of this bus in the directory; older ones are removed. None: nothing is removed.
        keep_run: the budget never removes a part of the run that is being written.
        reserve_mb: recording ends when less than this is free, and goes on when there is room again.
        flight_recorder_s: keep this time in memory and write it on a fault or on request. None: record all.
    """

    ring_cycles: Annotated[int, limits(ge=256, le=1 << 20)] = 4096
    chunk_s: Annotated[float, limits("s", ge=0.05, le=10.0)] = 0.5
    rotate_s: Annotated[float, limits("s", ge=1.0, le=86_400.0)] = 600.0
    rotate_mb: Annotated[float, limits("MB", ge=1.0, le=1e6)] = 1000.0
    budget_mb: Annotated[float, limits("MB", ge=10.0, le=1e9)] | None = None
    keep_run: bool = True
    reserve_mb: Annotated[float, limits("MB", ge=0.0, le=1e9)] = 256.0
    flight_recorder_s: Annotated[float, limits("s", ge=1.0, le=600.0)] | None = None

    def __post_init__(self) -> None:
        check(self, "recording")


@dataclass(frozen=True)
class Realtime:
    """Section `realtime`: what the loop asks of the kernel; what it does not get is logged."""

    priority: Annotated[int, limits(ge=0, le=98)] = 80
    cpu: Annotated[int, limits(ge=0, le=4095)] | None = None
    lock_memory: bool = True


@dataclass(frozen=True, slots=True)
class ContactSettings:
    """Section `contact`: torque rate and contact of every joint (docs/estimator.md); without the section nobody watches.

    Attributes:
        threshold_nm: torque from outside that is a contact; None: 5 % of the joint's rated torque.
        opposed: joints 1 and 2, and 3 and 4, turn one link against each other, as on a towing bench.
        pdo: send 380h and 480h + node_id; without, contacts are in the log only.
    """

    threshold_nm: Annotated[float, limits("Nm", gt=0.0, le=1e4)] | None = None
    opposed: bool = False
    pdo: bool = True

    def __post_init__(self) -> None:
        check(self, "contact")

    def threshold_of(self, rated_torque_nm: float) -> float:
        """Return the threshold of a joint [Nm]."""
        return CONTACT_THRESHOLD * rated_torque_nm if self.threshold_nm is None else self.threshold_nm


@dataclass(frozen=True)
class Ros2Settings:
    """Section `ros2`: what is published for ROS 2 (docs/ros2.md).

    Attributes:
        domain_id: DDS domain; None: as ROS_DOMAIN_ID says, else 0.
        interface: network interface.
        rate_hz: of joint states and torque states.
        names: of the joints in ROS 2, by section (`joint_1`); left out: the section's name.
    """

    domain_id: Annotated[int, limits(ge=0, le=HIGHEST_DOMAIN)] | None = None
    interface: Text = LOOPBACK
    rate_hz: Annotated[float, limits("Hz", ge=1.0, le=500.0)] = 100.0
    names: Mapping[str, Text] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check(self, "ros2")
        if not _INTERFACE.fullmatch(self.interface):
            raise FieldError("ros2", "interface", self.interface, "a network interface such as lo or eth0")

    def names_of(self, joints: int) -> tuple[str, ...]:
        """Return the names of so many joints, joint 1 first."""
        sections = (f"joint_{number}" for number in range(1, joints + 1))
        return tuple(self.names.get(section, section) for section in sections)
