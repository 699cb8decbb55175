"""What a log is replayed with: the files it carries, or others from a directory."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

from daemon.config import Config
from daemon.loop.joint_safety import JointSafety
from daemon.replay.origin import Origin
from daemon.replay.whole import Model
from estimator.checked import ConfigError
from estimator.methods import AnyEstimator, AnyNetwork, load_network, make_estimator
from estimator.parameters import Joint
from models.files import load_joint

AS_LOGGED = "as logged"
_WITH_NETWORK = ("network", "fused")
_ANY_JOINT = "extended.joint.yaml"


@dataclass(frozen=True)
class Models:
    """Models of joint 1 and 2, and the files they come from, with hashes; "as logged" for those of the log."""

    joints: tuple[Model, Model]
    files: tuple[str, ...]

    def safety(self, config: Config) -> list[JointSafety]:
        """Limits of both joints by the log's configuration and these joint files."""
        return [
            JointSafety(config.safety, each.settings, each.joint, config.period_ns) for each in self.joints
        ]

    def estimators(self) -> list[AnyEstimator]:
        """New estimators, warmed up by nobody. Raises ConfigError."""
        return [make_estimator(each.joint, each.settings, each.network) for each in self.joints]


def logged_models(origin: Origin) -> Models:
    """What the log was recorded with. Raises ConfigError, NetworkError."""
    settings = origin.config.estimator
    made = []
    for each in origin.config.joints:
        network = None
        if each.network is not None:
            network = load_network(settings.method, str(each.network.path), each.network.sha256)
        made.append(Model(each.joint, settings, network))
        make_estimator(each.joint, settings, network)  # refused here, and not when the arrays are half done
    return Models((made[0], made[1]), (AS_LOGGED, AS_LOGGED))


def other_models(origin: Origin, directory: Path | None, method: str | None) -> Models:
    """The log's models with what `directory` has in their place, and another method. Raises ConfigError, NetworkError.

    Joint files are `jointN.yaml` or `extended.jointN.yaml`, or `extended.joint.yaml` for the joint of that name;
    networks `jointN.fused.onnx` for method fused, `jointN.onnx` for network. What is not there stays as logged.
    """
    settings = origin.config.estimator
    if method is not None:
        settings = replace(settings, method=method)
    taken = 0
    made, files = [], []
    for number, each in enumerate(origin.config.joints, start=1):
        joint, network, said = each.joint, None, []
        path = None if directory is None else _joint_file(directory, number, each.joint)
        if path is not None:
            joint = load_joint(path)
            said.append(_named(path))
        network_path = None if directory is None else _network_file(directory, number, settings.method)
        if network_path is not None:
            network = load_network(settings.method, str(network_path))
            said.append(_named(network_path))
        elif settings.method in _WITH_NETWORK:
            network = _logged_network(origin, number, settings.method)
        taken += len(said)
        make_estimator(joint, settings, network)  # refused here, and not when the arrays are half done
        made.append(Model(joint, settings, network))
        files.append(", ".join(said) or AS_LOGGED)
    if directory is not None and not taken:
        names = ", ".join([*_joint_names(1), *_joint_names(2), _ANY_JOINT])
        raise ConfigError(
            f"{directory}: found no file for these joints, expected one of {names} or a network"
        )
    return Models((made[0], made[1]), tuple(files))


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
    if method not in _WITH_NETWORK:
        return None
    path = directory / (f"joint{number}.fused.onnx" if method == "fused" else f"joint{number}.onnx")
    return path if path.is_file() else None


def _logged_network(origin: Origin, number: int, method: str) -> AnyNetwork | None:
    """The log's network where the method is still the same; another method cannot read it."""
    file = origin.config.joints[number - 1].network
    if file is None or method != origin.config.estimator.method:
        return None
    return load_network(method, str(file.path), file.sha256)
