"""`jtq replay`: a log that was just recorded over the unix bus, bit for bit; cut and spoilt ones; models, arguments."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from jtqd.daemon.logs import LogError, read_attachments, read_topic
from jtqd.daemon.replay.command import main
from jtqd.daemon.replay.logged import read_runs, read_setup
from jtqd.daemon.replay.session import Replayer, models_of, replay
from jtqd.daemon.shared.cycle_record import FLAG_NETWORK_SKIPPED
from jtqd.models.files import shipped
from tests.daemon.replay.replay_helpers import cut, cycles, provenance
from tests.estimator.fused_configuration import networks
from tests.golden.scene import SCENES, play
from tests.paths import GOLDEN
from tests.shipped_bench import shipped_bench

Change = Callable[[dict[str, bytes]], dict[str, bytes]]
VALUES = 4 + 24 + 16
"""Where the 12 numbers of a JointEstimate begin: after encapsulation, stamp and frame_id, cycle and monotonic time."""


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """2.2 s of jtqd on the emulated bench, method fused with networks, in real time: with whatever the machine did."""
    return recorded(tmp_path_factory.mktemp("recorded"), 2.2)


def recorded(
    directory: Path, seconds: float, beside: Callable[[subprocess.Popen[str], Path], None] | None = None
) -> Path:
    """The log of a run; beside: what happens to its processes meanwhile, until they have ended."""
    content = shipped_bench()
    for number, data in networks().items():
        file = directory / f"joint{number}.fused.onnx"
        file.write_bytes(data)
        content[f"joint_{number}"]["network"] = {
            "file": str(file),
            "sha256": hashlib.sha256(data).hexdigest(),
        }
    (directory / "bench.yaml").write_text(yaml.safe_dump(content))
    command = [
        *(sys.executable, "-m", "jtqd.daemon.jtqd", "--bus", "sim", "--duration", str(seconds)),
        *("--config", str(directory / "bench.yaml"), "--record", str(directory / "logs"), "--json"),
    ]
    env = {**os.environ, "RUNTIME_DIRECTORY": str(directory)}
    with (
        (directory / "out").open("w") as out,
        subprocess.Popen(command, env=env, stdout=out, stderr=subprocess.STDOUT, text=True) as process,
    ):
        if beside is not None:
            beside(process, directory)
        process.wait(timeout=120)
    said = (directory / "out").read_text()
    assert process.returncode in (0, 3), said
    found = list((directory / "logs").glob("*.mcap"))
    assert len(found) == 1, said
    return found[0]


def stopped_at_times(process: subprocess.Popen[str], directory: Path) -> None:
    """Once it records, stop one of the processes below this one after the other, for 2 to 150 ms, until it ends."""
    rng = np.random.default_rng(3)
    while process.poll() is None and not list(directory.glob("logs/*")):
        time.sleep(0.05)
    while process.poll() is None:
        below, every = [process.pid], list[int]()
        while below:
            try:
                text = Path(f"/proc/{below[0]}/task/{below[0]}/children").read_text()
            except OSError:  # it has ended
                text = ""
            every += (more := [int(pid) for pid in text.split()])
            below = [*below[1:], *more]
        for pid in every:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGSTOP)
                time.sleep(float(rng.choice((0.002, 0.01, 0.04, 0.15))))
                os.kill(pid, signal.SIGCONT)
        time.sleep(0.05)


@pytest.mark.native
def test_processes_that_stood_still_cost_cycles_and_no_bit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = recorded(tmp_path, 3.0, stopped_at_times)
    status, found, _ = run(capsys, file)
    assert status == 0
    assert found["identity"]["identical"] == found["cycles"] == len(cycles(file))
    assert found["cycles"] < 2900, "the loop stood still at times"


@pytest.mark.socketcan
@pytest.mark.parametrize("name", ["faults", "network"])
def test_a_log_of_a_real_interface_comes_out_bit_for_bit(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """SocketCAN, also after a foreign SYNC, a conflict, a node that restarted and an interface that was down."""
    status, found, _ = run(capsys, play(name, tmp_path))
    assert status == 0
    assert found["identity"]["identical"] == found["cycles"]
    assert found["identity"]["pdos"] == found["identity"]["pdos_equal"]
    assert found["cycles"] == pytest.approx(SCENES[name].seconds * 1e6 / SCENES[name].period_us, rel=0.1)


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict, str]:  # type: ignore[type-arg]
    """(exit status, the one run of the JSON, stderr)."""
    status = main([*map(str, arguments), "--json"])
    out, err = capsys.readouterr()
    return status, json.loads(out)["runs"][0] if out else {}, err


def one_line(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The line that a log or model that cannot be used gives."""
    assert main([*map(str, arguments)]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("jtq replay: ")
    assert err.count("\n") == 1, err
    return err


@pytest.mark.native
def test_what_was_recorded_comes_out_bit_for_bit(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, found, _ = run(capsys, log)
    assert found["cycles"] == found["identity"]["identical"] == len(cycles(log))
    assert found["identity"]["pdos"] == found["identity"]["pdos_equal"] > 1500
    assert found["identity"]["differences"] == found["identity"]["unknown"] == []
    assert status == 0
    assert main([str(log)]) == 0
    text = capsys.readouterr().out
    count = f"{found['cycles']:,}".replace(",", " ")
    assert f"bit-identical: {count} of {count} cycles" in text


@pytest.mark.native
def test_a_log_that_begins_in_the_middle(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The observer's state is not in it: the replay reports that, and is identical from the first state in the log on."""
    begin = cycles(log)[500]
    late = cut(log, tmp_path / "late.mcap", lambda cycle: cycle >= begin)
    status, found, _ = run(capsys, late)
    same = found["identity"]
    assert status == 0
    assert not same["bit_identical"]
    assert same["explained"]
    assert {each["joint"] for each in same["unknown"]} == {1, 2}
    assert begin <= min(each["first_cycle"] for each in same["unknown"]) < begin + 100
    assert all("begins in the middle" in each["reason"] for each in same["unknown"])
    assert begin < same["from_cycle"] < begin + 1200
    assert same["identical"] >= sum(cycle >= same["from_cycle"] for cycle in cycles(late))
    main([str(late)])
    assert f"bit-identical from cycle {same['from_cycle']:,} on".replace(",", " ") in capsys.readouterr().out


@pytest.mark.native
def test_parts_of_one_run_are_joined(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    middle = cycles(log)[900]
    one = cut(log, tmp_path / "b.mcap", lambda cycle: cycle < middle)
    two = cut(log, tmp_path / "a.mcap", lambda cycle: cycle >= middle)
    status, found, _ = run(capsys, two, one)
    assert status == 0
    assert found["logs"] == [str(one), str(two)]
    assert found["identity"]["bit_identical"]
    assert found["cycles"] == len(cycles(log))
    assert "given twice" in one_line(capsys, one, one)


@pytest.mark.native
def test_lost_cycles_are_counted_and_their_effect_ends(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """30 cycles are missing: the difference from there on has a reason, and ends."""
    gone = set(cycles(log)[700:730])
    status, found, _ = run(capsys, cut(log, tmp_path / "thin.mcap", lambda cycle: cycle not in gone))
    same = found["identity"]
    assert status == 0
    assert found["lost_cycles"] == 30
    assert all("missing" in each["reason"] for each in same["unknown"])
    assert same["unknown"][0]["first_cycle"] > max(gone)
    assert same["explained"]
    assert same["from_cycle"] > max(gone)


@pytest.mark.native
def test_a_changed_number_is_found(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One torque in the log is another by one bit."""
    state = read_topic(log, "/joint/2/state")
    target = int(state["cycle"][np.isfinite(state["physics_nm"])][1200])

    def spoil(topic: str, cycle: int, data: bytes) -> bytes:
        if topic != "/joint/2/state" or cycle != target:
            return data
        at = VALUES + 8 * 8  # tob_nm is not published; physics_nm, one further, is of method fused
        (bits,) = struct.unpack_from("<q", data, at + 8)
        return data[: at + 8] + struct.pack("<q", bits ^ 1) + data[at + 16 :]

    status, found, _ = run(capsys, cut(log, tmp_path / "spoilt.mcap", payload=spoil))
    (one,) = found["identity"]["differences"]
    assert status == 3
    assert (one["joint"], one["cycle"], one["cycles"], one["field"]) == (2, target, 1, "physics_nm")
    assert found["identity"]["identical"] == found["cycles"] - 1


@pytest.mark.native
def test_the_raw_frames_are_what_is_replayed(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A current that is changed in the frames of one cycle only: the estimate is another from there on."""
    state = read_topic(log, "/joint/1/state")
    target = int(state["cycle"][np.isfinite(state["torque_nm"])][800])
    head = struct.pack("<IB3x", 0x281, 8)

    def spoil(topic: str, cycle: int, data: bytes) -> bytes:
        if topic != "/can/frames" or cycle != target:
            return data
        at = data.rindex(head) + len(head) + 4  # 606Ch I32, then 6078h I16
        (current,) = struct.unpack_from("<h", data, at)
        return data[:at] + struct.pack("<h", current + 50) + data[at + 2 :]

    status, found, _ = run(capsys, cut(log, tmp_path / "spoilt.mcap", payload=spoil))
    one, *later = found["identity"]["differences"]
    assert status == 3
    assert (one["joint"], one["cycle"], one["field"]) == (1, target, "torque_nm")
    # what the joint has learned from that cycle is in its state as well
    assert all((d["joint"], d["field"]) == (1, "state") and d["cycle"] > target for d in later)


@pytest.mark.native
def test_other_models_and_the_file_with_both(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Joint 1 with a torque constant 10 % larger: the difference, the error to the sensor, a file for the viewer."""
    models = tmp_path / "models"
    models.mkdir()
    text = read_attachments(log)["joint1.yaml"].decode()
    (line,) = [each for each in text.splitlines() if each.startswith("torque_constant_nm_per_a:")]
    constant = float(line.split(":")[1])
    (models / "joint1.yaml").write_text(text.replace(line, f"torque_constant_nm_per_a: {1.1 * constant!r}"))
    target = tmp_path / "both.mcap"
    status, found, _ = run(capsys, log, "--model", models, "--out", target)
    one, two = found["joints"]
    assert status == 0
    assert found["identity"] is None
    assert str(models / "joint1.yaml") in found["models"][0]
    assert found["models"][1] == "as logged"
    assert two["max_nm"] < 1e-9
    assert 0.001 < one["rms_nm"] <= one["max_nm"]
    assert one["sensor_replayed_nm"] != pytest.approx(one["sensor_logged_nm"], rel=1e-4)
    sensor = np.isfinite(read_topic(log, "/joint/1/state")["sensor_torque_nm"])
    assert one["both"] > 1000
    assert one["both"] - (~sensor).sum() <= one["sensor_cycles"] <= one["both"]
    for number in (1, 2):
        logged = read_topic(target, f"/joint/{number}/state")
        replayed = read_topic(target, f"/joint/{number}/replay")
        original = read_topic(log, f"/joint/{number}/state")
        assert logged.dtype.names == original.dtype.names
        assert logged.tobytes() == original.tobytes()
        np.testing.assert_array_equal(replayed["cycle"], original["cycle"])
        apart = np.nanmax(np.abs(replayed["torque_nm"] - original["torque_nm"]))
        assert apart == pytest.approx(found["joints"][number - 1]["max_nm"], abs=1e-12)
    assert {"replay.json", "configuration.yaml", "joint1.yaml"} <= read_attachments(target).keys()
    assert main([str(log), "--out", str(target)]) == 2
    assert "exists" in capsys.readouterr().err


@pytest.mark.native
def test_shadow_methods_are_replayed_and_compared(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The paper's three, as the shipped bench has them: one number that is another in the log is a difference."""
    assert main([str(log)]) == 0
    text = capsys.readouterr().out
    for method in ("tob", "efficiency", "network"):
        assert text.count(f"{method} ") == 2, text
    changed = cycles(log)[1000]
    where = read_topic(log, "/joint/1/shadow").dtype.names.index("tob_torque_nm")

    def spoil(topic: str, cycle: int, data: bytes) -> bytes:
        if topic != "/joint/1/shadow" or cycle != changed:
            return data
        at = VALUES + 8 * (where - 3)
        return data[:at] + struct.pack("<d", 99.0) + data[at + 8 :]

    status, found, _ = run(capsys, cut(log, tmp_path / "spoilt.mcap", payload=spoil))
    (difference,) = found["identity"]["differences"]
    assert status == 3
    assert (difference["joint"], difference["cycle"], difference["cycles"]) == (1, changed, 1)
    assert (difference["field"], difference["logged"]) == ("tob_torque_nm", 99.0)


@pytest.mark.native
def test_a_shadow_method_that_is_sent_in_the_replay_has_the_network_of_the_log(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (result,) = replay([log], method="network")
    assert [each.network is not None for each in result.models] == [True, True]
    assert [[each.settings.method for each in model.shadows] for model in result.models] == 2 * [
        ["tob", "efficiency"]
    ]
    for logged, replayed in zip(result.run.joints, result.joints, strict=True):
        # What is sent has no network where there was no time for it; a shadow has one in every cycle.
        in_time = (logged["input_flags"] & FLAG_NETWORK_SKIPPED) == 0
        published = np.isfinite(replayed["torque_nm"]) & np.isfinite(logged["network_torque_nm"]) & in_time
        assert published.sum() > 1000
        np.testing.assert_array_equal(
            replayed["torque_nm"][published], logged["network_torque_nm"][published]
        )
        assert np.isnan(replayed["network_age_ms"]).all()


# ---- models and logs that cannot be used: golden logs ----

LOG = GOLDEN / "faults.mcap"


def test_wrong_models(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "not a directory" in one_line(capsys, LOG, "--model", tmp_path / "nowhere")
    assert "found no file for these joints" in one_line(capsys, LOG, "--model", tmp_path)
    (tmp_path / "joint1.yaml").write_text("name: [")
    assert "joint1.yaml" in one_line(capsys, LOG, "--model", tmp_path)
    for name in ("joint1.yaml", "extended.joint1.yaml"):
        shutil.copy(shipped("joint1.yaml"), tmp_path / name)
    line = one_line(capsys, LOG, "--model", tmp_path)
    assert line.endswith(f"{tmp_path}: found joint1.yaml and extended.joint1.yaml, expected one of them\n")
    for name in ("joint1.yaml", "extended.joint1.yaml"):
        (tmp_path / name).unlink()
    (tmp_path / "joint2.fused.onnx").write_bytes(b"no network")
    assert "joint2.fused.onnx" in one_line(capsys, LOG, "--model", tmp_path)
    assert "needs" in one_line(capsys, LOG, "--method", "network")
    assert "none: found no such directory" in one_line(capsys, LOG, "--out", tmp_path / "none" / "a.mcap")


def test_shadow_methods_of_a_replay_are_the_replay_of_these_methods(tmp_path: Path) -> None:
    """A golden log with a configuration that asks for two: what is sent stays, bit for bit."""
    log = GOLDEN / "network.mcap"
    ((run_, inputs),) = read_runs([log], tmp_path)
    setup = replace(run_.setup, config=replace(run_.setup.config, shadow=("tob", "efficiency")))
    replayed = Replayer(setup, models_of(setup)).run(run_.joints, inputs, run_.steps()).joints
    (sent,) = replay([log])
    for method in setup.config.shadow:
        (alone,) = replay([log], method=method)
        for one, other in zip(replayed, alone.joints, strict=True):
            published = np.isfinite(other["torque_nm"])
            assert published.sum() > 500
            for name in ("torque_nm", "sigma_nm"):
                np.testing.assert_array_equal(one[f"{method}_{name}"][published], other[name][published])
    for one, other in zip(replayed, sent.joints, strict=True):
        for name in other.dtype.names:
            np.testing.assert_array_equal(one[name], other[name])


def with_shadow_networks(networks: dict[str, Any], attached: dict[str, str]) -> Change:
    """Attachments whose configuration names these networks for joint 1, and whose provenance has these attachments."""

    def change(found: dict[str, bytes]) -> dict[str, bytes]:
        configuration = yaml.safe_load(found["configuration.yaml"])
        configuration["joint_1"]["shadow_networks"] = networks
        text, content = yaml.safe_dump(configuration).encode(), json.loads(found["provenance.json"])
        content["configuration"]["sha256"] = hashlib.sha256(text).hexdigest()
        content["joints"]["1"]["shadow_networks"] = attached
        return found | {"configuration.yaml": text, "provenance.json": json.dumps(content).encode()}

    return change


def test_a_network_that_no_shadow_method_used_is_not_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    networks = {"network": {"file": "gone.onnx", "sha256": "00"}}
    log = cut(LOG, tmp_path / "a.mcap", attachments=with_shadow_networks(networks, {}))
    status, found, _ = run(capsys, log)
    assert (status, found["identity"]["bit_identical"]) == (0, True)


def test_the_name_of_a_shadow_method_names_no_place_on_this_machine(tmp_path: Path) -> None:
    networks = {"../../evil": {"file": "x", "sha256": "00"}}
    change = with_shadow_networks(networks, {"../../evil": "bus.dbc"})
    place = tmp_path / "one" / "two"
    place.mkdir(parents=True)
    with pytest.raises(LogError, match=r"shadow_networks\.\.\./\.\./evil.*expected one of network, fused"):
        read_setup(LOG, change(read_attachments(LOG)), place)
    assert [each.name for each in tmp_path.iterdir()] == ["one"]
    assert [each.name for each in (tmp_path / "one").iterdir()] == ["two"]
    assert (place / "joint_1.shadow_0.onnx").exists()


def without(name: str) -> Change:
    return lambda found: {key: value for key, value in found.items() if key != name}


def bent(name: str) -> Change:
    return lambda found: {**found, name: found[name] + b" "}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (without("configuration.yaml"), "configuration.yaml, expected one"),
        (without("provenance.json"), "provenance.json, expected one"),
        (without("joint2.yaml"), "joint2.yaml, expected one"),
        (bent("configuration.yaml"), "attachment configuration.yaml: found SHA-256"),
        (bent("joint1.yaml"), "attachment joint1.yaml: found SHA-256"),
        (lambda found: {**found, "provenance.json": b"{"}, "provenance.json: Input data was truncated"),
        (
            lambda found: {**found, "provenance.json": b"[]"},
            "provenance.json: Expected `object`, got `array`",
        ),
        (provenance(lambda content: content["nodes"]["1"].pop("scaling")), "no usable scaling"),
        (
            provenance(lambda content: content["joints"]["2"].pop("file")),
            "joints.2: Object missing required field `file`",
        ),
    ],
)
def test_logs_with_other_attachments(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Change, text: str
) -> None:
    few = cycles(LOG)[5]
    path = cut(LOG, tmp_path / "a.mcap", lambda cycle: cycle < few, attachments=change)
    assert text in one_line(capsys, path)


@pytest.mark.native
def test_a_network_with_another_hash(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = cut(log, tmp_path / "a.mcap", attachments=bent("joint2.fused.onnx"))
    assert "sha256 of the network" in one_line(capsys, path)


def test_files_that_are_no_logs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "No such file" in one_line(capsys, tmp_path / "none.mcap")
    (tmp_path / "empty").mkdir()
    assert "found no *.mcap" in one_line(capsys, tmp_path / "empty")
    (tmp_path / "text.mcap").write_text("time_s,torque\n" * 100)
    assert "MCAP" in one_line(capsys, tmp_path / "text.mcap")
    foreign = cut(LOG, tmp_path / "foreign.mcap", lambda cycle: False)
    assert "/joint/1/state" in one_line(capsys, foreign)
    assert main([]) == 2
