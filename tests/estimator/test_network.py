"""Both networks: exported graph against numpy, one sample against many, and every way a file can be wrong."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest

from jtqd.estimator import onnx_graph
from jtqd.estimator.network import FEATURES, FUSED_FEATURES, FusedNetwork, TorqueNetwork
from jtqd.estimator.onnx_graph import NetworkError
from jtqd.sysid.train.network import export_network
from tests.estimator.estimator_helpers import HIGH, LOW, SmallNetwork, small_network
from tests.estimator.fused_helpers import HIGH as FUSED_HIGH
from tests.estimator.fused_helpers import LOW as FUSED_LOW
from tests.estimator.fused_helpers import everywhere, fused_network
from tests.paths import ROOT


def inputs(count: int, seed: int = 2) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.random.default_rng(seed).normal(size=(count, 6)) * 2.0 * np.array(HIGH)


def edited(change: Callable[[onnx.ModelProto], None]) -> bytes:
    model = onnx.load_from_string(small_network().data)
    change(model)
    data: bytes = model.SerializeToString()
    return data


def refused(source: bytes | Path, **options: Any) -> str:
    with pytest.raises(NetworkError) as caught:
        TorqueNetwork(source, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_the_graph_is_the_paper_s_network() -> None:
    """Weights well into saturation, so that tanh(x) instead of tanh(x/2) would be far off."""
    wild = small_network(3, noise=0.9)
    network = TorqueNetwork(wild.data)
    x = inputs(500)
    expected = wild.numpy(x)
    assert np.ptp(expected) > 1.0
    assert np.max(np.abs(network.run_many(x) - expected)) < 1e-9 * np.max(np.abs(expected))


def test_a_network_by_hand() -> None:
    """One hidden neuron: x = 2 -> (2-1)/0.5 = 2 -> 3*2+1 = 7 -> tanh(3.5) -> 4*()-1 -> *10+5."""
    w0 = np.zeros((6, 1))
    w0[0, 0] = 3.0
    mean, std = np.zeros(6), np.ones(6)
    mean[0], std[0] = 1.0, 0.5
    layers = [(w0, np.array([1.0])), (np.array([[4.0]]), np.array([-1.0]))]
    data = export_network(layers, mean, std, 5.0, 10.0, small_network().metadata)
    expected = 5.0 + 10.0 * (4.0 * math.tanh(3.5) - 1.0)
    assert TorqueNetwork(data).run_one(2.0, 0.0, 0.0, 0.0, 0.0, 0.0) == pytest.approx(expected, abs=1e-12)


def test_one_sample_and_many_agree() -> None:
    network = TorqueNetwork(small_network(4, noise=0.3).data)
    x = inputs(2000)
    assert network.bound
    many = network.run_many(x)
    assert np.max(np.abs(many - [network.run_one(*row) for row in x.tolist()])) < 1e-11
    assert network.run_many(np.zeros((0, 6))).shape == (0,)
    with pytest.raises(ValueError, match=r"\(4, 5\)"):
        network.run_many(np.zeros((4, 5)))
    assert math.isnan(network.run_one(math.nan, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert network.run_one(*x[0].tolist()) == many[0]  # NaN leaves nothing behind


def test_without_aliasing_it_falls_back_to_plain_run(monkeypatch: pytest.MonkeyPatch) -> None:
    original = onnxruntime.OrtValue.ortvalue_from_numpy
    monkeypatch.setattr(onnxruntime.OrtValue, "ortvalue_from_numpy", lambda x: original(x.copy()))
    network = TorqueNetwork(small_network(4, noise=0.3).data)
    assert not network.bound
    x = inputs(20)
    assert [network.run_one(*row) for row in x.tolist()] == pytest.approx(
        network.run_many(x).tolist(), abs=1e-11
    )


def test_the_runtime_has_no_thread_of_its_own_and_writes_nothing(tmp_path: Path) -> None:
    """Its telemetry would start one, and write a device-ID; ORT_DISABLE_TELEMETRY is read when the library is loaded."""
    code = (
        "import os, time; from jtqd.estimator.network import TorqueNetwork as N; "
        "from tests.estimator.estimator_helpers import small_network as s; "
        "N(s().data); time.sleep(0.5); print(len(os.listdir('/proc/self/task')))"
    )  # the threads that load it have ended, and need a moment to go
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    environment.pop("ORT_DISABLE_TELEMETRY", None)
    environment |= {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    assert subprocess.check_output([sys.executable, "-c", code], text=True, env=environment) == "1\n"
    assert list(tmp_path.iterdir()) == []


def test_the_runtime_is_of_a_version_in_which_that_was_tried() -> None:
    requirements = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    (needed,) = (each for each in requirements if each.startswith("onnxruntime"))
    assert needed == "onnxruntime>=1.20,<1.33"
    assert (1, 20) <= tuple(map(int, onnxruntime.__version__.split(".")[:2])) < (1, 33)


def test_metadata_and_hash(tmp_path: Path) -> None:
    small = small_network()
    path = tmp_path / "a.onnx"
    path.write_bytes(small.data)
    network = TorqueNetwork(path)
    assert (network.envelope_low, network.envelope_high) == (LOW, HIGH)
    assert (network.sigma_nm, network.joint, network.data_sha256) == (0.31, "joint1", "ab" * 32)
    assert TorqueNetwork(path, sha256=network.sha256.upper()).sha256 == network.sha256
    message = refused(path, sha256="0" * 64)
    assert message.startswith(f"{path}: found SHA-256 {network.sha256}, expected 000")


def test_unreadable_and_corrupt_files(tmp_path: Path) -> None:
    absent = tmp_path / "no.onnx"
    assert refused(absent).startswith(f"{absent}: cannot be read: No such file")
    assert "cannot be read" in refused(tmp_path)
    data = small_network().data
    rng = np.random.default_rng(8)
    for bad in (b"", b"\x00", b"not a model", data[: len(data) // 2], data[:-1], rng.bytes(5000)):
        assert refused(bad).startswith("network (bytes): ")


def test_flipped_bytes_never_give_another_exception() -> None:
    seed = 99
    rng = np.random.default_rng(seed)
    good = small_network().data
    for round_ in range(150):
        data = bytearray(good)
        for _ in range(rng.integers(1, 6)):
            data[rng.integers(0, len(data))] = rng.integers(0, 256)
        try:
            network = TorqueNetwork(bytes(data))
        except NetworkError as error:
            single_line = "\n" not in str(error)
        else:
            single_line = True
            network.run_one(1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
        assert single_line, (seed, round_)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("features", ..., "metadata 'features': missing"),
        ("features", list(FEATURES)[::-1], "metadata 'features': found ['efficiency_torque_nm'"),
        ("envelope_low", [0.0] * 5, "expected 6 finite numbers"),
        ("envelope_high", [*HIGH[:5], math.nan], "expected 6 finite numbers"),
        ("envelope_high", [-7.0, *HIGH[1:]], "envelope of current_a: found low -6 above high -7"),
        ("sigma_nm", 0.0, "metadata 'sigma_nm': found 0.0, expected a number in Nm > 0"),
        ("sigma_nm", "0.3", "metadata 'sigma_nm': found '0.3'"),
        ("joint", "", "metadata 'joint': found ''"),
        ("joint", ..., "metadata 'joint': missing"),
        ("data_sha256", 5, "metadata 'data_sha256': found 5"),
    ],
)
def test_wrong_metadata(key: str, value: object, words: str) -> None:
    assert words in refused(small_network().with_metadata(**{key: value}).data)


def test_metadata_that_is_not_json() -> None:
    def spoil(model: onnx.ModelProto) -> None:
        next(p for p in model.metadata_props if p.key == "sigma_nm").value = "0.3 Nm"

    assert "metadata 'sigma_nm': found '0.3 Nm', expected JSON" in refused(edited(spoil))


def test_metadata_nested_without_end_and_names_that_steer_a_terminal() -> None:
    def nested(model: onnx.ModelProto) -> None:
        next(p for p in model.metadata_props if p.key == "sigma_nm").value = "[" * 100_000

    assert "metadata 'sigma_nm': found '[[[" in refused(edited(nested))
    message = refused(small_network().with_metadata(joint="\x1b[31mjoint1").data)
    assert "metadata 'joint': found '\\x1b[31mjoint1', expected a text of printable characters" in message


def test_a_graph_that_does_not_answer_is_refused(tmp_path: Path) -> None:
    """It is well-formed, and has a loop of 10^15 turns inside; the process that refuses it can end."""
    helper, kind = onnx.helper, onnx.TensorProto
    one = helper.make_tensor("one", kind.DOUBLE, [], [1.0])
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["go_on"]), helper.make_node("Add", ["s", "one"], ["more"])],
        "body",
        [
            helper.make_tensor_value_info("n", kind.INT64, []),
            helper.make_tensor_value_info("go", kind.BOOL, []),
            helper.make_tensor_value_info("s", kind.DOUBLE, ["N", 1]),
        ],
        [
            helper.make_tensor_value_info("go_on", kind.BOOL, []),
            helper.make_tensor_value_info("more", kind.DOUBLE, ["N", 1]),
        ],
        [one],
    )

    def endless(model: onnx.ModelProto) -> None:
        (out,) = model.graph.output
        model.graph.initializer.append(helper.make_tensor("turns", kind.INT64, [], [10**15]))
        model.graph.initializer.append(helper.make_tensor("true", kind.BOOL, [], [True]))
        last = next(node for node in model.graph.node if out.name in node.output)
        last.output[0] = "before"
        model.graph.node.append(helper.make_node("Loop", ["turns", "true", "before"], [out.name], body=body))

    (tmp_path / "endless.onnx").write_bytes(edited(endless))
    program = f"""
