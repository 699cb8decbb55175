"""Score jtqd itself on the measured runs: played on a CAN bus, estimated at 1 kHz, compared from its own log.

For both runs, before and after fitting the losses on the other run: the run is played by `jtq sim --play` as the
PDOs of two drives and a sensor, jtqd runs against it and records, and the log is compared with the sensor
that came over the bus (filtered like the estimate) and with the estimate made offline from the file.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jtqd.daemon.logs import LogError, Records, read_topic
from jtqd.daemon.logs.read import published_torque, reference_torque, sync_time
from jtqd.estimator.decoder import decode
from jtqd.estimator.joint import Joint
from jtqd.estimator.methods import make_estimator
from jtqd.estimator.run import RunTable
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import DEGRADED, STALE, STANDSTILL, STARTING, VALID
from jtqd.models.files import load_joint, load_yaml, shipped
from jtqd.sim_can.bench import LONGEST_STEP_NS
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run
from validation.measured import JOINTS, RUNS, Panel, percent_of
from validation.study import Table

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

PUBLISHED = (VALID, DEGRADED, STANDSTILL)
ALL_INPUTS = 7  # input_flags: both PDOs of the drive and the sensor's
_NS = 1e-9

SILENT = "#d9d9e6"
AFTER_END_S = 0.3
"""jtqd runs on for so long without inputs: the status that it then publishes is part of the result."""
_READY = "bench ready"
_PLAY_PRIORITY = 70  # real-time, below jtqd's loop
_START_S = 60.0
_END_S = 120.0


@dataclass(frozen=True)
class BusRun:
    """One joint in one played run under one configuration, row by row of the log [n] (one row per cycle).

    `published_nm` is what stood in the estimate PDO, NaN where it has no torque. `reference_nm` is the
    sensor as it came over the bus, filtered like the estimate; `offline_nm` the whole-run estimate from the
    file at the row that was played, NaN after the run's end.
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
    rows: int  # rows of the run
    missed: int  # SYNC slots missed while the run was played
    incomplete: int  # cycles of the run that had an input missing
    rmse_nm: float  # published against reference
    offline_rmse_nm: float  # offline estimate of the same rows against the same reference
    scored: int  # rows of both
    offline_difference_nm: float  # largest |published - offline|
    replay_difference_nm: float  # largest |logged - whole-run estimate of the logged inputs|
    silent_after_end: bool  # no cycle after the run published a torque, and the last status is stale


@dataclass(frozen=True)
class Played:
    """A joint of a run as its configuration sees it."""

    number: int
    run: str
    config: str
    table: RunTable
    joint: Joint
    settings: EstimatorSettings


def configured(config: Path) -> tuple[tuple[Joint, Joint], EstimatorSettings]:
    """Joints and estimator of a configuration of jtqd. Raises ConfigError."""
    mapping = load_yaml(config)
    one, two = (load_joint(config.parent / mapping[f"joint_{number}"]["file"]) for number in (1, 2))
    return (one, two), decode(EstimatorSettings, mapping["estimator"], str(config), "estimator")


