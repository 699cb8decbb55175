"""A replay from logs to results: reading, estimating, comparing. No output; what `jtq replay` and `jtq batch` call."""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from jtqd.daemon.config import Config
from jtqd.daemon.core.joint_safety import JointSafety
from jtqd.daemon.logs import LogError, log_parts
from jtqd.daemon.replay.compare import Comparison, Identity, compare, identity, with_states
from jtqd.daemon.replay.logged import NO_STATES, EstimatorStates, Setup
from jtqd.daemon.replay.replayer import Model, Replayer, decode
from jtqd.daemon.replay.runs import (
    STRETCH_CYCLES,
    Part,
    Run,
    Steps,
    in_order,
    lost_cycles,
    read_pieces,
    stretches,
)
from jtqd.estimator.arrays import RecordArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.estimator.methods import AnyEstimator, AnyNetwork, make_estimator
from jtqd.estimator.network import NATIVE_LIMIT, load_network
from jtqd.estimator.onnx_graph import NetworkError
from jtqd.estimator.settings import METHODS, bandwidth_of
from jtqd.estimator.status import same_past
from jtqd.models.files import load_joint

# ---- models: those that the log carries, or others from a directory ----

AS_LOGGED = "as logged"
_ANY_JOINT = "extended.joint.yaml"


@dataclass(frozen=True)
class Models:
    """Models of the joints, and the files they come from, with hashes; "as logged" for those of the log."""

    joints: tuple[Model, ...]
    files: tuple[str, ...]

    def safety(self, config: Config) -> list[JointSafety]:
        """Limits of the joints by the log's configuration and these joint files."""
        return [
            JointSafety(config.safety, each.settings, each.joint, config.period_ns) for each in self.joints
        ]

    def estimators(self) -> list[AnyEstimator]:
        """Build new estimators without warm-up. Raises ConfigError."""
        return [make_estimator(each.joint, each.settings, each.network) for each in self.joints]


def logged_models(setup: Setup) -> Models:
    """Return the models of the log. Raises ConfigError, NetworkError."""
    settings = setup.config.estimator
    made = []
    for each in setup.config.joints:
        network = None
        if each.network is not None:
            network = load_network(settings.method, str(each.network.path), each.network.sha256)
        made.append(Model(each.joint, settings, network))
        make_estimator(each.joint, settings, network)  # refused here, and not when the arrays are half done
    return Models(tuple(made), (AS_LOGGED,) * len(made))


def other_models(setup: Setup, directory: Path | None, method: str | None) -> Models:
    """The log's models with what `directory` has in their place, and another method. Raises ConfigError, NetworkError.

    Joint files are `jointN.yaml` or `extended.jointN.yaml`, or `extended.joint.yaml` for the joint of that name;
    networks `jointN.fused.onnx` for method fused, `jointN.onnx` for network. What is not there stays as logged.
    """
    settings = setup.config.estimator
    if method is not None:
        settings = replace(settings, method=method)
    taken = 0
    made, files = [], []
    for number, each in enumerate(setup.config.joints, start=1):
        joint, network, said = each.joint, None, []
        path = None if directory is None else _joint_file(directory, number, each.joint)
        if path is not None:
            joint = load_joint(path)
            said.append(_named(path))
        network_path = None if directory is None else _network_file(directory, number, settings.method)
        if network_path is not None:
            network = load_network(settings.method, str(network_path))
            said.append(_named(network_path))
        elif METHODS[settings.method].network:
            network = _logged_network(setup, number, settings.method)
        taken += len(said)
        make_estimator(joint, settings, network)  # refused here, and not when the arrays are half done
        made.append(Model(joint, settings, network))
        files.append(", ".join(said) or AS_LOGGED)
    if directory is not None and not taken:
        every = [name for number in range(1, len(made) + 1) for name in _joint_names(number)]
        names = ", ".join([*every, _ANY_JOINT])
        raise ConfigError(
            f"{directory}: found no file for these joints, expected one of {names} or a network"
        )
    return Models(tuple(made), tuple(files))


def _bandwidths(run: Run, models: Models, number: int) -> tuple[float, float]:
    """Return what makes the age of joint `number`'s estimate, in the log and in the replay [rad/s]."""
    logged, replayed = run.setup.config.joints[number - 1].joint, models.joints[number - 1]
    return bandwidth_of(logged, run.setup.config.estimator), bandwidth_of(replayed.joint, replayed.settings)


def _named(path: Path) -> str:
    return f"{path} ({hashlib.sha256(path.read_bytes()).hexdigest()[:12]})"


def _joint_names(number: int) -> tuple[str, ...]:
    return f"joint{number}.yaml", f"extended.joint{number}.yaml"


