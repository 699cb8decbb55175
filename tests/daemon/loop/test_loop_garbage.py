"""The collector is off in the loop (fault 39): so nothing that a cycle makes may need it."""

import gc
import subprocess
import sys
from pathlib import Path

from tests.daemon.loop.cycle_helpers import inputs, make, turn

HEALTHY, LOST, STRANGE = inputs(), inputs()[1:], [*inputs(), inputs()[0]]


def test_no_cycle_leaves_anything_to_a_collector(tmp_path: Path) -> None:
    """Whole ones, ones without an input, ones with a frame twice."""
    cycle, _, _ = make(tmp_path, lambda n: (HEALTHY, LOST, STRANGE)[n % 3])
    turn(cycle, 100)
    gc.collect()
    gc.disable()
    try:
        turn(cycle, 300)
        assert gc.collect() == 0
    finally:
        gc.enable()


def test_the_collector_is_off_once_the_loop_is_ready() -> None:
    code = (
        "import gc; from jtqd.daemon.loop import realtime; realtime.freeze(); "
        "print(gc.isenabled(), gc.get_freeze_count() > 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]
