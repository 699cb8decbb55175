"""A replay from logs to results: reading, estimating, comparing. No output; `jtq replay` and `jtq batch` call it."""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from jtqd.daemon.logs import LogError
from jtqd.daemon.replay.compare import Comparison, Identity, compare, identity
from jtqd.daemon.replay.logged import NO_STATES, EstimatorStates, Inputs, Setup
from jtqd.daemon.replay.replayer import Model, Replayer
from jtqd.daemon.replay.runs import STRETCH_CYCLES, Progress, Run, lost_cycles, read_runs
from jtqd.estimator.arrays import BoolArray, RecordArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.estimator.methods import make_estimator
from jtqd.estimator.network import NATIVE_LIMIT, load_network
from jtqd.estimator.onnx_graph import NetworkError
from jtqd.estimator.settings import METHODS, bandwidth_of
from jtqd.estimator.status import same_past
from jtqd.models.files import load_joint

# ---- models: those that the log carries, or others from a directory ----

AS_LOGGED = "as logged"
_ANY_JOINT = "extended.joint.yaml"


def models_of(setup: Setup, directory: Path | None = None, method: str | None = None) -> list[Model]:
    """Return the log's models, those in `directory` in their place, with another method. Raises ConfigError, NetworkError.

    Joint files are `jointN.yaml` or `extended.jointN.yaml`, or `extended.joint.yaml` for the joint of that name;
    networks `jointN.fused.onnx` for method fused, `jointN.onnx` for network. Files that are not there stay as logged.
    """
    settings = setup.config.estimator
    logged_method = settings.method
    if method is not None:
        settings = replace(settings, method=method)
    if directory is not None and not directory.is_dir():
        raise ConfigError(f"{directory}: not a directory, expected one with joint files and networks")
    found = []
    for number, each in enumerate(setup.config.joints, start=1):
        joint, network, files = each.joint, None, []
        path = None if directory is None else _joint_file(directory, number, joint)
        if path is not None:
            joint = load_joint(path)
            files.append(path)
        ending = METHODS[settings.method].network_ending if METHODS[settings.method].network else None
        if directory is not None and ending and (directory / f"joint{number}{ending}").is_file():
            path = directory / f"joint{number}{ending}"
            network = load_network(settings.method, str(path))
            files.append(path)
        elif ending and each.network is not None and settings.method == logged_method:
            network = load_network(settings.method, str(each.network.path), each.network.sha256)
        names = ", ".join(f"{file} ({hashlib.sha256(file.read_bytes()).hexdigest()[:12]})" for file in files)
        estimator = make_estimator(joint, settings, network)
        found.append(Model(joint, settings, network, estimator, names or AS_LOGGED))
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


@dataclass(frozen=True)
class ReplayOptions:
    """Options of a replay.

    Attributes:
        model: directory with other joint files and networks.
        method: another method of the estimator.
    """

    model: Path | None = None
    method: str | None = None

    @property
    def other(self) -> bool:
        """Return whether a model differs from the logged one."""
        return self.model is not None or self.method is not None


@dataclass(frozen=True)
class Result:
    """Replay of one run, or of one stretch of a long one.

    Attributes:
        run: its logs and states.
        models: of each joint.
        seconds, read_s, replay_s: length of the run; wall time of reading and of estimating.
        lost: cycles that are missing in the middle of the logs.
        from_si: inputs whose frame was not in the log, from the SI values beside it.
        temperatures_from_log: the same of temperatures.
        identity: comparison bit for bit, with the logged models only.
        comparisons: of each joint.
        joints: estimates of each joint, fields as `SAMPLE`.
    """

    run: Run
    models: Sequence[Model]
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

    @property
    def method(self) -> str:
        """Return the method of the estimator."""
        return self.models[0].settings.method


def content(result: Result) -> dict[str, Any]:
    """Return a result as an object of `jtq.replay/1`."""
    same = result.identity
    cycle = result.run.joints[0]["cycle"]
    found = {
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
        "identity": same,
        "joints": result.comparisons,
    }
    plain: dict[str, Any] = msgspec.to_builtins(found)
    if same is not None:
        plain["identity"] |= {"bit_identical": same.whole, "explained": same.explained}
    return plain


def as_json(runs: Sequence[dict[str, Any]]) -> bytes:
    """Return what `content` made of some results as JSON (schema `jtq.replay/1`); NaN is null."""
    return msgspec.json.encode({"schema": "jtq.replay/1", "runs": runs})


# ---- replay ----


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
    """Replay logs; parts of one run are joined, and a directory stands for the logs in it.

    A run of more than `stretch` cycles gives several results, one after the other. A caller that drops each before it asks
    for the next needs memory for one of them only.

    Raises LogError, ConfigError, NetworkError: one line each; OSError.
    """
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
                replayers[run.number] = Replayer(run.setup, _models(run, options))
            replayer = replayers[run.number]
            yield _replay_run(run, inputs, replayer, options=options, progress=progress, read_s=read_s)
            del run, inputs


def _models(run: Run, options: ReplayOptions) -> list[Model]:
    try:
        return models_of(run.setup, options.model, options.method)
    except (ConfigError, NetworkError) as error:
        if options.other:
            raise
        raise LogError(f"{run.logs[0]}: its models: {error}") from None


def _replay_run(
    run: Run,
    inputs: Inputs,
    replayer: Replayer,
    *,
    options: ReplayOptions,
    progress: Progress,
    read_s: float,
) -> Result:
    """Replay a run, or a stretch; `replayer`: new, or as the stretch before has left it."""
    config, models = run.setup.config, replayer.models
    begun = time.perf_counter()
    steps = run.steps()
    states = _accepted_states(run, models, options)
    replayed = replayer.run(
        run.joints, inputs, steps, lambda done: progress("replaying", done, run.cycles), states
    )
    replay_s = time.perf_counter() - begun
    same = None
    if not options.other:
        compared = run.joints, replayed.joints, steps
        pdos = inputs.estimate, replayed.estimate, inputs.recorded
        same = identity(*compared, pdos, replayed.states_differ)
        if not same.explained and any(each.network is not None for each in models):
            limit = NATIVE_LIMIT * min(each.joint.rated_torque_nm for each in models)
            same = identity(*compared, pdos, replayed.states_differ, network_nm=limit)
    comparisons = []
    for n, (each, model) in enumerate(zip(config.joints, models, strict=True)):
        bandwidths = bandwidth_of(each.joint, config.estimator), bandwidth_of(model.joint, model.settings)
        known = _known(run, same, n + 1)
        comparisons.append(compare(n + 1, run.joints[n], replayed.joints[n], known, bandwidths))
    return Result(
        run,
        models,
        run.cycles * config.period_ns * 1e-9,
        read_s,
        replay_s,
        lost_cycles(run.joints[0], config),
        inputs.from_si,
        replayed.temperatures_from_log,
        same,
        tuple(comparisons),
        replayed.joints,
    )


def _accepted_states(run: Run, models: Sequence[Model], options: ReplayOptions) -> Sequence[EstimatorStates]:
    """Return the states of the log for each model: none where something differs that the zeros were learned with."""
    if not options.other or not any(len(each.cycle) for each in run.states):
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
