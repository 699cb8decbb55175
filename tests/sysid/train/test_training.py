"""Training: same seed same weights, split by run, and what a split by sample would claim."""

import hashlib
from types import SimpleNamespace

import numpy as np
import pytest

from jtqd.estimator.network import FEATURES, TorqueNetwork
from jtqd.sysid.train.network import (
    PaperBlock,
    Schedule,
    network_output,
    origin,
    split_by_sample,
    thinned,
    train,
    train_paper,
)

JOINT = SimpleNamespace(name="joint1")


def blocks_with_zeros(count=10, samples=200, zero_nm=1.0, seed=3):
    """Runs whose torque is 2 i plus an offset of the run, and whose angle shows which run it is."""
    rng = np.random.default_rng(seed)
    made = []
    for n in range(count):
        features = np.column_stack([rng.normal(size=samples) for _ in FEATURES])
        features[:, 1] = 50.0 * n + rng.normal(size=samples)  # where the motor happened to stand that day
        sensor = 2.0 * features[:, 0] + zero_nm * rng.choice([-1.0, 1.0])
        made.append(PaperBlock(f"run{n}", features, sensor, 2.0 * features[:, 0]))
    return made


def test_same_seed_same_weights_and_another_seed_others():
    rng = np.random.default_rng(1)
    x = rng.normal(size=(500, 3))
    y = np.sin(x[:, 0]) + x[:, 1]
    one, two, other = (train([x], [y], Schedule(5, seed), hidden=(8,)) for seed in (4, 4, 5))
    assert all(np.array_equal(a, b) for a, b in zip(sum(one.weights, ()), sum(two.weights, ()), strict=True))
    assert not np.array_equal(one.weights[0][0], other.weights[0][0])


def test_training_learns_and_reports_its_loss():
    rng = np.random.default_rng(2)
    x = rng.normal(size=(3000, 2))
    y = 3.0 + 2.0 * np.tanh(x[:, 0]) - x[:, 1]
    seen = []
    trained = train([x], [y], Schedule(150, 0, lambda n, loss: seen.append((n, loss))), hidden=(12,))
    error = np.mean((network_output(trained, x) - y) ** 2)
    assert error < 0.01 * np.var(y)
    assert seen == list(enumerate(trained.losses))
    assert len(seen) == 150
    assert trained.losses[-1] == pytest.approx(error, rel=0.5)


def test_split_by_sample_claims_what_a_new_run_does_not_give():
    blocks, schedule = blocks_with_zeros(), Schedule(300, 0)
    runs = {block.name: hashlib.sha256(block.name.encode()).hexdigest() for block in blocks}
    result = train_paper(blocks, JOINT, runs, schedule)
    assert set(result.held_out) == {"run4", "run9"}
    assert split_by_sample(blocks, schedule) < 0.2
    assert np.mean([network for network, _ in result.held_out.values()]) > 0.8
    network = TorqueNetwork(result.data)
    assert result.metadata["runs"] == runs
    assert (network.joint, network.data_sha256) == ("joint1", origin(JOINT, runs)["data_sha256"])
    x = np.concatenate([block.features for block in blocks])
    assert np.abs(network.run_many(x) - network_output(result.trained, x)).max() < 1e-6
    with pytest.raises(ValueError, match="found 4 runs, expected at least 5"):
        train_paper(blocks[:4], JOINT, {}, schedule)


def test_thinning_keeps_every_kth_sample(monkeypatch):
    monkeypatch.setattr("jtqd.sysid.train.network.SAMPLES", 100)
    kept = thinned([np.arange(150.0), np.arange(1000.0, 1150.0)])
    assert len(kept) == 100
    assert kept[:2].tolist() == [0.0, 3.0]
