"""CPU time of a plant step and of a whole SYNC of the bench, measured in this process (`jtq sim --cost`)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

from jtqd.drivers.drive import drive_tpdo1, drive_tpdo2
from jtqd.drivers.pdo import SYNC_COB_ID, PdoMap
from jtqd.drivers.sdo import REQUEST_ID
from jtqd.drivers.sensor import sensor_tpdo1
from jtqd.sim_can.bench import Bench
from jtqd.sim_can.plant_source import PlantSource
from jtqd.sim_can.plants import AnyPlant

CYCLE_NS = 1_000_000
BLOCK = 50


@dataclass(frozen=True)
class Cost:
    """CPU time in microseconds per 1 ms cycle: medians over blocks of BLOCK cycles."""

    plant_step_us: float  # both joints with their drives' control loops
    source_us: float  # plant step with encoders, noise and sensor
    sync_us: float  # everything a SYNC does: source, state machines, five TPDOs packed
    substeps: int
    cycles: int

    def as_json(self) -> dict[str, float | int]:
        """Return a plain mapping for `--json`."""
        return asdict(self)


def map_pdos(bench: Bench) -> None:
    """Write the PDO mapping that jtqd writes at boot by SDO, and start the nodes."""
    maps = [(node, pdo) for node in (1, 2) for pdo in (drive_tpdo1(node), drive_tpdo2(node))]
    for node, pdo in [*maps, (3, sensor_tpdo1(3))]:
        number = (pdo.cob_id - 0x80) // 0x100 - 1
        for index, subindex, value, size in _mapping_writes(0x1800 + number, pdo):
            request = bytes([0x23 | (4 - size) << 2]) + index.to_bytes(2, "little") + bytes([subindex])
            bench.on_frame(REQUEST_ID + node, request + value.to_bytes(4, "little"), 0, 0)
    bench.on_frame(0x000, b"\x01\x00", 0, 0)


def _mapping_writes(index: int, pdo: PdoMap) -> list[tuple[int, int, int, int]]:
    """Return the SDO writes (index, subindex, value, size in bytes) that map the TPDO at `index`."""
    entries = [(index + 0x200, entry, word, 4) for entry, word in enumerate(pdo.words, 1)]
    return [
        (index, 1, 0xC000_0000 | pdo.cob_id, 4),
        (index + 0x200, 0, 0, 1),
        *entries,
        (index + 0x200, 0, len(pdo.words), 1),
        (index, 2, pdo.transmission_type, 1),
        (index, 1, 0x4000_0000 | pdo.cob_id, 4),
    ]


def measure(parameters: AnyPlant, cycles: int = 4000) -> Cost:
    """Run the demo motion for `cycles` SYNCs and measure; three benches, so that no part is a difference of
    two others.
    """
    full = Bench(PlantSource(parameters))
    map_pdos(full)
    stamps = [0]

    def sync() -> None:
        stamps[0] += CYCLE_NS
        full.on_frame(SYNC_COB_ID, b"\x01", stamps[0], stamps[0])

    whole = _median_us(sync, cycles)
    source = PlantSource(parameters)
    for drive, moving in enumerate(full.drives):
        source.command(drive, *moving.source_command())
    reading = _median_us(lambda: source.advance(0.001), cycles)
    plant = source.plant
    stepping = _median_us(lambda: plant.step(0.001), cycles)
    substeps = round(0.001 / plant.substep_s)
    return Cost(stepping, reading, whole, substeps, cycles)


def _median_us(call: Callable[[], object], cycles: int) -> float:
    """Return the median CPU time of a call in microseconds, over blocks of BLOCK calls."""
    blocks = []
    for _ in range(max(1, cycles // BLOCK)):
        start = time.process_time_ns()
        for _ in range(BLOCK):
            call()
        blocks.append((time.process_time_ns() - start) / (BLOCK * 1000.0))
    return sorted(blocks)[len(blocks) // 2]
