"""A replay from logs to results: reading, estimating, comparing. No output; `jtq replay` calls it.

What comes out is bit for bit what the loop had, or something differs. Taken from the log is what only the loop could know:
which inputs counted, how long a step was, that an estimate was ready too late. Everything else (positions that roll over,
temperatures and their age, estimate, status, the bytes of the estimate PDO) is computed from the raw frames again.
"""

from __future__ import annotations

import hashlib
import tempfile
import time
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from jtqd.daemon.core.input_pdos import input_pdos, joint_temperatures
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.joint import JointCycle, contacts_of
from jtqd.daemon.core.status import JointSafety
from jtqd.daemon.logs import LogError
from jtqd.daemon.replay.compare import Comparison, Identity, compare, identity
from jtqd.daemon.replay.logged import (
    NO_STATES,
    SAMPLE,
    SHADOW,
    STRETCH_CYCLES,
    EstimatorStates,
    Inputs,
    Progress,
    Run,
    Setup,
    Steps,
    lost_cycles,
    offsets,
    read_runs,
)
from jtqd.daemon.replay.rows import CycleRows
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.estimator.arrays import BoolArray, FloatArray, RecordArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import Estimator, make_estimator
from jtqd.estimator.joint import Joint
from jtqd.estimator.network import NATIVE_LIMIT, AnyNetwork, NetworkError, load_network
from jtqd.estimator.settings import METHODS, EstimatorSettings, bandwidth_of
from jtqd.estimator.status import learner_of, same_past
from jtqd.models.files import load_joint

_PROGRESS_CYCLES = 1 << 14
"""Between two calls of `progress`."""
_Events = defaultdict[int, list[Callable[[], object]]]
"""Row -> what happens before it."""


@dataclass(frozen=True)
class Model:
    """Model of one joint, its estimators without warm-up, and where it comes from: files with hashes, or "as logged"."""

    joint: Joint
    settings: EstimatorSettings
    network: AnyNetwork | None
    estimator: Estimator
    source: str
    shadows: tuple[Estimator, ...] = ()
    """Of its shadow methods."""


@dataclass(frozen=True)
class Replayed:
    """Result over n cycles.

    Attributes:
        joints: of each joint, `SAMPLE` [n], with shadow methods `SHADOW` behind.
        estimate: bytes of the estimate PDOs, one after the other [n, 8 * PDOs].
        temperatures_from_log: cycles whose temperature does not follow from the frames alone.
        states_differ: (joint from 1 on, cycle) after which the log has another state of the estimator than the replay.
    """

    joints: tuple[RecordArray, ...]
    estimate: npt.NDArray[np.uint8]
    temperatures_from_log: int
    states_differ: tuple[tuple[int, int], ...]


