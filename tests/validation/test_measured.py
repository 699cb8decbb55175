"""The measured runs: scores are what they claim, and the fit helps where the page says it does."""

import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from jtqd.daemon.logs import read_topic
from jtqd.daemon.logs.read import published_torque
from jtqd.drivers.frame import FRAME, pack
from jtqd.drivers.frame_socket import open_frame_socket
from jtqd.estimator.status import STALE, STARTING
from jtqd.models.files import load_joint, load_yaml, shipped
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run
from validation.measured import (
    AFTER,
    JOINTS,
    RUNS,
    SETTINGS,
    Case,
    Played,
    config_file,
    configured,
    evaluate,
    fit,
    record,
    score,
    score_log,
)

RUN = "RunTrajectory1"


@pytest.fixture(scope="module")
def cases() -> dict[tuple[int, str], Case]:
    return {(case.joint, case.run): case for case in evaluate(None, "2026-01-01")[0]}


def test_an_estimate_that_is_only_late_by_the_filter_scores_zero() -> None:
    dt_s = np.full(2000, 0.001)
    t = np.cumsum(dt_s) - 0.001
    # First-order low-pass of sin(w t) from rest at 0, closed form, g = 200, w = 20.
    g, w = 200.0, 20.0
    late = g * (g * np.sin(w * t) - w * np.cos(w * t) + w * np.exp(-g * t)) / (g * g + w * w)
    assert score(late, np.sin(w * t), dt_s, g).rmse_nm < 2e-4
    assert score(np.sin(w * t), np.sin(w * t), dt_s, g).rmse_nm > 0.05


def test_rows_without_an_estimate_do_not_count() -> None:
    estimate = np.array([np.nan, 3.0, 1.0, np.nan, 1.0])
    result = score(estimate, np.ones(5), np.full(5, 0.001), 200.0)
    assert result.rows == 3
    assert result.rmse_nm == pytest.approx(np.sqrt(4.0 / 3.0))
    assert result.max_nm == 2.0
    with pytest.raises(ValueError, match="no row"):
        score(np.full(5, np.nan), np.ones(5), np.full(5, 0.001), 200.0)


def test_every_case_is_judged_on_a_run_its_fit_has_not_seen(cases: dict[tuple[int, str], Case]) -> None:
    assert len(cases) == 4
    for case in cases.values():
        assert case.fitted_on != case.run
        assert case.after.rows >= 0.99 * len(case.time_s)


def test_friction_explains_most_of_the_error_and_the_fit_beats_the_guess(
    cases: dict[tuple[int, str], Case],
) -> None:
    for case in cases.values():
        assert case.after.rmse_nm < 0.4 * case.no_friction.rmse_nm
        # docs/results.md says by how much; when that changes, the page must change too
        assert case.after.rmse_nm < 0.9 * case.before.rmse_nm


def test_the_shipped_joint_files_are_what_the_shipped_runs_give() -> None:
    columns = ColumnMap.load(shipped("kinova_gen3/columns.yaml"))
    for run in RUNS:
        file = read_run(shipped(f"kinova_gen3/{run}.csv.gz"), columns)
        for number in JOINTS:
            nominal = load_joint(columns.joint_files[number])
            there = load_joint(shipped(f"kinova_gen3/joint{number}.fitted_on_{run}.yaml"))
            found = fit(nominal, file, number=number, run=run)
            assert there.fused is not None
            assert there.rotor_inertia_kgm2 == pytest.approx(found.joint.rotor_inertia_kgm2, rel=1e-6)
            for mine, shipped_side in (
                (found.fused.loss.positive, there.fused.loss.positive),
                (found.fused.loss.negative, there.fused.loss.negative),
            ):
                assert mine.constant_nm == pytest.approx(shipped_side.constant_nm, rel=1e-6)
                assert mine.viscous_nms_per_rad == pytest.approx(shipped_side.viscous_nms_per_rad, rel=1e-6)
            assert found.fused.sigma.scale == pytest.approx(there.fused.sigma.scale, rel=1e-6)
            assert there.provenance["log_sha256"] == file.sha256
            same = {"fused": None, "rotor_inertia_kgm2": nominal.rotor_inertia_kgm2}
            assert replace(there, **same, provenance=nominal.provenance) == nominal


# Over a bus.


@pytest.mark.parametrize("run", RUNS)
def test_configurations_differ_in_the_fit_alone_and_never_judge_a_run_by_its_own(run: str) -> None:
    before, after = config_file(run, False), config_file(run, True)
    other = RUNS[1 - RUNS.index(run)]
    old, new = load_yaml(before), load_yaml(after)
    for number, joint in zip((1, 2), JOINTS, strict=True):
        assert old[f"joint_{number}"].pop("file") == f"joint{joint}.yaml"
        assert new[f"joint_{number}"].pop("file") == f"joint{joint}.fitted_on_{other}.yaml"
    assert (old["estimator"].pop("method"), new["estimator"].pop("method")) == ("tob", "fused")
    assert old == new
    (joints, settings), (fitted, own) = configured(before), configured(after)
    assert settings == SETTINGS
    assert own == AFTER
    for joint, changed in zip(joints, fitted, strict=True):
        assert changed.fused is not None
        same = {"fused": None, "rotor_inertia_kgm2": joint.rotor_inertia_kgm2, "provenance": joint.provenance}
        assert replace(changed, **same) == joint


