"""Instructions of one joint's step, counted by callgrind: no noise of a machine touches them.

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
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from jtqd.estimator import load_network, make_estimator, onnx_graph
from jtqd.estimator.joint import Agreement
from jtqd.estimator.settings import recommended
from jtqd.models.files import load_joint, shipped

STORED = Path(__file__).with_name("instructions.json")
SAMPLES = 2000
METHODS = ("tob", "efficiency", "network", "fused")
_STEP = "__pyx_f_4jtqd_9estimator_9estimator_*Estimator_advance"


def work(method: str) -> None:
    """Estimate a run: what is counted."""
    fused = method == "fused"
    name = "trained/joint1.fused.onnx" if fused else "trained/joint1.onnx"
    network = load_network(method, str(shipped(name))) if method in ("network", "fused") else None
    joint = load_joint(shipped("trained/joint1.yaml"))
    assert joint.fused is not None
    joint = replace(joint, fused=replace(joint.fused, agreement=Agreement(0.4, 0.5, 0.004, 0.15)))
    estimator = make_estimator(joint, recommended(method), network)
    time = np.arange(SAMPLES) * 1e-3
    angle = np.sin(3.0 * time)
    run = estimator.run(
        np.full(SAMPLES, 1e-3), 3.0 * np.cos(5.0 * time), 100.0 * angle, 300.0 * np.cos(3.0 * time), angle
    )
    assert np.isfinite(run.torque_nm[1:]).all()


def count(method: str) -> float:
    """Return the instructions of one sample. Raises RuntimeError where they cannot be counted."""
    if shutil.which("valgrind") is None:
        raise RuntimeError("found no valgrind")
    with tempfile.TemporaryDirectory() as directory:
        out = Path(directory) / "callgrind.out"
        done = subprocess.run(
            [
                *("valgrind", "--tool=callgrind", "--collect-atstart=no", f"--toggle-collect={_STEP}"),
                *(f"--callgrind-out-file={out}", sys.executable, "-m", "tests.benchmarks.instructions"),
                *("--work", method),
            ],
            env={
                **os.environ,
                "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-AVX2_Usable,-FMA,-FMA_Usable,-FMA4",
            },
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(f"valgrind: {done.stderr.strip().splitlines()[-1:]}")
        found = re.search(r"^(?:totals|summary): (\d+)", out.read_text(), re.MULTILINE)
    if found is None or int(found[1]) == 0:
        raise RuntimeError("callgrind has counted nothing: is the build stripped?")
    return int(found[1]) / SAMPLES


def main() -> int:
    """Print the counts beside the stored ones, or store them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--store", metavar="WHY", help="store them, with this reason")
    parser.add_argument("--work", choices=METHODS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        onnx_graph._LONGEST_S = math.inf  # type: ignore[misc]  # valgrind takes fifty times as long
        work(options.work)
        return 0
    counts = {method: round(count(method), 1) for method in METHODS}
    stored = json.loads(STORED.read_text())["per_step"] if STORED.exists() else {}
    for method, now in counts.items():
        before = stored.get(method)
        change = "" if not before else f"  stored {before:8.1f}  {100.0 * (now / before - 1.0):+.1f} %"
        print(f"{method:12}{now:10.1f} instructions per joint and sample{change}")
    if options.store:
        compiler = subprocess.run(
            ["cc", "--version"], capture_output=True, text=True, check=True
        ).stdout.splitlines()[0]
        content = {"compiler": compiler, "why": options.store, "per_step": counts}
        STORED.write_text(json.dumps(content, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
