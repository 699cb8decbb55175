"""Which joints of a bus are moved together: a pair on a towing bench, or one alone; and what its runs can identify. Pure.

Two joints that share a channel of the torque sensor are on a towing bench; so are those that --towing names. Every other
joint is moved alone: in doubt nothing is driven by a current.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from jtqd.estimator.checked import ConfigError
from jtqd.sysid.campaign.plan import Plan

Pair = tuple[int, int]


@dataclass(frozen=True)
class Unit:
    """Joints that are moved together, by number, rising; measured: each has a channel of the torque sensor."""

    joints: tuple[int, ...]
    measured: bool

    @property
    def name(self) -> str:
        """Of its runs: "joint_3", "joints_3_4"."""
        return f"joint{'s' if len(self.joints) > 1 else ''}_{'_'.join(map(str, self.joints))}"

    @property
    def who(self) -> str:
        """For people: "joint 3", "joints 3 and 4"."""
        return f"joint{'s' if len(self.joints) > 1 else ''} {' and '.join(map(str, self.joints))}"

    def refused(self, kind: str) -> str:
        """Return why a campaign of this kind has no runs of these joints; "" where it has."""
        if kind == "efficiency" and len(self.joints) == 1:
            return (
                "no efficiency: a second joint on a towing bench must set the load (--towing A,B says that two are on one); "
                "jtq campaign excitation moves a joint alone"
            )
        if kind != "excitation" and not self.measured:
            what = "efficiency" if kind == "efficiency" else "validation"
            reference = "without a channel of the torque sensor, which is the reference"
            return f"no {what} {reference}; jtq campaign excitation needs none"
        return ""

    def serves(self) -> str:
        """Return what its runs can identify."""
        if not self.measured:
            return (
                "no torque sensor: current, motion and temperature are recorded; jtq fit and jtq diagnose need a known load "
                "beside them (jN.load of a column map)"
            )
        if len(self.joints) == 1:
            return (
                "moved alone: losses and torsion under the loads of gravity and inertia (jtq fit losses, jtq diagnose); no "
                "efficiency under other loads"
            )
        return "on a towing bench: efficiency, losses, torsion"


def said_of(units: Iterable[Unit], say: Callable[[Unit], str]) -> list[str]:
    """Return what is said of each unit, a line for all those of which the same is said; nothing where it is ""."""
    of: dict[str, list[str]] = {}
    for unit in units:
        of.setdefault(say(unit), []).append(unit.who)
    return [f"{'; '.join(who)}: {text}" for text, who in of.items() if text]


def units_of(channels: Sequence[int | None], sensor: bool, towing: Iterable[Pair] = ()) -> tuple[Unit, ...]:
    """Return the units of a bus in the order of their first joints.

    channels: of the sensor, for joints 1, 2, ...; sensor: there is one. towing: pairs that are said to be coupled.

    Raises:
        ConfigError: a pair of joints that are not there, or of which one is in another pair.
    """
    pairs: dict[int, Pair] = {}
    shared: dict[int, list[int]] = {}
    for number, channel in enumerate(channels, 1):
        if sensor and channel is not None:
            shared.setdefault(channel, []).append(number)
    given = [(min(pair), max(pair)) for pair in towing]
    found = [*given, *((one, two) for one, two in _pairs(shared.values()))]
    for pair in dict.fromkeys(found):
        for number in pair:
            if not 1 <= number <= len(channels):
                raise ConfigError(
                    f"--towing: found joint {number}, expected joints of the bus, 1 to {len(channels)}"
                )
            if number in pairs:
                raise ConfigError(
                    f"found joint {number} coupled with joints {_other(pairs[number], number)} and {_other(pair, number)}, "
                    "expected one (sensor_channel, --towing)"
                )
        pairs |= dict.fromkeys(pair, pair)
    made = []
    for number in range(1, len(channels) + 1):
        joints = pairs.get(number, (number,))
        if joints[0] == number:
            made.append(Unit(joints, sensor and all(channels[each - 1] is not None for each in joints)))
    return tuple(made)


def _pairs(groups: Iterable[list[int]]) -> Iterable[Pair]:
    for group in groups:
        if len(group) > 2:
            raise ConfigError(
                f"found one sensor_channel for joints {', '.join(map(str, group))}, expected two joints at most"
            )
        if len(group) == 2:
            yield group[0], group[1]


def _other(pair: Pair, number: int) -> int:
    return pair[0] if pair[1] == number else pair[1]


def check_joints(plan: Plan, units: Sequence[Unit]) -> None:
    """Refuse a plan that moves joints as they are not coupled, or takes the power from a bus with others to hold.

    Raises ConfigError naming the run.
    """
    of = {number: unit for unit in units for number in unit.joints}
    for run in plan.runs:
        for number in run.joints:
            if number not in of:
                raise ConfigError(
                    f"run '{run.name}': found joint {number}, expected joints of the bus, 1 to {len(of)}"
                )
        unit = of[run.velocity_joint]
        if run.joints == unit.joints:
            if len(unit.joints) < len(of) and any(
                each.to_mapping()["kind"] == "power_off" for each in run.segments
            ):
                raise ConfigError(
                    f"run '{run.name}': found power_off, expected none beside joints that must be held"
                )
            continue
        if run.current_joint is None:
            raise ConfigError(
                f"run '{run.name}': found joint {run.velocity_joint} moved alone, expected a run of {unit.who}: they are "
                "coupled"
            )
        one, two = run.joints
        raise ConfigError(
            f"run '{run.name}': found joints {one} and {two} driven against each other, expected joints that share a channel"
            f" of the torque sensor; --towing {one},{two} says that they are coupled on a bench"
        )
