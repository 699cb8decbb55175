"""Runs of a campaign: what is wrong with one, which are tried again, what ends a campaign, exit status."""

import io
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_file import load_plant
from jtqd.sysid.campaign.processes import Interrupted
from jtqd.sysid.campaign.reporter import BETWEEN_RUNS_S, Remaining, Reporter, clock_text
from jtqd.sysid.campaign.runner import (
    ATTEMPTS,
    LONGEST_GAP,
    Attempt,
    Outcome,
    _stopped,
    ends_early,
    fill,
    findings,
    gap_too_long,
    go_through,
    partial_runs,
)
from jtqd.sysid.campaign.state import DONE, FAILED, STOPPED, CampaignDirectory, RunState
from jtqd.sysid.motion.commander import Pace
from jtqd.sysid.motion.setpoints import JointSample, Limits, Monitor, MotionResult, Sample, Setpoints, Timing
from jtqd.sysid.planner.campaigns import plateau_run
from jtqd.sysid.planner.fourier import FourierSeries, FourierTrajectory
from jtqd.sysid.planner.plan import (
    DEFAULT_LIMITS,
    Fourier,
    Plan,
    Plateau,
    Rest,
    Run,
    Segment,
    check_plan,
    expand,
    marks_of,
)
from jtqd.sysid.runs.logs import LoggedRun

GAP_S = 1e-3 * LONGEST_GAP
PLAN = Plan("p", DEFAULT_LIMITS, tuple(Run(name, 1, (Rest(1.0),)) for name in ("a", "b", "c")))
GOOD = Attempt(RunState(DONE, played_s=1.0, rows=1000))
LIMIT = Attempt(RunState(STOPPED, "joint 1: current 9.1 A, limit 9 A"))
LATE = Attempt(RunState(STOPPED, "SYNC missing for 25 ms, limit 20 ms"), again=True)
GAP = Attempt(RunState(FAILED, "found a gap of 30 ms"), again=True)
NO_BENCH = Attempt(RunState(FAILED, "jtqd ended with exit status 1"), begun=False)
REFUSED = Attempt(RunState(FAILED, "no SYNC: is jtqd running on this bus?"), again=True, begun=False)
SIGNAL = Attempt(RunState(STOPPED, "SIGINT"), signalled=True)


class Script:
    """Attempts that a test prescribes, run by run; what was asked for is written down."""

    def __init__(self, **attempts: list[Attempt | BaseException]) -> None:
        self._attempts: dict[str, Iterator[Attempt | BaseException]] = {
            name: iter(each) for name, each in attempts.items()
        }
        self.asked: list[str] = []

    def __call__(self, run: Run, setpoints: Setpoints) -> Attempt:
        assert setpoints.duration_s == run.duration_s
        self.asked.append(run.name)
        found = next(self._attempts[run.name], GOOD) if run.name in self._attempts else GOOD
        if isinstance(found, BaseException):
            raise found
        return found


@pytest.fixture
def directory(tmp_path: Path) -> Iterator[CampaignDirectory]:
    made = CampaignDirectory(tmp_path)
    made.begin(PLAN, {})
    yield made
    made.close()


def gone(directory: CampaignDirectory, script: Script, **options: bool) -> Outcome:
    points = check_plan(PLAN)
    with Reporter([3.0], 3, 0, Console(file=io.StringIO())) as reporter:
        return go_through(PLAN, points, directory, reporter, script, **options)


