"""Joint files: what ships is what the paper says; whatever is wrong is refused in one line that names it."""

from __future__ import annotations

import copy
import pickle
import re
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jtqd.daemon.config import load_config
from jtqd.estimator.errors import ConfigError, range_text
from jtqd.estimator.joint import ELASTIC, Effect, Friction, Joint
from jtqd.models.files import load_joint, load_yaml, parse_yaml, read_yaml, shipped
from jtqd.sim_can.plant_file import load_plant
from jtqd.sysid.fit.efficiency import TABLE_I
from jtqd.sysid.fit.joint_writer import write_joint

# Table I as printed: one row per coefficient, columns i>0 w>0 | i<0 w<0 | i<0 w>0 | i>0 w<0
PRINTED = """
P00   0.2530  0.2850  1.8830  1.8660
P10   0.1493 -0.1430  0.4870 -0.4769
P01  -0.0820  0.0839  0.2602 -0.2342
P20  -0.0117 -0.0114  0.0658  0.0645
P11   0.0060  0.0059  0.0435  0.04295
P02   0.0066  0.0060 -0.0168 -0.0101
RMSE 0.01963 0.01719 0.05599 0.05504
"""


def mapping() -> dict[str, Any]:
    return load_yaml(shipped("joint1.yaml"))


def refused(change: dict[str, Any]) -> str:
    with pytest.raises(ConfigError) as caught:
        Joint.from_mapping(change, "my.yaml")
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_table_one_is_the_printed_one_and_ships_with_both_joints() -> None:
    quadrants = (TABLE_I.i_pos_w_pos, TABLE_I.i_neg_w_neg, TABLE_I.i_neg_w_pos, TABLE_I.i_pos_w_neg)
    for line in PRINTED.strip().splitlines():
        name, *printed = line.split()
        assert [getattr(q, name.lower()) for q in quadrants] == [float(x) for x in printed]
    assert TABLE_I.convention == "joint_over_motor"
    for name in ("joint1.yaml", "joint2.yaml"):
        assert load_joint(shipped(name)).efficiency == TABLE_I


def test_shipped_numbers() -> None:
    one, two = load_joint(shipped("joint1.yaml")), load_joint(shipped("joint2.yaml"))
    assert (one.name, one.gear_ratio, one.torque_constant_nm_per_a) == ("joint1", 100.0, 0.062)
    assert (one.rotor_inertia_kgm2, one.stiffness_nm_per_rad, one.damping_nms_per_rad) == (7e-5, 12000.0, 8.0)
    assert (one.link_inertia_kgm2, one.rated_torque_nm, one.effects) == (0.008, 40.0, ())
    assert one.friction == Friction(3.0, 2.0, 0.8, 0.05)
    assert (two.name, two.torque_constant_nm_per_a, two.friction.coulomb_nm) == ("joint2", 0.0615, 3.2)


def test_round_trip_copy_and_pickle() -> None:
    joint = replace(
        load_joint(shipped("joint1.yaml")),
        effects=(Effect("cogging", {"amplitude_nm": 0.1, "order_per_motor_rev": 12}),),
    )
    assert Joint.from_mapping(joint.to_mapping(), "x") == joint
    assert pickle.loads(pickle.dumps(joint)) == joint
    assert copy.deepcopy(joint) == joint
    with pytest.raises(TypeError):
        joint.effects[0].parameters["amplitude_nm"] = 1.0  # type: ignore[index]


def test_a_typo_is_refused_with_the_nearest_key() -> None:
    change = mapping()
    change["friction"]["coloumb_nm"] = 1.0
    message = refused(change)
    assert message.startswith("my.yaml: key 'friction.coloumb_nm': unknown key")
    assert "did you mean 'coulomb_nm'?" in message


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("friction.coulomb_nm", "abc", "found 'abc', expected a number in Nm >= 0"),
        ("friction.coulomb_nm", -1, "found -1, expected a number in Nm >= 0"),
        ("friction.stribeck_velocity_rad_s", 0.0, "expected a number in rad/s > 0"),
        ("gear_ratio", 0, "found 0, expected a number > 0"),
        ("gear_ratio", True, "found True"),
        ("gear_ratio", float("nan"), "found nan"),
        ("rated_torque_nm", float("inf"), "found inf"),
        ("rated_torque_nm", 10**400, "expected a number in Nm > 0"),
        ("rotor_inertia_kgm2", "7e-5", "write 7.0e-5, not 7e-5"),
        ("name", "", "expected a text"),
        ("name", 3, "expected a text"),
        ("efficiency", [1], "expected a mapping"),
        ("efficiency.i_pos_w_pos.p00", None, "expected a number"),
        ("efficiency.convention", "up", "one of 'joint_over_motor'"),
        ("effects", {"name": "cogging"}, "expected a list of mappings"),
        ("provenance", "yesterday", "expected a mapping"),
    ],
)
def test_wrong_values_name_key_found_and_expected(path: str, value: object, words: str) -> None:
    change = mapping()
    *parents, last = path.split(".")
    inner = change
    for parent in parents:
        inner = inner[parent]
    inner[last] = value
    message = refused(change)
    assert message.startswith(f"my.yaml: key '{path}': found")
    assert words in message


