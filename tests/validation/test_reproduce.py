"""Study `reproduce`: the commands, their order, what ends it, the configuration it leaves; the shipped models fit theirs."""

import hashlib
import json
import subprocess
import sys

import numpy as np
import pytest
import yaml

from jtqd.daemon.config import load_config
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.campaign import command as campaign_command
from jtqd.sysid.planner.plan import check_plan, load_plan
from tests.estimator.fused_configuration import networks
from validation import reproduce
from validation.__main__ import FAILED, main
from validation.reproduce import steps, write_config


def test_every_step_comes_after_what_it_reads(tmp_path):
    made = {str(shipped(f"joint{n}.yaml")) for n in (1, 2)} | {str(shipped("campaign_plant_outside.yaml"))}
    made |= {str(tmp_path / "outside.plan.yaml")}
    names = []
    for step in steps(tmp_path, "sim", True, 0):
        names.append(step.text.split()[2 if step.module != "jtqd.daemon.jtq" else 1])
        paths = [word for word in step.arguments if "/" in word and not word.startswith("-")]
        out = step.arguments[step.arguments.index("--out") + 1]
        for path in paths:
            assert path in made or path == out or path.endswith(".png"), (step.arguments, path)
        made.add(out)
    assert names == [
        *["campaign"] * 3,
        *["fit"] * 4,
        "train",
        "train",
        "campaign",
        "campaign",
        "evaluate",
        "jtqd.sysid.campaign.emulated",
        "evaluate",
    ]


@pytest.mark.parametrize("kind", ["efficiency", "excitation", "quick", "validate"])
def test_quick_campaigns_are_plans_that_can_be_driven(tmp_path, capsys, kind):
    (step,) = (s for s in steps(tmp_path, "sim", True, 0) if s.arguments[:2] == ("campaign", kind))
    size = [word for word in step.arguments[2:] if word != "160"]
    if "--evaluations" in size:
        size.insert(size.index("--evaluations") + 1, "1")
    assert campaign_command.main([kind, *size, "--dry-run"]) == 0, capsys.readouterr().err


def test_nothing_is_trained_on_what_judges(tmp_path):
    for step in steps(tmp_path, "sim", False, 0):
        if step.arguments[0] in ("fit", "train"):
            assert not any(
                part in word for word in step.arguments for part in ("validate", "outside", "days")
            )


@pytest.fixture
def scripted(monkeypatch):
    """Return what puts a function of command and call number in the place of the commands; the list is what ran."""

    def put(answer):
        called = []

        def run(command, **_):
            called.append(command[3])
            return subprocess.CompletedProcess(command, answer(command[3], len(called)))

        monkeypatch.setattr(reproduce.subprocess, "run", run)
        monkeypatch.setattr(reproduce, "check_installed", lambda *_: None)  # nothing is trained here
        return called

    return put


def test_failed_step_ends_it_and_findings_of_a_campaign_do_not(tmp_path, scripted, capsys):
    called = scripted(lambda name, _: 3 if name == "campaign" else 1)
    assert main(["reproduce", "--out", str(tmp_path), "--quick"]) == FAILED
    assert called == [*["campaign"] * 3, "fit"]
    assert "reproduce: jtq fit efficiency ended with status 1" in capsys.readouterr().err


@pytest.mark.parametrize(("done", "calls"), [([1, 2, 2], 3), ([0, 0], 2), ([], 1)])
def test_campaign_that_ended_early_goes_on_while_runs_get_done(tmp_path, scripted, capsys, done, calls):
    """Each number is how many runs are done after an attempt that ended early; without a state nothing was begun."""

    def answer(name, number):
        state = tmp_path / "campaigns" / "excitation" / "campaign.json"
        if done:
            state.parent.mkdir(parents=True, exist_ok=True)
            count = done[number - 1]
            runs = [{"name": f"run{n}", "status": "done" if n < count else "pending"} for n in range(3)]
            state.write_text(json.dumps({"runs": runs}))
        return 1

    called = scripted(answer)
    assert main(["reproduce", "--out", str(tmp_path), "--quick"]) == FAILED
    assert called == ["campaign"] * calls
    assert "jtq campaign excitation ended with status 1" in capsys.readouterr().err


