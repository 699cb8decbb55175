"""Network files of both kinds: exported graph against numpy, weights in the metadata, and every way a file can be wrong."""

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
from onnx import TensorProto, helper, numpy_helper

from jtqd.estimator import network as network_module
from jtqd.estimator.decoder import plain_values
from jtqd.estimator.estimator import FusedEstimator, JointEstimator
from jtqd.estimator.native_network import INPUTS
from jtqd.estimator.network import (
    FEATURES,
    PERCEPTRON,
    NetworkError,
    PathNetwork,
    TorqueNetwork,
    native_of,
)
from jtqd.estimator.settings import EstimatorSettings
from jtqd.sysid.train.network import Trained, export_network
from tests.estimator.estimator_helpers import HIGH, LOW, SmallNetwork, joint1, motion, small_network
from tests.estimator.fused_helpers import HIGH as FUSED_HIGH
from tests.estimator.fused_helpers import LOW as FUSED_LOW
from tests.estimator.fused_helpers import (
    OWN,
    QUICK_LIMITS,
    REST_NM,
    TRACKED,
    FakeNetwork,
    everywhere,
    fused_joint,
    fused_network,
)
from tests.paths import ROOT

Change = Callable[[onnx.ModelProto], None]


def inputs(count: int, seed: int = 2) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.random.default_rng(seed).normal(size=(count, 6)) * 2.0 * np.array(HIGH)


def edited(change: Change, small: SmallNetwork | None = None, *, weights: bool = False) -> bytes:
    """Return a changed file, without the weights in its metadata unless asked for."""
    model = onnx.load_from_string((small or small_network(3, noise=0.3)).data)
    if not weights:
        model.metadata_props.remove(entry(model, PERCEPTRON))
    change(model)
    data: bytes = model.SerializeToString()
    return data


def entry(model: onnx.ModelProto, key: str) -> Any:
    return next(each for each in model.metadata_props if each.key == key)


def nothing(model: onnx.ModelProto) -> None:
    pass


