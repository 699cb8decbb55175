"""Score one joint of a played run from jtqd's log: published estimate, sensor, and the offline estimate beside it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.logs.reader import LogError, Records, read_topic
from estimator.checked import Section
from estimator.parameters import Joint
from estimator.run import RunTable
from estimator.settings import EstimatorSettings
from estimator.status import DEGRADED, STALE, STANDSTILL, STARTING, VALID
from estimator.whole_run import estimate_run
from models.files import load_joint, load_yaml
from sim_can.bench import LONGEST_STEP_NS
from sysid.friction_fit import low_pass

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

PUBLISHED = (VALID, DEGRADED, STANDSTILL)
ESTIMATE_COB_ID = 0x1A0
NO_TORQUE = -0x8000
TORQUE_UNIT_NM = 0.01
ALL_INPUTS = 7  # input_flags: both PDOs of the drive and the sensor's
_NS = 1e-9


@dataclass(frozen=True)
class BusRun:
    """One joint in one played run under one configuration, row by row of the log [n] (one row per cycle).

    `published_nm` is what stood in the estimate PDO, NaN where it said "no torque". `reference_nm` is the
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
    mapping, _ = load_yaml(config)
    top = Section(mapping, str(config))
    sections = [top.section(f"joint_{number}") for number in (1, 2)]
    one, two = (
        load_joint(config.parent / section.text("file")) for section in sections if section is not None
    )
    estimator = top.section("estimator")
    assert estimator is not None  # a missing section is a ConfigError
    return (one, two), EstimatorSettings.from_section(estimator)


def published_torque(frames: Records, joint: int) -> Array:
    """Torque of joint 0 or 1 in the estimate PDO of each cycle [n]; NaN: none there, or it says "no torque"."""
    raw = frames["frames"]
    at = (raw["id"] == ESTIMATE_COB_ID) & (np.arange(raw.shape[1]) < frames["frame_count"][:, None])
    data = raw["data"][np.arange(len(raw)), np.argmax(at, axis=1)]
    counts = np.ascontiguousarray(data[:, 2 * joint : 2 * joint + 2]).view("<i2")[:, 0]
    return np.where(at.any(axis=1) & (counts != NO_TORQUE), counts * TORQUE_UNIT_NM, np.nan)


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


def as_mapping(run: BusRun) -> Mapping[str, object]:
    """The numbers of a BusRun for a program, without its arrays."""
    return {key: value for key, value in vars(run).items() if not isinstance(value, np.ndarray)}


def sync_time(stamp: Records) -> Array:
    """Time of each SYNC since the first [s]."""
    whole = (stamp["sec"].astype(np.int64) - int(stamp["sec"][0])) * 1_000_000_000
    return np.asarray((whole + stamp["nanosec"] - int(stamp["nanosec"][0])) * _NS)


def _played_row(time_s: Array, run_s: Array) -> NDArray[np.intp]:
    """Row of the run that a SYNC at time_s got: the nearest (sim_can.play); len(run_s) after the end.

    As in the bench, a longer pause between two SYNCs than LONGEST_STEP_NS holds the run's time.
    """
    steps = np.minimum(np.diff(time_s, prepend=time_s[0]), LONGEST_STEP_NS * _NS)
    middles = 0.5 * (run_s[1:] + run_s[:-1]) - run_s[0]
    end = run_s[-1] - run_s[0] + 0.5 * (run_s[-1] - run_s[-2])
    return np.searchsorted(np.append(middles, end), np.cumsum(steps), side="right")


def _offline(played: Played) -> Array:
    """Whole-run estimate from the file, as sysid.measured makes it; NaN where none would be published."""
    table, joint = played.table, played.joint
    inputs = table.estimator_inputs(played.number, joint.gear_ratio)
    result = estimate_run(joint, played.settings, None, *inputs)
    return np.where(np.isin(result.status, PUBLISHED), result.torque_nm, np.nan)


def reference_torque(state: Records, time_s: Array, bandwidth_rad_s: float) -> Array:
    """The sensor as received through the observer's low-pass; NaN where no sensor value came."""
    sensor = state["sensor_torque_nm"]
    there = np.isfinite(sensor)
    result = np.full(len(sensor), np.nan)
    if there.any():
        dt_s = np.diff(time_s[there], prepend=time_s[there][0])
        result[there] = low_pass(sensor[there], dt_s, bandwidth_rad_s)
    return result


def _replay(state: Records, played: Played) -> float:
    """Largest difference between what the loop logged and a whole-run estimate of the inputs it logged [Nm]."""
    fed = np.isfinite(state["dt_s"])
    names = ("dt_s", "current_a", "motor_position_rad", "motor_velocity_rad_s", "link_position_rad")
    again = estimate_run(
        played.joint, played.settings, None, *(np.asarray(state[name][fed]) for name in names)
    )
    logged = state["torque_nm"][fed]
    # The loop keeps its first cycles back as "starting"; there is no torque of theirs in the log.
    expected = np.isfinite(again.torque_nm) & (state["status"][fed] != STARTING)
    if not np.array_equal(np.isfinite(logged), expected):
        return float("inf")
    return float(np.max(np.abs(logged - again.torque_nm)[expected], initial=0.0))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