@pytest.mark.parametrize(
    ("attempts", "options", "asked", "expected"),
    [
        ({}, {}, "abc", ([DONE, DONE, DONE], 0)),
        ({"b": [LATE]}, {}, "abbc", ([DONE, DONE, DONE], 0)),
        ({"b": [GAP, LATE]}, {}, "abbbc", ([DONE, DONE, DONE], 0)),
        ({"b": [GAP] * 9}, {}, "abbbc", ([DONE, FAILED, DONE], 3)),
        ({"b": [LIMIT]}, {}, "ab", ([DONE, STOPPED, "pending"], 1)),
        ({"b": [LIMIT]}, {"keep_going": True}, "abc", ([DONE, STOPPED, DONE], 3)),
        ({"b": [LATE] * 9}, {}, "abbbc", ([DONE, STOPPED, DONE], 3)),
        ({"b": [NO_BENCH]}, {"keep_going": True}, "ab", ([DONE, FAILED, "pending"], 1)),
        ({"b": [REFUSED]}, {}, "abbc", ([DONE, DONE, DONE], 0)),
        ({"b": [REFUSED] * 9}, {}, "abbb", ([DONE, FAILED, "pending"], 1)),
        ({"b": [SIGNAL]}, {"keep_going": True}, "ab", ([DONE, STOPPED, "pending"], 1)),
        ({"b": [Interrupted()]}, {"keep_going": True}, "ab", ([DONE, "pending", "pending"], 1)),
    ],
)
def test_what_is_tried_and_what_becomes_of_it(
    directory: CampaignDirectory,
    attempts: dict[str, list[Attempt | BaseException]],
    options: dict[str, bool],
    asked: str,
    expected: tuple[list[str], int],
) -> None:
    statuses, status = expected
    script = Script(**attempts)
    outcome = gone(directory, script, **options)
    assert "".join(script.asked) == asked
    assert [state.status for state in outcome.runs.values()] == statuses
    assert outcome.exit_status == status
    assert bool(outcome.ended) == (status == 1)
    assert all(state.attempts <= ATTEMPTS for state in outcome.runs.values())


MISSING = Attempt(
    RunState(DONE, rows=900, findings=("cycles: found 9.1% missing (90 ..), expected at most 1%",))
)
OTHER_FINDING = Attempt(RunState(DONE, rows=1000, findings=("j1.torque_nm: found no value",)))


@pytest.mark.parametrize(
    ("attempts", "asked", "late", "statuses"),
    [
        ({}, "abc", False, [DONE, DONE, DONE]),
        ({"b": [LATE]}, "ab", True, [DONE, STOPPED, "pending"]),
        ({"b": [GAP]}, "ab", True, [DONE, FAILED, "pending"]),
        ({"b": [MISSING]}, "ab", True, [DONE, FAILED, "pending"]),
        ({"b": [REFUSED]}, "ab", True, [DONE, FAILED, "pending"]),
        ({"b": [OTHER_FINDING]}, "abc", False, [DONE, DONE, DONE]),
        ({"b": [LIMIT]}, "ab", False, [DONE, STOPPED, "pending"]),
        ({"b": [SIGNAL]}, "ab", False, [DONE, STOPPED, "pending"]),
    ],
)
def test_where_exact_time_can_be_had_nothing_is_tried_again_in_real_time(
    directory: CampaignDirectory,
    attempts: dict[str, list[Attempt | BaseException]],
    asked: str,
    late: bool,
    statuses: list[str],
) -> None:
    script = Script(**attempts)
    outcome = gone(directory, script, exact_next=True)
    assert "".join(script.asked) == asked
    assert [state.status for state in outcome.runs.values()] == statuses
    assert outcome.late == late
    assert bool(outcome.ended) == (asked != "abc")


def fourier_run(name: str = "b", trajectories: int = 2) -> Run:
    segments: list[Segment] = [Rest(1.0, 0.0)]
    for number in range(trajectories):
        velocity = FourierTrajectory(2.0 * np.pi / 4.0, (0.2,), (0.1 * (number + 1),), 4.0)
        segments += [
            Fourier(velocity, FourierSeries(1.0, (1.0,), (0.5,), 4.0)),
            Rest(1.0, 0.0),
            Rest(1.0, 0.0),
        ]
    return Run(name, 1, tuple(segments))