class Replayer:
    """Replay cycle by cycle; keeps the joints from one stretch of a log to the next.

    Args:
        setup: configuration and scaling.
        models: of each joint; kept as an attribute.
    """

    def __init__(self, setup: Setup, models: Sequence[Model]) -> None:
        config = setup.config
        self._setup, self.models = setup, models
        self._intake = Intake(input_pdos(config), joint_temperatures(config))
        # Counters of the loop in shared memory; not read here.
        unread = SimpleNamespace(
            counters=array("Q", [0] * len(COUNTERS)),
            errors=array("d", [0.0] * 3 * cr.MOST_JOINTS),
            shadow_errors=array("d", [0.0] * 3 * cr.MOST_JOINTS * len(cr.SHADOW_METHODS)),
        )
        self._joints = [
            JointCycle(
                n,
                inputs,
                model.estimator,
                intake=self._intake,
                snapshot=unread,
                period_ns=config.period_ns,
                safety=JointSafety(
                    config.safety, model.settings, model.joint, config.period_ns, model.network is not None
                ),
                shadows=model.shadows,
            )
            for n, (inputs, model) in enumerate(zip(setup.inputs, models, strict=True))
        ]
        self._kind = np.dtype(SAMPLE.descr + (SHADOW.descr if models[0].shadows else []))
        self._unknown = [True] * len(self._joints)
        self.lost = (
            False  # cycles: what shadow methods have learned is not known, the log has no state of them
        )
        self._states_differ: list[tuple[int, int]] = []
        self._contacts = contacts_of(config)
        self._time_ns = [1 << 60] * len(self._joints)  # any but 0: that is a joint without a sample yet

    def run(
        self,
        joints: Sequence[RecordArray],
        inputs: Inputs,
        steps: Sequence[Steps],
        progress: Callable[[int], None] = lambda _: None,
        states: Sequence[EstimatorStates] = (),
    ) -> Replayed:
        """Replay the cycles of one stretch; `joints` are its states as logged. `progress` is called with the cycles done.

        states: of each joint, states of its estimator in the log. The first one after a place where the state was not known
        is continued from; the others are compared.
        """
        count = len(joints[0])
        events: _Events = defaultdict(list)
        celsius = self._temperatures(inputs, joints, events)
        for n in range(len(self._joints)):
            known = states[n] if states else NO_STATES
            for row, event in self._marks(n, joints[n], inputs, steps[n], known):
                events[row].append(event)
        times = np.array(
            [start + np.cumsum(each.dt_ns) for start, each in zip(self._time_ns, steps, strict=True)]
        )
        rows = CycleRows(
            self._intake,
            self._joints,
            fresh=[each.fresh for each in inputs.pdos],
            values=[each.values for each in inputs.pdos],
            velocity=[each["motor_velocity_rad_s"] for each in joints],
            celsius=celsius,
            cycle=joints[0]["cycle"],
            counter=joints[0]["sync_counter"],
            sync_ns=times,
            wanted=[(each["input_flags"] & cr.FLAG_NETWORK_SKIPPED) == 0 for each in joints],
            contacts=self._contacts,
            flags=[each["cycle_flags"] for each in joints],
        )
        for first, end in pairwise(sorted({*events, *range(0, count, _PROGRESS_CYCLES), count})):
            for happen in events.get(first, ()):
                happen()
            rows.go_on(first, end)
            progress(end)
        if count:
            self._time_ns = times[:, -1].tolist()
        samples = tuple(each.view(self._kind)[:, 0] for each in rows.samples)
        differ, self._states_differ = tuple(self._states_differ), []
        return Replayed(samples, rows.estimates, rows.temperatures_from_log, differ)

    def _temperatures(
        self, inputs: Inputs, joints: Sequence[RecordArray], events: _Events
    ) -> list[FloatArray]:
        """Return each joint temperature as logged [n]; its frames are events.

        A node that restarted is not believed until it is configured, and a frame may have found no room in its record: where
        the log has another temperature than the frames, the log is right.
        """
        celsius: list[FloatArray] = []
        for index, frames in enumerate(inputs.temperatures):
            number = next(n for n, each in enumerate(self._setup.inputs) if each.temperature == index)
            known = (joints[number]["input_flags"] & cr.FLAG_TEMPERATURE) != 0
            celsius.append(np.where(known, joints[number]["temperature_c"], np.nan))
            for row, frame in frames:
                events[row].append(partial(self._intake.receive_temperature, index, frame))
        return celsius

    def _marks(
        self, number: int, records: RecordArray, inputs: Inputs, steps: Steps, states: EstimatorStates
    ) -> Iterator[tuple[int, Callable[[], object]]]:
        """Yield the events of one joint by row: continuation after a gap in the log, reset of faults, restart."""
        joint, each = self._joints[number], self._setup.inputs[number]
        for row, _ in steps.breaks:
            yield row, partial(self._lose, number, offsets(inputs.pdos, records, each, row))
        for row, content in states.rows(records["cycle"]).items():
            yield row, partial(self._meet, number, int(records["cycle"][row]) - 1, content)
        for row in np.flatnonzero(records["cycle_flags"] & cr.FLAG_RESET).tolist():
            yield row, joint.reset_latch
        for row in steps.begins.tolist():
            yield row, partial(self._begin, number)

    def _begin(self, number: int) -> None:
        """Continue where a joint starts, so that all about it is known."""
        self._joints[number].begin_again()
        self._unknown[number] = False

    def _lose(self, number: int, offset: tuple[int, int]) -> None:
        """Continue behind missing cycles, with these roll-overs of the positions."""
        self._joints[number].resume(*offset)
        self._unknown[number] = self.lost = True

    def _meet(self, number: int, cycle: int, content: bytes) -> None:
        """Compare the estimator's state with that of the log after `cycle`, and continue from the latter."""
        learner = learner_of(self._joints[number].estimator)
        if learner is None or learner.past == content:
            return
        if not self._unknown[number]:
            self._states_differ.append((number + 1, cycle))
        learner.past = content
        self._unknown[number] = False


# ---- models: those that the log carries, or others from a directory ----

AS_LOGGED = "as logged"
_ANY_JOINT = "extended.joint.yaml"


