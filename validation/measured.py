"""Score the estimator on shipped runs of a real arm (models/kinova_gen3) by its torque sensor, before and after a fit.

    python -m validation measured --out DIR
    python -m validation measured --out DIR --bus unix:PATH
    python -m jtqd.sim_can.bench_kernel run --time-travel --out DIR -- python -m validation measured --bus vcan0 --out DIR

For each joint and each run the estimate is made three times: with the joint file that ships and method `tob` (before), with
losses, offset and rotor inertia fitted on the OTHER run and method `fused` without torsion (after: `sysid.fit.few_runs`),
and with no friction at all, for scale. No run is scored by a fit that has seen it. The reference is the sensor passed
through the observer's own low-pass, so that the known group delay is not counted as error.

--bus: each run is played by `jtq sim --play` as the PDOs of two drives and a sensor, jtqd runs against it before and after
the fit on the other run, and its log is compared with the sensor that came over the bus and with the offline estimate.
"""

from __future__ import annotations

import argparse
import datetime as dt
import json
import math
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jtqd.daemon.logs import LogError, Records, read_topic
from jtqd.daemon.logs.read import published_torque, reference_torque, sync_time
from jtqd.estimator.command_line import make_directory
from jtqd.estimator.decoder import decode
from jtqd.estimator.estimator import make_estimator
from jtqd.estimator.joint import Friction, Joint
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import EstimateRun, RunTable
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import DEGRADED, STALE, STANDSTILL, STARTING, VALID
from jtqd.models.files import load_joint, load_yaml, shipped
from jtqd.sim_can.bench import LONGEST_STEP_NS
from jtqd.sysid.fit.few_runs import FewRunsFit, fit_few_runs
from jtqd.sysid.fit.joint_writer import write_joint
from jtqd.sysid.fit.signals import run_signals
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run
from jtqd.sysid.runs.run_file import RunError, RunFile
from validation.study import Report, Table, UsageError

Array = NDArray[np.float64]
RUNS = ("opti_traj_testing1", "RunTrajectory1")
JOINTS = (2, 4)
SETTINGS = EstimatorSettings(method="tob", bandwidth_rad_s=200.0)
AFTER = EstimatorSettings(method="fused", bandwidth_rad_s=200.0)
"""Of the fitted joint files, which have section `fused`."""
NO_FRICTION = Friction(coulomb_nm=0.0, viscous_nms_per_rad=0.0)
AFTER_END_S = 0.3
"""jtqd runs on for so long without inputs: the status that it then publishes is part of the result."""
_PUBLISHED = (VALID, DEGRADED, STANDSTILL)
_ALL_INPUTS = 7  # input_flags: both PDOs of the drive and the sensor's
_SILENT = "#d9d9e6"
_STANDING_LABEL = "standstill: the estimate is the middle of an interval"
_PLAY_PRIORITY = 70  # real-time, below jtqd's loop
_START_S, _END_S = 60.0, 120.0


@dataclass(frozen=True)
class Score:
    """Error of an estimate against the sensor, in Nm, over the rows that have an estimate."""

    rmse_nm: float
    p95_nm: float
    max_nm: float
    rows: int


@dataclass(frozen=True)
class Case:
    """One joint in one run. Arrays [n]; `reference_nm` is the sensor through the observer's low-pass.

    At standstill the estimate is the middle of an interval as wide as the friction, no more.
    """

    joint: int
    run: str
    fitted_on: str
    rated_nm: float
    time_s: Array
    reference_nm: Array
    before_nm: Array
    after_nm: Array
    standstill: NDArray[np.bool_]
    no_friction: Score
    before: Score
    after: Score


def score(estimate_nm: Array, sensor_nm: Array, dt_s: Array, bandwidth_rad_s: float) -> Score:
    """Compare an estimate [n] with the sensor [n] filtered like it; rows whose estimate is NaN do not count.

    dt_s[k] is the step that ends at row k; dt_s[0] is not used. Raises ValueError without a single estimate.
    """
    error = estimate_nm - low_pass(sensor_nm, dt_s, bandwidth_rad_s)
    size = np.abs(error[np.isfinite(error)])
    if not len(size):
        raise ValueError("found no row with an estimate, expected at least one")
    return Score(
        math.sqrt(float(np.mean(size**2))), float(np.quantile(size, 0.95)), float(np.max(size)), len(size)
    )


