"""Native evaluation against ONNX Runtime, which of the graphs are evaluated natively, and what happens to the others."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.estimator import FusedEstimator, JointEstimator
from jtqd.estimator.network import FusedNetwork, TorqueNetwork, native_of
from jtqd.estimator.onnx_graph import NetworkError
from jtqd.estimator.onnx_weights import read_perceptron
from jtqd.estimator.perceptron import Perceptron, tanh_many
from jtqd.estimator.settings import EstimatorSettings
from jtqd.sysid.train.network import export_network
from tests.estimator.estimator_helpers import joint1, motion, small_network
from tests.estimator.fused_helpers import fused_joint, fused_network


def layers(seed: int, *widths: int) -> list[tuple[FloatArray, FloatArray]]:
    rng = np.random.default_rng(seed)
    pairs = itertools.pairwise(widths)
    return [(rng.normal(size=(m, n)), rng.normal(size=n)) for m, n in pairs]


def numpy_answer(parts: list[tuple[FloatArray, FloatArray]], x: FloatArray) -> FloatArray:
    for w, b in parts[:-1]:
        x = np.tanh(x @ w + b)
    w, b = parts[-1]
    answer: FloatArray = x @ w + b
    return answer


@pytest.mark.parametrize(
    "widths", [(6, 1), (6, 20, 40, 10, 1), (1, 1, 1), (3, 128, 1), (9, 7, 6, 5, 4, 3, 2, 2, 1)]
)
def test_plain_and_gated_against_numpy(widths: tuple[int, ...]) -> None:
    x = np.random.default_rng(5).normal(size=(200, widths[0])) * 2.0
    plain = layers(1, *widths)
    many = Perceptron(plain).run_many(x)
    assert many == pytest.approx(numpy_answer(plain, x)[:, 0], abs=1e-11)
    assert many.tolist() == [Perceptron(plain).run_one(*row) for row in x.tolist()]
    gate = [widths[0] - 1, 0, 0]
    gated = layers(2, *widths[:-1], 3)
    expected = (numpy_answer(gated, x) * x[:, gate]).sum(axis=1)
    assert Perceptron(gated, gate).run_many(x) == pytest.approx(expected, abs=1e-11)


def test_the_tangent_is_within_4e_16_odd_and_keeps_nan() -> None:
    rng = np.random.default_rng(1)
    x = np.concatenate(
        [np.linspace(-25.0, 25.0, 100_001), rng.normal(size=50_000), np.logspace(-300, 300, 5000)]
    )
    found = tanh_many(x)
    assert np.max(np.abs(found - [math.tanh(each) for each in x.tolist()])) < 4e-16
    assert np.array_equal(tanh_many(-x), -found)
    assert np.max(np.abs(found)) == 1.0
    edges = tanh_many(np.array([0.0, -0.0, math.inf, -math.inf, math.nan])).tolist()
    assert edges[:4] == [0.0, 0.0, 1.0, -1.0]
    assert math.copysign(1.0, edges[1]) == -1.0
    assert math.isnan(edges[4])


def test_what_does_not_fit_is_refused() -> None:
    assert Perceptron.fits(layers(1, 6, 128, 1))
    for widths in ((6, 129, 1), (6, *[4] * 8, 1), (6, 100, 100, 1)):
        assert not Perceptron.fits(layers(1, *widths))
        with pytest.raises(ValueError, match="too large"):
            Perceptron(layers(1, *widths))
    with pytest.raises(ValueError, match="found 2 outputs, expected 1"):
        Perceptron(layers(1, 6, 2))
    with pytest.raises(ValueError, match="found gate 6"):
        Perceptron(layers(1, 6, 1), [6])
    with pytest.raises(ValueError, match="found weights"):
        Perceptron([*layers(1, 6, 4), *layers(1, 5, 1)])
    with pytest.raises(ValueError, match="found 5 inputs, expected 6"):
        Perceptron(layers(1, 6, 1)).run_one(*[0.0] * 5)


def test_our_files_are_read_as_onnx_runtime_evaluates_them() -> None:
    for seed in range(4):
        paper = TorqueNetwork(small_network(seed, noise=0.3).data)
        fused = FusedNetwork(fused_network(seed, size_nm=4.0).data)
        for network, width in ((paper, 6), (fused, 7)):
            assert network.perceptron is not None
            assert network.native_error_nm() < 1e-11
            x = np.random.default_rng(seed).normal(size=(500, width)) * 3.0
            assert network.perceptron.run_many(x) == pytest.approx(network.run_many(x), abs=1e-11)


def changed(change: Any) -> bytes:
    model = onnx.load_from_string(small_network(3, noise=0.3).data)
    change(model.graph)
    data: bytes = model.SerializeToString()
    return data


def _other_operator(graph: Any) -> None:
    graph.node[1].op_type = "Sigmoid"


def _attribute(graph: Any) -> None:
    graph.node[0].attribute.append(helper.make_attribute("alpha", 0.5))


def _float32(graph: Any) -> None:
    weights = numpy_helper.to_array(graph.initializer[0])
    graph.initializer[0].CopyFrom(
        numpy_helper.from_array(weights.astype(np.float32), graph.initializer[0].name)
    )


def _one_node_more(graph: Any) -> None:
    last = graph.node[-1]
    answer, last.output[0] = last.output[0], "before"
    graph.node.append(helper.make_node("Neg", ["before"], [answer]))


def _tanh_at_the_end(graph: Any) -> None:
    last = graph.node[-1]
    answer, last.output[0] = last.output[0], "before"
    graph.node.append(helper.make_node("Tanh", ["before"], [answer]))


def _other_source(graph: Any) -> None:
    graph.node[2].input[0] = "x"


FOREIGN = [_other_operator, _attribute, _float32, _one_node_more, _tanh_at_the_end, _other_source]


@pytest.mark.parametrize("change", FOREIGN)
def test_another_graph_is_not_evaluated_natively(change: Any) -> None:
    assert read_perceptron(changed(lambda graph: None)) is not None
    assert read_perceptron(changed(change)) is None


def test_damaged_bytes_are_no_network_and_no_traceback() -> None:
    good, rng = fused_network(1).data, np.random.default_rng(17)
    for end in range(0, len(good), 97):
        assert read_perceptron(good[:end]) is None
    for _ in range(400):
        data = bytearray(good)
        for _ in range(rng.integers(1, 6)):
            data[rng.integers(0, len(data))] = rng.integers(0, 256)
        read_perceptron(bytes(data))  # None, or numbers that the comparison judges


def test_weights_as_a_list_of_doubles_are_read_too() -> None:
    def change(graph: Any) -> None:
        for each in graph.initializer:
            values = numpy_helper.to_array(each)
            each.CopyFrom(
                helper.make_tensor(each.name, TensorProto.DOUBLE, values.shape, values.ravel().tolist())
            )

    network = TorqueNetwork(changed(change))
    assert network.perceptron is not None
    assert network.native_error_nm() < 1e-11


@pytest.mark.parametrize("wrong", [1e-4, math.nan])
def test_a_native_evaluation_that_differs_is_refused(wrong: float) -> None:
    joint, small = joint1(), small_network(3, noise=0.3)
    network = TorqueNetwork(small.data)
    assert native_of(network, joint) is network.perceptron
    bent = list(small.layers)
    bent[-1] = (bent[-1][0], bent[-1][1] + wrong)
    other = read_perceptron(replace(small, layers=tuple(bent)).data)
    network._graph.perceptron = other  # type: ignore[misc]
    network.perceptron = other  # type: ignore[misc]
    with pytest.raises(NetworkError, match="native evaluation and ONNX Runtime"):
        JointEstimator(joint, EstimatorSettings(), network)


def test_a_foreign_graph_gives_the_same_estimates_through_onnx_runtime() -> None:
    """Neg(Neg(answer)) is none of ours; the estimates of a run agree to rounding."""

    def twice(graph: Any) -> None:
        _one_node_more(graph)
        last = graph.node[-1]
        answer, last.output[0] = last.output[0], "negative"
        graph.node.append(helper.make_node("Neg", ["negative"], [answer]))

    native, foreign = TorqueNetwork(changed(lambda graph: None)), TorqueNetwork(changed(twice))
    assert foreign.perceptron is None
    runs = [
        JointEstimator(joint1(), EstimatorSettings(), each).run(*motion(2, 2000).arrays())
        for each in (native, foreign)
    ]
    assert np.isfinite(runs[0].network_nm).sum() > 500
    for name in ("torque_nm", "sigma_nm", "network_nm", "physics_nm"):
        assert getattr(runs[0], name) == pytest.approx(getattr(runs[1], name), abs=1e-9, nan_ok=True)
    assert np.array_equal(runs[0].status, runs[1].status)


def test_a_network_that_raises_is_physics_only() -> None:
    class Raises:
        joint, sigma_scale, name = "joint1", (1.0,) * 4, "raises"
        envelope = FusedNetwork(fused_network().data).envelope

        def run_one(self, *_: float) -> float:
            raise RuntimeError("no memory")

    joint = fused_joint()
    m = motion(2, 2000)
    run = FusedEstimator(joint, EstimatorSettings(method="fused"), Raises()).run(*m.arrays())  # type: ignore[arg-type]
    alone = FusedEstimator(joint, EstimatorSettings(method="fused")).run(*m.arrays())
    assert np.array_equal(run.torque_nm, alone.torque_nm, equal_nan=True)
    assert not np.isfinite(run.network_nm).any()


def test_exported_networks_of_the_trainer_are_ours() -> None:
    data = export_network(layers(4, 6, 5, 1), np.zeros(6), np.ones(6), 0.0, 1.0, small_network().metadata)
    assert read_perceptron(data) is not None