from jtqd.estimator import onnx_graph
from jtqd.estimator.network import TorqueNetwork
onnx_graph._LONGEST_S = 0.3
try:
    TorqueNetwork({str(tmp_path / "endless.onnx")!r})
except onnx_graph.NetworkError as error:
    print(error)
"""
    result = subprocess.run(
        [sys.executable, "-c", program], check=False, capture_output=True, text=True, timeout=30
    )
    assert "endless.onnx: found no answer within 0.3 s, expected one: it is not used" in result.stdout


def test_a_step_that_blocks_is_refused_although_it_takes_no_processor_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    graph, released = TorqueNetwork(small_network().data)._graph, threading.Event()
    monkeypatch.setattr(onnx_graph, "_LONGEST_S", 0.05)
    try:
        with pytest.raises(NetworkError, match=r"found no answer within 0\.05 s"):
            graph._answered(lambda: released.wait(20.0))
    finally:
        released.set()


def test_wrong_shapes_types_and_names() -> None:
    def fixed_batch(model: onnx.ModelProto) -> None:
        model.graph.input[0].type.tensor_type.shape.dim[0].dim_value = 1

    def renamed(model: onnx.ModelProto) -> None:
        model.graph.input[0].name = model.graph.node[0].input[0] = "features"

    assert "of shape [1, 6], expected ['N', 6]" in refused(edited(fixed_batch))
    assert "found inputs ['features'], expected one, 'x'" in refused(edited(renamed))
    meta = small_network().metadata
    seven = export_network([(np.ones((7, 1)), np.zeros(1))], np.zeros(7), np.ones(7), 0.0, 1.0, meta)
    assert "found input 'x' of shape ['N', 7], expected ['N', 6]" in refused(seven)


def test_float32_is_refused() -> None:
    helper = onnx.helper
    kind = onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        [helper.make_node("ReduceSum", ["x", "axes"], ["y"])],
        "g",
        [helper.make_tensor_value_info("x", kind, ["N", 6])],
        [helper.make_tensor_value_info("y", kind, ["N", 1])],
        [onnx.numpy_helper.from_array(np.array([1], np.int64), "axes")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, {k: json.dumps(v) for k, v in small_network().metadata.items()})
    message = refused(model.SerializeToString())
    assert "found input 'x' of type tensor(float), expected tensor(double)" in message


def with_weight(value: float, name: str = "W1") -> Callable[[onnx.ModelProto], None]:
    """Put a value into the middle of an initializer."""

    def edit(model: onnx.ModelProto) -> None:
        tensor = next(each for each in model.graph.initializer if each.name == name)
        values = onnx.numpy_helper.to_array(tensor).copy()
        values.flat[values.size // 2] = value
        tensor.CopyFrom(onnx.numpy_helper.from_array(values, name))

    return edit


def with_last(model: onnx.ModelProto, *nodes: onnx.NodeProto) -> None:
    """Append nodes that make the answer of "before", which is the answer so far."""
    model.graph.node[-1].output[0] = "before"
    model.graph.node.extend(nodes)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_weights_that_are_not_finite_are_refused_although_a_layer_hides_them(value: float) -> None:
    words = "found weights 'W1' with a value that is not finite"
    assert words in refused(edited(with_weight(value)))
    kind, answer = onnx.TensorProto, onnx.load_from_string(small_network().data).graph.output[0].name

    def hidden(model: onnx.ModelProto) -> None:
        with_weight(value)(model)
        model.graph.initializer.append(onnx.helper.make_tensor("zero", kind.DOUBLE, [], [0.0]))
        with_last(model, onnx.helper.make_node("Mul", ["before", "zero"], [answer]))

    assert words in refused(edited(hidden))


@pytest.mark.parametrize(
    "kind", [onnx.TensorProto.FLOAT, onnx.TensorProto.FLOAT16, onnx.TensorProto.BFLOAT16]
)
@pytest.mark.parametrize("raw", [True, False])
def test_constants_of_a_node_are_looked_at_too(kind: int, raw: bool) -> None:
    helper, answer = onnx.helper, onnx.load_from_string(small_network().data).graph.output[0].name

    def constant(value: float) -> Callable[[onnx.ModelProto], None]:
        tensor = helper.make_tensor("c", kind, [], [value])
        if raw:
            tensor = onnx.numpy_helper.from_array(onnx.numpy_helper.to_array(tensor), "c")

        def edit(model: onnx.ModelProto) -> None:
            with_last(
                model,
                helper.make_node("Constant", [], ["small"], value=tensor),
                helper.make_node("Cast", ["small"], ["wide"], to=onnx.TensorProto.DOUBLE),
                helper.make_node("Min", ["before", "wide"], [answer]),
            )

        return edit

    assert "found weights 'c' with a value that is not finite" in refused(edited(constant(math.inf)))
    assert TorqueNetwork(edited(constant(1000.0))).perceptron is None


def test_weights_in_another_file_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The SHA-256 is of the graph alone then: whoever changes the other file changes the network unseen."""
    monkeypatch.chdir(tmp_path)

    def external(model: onnx.ModelProto) -> None:
        tensor = model.graph.initializer[0]
        Path("weights.bin").write_bytes(tensor.raw_data)
        tensor.ClearField("raw_data")
        tensor.data_location = onnx.TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="weights.bin")

    assert "found weights 'W0' in another file, expected them in this one" in refused(edited(external))


