"""ARM.yaml: which joint of which running jtqd is which joint of a URDF, and what is known of the arm; frozen values.

    urdf: arm.urdf                # beside this file
    tool: flange                  # a link of the URDF
    joints:                       # of the URDF; all others stand at zero
      shoulder: {bus: can0, joint: 1, direction: 1, zero_rad: 0.0132}
      elbow: {bus: can0, joint: 2, direction: -1, zero_rad: -1.5708}

Unknown keys and wrong values are errors of one line that name the file, the key, what was found and what was expected.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

from jtqd.daemon.config import RecordingSettings
from jtqd.daemon.shared.cycle_record import MOST_JOINTS
from jtqd.estimator.decoder import FieldError, Text, decode, limits
from jtqd.estimator.errors import ConfigError, Verbatim
from jtqd.estimator.files import read_regular
from jtqd.estimator.text import sha256_hex
from jtqd.models.files import read_yaml

_LARGEST_URDF: Final = 4_000_000
"""Bytes; arms of seven joints have 20 000."""
_FARTHEST_M: Final = 2.0
"""Centre of a payload in the tool's frame: a number in mm is beyond."""
Vector = Annotated[tuple[float, ...], limits(length=(3, 3))]


@dataclass(frozen=True)
class JointSource:
    """Where a joint's numbers are. Angle of the URDF: direction (link encoder - zero_rad); torques have the same sign."""

    bus: Text
    """As of `jtqd --bus`, or the name of its instance as `jtq status` shows it."""
    joint: Annotated[int, limits(ge=1, le=MOST_JOINTS)]
    """Number at that jtqd."""
    direction: Annotated[int, limits(ge=-1, le=1)]
    zero_rad: Annotated[float, limits("rad", ge=-6.3, le=6.3)]
    """The link encoder's reading at the URDF's zero, up to a turn: degrees are beyond."""

    def __post_init__(self) -> None:
        if self.direction == 0:
            raise FieldError("joint", "direction", 0, "1 or -1")


@dataclass(frozen=True)
class FixedPayload:
    """Section `payload`: what hangs at the tool for good; centre in the tool's frame."""

    mass_kg: Annotated[float, limits("kg", ge=0.0, le=1000.0)]
    centre_m: Annotated[tuple[float, ...], limits("m", length=(3, 3))] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if max(map(abs, self.centre_m)) > _FARTHEST_M:
            expected = f"3 numbers in m from {-_FARTHEST_M:g} to {_FARTHEST_M:g}"
            raise FieldError("payload", "centre_m", list(self.centre_m), expected)


@dataclass(frozen=True)
class Noise:
    """Section `noise`, by `jtq fit arm`: what free motion leaves, by joint (`estimator.ArmNoise`)."""

    total: Mapping[str, Annotated[float, limits(gt=0.0, le=1e6)]]
    offset: Annotated[float, limits(ge=0.0, le=1e6)]
    tests: Mapping[str, Vector]
    position_rad: Mapping[str, Annotated[float, limits("rad", ge=0.0, le=1.0)]]

    def of(self, joints: Sequence[str]) -> Iterator[tuple[str, object, str]]:
        """Yield key, value and expectation of each key that does not fit the joints."""
        for key in ("total", "tests", "position_rad"):
            values: Mapping[str, Any] = getattr(self, key)
            for name in {**dict.fromkeys(joints), **values}:
                if name not in values:
                    yield f"{key}.{name}", MISSING, "a value, as of every key of joints"
                elif name not in joints:
                    yield f"{key}.{name}", Verbatim("that joint"), f"one of {', '.join(joints)}"
        for name, each in self.tests.items():
            if min(each) <= 0.0:
                yield f"tests.{name}", list(each), "3 numbers > 0"


@dataclass(frozen=True)
class ArmFile:
    """A whole ARM.yaml."""

    urdf: Text
    tool: Text
    joints: Mapping[str, JointSource]
    up: Vector = (0.0, 0.0, 1.0)
    payload: FixedPayload | None = None
    noise: Noise | None = None
    recording: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for key, found, expected in self._wrong():
            raise FieldError("arm", key, found, expected)

    def _wrong(self) -> Iterator[tuple[str, object, str]]:
        """Yield key, value and expectation of each mistake."""
        if not self.joints:
            yield "joints", Verbatim("none"), "joints of the URDF with bus, joint, direction and zero_rad"
        if max(map(abs, self.up)) < 1e-3:
            yield "up", list(self.up), "a direction: 3 numbers that are not all 0"
        for name in self.joints:
            if not (name.isprintable() and name.strip()):
                yield "joints", name, "names of printable characters"
        users: dict[tuple[str, int], str] = {}
        for name, each in self.joints.items():
            user = users.setdefault((each.bus, each.joint), name)
            if user != name:
                yield f"joints.{name}.joint", each.joint, f"a joint of {each.bus} that is not {user}"
        for key, found, expected in () if self.noise is None else self.noise.of([*self.joints]):
            yield f"noise.{key}", found, expected


@dataclass(frozen=True)
class ArmConfig:
    """ARM.yaml with the URDF. text: as read, for the log; name: of the file, in names of logs; recording: of jtqd."""

    path: Path
    text: str
    sha256: str
    name: str
    urdf_path: Path
    urdf: str
    file: ArmFile
    recording: RecordingSettings


def load_arm(path: Path) -> ArmConfig:
    """Read and check an ARM.yaml. Raises ConfigError: one line naming file, key, what was found and what was expected."""
    mapping, data = read_yaml(path)
    where = str(path)
    file = decode(ArmFile, mapping, where)
    # an arm has no ring of its own, and no fault that a flight recorder waits for
    of_loop: dict[str, Any] = {"ring_cycles": RecordingSettings.ring_cycles, "flight_recorder_s": None}
    recording = decode(RecordingSettings, file.recording, where, "recording", **of_loop)
    urdf = path.parent / file.urdf
    return ArmConfig(
        path=path,
        text=data.decode("utf-8", "replace"),
        sha256=sha256_hex(data),
        name=path.stem,
        urdf_path=urdf,
        urdf=_text(read_regular(urdf, _LARGEST_URDF, "a URDF"), urdf),
        file=file,
        recording=recording,
    )


def _text(data: bytes, path: Path) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8: byte {error.start + 1}, expected a URDF") from None
