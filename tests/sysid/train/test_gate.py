"""A network is written only where it takes 30 % off the error of physics on held-out runs, and is worse in 2 % at most."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from jtqd.models.files import shipped
from jtqd.sysid.train import command as train_command
from jtqd.sysid.train.network import TrainedNetwork
from jtqd.sysid.train.ours import judge, judged_scores, safe_share

GOOD = (0.48, 1.0)  # MSE: 30.7 % off the RMSE
FAIR = (0.50, 1.0)  # 29.3 %
WORSE = (1.01, 1.0)


@pytest.mark.parametrize(
    ("scores", "passed"),
    [
        ([GOOD] * 50, True),  # the gain is that of the error and not of its square
        ([FAIR] * 50, False),
        ([(0.4, 1.0)] * 49 + [WORSE], True),  # worse in one run of fifty, and in none of less
        ([(0.4, 1.0)] * 48 + [WORSE], False),
        ([(0.4, 1.0)] * 48 + [WORSE] * 2, False),
    ],
)
def test_a_network_is_accepted_by_its_gain_on_held_out_runs(scores, passed):
    assert judge(scores).passed is passed
    assert judge([FAIR] * 50).gain == pytest.approx(0.2929, abs=1e-4)


def test_what_changes_nothing_is_refused_with_its_numbers():
    none = judge([(1.0, 1.0)] * 8)
    assert not none.passed
    assert none.text == (
        "on 8 held-out runs it takes 0.0 % off the error of physics (RMSE 1.000 -> 1.000 Nm; expected at least 30 %) "
        "and is worse in 0 (expected at most 2 %)"
    )
    with pytest.raises(ValueError, match="no held-out run"):
        judge([])


def test_a_run_has_no_say_in_the_share_that_it_is_judged_with():
    """Of four folds one is harmed: the share of all is 0, and would hide it. Judged by the others' share it is worse."""
    rng = np.random.default_rng(3)
    corrections = [rng.normal(size=2000) for _ in range(8)]
    useful = [1.0] * 7 + [-0.5]
    unseen = [(factor * each, each) for factor, each in zip(useful, corrections, strict=True)]
    assert safe_share(unseen) == 0.0
    scores = judged_scores(unseen, [n // 2 for n in range(8)])
    assert [network > physics for network, physics in scores] == [False] * 7 + [True]
    assert scores[0] == (pytest.approx(scores[0][1]), scores[0][1]), "the others' share is 0 for the rest"
    assert judge(scores).worse == 1


def test_what_is_written_with_the_share_0_is_no_network():
    """A run of fifty may be harmed; the share that harms none can then be 0, and what is written corrects nothing."""
    found = judge([GOOD] * 50, share=0.0)
    assert not found.passed
    assert found.text.endswith("(expected at most 2 %); but no share of it is without harm to all of them")
    assert judge([FAIR] * 50, share=0.0).text == judge([FAIR] * 50).text


@pytest.fixture
def train(tmp_path, monkeypatch, capsys):
    """`jtq train` whose training gives these scores; exit status, standard output, JSON or None."""

    def run(kind, score, *more):
        trained = SimpleNamespace(losses=[1.0, 0.5], weights=[(0, np.zeros(1))], input_mean=np.zeros(3))
        envelope = {
            "known": [[1, 1, 1]] * 3,
            "velocity_step_rad_s": 0.25,
            "torque_step_nm": 3.0,
            "distance_nm": 1.0,
            "temperature_c": None,
        }
        metadata = {"runs": {"a": "0"}, "data_sha256": "0", "share": 1.0, "sigma_scale": [1.0] * 4}
        metadata |= (
            {"envelope": envelope}
            if kind == "ours"
            else {"features": ["x"], "envelope_low": [0.0], "envelope_high": [1.0]}
        )
        made = TrainedNetwork(b"network", trained, metadata, {f"run_{n}": score for n in range(10)})
        monkeypatch.setattr(
            train_command, "read_runs", lambda *_, **__: [SimpleNamespace(name="a", sha256="0")]
        )
        for name in ("channel_findings", "signals_of_runs", "progress"):
            monkeypatch.setattr(train_command, name, lambda *_, **__: [])
        monkeypatch.setattr(train_command, "two_encoders", lambda *_: True)
        for name in ("train_fused", "train_paper"):
            monkeypatch.setattr(train_command, name, lambda *_, **__: made)
        out = tmp_path / "out"
        joint = str(shipped("joint1.yaml"))
        arguments = f"x --joint {joint} --number 1 --network {kind} --out {out}".split()
        status = train_command.main([*arguments, *more])
        return status, capsys.readouterr().out, sorted(path.name for path in out.iterdir())

    return run


def test_a_network_that_earns_its_share_is_written(train):
    status, output, files = train("ours", GOOD)
    assert (status, files) == (0, ["joint1.fused.md", "joint1.fused.onnx", "joint1.fused.png"])
    assert "10 held-out runs" in output


def test_one_that_does_not_is_not_written_and_the_numbers_are_reported(train):
    status, output, files = train("ours", FAIR)
    assert (status, files) == (3, [])
    assert output.startswith(
        "joint1: no network is written: on 10 held-out runs it takes 29.3 % off the error of physics"
    )
    assert output.endswith("; jtqd runs on physics alone\n")
    status, output, _ = train("ours", FAIR, "--json")
    content = json.loads(output)["joint1"]
    assert (status, content["path"]) == (3, None)
    assert (content["gate"]["passed"], content["gate"]["worse"]) == (False, 0)


def test_an_earlier_network_at_that_place_is_named(train, tmp_path):
    train("ours", GOOD)
    status, output, files = train("ours", FAIR)
    assert status == 3
    assert "joint1.fused.onnx is of an earlier training" in output
    assert "joint1.fused.onnx" in files


def test_the_papers_network_is_written_as_it_is(train):
    status, _, files = train("paper", (2.0, 1.0))
    assert (status, "joint1.onnx" in files) == (0, True)
