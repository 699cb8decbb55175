"""What a diagnosis of ten runs of 60 s costs, and whether twice the samples cost twice the time. In processes of its own."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

from validation.hidden.figures import Figure

LONGEST_S: Final = 60.0
LARGEST_GB: Final = 2.0
RUNS: Final = 10
_STEEPEST: Final = 2.6  # of twice the samples; 2 is linear
_DRAW: Final = """
import pickle, sys
from validation.hidden import Order, draw_many
hidden = [("torque_ripple", 1, 0.5), ("torque_constant", 2, 0.002)]
case = draw_many([Order(5, hidden, runs=int(sys.argv[2]), duration_s=float(sys.argv[3]))])[0]
pickle.dump(case, open(sys.argv[1], "wb"))
"""
_DIAGNOSE: Final = """
import json, pickle, resource, sys, time
from jtqd.sysid.diagnosis.diagnose import diagnose
from validation.hidden.trials import joint_files, tables
case = pickle.load(open(sys.argv[1], "rb"))
runs, joints = tables(case.runs), joint_files(case)
wall, cpu = time.monotonic(), time.process_time()
verdict = diagnose(runs, joints).verdict
used = time.monotonic() - wall, time.process_time() - cpu
print(json.dumps([*used, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, verdict]))
"""


def measure(seconds: float) -> tuple[float, float, float]:
    """Return (wall time [s], processor time [s], largest memory of the process [GB]) of ten runs of this length.

    Raises RuntimeError with the last line of a process that fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder) / "case.pickle")
        _python(_DRAW, file, str(RUNS), str(seconds))
        wall, cpu, memory, _ = json.loads(_python(_DIAGNOSE, file))
    return wall, cpu, memory


def _python(code: str, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], check=False, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(done.stderr.strip().rsplit("\n", 1)[-1])
    return done.stdout


def cost_table() -> list[Figure]:
    """Return the rows of cost; shares of what is allowed."""
    wall, cpu, memory = measure(60.0)
    _, half, _ = measure(30.0)
    return [
        _row("ten runs of 60 s: share of 60 s", wall / LONGEST_S, 1.0, f"{wall:.0f} s"),
        _row("the same: share of 2 GB", memory / LARGEST_GB, 1.0, f"{memory:.2f} GB"),
        _row(
            "twice the samples: share of twice the time",
            0.5 * cpu / half,
            0.5 * _STEEPEST,
            f"{half:.0f} s -> {cpu:.0f} s",
        ),
    ]


def _row(what: str, value: float, most: float, note: str) -> Figure:
    return Figure(what, value, value, value, f"at most {most:.0%}".replace("%", " %"), value <= most, 1, note)
