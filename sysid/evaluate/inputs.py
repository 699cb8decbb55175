"""Methods of an evaluation: models loaded from a directory, and the estimates of every method on one joint of a run.

DIR holds jointN.yaml or joint_N.yaml (joint file; the second as `jtq init` writes it), jointN.onnx (the paper's network) and
jointN.fused.onnx (ours; without it ours is its physics alone). What is missing leaves its methods out, by name. Joint files
name the runs that they were made from in `provenance` (every mapping of a section's `sha256`), networks in the metadata key
`runs` and in a card jointN.json or jointN.fused.json beside them.

Only samples at which all methods move and have a value are scored, the same ones for each: a method must not look better
because it had no value where the others were wrong.

Runs of an evaluation: one that a model was made from is refused with all others, a broken one is named and left out.

Which joint of a run was in velocity mode (the paper's tested joint) comes from the campaign's marks, else from the data: a
velocity loop turns its current over by twice the friction within milliseconds wherever the joint reverses, and follows
every ripple; a current drive follows a smooth command. The second difference of the current over cells of 10 ms is 10 to
50 times larger in velocity mode on the emulated bench.
"""

from __future__ import annotations

import gzip
import hashlib
import re
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.decoder import parse_json, read_json
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import STANDSTILL_SIGMAS, estimate_columns, observe_run, quadrants
from jtqd.estimator.joint import Joint
from jtqd.estimator.network import AnyNetwork, load_network
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import EstimateRun, JointColumns, ObservedRun, RunTable
from jtqd.estimator.settings import METHODS, EstimatorSettings, bandwidth_of, recommended
from jtqd.estimator.status import DEGRADED, STANDSTILL, VALID
from jtqd.models.files import load_joint
from jtqd.sysid.progress import progress
from jtqd.sysid.runs.channels import Channels, RunIssue, check_channels
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run, run_paths
from jtqd.sysid.runs.run_file import RunError, RunFile
from jtqd.sysid.runs.tables import read_truth

OURS: Final = "fused"
PAPERS: Final = "network"
TITLES: Final = MappingProxyType(
    {
        **{name: METHODS[name].title for name in METHODS if name != OURS},
        "physics": "our physics",
        OURS: METHODS[OURS].title,
    }
)
"""Methods in the order of every table. `physics` is `fused` without its network, where it has one."""
PAPERS_BANDWIDTH: Final = EstimatorSettings().bandwidth_rad_s
SETTLE_S: Final = 0.1
"""The filters settle for so long after the first sample."""


def settings_of(method: str) -> EstimatorSettings:
    """Return the settings of a method of TITLES: those of a new configuration."""
    return recommended(OURS if method == "physics" else method)


# Runs that a model was made from -----------------------------------------------------------------------------------------

_RUNS: Final = "runs"
_COMPRESSION: Final = 6
"""Of run files as this toolbox writes them (jtqd.sysid.runs.tables)."""


def run_hashes(path: Path) -> tuple[str, ...]:
    """Return the SHA-256 of a run file, and that of the same data packed or unpacked: a copy is the same data."""
    data = path.read_bytes()
    hashes = [hashlib.sha256(data).hexdigest()]
    try:
        other = (
            gzip.decompress(data) if path.name.endswith(".gz") else gzip.compress(data, _COMPRESSION, mtime=0)
        )
    except (OSError, EOFError, zlib.error):  # not a run, which its reader reports
        return tuple(hashes)
    return (*hashes, hashlib.sha256(other).hexdigest())


def _joint_runs(name: str, joint: Joint) -> dict[str, frozenset[str]]:
    """Return the hashes of the runs of each fitted section; a file with nominal values has none."""
    found = {}
    for section, record in joint.provenance.items():
        if isinstance(record, Mapping):
            hashes = _hashes(record.get("sha256")) | _hashes(record.get(_RUNS))
            if hashes:
                found[f"{name} ({section})"] = hashes
    return found