def estimate(joint: Joint, table: RunTable, number: int) -> EstimateRun:
    """Estimate joint `number` of a run; torque is NaN where none would be published. Raises RunTableError."""
    settings = SETTINGS if joint.fused is None else AFTER
    dt_s, current, position, velocity, link = table.estimator_inputs(number, joint.gear_ratio)
    temperature = table.joints[number].temperature_c
    return make_estimator(joint, settings).run(dt_s, current, position, velocity, link, temperature)


def fit(joint: Joint, file: RunFile, *, number: int, run: str) -> FewRunsFit:
    """Fit a joint to one run, by its motor side alone. Raises LossFitError, RunTableError, ValueError."""
    columns = file.table.joint(number, joint.gear_ratio)
    return fit_few_runs([run_signals(run, joint, SETTINGS, file.table.time_s, columns)], joint)


def fitted_joint(joint: Joint, found: FewRunsFit, file: RunFile, *, run: str, date: str) -> Joint:
    """Return the fitted joint, and where it comes from."""
    origin: dict[str, object] = {
        "fused": f"fitted on {run}.csv.gz by jtq measured, and rotor_inertia_kgm2; no other value was fitted",
        "few_runs": found.lines(),
        "log_sha256": file.sha256,
        "date": date,
    }
    return replace(
        joint,
        fused=found.fused,
        rotor_inertia_kgm2=found.joint.rotor_inertia_kgm2,
        provenance={**joint.provenance, **origin},
    )


def compare(joint: Joint, after: Joint, table: RunTable, *, number: int, run: str, fitted_on: str) -> Case:
    """Estimate one joint in one run before and after, and score both."""
    sensor = table.joints[number].torque_nm
    if sensor is None:
        raise RunError(
            f"{run}: found no usable column j{number}.torque_nm, expected a reference to compare with"
        )
    dt_s = table.dt_s
    estimates = [estimate(j, table, number) for j in (replace(joint, friction=NO_FRICTION), joint, after)]
    none, old, new = (score(e.torque_nm, sensor, dt_s, SETTINGS.bandwidth_rad_s) for e in estimates)
    return Case(
        joint=number,
        run=run,
        fitted_on=fitted_on,
        rated_nm=joint.rated_torque_nm,
        time_s=table.time_s,
        reference_nm=low_pass(sensor, dt_s, SETTINGS.bandwidth_rad_s),
        before_nm=estimates[1].torque_nm,
        after_nm=estimates[2].torque_nm,
        standstill=estimates[2].status == STANDSTILL,
        no_friction=none,
        before=old,
        after=new,
    )


def evaluate(joint_files: Path | None, date: str) -> tuple[list[Case], dict[tuple[int, str], FewRunsFit]]:
    """Score all joints in all runs; return the cases, and the fits by (joint, run).

    Args:
        joint_files: folder for the fitted joint files; None: they are not written.
        date: for their provenance.

    Raises:
        RunError, RunTableError, ConfigError, LossFitError, ValueError, OSError: a file cannot be used.
    """
    columns = ColumnMap.load(shipped("kinova_gen3/columns.yaml"))
    files = {run: read_run(shipped(f"kinova_gen3/{run}.csv.gz"), columns) for run in RUNS}
    cases: list[Case] = []
    fits: dict[tuple[int, str], FewRunsFit] = {}
    for number in JOINTS:
        joint = load_joint(columns.joint_files[number])
        for run, other in (RUNS, RUNS[::-1]):
            found = fits[number, other] = fit(joint, files[other], number=number, run=other)
            after = fitted_joint(joint, found, files[other], run=other, date=date)
            cases.append(compare(joint, after, files[run].table, number=number, run=run, fitted_on=other))
            if joint_files is not None:
                _save(after, joint_files / f"joint{number}.fitted_on_{other}.yaml")
    return cases, fits


def _save(joint: Joint, path: Path) -> None:
    write_joint(
        path, joint, "Made by jtq measured: the shipped joint file with fitted losses and rotor inertia."
    )


class Line(NamedTuple):
    """An estimate [n], its error, and its difference to the offline estimate where there is another one."""

    label: str
    time_s: Array
    estimate_nm: Array
    error_nm: Array
    difference_nm: Array | None = None


class Panel(NamedTuple):
    """What is drawn of one run: before and after the fit; the reference and shaded times are those of the last line."""

    title: str
    lines: Sequence[Line]
    reference_nm: Array
    shades: Sequence[tuple[NDArray[np.bool_], str, str]]