def test_a_run_of_trajectories_is_cut_where_it_rests() -> None:
    run = fourier_run()
    one, two = partial_runs(run)
    assert (one.name, two.name) == ("b~1", "b~2")
    assert one.duration_s + two.duration_s == run.duration_s
    whole = expand(run)
    parts = [expand(piece) for piece in (one, two)]
    for name in ("velocity_rad_s", "current_a"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        assert np.array_equal(joined, getattr(whole, name))
    assert all(part.velocity_rad_s[0] == part.velocity_rad_s[-1] == 0.0 for part in parts)


def test_a_ladder_and_a_single_trajectory_are_not_cut() -> None:
    for run in (
        plateau_run("r", 2, [(1.2, 1.0), (-1.2, 3.0)], 0.8),
        fourier_run(trajectories=1),
        PLAN.runs[0],
    ):
        assert partial_runs(run) == (run,)


@pytest.mark.parametrize(
    ("attempts", "asked", "status", "pieces"),
    [
        ({}, ["b"], DONE, 1),
        ({"b": [LATE]}, ["b", "b~1", "b~2"], DONE, 2),
        ({"b": [GAP], "b~2": [LATE]}, ["b", "b~1", "b~2", "b~2"], DONE, 2),
        ({"b": [LATE], "b~1": [LATE] * 3}, ["b", "b~1", "b~1", "b~1"], STOPPED, 1),
        ({"b": [LATE], "b~1": [LIMIT]}, ["b", "b~1"], STOPPED, 1),
        ({"b": [LIMIT]}, ["b"], STOPPED, 1),
    ],
)
def test_what_is_lost_is_driven_again_in_pieces(
    tmp_path: Path,
    attempts: dict[str, list[Attempt | BaseException]],
    asked: list[str],
    status: str,
    pieces: int,
) -> None:
    plan = Plan("p", DEFAULT_LIMITS, (fourier_run(),))
    made = CampaignDirectory(tmp_path)
    made.begin(plan, {})
    script = Script(**attempts)
    with Reporter([3.0], 1, 0, Console(file=io.StringIO())) as reporter:
        outcome = go_through(plan, check_plan(plan), made, reporter, script)
    made.close()
    assert script.asked == asked
    state = outcome.runs["b"]
    assert (state.status, state.pieces, state.attempts) == (status, pieces, len(asked))
    if status == DONE:
        assert state.rows == 1000 * pieces
        for table in state.tables("b"):
            for ending in (".csv.gz", ".json", ".mcap"):
                (tmp_path / f"{table}{ending}").write_text("x")
        again = CampaignDirectory(tmp_path)
        again.begin(plan, {})
        assert again.runs["b"].status == DONE, "the pieces are its files"
        again.close()
    if "b~1" in attempts:
        assert state.reason.startswith("b~1: ")


def test_a_campaign_that_was_short_of_time_is_told_apart() -> None:
    assert Outcome({"a": LATE.state}).short_of_time
    assert Outcome({"a": RunState(FAILED, "b~1: found a gap of 30.0 ms in the log")}).short_of_time
    assert not Outcome({"a": LIMIT.state, "b": GOOD.state}).short_of_time


def test_only_what_is_not_done_is_played_when_the_command_is_repeated(directory: CampaignDirectory) -> None:
    for ending in (".csv.gz", ".json", ".mcap"):
        (directory.path / f"a{ending}").write_text("x")
    assert gone(directory, Script(b=[LIMIT])).exit_status == 1
    directory.begin(PLAN, {})
    script = Script()
    assert gone(directory, script).exit_status == 0
    assert script.asked == ["b", "c"]


def test_findings_are_told_and_make_the_exit_status_3(directory: CampaignDirectory) -> None:
    dead = Attempt(RunState(DONE, rows=9, missed=4, incomplete=2, findings=("j1.torque_nm: dead channel",)))
    outcome = gone(directory, Script(b=[dead]))
    assert outcome.exit_status == 3
    text = outcome.text()
    for words in ("3 done", "b: j1.torque_nm: dead channel", "missed 4 (b 4)", "incomplete 2 (b 2)"):
        assert words in text
    content = outcome.content()
    assert content["findings"] == {"b": ["j1.torque_nm: dead channel"]}
    assert content["missed_cycles"] == {"b": 4}
    assert content["runs"] == {"done": 3, "stopped": 0, "failed": 0, "pending": 0}


def late_reasons() -> list[str]:
    """What the commander itself says when nothing but time was against it."""
    pace = Pace(Timing(), 0)
    pace.on_sync(1_000_000, 1_000_000)
    lost = pace.watch(40_000_000)
    other = Pace(Timing(), 0)
    other.on_sync(1_000_000, 1_000_000)
    late = other.on_sync(2_000_000, 60_000_000)
    assert lost is not None
    assert late is not None
    return [lost.reason, late.reason]


def limit_reasons() -> list[str]:
    """What the monitor says of every limit."""
    fine = JointSample(0.0, 0.0, 0.0, 20.0)
    monitor = Monitor(Limits(1.0, 1.0, 1.0, 1.0, 30.0))
    samples = [
        Sample((fine._replace(current_a=2.0), fine), (0.0,)),
        Sample((fine, fine._replace(velocity_rad_s=-2.0)), (0.0,)),
        Sample((fine, fine._replace(travel_rad=2.0)), (0.0,)),
        Sample((fine, fine._replace(temperature_c=31.0)), (0.0,)),
        Sample((fine, fine), (-2.0,)),
    ]
    reasons = [monitor.check(sample) for sample in samples]
    assert all(reasons)
    return [reason for reason in reasons if reason]


def test_a_late_bus_is_tried_again_and_a_limit_never() -> None:
    for reason in late_reasons():
        assert _stopped(MotionResult("stopped", reason, 1.0)).again, reason
    for reason in [*limit_reasons(), "joint 1: fault (statusword 0218h)", "SIGINT", "SIGTERM"]:
        assert not _stopped(MotionResult("stopped", reason, 1.0)).again, reason
    assert _stopped(MotionResult("stopped", "SIGTERM", 1.0)).signalled
    assert not _stopped(MotionResult("stopped", limit_reasons()[0], 1.0)).signalled


def test_remaining_time_is_motion_plus_what_was_measured_between() -> None:
    now = [100.0]
    remaining = Remaining([10.0, 20.0, 30.0], lambda: now[0])
    assert remaining.seconds() == pytest.approx(60.0 + 3 * BETWEEN_RUNS_S)
    remaining.begin(10.0)
    assert remaining.seconds(4.0) == pytest.approx(56.0 + 3 * BETWEEN_RUNS_S)
    now[0] += 16.0  # 10 s of motion and 6 s beside it
    remaining.end()
    assert remaining.seconds() == pytest.approx(50.0 + 2 * 6.0)
    remaining.begin(20.0)
    now[0] += 26.0
    remaining.end()
    assert remaining.seconds() == pytest.approx(30.0 + 6.0)
    remaining.begin(30.0)
    now[0] += 36.0
    remaining.end()
    assert remaining.seconds() == 0.0


def test_clock_text() -> None:
    assert [clock_text(s) for s in (0, 61.6, 3723, -5)] == ["0:00", "1:02", "1:02:03", "0:00"]


def reported(terminal: bool, state: RunState) -> str:
    console = Console(file=io.StringIO(), force_terminal=terminal, width=120)
    with Reporter([2.0], 1, 0, console) as reporter:
        reporter.begin("one", 2.0)
        reporter.on_progress(1.0, 2.0)
        reporter.end("one", 2.0, state)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_a_bar_on_a_terminal_and_lines_elsewhere(capsys: pytest.CaptureFixture[str]) -> None:
    bar = reported(True, RunState(DONE, rows=7))
    assert "1/1 one" in bar
    assert "left" in bar
    assert capsys.readouterr().err == ""
    nothing = reported(False, RunState(DONE, rows=7, findings=("[dead] channel",)))
    assert nothing == ""
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "jtq campaign: run 1 of 1: one: done, 7 rows, 0 cycles missing",
        "jtq campaign: one: [dead] channel",
    ]


