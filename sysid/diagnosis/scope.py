"""What the user knows: effects that are absent or given, how far values may be off, and references that are no sensor."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Joint
from jtqd.sysid.diagnosis.findings import SENSOR, JointName
from jtqd.sysid.diagnosis.limits import PRIORS, Usage
from jtqd.sysid.runs.options import UsageError

_ITEM: Final = re.compile(r"(?:(?P<joint>[1-7]|sensor)=)?(?P<name>[a-z_]+)")

_SIZE: Final = re.compile(r"(?P<value>[\d.]+(?:e[+-]?\d+)?) *(?P<unit>.*)", re.IGNORECASE)
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


def scope_of(
    without: Iterable[str], given: Iterable[str], joints: Mapping[int, Joint], known: Iterable[int] = ()
) -> Scope:
    """Return the scope that options --without and --given ask for; items as "NAME", "2=NAME" or "sensor=NAME".

    Without: the effect is taken to be absent. Given: it is as the joint files have it, in `effects` or as one of their
    values, which is then not questioned. Raises UsageError for a name that is no effect, or a given effect that no joint
    file has.
    """
    asked = [*named_effects("--without", without), *named_effects("--given", given)]
    for option, text, where, name in asked:
        if where is not None and where != SENSOR and where not in joints:
            have = ", ".join(str(number) for number in sorted(joints))
            raise UsageError(f"{option} {text}: found no joint {where} in runs and joint files: {have}")
        if option == "--given":
            _check_given(text, name, where, joints)
    return Scope(frozenset((where, name) for *_, where, name in asked), frozenset(known))


def check_effects(without: Iterable[str], given: Iterable[str]) -> None:
    """Refuse what no runs are needed for: a name that is no effect, an effect that is both. Raises UsageError."""
    absent = named_effects("--without", without)
    for _, text, where, name in named_effects("--given", given):
        for _, other, there, same in absent:
            if name == same and (where == there or None in (where, there)):
                raise UsageError(f"--without {other}: found it beside --given {text}, expected one of them")


def named_effects(option: str, items: Iterable[str]) -> list[tuple[str, str, JointName | None, str]]:
    """Return (option, text, joint, name) of each item of an option. Raises UsageError for a name that is no effect."""
    found: list[tuple[str, str, JointName | None, str]] = []
    for text in items:
        match = _ITEM.fullmatch(text)
        if match is None or match["name"] not in EFFECTS:
            raise UsageError(
                f"{option} {text}: found no effect of that name, expected NAME, N=NAME or sensor=NAME of "
                f"{', '.join(sorted(EFFECTS))}"
            )
        joint = match["joint"]
        where: JointName | None = int(joint) if joint and joint != SENSOR else joint
        found.append((option, text, where, match["name"]))
    return found


def _check_given(text: str, name: str, where: JointName | None, joints: Mapping[int, Joint]) -> None:
    """Refuse an effect that no joint file has: taken as given it would be --without."""
    asked = [joint for number, joint in joints.items() if where in (None, SENSOR, number)]
    in_file = any(effect.name == name for joint in asked for effect in joint.effects)
    if not in_file and not any(parameter.key for parameter in EFFECTS[name].parameters):
        files = " or ".join(joint.name for joint in asked)
        raise UsageError(
            f"--given {text}: found no effect {name} in {files}, expected it under `effects` with its parameters "
            f"(or --without {text} for an effect that is absent)"
        )


def trusted(items: Iterable[str], joints: Mapping[int, Joint]) -> dict[str, float]:
    """Return the factor on the default size of a prior that option --trust asks for, by the prior's name (`limits.PRIORS`).

    Items are "NAME=SIZE": how far a value may be off, as a standard deviation. SIZE is in percent where the prior is
    ("sensor_gain=5%": five times the default of 1 %), of the same thing as the prior, or in the unit of the effect's leading
    parameter ("coulomb_friction=2Nm", "channel_delay=5ms"), where all joints then have one factor. Raises UsageError.
    """
    found: dict[str, float] = {}
    for text in items:
        name, _, asked = text.partition("=")
        if name not in PRIORS:
            raise UsageError(
                f"--trust {text}: found {name!r}, expected NAME=SIZE with one of {', '.join(sorted(PRIORS))}"
            )
        if name in found:
            raise UsageError(f"--trust {text}: found {name} twice, expected one size")
        size = _SIZE.fullmatch(asked.strip())
        value = _positive(size["value"]) if size else 0.0
        if size is None or not value:
            raise UsageError(
                f"--trust {text}: found {asked!r}, expected a number above 0 with a unit: {_expected(name)}"
            )
        found[name] = _factor(text, name, value, size["unit"].strip(), joints)
    return found


def _positive(text: str) -> float:
    """Return the number, 0 for what is none or not above 0."""
    try:
        value = float(text)
    except ValueError:
        return 0.0
    return value if 0.0 < value < math.inf else 0.0


def _unit(name: str) -> str:
    """Return the unit of the parameter that a prior is of, without spaces."""
    effect, _, parameter = name.partition(".")
    first, *others = EFFECTS[effect].parameters
    return next((p.unit for p in others if p.name == parameter), first.unit).replace(" ", "")


def _expected(name: str) -> str:
    """Return the units that fit, and the default."""
    unit = _unit(name)
    units = [*(["%"] if _PERCENT.match(PRIORS[name].text) else []), *([unit] if unit else [])]
    return f"{' or '.join(units)} (default {PRIORS[name].text})"


def _factor(text: str, name: str, value: float, unit: str, joints: Mapping[int, Joint]) -> float:
    prior, own = PRIORS[name], _unit(name)
    default = _PERCENT.match(prior.text)
    if unit == "%" and default:
        return value / float(default[1])
    unit = unit.replace(" ", "")
    scale = _PREFIXES.get(unit.removesuffix(own)) if own and unit.endswith(own) else None
    if scale is None:
        raise UsageError(f"--trust {text}: found {unit or 'no unit'!r}, expected {_expected(name)}")
    sizes = [prior.size(joint, use) for joint in joints.values() for use in _USAGES]
    if not sizes or max(sizes) > (1.0 + 1e-9) * min(sizes):
        raise UsageError(
            f"--trust {text}: found {unit}, expected %: the default ({prior.text}) is not one size in {own} for these joints"
        )
    return value * scale / sizes[0]