def test_every_key_but_the_optional_ones_must_be_there() -> None:
    optional = {"efficiency", "effects", "provenance"}
    for key in mapping():
        change = mapping()
        del change[key]
        if key in optional:
            Joint.from_mapping(change, "my.yaml")
        else:
            assert refused(change).startswith(f"my.yaml: key '{key}': missing")


def test_all_missing_keys_are_in_one_error() -> None:
    keys = re.findall(r"key '(\w+)': missing", refused({"name": "joint"}))
    assert keys == [
        *(
            "gear_ratio",
            "torque_constant_nm_per_a",
            "rotor_inertia_kgm2",
            *ELASTIC,
            "rated_torque_nm",
            "friction",
        )
    ]


def test_a_joint_with_one_encoder_needs_no_stiffness(tmp_path: Path) -> None:
    change = {key: value for key, value in mapping().items() if key not in ELASTIC}
    joint = Joint.from_mapping(change, "my.yaml", elastic=False)
    assert np.isnan([joint.stiffness_nm_per_rad, joint.damping_nms_per_rad]).all()
    assert set(joint.to_mapping()) & set(ELASTIC) == {"link_inertia_kgm2"}
    assert (
        pickle.loads(pickle.dumps(joint)).to_mapping()
        == copy.deepcopy(joint).to_mapping()
        == joint.to_mapping()
    )
    write_joint(tmp_path / "a.yaml", joint, "one encoder")
    assert load_joint(tmp_path / "a.yaml", elastic=False) == joint
    with pytest.raises(
        ConfigError, match=r"'stiffness_nm_per_rad': missing, .*; key 'damping_nms_per_rad': missing"
    ):
        load_joint(tmp_path / "a.yaml")


def test_efficiency_without_convention_names_both_choices() -> None:
    change = mapping()
    del change["efficiency"]["convention"]
    message = refused(change)
    assert "'joint_over_motor'" in message
    assert "'motor_over_joint'" in message
    assert "efficiency.convention': missing" in message


def test_effects_are_carried_and_only_known_names_pass() -> None:
    change = mapping()
    change["effects"] = [
        {"name": "torque_ripple", "parameters": {"amplitude_nm": 0.4, "order_per_motor_rev": 2}}
    ]
    joint = Joint.from_mapping(change, "my.yaml")
    assert joint.effects == (Effect("torque_ripple", {"amplitude_nm": 0.4, "order_per_motor_rev": 2.0}),)
    change["effects"][0]["name"] = "magic"
    assert "effects[0].name': found 'magic'" in refused(change)
    change["effects"][0] = {"name": "cogging", "parameters": {"amplitude_nm": "big"}}
    assert "effects[0].parameters.amplitude_nm': found 'big'" in refused(change)


def test_values_built_in_code_are_checked_too() -> None:
    joint = load_joint(shipped("joint1.yaml"))
    for change in ({"gear_ratio": 0.0}, {"rated_torque_nm": float("nan")}, {"link_inertia_kgm2": -1.0}):
        with pytest.raises(ConfigError):
            replace(joint, **change)  # type: ignore[arg-type]
    with pytest.raises(ConfigError):
        Friction(-0.1, 1.0)


def test_random_garbage_never_gets_past_as_another_exception() -> None:
    seed = 20260
    rng = np.random.default_rng(seed)
    garbage: list[Any] = [None, "x", -1, [], {}, float("nan"), True, [[1]], {"a": 1}, b"x", 1e400]
    for round_ in range(150):
        change: Any = mapping()
        inner = change
        for _ in range(rng.integers(0, 3)):
            keys = [k for k in inner if isinstance(inner[k], dict)]
            if keys:
                inner = inner[keys[rng.integers(len(keys))]]
        key = list(inner)[rng.integers(len(inner))]
        inner[key] = garbage[rng.integers(len(garbage))]
        message = ""
        try:
            Joint.from_mapping(change, "my.yaml")
        except ConfigError as error:
            message = str(error)
        assert message == "" or message.startswith("my.yaml: key"), (seed, round_)