def test_marks_say_which_segment_was_when() -> None:
    run = Run("r", 2, (Plateau(1.0, 2.0, 0.5, 0.25), Rest(0.5)))
    plan = Plan("p", DEFAULT_LIMITS, (run,))
    marks = marks_of(run, check_plan(plan)["r"])
    assert (marks["run"], marks["velocity_joint"]) == ("r", 2)
    assert [segment["kind"] for segment in marks["segments"]] == ["ramp", "plateau", "ramp", "rest"]
    assert marks["segments"][1] == {
        "kind": "plateau",
        "start_s": 0.25,
        "end_s": 0.75,
        "velocity_joint": 2,
        "velocity_rad_s": 1.0,
        "current_a": 2.0,
    }
    assert np.isclose(marks["segments"][-1]["end_s"], run.duration_s)


Change = Callable[[dict[int, JointColumns]], None]


@lru_cache
def good_run() -> tuple[RunTable, Setpoints, tuple[Joint, Joint]]:
    """Joint 2 drives over three points, both directions; as measured on the emulated bench."""
    points = expand(plateau_run("r", 2, [(1.2, 1.0), (1.2, 3.0), (-1.2, -3.0)], 0.8))
    last = len(points) - 1
    current = JointCommand.current(lambda t: float(points.current_a[min(round(t * 1e3), last)]))
    velocity = JointCommand.velocity(lambda t: float(points.velocity_rad_s[min(round(t * 1e3), last)]))
    table = emulate_run(load_plant(shipped("plant.yaml")), (current, velocity), points.duration_s, seed=2)
    return table, points, (load_joint(shipped("joint1.yaml")), load_joint(shipped("joint2.yaml")))