def _joint_file(directory: Path, number: int, logged: Joint) -> Path | None:
    """File of joint `number` in the directory, None without. Raises ConfigError for two of them."""
    if not directory.is_dir():
        raise ConfigError(f"{directory}: not a directory, expected one with joint files and networks")
    found = [directory / name for name in _joint_names(number) if (directory / name).is_file()]
    if len(found) > 1:
        raise ConfigError(f"{directory}: found {found[0].name} and {found[1].name}, expected one of them")
    if found:
        return found[0]
    path = directory / _ANY_JOINT
    if path.is_file() and load_joint(path).name == logged.name:
        return path
    return None


def _network_file(directory: Path, number: int, method: str) -> Path | None:
    if not METHODS[method].network:
        return None
    path = directory / f"joint{number}{METHODS[method].network_ending}"
    return path if path.is_file() else None


def _logged_network(setup: Setup, number: int, method: str) -> AnyNetwork | None:
    """Return the log's network where the method is still the same; another method cannot read it."""
    file = setup.config.joints[number - 1].network
    if file is None or method != setup.config.estimator.method:
        return None
    return load_network(method, str(file.path), file.sha256)


@dataclass(frozen=True)
class ReplayOptions:
    """Options of a replay.

    Attributes:
        model: directory with other joint files and networks.
        method: another method of the estimator.
        compare: differences and errors against the sensor, too.
    """

    model: Path | None = None
    method: str | None = None
    compare: bool = False

    @property
    def other(self) -> bool:
        """Return whether a model differs from the logged one."""
        return self.model is not None or self.method is not None


@dataclass(frozen=True)
class Result:
    """Replay of one run, or of one stretch of a long one.

    Attributes:
        run: its logs and states.
        files: of the models.
        method: of the estimator.
        seconds, read_s, replay_s: length of the run; wall time of reading and of estimating.
        lost: cycles that are missing in the middle of the logs.
        from_si: inputs whose frame was not in the log, from the SI values beside it.
        temperatures_from_log: the same of temperatures.
        identity: comparison bit for bit, with the logged models only.
        comparisons: of each joint.
        joints: estimates of each joint, fields as `SAMPLE`.
    """

    run: Run
    files: tuple[str, ...]
    method: str
    seconds: float
    read_s: float
    replay_s: float
    lost: int
    from_si: int
    temperatures_from_log: int
    identity: Identity | None
    comparisons: tuple[Comparison, ...]
    joints: tuple[RecordArray, ...]

    @property
    def good(self) -> bool:
        """Return whether there is no unexplained difference."""
        return self.identity is None or self.identity.explained

    def to_mapping(self) -> dict[str, Any]:
        """Plain values for JSON."""
        first, last = self.run.parts[0].joints[0]["cycle"][0], self.run.parts[-1].joints[0]["cycle"][-1]
        return {
            "logs": [str(part.path) for part in self.run.parts],
            "cycles": self.run.cycles,
            "first_cycle": int(first),
            "last_cycle": int(last),
            "seconds": self.seconds,
            "method": self.method,
            "models": list(self.files),
            "read_s": self.read_s,
            "replay_s": self.replay_s,
            "times_real_time": self.seconds / max(self.replay_s, 1e-9),
            "lost_cycles": self.lost,
            "inputs_from_si": self.from_si,
            "temperatures_from_log": self.temperatures_from_log,
            "identity": None if self.identity is None else _plain(self.identity.to_mapping()),
            "joints": [each.to_mapping() for each in self.comparisons],
        }