def draw(panels: Sequence[Panel], path: Path) -> None:
    """Draw one column per run: torque, estimate less sensor, and the difference to the offline estimate; PNG at `path`."""
    import matplotlib as mpl
    from matplotlib import pyplot as plt

    from jtqd.sysid.report import page as parts

    mpl.use("Agg")  # files only; a display is not needed
    differences = panels[0].lines[0].difference_nm is not None
    heights = (4, 3, 2) if differences else (3, 2)
    size = (6.2 * len(panels), 7.6 if differences else 6.4)
    figure, axes = plt.subplots(
        len(heights), len(panels), figsize=size, sharex="col", squeeze=False, height_ratios=heights
    )
    for column, panel in zip(axes.T, panels, strict=True):
        for colour, line in zip((parts.BEFORE, parts.AFTER), panel.lines, strict=True):
            column[0].plot(line.time_s, line.estimate_nm, color=colour, linewidth=0.9, label=line.label)
            column[1].plot(line.time_s, line.error_nm, color=colour, linewidth=0.9)
            if line.difference_nm is not None:
                column[2].plot(line.time_s, 1e3 * line.difference_nm, color=colour, linewidth=0.6)
        time_s = panel.lines[-1].time_s
        label = "torque sensor, filtered like the estimate"
        column[0].plot(time_s, panel.reference_nm, color=parts.SENSOR, linewidth=1.4, label=label)
        low, high = column[0].get_ylim()
        column[0].set_ylim(low, high + 0.45 * (high - low))  # room for the legend
        column[0].set_title(panel.title, fontsize=10)
        column[1].axhline(0.0, color=parts.SENSOR, linewidth=0.8)
        column[-1].set_xlabel("time [s]")
        for axis in column:
            for where, colour, label in panel.shades:
                named = label if axis is column[0] and where.any() else None
                parts.shade(axis, time_s, where, colour, named)
            parts.plain(axis)
        column[0].legend(loc="upper left", fontsize=8, framealpha=0.85, edgecolor="none")
    labels = ("joint torque [Nm]", "estimate - sensor [Nm]", "published - offline [mNm]")
    for axis, label in zip(axes[:, 0], labels, strict=False):
        axis.set_ylabel(label)
    figure.tight_layout()
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)


def panel(case: Case) -> Panel:
    from jtqd.sysid.report import page as parts

    t, reference = case.time_s - case.time_s[0], case.reference_nm
    before = f"before: joint file as shipped, RMSE {case.before.rmse_nm:.2f} Nm"
    after = f"after: losses fitted on {case.fitted_on}, RMSE {case.after.rmse_nm:.2f} Nm"
    estimates = ((before, case.before_nm), (after, case.after_nm))
    lines = [Line(label, t, values, values - reference) for label, values in estimates]
    shade = (case.standstill, parts.STANDING, _STANDING_LABEL)
    return Panel(f"joint {case.joint}, {case.run}", lines, reference, [shade])


def case_table(cases: Sequence[Case]) -> Table:
    """Return RMSE per joint and run in Nm and in percent of rated torque, with what the fit did to it."""
    head = ("joint", "scored on", "fitted on", "no friction", "before", "after", "change by the fit")
    rows = []
    for case in cases:
        change = 100.0 * (case.after.rmse_nm / case.before.rmse_nm - 1.0)
        rows.append(
            (
                *(str(case.joint), case.run, case.fitted_on),
                *(percent_of(s.rmse_nm, case.rated_nm) for s in (case.no_friction, case.before, case.after)),
                f"better by {-change:.0f} %" if change < 0.0 else f"WORSE by {change:.0f} %",
            )
        )
    return Table(
        head, rows, "RMSE of the estimate against the arm's torque sensor, Nm (percent of rated torque)"
    )


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def percent_of(error_nm: float, rated_nm: float) -> str:
    """Return an error in Nm and in percent of the rated torque."""
    return f"{error_nm:.3f} ({100.0 * error_nm / rated_nm:.1f} %)"


# On a bus.


class Played(NamedTuple):
    """A joint of a run as its configuration sees it."""

    number: int
    run: str
    config: str
    table: RunTable
    joint: Joint
    settings: EstimatorSettings


