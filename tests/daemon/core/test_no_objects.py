"""No Python object is made in a cycle: counted in the interpreter's own allocators, on a real frame socket."""

from __future__ import annotations

import ctypes
import gc
import subprocess
import sysconfig
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from jtqd.daemon.config import Config, load_config
from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.loop import process as loop
from jtqd.daemon.shared.snapshot import SnapshotReader, View
from jtqd.drivers.frame_socket import open_frame_socket
from jtqd.estimator.status import PUBLISHED
from jtqd.models.files import shipped
from tests.benchmarks import contender
from tests.benchmarks.fixture import Fixture

Count = Callable[[Callable[[], object]], int]
SLOTS, CYCLES, ROUNDS = 200, 40, 20
_SOURCE = Path(__file__).with_name("allocations.c")


@pytest.fixture(scope="module")
def allocations(tmp_path_factory: pytest.TempPathFactory) -> Count:
    """How often a call takes memory from Python's allocators, however soon it is given back."""
    library = tmp_path_factory.mktemp("counting") / "allocations.so"
    compiler = (sysconfig.get_config_var("CC") or "cc").split()[0]
    include = f"-I{sysconfig.get_path('include')}"
    subprocess.run(
        [compiler, "-O1", "-shared", "-fPIC", include, str(_SOURCE), "-o", str(library)], check=True
    )
    counter = ctypes.PyDLL(str(library))
    counter.begin.restype = None
    counter.end.restype = ctypes.c_long

    def count(call: Callable[[], object]) -> int:
        gc.collect()  # empties the free lists as well
        gc.disable()
        try:
            counter.begin()
            call()
            return int(counter.end())
        finally:
            gc.enable()

    return count


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[str]:
    """Two drives and a sensor that answer each SYNC, in a process of their own."""
    traffic = contender.traffic(tmp_path, contender.Cpus(None, None))
    yield f"unix:{tmp_path / 'bus'}"
    traffic.end()


def the_loop_s_cycle(config: Config, bus: str, directory: Path) -> Cycle:
    """A cycle as the loop process builds it, on a grid that begins now."""
    estimators = [loop.build_estimator(config, joint) for joint in config.joints]
    request = {"ring": str(directory / "ring"), "snapshot": str(directory / "snapshot"), "worst_load": 0.0}
    socket = open_frame_socket(bus, loop.loop_filters(config), receive_own=True)
    cycle, grid = loop.build_cycle(
        config, request, Fixture(directory).report, socket, estimators, shadows=loop.build_shadows(config)
    )
    grid.slot_ns = time.monotonic_ns() + grid.period_ns
    return cycle


def configured(name: str, directory: Path) -> Config:
    """A shipped configuration at 500 Hz, so that a busy machine keeps up; with contacts where its method tells them."""
    shipped_file = shipped(name)
    text = shipped_file.read_text(encoding="utf-8").replace("trained/", f"{shipped_file.parent}/trained/")
    path = directory / name
    text = text.replace("period_us: 1000", "period_us: 2000")
    path.write_text(text + ("contact: {}\n" if "method: fused" in text else ""), encoding="utf-8")
    return load_config(path)


@pytest.mark.parametrize("name", ["bench.yaml", "bench_paper.yaml"])
def test_cycles_take_nothing_from_python_s_allocators(
    name: str, bus: str, tmp_path: Path, allocations: Count
) -> None:
    """Methods `fused` (zeros, temperatures), `network` and shadow methods: what 200 slots take is what none takes."""
    cycle = the_loop_s_cycle(configured(name, tmp_path), bus, tmp_path)
    cycle.go_on(SLOTS, 0)
    reader = SnapshotReader(tmp_path / "snapshot")
    before, rounds = torques(reader.read()), 0
    while torques(reader.read()) - before < CYCLES:
        none = allocations(lambda: cycle.go_on(0, 0))
        assert allocations(lambda: cycle.go_on(SLOTS, 0)) == none
        rounds += 1
        assert rounds < ROUNDS, "there were no cycles with a torque of both joints"


def torques(view: View) -> int:
    """Cycles in which each of the joints had a torque."""
    return min(sum(spent[code] for code in PUBLISHED) for spent in view.status_cycles)


def test_an_object_that_is_gone_at_once_is_counted(allocations: Count) -> None:
    """Doubt the count: a float and a number, neither of which is kept."""
    half, large = 0.5, 10**6
    nothing = allocations(lambda: None)
    assert allocations(lambda: half * half) == nothing + 1
    assert allocations(lambda: large * large) == nothing + 1