def test_a_network_that_gives_nan_is_refused() -> None:
    answer = onnx.load_from_string(small_network().data).graph.output[0].name

    def root(model: onnx.ModelProto) -> None:
        """Of minus the answer's size."""
        steps = (("Abs", "before", "size"), ("Neg", "size", "less"), ("Sqrt", "less", answer))
        with_last(model, *(onnx.helper.make_node(name, [x], [y]) for name, x, y in steps))

    assert "found nan at the centre of its envelope" in refused(edited(root))


def test_a_graph_that_draws_lots_is_refused() -> None:
    answer = onnx.load_from_string(small_network().data).graph.output[0].name

    def drawn(model: onnx.ModelProto) -> None:
        like = onnx.helper.make_node("RandomNormalLike", ["before"], ["lot"], dtype=onnx.TensorProto.DOUBLE)
        with_last(model, like, onnx.helper.make_node("Add", ["before", "lot"], [answer]))

    assert "found different answers to one input" in refused(edited(drawn))


def test_the_writer_refuses_what_does_not_fit() -> None:
    ok = [(np.ones((6, 1)), np.zeros(1))]
    zero, one = np.zeros(6), np.ones(6)
    for weights, std, output_std in (
        ([(np.ones((6, 2)), np.zeros(2))], one, 1.0),
        ([(np.ones((5, 1)), np.zeros(1))], one, 1.0),
        ([(np.ones((6, 1)), np.zeros(2))], one, 1.0),
        ([], one, 1.0),
        (ok, zero, 1.0),
        (ok, np.ones(5), 1.0),
        (ok, one, 0.0),
    ):
        with pytest.raises(ValueError, match="found"):
            export_network(weights, zero, std, 0.0, output_std, {})


