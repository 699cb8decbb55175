"""Our network's file: what is read from it, one sample against many, and every wrong file in one line."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from jtqd.estimator.network import FUSED_FEATURES, FusedNetwork, TorqueNetwork
from jtqd.estimator.onnx_graph import NetworkError
from jtqd.sysid.train.network import export_network
from tests.estimator.estimator_helpers import SmallNetwork, small_network
from tests.estimator.fused_helpers import HIGH, LOW, everywhere, fused_network


def refused(data: bytes | Path) -> str:
    with pytest.raises(NetworkError) as caught:
        FusedNetwork(data)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_what_the_file_says(tmp_path: Path) -> None:
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


def test_one_sample_many_and_numpy_agree() -> None:
    small = fused_network(5, noise=0.8, size_nm=4.0)
    network = FusedNetwork(small.data)
    x = np.random.default_rng(6).uniform(LOW, HIGH, (1500, 7)) * 1.5
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
        ("input_high", [*HIGH[:8], math.inf], "metadata 'input_high': found"),
        (
            "input_low",
            [9.0, *LOW[1:]],
            "range of joint_velocity_rad_s: found input_low 9 above input_high 3.5",
        ),
        ("joint", "", "metadata 'joint': found ''"),
        ("joint", 1, "metadata 'joint': found 1, expected a text"),
        ("data_sha256", None, "metadata 'data_sha256': found None"),
    ],
)
def test_wrong_metadata(key: str, value: object, words: str) -> None:
    message = refused(fused_network(**{key: value}).data)
    assert message.startswith("network (bytes): ")
    assert words in message


def test_wrong_graphs() -> None:
    assert "expected ['N', 7]" in refused(
        export_network(
            [(np.ones((6, 1)), np.zeros(1))], np.zeros(6), np.ones(6), 0.0, 1.0, fused_network().metadata
        )
    )
    small = fused_network()
    w, b = small.layers[-1]
    nan = SmallNetwork((*small.layers[:-1], (w * np.nan, b)), small.mean, small.std, 0.0, 1.0, small.metadata)
    assert "found nan in the middle of its envelope" in refused(nan.data)


def test_the_two_kinds_are_not_mistaken_for_each_other() -> None:
    assert "expected ['N', 7]" in refused(small_network().data)
    with pytest.raises(NetworkError, match=r"expected \['N', 6\]"):
        TorqueNetwork(fused_network().data)


def test_unreadable_files(tmp_path: Path) -> None:
    assert "cannot be read" in refused(tmp_path / "no.onnx")
    data = fused_network().data
    for bad in (b"", b"x" * 100, data[: len(data) // 2]):
        assert refused(bad).startswith("network (bytes): ")
