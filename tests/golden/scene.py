"""The scenes of the golden logs, played on a real CAN interface: `python -m tests.golden.scene DIRECTORY [NAME...]`.

Runs where there is a `vcan0`; in the bench kernel in time travel everything but the clock is the same each time.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import yaml

from jtqd.models.files import shipped

INTERFACE = os.environ.get("JTQD_CAN_INTERFACE", "vcan0")


@dataclass(frozen=True)
class Scene:
    """One log: method, SYNC period, length and what happens meanwhile."""

    method: str
    seconds: float
    period_us: int = 1000
    happens: Callable[[], None] | None = None


def _after(estimates: int) -> None:
    """Wait for so many estimate PDOs."""
    subprocess.run(
        ["candump", "-n", str(estimates), "-T", "5000", f"{INTERFACE},1A0:7FF"],
        stdout=subprocess.DEVNULL,
        check=True,
    )


def _send(*frames: str) -> None:
    for frame in frames:
        subprocess.run(["cansend", INTERFACE, frame], check=True)


def _faults() -> None:
    """A foreign SYNC, a second TPDO with other bytes, a node that restarts, an interface that goes down."""
    _after(150)
    _send("080#07")
    _after(100)
    _send("181#1122334455667788", "281#00112233")
    _after(100)
    _send("702#00")
    _after(500)
    for state in ("down", "up"):
        subprocess.run(["ip", "link", "set", INTERFACE, state], check=True)
        time.sleep(0.03)


SCENES = {
    "network": Scene("network", 2.1, period_us=2000),
    "faults": Scene("fused", 1.2, happens=_faults),
}
"""Joint 1 stands for 1 s, moves and reverses at 2.41 s; joint 2 follows a torque from the start."""


def configuration(scene: Scene, directory: Path) -> Path:
    """The shipped configuration with the scene's method and period."""
    name = "bench.yaml" if scene.method == "fused" else "bench_paper.yaml"
    content = yaml.safe_load(shipped(name).read_text())
    content["estimator"] |= {"method": scene.method, "shadow": []}
    content["sync"]["period_us"] = scene.period_us
    content["inputs"] = {"wait_us": 500, "deadline_us": 850}
    for number in (1, 2):
        joint = content[f"joint_{number}"]
        joint.pop("shadow_networks", None)
        for section in (joint, *([joint["network"]] if "network" in joint else [])):
            shutil.copy(
                shipped(section["file"]), directory
            )  # its name is enough: no path of this machine is in the log
            section["file"] = Path(section["file"]).name
    path = directory / "bench.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def play(name: str, out: Path) -> Path:
    """Record one scene; returns the log, `out`/NAME.mcap."""
    scene = SCENES[name]
    with tempfile.TemporaryDirectory() as scratch:
        bench = subprocess.Popen(
            [sys.executable, "-m", "jtqd.sim_can", "--bus", INTERFACE, "--seed", "1"],
            stderr=subprocess.PIPE,
            text=True,
        )
        assert bench.stderr is not None
        assert "ready" in bench.stderr.readline()
        logs = Path(scratch) / "logs"
        daemon = subprocess.Popen(
            [
                *(sys.executable, "-m", "jtqd.daemon.jtqd", "--bus", INTERFACE),
                *("--config", str(configuration(scene, Path(scratch)))),
                *("--duration", str(scene.seconds), "--record", str(logs)),
            ],
            env={**os.environ, "RUNTIME_DIRECTORY": scratch},
            stdout=subprocess.DEVNULL,
        )
        try:
            if scene.happens is not None:
                scene.happens()
            status = daemon.wait(120)
        finally:
            daemon.kill()
            bench.send_signal(signal.SIGTERM)
            bench.wait(10)
        if status not in (0, 3):
            raise RuntimeError(f"jtqd ended with exit status {status}")
        (log,) = logs.glob("*.mcap")
        target = out / f"{name}.mcap"
        target.write_bytes(log.read_bytes())
        return target


if __name__ == "__main__":
    for each in sys.argv[2:] or SCENES:
        play(each, Path(sys.argv[1]))