def _plain(content: Any) -> Any:
    """None in place of NaN, all the way down."""
    if isinstance(content, dict):
        return {key: _plain(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_plain(value) for value in content]
    return None if isinstance(content, float) and np.isnan(content) else content


Progress = Callable[[str, int, int], None]
"""Told what is being done, how much of it, and of how much."""


def replay(
    paths: Sequence[Path], options: ReplayOptions, progress: Progress = lambda *_: None
) -> list[Result]:
    """As `replay_each`, all results at once."""
    return list(replay_each(paths, options, progress))


def replay_each(
    paths: Sequence[Path],
    options: ReplayOptions,
    progress: Progress = lambda *_: None,
    stretch: int = STRETCH_CYCLES,
) -> Iterator[Result]:
    """Replay logs; parts of one run are joined, and a directory stands for those in it.

    A run of more than `stretch` cycles gives several results, one after the other: whoever lets go of each before
    asking for the next needs memory for one of them only.

    Raises LogError, ConfigError, NetworkError: one line each; OSError.
    """
    with tempfile.TemporaryDirectory(prefix="jtq-replay-") as scratch:
        logs = in_order([log for path in paths for log in log_parts(path)])
        replayers: dict[int, Replayer] = {}
        runs = stretches(_parts(logs, Path(scratch), progress, stretch), stretch)
        while True:
            begun = time.perf_counter()
            run = next(runs, None)
            if run is None:
                return
            yield _replay_run(run, options, progress, time.perf_counter() - begun, replayers)
            del run  # its states take most of the memory


def _parts(logs: Sequence[Path], scratch: Path, progress: Progress, stretch: int) -> Iterator[Part]:
    for n, path in enumerate(logs):
        progress("reading", n, len(logs))
        directory = scratch / str(n)
        directory.mkdir(mode=0o700)
        yield from read_pieces(path, directory, stretch)


def _models(run: Run, options: ReplayOptions) -> Models:
    try:
        if options.other:
            return other_models(run.setup, options.model, options.method)
        return logged_models(run.setup)
    except (ConfigError, NetworkError) as error:
        if options.other:
            raise
        raise LogError(f"{run.parts[0].path}: its models: {error}") from None


def _replay_run(
    run: Run, options: ReplayOptions, progress: Progress, read_s: float, replayers: dict[int, Replayer]
) -> Result:
    models = _models(run, options)
    logged = run.joints
    begun = time.perf_counter()
    steps = run.steps()
    replayer = replayers.get(run.number)
    if replayer is None:
        safety = models.safety(run.setup.config)
        replayers[run.number] = replayer = Replayer(run.setup, models.estimators(), safety)
    found = _replayed(run, replayer, steps, progress, _known_pasts(run, models))
    estimate = (found.sent, found.made, found.recorded)
    replay_s = time.perf_counter() - begun
    progress("replaying", run.cycles, run.cycles)
    same = None
    if not options.other:
        same = identity(logged, found.joints, steps, estimate)
        if not same.explained and any(each.network is not None for each in models.joints):
            limit = NATIVE_LIMIT * min(each.joint.rated_torque_nm for each in models.joints)
            same = identity(logged, found.joints, steps, estimate, network_nm=limit)
        same = with_states(same, found.pasts_differ)
    comparisons = tuple(
        compare(number, *both, _known(run, same, number), _bandwidths(run, models, number))
        for number, both in enumerate(zip(logged, found.joints, strict=True), start=1)
    )
    return Result(
        run,
        models.files,
        models.joints[0].settings.method,
        run.cycles * run.setup.config.period_ns * 1e-9,
        read_s,
        replay_s,
        lost_cycles(logged[0], run.setup.config),
        found.from_si,
        found.temperatures,
        same,
        comparisons,
        found.joints,
    )


def _known(run: Run, same: Identity | None, number: int) -> npt.NDArray[np.bool_]:
    """Return cycles [n] whose state was known, as far as the comparison with the logged models has found out."""
    cycle = run.joints[0]["cycle"].astype(np.int64)
    known: npt.NDArray[np.bool_] = np.ones(len(cycle), np.bool_)
    for each in () if same is None else same.unknown:
        if each.joint == number and not each.until_end:
            known &= (cycle < each.first_cycle) | (cycle >= each.first_cycle + each.cycles)
    return known


def _tell(progress: Progress, before: int, total: int, row: int) -> None:
    progress("replaying", before + row, total)


@dataclass(frozen=True)
class _Replayed:
    """Results of all parts, one after the other."""

    joints: tuple[RecordArray, ...]
    sent: npt.NDArray[np.uint8]
    made: npt.NDArray[np.uint8]
    recorded: npt.NDArray[np.bool_]
    from_si: int
    temperatures: int
    pasts_differ: tuple[tuple[int, int], ...] = ()


def _known_pasts(run: Run, models: Models) -> list[EstimatorStates]:
    """Return the states of the log for each model: none where something differs that the zeros were learned with."""
    if not any(len(each.cycle) for each in run.pasts):
        return [NO_STATES] * len(models.joints)
    logged = logged_models(run.setup).estimators()
    pairs = zip(run.pasts, logged, models.estimators(), strict=True)
    return [pasts if same_past(old, new) else NO_STATES for pasts, old, new in pairs]


def _replayed(
    run: Run, replayer: Replayer, steps: Sequence[Steps], progress: Progress, pasts: Sequence[EstimatorStates]
) -> _Replayed:
    """Cycle by cycle, part by part: the raw frames of only one part are in memory at a time.

    `replayer`: new, or as the stretch before has left it.
    """
    done, from_si, temperatures = 0, 0, 0
    states: list[tuple[int, int]] = []
    joints, sent, made, recorded = [], [], [], []
    for part in run.parts:
        end = done + len(part.joints[0])
        frames = decode(run.setup, part.frames(), part.joints)
        here = [each.part(done, end) for each in steps]
        told = partial(_tell, progress, done, run.cycles)
        result = replayer.run(part.joints, frames, here, told, pasts)
        joints.append(result.joints)
        sent.append(frames.estimate)
        made.append(result.estimate)
        recorded.append(frames.recorded)
        from_si += frames.from_si
        temperatures += result.temperatures_from_log
        states += result.pasts_differ
        done = end
    return _Replayed(
        tuple(np.concatenate(each) for each in zip(*joints, strict=True)),
        np.concatenate(sent),
        np.concatenate(made),
        np.concatenate(recorded),
        from_si,
        temperatures,
        tuple(states),
    )