def models_of(setup: Setup, directory: Path | None = None, method: str | None = None) -> list[Model]:
    """Return the log's models, those in `directory` in their place, with another method. Raises ConfigError, NetworkError.

    Joint files are `jointN.yaml` or `extended.jointN.yaml`, or `extended.joint.yaml` for the joint of that name;
    networks `jointN.fused.onnx` for method fused, `jointN.onnx` for network. Files that are not there stay as logged.
    """
    logged = setup.config.estimator.method
    sent = method or logged
    methods = [sent, *(name for name in setup.config.shadow if name != sent)]
    if directory is not None and not directory.is_dir():
        raise ConfigError(f"{directory}: not a directory, expected one with joint files and networks")
    found = []
    for number, each in enumerate(setup.config.joints, start=1):
        joint, files = each.joint, []
        path = None if directory is None else _joint_file(directory, number, joint)
        if path is not None:
            joint = load_joint(path)
            files.append(path)
        networks: dict[str, AnyNetwork] = {}
        for name, file in {logged: each.network, **each.shadow_networks}.items():
            if file is not None and name in methods:
                networks[name] = load_network(name, str(file.path), file.sha256)
        for name in (each for each in methods if directory is not None and METHODS[each].network):
            path = Path(directory or "") / f"joint{number}{METHODS[name].network_ending}"
            if path.is_file():
                networks[name] = load_network(name, str(path))
                files.append(path)
        names = ", ".join(f"{file} ({hashlib.sha256(file.read_bytes()).hexdigest()[:12]})" for file in files)
        settings = [replace(setup.config.estimator, method=name) for name in methods]
        estimator, *shadows = (make_estimator(joint, one, networks.get(one.method)) for one in settings)
        network, source = networks.get(sent), names or AS_LOGGED
        found.append(Model(joint, settings[0], network, estimator, source, tuple(shadows)))
    if directory is not None and all(each.source == AS_LOGGED for each in found):
        every = [name for number in range(1, len(found) + 1) for name in _joint_names(number)]
        names = ", ".join([*every, _ANY_JOINT])
        raise ConfigError(
            f"{directory}: found no file for these joints, expected one of {names} or a network"
        )
    return found


def _joint_names(number: int) -> tuple[str, str]:
    return f"joint{number}.yaml", f"extended.joint{number}.yaml"


def _joint_file(directory: Path, number: int, logged: Joint) -> Path | None:
    """File of joint `number` in the directory, None without. Raises ConfigError for two of them."""
    found = [directory / name for name in _joint_names(number) if (directory / name).is_file()]
    if len(found) > 1:
        raise ConfigError(f"{directory}: found {found[0].name} and {found[1].name}, expected one of them")
    if found:
        return found[0]
    path = directory / _ANY_JOINT
    return path if path.is_file() and load_joint(path).name == logged.name else None


# ---- results ----


@dataclass(frozen=True)
class Result:
    """Replay of one run, or of one stretch of a long one.

    Attributes:
        run: its logs and states.
        models: of each joint.
        read_s, replay_s: wall time of reading and of estimating.
        from_si: inputs whose frame was not in the log, from the SI values beside it.
        temperatures_from_log: the same of temperatures.
        identity: comparison bit for bit, with the logged models only.
        comparisons: of each joint.
        joints: estimates of each joint, fields as in `Replayed`.
    """

    run: Run
    models: Sequence[Model]
    read_s: float
    replay_s: float
    from_si: int
    temperatures_from_log: int
    identity: Identity | None
    comparisons: tuple[Comparison, ...]
    joints: tuple[RecordArray, ...]

    @property
    def seconds(self) -> float:
        """Return the length of the run."""
        return self.run.cycles * self.run.setup.config.period_ns * 1e-9

    @property
    def lost(self) -> int:
        """Return cycles that are missing in the middle of the logs."""
        return lost_cycles(self.run.joints[0], self.run.setup.config)

    @property
    def good(self) -> bool:
        """Return whether there is no unexplained difference."""
        return self.identity is None or self.identity.explained

    @property
    def method(self) -> str:
        """Return the method of the estimator."""
        return self.models[0].settings.method


def content(result: Result) -> dict[str, Any]:
    """Return a result as an object of `jtq.replay/1`."""
    same = result.identity
    cycle = result.run.joints[0]["cycle"]
    plain: dict[str, Any] = {
        "logs": [str(log) for log in result.run.logs],
        "cycles": result.run.cycles,
        "first_cycle": int(cycle[0]),
        "last_cycle": int(cycle[-1]),
        "seconds": result.seconds,
        "method": result.method,
        "models": [each.source for each in result.models],
        "read_s": result.read_s,
        "replay_s": result.replay_s,
        "times_real_time": result.seconds / max(result.replay_s, 1e-9),
        "lost_cycles": result.lost,
        "inputs_from_si": result.from_si,
        "temperatures_from_log": result.temperatures_from_log,
        "identity": msgspec.to_builtins(same),
        "joints": msgspec.to_builtins(result.comparisons),
    }
    if same is not None:
        plain["identity"] |= {"bit_identical": same.whole, "explained": same.explained}
    return plain


def as_json(runs: Sequence[dict[str, Any]]) -> bytes:
    """Return what `content` made of some results as JSON (schema `jtq.replay/1`); NaN is null."""
    return msgspec.json.encode({"schema": "jtq.replay/1", "runs": runs})


