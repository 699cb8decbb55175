"""ARM.yaml: what is read, and the one line of every mistake."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

from jtqd.daemon.arm.arm_file import load_arm
from jtqd.estimator.errors import ConfigError
from tests.daemon.arm import small_arm


def changed(key: str, value: Any) -> dict[str, Any]:
    """ARM.yaml with another value of a dotted key; None: without it."""
    mapping = copy.deepcopy(
        small_arm.content(
            payload={"mass_kg": 1.5, "centre_m": [0.0, 0.01, 0.1]},
            noise={
                "total": {"shoulder": 1.25, "elbow": 0.75},
                "offset": 0.5,
                "tests": {"shoulder": [1.0, 2.0, 3.0], "elbow": [4.0, 5.0, 6.0]},
                "position_rad": {"shoulder": 1e-5, "elbow": 2e-5},
            },
            recording={"rotate_s": 60.0},
        )
    )
    *path, last = key.split(".")
    at = mapping
    for part in path:
        at = at[part]
    if value is None:
        del at[last]
    else:
        at[last] = value
    return mapping


def test_what_is_read(tmp_path: Path) -> None:
    config = load_arm(small_arm.write(tmp_path, changed("up", [0, -1, 0])))
    assert (config.name, config.urdf, config.file.tool) == ("arm", small_arm.URDF, "flange")
    assert list(config.file.joints) == ["shoulder", "elbow"]
    elbow = config.file.joints["elbow"]
    assert (elbow.bus, elbow.joint, elbow.direction, elbow.zero_rad) == ("vcan1", 1, -1, -0.5)
    assert config.file.up == (0.0, -1.0, 0.0)
    assert config.file.payload is not None
    assert (config.file.payload.mass_kg, config.file.payload.centre_m) == (1.5, (0.0, 0.01, 0.1))
    assert config.file.noise is not None
    assert (config.file.noise.total, config.file.noise.offset) == ({"shoulder": 1.25, "elbow": 0.75}, 0.5)
    assert config.file.noise.tests["elbow"] == (4.0, 5.0, 6.0)
    assert (config.recording.rotate_s, config.recording.chunk_s) == (60.0, 0.5)


def test_what_may_be_left_out(tmp_path: Path) -> None:
    config = load_arm(small_arm.write(tmp_path))
    assert (config.file.up, config.file.payload, config.file.noise) == ((0.0, 0.0, 1.0), None, None)


SOURCE = {"bus": "vcan2", "joint": 1, "direction": 1, "zero_rad": 0.0}
MISTAKES = [
    ("urdf", None, "key 'urdf'", "missing", "a text"),
    ("urdf", "other.urdf", "other.urdf", "No such file", ""),
    ("tol", "flange", "key 'tol'", "unknown key", "'tool'"),
    ("tool", 3, "key 'tool'", "found 3", "a text"),
    ("joints", {}, "key 'joints'", "found none", "zero_rad"),
    ("joints", ["shoulder"], "key 'joints'", "found ['shoulder']", "a mapping"),
    (
        "joints.elbow",
        {"bus": "vcan0"},
        "key 'joints.elbow.joint'",
        "missing",
        "'joints.elbow.zero_rad': missing",
    ),
    ("joints.elbow", None, "key 'noise.total.elbow'", "found that joint", "one of shoulder"),
    ("joints.elbow", 1, "key 'joints.elbow'", "found 1", "a mapping"),
    ("joints.elbow.zero_deg", 3, "key 'joints.elbow.zero_deg'", "unknown key", "'zero_rad'"),
    ("joints.elbow.zero_rad", 90.0, "key 'joints.elbow.zero_rad'", "found 90.0", "in rad from -6.3 to 6.3"),
    ("joints.elbow.zero_rad", "0", "key 'joints.elbow.zero_rad'", "found '0'", "a number in rad"),
    ("joints.elbow.direction", 0, "key 'joints.elbow.direction'", "found 0", "1 or -1"),
    ("joints.elbow.direction", 2, "key 'joints.elbow.direction'", "found 2", "from -1 to 1"),
    ("joints.elbow.joint", 5, "key 'joints.elbow.joint'", "found 5", "from 1 to 4"),
    ("joints.elbow.bus", "vcan0", "key 'joints.elbow.joint'", "found 1", "vcan0 that is not shoulder"),
    ("up", [0, 0], "key 'up'", "found 2 numbers", "3 finite numbers"),
    ("up", [0, 0, 0], "key 'up'", "found [0", "not all 0"),
    ("up", [1e-320, 0, 0], "key 'up'", "found [1e-320", "not all 0"),
    ("joints.el\tbow", SOURCE, "key 'joints'", "found 'el\\tbow'", "printable"),
    ("joints. ", SOURCE, "key 'joints'", "found ' '", "printable"),
    ("payload.mass_kg", -1.0, "key 'payload.mass_kg'", "found -1.0", "in kg from 0 to 1000"),
    ("payload.centre_m", [0, 10, 100], "key 'payload.centre_m'", "found [0", "in m from -2 to 2"),
    ("noise.total.elbow", None, "key 'noise.total.elbow'", "missing", "a value"),
    ("noise.tests.elbow", None, "key 'noise.tests.elbow'", "missing", "a value"),
    ("noise.tests.elbow", [1.0, 2.0], "key 'noise.tests.elbow'", "found 2 numbers", "3 finite numbers"),
    ("noise.tests.elbow", [1.0, 0.0, 2.0], "key 'noise.tests.elbow'", "found [1.0", "3 numbers > 0"),
    ("noise.position_rad.elbow", -1.0, "key 'noise.position_rad.elbow'", "found -1.0", "in rad from 0"),
    ("noise.tests", None, "key 'noise.tests'", "missing", "a mapping"),
    ("noise.total.wrist", 1.0, "key 'noise.total.wrist'", "found that joint", "one of shoulder, elbow"),
    ("noise.total.elbow", 0.0, "key 'noise.total.elbow'", "found 0.0", "a number > 0"),
    ("noise.offset", None, "key 'noise.offset'", "missing", "a number"),
    ("recording.rotate_s", 0.0, "key 'recording.rotate_s'", "found 0.0", "in s from 1 to 86400"),
    ("recording.flight_recorder_s", 9.0, "key 'recording.flight_recorder_s'", "unknown key", "known keys"),
]


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake[0])
def test_a_mistake_is_one_line_with_key_found_and_expected(
    tmp_path: Path, mistake: tuple[str, Any, str, str, str]
) -> None:
    key, value, *parts = mistake
    path = small_arm.write(tmp_path, changed(key, value))
    with pytest.raises(ConfigError) as error:
        load_arm(path)
    text = str(error.value)
    assert "\n" not in text
    assert str(path.parent) in text
    for part in parts:
        assert part in text, text


@pytest.mark.parametrize(("data", "found"), [(b"\xff\xfe<", "not UTF-8"), (None, "Is a directory")])
def test_a_file_that_is_no_urdf(tmp_path: Path, data: bytes | None, found: str) -> None:
    path = small_arm.write(tmp_path)
    (tmp_path / "arm.urdf").unlink()
    if data is None:
        (tmp_path / "arm.urdf").mkdir()
    else:
        (tmp_path / "arm.urdf").write_bytes(data)
    with pytest.raises(ConfigError, match=found):
        load_arm(path)