def logged(table: RunTable) -> LoggedRun:
    gap = float(np.diff(table.time_s).max())
    return LoggedRun(table, missed=0, incomplete=0, incomplete_by={}, longest_gap_s=gap)


def found(change: Change | None = None) -> tuple[str, ...]:
    table, points, joints = good_run()
    columns = dict(table.joints)
    if change is not None:
        change(columns)
    return findings(logged(RunTable(table.time_s, columns)), points, joints, measured=(1, 2))


def torque(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """The same change of the sensor as both joints have it."""

    def both(columns: dict[int, JointColumns]) -> None:
        for number in (1, 2):
            values = columns[number].torque_nm
            assert values is not None
            columns[number] = replace(columns[number], torque_nm=change(np.array(values)))

    return both


def one(number: int, name: str, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def joint(columns: dict[int, JointColumns]) -> None:
        values = np.array(getattr(columns[number], name))
        columns[number] = replace(columns[number], **{name: change(values)})

    return joint


def held(values: np.ndarray) -> np.ndarray:
    values[1200:2600] = values[1200]
    return values


def without_sensor(columns: dict[int, JointColumns]) -> None:
    for number in (1, 2):
        columns[number] = replace(columns[number], torque_nm=None)


def test_a_good_run_has_nothing_to_say() -> None:
    assert found() == ()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without_sensor, ["j1.torque_nm", "no value in the whole run"]),
        (torque(lambda x: 0.0 * x), ["torque_nm", "exactly zero", "dead channel"]),
        (torque(held), ["torque_nm", "stuck"]),
        (torque(lambda x: np.clip(x, -8.0, 8.0)), ["torque_nm", "saturated"]),
        (torque(lambda x: -x), ["torque_nm", "swapped sign"]),
        (one(1, "current_a", lambda x: -x), ["j1.current_a", "opposite sign"]),
        (one(1, "current_a", lambda x: 0.7 * x), ["j1.current_a", "off the set-point"]),
        (one(2, "motor_velocity_rad_s", lambda x: 0.8 * x), ["j2.motor_velocity_rad_s", "off the set-point"]),
        (one(2, "motor_velocity_rad_s", lambda x: -x), ["j2.motor_velocity_rad_s", "opposite sign"]),
        (one(1, "link_position_rad", lambda x: -x), ["j1.link_position_rad", "swapped sign"]),
        (one(2, "link_position_rad", lambda x: 1.03 * x), ["j2", "gear ratio"]),
        (one(2, "link_position_rad", lambda x: -x), ["j2.link_position_rad", "expected -1"]),
    ],
)
def test_every_fault_is_named(change: Change, words: list[str]) -> None:
    lines = found(change)
    assert all(len(line.splitlines()) == 1 for line in lines)
    assert any(all(word in line for word in words) for line in lines), lines


def one_encoder(columns: dict[int, JointColumns]) -> None:
    for number, each in columns.items():
        columns[number] = replace(each, link_position_rad=None)


def test_joints_with_one_encoder_are_judged_by_it() -> None:
    """The motors' positions through the gears say how the links turn."""
    assert found(one_encoder) == ()

    def turned(columns: dict[int, JointColumns]) -> None:
        one_encoder(columns)
        two = columns[2].motor_position_rad
        assert two is not None
        columns[2] = replace(columns[2], motor_position_rad=1.05 * two)

    assert any(
        "j2.motor_position_rad: through the gear found it turning -1.049 times" in each
        for each in found(turned)
    )


