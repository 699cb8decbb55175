"""Which estimator the loop builds by configuration, how ONNX Runtime checks its network, and one line for each refusal."""

from __future__ import annotations

import hashlib
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import onnx
import pytest
import yaml
from onnx import helper

from jtqd.daemon.config import Config, load_config
from jtqd.daemon.core.status import safety_of
from jtqd.daemon.loop import process
from jtqd.daemon.loop.process import (
    build_estimator,
    build_estimators,
    build_shadows,
    check_networks,
    loop_filters,
    warm_up,
)
from jtqd.drivers.bus_socket import CanFilter
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import FusedEstimator, JointEstimator
from jtqd.estimator.network import NetworkError, RuntimeCheck
from tests.estimator.estimator_helpers import small_network
from tests.estimator.fused_configuration import configured, joint_of, networks

JOINTS = (1, 2)


def the_papers() -> dict[int, bytes]:
    return {number: small_network().with_metadata(joint=f"joint{number}").data for number in JOINTS}


def test_method_fused_uses_its_networks(tmp_path: Path) -> None:
    config = load_config(configured(tmp_path, "fused", networks()))
    estimators = [build_estimator(config, joint) for joint in config.joints]
    warm_up(estimators)
    for number, estimator in zip(JOINTS, estimators, strict=True):
        assert isinstance(estimator, FusedEstimator)
        assert estimator.joint == joint_of(number)
        found = [estimator.step(1e-3, 2.0, 0.1 * n, 100.0, 0.001 * n - 1e-3, 25.0) for n in range(50)][-1]
        assert found.status == 2
        assert found.torque_nm != found.physics_nm


def test_method_fused_without_networks_is_its_physics(tmp_path: Path) -> None:
    config = load_config(configured(tmp_path, "fused", {1: networks()[1]}))
    assert [joint.network is None for joint in config.joints] == [False, True]
    estimator = build_estimator(config, config.joints[1])
    found = [estimator.step(1e-3, 2.0, 0.1 * n, 100.0, 0.001 * n, 25.0) for n in range(50)][-1]
    assert (found.status, found.torque_nm) == (2, found.physics_nm)


def test_a_drive_without_a_link_encoder_may_have_a_network_of_the_current_path(tmp_path: Path) -> None:
    """Its estimate is that of the network, without delay; the paper's network has the link position among its inputs."""
    path = configured(tmp_path, "fused", networks(), objects={"link_position": False})
    for number in JOINTS:
        file = yaml.safe_load((tmp_path / f"j{number}.yaml").read_text())
        del file["fused"]["torsion"]
        (tmp_path / f"j{number}.yaml").write_text(yaml.safe_dump(file))
    config = load_config(path)
    (safety, _), estimator = safety_of(config), build_estimator(config, config.joints[0])
    assert safety.bandwidth_rad_s == math.inf
    found = [estimator.step(1e-3, 2.0, 0.1 * n, 100.0, 0.001 * n, 25.0) for n in range(50)][-1]
    assert (found.status, found.torque_nm) == (2, found.network_nm)
    with pytest.raises(ConfigError, match="uses a network with the link position"):
        load_config(configured(tmp_path, "network", the_papers(), objects={"link_position": False}))


def notes(config: Config) -> list[str]:
    found: list[str] = []
    for joint in config.joints:
        build_estimator(config, joint, None, found)
    return found


def test_a_joint_that_is_its_physics_alone_is_told(tmp_path: Path) -> None:
    assert notes(load_config(None)) == [f"joint {number}: no network, physics only" for number in JOINTS]
    half = load_config(configured(tmp_path, "fused", {1: networks()[1]}))
    assert notes(half) == ["joint 2: no network, physics only"]


@pytest.mark.parametrize("method", ["tob", "efficiency", "network"])
def test_methods_that_are_no_correction_of_it_say_nothing(tmp_path: Path, method: str) -> None:
    assert notes(load_config(configured(tmp_path, method, the_papers()))) == []


@pytest.mark.parametrize("method", ["tob", "efficiency"])
def test_other_methods_leave_a_network_alone(tmp_path: Path, method: str) -> None:
    config = load_config(configured(tmp_path, method, networks()))
    assert [joint.network for joint in config.joints] == [None, None]
    assert isinstance(build_estimator(config, config.joints[0]), JointEstimator)


def test_method_network_still_needs_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"joint_2\.network.*missing.*estimator\.method is network"):
        load_config(configured(tmp_path, "network", {1: the_papers()[1]}))
    config = load_config(configured(tmp_path, "network", the_papers()))
    assert isinstance(build_estimator(config, config.joints[1]), JointEstimator)


def test_a_joint_without_section_fused_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(configured(tmp_path, "fused", networks(), without_fused=(2,)))
    assert str(caught.value) == (
        f"{tmp_path}/j2.yaml: key 'fused': missing, expected because estimator.method is fused"
    )