@dataclass(frozen=True)
class BusRun:
    """One joint in one played run under one configuration, row by row of the log [n] (one row per cycle).

    published_nm: of the estimate PDO, NaN where it has no torque. reference_nm: the sensor as it came over the bus, filtered
    like the estimate. offline_nm: the whole-run estimate from the file at the row that was played, NaN after the run's end.
    rows: of the run; missed: SYNC slots; incomplete: cycles with an input missing; scored: rows that have both estimates and
    the sensor. replay_difference_nm: of the logged torque to a whole-run estimate of the logged inputs.
    """

    joint: int
    run: str
    config: str
    rated_nm: float
    time_s: Array
    published_nm: Array
    reference_nm: Array
    offline_nm: Array
    status: NDArray[np.uint16]
    rows: int
    missed: int
    incomplete: int
    rmse_nm: float
    offline_rmse_nm: float
    scored: int
    offline_difference_nm: float
    replay_difference_nm: float
    silent_after_end: bool


def configured(config: Path) -> tuple[tuple[Joint, Joint], EstimatorSettings]:
    """Return joints and estimator of a configuration of jtqd. Raises ConfigError."""
    mapping = load_yaml(config)
    one, two = (load_joint(config.parent / mapping[f"joint_{number}"]["file"]) for number in (1, 2))
    return (one, two), decode(EstimatorSettings, mapping["estimator"], str(config), "estimator")


def score_log(log: Path, index: int, played: Played) -> BusRun:
    """Score joint `index` (0, 1) of a log. Raises LogError when nothing of the run is in it."""
    state, frames = read_topic(log, f"/joint/{index + 1}/state"), read_topic(log, "/can/frames")
    if not np.array_equal(state["cycle"], frames["cycle"]):
        raise LogError(f"{log}: found cycles in one topic that are not in the other, expected the same")
    time_s, rows = sync_time(state["header"]["stamp"]), len(played.table.time_s)
    row = _played_row(time_s, played.table.time_s)
    running = row < rows
    published = published_torque(frames, index)
    reference = reference_torque(state, time_s, played.settings.bandwidth_rad_s)
    offline = np.full(len(time_s), np.nan)
    offline[running] = _offline(played)[row[running]]
    used = running & np.isfinite(published) & np.isfinite(reference) & np.isfinite(offline)
    if not used.any():
        raise LogError(f"{log}: found no cycle of {played.run} with estimate and sensor, expected them")
    complete = (state["input_flags"] & _ALL_INPUTS) == _ALL_INPUTS
    return BusRun(
        joint=played.number,
        run=played.run,
        config=played.config,
        rated_nm=played.joint.rated_torque_nm,
        time_s=time_s,
        published_nm=published,
        reference_nm=reference,
        offline_nm=offline,
        status=state["status"],
        rows=rows,
        missed=int(state["cycle"][running][-1]) + 1 - int(running.sum()),
        incomplete=int(np.count_nonzero(running & ~complete)),
        rmse_nm=rms((published - reference)[used]),
        offline_rmse_nm=rms((offline - reference)[used]),
        scored=int(used.sum()),
        offline_difference_nm=float(np.max(np.abs(published - offline)[used])),
        replay_difference_nm=_replay(state, played),
        silent_after_end=bool(np.isnan(published[~running]).all() and state["status"][-1] == STALE),
    )


def _played_row(time_s: Array, run_s: Array) -> NDArray[np.intp]:
    """Return the row of the run that a SYNC at time_s got: the nearest (jtqd.sim_can.play); len(run_s) after the end.

    As in the bench, a longer pause between two SYNCs than LONGEST_STEP_NS holds the run's time.
    """
    steps = np.minimum(np.diff(time_s, prepend=time_s[0]), 1e-9 * LONGEST_STEP_NS)
    middles = 0.5 * (run_s[1:] + run_s[:-1]) - run_s[0]
    end = run_s[-1] - run_s[0] + 0.5 * (run_s[-1] - run_s[-2])
    return np.searchsorted(np.append(middles, end), np.cumsum(steps), side="right")


def _offline(played: Played) -> Array:
    """Return the whole-run estimate from the file, NaN where none would be published; the drives send no temperature."""
    dt_s, current, motor, speed, link = played.table.estimator_inputs(played.number, played.joint.gear_ratio)
    result = make_estimator(played.joint, played.settings).run(dt_s, current, motor, speed, link)
    return np.where(np.isin(result.status, _PUBLISHED), result.torque_nm, np.nan)