def test_files(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(b"a: 1\nb: {c: 2.5}\n")
    content, data = read_yaml(path)
    assert content == load_yaml(path) == {"a": 1, "b": {"c": 2.5}}
    assert data == path.read_bytes()
    for text, words in (
        (b"a: 1\na: 2\n", "line 2, column 1 not YAML: the key 'a' is given twice"),
        (b"a: &a {b: 1}\nc: {<<: *a, <<: *a}\n", "line 2, column 13 not YAML: the key '<<' is given twice"),
        (b"a: &a [1]\nc: {<<: *a}\n", "not YAML: expected the mapping that << merges"),
        (b"a: [1\n", "line 2, column 1 not YAML: expected ',' or ']', found the end of the file"),
        (b'a: "b\n', "found the end of the file (while scanning a text in quotes that begins in line 1)"),
        (
            b"a: {b: 1\nc: 2\n",
            "expected ',' or '}', found ':' (while parsing a mapping in { } that begins in line 1)",
        ),
        (b"a:\n\tb: 1\n", "line 2, column 1 not YAML: found a tab, expected spaces"),
        (b"a: 1\nb\nc: 1\n", "found no ': ' behind a key"),
        (b"\x89MCAP0\r\n", "not YAML: found 89h at offset 0, expected a text file"),
        (b"- 1\n", "found list"),
        (b"", "an empty file"),
        (b"\xff\xfe\x00", "not YAML"),
        (b"a: \x00", "not YAML"),
        (b'a: !!int ""\n', "not YAML"),
        (b'a: !!bool "x"\n', "not YAML"),
        (b'a: !!timestamp "x"\n', "not YAML"),
        (b"a: !!python/object:os.system {}", "not YAML"),
        (b"? [1]\n: 2\n? {a: 1}\n: 3\n", "not YAML"),
    ):
        path.write_bytes(text)
        with pytest.raises(ConfigError) as caught:
            load_yaml(path)
        assert str(caught.value).startswith(str(path)), text
        assert words in str(caught.value)
        assert "\n" not in str(caught.value)
    for bad in (tmp_path / "absent.yaml", tmp_path):
        with pytest.raises(ConfigError, match="cannot be read"):
            load_yaml(bad)


def test_what_holds_of_merged_mappings_does_not_depend_on_the_library(tmp_path: Path) -> None:
    path = tmp_path / "merged.yaml"
    path.write_text(
        "deep: {er: {found: &late {<<: {torque: 8}, torque: 9}}}\n"
        "a: &a {torque: 1, speed: 2}\n"
        "b: &b {torque: 3, gear: 4}\n"
        "first_of_a_list: {<<: [*a, *b]}\n"
        "its_own: {<<: [*b, *a], speed: 5}\n"
        "through: {<<: {<<: *a, speed: 6}, gear: 7}\n"
        "merged_before_it_is_read: {<<: *late}\n"
        "itself: &me {<<: *me, torque: 1}\n"
    )
    content = load_yaml(path)
    assert content["first_of_a_list"] == {"torque": 1, "speed": 2, "gear": 4}
    assert content["its_own"] == {"torque": 3, "gear": 4, "speed": 5}
    assert content["through"] == {"torque": 1, "speed": 6, "gear": 7}
    assert content["deep"]["er"]["found"] == content["merged_before_it_is_read"] == {"torque": 9}
    assert content["itself"] == {"torque": 1}


def test_a_file_too_large_for_anything_written_by_hand_is_refused_without_reading_it_all(
    tmp_path: Path,
) -> None:
    path = tmp_path / "large.yaml"
    path.write_bytes(b"a: 1\n#".ljust(250_000, b" "))
    assert load_yaml(path) == {"a": 1}
    path.write_bytes(b"a: 1\n#".ljust(250_001, b" "))
    for load in (load_yaml, load_joint, load_config, load_plant):
        for large, found in ((path, "more than 250000 bytes"), (Path("/dev/zero"), "no regular file")):
            with pytest.raises(ConfigError) as caught:
                load(large)
            assert str(caught.value) == f"{large}: found {found}, expected a YAML file written by hand"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("".join(f"k{n}: 1\n" for n in range(20_000)), "more than 10000 keys and values"),
        ("a: {" + ", ".join(f"k{n}" for n in range(20_000)) + "}", "more than 10000 keys and values"),
        ("a: [" + "1," * 100_000 + "]", "more than 10000 keys and values"),
        ("[" * 200_000, "line 1, column 51 not YAML: found brackets nested more than 50 deep"),
        ("a: " + "{" * 200_000, "found brackets nested more than 50 deep"),
        ("- " * 100_000, "found values nested more than 50 deep"),
        ("? " * 100_000, "found values nested more than 50 deep"),
        (
            "a: " + "1" * 4000,
            "line 1, column 4 not YAML: found a number of 4000 characters, expected at most 100",
        ),
        ("a: 0x" + "f" * 200_000, "found a number of 200002 characters"),
        ("a: 1" + ":1" * 100_000, "found a number of 200001 characters"),
        ("a: 1" + ":1" * 100_000 + ".5", "found a number of 200003 characters"),
        ('a: "\\ud800"', "line 1, column 4 not YAML: found half of a surrogate pair, expected a character"),
        ('"\\udfff": 1', "found half of a surrogate pair"),
        ('a: "\\Uffffffff"', "not YAML: "),
        (
            "a: &a " + str(list(range(100))) + "\n" + "".join(f"b{n}: *a\n" for n in range(100)),
            "more than 10000",
        ),
        (
            "a0: &a0 [1, 1]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 60)),
            "more than 10000",
        ),
        (
            "a: &a {" + "".join(f"k{n}: 1, " for n in range(2000)) + "<<: [" + "*a, " * 2000 + "]}",
            "more than 100000 keys by merging",
        ),
    ],
)
def test_decoding_takes_no_longer_than_the_values_of_a_file_written_by_hand(text: str, words: str) -> None:
    """One line, within a second: the time of PyYAML grows with the values, of its numbers with the square of the digits."""
    before = time.process_time()
    with pytest.raises(ConfigError) as refused:
        parse_yaml(text.encode(), "x.yaml")
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 200
    assert time.process_time() - before < 2.0


