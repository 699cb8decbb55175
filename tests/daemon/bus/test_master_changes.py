"""A node whose configuration or scaling changes in service while 1020h is intact: found, not used, put right or kept out."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from jtqd.daemon.bus import nodes as node_care
from jtqd.drivers.bus_load import LIMIT, configured_load
from jtqd.drivers.drive import drive_tpdo1
from jtqd.drivers.frame import worst_case_bits
from tests.daemon.bus.master_bench import MasterBench

pytestmark = pytest.mark.native

EMCY = 0x080


def frame(text: str) -> bytes:
    return bytes.fromhex(text)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[MasterBench]:
    """A round of all objects takes a second here, and not ten."""
    monkeypatch.setattr(node_care, "_CHECK_S", 0.01)
    with MasterBench(tmp_path) as each:
        yield each


def test_a_rated_current_that_changed_keeps_the_node_out_until_it_is_as_it_was(bench: MasterBench) -> None:
    """6075h is a factor of each current: with the old one every torque would be wrong, and nothing else shows it."""
    store, before = bench.drives[0].store, bench.drives[0].store.number(0x6075)
    store.set_number(0x6075, 0, before // 2)
    assert store.number(0x1020, 1) != 0
    assert bench.run(lambda: bench.snapshot.doubts[1] == 1, 10.0), bench.lines
    assert bench.snapshot.orders[2] == 1, "the loop is told before a boot has begun"
    text = f"node 1: its configuration was changed (6075h:0: expected {before}, found {before // 2})"
    assert text in bench.lines
    assert bench.run(lambda: bool(bench.own(EMCY)))
    #                                       code reg ended node joint 1
    assert bench.own(EMCY)[0] == frame("03ff 81 0000 0100 01")
    assert bench.run(lambda: bench.said("node 1 has another scaling than at the start"))
    bench.pause(1.5)
    assert bench.snapshot.configured[1] == 0, "never with another factor"
    assert [bench.snapshot.doubts[node] for node in (1, 2, 3)] == [1, 0, 0]
    bench.heard.clear()
    store.set_number(0x6075, 0, before)
    assert bench.run(lambda: bench.snapshot.configured[1] == 1, 15.0), bench.lines
    assert bench.run(lambda: frame("0000 00 03ff 0100 01") in bench.own(EMCY))
    assert bench.drives[0].state == 5
    bench.pause(1.5)
    assert bench.snapshot.doubts[1] == 1, "watched again, and well"


def test_the_sensors_decimals(bench: MasterBench) -> None:
    bench.sensor.store.set_number(0x6132, 1, 2)
    assert bench.run(lambda: bench.snapshot.doubts[3] == 1, 10.0), bench.lines
    assert bench.said("node 3: its configuration was changed (6132h:1: expected 3, found 2)")
    assert bench.run(lambda: bench.said("node 3 has another scaling than at the start"))
    bench.sensor.store.set_number(0x6132, 1, 3)
    assert bench.run(lambda: bench.snapshot.configured[3] == 1, 15.0), bench.lines


@pytest.mark.parametrize(
    ("index", "subindex", "value"),
    [(0x1800, 2, 10), (0x1800, 1, 0xC000_0181), (0x1A00, 1, 0x60E4_0120), (0x1801, 1, 0x4000_0285)],
    ids=["transmission type", "switched off", "mapping", "COB-ID"],
)
def test_a_pdo_parameter_is_written_again(bench: MasterBench, index: int, subindex: int, value: int) -> None:
    bench.drives[0].store.set_number(index, subindex, value)
    assert bench.run(lambda: bench.snapshot.doubts[1] == 1, 10.0), bench.lines
    assert bench.run(lambda: bench.snapshot.configured[1] == 1, 10.0), bench.lines
    assert bench.drives[0].parameters.tpdos()[0] == drive_tpdo1(1)
    assert bench.run(lambda: bench.drives[0].state == 5)
    assert not bench.service.care.changed


def test_a_gear_ratio_told_by_other_numbers_is_the_same(bench: MasterBench) -> None:
    """The objects changed and not what they mean: the node is booted, and used again."""
    for subindex in (1, 2):
        bench.drives[0].store.set_number(0x6091, subindex, 2 * bench.drives[0].store.number(0x6091, subindex))
    assert bench.run(lambda: bench.snapshot.configured[1] == 1, 15.0), bench.lines
    bench.pause(1.5)
    assert bench.snapshot.doubts[1] == 1, "what it said at its last boot counts now"


def test_another_mode_is_told_and_the_node_is_used(bench: MasterBench) -> None:
    bench.pause(1.5)
    bench.drives[1].store.set_number(0x6061, 0, 10)
    assert bench.run(lambda: bench.said("node 2: its mode of operation (6061h) is 10 now, 0 before"), 10.0)
    assert not any(bench.snapshot.doubts)
    assert not bench.own(EMCY)


def test_the_readings_fit_the_bus() -> None:
    """Both frames of each reading, at worst, beside the fullest configuration."""
    load = configured_load((1, 2), {3: (1, 2)}, temperatures=(1, 2)).worst
    readings = 2 * worst_case_bits(8) / node_care._CHECK_S / 1_000_000
    print(f"readings: {readings:.2%}, with the fullest bus: {load + readings:.2%}")
    assert readings < 0.003
    assert load + readings < LIMIT


def test_how_long_a_round_takes(bench: MasterBench) -> None:
    """docs/bus.md states it: all objects of a drive, and a signature in each fourth reading, a third of all readings."""
    watched = {node: len(report["watched"]) for node, report in bench.report["nodes"].items()}
    round_s = {node: 3 * 0.1 * (count + 1) * 4 / 3 for node, count in watched.items()}
    print(json.dumps({"objects": watched, "round_s": round_s}))
    assert max(round_s.values()) < 12.5