@pytest.mark.parametrize(
    ("method", "kind", "found"),
    [
        ("fused", the_papers, "found input 'x' of shape ['N', 6], expected ['N', 28]"),
        ("network", networks, "found input 'x' of shape ['N', 28], expected ['N', 6]"),
    ],
)
def test_a_network_of_another_method_is_named(tmp_path: Path, method: str, kind: Any, found: str) -> None:
    config = load_config(configured(tmp_path, method, kind()))
    with pytest.raises(NetworkError) as caught:
        build_estimator(config, config.joints[1])
    assert str(caught.value) == (
        f"{tmp_path}/n2.onnx: {found} ({tmp_path}/c.yaml: 'joint_2', estimator.method is {method})"
    )


@pytest.mark.parametrize("method", ["fused", "network"])
def test_a_network_of_another_joint_is_named(tmp_path: Path, method: str) -> None:
    second = (networks() if method == "fused" else the_papers())[2]
    config = load_config(configured(tmp_path, method, {1: second, 2: second}))
    with pytest.raises(ConfigError) as caught:
        build_estimator(config, config.joints[0])
    message = str(caught.value)
    assert "joint joint1: found a network of joint 'joint2', expected one of 'joint1'" in message
    assert message.endswith(f"({tmp_path}/c.yaml: 'joint_1', estimator.method is {method})")
    assert "\n" not in message


def received(filters: list[CanFilter], can_id: int) -> bool:
    return any((can_id & each.mask) == (each.can_id & each.mask) for each in filters)


@pytest.mark.parametrize("temperature", [True, False])
def test_the_loop_hears_what_its_configuration_needs_and_nothing_else(
    tmp_path: Path, temperature: bool
) -> None:
    filters = loop_filters(load_config(configured(tmp_path, "tob", {}, temperature=temperature)))
    wanted = {0x080, 0x181, 0x281, 0x182, 0x282, 0x183, 0x701, 0x702, 0x703}
    wanted |= {0x381, 0x382} if temperature else set()
    wanted |= {0x1A0, 0x2A0, 0x3A0, 0x4A0, 0x720}  # its own: what it did not send is a conflict
    assert {can_id for can_id in range(0x800) if received(filters, can_id)} == wanted


PROGRAM = """
import json, sys
from pathlib import Path
from jtqd.daemon.config import load_config
from jtqd.daemon.loop.process import build_estimators
config = load_config(Path(sys.argv[1]))
_, estimators = build_estimators({"config": sys.argv[1], "config_sha256": config.files_sha256})
steps = [each.step(1e-3, 2.0, 0.1 * n, 100.0, 0.001 * n, 25.0) for each in estimators for n in range(50)]
print(json.dumps([["onnxruntime" in sys.modules, all(each.with_network for each in estimators)], steps]))
"""


def loaded(path: Path) -> tuple[bool, list[list[float]]]:
    """Whether a loop of this configuration has ONNX Runtime, and the estimates of its estimators, all with a network."""
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(path)], capture_output=True, text=True, check=True
    )
    (runtime, used), steps = json.loads(run.stdout)
    assert used
    return runtime, steps


def foreign(data: bytes) -> bytes:
    """The same network with the answer negated twice and without weights in its metadata: none of our graphs."""
    model = onnx.load_from_string(data)
    model.metadata_props.remove(next(each for each in model.metadata_props if each.key == "perceptron"))
    last = model.graph.node[-1]
    answer, last.output[0] = last.output[0], "answer"
    model.graph.node.append(helper.make_node("Neg", ["answer"], ["negative"]))
    model.graph.node.append(helper.make_node("Neg", ["negative"], [answer]))
    return bytes(model.SerializeToString())


def refusal(config: Config, joint: int) -> tuple[str, str]:
    """The refusal of a joint's network, checked apart and checked here."""
    checks, texts = check_networks(config), []
    for check in (checks[joint], None):
        with pytest.raises((NetworkError, ConfigError)) as caught:
            build_estimator(config, config.joints[joint], check)
        texts.append(str(caught.value))
    return texts[0], texts[1]


def test_the_loop_has_no_runtime_unless_a_graph_is_foreign(tmp_path: Path) -> None:
    ours, mixed = tmp_path / "ours", tmp_path / "mixed"
    ours.mkdir(), mixed.mkdir()
    files = networks()
    without, native = loaded(configured(ours, "fused", files))
    having, other = loaded(configured(mixed, "fused", {1: foreign(files[1]), 2: files[2]}))
    assert (without, having) == (False, True)
    for a, b in zip(native, other, strict=True):
        assert a == pytest.approx(b, abs=1e-9, nan_ok=True)