def fused_refused(data: bytes | Path) -> str:
    with pytest.raises(NetworkError) as caught:
        FusedNetwork(data)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_metadata_and_hash_of_a_fused_network(tmp_path: Path) -> None:
    path = tmp_path / "ours.onnx"
    path.write_bytes(fused_network().data)
    network = FusedNetwork(path)
    assert (network.joint, network.data_sha256, network.sigma_scale) == (
        "joint1",
        "cd" * 32,
        (0.5, 0.6, 0.7, 0.8),
    )
    assert network.envelope == everywhere()
    assert network.name == str(path)
    assert FusedNetwork(path, network.sha256).sha256 == network.sha256
    with pytest.raises(NetworkError, match="expected 0000"):
        FusedNetwork(path, "0" * 64)


def test_fused_sample_many_and_numpy_agree() -> None:
    small = fused_network(5, noise=0.8, size_nm=4.0)
    network = FusedNetwork(small.data)
    x = np.random.default_rng(6).uniform(FUSED_LOW, FUSED_HIGH, (1500, 7)) * 1.5
    expected = small.numpy(x)
    assert np.ptp(expected) > 1.0
    assert network.bound
    assert np.max(np.abs(network.run_many(x) - expected)) < 1e-9
    assert np.max(np.abs(expected - [network.run_one(*row) for row in x.tolist()])) < 1e-9
    assert math.isnan(network.run_one(math.nan, *[0.0] * 6))
    assert network.run_one(*x[0].tolist()) == pytest.approx(
        expected[0], abs=1e-9
    )  # NaN leaves nothing behind


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        *((key, ..., f"metadata '{key}': missing") for key in fused_network().metadata),
        ("features", list(FUSED_FEATURES)[::-1], "metadata 'features': found ['sin_4"),
        (
            "envelope",
            everywhere().to_mapping() | {"distance_nm": 0},
            "metadata 'envelope': distance_nm: found 0",
        ),
        ("envelope", 7, "metadata 'envelope': found 7, expected the keys"),
        (
            "sigma_scale",
            [1.0] * 3,
            "metadata 'sigma_scale': found [1.0, 1.0, 1.0], expected 4 finite numbers",
        ),
        (
            "sigma_scale",
            [1.0, 1.0, -0.1, 1.0],
            "metadata 'sigma_scale': found [1.0, 1.0, -0.1, 1.0], expected numbers",
        ),
        ("sigma_scale", [1.0, 1.0, math.nan, 1.0], "expected 4 finite numbers"),
        ("input_low", [0.0] * 8, "metadata 'input_low': found"),
        ("input_high", [*FUSED_HIGH[:8], math.inf], "metadata 'input_high': found"),
        (
            "input_low",
            [9.0, *FUSED_LOW[1:]],
            "range of joint_velocity_rad_s: found input_low 9 above input_high 3.5",
        ),
        ("joint", "", "metadata 'joint': found ''"),
        ("joint", 1, "metadata 'joint': found 1, expected a text"),
        ("data_sha256", None, "metadata 'data_sha256': found None"),
    ],
)
def test_wrong_metadata_of_a_fused_network(key: str, value: object, words: str) -> None:
    message = fused_refused(fused_network(**{key: value}).data)
    assert message.startswith("network (bytes): ")
    assert words in message


def test_wrong_graphs_of_a_fused_network() -> None:
    assert "expected ['N', 7]" in fused_refused(
        export_network(
            [(np.ones((6, 1)), np.zeros(1))], np.zeros(6), np.ones(6), 0.0, 1.0, fused_network().metadata
        )
    )
    small = fused_network()
    w, b = small.layers[-1]
    nan = SmallNetwork((*small.layers[:-1], (w * np.nan, b)), small.mean, small.std, 0.0, 1.0, small.metadata)
    assert "with a value that is not finite" in fused_refused(nan.data)


def test_the_two_kinds_are_not_mistaken_for_each_other() -> None:
    assert "expected ['N', 7]" in fused_refused(small_network().data)
    with pytest.raises(NetworkError, match=r"expected \['N', 6\]"):
        TorqueNetwork(fused_network().data)