def test_a_bench_without_a_sensor_is_not_reproached_for_it() -> None:
    table, points, joints = good_run()
    columns = dict(table.joints)
    without_sensor(columns)
    assert findings(logged(RunTable(table.time_s, columns)), points, joints, measured=()) == ()


def test_missing_cycles_are_named_above_one_percent_only() -> None:
    table, points, joints = good_run()
    run = logged(table)
    few = replace(run, missed=20, incomplete=10, incomplete_by={"joint 1": 10, "sensor": 0})
    assert findings(few, points, joints, measured=(1, 2)) == ()
    many = replace(run, missed=50, incomplete=10, incomplete_by={"joint 1": 10, "sensor": 0})
    (line,) = findings(many, points, joints, measured=(1, 2))
    for word in ("50 without a cycle", "10 incomplete: joint 1 10", "at most 1%"):
        assert word in line


def test_lost_cycles_do_not_make_a_motion_look_wrong() -> None:
    """Rows are compared with the set-point of their own time, not of their number."""
    table, points, joints = good_run()
    keep = np.random.default_rng(1).random(len(table.time_s)) > 0.3
    columns = {
        number: JointColumns(
            **{
                name: None if getattr(joint, name) is None else getattr(joint, name)[keep]
                for name in joint.__slots__
            }
        )
        for number, joint in table.joints.items()
    }
    assert findings(logged(RunTable(table.time_s[keep], columns)), points, joints, measured=(1, 2)) == ()


def with_gaps(*gaps: tuple[int, int]) -> LoggedRun:
    """A good run without the rows [first, first + count) of each gap."""
    table, _, _ = good_run()
    keep = np.ones(len(table.time_s), bool)
    for first, count in gaps:
        keep[first : first + count] = False
    columns = {
        number: JointColumns(
            **{
                name: None if getattr(joint, name) is None else getattr(joint, name)[keep]
                for name in joint.__slots__
            }
        )
        for number, joint in table.joints.items()
    }
    return logged(RunTable(table.time_s[keep], columns))


def test_a_gap_is_interpolated_and_counted() -> None:
    table, _, _ = good_run()
    whole, made = fill(with_gaps((1000, 15), (2000, 5)), GAP_S)
    assert made == 15, "a short gap is left to the readers"
    assert gap_too_long(whole, GAP_S) is None
    time_s = np.asarray(whole.table.time_s)
    assert np.abs(np.diff(time_s)[990:1020] - 1e-3).max() < 1e-9
    place = slice(1000, 1015)
    for name, worst in (("motor_position_rad", 0.05), ("link_position_rad", 1e-3), ("current_a", 0.5)):
        found = np.asarray(getattr(whole.table.joints[2], name))[place]
        assert np.abs(found - np.asarray(getattr(table.joints[2], name))[place]).max() < worst


@pytest.mark.parametrize("gaps", [((1000, 60),), ((1000, 45), (3000, 45)), ()], ids=["long", "many", "none"])
def test_what_is_too_long_or_too_much_is_not_interpolated(gaps: tuple[tuple[int, int], ...]) -> None:
    run = with_gaps(*gaps)
    assert fill(run, GAP_S) == (run, 0)
    assert (gap_too_long(run, GAP_S) is None) == (not gaps)


def test_a_log_that_lost_the_end_of_the_motion_is_not_kept() -> None:
    table, points, _ = good_run()
    assert ends_early(logged(table), points) is None
    keep = table.time_s < points.duration_s - 0.2
    joints = {n: JointColumns(current_a=columns.current_a[keep]) for n, columns in table.joints.items()}  # type: ignore[index]
    why = ends_early(logged(RunTable(table.time_s[keep], joints)), points)
    assert why is not None
    assert "found the last row of the log at" in why


def test_a_gap_that_readers_refuse_makes_a_run_gap_too_long() -> None:
    table, _, _ = good_run()
    assert gap_too_long(logged(table), GAP_S) is None
    assert gap_too_long(replace(logged(table), longest_gap_s=0.009), GAP_S) is None
    shifted = np.array(table.time_s)
    shifted[1000:] += 0.024
    why = gap_too_long(logged(RunTable(shifted, table.joints)), GAP_S)
    assert why is not None
    assert "25.0 ms" in why
    assert "at 0.999 s" in why
