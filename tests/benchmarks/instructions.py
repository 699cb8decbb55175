"""Instructions of one joint's step, and of one whole cycle, counted by callgrind: no noise of a machine touches them.

    python -m tests.benchmarks.instructions [--store WHY]

A Python process estimates a run under valgrind; what is inside the compiled step is counted, divided by the samples. The
libm functions are pinned to their plain variants, so that the processor's own do not count. Another compiler may give other
numbers; the stored ones name theirs.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import pickle
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from jtqd.estimator import load_network, make_estimator
from jtqd.estimator.settings import recommended
from jtqd.models.files import load_joint, shipped

STORED = Path(__file__).with_name("instructions.json")
SAMPLES = 2000
METHODS = ("tob", "efficiency", "network", "fused")
STEPS = ("__pyx_f_4jtqd_9estimator_9estimator_*Estimator_advance",)
STAGES = tuple(
    f"__pyx_f_4jtqd_6daemon_4core_5cycle_5Cycle_{stage}"
    for stage in ("begin", "gather", "observe", "publish", "record")
)
CYCLE = "cycle"
"""Two joints, method `fused`, of SYNC to the record, per cycle with a torque; what the kernel does is not counted."""
SHADOWS = {f"{CYCLE} with {method}": method for method in ("tob", "efficiency", "network")}
"""The same with one shadow method in each joint."""
SLOTS, PERIOD_US = 200, 20_000
WAIT_US, DEADLINE_US = 10_000, 18_000
"""Under valgrind a cycle takes some milliseconds, and what answers SYNC waits for a busy machine."""
LEAST_TORQUES = 0.87
"""Of the slots, of which the start takes a tenth: a cycle without a torque costs about half as much."""
TRIES = 6
"""A machine that stops what answers SYNC for long is asked again."""


class BusyError(RuntimeError):
    """Too few cycles had a torque, in each of TRIES runs."""


def prepared(method: str) -> bytes:
    """Return the network of a method, of the paper's form and size or of ours, and ONNX Runtime's check of it, pickled.

    Of SHADOWS: the checks of both joints' shipped networks.
    """
    from tests.benchmarks.fixture import small_network
    from tests.estimator.fused_configuration import network_of

    if method in SHADOWS:
        from jtqd.daemon.config import load_config
        from jtqd.daemon.loop.process import check_networks

        shadows = {each.estimator.method: each for each in load_config(None).shadows}
        return pickle.dumps(check_networks(shadows[SHADOWS[method]]))
    if method not in ("network", "fused"):
        return pickle.dumps(None)
    data = small_network(1).onnx("joint1") if method == "network" else network_of(1)
    return pickle.dumps((data, load_network(method, data).check))


def work(method: str, prepared: Path) -> None:
    """Estimate a run: what is counted. Few imports, and no ONNX Runtime: under valgrind they take minutes."""
    joint = load_joint(shipped("trained/joint1.yaml"))
    assert joint.fused is not None
    assert joint.fused.agreement is not None
    made = pickle.loads(prepared.read_bytes())
    network = None if made is None else load_network(method, made[0], check=made[1])
    estimator = make_estimator(joint, recommended(method), network)
    at_s = np.arange(SAMPLES) * 1e-3
    angle = np.sin(3.0 * at_s)
    _instrumented()
    run = estimator.run(
        np.full(SAMPLES, 1e-3), 3.0 * np.cos(5.0 * at_s), 100.0 * angle, 300.0 * np.cos(3.0 * at_s), angle
    )
    assert np.isfinite(run.torque_nm[1:]).all()


def _instrumented() -> None:
    """From here on callgrind counts: what starts before it runs six times as fast."""
    order = subprocess.Popen(["callgrind_control", "-i", "on", str(os.getpid())], stdout=subprocess.DEVNULL)
    while order.poll() is None:  # valgrind takes orders between the steps of the program
        time.sleep(0.001)
    assert order.returncode == 0


def cycles(shadow: str | None, prepared: Path) -> None:
    """Go through the loop's own cycle with this shadow method, on a unix bus, beside the bench's traffic: it is counted."""
    from jtqd.daemon.config import load_config
    from jtqd.daemon.loop import process as loop
    from jtqd.daemon.shared.snapshot import SnapshotReader
    from jtqd.drivers.frame_socket import open_frame_socket
    from jtqd.estimator import network
    from jtqd.estimator.status import PUBLISHED
    from tests.benchmarks.contender import Cpus, traffic
    from tests.benchmarks.fixture import Fixture

    network._LONGEST_S = math.inf  # type: ignore[misc]  # valgrind takes fifty times as long
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        original = shipped("bench.yaml")
        text = original.read_text(encoding="utf-8").replace("trained/", f"{original.parent}/trained/")
        for key, us in (("period", PERIOD_US), ("wait", WAIT_US), ("deadline", DEADLINE_US)):
            text, found = re.subn(rf"\b{key}_us: \d+", f"{key}_us: {us}", text)
            assert found == 1, f"found {key}_us {found} times"
        text, found = re.subn(r"shadow: \[.*\]", f"shadow: [{shadow or ''}]", text)
        assert found == 1, f"found shadow {found} times"
        configuration = directory / "bench.yaml"
        configuration.write_text(text, encoding="utf-8")
        config = load_config(configuration)
        source = traffic(directory, Cpus(None, None), period_us=PERIOD_US)
        estimators = [loop.build_estimator(config, joint) for joint in config.joints]
        shadows = [
            [loop.build_estimator(each, joint, check, shadow=True)]
            for each in config.shadows
            for joint, check in zip(each.joints, pickle.loads(prepared.read_bytes()), strict=True)
        ]
        request = {
            "ring": str(directory / "ring"),
            "snapshot": str(directory / "snapshot"),
            "worst_load": 0.0,
        }
        socket = open_frame_socket(f"unix:{directory / 'bus'}", loop.loop_filters(config), receive_own=True)
        cycle, grid = loop.build_cycle(
            config, request, Fixture(directory).report, socket, estimators, shadows=shadows
        )
        _instrumented()
        grid.slot_ns = time.monotonic_ns() + grid.period_ns
        cycle.go_on(SLOTS, 0)
        view = SnapshotReader(directory / "snapshot").read()
        source.end()
        torques = min(sum(spent[code] for code in PUBLISHED) for spent in view.status_cycles)
        print(torques)


def count(method: str) -> float:
    """Return the instructions of one sample, or of one CYCLE.

    Raises RuntimeError where they cannot be counted, BusyError where the machine was too busy for cycles.
    """
    whole = method == CYCLE or method in SHADOWS
    counted = [f"--toggle-collect={each}" for each in (STAGES if whole else STEPS)]
    if shutil.which("valgrind") is None:
        raise RuntimeError("found no valgrind")
    with tempfile.TemporaryDirectory() as directory:
        out, made = Path(directory) / "callgrind.out", Path(directory) / "network.pickle"
        made.write_bytes(prepared(method))
        command = [
            *("valgrind", "--tool=callgrind", "--collect-atstart=no", "--instr-atstart=no", *counted),
            *(f"--callgrind-out-file={out}", sys.executable, "-m", "tests.benchmarks.instructions"),
            *("--work", method, str(made)),
        ]
        plain = "glibc.cpu.hwcaps=-AVX2,-AVX2_Usable,-FMA,-FMA_Usable,-FMA4"
        environment = {**os.environ, "GLIBC_TUNABLES": plain}
        for _ in range(TRIES if whole else 1):
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
            if done.returncode:
                raise RuntimeError(f"valgrind: {done.stderr[-500:]}")
            samples = int(done.stdout) if whole else SAMPLES
            if not whole or samples >= LEAST_TORQUES * SLOTS:
                break
        else:
            raise BusyError(f"found {samples} cycles of {SLOTS} with a torque, {TRIES} times: a busy machine")
        found = re.search(r"^(?:totals|summary): (\d+)", out.read_text(), re.MULTILINE)
    if found is None or int(found[1]) == 0:
        raise RuntimeError("callgrind has counted nothing: is the build stripped?")
    return int(found[1]) / samples


def main() -> int:
    """Print the counts beside the stored ones, or store them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--store", metavar="WHY", help="store them, with this reason")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="count these alone")
    parser.add_argument("--work", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        method, made = options.work
        whole = method == CYCLE or method in SHADOWS
        cycles(SHADOWS.get(method), Path(made)) if whole else work(method, Path(made))
        return 0
    counts = {method: round(count(method), 1) for method in options.only or (*METHODS, CYCLE, *SHADOWS)}
    stored = json.loads(STORED.read_text())["instructions"] if STORED.exists() else {}
    for method, now in counts.items():
        before = stored.get(method)
        what = "joint and sample" if method in METHODS else "cycle of two joints"
        change = "" if not before else f"  stored {before:8.1f}  {100.0 * (now / before - 1.0):+.1f} %"
        print(f"{method:22}{now:10.1f} instructions per {what}{change}")
        if method in SHADOWS and CYCLE in counts:
            cost = (now - counts[CYCLE]) / 2
            print(f"{'':22}{cost:10.1f} of them the shadow method {SHADOWS[method]} of one joint")
    if options.store:
        compiler = subprocess.run(
            ["cc", "--version"], capture_output=True, text=True, check=True
        ).stdout.splitlines()[0]
        content = {"compiler": compiler, "why": options.store, "instructions": {**stored, **counts}}
        STORED.write_text(json.dumps(content, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