def _replay(state: Records, played: Played) -> float:
    names = ("dt_s", "current_a", "motor_position_rad", "motor_velocity_rad_s", "link_position_rad")
    fed = np.isfinite(state["dt_s"])
    inputs = (np.asarray(state[name][fed]) for name in (*names, "temperature_c"))
    again = make_estimator(played.joint, played.settings).run(*inputs).torque_nm
    logged = state["torque_nm"][fed]
    # The loop keeps back the torque of its first cycles, and of those beside a missing input; there is none in the log.
    expected = np.isfinite(again) & ~np.isin(state["status"][fed], (STARTING, STALE))
    if not np.array_equal(np.isfinite(logged), expected):
        return float("inf")
    return float(np.max(np.abs(logged - again)[expected], initial=0.0))


class PlayError(RuntimeError):
    """The play or jtqd failed; one line with its last message."""


def config_file(run: str, after: bool) -> Path:
    """Return the configuration of jtqd for a played run: joint files as shipped, or fitted on the other run."""
    other = RUNS[1 - RUNS.index(run)]
    name = f"jtqd_after.fitted_on_{other}.yaml" if after else "jtqd_before.yaml"
    return shipped(f"kinova_gen3/{name}")


def record(bus: str, run: Path, config: Path, length_s: float, out: Path) -> tuple[Path, dict[str, Any]]:
    """Play a run, run jtqd against it, return the log and jtqd's summary. Raises PlayError.

    jtqd outlives the run by AFTER_END_S, and the play must then have ended by itself with exit status 0.
    """
    out.mkdir(parents=True, exist_ok=True)
    play = [sys.executable, "-m", "jtqd.sim_can", "--bus", bus, "--play", str(run), "--joints"]
    command = [sys.executable, "-m", "jtqd.daemon.jtqd", "--bus", bus, "--config", str(config)]
    command += ["--record", str(out), "--duration", f"{length_s + AFTER_END_S:.3f}", "--json"]
    with (
        (out / "play.log").open("wb") as log,
        _ready([*play, ",".join(map(str, JOINTS))], log) as playing,
    ):
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, stdin=subprocess.DEVNULL,
                timeout=length_s + _END_S, check=False,
            )  # fmt: skip
            status = playing.wait(_START_S) if done.returncode in (0, 3) else 0
        except subprocess.TimeoutExpired as error:
            raise PlayError(f"did not end in {error.timeout:.0f} s: {error.cmd}") from None
    (out / "jtqd.log").write_text(done.stderr)
    if done.returncode not in (0, 3):  # 3: done, with cycles missing in the log
        lines = (done.stderr or done.stdout).strip().splitlines() or ["no message"]
        raise PlayError(f"jtqd ended with exit status {done.returncode}, see {out / 'jtqd.log'}: {lines[-1]}")
    if status:
        raise PlayError(f"the play ended with exit status {status}, see {out / 'play.log'}")
    summary = json.loads(done.stdout)
    path = (summary.get("recording") or {}).get("path")
    if not path:
        raise PlayError(f"jtqd recorded nothing: {summary.get('recording')}")
    return Path(path), summary


@contextmanager
def _ready(command: list[str], log: BinaryIO) -> Iterator[subprocess.Popen[bytes]]:
    """Start the play, ready on the bus; end it with the context. Raises PlayError."""
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL)
    assert process.stderr is not None
    try:
        line = b"no message"
        for line in process.stderr:
            log.write(line)
            if line.startswith(b"bench ready"):
                break
        else:
            raise PlayError(
                f"the play ended with exit status {process.wait(_START_S)}: {line.decode().strip()}"
            )
        try:  # a drive answers SYNC whatever else this machine does
            os.sched_setscheduler(process.pid, os.SCHED_FIFO, os.sched_param(_PLAY_PRIORITY))
        except PermissionError:
            print("measured: the play has no real-time priority (not permitted)", file=sys.stderr, flush=True)
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
        process.wait(_START_S)
        log.write(process.stderr.read())
        process.stderr.close()


def evaluate_bus(bus: str, out: Path) -> list[BusRun]:
    """Play and score all runs, before and after the fit, both joints. Logs stay in `out`.

    Raises:
        RunError, RunTableError, ConfigError, LogError, PlayError, OSError: a run or a log cannot be used.
    """
    columns = ColumnMap.load(shipped("kinova_gen3/columns.yaml"))
    results: list[BusRun] = []
    for run, name in product(RUNS, ("before", "after")):
        path = shipped(f"kinova_gen3/{run}.csv.gz")
        table = read_run(path, columns).table
        print(f"measured: playing {run} on {bus}, {name} the fit", file=sys.stderr, flush=True)
        config = config_file(run, name == "after")
        length_s = float(table.time_s[-1] - table.time_s[0])
        log, _ = record(bus, path, config, length_s, out / f"{run}.{name}")
        joints, settings = configured(config)
        for index, (number, joint) in enumerate(zip(JOINTS, joints, strict=True)):
            results.append(score_log(log, index, Played(number, run, name, table, joint, settings)))
    return results