def _network_runs(path: Path) -> frozenset[str]:
    """Return the hashes of the runs that a network was trained on, by its metadata and its card."""
    import onnx

    model = onnx.load_model(str(path), load_external_data=False)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    hashes: frozenset[str] = frozenset()
    with suppress(ValueError):
        hashes = _hashes(parse_json(metadata.get(_RUNS, "")))
    card = path.with_suffix(".json")
    if card.is_file():
        with suppress(OSError, ValueError):
            content = read_json(card)
            hashes |= _hashes(content.get(_RUNS) if isinstance(content, dict) else None)
    return hashes


def _hashes(value: Any) -> frozenset[str]:
    """Hex SHA-256 in a mapping name -> hash or in a list; everything else is none."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if not isinstance(value, list):
        return frozenset()
    return frozenset(text.lower() for text in value if isinstance(text, str) and len(text) == 64)


# Models ------------------------------------------------------------------------------------------------------------------

_INPUTS: Final = ("current_a", "motor_position_rad", "motor_velocity_rad_s", "link_position_rad")
_MADE_BY: Final = {"fused": " (jtq fit losses)"}
"""Section of a joint file -> the command that makes it."""


@dataclass(frozen=True)
class JointModels:
    """Everything that estimates one joint.

    number: of the joint in the runs. networks: by method. methods: those that can be run, in TITLES' order. missing: the
    others, with the reason. training: SHA-256 of the runs that a network or section was made from, by its name; none for a
    network that names no runs. files: name to SHA-256.
    """

    number: int
    joint: Joint
    networks: Mapping[str, AnyNetwork]
    methods: tuple[str, ...]
    missing: Mapping[str, str]
    training: Mapping[str, frozenset[str]]
    files: Mapping[str, str]

    @property
    def without_runs(self) -> tuple[str, ...]:
        """Networks that name no training runs."""
        return tuple(name for name, hashes in self.training.items() if not hashes)

    def estimate(
        self, time_s: FloatArray, columns: JointColumns
    ) -> tuple[Mapping[str, EstimateRun], ObservedRun]:
        """Return every method's estimates of a run, and the outputs of the observer; ConfigError, ValueError."""
        runs = {
            method: estimate_columns(
                self.joint, settings_of(method), self.networks.get(method), time_s, columns
            )
            for method in self.methods
        }
        torsion = None if self.joint.fused is None else self.joint.fused.torsion
        dt = np.diff(time_s, prepend=time_s[0])
        current, motor, velocity, link = (getattr(columns, name) for name in _INPUTS)
        seen = observe_run(
            self.joint, recommended(OURS), torsion, dt, current, motor, velocity, link, columns.temperature_c
        )
        return runs, seen


def load_models(directory: Path, numbers: Sequence[int] = ()) -> tuple[JointModels, ...]:
    """Return the models of the joints `numbers`, or of every jointN.yaml there is.

    Raises:
        ConfigError: the directory or a joint file is missing or wrong, or a network is of another joint.
        NetworkError: a network file cannot be used.
    """
    if not directory.is_dir():
        raise ConfigError(
            f"--models {directory}: found no directory, expected one with joint1.yaml, joint1.onnx, ..."
        )
    there: dict[int, Path] = {}
    for path in sorted(directory.iterdir()):
        match = re.fullmatch(r"joint_?(\d)\.yaml", path.name)
        if match is None:
            continue
        number = int(match.group(1))
        if number in there:
            raise ConfigError(
                f"--models {directory}: found {path.name} and {there[number].name}, expected one of them"
            )
        there[number] = path
    absent = [number for number in numbers if number not in there]
    if absent or not there:
        wanted = " and ".join(f"joint{number}.yaml" for number in absent) or "joint1.yaml"
        have = ", ".join(there[number].name for number in sorted(there)) or "no joint file"
        raise ConfigError(f"--models {directory}: found {have}, expected {wanted}")
    return tuple(_joint_models(there[number], number) for number in sorted(set(numbers) or there))


