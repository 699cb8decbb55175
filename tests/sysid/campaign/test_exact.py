"""Campaigns in exact time: when they run there, with which command, and how they end; one is driven."""

import json
import os
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from jtqd.sim_can.bench_kernel import build, guest
from jtqd.sysid.campaign import bench, command
from jtqd.sysid.campaign.bench import ProcessError
from jtqd.sysid.campaign.runner import Outcome
from jtqd.sysid.campaign.state import DONE, STATE_FILE, RunState
from jtqd.sysid.runs.files import read_run

PLAN = yaml.safe_load("""
schema: jtq.plan/1
name: small
runs:
  - name: a
    velocity_joint: 1
    segments: [{kind: plateau, velocity_rad_s: 0.5, current_a: 1.0, hold_s: 0.5}, {kind: rest, hold_s: 0.5}]
""")


@pytest.fixture
def argv(tmp_path):
    path = tmp_path / "small.plan.yaml"
    path.write_text(yaml.safe_dump(PLAN))
    return [str(path), "--out", str(tmp_path / "out")]


@pytest.fixture
def sent(monkeypatch):
    """Calls of exact time, which ends with status 3."""
    found: list[tuple[list[str], Path]] = []
    monkeypatch.setattr(command, "run_in_exact_time", lambda argv, out: found.append((list(argv), out)) or 3)
    monkeypatch.delenv(guest.TIME_TRAVEL_MARK, raising=False)
    return found


def test_bus_exact_goes_there_at_once(argv, sent, tmp_path):
    argv += ["--bus", "exact"]
    assert command.main(argv) == 3
    assert sent == [(argv, tmp_path / "out")]
    assert not (tmp_path / "out").exists(), "the directory belongs to the campaign inside"


def test_inside_of_exact_time_the_bench_is_on_its_bus(argv, sent, monkeypatch):
    buses = []
    monkeypatch.setenv(guest.TIME_TRAVEL_MARK, "1")
    monkeypatch.setattr(
        command, "_run", lambda options, *_, **__: buses.append(options.bus) or Outcome({}, "ended")
    )
    assert command.main([*argv, "--bus", "exact"]) == 1
    assert buses == [bench.EXACT_TIME_BUS]
    assert sent == []


@pytest.mark.parametrize(
    "case",  # bus, whether the bench kernel is there, whether it is used
    [("sim", True, True), ("sim", False, False), ("sim:unix:/tmp/bus", True, False), ("can0", True, False)],
)
def test_runs_that_real_time_loses_go_on_in_exact_time_on_the_emulated_bench_alone(
    argv, sent, monkeypatch, capsys, case
):
    """Never from a real bench to an emulated one, and never from a given bus to another."""
    bus, ready, goes = case
    asked = []

    def run(*_: object, exact_next: bool) -> Outcome:
        asked.append(exact_next)
        lost = {"a": RunState("stopped", "SYNC missing for 51 ms, limit 50 ms")}
        return Outcome(lost, "a: SYNC missing for 51 ms, limit 50 ms", late=exact_next)

    monkeypatch.setattr(command, "exact_time_ready", lambda: ready)
    monkeypatch.setattr(command, "_run", run)
    argv += ["--bus", bus]
    assert command.main(argv) == (3 if goes else 1)
    assert asked == [goes]
    assert [each for each, _ in sent] == ([argv] if goes else [])
    captured = capsys.readouterr()
    assert ("too busy for real time" in captured.err) == goes
    assert ("--bus exact" in captured.err) == (not goes and bus != "can0")
    assert ("ended by" in captured.out) == (not goes)


def test_a_kernel_that_does_not_boot_leaves_real_time_with_its_repeats(argv, monkeypatch, capsys):
    asked = []

    def run(*_: object, exact_next: bool) -> Outcome:
        asked.append(exact_next)
        return Outcome({"a": RunState("pending")}, "a: late", late=True) if exact_next else Outcome({})

    def boot(*_: object, **__: object) -> None:
        raise guest.GuestError("the guest ended without a result")

    monkeypatch.delenv(guest.TIME_TRAVEL_MARK, raising=False)
    monkeypatch.setattr(command, "exact_time_ready", lambda: True)
    monkeypatch.setattr(guest, "run", boot)
    monkeypatch.setattr(command, "_run", run)
    assert command.main([*argv, "--bus", "sim"]) == 0
    assert asked == [True, False]
    assert "the guest ended without a result; in real time again" in capsys.readouterr().err


def test_the_command_inside_is_the_same_on_another_bus(monkeypatch):
    ran: list[tuple[list[str], dict[str, Any]]] = []

    def run(words: list[str], **options: Any) -> SimpleNamespace:
        ran.append((words, options))
        return SimpleNamespace(returncode=3)

    monkeypatch.setattr(guest, "run", run)
    assert bench.run_in_exact_time(["validate", "--bus", "sim", "--quick"], Path("there")) == 3
    [(words, options)] = ran
    assert words[-7:] == ["campaign", "validate", "--bus", "sim", "--quick", "--bus", "sim:vcan0"]
    assert command.parser().parse_args(words[-6:]).bus == "sim:vcan0"
    assert options["time_travel"] is True
    assert options["out_dir"] == Path("there")


@pytest.mark.parametrize(
    ("raised", "words"),
    [
        (build.BuildError("no compiler"), "exact time: no compiler"),
        (build.MissingPackagesError(["flex"]), "flex"),
        (guest.GuestError("the guest ended"), "the guest ended"),
        (KeyboardInterrupt(), "the same command continues"),
    ],
)
def test_a_missing_bench_kernel_is_one_line(monkeypatch, raised, words):
    def run(*_: object, **__: object) -> None:
        raise raised

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(guest, "run", run)
    with pytest.raises(ProcessError, match=words):
        bench.run_in_exact_time(["validate"], Path("there"))
    assert signal.getsignal(signal.SIGTERM) is before


def test_sigterm_ends_the_guest(monkeypatch):
    monkeypatch.setattr(guest, "run", lambda *_, **__: os.kill(os.getpid(), signal.SIGTERM))
    with pytest.raises(ProcessError, match="ended by a signal"):
        bench.run_in_exact_time(["validate"], Path("there"))


def test_a_broken_override_of_the_kernel_is_no_kernel(monkeypatch):
    monkeypatch.setenv("JTQD_BENCH_KERNEL", "/nowhere")
    monkeypatch.delenv(guest.TIME_TRAVEL_MARK, raising=False)
    assert not bench.exact_time_ready()


@pytest.mark.boots
def test_a_run_in_exact_time_has_all_of_its_cycles(argv, tmp_path, capfdbinary):
    assert command.main([*argv, "--bus", "exact", "--json"]) == 0
    outcome = json.loads(capfdbinary.readouterr().out)
    assert outcome["missed_cycles"] == outcome["incomplete_cycles"] == {}
    [state] = json.loads((tmp_path / "out" / STATE_FILE).read_text())["runs"]
    assert (state["status"], state["missed"], state["findings"]) == (DONE, 0, [])
    table = read_run(tmp_path / "out" / "a.csv.gz").table
    steps = table.time_s[1:] - table.time_s[:-1]
    assert abs(steps - 1e-3).max() < 1e-5