def bus_table(results: Sequence[BusRun]) -> Table:
    """Return one line per joint, run and configuration."""
    head = ("joint", "run", "config", "rows", "missed", "incomplete", "scored", "on the bus", "offline")
    rows = [
        (
            *(str(r.joint), r.run, r.config, str(r.rows), str(r.missed), str(r.incomplete), str(r.scored)),
            percent_of(r.rmse_nm, r.rated_nm),
            *(f"{r.offline_rmse_nm:.3f}", f"{r.offline_difference_nm:.3f}", f"{r.replay_difference_nm:.1g}"),
            "stale, no torque" if r.silent_after_end else "NOT SILENT",
        )
        for r in results
    ]
    title = "RMSE of the published estimate against the arm's torque sensor; differences in Nm"
    return Table((*head, "bus - offline", "replay", "after the end"), rows, title)


def bus_panels(results: Sequence[BusRun]) -> list[Panel]:
    """Return what is drawn of one joint: both configurations of each run."""
    from jtqd.sysid.report import page as parts

    labels = {"before": "before: joint file as shipped", "after": "after: losses fitted on the other run"}

    def line(r: BusRun) -> Line:
        label = f"{labels[r.config]}, RMSE {r.rmse_nm:.2f} Nm"
        error, difference = r.published_nm - r.reference_nm, r.published_nm - r.offline_nm
        return Line(label, r.time_s, r.published_nm, error, difference)

    found = []
    for run in dict.fromkeys(result.run for result in results):
        own = [result for result in results if result.run == run]
        last = own[-1]
        shades = (
            (last.status == STANDSTILL, parts.STANDING, _STANDING_LABEL),
            (last.status == STALE, _SILENT, "inputs missing: status stale, no torque published"),
        )
        title = f"joint {last.joint}, {run} on the bus"
        found.append(Panel(title, list(map(line, own)), last.reference_nm, shades))
    return found


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--bus", help="play the runs on this bus (vcan0, unix:PATH) and score the published estimates of jtqd"
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="directory of the figures and jtqd's logs"
    )
    parser.add_argument(
        "--joint-files",
        type=Path,
        metavar="DIR",
        help="directory of the fitted joint files (default: the --out directory)",
    )


def run(options: argparse.Namespace) -> Report:
    if options.bus is not None and options.joint_files is not None:
        raise UsageError("--joint-files: not possible with --bus, which does not fit")
    make_directory(options.out)
    if options.bus is not None:
        results = evaluate_bus(options.bus, options.out)
        runs = [{k: x for k, x in vars(each).items() if not isinstance(x, np.ndarray)} for each in results]
        report = Report([bus_table(results)], values={"runs": runs})
        panels = {n: bus_panels([r for r in results if r.joint == n]) for n in JOINTS}
        name = "measured_bus_joint{}.png"
    else:
        cases, fits = evaluate(options.joint_files or options.out, dt.date.today().isoformat())
        notes = []
        for (joint, on), found in fits.items():
            notes += ["", f"joint {joint}, losses fitted on {on}:", *(f"  {line}" for line in found.lines())]
        report = Report([case_table(cases)], {}, notes[1:], _values(cases, fits))
        panels = {n: [panel(case) for case in cases if case.joint == n] for n in JOINTS}
        name = "measured_joint{}.png"
    try:
        for number, drawn in panels.items():
            draw(drawn, options.out / name.format(number))
    except ModuleNotFoundError as error:
        print(f"measured: no figures: {error}", file=sys.stderr)
    return report


def _values(cases: Sequence[Case], fits: dict[tuple[int, str], FewRunsFit]) -> dict[str, Any]:
    return {
        "cases": [
            {
                **{k: getattr(case, k) for k in ("joint", "run", "fitted_on", "rated_nm")},
                **{k: asdict(getattr(case, k)) for k in ("no_friction", "before", "after")},
            }
            for case in cases
        ],
        "fits": [
            {
                "joint": joint,
                "run": on,
                "terms": [asdict(term) for term in found.terms],
                "rotor_inertia_kgm2": found.joint.rotor_inertia_kgm2,
                "report": found.lines(),
            }
            for (joint, on), found in fits.items()
        ],
    }