@pytest.mark.native
@pytest.mark.socketcan
def test_a_played_run_on_vcan_is_the_offline_estimate_and_then_stale(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    config, path = config_file(RUN, False), shipped(f"kinova_gen3/{RUN}.csv.gz")
    table = read_run(path, ColumnMap.load(shipped("kinova_gen3/columns.yaml"))).table
    dump = tmp_path / "dump.log"
    with dump.open("w") as file:
        candump = subprocess.Popen(["candump", "-L", "vcan0,1A0:7FF"], stdout=file)
        log, summary = record("vcan0", path, config, float(table.time_s[-1]), tmp_path)
        candump.terminate()
        candump.wait()
    joints, settings = configured(config)
    assert summary["missed"] == 0
    assert summary["recording"]["lost"] == 0

    frames = read_topic(log, "/can/frames")
    assert np.array_equal(frames["cycle"], np.arange(len(frames)))  # every cycle, none twice
    after = slice(len(table.time_s), None)
    assert len(frames[after]) >= 290
    for index, (number, joint) in enumerate(zip(JOINTS, joints, strict=True)):
        result = score_log(log, index, Played(number, RUN, "before", table, joint, settings))
        assert (result.missed, result.incomplete) == (0, 0)
        assert result.scored == len(table.time_s) - 20
        assert np.all(result.status[:20] == STARTING)
        assert np.isnan(result.published_nm[:20]).all()
        # Half a unit of the current (6078h: 1/1000 of the rated current, the joint's rated torque) and of the PDO.
        assert result.offline_difference_nm < joint.rated_torque_nm / 2000.0 + 0.005 + 1e-4
        assert result.replay_difference_nm < 1e-9
        assert result.rmse_nm == pytest.approx(result.offline_rmse_nm, abs=0.002)
        assert np.all(result.status[after] == STALE)
        assert np.isnan(result.published_nm[after]).all()
        assert result.silent_after_end
        # The score is that of the run it claims, not of the other joint's channel.
        other = score_log(log, index, Played(JOINTS[1 - index], RUN, "", table, joint, settings))
        assert other.offline_difference_nm > 1.0

    check_against_the_bus(dump, published_torque(frames, 0), published_torque(frames, 1))


def check_against_the_bus(dump, *published) -> None:
    """What the log says was published is what another node saw, and it ends with "off"."""
    seen = [bytes.fromhex(line.rsplit("#", 1)[1]) for line in dump.read_text().splitlines()]
    assert len(seen) == len(published[0]) + 1
    torque = np.array([np.frombuffer(data[:4], "<i2") for data in seen])
    for joint, values in enumerate(published):
        expected = np.where(np.isnan(values), -0x8000, np.nan_to_num(values) * 100.0)
        assert torque[:-1, joint] == pytest.approx(expected, abs=1e-6)
    assert (torque[-1] == -0x8000).all()
    assert seen[-1][6] == 0


@pytest.mark.native
def test_a_unix_bus_outlives_the_run_that_was_played_on_it(tmp_path) -> None:
    rows = "".join(f"{k / 1000},1,{0.001 * k},1,{0.001 * k}\n" for k in range(30))
    run = tmp_path / "run.csv"
    run.write_text("time_s,j1.current_a,j1.link_position_rad,j2.current_a,j2.link_position_rad\n" + rows)
    bus = f"unix:{tmp_path}/bus"
    play = subprocess.Popen(
        [sys.executable, "-m", "jtqd.sim_can", "--bus", bus, "--play", str(run)],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert play.stderr.readline() == f"bench ready on {bus}\n"
        socket = open_frame_socket(bus, None)
        socket.send(pack(0x000, bytes((1, 0))))
        answers = [answered(socket, 0.05) for _ in range(30)]
        assert answers[0] >= {0x181, 0x281, 0x182, 0x282, 0x183}
        assert not any(answers[-3:])  # at 1 ms or more between SYNCs the run is over long before
        assert play.poll() is None
        socket.send(pack(0x601, bytes((0x40, 0x00, 0x10, 0, 0, 0, 0, 0))))
        assert not socket.wait(0.1)  # silent means all services
        socket.close()
        assert play.wait(10) == 0
        assert "the run has ended" in play.stderr.read()
    finally:
        play.kill()
        play.wait()
        play.stderr.close()


def answered(socket, wait_s) -> set[int]:
    socket.send(pack(0x080, b"\x01"))
    found: set[int] = set()
    end = time.monotonic() + wait_s
    while (left := end - time.monotonic()) > 0:
        if socket.wait(left):
            count = socket.receive()
            found |= {FRAME.unpack_from(socket.frames, 16 * k)[0] for k in range(count)}
    return found - {0x701, 0x702, 0x703}
