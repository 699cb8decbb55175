"""What the user knows: effects that are absent or given, how far values may be off, and references that are no sensor.

Options --without and --given have items [WHERE=]EFFECT, WHERE a joint's number or "sensor"; --trust has items PRIOR=SIZE.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Joint
from jtqd.sysid.diagnosis.findings import SENSOR, JointName
from jtqd.sysid.diagnosis.limits import PRIORS, Usage
from jtqd.sysid.runs.options import UsageError

_ITEM: Final = re.compile(r"(?:(?P<where>[1-7]|sensor)=)?(?P<name>[a-z_]+)")
_SIZE: Final = re.compile(
    r"(?P<value>(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)(?![\d.]) *(?P<unit>.*)", re.IGNORECASE
)
_PERCENT: Final = re.compile(r"([\d.]+) %")
_PREFIXES: Final = {"": 1.0, "m": 1e-3, "u": 1e-6, "µ": 1e-6}
_USAGES: Final = (Usage(0.1, 5.0), Usage(3.0, 50.0))
"""Two very different ways to use a joint: a prior whose size differs between them has no size in its unit."""


@dataclass(frozen=True)
class Scope:
    """Effects that are not looked for, and joints whose torque is known.

    out: (joint or "sensor", name); joint None: wherever it may be. known_references: joints whose reference is a known load
    or a model's torque: no sensor effect may touch it, and it has no zero that drifts.
    """

    out: frozenset[tuple[JointName | None, str]] = frozenset()
    known_references: frozenset[int] = frozenset()

    def looks_for(self, name: str, where: JointName, number: int) -> bool:
        """Return whether an effect of a joint or the sensor, seen in the balances of joint `number`, is a candidate."""
        if where == SENSOR and number in self.known_references:
            return False
        return (None, name) not in self.out and (where, name) not in self.out

    @property
    def note(self) -> tuple[str, ...]:
        """One line in the presence of an unexplained residual: which effects were not looked for; none where all were."""
        names = ", ".join(sorted({name for _, name in self.out}))
        return (
            (f"not looked for, as asked: {names}; the unexplained residual may be theirs",) if names else ()
        )


EVERYTHING: Final = Scope()


class Asked(NamedTuple):
    """An item of --without or --given: option, as it was written, where (None: wherever it may be), effect."""

    option: str
    text: str
    where: JointName | None
    name: str


def asked_effects(without: Iterable[str], given: Iterable[str]) -> list[Asked]:
    """Return the items of --without (the effect is taken to be absent) and --given (it is as the joint files have it, in
    `effects` or as one of their values, which is then not questioned).

    Raises UsageError for a name that is no effect, and for an effect that is both.
    """
    absent = [_asked("--without", text) for text in without]
    known = [_asked("--given", text) for text in given]
    for one in known:
        for other in absent:
            if one.name == other.name and (one.where == other.where or None in (one.where, other.where)):
                raise UsageError(
                    f"--without {other.text}: found it beside --given {one.text}, expected one of them"
                )
    return [*absent, *known]


def _asked(option: str, text: str) -> Asked:
    match = _ITEM.fullmatch(text)
    if match is None or match["name"] not in EFFECTS:
        raise UsageError(
            f"{option} {text}: found no effect of that name, expected NAME, N=NAME or sensor=NAME of "
            f"{', '.join(sorted(EFFECTS))}"
        )
    where = match["where"]
    return Asked(option, text, where if where in (None, SENSOR) else int(where), match["name"])


def scope_of(asked: Iterable[Asked], joints: Mapping[int, Joint], known: Iterable[int] = ()) -> Scope:
    """Return the scope that options ask for; known: joints whose torque is known. Raises UsageError for a joint that there
    is not, and for a given effect that no joint file has: taken as given it would be --without.
    """
    out = set()
    for option, text, where, name in asked:
        if where is not None and where != SENSOR and where not in joints:
            have = ", ".join(str(number) for number in sorted(joints))
            raise UsageError(f"{option} {text}: found no joint {where} in runs and joint files: {have}")
        files = [joint for number, joint in joints.items() if where in (None, SENSOR, number)]
        in_file = any(effect.name == name for joint in files for effect in joint.effects)
        has_key = any(parameter.key for parameter in EFFECTS[name].parameters)
        if option == "--given" and not in_file and not has_key:
            raise UsageError(
                f"--given {text}: found no effect {name} in {' or '.join(joint.name for joint in files)}, expected it under "
                f"`effects` with its parameters (or --without {text} for an effect that is absent)"
            )
        out.add((where, name))
    return Scope(frozenset(out), frozenset(known))


def trusted(items: Iterable[str], joints: Mapping[int, Joint]) -> dict[str, float]:
    """Return the factor on the default size of a prior that option --trust asks for, by the prior's name (`limits.PRIORS`).

    Items are "NAME=SIZE": how far a value may be off, as a standard deviation. SIZE is in percent where the prior is
    ("sensor_gain=5%": five times the default of 1 %), of the same thing as the prior, or in the unit of the effect's leading
    parameter ("coulomb_friction=2Nm", "channel_delay=5ms"), where all joints then have one factor. Raises UsageError.
    """
    found: dict[str, float] = {}
    for text in items:
        name, _, size = text.partition("=")
        if name not in PRIORS:
            raise UsageError(
                f"--trust {text}: found {name!r}, expected NAME=SIZE with one of {', '.join(sorted(PRIORS))}"
            )
        if name in found:
            raise UsageError(f"--trust {text}: found {name} twice, expected one size")
        found[name] = _factor(f"--trust {text}", name, size, joints)
    return found


def _factor(item: str, name: str, asked: str, joints: Mapping[int, Joint]) -> float:
    """Return the factor on the size of a prior that gives the size asked for. Raises UsageError."""
    prior, own = PRIORS[name], _unit(name)
    default = _PERCENT.match(prior.text)
    fitting = " or ".join(filter(None, ("%" if default else "", own)))
    expected = f"{fitting} (default {prior.text})"
    size = _SIZE.fullmatch(asked.strip())
    if size is None or not 0.0 < float(size["value"]) < math.inf:
        raise UsageError(f"{item}: found {asked!r}, expected a number above 0 with a unit: {expected}")
    value, unit = float(size["value"]), size["unit"].replace(" ", "")
    if unit == "%" and default:
        return value / float(default[1])
    scale = _PREFIXES.get(unit.removesuffix(own)) if own and unit.endswith(own) else None
    if scale is None:
        raise UsageError(f"{item}: found {unit or 'no unit'!r}, expected {expected}")
    sizes = [prior.size(joint, use) for joint in joints.values() for use in _USAGES]
    if not sizes or max(sizes) > (1.0 + 1e-9) * min(sizes):
        raise UsageError(
            f"{item}: found {unit}, expected %: the default ({prior.text}) is not one size in {own} for these joints"
        )
    return value * scale / sizes[0]


def _unit(name: str) -> str:
    """Return the unit of the parameter that a prior is of, without spaces."""
    effect, _, parameter = name.partition(".")
    first, *others = EFFECTS[effect].parameters
    return next((p.unit for p in others if p.name == parameter), first.unit).replace(" ", "")