def _joint_models(path: Path, number: int) -> JointModels:
    directory = path.parent
    joint = load_joint(path)
    files = {path.name: hashlib.sha256(path.read_bytes()).hexdigest()}
    training = _joint_runs(path.name, joint)
    networks: dict[str, AnyNetwork] = {}
    missing: dict[str, str] = {}
    for method, kind in METHODS.items():
        absent = [section for section in kind.sections if getattr(joint, section) is None]
        if absent:
            missing[method] = f"{path.name} has no section {absent[0]}{_MADE_BY.get(absent[0], '')}"
            if method == OURS:
                missing["physics"] = missing[method]
        if not kind.network:
            continue
        name = f"joint{number}{kind.network_ending}"
        source = directory / name
        if not source.exists():
            if kind.network_required:
                missing.setdefault(method, f"no {name} in {directory}")
            else:  # as jtqd runs it
                missing.setdefault("physics", f"ours is its physics, since there is no {name} in {directory}")
            continue
        network = load_network(method, str(source))
        if network.joint != joint.name:
            raise ConfigError(
                f"{source}: found a network of joint '{network.joint}', expected one of '{joint.name}'"
            )
        networks[method], files[name] = network, network.sha256
        training[name] = _network_runs(source)
    methods = tuple(method for method in TITLES if method not in missing)
    ordered = {method: missing[method] for method in TITLES if method in missing}
    return JointModels(number, joint, networks, methods, ordered, training, files)


# Samples -----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Samples:
    """Arrays [n] of one joint (`number`) in one run (`run`).

    sensor_nm: torque sensor with the delay of the paper's estimates. sensors_nm: by method, for those with a shorter delay.
    bandwidth_rad_s: by method, of the filter that makes its delay. raw_nm: G Kt i less the rotor's share, whose sign with
    the velocity's [rad/s, joint side] makes the quadrant (index into QUADRANTS). estimate_nm, sigma_nm, status: by method.
    scored: all methods move and have a value. standing: all have a value and stand still. missing: settled, but some method
    has no value. temperature_c: NaN where the run has none. bare_nm: the paper's network without the guard around it, NaN
    where there is none. true_nm: the torque of the gear, where the run is emulated and has it. reference_nm: standard
    deviation of the sensor's offset, standstill_sigmas: half width of the interval at rest in standard deviations, as the
    joint file has them.
    """

    run: str
    number: int
    rated_nm: float
    time_s: FloatArray
    sensor_nm: FloatArray
    raw_nm: FloatArray
    velocity_rad_s: FloatArray
    temperature_c: FloatArray
    quadrant: NDArray[np.intp]
    estimate_nm: Mapping[str, FloatArray]
    sigma_nm: Mapping[str, FloatArray]
    status: Mapping[str, NDArray[np.uint8]]
    scored: BoolArray
    standing: BoolArray
    missing: BoolArray
    bare_nm: FloatArray
    true_nm: FloatArray | None = None
    sensors_nm: Mapping[str, FloatArray] = field(default_factory=dict)
    bandwidth_rad_s: Mapping[str, float] = field(default_factory=dict)
    reference_nm: float = 0.0
    standstill_sigmas: float = STANDSTILL_SIGMAS

    def sensor_of(self, method: str) -> FloatArray:
        """Return the sensor [n] with the delay of a method's estimate [Nm]."""
        return self.sensors_nm.get(method, self.sensor_nm)

    def error_nm(self, method: str) -> FloatArray:
        """Estimate less sensor with the same delay [n] [Nm]."""
        return self.estimate_nm[method] - self.sensor_of(method)

    def scored_error_nm(self, method: str) -> FloatArray:
        """Error of the scored samples [Nm]."""
        return self.error_nm(method)[self.scored]

    def where(self, mask: BoolArray) -> Samples:
        """Return the same with fewer scored samples."""
        return replace(self, scored=self.scored & mask)