def test_a_message_is_one_line_of_bounded_length_whatever_a_file_holds() -> None:
    for text in ('"a\\nb\\e[2J": 1', "? " + "x" * 200_000 + "\n: 1", "a: *" + "x" * 200_000):
        with pytest.raises(ConfigError) as refused:
            Joint.from_mapping(parse_yaml(text.encode(), "x\n.yaml"), "x\n.yaml", elastic=False)
        assert str(refused.value).isprintable()
        assert len(str(refused.value)) <= 2003
        assert type(pickle.loads(pickle.dumps(refused.value))) is ConfigError


def test_a_value_that_contains_itself_ends() -> None:
    content = parse_yaml(b"a: &a {b: *a}", "x.yaml")
    assert content["a"]["b"] is content["a"]


def test_a_text_of_a_log_has_the_bounds_of_a_file() -> None:
    with pytest.raises(
        ConfigError, match=r"x\.yaml: found 250001 bytes, expected a YAML file written by hand"
    ):
        parse_yaml(b"a: 1\n#".ljust(250_001), "x.yaml")


@pytest.mark.parametrize("load", [load_yaml, load_joint, load_config, load_plant])
def test_a_nul_in_a_name_is_one_line(load: Callable[[str], object]) -> None:
    with pytest.raises(ConfigError, match=r"^'a\\x00b\.yaml': cannot be read: embedded null byte$"):
        load("a\0b.yaml")


def test_whole_limits_are_shown_as_whole_numbers() -> None:
    assert range_text("a whole number", 10_000, 1_000_000, None) == "a whole number from 10000 to 1000000"
    assert range_text("a whole number", 1_000_000, None, None) == "a whole number >= 1000000"
    assert range_text("a whole number", None, 0xFFFF_FFFF, None) == "a whole number <= 4294967295"
    assert range_text("a number", 0.5, 1e9, None) == "a number from 0.5 to 1e+09"


def test_shipped_lists_what_ships() -> None:
    with pytest.raises(ConfigError, match=r"shipped files: .*joint1\.yaml.*joint2\.yaml"):
        shipped("joint3.yaml")
    with pytest.raises(ConfigError):
        shipped("../pyproject.toml")