def test_out_that_cannot_be_made_is_one_line(tmp_path, capsys):
    file = tmp_path / "file"
    file.touch()
    assert main(["reproduce", "--out", str(file)]) == FAILED
    assert capsys.readouterr().err == f"reproduce: --out {file}: cannot be created: it is a file\n"
    assert main(["reproduce", "--out", str(file / "below")]) == FAILED
    assert capsys.readouterr().err.count("\n") == 1


def test_packages_that_training_needs_are_asked_for_before_the_first_campaign(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    assert main(["reproduce", "--quick", "--out", str(tmp_path / "out")]) == FAILED
    assert capsys.readouterr().err == "reproduce: torch is not installed: pip install 'jtqd[train]'\n"


def test_outside_plan_has_half_as_much_load_again_and_is_within_its_limits(tmp_path):
    path = tmp_path / "outside.plan.yaml"
    reproduce._write_outside_plan(path, 0, 2)
    plan = load_plan(path)
    peaks = [np.abs(points.current_a).max() for points in check_plan(plan).values()]
    assert max(peaks) > 1.3 * 5.0  # the peak of every other campaign is 5 A


def trained(directory):
    for file in shipped("trained/joint1.yaml").parent.iterdir():
        (directory / file.name).write_bytes(file.read_bytes())


def test_configuration_written_beside_the_models_is_one_that_jtqd_takes(tmp_path):
    trained(tmp_path)
    write_config(tmp_path / "bench_paper.yaml", "bench_paper.yaml")
    config = load_config(tmp_path / "bench_paper.yaml")
    for joint in config.joints:
        assert joint.network is not None
        assert joint.network.path.parent == tmp_path
        assert hashlib.sha256(joint.network.path.read_bytes()).hexdigest() == joint.network.sha256


def test_the_configuration_has_those_networks_that_the_gate_let_through(tmp_path):
    trained(tmp_path)
    (tmp_path / "joint2.fused.onnx").write_bytes(networks()[2])
    write_config(tmp_path / "bench.yaml", "bench.yaml")
    config = load_config(tmp_path / "bench.yaml")
    assert [joint.network and joint.network.path.name for joint in config.joints] == [
        None,
        "joint2.fused.onnx",
    ]
    for joint in config.joints:
        assert joint.temperature


@pytest.mark.parametrize("number", [1, 2])
def test_shipped_models_come_from_the_same_runs(number):
    import onnx

    joint = load_joint(shipped(f"trained/joint{number}.yaml"))
    trained_on = joint.provenance["fused"]["sha256"]
    model = onnx.load(str(shipped(f"trained/joint{number}.onnx")))
    metadata = {item.key: yaml.safe_load(item.value) for item in model.metadata_props}
    assert metadata["runs"] == trained_on
    assert metadata["joint"] == joint.name


@pytest.mark.campaign
def test_quick_reproduction_from_nothing(tmp_path):
    command = [sys.executable, "-m", "validation", "reproduce", "--quick", "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1500, check=False)
    assert done.returncode in (0, 3), done.stderr[-2000:]
    assert (tmp_path / "report" / "evaluation.html").stat().st_size > 10_000
    assert (tmp_path / "report_days" / "evaluation.html").stat().st_size > 10_000
    assert load_config(tmp_path / "models" / "bench.yaml").estimator.method == "fused"


def test_another_plant_needs_no_bus_and_is_judged_on_other_days(tmp_path):
    plant = shipped("plants/typical.yaml")
    made = list(steps(tmp_path, "sim", True, 3, plant))
    assert not any(step.arguments[0] == "campaign" for step in made)
    emulated = [step.arguments for step in made if step.module == "jtqd.sysid.campaign.emulated"]
    assert all(str(plant) in arguments for arguments in emulated)
    seeds = [arguments[arguments.index("--seed") + 1] for arguments in emulated]
    assert len(emulated) == 5
    assert seeds[0] == seeds[1] == seeds[2]
    assert len({*seeds}) == 3