def take_samples(
    run: str,
    models: JointModels,
    time_s: FloatArray,
    columns: JointColumns,
    true_nm: FloatArray | None = None,
) -> Samples:
    """Estimate one joint of a run by every method.

    columns: all inputs and the sensor [n], finite. Raises ConfigError and ValueError as the estimators.
    """
    if columns.torque_nm is None:
        raise ValueError(f"{run}: j{models.number}.torque_nm: missing")
    runs, seen = models.estimate(time_s, columns)
    joint = models.joint
    dt = np.diff(time_s, prepend=time_s[0])
    rates = {
        method: bandwidth_of(joint, settings_of(method), network=method in models.networks) for method in runs
    }
    sensors = {rate: low_pass(columns.torque_nm, dt, rate) for rate in {PAPERS_BANDWIDTH, *rates.values()}}
    settled = time_s - time_s[0] >= SETTLE_S
    published = settled & np.logical_and.reduce([np.isfinite(each.torque_nm) for each in runs.values()])
    moving = np.logical_and.reduce([np.isin(each.status, (VALID, DEGRADED)) for each in runs.values()])
    standing = np.logical_and.reduce([each.status == STANDSTILL for each in runs.values()])
    section = joint.fused
    rest = None if section is None else section.standstill
    return Samples(
        run=run,
        number=models.number,
        rated_nm=joint.rated_torque_nm,
        time_s=time_s,
        sensor_nm=sensors[PAPERS_BANDWIDTH],
        raw_nm=seen.raw_nm,
        velocity_rad_s=seen.velocity_rad_s,
        temperature_c=seen.temperature_c,
        quadrant=quadrants(seen.raw_nm, seen.velocity_rad_s),
        estimate_nm={method: each.torque_nm for method, each in runs.items()},
        sigma_nm={method: each.sigma_nm for method, each in runs.items()},
        status={method: each.status for method, each in runs.items()},
        scored=published & moving,
        standing=published & standing,
        missing=settled & ~published,
        bare_nm=runs[PAPERS].network_nm if PAPERS in runs else np.full_like(time_s, np.nan),
        true_nm=true_nm,
        sensors_nm={method: sensors[rate] for method, rate in rates.items() if rate != PAPERS_BANDWIDTH},
        bandwidth_rad_s=rates,
        reference_nm=0.0 if section is None else section.sigma.reference_nm,
        standstill_sigmas=STANDSTILL_SIGMAS if rest is None else rest.sigmas,
    )


_CELL_S: Final = 0.01
_CLEAR: Final = 3.0
"""Ratio of the two joints' roughness from which on the rougher one is called the velocity joint."""


def by_marks(path: Path) -> int | None:
    """Return the velocity joint that the campaign's NAME.json beside NAME.csv.gz names, None where it does not."""
    stem = path.name.removesuffix(".gz").removesuffix(".csv")
    try:
        marks = read_json(path.with_name(f"{stem}.json"))
    except (OSError, ValueError):
        return None
    number = marks.get("velocity_joint") if isinstance(marks, dict) else None
    return number if isinstance(number, int) and not isinstance(number, bool) else None


def by_data(table: RunTable) -> int | None:
    """Return the velocity joint of a run of two joints by their currents, None where the data are ambiguous."""
    rough = {
        number: _roughness(table.time_s, columns.current_a)
        for number, columns in table.joints.items()
        if columns.current_a is not None
    }
    if len(rough) != 2:
        return None
    (_, low), (number, high) = sorted(rough.items(), key=lambda item: item[1])
    return number if high > _CLEAR * low else None