# ---- replay ----


def replay(
    paths: Sequence[Path],
    model: Path | None = None,
    method: str | None = None,
    *,
    progress: Progress = lambda *_: None,
    stretch: int = STRETCH_CYCLES,
) -> Iterator[Result]:
    """Replay logs; parts of one run are joined, and a directory stands for the logs in it.

    A run of more than `stretch` cycles gives several results, one after the other. A caller that drops each before it asks
    for the next needs memory for one of them only.

    Args:
        paths: logs.
        model: directory with other joint files and networks.
        method: another method of the estimator.
        progress: see `Progress`.
        stretch: longest [cycles].

    Raises LogError, ConfigError, NetworkError: one line each; OSError.
    """
    other = model is not None or method is not None
    with tempfile.TemporaryDirectory(prefix="jtq-replay-") as scratch:
        runs = read_runs(paths, Path(scratch), progress, stretch)
        replayers: dict[int, Replayer] = {}
        while True:
            begun = time.perf_counter()
            found = next(runs, None)
            if found is None:
                return
            read_s = time.perf_counter() - begun
            run, inputs = found
            del found  # its arrays take most of the memory
            if run.number not in replayers:
                try:
                    replayers[run.number] = Replayer(run.setup, models_of(run.setup, model, method))
                except (ConfigError, NetworkError) as error:
                    if other:
                        raise
                    raise LogError(f"{run.logs[0]}: its models: {error}") from None
            replayer = replayers[run.number]
            yield _replay_run(run, inputs, replayer, other=other, progress=progress, read_s=read_s)
            del run, inputs


def _replay_run(
    run: Run, inputs: Inputs, replayer: Replayer, *, other: bool, progress: Progress, read_s: float
) -> Result:
    """Replay a run, or a stretch; `replayer`: new, or as the stretch before has left it; other: than the logged models."""
    config, models = run.setup.config, replayer.models
    begun = time.perf_counter()
    steps = run.steps()
    states = _accepted_states(run, models) if other else run.states
    replayed = replayer.run(
        run.joints, inputs, steps, lambda done: progress("replaying", done, run.cycles), states
    )
    replay_s = time.perf_counter() - begun
    same = None
    if not other:
        compared = run.joints, _comparable(replayed.joints, replayer), steps
        pdos = inputs.estimate, replayed.estimate, inputs.recorded
        same = identity(*compared, pdos, replayed.states_differ)
        if not same.explained and any(each.network is not None for each in models):
            limit = NATIVE_LIMIT * min(each.joint.rated_torque_nm for each in models)
            same = identity(*compared, pdos, replayed.states_differ, network_nm=limit)
    comparisons = []
    for n, (each, model) in enumerate(zip(config.joints, models, strict=True)):
        bandwidths = (
            bandwidth_of(each.joint, config.estimator, network=each.network is not None),
            bandwidth_of(model.joint, model.settings, network=model.network is not None),
        )
        known = _known(run, same, n + 1)
        comparisons.append(compare(n + 1, run.joints[n], replayed.joints[n], known, bandwidths))
    return Result(
        run,
        models,
        read_s,
        replay_s,
        inputs.from_si,
        replayed.temperatures_from_log,
        same,
        tuple(comparisons),
        replayed.joints,
    )


def _comparable(joints: tuple[RecordArray, ...], replayer: Replayer) -> tuple[RecordArray, ...]:
    """Return the replayed fields that must be those of the log: without shadow methods whose state is not known."""
    shadows = replayer.models[0].shadows if replayer.lost else ()
    hidden = [f"{each.settings.method}_" for each in shadows if learner_of(each) is not None]
    names = [*(SAMPLE.names or ()), *(each for each in SHADOW.names or () if not each.startswith((*hidden,)))]
    return tuple(each[names] for each in joints) if hidden else joints


def _accepted_states(run: Run, models: Sequence[Model]) -> Sequence[EstimatorStates]:
    """Return the states of the log for each model: none where something differs that the zeros were learned with."""
    if not any(len(each.cycle) for each in run.states):
        return run.states
    pairs = zip(run.states, models_of(run.setup), models, strict=True)
    return [states if same_past(old.estimator, new.estimator) else NO_STATES for states, old, new in pairs]


def _known(run: Run, same: Identity | None, joint: int) -> BoolArray:
    """Return cycles [n] whose state was known, as far as the comparison with the logged models has found out."""
    cycle = run.joints[0]["cycle"].astype(np.int64)
    known: BoolArray = np.ones(len(cycle), np.bool_)
    for each in () if same is None else same.unknown:
        if each.joint == joint and not each.until_end:
            known &= (cycle < each.first_cycle) | (cycle >= each.first_cycle + each.cycles)
    return known