@pytest.mark.parametrize("method", ["fused", "network"])
def test_an_estimator_is_the_same_wherever_its_network_was_check_networks(
    tmp_path: Path, method: str
) -> None:
    files = (
        networks()
        if method == "fused"
        else {n: small_network().with_metadata(joint=f"joint{n}").data for n in (1, 2)}
    )
    path = configured(tmp_path, method, files)
    config = load_config(path)
    _, apart = build_estimators({"config": str(path), "config_sha256": config.files_sha256})
    here = [build_estimator(config, joint) for joint in config.joints]
    for one, other in zip(apart, here, strict=True):
        other.reset()
        for n in range(50):
            sample = (1e-3, 2.0, 0.1 * n, 100.0, 0.001 * n, 25.0)
            a, b = one.step(*sample), other.step(*sample)
            assert a == pytest.approx(b, abs=0.0, nan_ok=True)
        assert a.network_nm == a.network_nm


def test_refusals_have_the_same_words(tmp_path: Path) -> None:
    files = networks()
    for number, (bad, word) in enumerate(
        [
            (b"no model", "not a usable ONNX model"),
            (small_network().data, "found input 'x' of shape ['N', 6], expected ['N', 28]"),
            (files[1], "found a network of joint 'joint1', expected one of 'joint2'"),
        ]
    ):
        directory = tmp_path / str(number)
        directory.mkdir()
        apart, here = refusal(load_config(configured(directory, "fused", {1: files[1], 2: bad})), 1)
        assert word in apart
        assert apart == here


def test_other_bytes_than_the_checked_ones_are_refused(tmp_path: Path) -> None:
    config = load_config(configured(tmp_path, "fused", networks()))
    check = check_networks(config)[0]
    assert isinstance(check, RuntimeCheck)
    with pytest.raises(NetworkError, match="was changed while it was checked"):
        build_estimator(config, config.joints[0], check._replace(sha256="0" * 64))


def test_a_native_evaluation_that_differs_is_refused(tmp_path: Path) -> None:
    config = load_config(configured(tmp_path, "fused", networks()))
    check = check_networks(config)[0]
    assert isinstance(check, RuntimeCheck)
    with pytest.raises(NetworkError, match=r"native evaluation and ONNX Runtime 0\.001 Nm apart"):
        build_estimator(config, config.joints[0], check._replace(native_error_nm=1e-3))


def test_a_check_that_dies_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_config(configured(tmp_path, "fused", networks()))
    (tmp_path / "dies.py").write_text("import os, signal; os.kill(os.getpid(), signal.SIGKILL)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(process, "CHECK_PROGRAM", "dies")
    for joint, check in zip(config.joints, check_networks(config), strict=True):
        with pytest.raises(NetworkError) as caught:
            build_estimator(config, joint, check)
        assert str(caught.value) == (
            f"{tmp_path}/n{joint.number}.onnx: the check by ONNX Runtime ended with exit status -9 "
            f"({tmp_path}/c.yaml: 'joint_{joint.number}', estimator.method is fused)"
        )


def with_shadow(directory: Path, data: bytes) -> Config:
    """The bench by method tob, with the paper's chain as a shadow of both joints; joint 2 has this network."""
    path = configured(directory, "tob", {})
    content = yaml.safe_load(path.read_text())
    content["estimator"]["shadow"] = ["efficiency", "network"]
    for number, each in {**the_papers(), 2: data}.items():
        (directory / f"s{number}.onnx").write_bytes(each)
        network = {"file": f"s{number}.onnx", "sha256": hashlib.sha256(each).hexdigest()}
        content[f"joint_{number}"]["shadow_networks"] = {"network": network}
    path.write_text(yaml.safe_dump(content))
    return load_config(path)


def test_shadow_methods_are_built_by_the_loop_and_checked_by_the_runtime(tmp_path: Path) -> None:
    built = build_shadows(with_shadow(tmp_path, the_papers()[2]))
    assert [[each.settings.method for each in of_joint] for of_joint in built] == 2 * [
        ["efficiency", "network"]
    ]
    assert [[each.with_network for each in of_joint] for of_joint in built] == 2 * [[False, True]]
    assert [each[0].joint.name for each in built] == ["joint1", "joint2"]
    assert build_shadows(load_config(configured(tmp_path, "tob", {}))) == []


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"no model", "not a usable ONNX model"),
        (foreign(the_papers()[2]), "found a graph that ONNX Runtime must run, expected a graph with weights"),
    ],
)
def test_a_network_of_a_shadow_method_that_cannot_be_used_is_refused(
    tmp_path: Path, data: bytes, words: str
) -> None:
    """A foreign graph is right for the method that is sent: it has a budget of time, a shadow method has none."""
    with pytest.raises(NetworkError) as caught:
        build_shadows(with_shadow(tmp_path, data))
    text = str(caught.value)
    assert f"{tmp_path}/s2.onnx" in text
    assert words in text
    assert text.endswith(f"({tmp_path}/c.yaml: 'joint_2', estimator.shadow has network)")
