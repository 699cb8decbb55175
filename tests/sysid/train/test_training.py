"""Training: same seed same weights, split by run, what a split by sample would claim, and what our network may learn."""

import hashlib
from types import SimpleNamespace

import numpy as np
import pytest

from jtqd.estimator.network import FEATURES, FUSED_FEATURES, FusedNetwork, TorqueNetwork
from jtqd.sysid.train.network import (
    PaperBlock,
    Schedule,
    export_network,
    network_output,
    origin,
    split_by_sample,
    thinned,
    train,
    train_paper,
)
from jtqd.sysid.train.ours import quick_part, safe_share, scaled, training_envelope

JOINT = SimpleNamespace(name="joint1")
ENVELOPE = {
    "velocity_step_rad_s": 0.25,
    "torque_step_nm": 3.0,
    "known": [[1, 1, 1]] * 3,
    "distance_nm": 2.0,
    "temperature_c": None,
}


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


def test_quick_part_keeps_ripple_and_drops_zero_and_drift():
    t = np.arange(4000) * 1e-3
    ripple = 0.3 * np.cos(2 * np.pi * 20.0 * t)
    quick = quick_part(1.7 + 0.2 * t + ripple)
    inner = slice(300, -300)
    assert np.abs(quick - ripple)[inner].max() < 0.01
    assert abs(quick[inner].mean()) < 1e-3
    assert np.allclose(quick_part(np.full(50, 3.0)), 0.0)


def test_safe_share_is_the_best_over_all_runs_that_harms_none():
    rng = np.random.default_rng(6)
    runs = []
    for useful in (1.0, 0.8, 0.3):
        correction = rng.normal(size=4000)
        runs.append((useful * correction + 0.1 * rng.normal(size=4000), correction))
    share = safe_share(runs)
    assert share == pytest.approx(0.54, abs=0.02)  # 1.8 times the 0.3 of the run that gains least
    for residual, correction in runs:
        assert np.mean((residual - share * correction) ** 2) <= np.mean(residual**2)
    assert safe_share(runs[:2]) == pytest.approx(0.9, abs=0.02)


def test_network_that_learned_nothing_has_no_share():
    """Noise; one run of many that would be harmed; a correction that is nothing at all."""
    rng = np.random.default_rng(7)
    assert safe_share([(rng.normal(size=2000), rng.normal(size=2000)) for _ in range(3)]) == 0.0
    correction = rng.normal(size=2000)
    good = [(correction, correction)] * 20
    assert safe_share(good) == 1.0
    assert safe_share([*good, (-0.1 * correction, correction)]) == 0.0
    assert safe_share([(correction, np.zeros(2000))] * 3) == 0.0


def test_envelope_knows_visited_cells_and_holes_between_them():
    cells = [(v, raw) for v in (-0.5, 0.0, 0.5) for raw in (-6.0, 0.0, 6.0) if (v, raw) != (0.0, 0.0)]
    features = np.repeat([[v, raw, 0.4, *([0.0] * 6)] for v, raw in cells], 30, axis=0)
    runs = [SimpleNamespace(temperature_c=t) for t in (22.0, 27.0, float("nan"))]
    envelope = training_envelope([SimpleNamespace(features=features)], runs)
    known = np.array(envelope.known)
    middle = known.shape[0] // 2, known.shape[1] // 2
    assert known[middle[0] + 2, middle[1] + 2] == 1
    assert known[middle] == 1  # a hole between known cells in both directions
    assert known[middle[0] + 3].sum() == 0
    assert envelope.temperature_c == (21.5, 27.5)
    assert envelope.distance_nm == pytest.approx(0.5)


def test_gated_network_in_numpy_and_as_a_graph_agree_and_have_no_mean():
    rng = np.random.default_rng(8)
    core, angle = rng.normal(size=(3000, 3)), rng.uniform(0, 2 * np.pi, 3000)

    def waves(at):
        return np.column_stack((np.cos(at), np.sin(at), np.cos(2 * at), np.sin(2 * at)))

    target = (0.3 + 0.1 * core[:, 0]) * np.cos(angle)
    trained = train([core], [target], Schedule(150, 0), hidden=(8,), waves=[waves(angle)])
    out = network_output(trained, core, waves(angle))
    assert np.std(out - target) < 0.03
    turn = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    assert abs(network_output(trained, np.tile(core[0], (360, 1)), waves(turn)).mean()) < 1e-9
    metadata = {
        "features": list(FUSED_FEATURES),
        "envelope": ENVELOPE,
        "sigma_scale": [1.0] * 4,
        "input_low": [-1.0] * 7,
        "input_high": [1.0] * 7,
        **origin(JOINT, {}),
    }
    for share in (1.0, 0.3, 0.0):
        data = export_network(scaled(trained, share), metadata, 4)
        found = FusedNetwork(data).run_many(np.column_stack((core, waves(angle))))
        assert np.abs(found - share * out).max() < 1e-6
    assert not found.any()  # exactly nothing: the estimate is then the physics to the last bit
