"""Profiles of drive families: values of a section `joint_N` for such a drive, each line with its source.

A profile is one of `drivers/profiles/` or a file beside the configuration. `with_profiles` adds its values to those of the
configuration; `jtq init` and `jtq probe` recognise a family by its vendor-ID (1018h:1), read the objects whose values
differ from drive to drive, and check those that the profile assumes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import jtqd.drivers
from jtqd.drivers.sdo import Key, label, parse_key
from jtqd.estimator.decoder import FieldError, Text, choice, decode, limits
from jtqd.estimator.errors import ConfigError
from jtqd.models.files import read_yaml

STATES: Final = ("by the manual", "by the EDS", "tried on the bus", "not confirmed")
"""Evidence of a line: a document of the maker, a data sheet (EDS, DCF) of the maker, a drive, none."""
OPTIONS: Final = ("encoder_counts", "link_encoder_counts", "gear_ratio_numerator", "gear_ratio_denominator")
"""Values of the operator: options of `jtq init`; a gear ratio as numerator and denominator."""
INIT: Final = "init."
"""Prefix of numbers that `jtq init` uses for objects of CiA 402; they are no keys of the configuration."""
_FOLDER: Final = Path(jtqd.drivers.__file__).resolve().parent / "profiles"
_JOINTS: Final = tuple(f"joint_{number}" for number in range(1, 5))
_Unsigned32 = Annotated[int, limits(ge=0, le=0xFFFF_FFFF)]


@dataclass(frozen=True)
class Line:
    """One fact about a family.

    Attributes:
        why, source, state: meaning, source, evidence (`STATES`).
        key: dotted key of the section, or of INIT. It gets a `value`, or `factor` times (`inverse`: divided by) the
            number of the object `read`, or of the `option`.
        check: an object of the drive that must be `expected`, as other lines rest on it.
    """

    why: Text
    source: Text
    state: Annotated[str, choice(STATES)]
    key: Text | None = None
    value: Any = None
    read: Text | None = None
    option: Annotated[str, choice(OPTIONS)] | None = None
    factor: Annotated[float, limits(gt=0.0)] = 1.0
    inverse: bool = False
    check: Text | None = None
    expected: _Unsigned32 | None = None

    def __post_init__(self) -> None:
        for name in ("read", "check"):
            text = getattr(self, name)
            if text is not None and _parsed(text) is None:
                raise FieldError("line", name, text, "an object like 608Fh:1")
        origins = [name for name in ("value", "read", "option") if getattr(self, name) is not None]
        if (self.key is not None) != (len(origins) == 1):
            raise FieldError("line", "key", self.key, "a key with one of value, read and option, or neither")
        if self.key is not None and self.key.startswith("objects.temperature"):
            raise FieldError(
                "line", "key", self.key, "that of a quantity: a temperature is named by the joint's section"
            )
        if (self.check is None) != (self.expected is None) or (self.check and self.key):
            raise FieldError("line", "check", self.check, "an object with its expected value, and no key")

    @property
    def reads(self) -> Key | None:
        """The object that it needs of the drive."""
        text = self.read or self.check
        return None if text is None else _parsed(text)

    @property
    def open(self) -> bool:
        """Whether the configuration itself must have the key."""
        return self.value is None and self.key is not None and not self.key.startswith(INIT)

    def of(self, number: float) -> float:
        """Return the value of the key from the number of the object or option."""
        return self.factor / number if self.inverse else self.factor * number


def _parsed(text: str) -> Key | None:
    try:
        return parse_key(text)
    except ValueError:
        return None


@dataclass(frozen=True)
class Family:
    """A drive family: name, title, vendor-ID (1018h:1), its lines, further variants."""

    name: str
    title: Text
    vendor: _Unsigned32
    lines: tuple[Line, ...]
    variants: tuple[str, ...] = ()

    def section(self) -> dict[str, Any]:
        """Return the values as part of a section `joint_N`."""
        found: dict[str, Any] = {}
        for line in self.lines:
            if line.key is not None and line.value is not None and not line.key.startswith(INIT):
                _put(found, line.key, line.value)
        return found

    @property
    def objects(self) -> tuple[Key, ...]:
        """Objects that `filled` and `findings` need of a drive."""
        return tuple(dict.fromkeys(line.reads for line in self.lines if line.reads is not None))

    def mapped(self, quantity: str, standard: Key) -> Key:
        """Return the object of a quantity of `joint_N.objects`; `standard`: that of CiA 402."""
        own = self.section().get("objects", {}).get(quantity, {})
        if "index" not in own:
            return standard
        return int(own["index"]), int(own.get("sub", 0))

    def scales(self, quantity: str) -> bool:
        """Whether the quantity has a factor of its own, so that no object of CiA 402 scales it."""
        return any(line.key == f"objects.{quantity}.factor" for line in self.lines)

    def filled(
        self, numbers: Mapping[Key, int], options: Mapping[str, float]
    ) -> dict[str, tuple[float, str]]:
        """Return the values by drive and operator: key -> (value, origin), without keys that have none."""
        found: dict[str, tuple[float, str]] = {}
        for line in self.lines:
            if line.key is None or line.value is not None:
                continue
            if line.option is not None:
                number: float | None = options.get(line.option)
                option = line.option.removesuffix("_numerator").removesuffix("_denominator")
                origin = f"--{option.replace('_', '-')}"
            else:
                assert line.reads is not None
                number, origin = numbers.get(line.reads), f"{label(*line.reads)} of the drive"
            if number is not None and number >= 1:
                found[line.key] = line.of(number), origin
        return found

    def findings(self, numbers: Mapping[Key, int]) -> list[str]:
        """Return one line for each object of a drive that differs from the profile."""
        return [
            f"{label(*line.reads)}: expected 0x{line.expected:X}, found 0x{numbers[line.reads]:X}: {line.why}"
            for line in self.lines
            if line.check is not None
            and line.reads is not None
            and line.reads in numbers
            and numbers[line.reads] != line.expected
        ]


def _put(mapping: dict[str, Any], key: str, value: object) -> None:
    *sections, last = key.split(".")
    for name in sections:
        mapping = mapping.setdefault(name, {})
    mapping[last] = value


def names() -> list[str]:
    """Return the names of the profiles that ship."""
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def load(path: Path) -> Family:
    """Read a profile. Raises ConfigError."""
    return decode(Family, read_yaml(path)[0], str(path), name=path.stem)


def shipped() -> list[Family]:
    """Read the profiles that ship. Raises ConfigError."""
    return [load(_FOLDER / f"{name}.yaml") for name in names()]


def of_vendor(vendor: int | None) -> Family | None:
    """Return the profile that ships for a vendor-ID, or None."""
    return next((family for family in shipped() if family.vendor == vendor), None)


def path_of(name: str, beside: Path | None = None) -> Path:
    """Return the file of a profile that ships, or NAME.yaml in the directory `beside`. Raises ConfigError."""
    if name in names():
        return _FOLDER / f"{name}.yaml"
    if beside is not None and name.endswith(".yaml"):
        return beside / name
    expected = "one of " + ", ".join(map(repr, names())) + ", or a file NAME.yaml"
    raise ConfigError(f"profile: found {name!r}, expected {expected}")


def named(name: str, beside: Path | None = None) -> Family:
    """Return a profile by its name, see `path_of`. Raises ConfigError."""
    return load(path_of(name, beside))


def with_profiles(mapping: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return a configuration with the values of its profiles added to its own.

    Raises ConfigError, also for a value that the profile leaves to drive or operator and the configuration lacks.
    """
    merged = dict(mapping)
    for joint in _JOINTS:
        own = mapping.get(joint)
        if not isinstance(own, Mapping) or not isinstance(own.get("profile"), str):
            continue
        try:
            family = named(own["profile"], path.parent)
        except ConfigError as error:
            raise ConfigError(f"{path}: key '{joint}.profile': {error}") from None
        merged[joint] = _below(family.section(), own)
        for line in family.lines:
            if line.open and line.key is not None and not _has(own, line.key):
                source = label(*line.reads) if line.reads else (line.option or "").replace("_", " ")
                raise ConfigError(
                    f"{path}: key '{joint}.{line.key}': missing, expected a number by {source} "
                    f"(profile {family.name}: {line.why}); jtq probe and jtq init write it"
                )
    return merged


def _below(profile: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return `own` with the keys that only the profile has."""
    merged = {**profile, **own}
    for key, value in own.items():
        if isinstance(value, Mapping) and isinstance(profile.get(key), Mapping):
            merged[key] = _below(profile[key], value)
    return merged


def _has(mapping: Any, key: str) -> bool:
    """Whether a dotted key is present or not needed (`link_position: false`)."""
    for name in key.split("."):
        if mapping is False:
            return True
        if not isinstance(mapping, Mapping) or name not in mapping:
            return False
        mapping = mapping[name]
    return True
