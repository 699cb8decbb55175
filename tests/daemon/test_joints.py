"""jtqd with 1, 3 and 4 joints as users run it: its log read, exported, replayed, its node asked by SDO."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
import yaml

from jtqd.daemon.core.estimate_pdo import decode
from jtqd.daemon.logs import read_attachments, read_topic, read_topics, topics_of
from jtqd.daemon.logs.read import iter_frames
from jtqd.daemon.replay.session import replay
from jtqd.drivers import own_objects
from jtqd.drivers.can_unix import UnixBus
from tests.paths import ROOT
from tests.shipped_bench import shipped_bench

canopen = pytest.importorskip("canopen")
pytestmark = pytest.mark.native


def configuration(directory: Path, joints: int, *, sensor: bool) -> Path:
    """Pairs of the shipped bench; with more than two joints at 500 Hz, the sensor then being node 5 with two channels."""
    content = shipped_bench()
    pair = content.pop("joint_1"), content.pop("joint_2")
    for n in range(joints):
        joint = yaml.safe_load(yaml.safe_dump(pair[n % 2])) | {"node": n + 1, "sensor_channel": 1 + n // 2}
        if not sensor:
            del joint["sensor_channel"]
        content[f"joint_{n + 1}"] = joint
    if joints > 2:
        content["sync"]["period_us"] = 2000
        del content["inputs"]
    content["sensor"] = {"node": 3 if joints <= 2 else 5, "channels": (joints + 1) // 2}
    if not sensor:
        del content["sensor"]
    path = directory / "config.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


class Run:
    """One run of jtqd, ended; what it answered while it ran."""

    def __init__(self, directory: Path, joints: int, *, sensor: bool) -> None:
        self.joints = joints
        environment = {**os.environ, "RUNTIME_DIRECTORY": str(directory / "run"), "LOGS_DIRECTORY": ""}
        arguments = ["--bus", "sim", "--config", str(configuration(directory, joints, sensor=sensor))]
        command = [sys.executable, "-m", "jtqd.daemon.jtqd", *arguments, "--json"]
        with subprocess.Popen(
            [*command, "--record", str(directory / "logs")],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as process:
            try:
                self.reported = self.ask(directory, environment)
            finally:  # else a failure would wait for its end for ever
                process.terminate()
            out, error = process.communicate(timeout=60)
        assert process.returncode == 0, error
        assert "Traceback" not in error
        self.summary = json.loads(out)
        self.log = Path(self.summary["recording"]["path"])

    def ask(self, directory: Path, environment: dict[str, str]) -> dict[str, Any]:
        """What `jtq status --json`, the metrics of the node and its objects say while it runs."""
        deadline = time.monotonic() + 60
        found: dict[str, Any] = {}
        while time.monotonic() < deadline:
            done = subprocess.run(
                [sys.executable, "-m", "jtqd.daemon.jtq", "status", "--json"],
                env=environment,
                capture_output=True,
                text=True,
                check=False,
            )
            found = json.loads(done.stdout) if done.returncode == 0 else {}
            if found.get("joints") and found["cycle"] > (2000 if self.joints <= 2 else 1000):  # of 2 s
                break
            time.sleep(0.1)
        path = next((directory / "run").glob("jtqd-*-sim/bus"))
        network = canopen.Network()
        network.bus = UnixBus(str(path))
        network.connect()
        try:
            eds = ROOT / "drivers" / "eds" / own_objects.own_sheet(self.joints)
            node = network.add_node(0x20, str(eds))
            room = own_objects.room_for(self.joints)
            status = [node.sdo[0x2102].raw]
            status += [node.sdo[0x2105].raw] if room == 4 else []
            found["objects"] = {
                "revision": node.sdo[0x1018][3].raw,
                "torque": [node.sdo[0x2100][sub].raw for sub in range(1, room + 1)],
                "sigma": [node.sdo[0x2101][sub].raw for sub in range(1, room + 1)],
                "status": [code >> shift & 0x0F for code in status for shift in (0, 4)],
                "gears": [node.sdo[index][1].raw for index in own_objects.PARAMETERS[:room]],
                "nodes": [node.sdo[0x2206][sub].raw >> 24 for sub in range(1, room + 2)],
                "pdos": [node.sdo[index][1].raw for index in (0x1800, 0x1801)[: room // 2]],
            }
        finally:
            network.disconnect()
        return found


@pytest.mark.measures
@pytest.mark.parametrize(
    ("joints", "sensor"),
    [
        pytest.param(1, True, marks=pytest.mark.campaign),
        (1, False),
        (3, True),
        pytest.param(4, True, marks=pytest.mark.campaign),
        pytest.param(4, False, marks=pytest.mark.campaign),
    ],
)
def test_a_run_and_its_log(tmp_path: Path, joints: int, sensor: bool) -> None:
    run = Run(tmp_path, joints, sensor=sensor)
    check_answers(run.reported, joints, sensor=sensor)
    numbers = range(1, joints + 1)
    assert list(run.summary["rmse_nm"]) == [f"joint_{number}" for number in numbers]
    assert all((value is not None) == sensor for value in run.summary["rmse_nm"].values())
    assert not [each for each in run.summary["conditions"] if each["name"] in ("sensor_lost", "deviation")]
    topics = topics_of(run.log)
    own = {f"/joint/{n}/{kind}" for n in numbers for kind in ("state", "shadow", "zeros")}
    assert {name for name in topics if name.startswith("/joint/")} == own
    states = read_topics(run.log, [f"/joint/{number}/state" for number in numbers])
    for state in states.values():
        assert np.isin(2, state["status"])
        assert np.isfinite(state["sensor_torque_nm"]).any() == sensor
        assert (state["status"] == 4).mean() < 0.2
    check_frames(run, states)
    (result,) = replay([run.log])
    assert result.identity is not None
    assert result.identity.whole
    assert result.identity.pdos_equal == result.identity.pdos > 0
    table = tmp_path / "run.csv"
    export = [sys.executable, "-m", "jtqd.daemon.jtq", "export", "csv", str(run.log), "--out", str(table)]
    export += ["--all-cycles"]
    assert subprocess.run(export, capture_output=True, check=False).returncode == 0
    columns = table.read_text().partition("\n")[0].split(",")
    assert {name.partition(".")[0] for name in columns[1:]} == {f"j{number}" for number in numbers}
    assert (f"j{joints}.torque_nm" in columns) == sensor


def check_frames(run: Run, states: dict[str, Any]) -> None:
    """The DBC of the log reads the estimate PDOs of its frames as the states have them."""
    attachments = read_attachments(run.log)
    sheet = own_objects.own_sheet(run.joints)
    assert {name for name in attachments if name.endswith(".eds")} == {
        sheet,
        "drive.eds",
        "torque_sensor.eds",
    }
    database = cantools.database.load_string(attachments["bus.dbc"].decode(), "dbc")
    records = read_topic(run.log, "/can/frames")
    assert sum(len(each.ids) for each in iter_frames(run.log, "/can/frames")) == records["frame_count"].sum()
    for row in range(0, len(records), 50):
        if records["frames_left_out"][row]:
            continue
        frames = records["frames"][row][: records["frame_count"][row]]
        sent = {int(each["id"]): bytes(each["data"]) for each in frames}
        assert (0x2A0 in sent) == (run.joints > 2)
        for number, state in enumerate(states.values(), start=1):
            can_id, half = (0x1A0, 0x2A0)[(number - 1) // 2], (number - 1) % 2
            estimate = decode(sent[can_id])
            read = database.decode_message(can_id, sent[can_id], decode_choices=False)
            assert estimate.status[half] == read[f"status_{number}"] == state["status"][row]
            torque = estimate.torque_nm[half]
            if torque is not None:
                assert torque == pytest.approx(state["torque_nm"][row], abs=0.0051)
                assert torque == pytest.approx(read[f"torque_{number}"])


def check_answers(reported: dict[str, Any], joints: int, *, sensor: bool) -> None:
    """What a master reads of the node, and `jtq status`."""
    assert [each["joint"] for each in reported["joints"]] == list(range(1, joints + 1))
    objects = reported["objects"]
    room = 2 if joints <= 2 else 4
    assert objects["revision"] == (0x0001_0000 if room == 2 else 0x0002_0000)
    assert [each & 0x7FF for each in objects["pdos"]] == [0x1A0, 0x2A0][: room // 2]
    assert objects["torque"][joints:] == [-0x8000] * (room - joints)
    assert objects["sigma"][joints:] == [255] * (room - joints)
    assert objects["status"][joints:] == [0] * (room - joints)
    assert all(code in (1, 2, 3, 4, 6) for code in objects["status"][:joints])
    assert [gear > 0 for gear in objects["gears"]] == [True] * joints + [False] * (room - joints)
    nodes = [*range(1, joints + 1), *[0] * (room - joints), (3 if room == 2 else 5) * sensor]
    assert objects["nodes"] == nodes