def score_log(log: Path, index: int, played: Played) -> BusRun:
    """Score joint `index` (0, 1) of a log. Raises LogError when nothing of the run is in it."""
    state, frames = read_topic(log, f"/joint/{index + 1}/state"), read_topic(log, "/can/frames")
    if not np.array_equal(state["cycle"], frames["cycle"]):
        raise LogError(f"{log}: found cycles in one topic that are not in the other, expected the same")
    time_s = sync_time(state["header"]["stamp"])
    row = _played_row(time_s, played.table.time_s)
    running = row < len(played.table.time_s)
    published = published_torque(frames, index)
    reference = reference_torque(state, time_s, played.settings.bandwidth_rad_s)
    offline = np.full(len(time_s), np.nan)
    offline[running] = _offline(played)[row[running]]
    used = running & np.isfinite(published) & np.isfinite(reference) & np.isfinite(offline)
    if not used.any():
        raise LogError(f"{log}: found no cycle of {played.run} with estimate and sensor, expected them")
    complete = (state["input_flags"] & ALL_INPUTS) == ALL_INPUTS
    after = ~running
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
        rows=len(played.table.time_s),
        missed=int(state["cycle"][running][-1]) + 1 - int(running.sum()),
        incomplete=int(np.count_nonzero(running & ~complete)),
        rmse_nm=_rms((published - reference)[used]),
        offline_rmse_nm=_rms((offline - reference)[used]),
        scored=int(used.sum()),
        offline_difference_nm=float(np.max(np.abs(published - offline)[used])),
        replay_difference_nm=_replay(state, played),
        silent_after_end=bool(np.isnan(published[after]).all() and state["status"][-1] == STALE),
    )


def _played_row(time_s: Array, run_s: Array) -> NDArray[np.intp]:
    """Row of the run that a SYNC at time_s got: the nearest (jtqd.sim_can.play); len(run_s) after the end.

    As in the bench, a longer pause between two SYNCs than LONGEST_STEP_NS holds the run's time.
    """
    steps = np.minimum(np.diff(time_s, prepend=time_s[0]), LONGEST_STEP_NS * _NS)
    middles = 0.5 * (run_s[1:] + run_s[:-1]) - run_s[0]
    end = run_s[-1] - run_s[0] + 0.5 * (run_s[-1] - run_s[-2])
    return np.searchsorted(np.append(middles, end), np.cumsum(steps), side="right")


def _offline(played: Played) -> Array:
    """Whole-run estimate from the file, as `offline` makes it; NaN where none would be published.

    Without the temperature: the played drives send none.
    """
    table, joint = played.table, played.joint
    dt_s, current, motor, velocity, link = table.estimator_inputs(played.number, joint.gear_ratio)
    result = make_estimator(joint, played.settings).run(dt_s, current, motor, velocity, link)
    return np.where(np.isin(result.status, PUBLISHED), result.torque_nm, np.nan)


def _replay(state: Records, played: Played) -> float:
    """Return the largest difference between the logged torque and a whole-run estimate of the logged inputs [Nm]."""
    fed = np.isfinite(state["dt_s"])
    names = (
        "dt_s",
        "current_a",
        "motor_position_rad",
        "motor_velocity_rad_s",
        "link_position_rad",
        "temperature_c",
    )
    again = make_estimator(played.joint, played.settings).run(
        *(np.asarray(state[name][fed]) for name in names)
    )
    logged = state["torque_nm"][fed]
    # The loop keeps back the torque of its first cycles, and of those beside a missing input; there is none in the log.
    expected = np.isfinite(again.torque_nm) & ~np.isin(state["status"][fed], (STARTING, STALE))
    if not np.array_equal(np.isfinite(logged), expected):
        return float("inf")
    return float(np.max(np.abs(logged - again.torque_nm)[expected], initial=0.0))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


class PlayError(RuntimeError):
    """The play or jtqd failed; one line with its last message."""


def config_file(run: str, after: bool) -> Path:
    """Configuration of jtqd for a played run: joint files as shipped, or fitted on the other run."""
    other = RUNS[1 - RUNS.index(run)]
    return shipped(
        f"kinova_gen3/jtqd_after.fitted_on_{other}.yaml" if after else "kinova_gen3/jtqd_before.yaml"
    )