def refused(source: bytes | Path, kind: Any = TorqueNetwork, **options: Any) -> str:
    with pytest.raises(NetworkError) as caught:
        kind(source, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


# ---- values


def test_the_graph_is_the_paper_s_network() -> None:
    """Weights well into saturation, so that tanh(x) instead of tanh(x/2) would be far off."""
    saturated = small_network(3, noise=0.9)
    network = TorqueNetwork(saturated.data)
    x = inputs(500)
    expected = saturated.numpy(x)
    assert np.ptp(expected) > 1.0
    assert np.max(np.abs(network.run_many(x) - expected)) < 1e-9 * np.max(np.abs(expected))


def test_a_network_by_hand() -> None:
    """One hidden neuron: x = 2 -> (2-1)/0.5 = 2 -> 3*2+1 = 7 -> tanh(3.5) -> 4*()-1 -> *10+5."""
    w0 = np.zeros((6, 1))
    w0[0, 0] = 3.0
    mean, std = np.zeros(6), np.ones(6)
    mean[0], std[0] = 1.0, 0.5
    layers = [(w0, np.array([1.0])), (np.array([[4.0]]), np.array([-1.0]))]
    data = export_network(Trained(layers, mean, std, 5.0, 10.0), small_network().metadata)
    expected = 5.0 + 10.0 * (4.0 * math.tanh(3.5) - 1.0)
    assert TorqueNetwork(data).run_one(2.0, 0.0, 0.0, 0.0, 0.0, 0.0) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("kind", ["network", "fused"])
def test_one_sample_and_many_agree(kind: str) -> None:
    if kind == "network":
        small, network = small_network(4, noise=0.3), TorqueNetwork(small_network(4, noise=0.3).data)
        x = inputs(1500)
    else:
        small = fused_network(5, noise=0.8, size_nm=4.0)
        network = PathNetwork(small.data)
        x = np.random.default_rng(6).uniform(FUSED_LOW, FUSED_HIGH, (1500, 28)) * 1.5
    many = network.run_many(x)
    assert np.max(np.abs(many - small.numpy(x))) < 1e-9
    assert np.max(np.abs(many - [network.run_one(*row) for row in x.tolist()])) < 1e-11
    assert network.run_many(x[:0]).shape == (0,)
    with pytest.raises(ValueError, match=r"\(4, 5\)"):
        network.run_many(np.zeros((4, 5)))
    assert math.isnan(network.run_one(math.nan, *x[0, 1:].tolist()))
    assert network.run_one(*x[0].tolist()) == many[0]  # NaN leaves nothing behind


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


# ---- native evaluation


def test_weights_of_the_metadata_and_of_the_graph_are_those_that_onnx_runtime_evaluates() -> None:
    for seed in range(4):
        for kind, small, width in (
            (TorqueNetwork, small_network(seed, noise=0.3), 6),
            (PathNetwork, fused_network(seed, size_nm=4.0), 28),
        ):
            x = np.random.default_rng(seed).normal(size=(500, width)) * 3.0
            found = []
            for network in (kind(small.data), kind(edited(nothing, small))):
                assert network.perceptron is not None
                assert network.native_error_nm < 1e-11
                assert network.perceptron.run_many(x) == pytest.approx(network.run_many(x), abs=1e-11)
                found.append(network.perceptron.run_many(x).tobytes())
            assert found[0] == found[1]


def test_weights_as_a_list_of_doubles_are_read_too() -> None:
    def change(model: onnx.ModelProto) -> None:
        for each in model.graph.initializer:
            values = numpy_helper.to_array(each)
            each.CopyFrom(
                helper.make_tensor(each.name, TensorProto.DOUBLE, values.shape, values.ravel().tolist())
            )

    assert TorqueNetwork(edited(change)).native_error_nm < 1e-11


def test_without_the_package_onnx_a_file_without_weights_runs_by_onnx_runtime(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with_weights, without = small_network(3, noise=0.3).data, edited(nothing)
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert TorqueNetwork(with_weights).perceptron is not None
    network = TorqueNetwork(without)
    assert (network.perceptron, network.native_error_nm) == (None, None)
    assert native_of(network, joint1()) is None
    x = inputs(50)
    assert network.run_many(x) == pytest.approx(TorqueNetwork(with_weights).run_many(x), abs=1e-11)


def _last(model: onnx.ModelProto, *nodes: tuple[str, str, str]) -> None:
    """Append nodes (operator, input, output); "before" is the answer so far."""
    model.graph.node[-1].output[0] = "before"
    model.graph.node.extend(helper.make_node(name, [x], [y]) for name, x, y in nodes)


def _answer(model: onnx.ModelProto) -> str:
    return str(model.graph.output[0].name)


def other_operator(model: onnx.ModelProto) -> None:
    model.graph.node[1].op_type = "Sigmoid"


def attribute(model: onnx.ModelProto) -> None:
    model.graph.node[0].attribute.append(helper.make_attribute("alpha", 0.5))


def negated_twice(model: onnx.ModelProto) -> None:
    _last(model, ("Neg", "before", "negative"), ("Neg", "negative", _answer(model)))


def tanh_at_the_end(model: onnx.ModelProto) -> None:
    _last(model, ("Tanh", "before", _answer(model)))


def other_source(model: onnx.ModelProto) -> None:
    model.graph.initializer.append(numpy_helper.from_array(np.eye(6), "eye"))
    model.graph.node.insert(0, helper.make_node("MatMul", ["x", "eye"], ["same"]))
    model.graph.node[1].input[0] = "same"


@pytest.mark.parametrize("change", [other_operator, attribute, negated_twice, tanh_at_the_end, other_source])
def test_another_graph_is_not_evaluated_natively(change: Change) -> None:
    network = TorqueNetwork(edited(change))
    assert (network.perceptron, network.native_error_nm) == (None, None)


def test_a_foreign_graph_gives_the_same_estimates_through_onnx_runtime() -> None:
    """The estimates of a run agree to rounding."""
    native, foreign = TorqueNetwork(edited(nothing)), TorqueNetwork(edited(negated_twice))
    runs = [
        JointEstimator(joint1(), EstimatorSettings(), each).run(*motion(2, 2000).arrays())
        for each in (native, foreign)
    ]
    assert np.isfinite(runs[0].network_nm).sum() > 500
    for name in ("torque_nm", "sigma_nm", "network_nm", "physics_nm"):
        assert getattr(runs[0], name) == pytest.approx(getattr(runs[1], name), abs=1e-9, nan_ok=True)
    assert np.array_equal(runs[0].status, runs[1].status)


def test_a_network_that_raises_is_physics_only() -> None:
    class Raises(FakeNetwork):
        def run_one(self, *_: float) -> float:
            raise RuntimeError("no memory")

    joint, m = fused_joint(), motion(2, 2000)
    run = FusedEstimator(joint, TRACKED, Raises(lambda *_: 0.0)).run(*m.arrays())  # type: ignore[arg-type]
    alone = FusedEstimator(joint, TRACKED).run(*m.arrays())
    assert np.array_equal(run.torque_nm, alone.torque_nm, equal_nan=True)
    assert not np.isfinite(run.network_nm).any()


def with_weight(value: float, name: str = "W1") -> Change:
    """Put a value into the middle of an initializer."""

    def edit(model: onnx.ModelProto) -> None:
        tensor = next(each for each in model.graph.initializer if each.name == name)
        values = numpy_helper.to_array(tensor).copy()
        values.flat[values.size // 2] = value
        tensor.CopyFrom(numpy_helper.from_array(values, name))

    return edit


@pytest.mark.parametrize("value", [0.3, math.inf])
def test_a_graph_that_is_not_that_of_its_weights_is_refused(value: float) -> None:
    network = TorqueNetwork(edited(with_weight(value), small_network(), weights=True))
    with pytest.raises(NetworkError, match="native evaluation and ONNX Runtime"):
        JointEstimator(joint1(), EstimatorSettings(), network)


# ---- refusals


def test_metadata_and_hash(tmp_path: Path) -> None:
    path, ours = tmp_path / "a.onnx", tmp_path / "ours.onnx"
    path.write_bytes(small_network().data)
    ours.write_bytes(fused_network().data)
    network, fused = TorqueNetwork(path), PathNetwork(ours)
    assert (network.envelope_low, network.envelope_high) == (LOW, HIGH)
    assert (network.sigma_nm, network.joint, network.data_sha256) == (0.31, "joint1", "ab" * 32)
    assert TorqueNetwork(path, sha256=network.sha256.upper()).sha256 == network.sha256
    message = refused(path, sha256="0" * 64)
    assert message.startswith(f"{path}: found SHA-256 {network.sha256}, expected 000")
    assert (fused.joint, fused.data_sha256, fused.sigma) == ("joint1", "cd" * 32, OWN)
    assert (fused.envelope, fused.rest_nm, fused.quick, fused.name) == (
        everywhere(),
        REST_NM,
        QUICK_LIMITS,
        str(ours),
    )


def test_unreadable_and_corrupt_files(tmp_path: Path) -> None:
    absent = tmp_path / "no.onnx"
    assert refused(absent).startswith(f"{absent}: cannot be read: No such file")
    assert "cannot be read" in refused(tmp_path)
    data = small_network().data
    rng = np.random.default_rng(8)
    for bad in (b"", b"\x00", b"not a model", data[: len(data) // 2], data[:-1], rng.bytes(5000)):
        assert refused(bad).startswith("network (bytes): ")


@pytest.mark.parametrize("weights", [True, False], ids=["weights in the metadata", "weights in the graph"])
def test_flipped_bytes_never_give_another_exception(weights: bool) -> None:
    seed = 99
    rng = np.random.default_rng(seed)
    good = edited(nothing, weights=weights)
    for round_ in range(100):
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


FUSED_KEYS = fused_network().metadata


@pytest.mark.parametrize(
    ("kind", "key", "value", "words"),
    [
        ("network", "features", ..., "metadata 'features': missing"),
        ("network", "features", list(FEATURES)[::-1], "metadata 'features': found ['efficiency_torque_nm'"),
        ("network", "envelope_low", [0.0] * 5, "expected 6 finite numbers"),
        ("network", "envelope_high", [*HIGH[:5], math.nan], "expected 6 finite numbers"),
        (
            "network",
            "envelope_high",
            [-7.0, *HIGH[1:]],
            "range of current_a: found envelope_low -6 above envelope_high -7",
        ),
        ("network", "sigma_nm", 0.0, "metadata 'sigma_nm': found 0.0, expected a number in Nm > 0"),
        ("network", "sigma_nm", "0.3", "metadata 'sigma_nm': found '0.3'"),
        ("network", "joint", "", "metadata 'joint': found ''"),
        ("network", "joint", ..., "metadata 'joint': missing"),
        (
            "network",
            "joint",
            "\x1b[31mjoint1",
            "metadata 'joint': found '\\x1b[31mjoint1', expected a text of printable characters",
        ),
        ("network", "data_sha256", 5, "metadata 'data_sha256': found 5"),
        *(("fused", key, ..., f"metadata '{key}': missing") for key in FUSED_KEYS),
        ("fused", "features", list(INPUTS)[::-1], "metadata 'features': found ['stop_by_velocity"),
        (
            "fused",
            "envelope",
            everywhere().to_mapping() | {"distance_nm": 0},
            "metadata 'envelope': distance_nm: found 0",
        ),
        ("fused", "envelope", 7, "metadata 'envelope': found 7, expected a mapping"),
        ("fused", "sigma", 7, "metadata 'sigma': found 7, expected a mapping"),
        (
            "fused",
            "sigma",
            plain_values(OWN) | {"scale": [1.0] * 3},
            "metadata 'sigma': scale: found 3 numbers, expected a list of 4",
        ),
        ("fused", "sigma", plain_values(OWN) | {"scale": [1.0, 1.0, -0.1, 1.0]}, "expected 4 numbers > 0"),
        (
            "fused",
            "rest_nm",
            [0.0],
            "metadata 'rest_nm', 'quick': found [0.0, 400.0, 80.0, 80.0], expected numbers > 0",
        ),
        ("fused", "quick", [1.0, 1.0], "metadata 'quick': found [1.0, 1.0], expected 3 finite numbers"),
        ("fused", "input_low", [0.0] * 8, "metadata 'input_low': found"),
        ("fused", "input_high", [*FUSED_HIGH[:8], math.inf], "metadata 'input_high': found"),
        (
            "fused",
            "input_low",
            [90.0, *FUSED_LOW[1:]],
            "range of torque_nm: found input_low 90 above input_high 50",
        ),
        ("fused", "joint", 1, "metadata 'joint': found 1, expected a text"),
        ("fused", "data_sha256", None, "metadata 'data_sha256': found None"),
    ],
)
def test_wrong_metadata(kind: str, key: str, value: object, words: str) -> None:
    if kind == "network":
        message = refused(small_network().with_metadata(**{key: value}).data)
    else:
        message = refused(fused_network(**{key: value}).data, PathNetwork)
    assert message.startswith("network (bytes): ")
    assert words in message


@pytest.mark.parametrize(
    ("key", "text", "words"),
    [
        ("sigma_nm", "0.3 Nm", "metadata 'sigma_nm': found '0.3 Nm', expected JSON"),
        ("sigma_nm", "[" * 100_000, "metadata 'sigma_nm': found '[[["),
        (PERCEPTRON, "7", "found no layers"),
        (PERCEPTRON, "{}", "found no layers"),
        (PERCEPTRON, '{"widths": [6, 1], "numbers": ["?"]}', "found no layers"),
        (PERCEPTRON, '{"widths": [6, 1], "numbers": ["AAAA"]}', "buffer size"),
        (
            PERCEPTRON,
            '{"widths": [6, 1], "numbers": []}',
            "found numbers of 0 layers, expected 1",
        ),
        (PERCEPTRON, '{"widths": [], "numbers": []}', "at least 2 whole numbers"),
        (PERCEPTRON, '{"widths": [6, -1], "numbers": [""]}', "at least 2 whole numbers"),
        (PERCEPTRON, '{"widths": [6, 1e9], "numbers": [""]}', "at least 2 whole numbers"),
        (PERCEPTRON, '{"widths": [6, 1], "numbers": ["AAAAAAAA+H8="]}', "not finite"),
        (
            PERCEPTRON,
            '{"widths": [1, 1], "numbers": ["AAAAAAAAAAAAAAAAAAAAAA=="]}',
            "found 1 inputs, expected 6",
        ),
    ],
)
def test_metadata_that_cannot_be_read(key: str, text: str, words: str) -> None:
    def spoil(model: onnx.ModelProto) -> None:
        entry(model, key).value = text

    assert words in refused(edited(spoil, weights=True))


def test_a_graph_that_does_not_answer_is_refused(tmp_path: Path) -> None:
    """It is well-formed, and has a loop of 10^15 turns inside; the process that refuses it can end."""
    kind = TensorProto
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
        model.graph.initializer.append(helper.make_tensor("turns", kind.INT64, [], [10**15]))
        model.graph.initializer.append(helper.make_tensor("true", kind.BOOL, [], [True]))
        _last(model)
        model.graph.node.append(
            helper.make_node("Loop", ["turns", "true", "before"], [_answer(model)], body=body)
        )

    (tmp_path / "endless.onnx").write_bytes(edited(endless))
    program = f"""
from jtqd.estimator import network
network._LONGEST_S = 0.3
try:
    network.TorqueNetwork({str(tmp_path / "endless.onnx")!r})
except network.NetworkError as error:
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
    monkeypatch.setattr(network_module, "_LONGEST_S", 0.05)
    try:
        with pytest.raises(NetworkError, match=r"found no answer within 0\.05 s"):
            graph._answered(lambda: released.wait(20.0))  # type: ignore[attr-defined]
    finally:
        released.set()


def fixed_batch(model: onnx.ModelProto) -> None:
    model.graph.input[0].type.tensor_type.shape.dim[0].dim_value = 1


def renamed(model: onnx.ModelProto) -> None:
    model.graph.input[0].name = model.graph.node[0].input[0] = "features"


def drawn(model: onnx.ModelProto) -> None:
    model.graph.node[-1].output[0] = "before"
    like = helper.make_node("RandomNormalLike", ["before"], ["lot"], dtype=TensorProto.DOUBLE)
    model.graph.node.extend((like, helper.make_node("Add", ["before", "lot"], [_answer(model)])))


def root(model: onnx.ModelProto) -> None:
    """Of minus the answer's size."""
    _last(model, ("Abs", "before", "size"), ("Neg", "size", "less"), ("Sqrt", "less", _answer(model)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (fixed_batch, "of shape [1, 6], expected ['N', 6]"),
        (renamed, "found inputs ['features'], expected one, 'x'"),
        (drawn, "found different answers to one input"),
        (root, "found nan at the centre of its envelope"),
    ],
)
def test_graphs_that_cannot_be_used(change: Change, words: str) -> None:
    assert words in refused(edited(change))


def test_networks_of_another_width_or_type() -> None:
    meta = small_network().metadata
    seven = export_network(Trained([(np.ones((7, 1)), np.zeros(1))], np.zeros(7), np.ones(7), 0.0, 1.0), meta)
    assert "found input 'x' of shape ['N', 7], expected ['N', 6]" in refused(seven)
    assert "expected ['N', 28]" in refused(small_network().data, PathNetwork)
    assert "expected ['N', 6]" in refused(fused_network().data)
    graph = helper.make_graph(
        [helper.make_node("ReduceSum", ["x", "axes"], ["y"])],
        "g",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["N", 6])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["N", 1])],
        [numpy_helper.from_array(np.array([1], np.int64), "axes")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, {k: json.dumps(v) for k, v in meta.items()})
    message = refused(model.SerializeToString())
    assert "found input 'x' of type tensor(float), expected tensor(double)" in message


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_weights_that_are_not_finite_are_refused_although_a_layer_hides_them(value: float) -> None:
    words = "found weights 'W1' with a value that is not finite"
    assert words in refused(edited(with_weight(value)))

    def hidden(model: onnx.ModelProto) -> None:
        with_weight(value)(model)
        model.graph.initializer.append(helper.make_tensor("zero", TensorProto.DOUBLE, [], [0.0]))
        _last(model)
        model.graph.node.append(helper.make_node("Mul", ["before", "zero"], [_answer(model)]))

    assert words in refused(edited(hidden))


@pytest.mark.parametrize("kind", [TensorProto.FLOAT, TensorProto.FLOAT16, TensorProto.BFLOAT16])
@pytest.mark.parametrize("raw", [True, False])
def test_constants_of_a_node_are_looked_at_too(kind: int, raw: bool) -> None:
    def constant(value: float) -> Change:
        tensor = helper.make_tensor("c", kind, [], [value])
        if raw:
            tensor = numpy_helper.from_array(numpy_helper.to_array(tensor), "c")

        def edit(model: onnx.ModelProto) -> None:
            _last(model)
            model.graph.node.extend(
                (
                    helper.make_node("Constant", [], ["small"], value=tensor),
                    helper.make_node("Cast", ["small"], ["wide"], to=TensorProto.DOUBLE),
                    helper.make_node("Min", ["before", "wide"], [_answer(model)]),
                )
            )

        return edit

    assert "found weights 'c' with a value that is not finite" in refused(edited(constant(math.inf)))
    assert TorqueNetwork(edited(constant(1000.0))).perceptron is None


@pytest.mark.parametrize("weights", [True, False])
def test_weights_in_another_file_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights: bool
) -> None:
    """The SHA-256 is of the graph alone then: a change of the other file would change the network unseen."""
    monkeypatch.chdir(tmp_path)

    def external(model: onnx.ModelProto) -> None:
        tensor = model.graph.initializer[0]
        Path("weights.bin").write_bytes(tensor.raw_data)
        tensor.ClearField("raw_data")
        tensor.data_location = TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="weights.bin")

    message = refused(edited(external, weights=weights))
    assert "not a usable ONNX model" in message
    assert "W0" in message


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
            export_network(Trained(weights, zero, std, 0.0, output_std), {})