def _roughness(time_s: FloatArray, current_a: FloatArray) -> float:
    """Root mean square [A] of the second difference of the current's means over cells of 10 ms."""
    size = max(1, round(_CELL_S / float(np.median(np.diff(time_s)))))
    cells = current_a[: len(current_a) // size * size].reshape(-1, size).mean(axis=1)
    if len(cells) < 3:
        return 0.0
    return float(np.sqrt(np.mean(np.diff(cells, n=2) ** 2)))


_NEEDED = ("current_a", "motor_position_rad", "link_position_rad", "torque_nm")
"""Columns of a joint that must have been measured; the motor's velocity may be derived."""


class EvaluatedRun(NamedTuple):
    """One run: columns by joint number, complete and checked; velocity_joint None: not known; `by`: marks or data.

    truth: true torque [n] by joint, empty where the run has none.
    """

    name: str
    sha256: str
    table: RunTable
    columns: Mapping[int, JointColumns]
    velocity_joint: int | None
    by: str
    truth: Mapping[int, FloatArray] = MappingProxyType({})


class Inputs(NamedTuple):
    """runs: at least one joint of each can be scored; findings: what was left out; notes: of the reader."""

    runs: tuple[EvaluatedRun, ...]
    findings: tuple[RunIssue, ...]
    notes: tuple[str, ...]


def read_inputs(
    arguments: Sequence[Path], models: Sequence[JointModels], columns: Path | None = None
) -> Inputs:
    """Read and check all runs; a progress bar on a terminal.

    Raises:
        ConfigError: models were fitted to, or trained on, one of them, one line per run; the column map.
        RunError: a path that does not exist, or a directory without a run.
    """
    paths = run_paths(arguments)
    mapping = None if columns is None else ColumnMap.load(columns)
    _refuse_trained_on(paths, models)
    runs: list[EvaluatedRun] = []
    findings: list[RunIssue] = []
    notes: list[str] = []
    for path in progress(paths, "reading runs"):
        name = path.name if all(path.name != run.name for run in runs) else str(path)
        try:
            file = read_run(path, mapping, joints=[each.number for each in models])
        except RunError as error:
            findings.append(RunIssue("unreadable", f"{error}: run left out"))
            continue
        twin = next((run.name for run in runs if run.sha256 == file.sha256), None)
        if twin is not None:
            findings.append(
                RunIssue("twice", f"{name}: found the same data as in {twin}: left out, scored once")
            )
            continue
        run, found = _evaluated(name, file, models, path)
        findings += found
        notes += [f"{name}: {note}" for note in file.notes]
        if run.columns:
            runs.append(run)
    return Inputs(tuple(runs), tuple(findings), tuple(notes))


def _refuse_trained_on(paths: Sequence[Path], models: Sequence[JointModels]) -> None:
    """Raise ConfigError when a file holds the data of a run that a model was made from."""
    leaks = []
    for path in filter(Path.is_file, paths):
        hashes = set(run_hashes(path))
        names = [name for each in models for name, runs in each.training.items() if hashes & runs]
        if names:
            leaks.append(f"{path}: found a run that {', '.join(dict.fromkeys(names))} was trained on")
    if leaks:
        raise ConfigError("\n".join(leaks) + "\nexpected held-out runs: nothing was scored")


def _evaluated(
    name: str, file: RunFile, models: Sequence[JointModels], path: Path
) -> tuple[EvaluatedRun, list[RunIssue]]:
    usable: dict[int, JointColumns] = {}
    findings: list[RunIssue] = []
    for each in models:
        found = _check(name, file, each.number, each.joint)
        findings += found
        if not found:
            usable[each.number] = file.table.joint(each.number, each.joint.gear_ratio)
    marked = by_marks(path)
    number = marked if marked is not None else by_data(file.table)
    by = "unknown" if number is None else "data" if marked is None else "marks"
    truth: Mapping[int, FloatArray] = {}
    try:
        truth = read_truth(path)
        if any(len(values) != len(file.table.time_s) for values in truth.values()):
            raise ValueError(
                f"{path}: found true torques of another length than the run's {len(file.table.time_s)} rows"
            )
    except ValueError as error:
        findings.append(RunIssue("truth", f"{error}: not scored against the true torque"))
        truth = {}
    return EvaluatedRun(name, file.sha256, file.table, usable, number, by, truth), findings


def _check(name: str, file: RunFile, number: int, joint: Joint) -> list[RunIssue]:
    """Return the reasons to leave out a joint of a run."""
    where = f"{name}: j{number}"
    if number not in file.table.joints:
        return [RunIssue("missing_joint", f"{where}: found no columns of this joint: not scored")]
    columns = file.table.joints[number]
    dead = [note for note in file.notes if note.startswith(f"j{number}.")]
    missing = [key for key in _NEEDED if getattr(columns, key) is None]
    if dead:
        return [RunIssue("dead_channel", f"{name}: {note}: j{number} not scored") for note in dead]
    if missing:
        return [RunIssue("missing_columns", f"{where}: found no {', '.join(missing)}: not scored")]
    known = number in file.known_loads
    found = check_channels(Channels(file.table.time_s, columns, joint, where, known))
    return [RunIssue(item.kind, f"{item.text}: j{number} not scored") for item in found]