@contextmanager
def playing(bus: str, run: Path, log_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """`jtq sim --play` on the bus, ready; ended with the context. Its log goes to `log_path`. Raises PlayError."""
    joints = ",".join(str(number) for number in JOINTS)
    command = [sys.executable, "-m", "jtqd.sim_can", "--bus", bus, "--play", str(run), "--joints", joints]
    read_end, write_end = os.pipe()
    with log_path.open("wb") as log, os.fdopen(read_end, "rb") as pipe:
        process = subprocess.Popen(command, stderr=write_end, stdin=subprocess.DEVNULL)
        os.close(write_end)
        try:
            for line in pipe:
                log.write(line)
                if line.startswith(_READY.encode()):
                    break
            else:
                raise PlayError(
                    f"the play ended with exit status {process.wait(_START_S)}: {_last_line(log_path, log)}"
                )
            _prefer(process.pid)
            yield process
        finally:
            if process.poll() is None:
                process.terminate()
            process.wait(_START_S)
            log.write(pipe.read())


def _prefer(pid: int) -> None:
    """A drive answers SYNC whatever else this machine does: real-time priority below jtqd's loop, where allowed."""
    try:
        os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(_PLAY_PRIORITY))
    except PermissionError:
        print("measured: the play has no real-time priority (not permitted)", file=sys.stderr, flush=True)


def _last_line(path: Path, log: Any) -> str:
    log.flush()
    return (path.read_text(errors="replace").strip().splitlines() or ["no message"])[-1]


def record(bus: str, run: Path, config: Path, length_s: float, out: Path) -> tuple[Path, dict[str, Any]]:
    """Play a run, run jtqd against it, return the log and jtqd's summary. Raises PlayError.

    jtqd outlives the run by AFTER_END_S, and the play must then have ended by itself with exit status 0.
    """
    out.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "jtqd.daemon.jtqd", "--bus", bus, "--config", str(config)]
    command += ["--record", str(out), "--duration", f"{length_s + AFTER_END_S:.3f}", "--json"]
    with playing(bus, run, out / "play.log") as play:
        try:
            done = subprocess.run(
                command,
                capture_output=True,
                text=True,
                stdin=subprocess.DEVNULL,
                timeout=length_s + _END_S,
                check=False,
            )
            status = play.wait(_START_S) if done.returncode in (0, 3) else 0
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


def evaluate(bus: str, out: Path) -> list[BusRun]:
    """Play and score all runs, before and after the fit, both joints. Logs stay in `out`.

    Raises:
        RunError, RunTableError, ConfigError, LogError, PlayError, OSError: a run or a log cannot be used.
    """
    columns = ColumnMap.load(shipped("kinova_gen3/columns.yaml"))
    results: list[BusRun] = []
    for run in RUNS:
        path = shipped(f"kinova_gen3/{run}.csv.gz")
        table = read_run(path, columns).table
        length_s = float(table.time_s[-1] - table.time_s[0])
        for after in (False, True):
            name = "after" if after else "before"
            print(f"measured: playing {run} on {bus}, {name} the fit", file=sys.stderr, flush=True)
            config = config_file(run, after)
            log, _ = record(bus, path, config, length_s, out / f"{run}.{name}")
            joints, settings = configured(config)
            results += [
                score_log(log, index, Played(number, run, name, table, joint, settings))
                for index, (number, joint) in enumerate(zip(JOINTS, joints, strict=True))
            ]
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


def panels(results: Sequence[BusRun]) -> list[Panel]:
    """Return what is drawn of one joint: both configurations of each run."""
    from jtqd.sysid.report import page as parts

    labels = {"before": "before: joint file as shipped", "after": "after: losses fitted on the other run"}
    found = []
    for run in dict.fromkeys(result.run for result in results):
        own = [result for result in results if result.run == run]
        last = own[-1]
        found.append(
            Panel(
                f"joint {last.joint}, {run} on the bus",
                last.time_s,
                last.reference_nm,
                [(r.published_nm, f"{labels[r.config]}, RMSE {r.rmse_nm:.2f} Nm") for r in own],
                (
                    (last.status == STANDSTILL, parts.STANDING, parts.STANDING_LABEL),
                    (last.status == STALE, SILENT, "inputs missing: status stale, no torque published"),
                ),
                [r.published_nm - r.offline_nm for r in own],
            )
        )
    return found
