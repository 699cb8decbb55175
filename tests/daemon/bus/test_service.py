"""What jtqd does on the bus beside its loop, by frames over a hub: EMCY, heartbeats, bus state, nodes that come and go."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from jtqd.daemon.bus import nodes as node_care
from jtqd.daemon.bus.nodes import ACTIVE
from jtqd.drivers.bus_load import LIMIT, configured_load
from jtqd.drivers.drive import drive_tpdo1
from jtqd.drivers.frame import CAN_ERR_FLAG, worst_case_bits
from jtqd.drivers.sensor import sensor_tpdo1
from tests.daemon.bus.master_bench import OWN, MasterBench

pytestmark = pytest.mark.native

EMCY, SDO = 0x080, 0x580


def frame(text: str) -> bytes:
    return bytes.fromhex(text)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[MasterBench]:
    with MasterBench(tmp_path) as each:
        assert each.run(lambda: set(each.service.heartbeats.states().values()) == {ACTIVE})
        yield each


def test_a_heartbeat_that_stops_is_8130h_with_its_node_and_comes_back(bench: MasterBench) -> None:
    bench.drives[1].beats = False
    assert bench.run(lambda: bool(bench.own(EMCY)))
    #                                   code reg ended node joints: joint 2
    assert bench.own(EMCY) == [frame("3081 11 0000 0200 02")]
    assert "node 2: no heartbeat for 0.3 s" in bench.lines
    assert bench.sdo(0x1001, 0) == 0x11
    assert bench.sdo(0x1003, 1) == 0x0002_8130
    assert bench.sdo(0x2206, 2) == 0x02_01_03_05, "node 2, configured, heartbeat lost, last operational"
    bench.drives[1].beats = True
    assert bench.run(lambda: len(bench.own(EMCY)) > 0)
    assert bench.own(EMCY) == [frame("0000 00 3081 0200 02")]
    assert bench.sdo(0x1001, 0) == 0


def test_frames_that_are_no_heartbeat_keep_nothing_alive(bench: MasterBench) -> None:
    bench.drives[0].beats = False
    end = time.monotonic() + 5.0
    while not bench.own(EMCY) and time.monotonic() < end:
        bench.send(0x701, b"")
        bench.send(0x701, b"\x05\x00")
        bench.pause(0.02)
    assert bench.own(EMCY) == [frame("3081 11 0000 0100 01")]
    assert bench.service.heartbeats.malformed > 5


def test_error_frames_become_states_emcys_and_objects(bench: MasterBench) -> None:
    """linux/can/error.h: CRTL | CNT with TX passive, TEC 130, REC 2; then active again; then bus-off."""
    bench.send(CAN_ERR_FLAG | 0x204, frame("00 20 0000 0000 82 02"))
    assert bench.run(lambda: bool(bench.own(EMCY)))
    assert bench.own(EMCY) == [frame("2081 11 0000 0000 00")]
    assert "bus: error passive, previously error active (TEC 130, REC 2)" in bench.lines
    assert [bench.sdo(0x2205, sub) for sub in (1, 2, 3, 5)] == [2, 130, 2, 1]
    bench.send(CAN_ERR_FLAG | 0x004, frame("00 40 0000 0000 0000"))
    assert bench.run(lambda: bool(bench.own(EMCY)))
    assert bench.own(EMCY) == [frame("0000 00 2081 0000 00")]
    bench.heard.clear()
    bench.send(CAN_ERR_FLAG | 0x040, frame("0000000000000000"))
    assert bench.run(lambda: bool(bench.own(EMCY)))
    assert bench.own(EMCY) == [frame("4081 01 0000 0000 00")], "8140h when the first frame was heard again"
    assert [bench.sdo(0x2205, sub) for sub in (1, 6)] == [0, 1]

    def reported() -> Any:
        return json.loads((Path(bench.path).parent / "bus.json").read_text())

    assert bench.run(lambda: reported()["nodes"]["1"]["heartbeat"] == "heard")
    assert reported()["state"] == "error active"
    assert reported()["counts"]["bus_offs"] == 1


def test_emcy_of_the_nodes_short_ones_too(bench: MasterBench) -> None:
    bench.send(0x081, frame("1023 03 0000000000"))
    bench.send(0x083, frame("0073"))
    assert bench.run(lambda: bench.logged("node 3:"))
    assert "node 1: EMCY 2310h (continuous overcurrent), register 03h (generic, current)" in bench.lines
    assert "node 3: EMCY 7300h (sensor), register 00h (none), a frame of 2 bytes" in bench.lines
    assert bench.sdo(0x2207, 1) == 0x01_03_2310
    assert bench.sdo(0x2207, 2) == 0
    reported = len(bench.lines)
    for _ in range(3000):
        bench.send(0x081, frame("1023 03 0000000000"))
    bench.pause(0.5)
    assert len(bench.lines) == reported, "a storm of what is known already"
    assert bench.service.emergencies.count_of(1) > 1000


def test_foreign_nmt_commands_and_nodes_are_reported(bench: MasterBench) -> None:
    bench.send(0x000, b"\x02\x00")
    bench.send(0x705, b"\x00")
    assert bench.run(lambda: len(bench.lines) >= 2)
    assert "NMT command 'stop' to all nodes from another master" in bench.lines
    assert "node 5: on the bus but not in the configuration (status A)" in bench.lines
    assert bench.service.foreign_nmt == 1


def test_a_stopped_node_is_booted_and_its_boot_is_nobodys_foreign_command(bench: MasterBench) -> None:
    bench.drives[0].state = 4
    bench.snapshot.node_states[1] = 4
    assert bench.run(lambda: bench.drives[0].state == 5)
    bench.snapshot.node_states[1] = 5
    assert bench.run(lambda: bench.logged("node 1 returned and is configured again"))
    bench.pause(0.3)
    assert not bench.logged("another master")
    assert bench.snapshot.configured[1] == 1


def test_a_configuration_that_somebody_changed_is_found_and_put_right(bench: MasterBench) -> None:
    """The two positions swapped: same COB-ID, same length, other meaning. Only reading it again shows it."""
    store = bench.drives[0].store
    store.set_number(0x1A00, 1, 0x60E4_0120)
    store.set_number(0x1A00, 2, 0x6064_0020)
    store.set_number(0x1020, 1, 0)  # as a device does when it is written to
    assert bench.run(lambda: bench.snapshot.configured[1] == 1, 20.0), bench.lines
    assert bench.drives[0].parameters.tpdos()[0] == drive_tpdo1(1)
    assert bench.drives[0].state == 5
    expected = "1A00h:1: expected 0x60640020, found 0x60E40120"
    assert bench.logged(f"node 1: its configuration was changed ({expected})")
    assert store.number(0x1020, 1) != 0, "signed again"


def test_a_node_that_somebody_else_asks_is_left_alone(bench: MasterBench) -> None:
    """An SDO server serves one client: while the commander uses it, jtqd's checks wait."""
    asked = frame("40 41 60 00 00 00 00 00")  # 6041h, from another client

    def checks() -> int:
        return sum(can_id == 0x601 for can_id, _ in bench.heard)

    assert bench.run(lambda: checks() >= 2)
    bench.send(0x601, asked)
    bench.pause(0.3)  # what had been asked for is over
    bench.heard.clear()
    for _ in range(4):
        bench.send(0x601, asked)
        bench.pause(0.3)
    assert checks() == 0
    assert sum(can_id == 0x602 for can_id, _ in bench.heard) > 0, "the others are checked"
    assert bench.run(lambda: checks() >= 2)


def test_an_absent_optional_sensor_is_reported_and_configured_when_it_appears(tmp_path: Path) -> None:
    with MasterBench(tmp_path, with_sensor=False) as bench:
        assert bench.logged("node 3: no answer to SDO 1000h:0")
        assert bench.logged("it is optional")
        assert 3 in bench.service.returning.absent
        bench.pause(0.5)
        assert not bench.children, "an absent node is not booted"
        probes = [data for can_id, data in bench.heard if can_id == 0x603]
        assert frame("40 00 10 00 00 00 00 00") in probes, "but it is asked for (1000h:0)"
        bench.appear()
        assert bench.run(lambda: bench.snapshot.configured[3] == 1), bench.lines
        assert bench.logged("node 3 appeared and is configured")
        assert bench.sensor.parameters.tpdos() == [sensor_tpdo1(3)]
        assert bench.sensor.state == 5
        assert bench.snapshot.factors(3) == (0.001, 0.0, 0.0, 0.0)
        assert 3 not in bench.service.returning.absent
        bench.pause(0.4)
        assert bench.sdo(0x2206, 3) >> 8 & 0xFF == 2, "and watched from now on"


def test_a_node_that_cannot_be_booted_keeps_no_other_one_waiting(bench: MasterBench) -> None:
    bench.drives[0].store.set_number(0x1000, 0, 0x00020194)  # node 1 came back as a sensor
    for node in (1, 2):
        bench.snapshot.unconfigured[node] = 1
    assert bench.run(lambda: bench.snapshot.configured[2] == 1), bench.lines
    assert bench.snapshot.configured[1] == 0
    bench.snapshot.unconfigured[2] = 0
    bench.pause(1.5)
    assert 2 <= len(bench.children) <= 4, "tried again, less and less often"
    assert len([line for line in bench.lines if "status C" in line]) == 1


def test_a_storm_of_requests_is_answered_a_part_at_a_time(bench: MasterBench) -> None:
    longest = 0.0
    for _ in range(40):
        for _ in range(100):
            bench.send(0x600 + OWN, frame("40 00 10 00 00 00 00 00"))
        began = time.monotonic()
        bench.service.turn(bench.reader.read(), began)
        longest = max(longest, time.monotonic() - began)
    assert longest < 0.5
    assert bench.run(lambda: bool(bench.own(SDO)))
    garbage = [bytes(n) for n in range(8)] + [bytes([c]) + bytes(7) for c in range(256)]
    for data in garbage:
        bench.send(0x600 + OWN, data)
        bench.send(0x580 + 1, data)
    bench.pause(0.2)
    assert bench.sdo(0x1000, 0) == 0


# Configuration that changes in service while 1020h is intact


ROUND_S = 0.8
"""Longer than a round of all objects takes in `fast_bench`."""


@pytest.fixture
def fast_bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[MasterBench]:
    """A round of all objects takes half a second here, and not ten."""
    monkeypatch.setattr(node_care, "_CHECK_S", 0.004)
    with MasterBench(tmp_path) as each:
        yield each


def test_a_rated_current_that_changed_keeps_the_node_out_until_it_is_as_it_was(
    fast_bench: MasterBench,
) -> None:
    """6075h is a factor of each current: with the old one every torque would be wrong, and nothing else shows it."""
    store, before = fast_bench.drives[0].store, fast_bench.drives[0].store.number(0x6075)
    store.set_number(0x6075, 0, before // 2)
    assert store.number(0x1020, 1) != 0
    assert fast_bench.run(lambda: fast_bench.snapshot.doubts[1] == 1, 10.0), fast_bench.lines
    assert fast_bench.snapshot.orders[2] == 1, "the loop knows before a boot has begun"
    text = f"node 1: its configuration was changed (6075h:0: expected {before}, found {before // 2})"
    assert text in fast_bench.lines
    assert fast_bench.run(lambda: bool(fast_bench.own(EMCY)))
    #                                       code reg ended node joint 1
    assert fast_bench.own(EMCY)[0] == frame("03ff 81 0000 0100 01")
    assert fast_bench.run(lambda: fast_bench.logged("node 1 has another scaling than at the start"))
    fast_bench.pause(ROUND_S)
    assert fast_bench.snapshot.configured[1] == 0, "never with another factor"
    assert [fast_bench.snapshot.doubts[node] for node in (1, 2, 3)] == [1, 0, 0]
    fast_bench.heard.clear()
    store.set_number(0x6075, 0, before)
    assert fast_bench.run(lambda: fast_bench.snapshot.configured[1] == 1, 15.0), fast_bench.lines
    assert fast_bench.run(lambda: frame("0000 00 03ff 0100 01") in fast_bench.own(EMCY))
    assert fast_bench.drives[0].state == 5
    fast_bench.pause(ROUND_S)
    assert fast_bench.snapshot.doubts[1] == 1, "watched again, and well"


def test_the_sensors_decimals(fast_bench: MasterBench) -> None:
    fast_bench.sensor.store.set_number(0x6132, 1, 2)
    assert fast_bench.run(lambda: fast_bench.snapshot.doubts[3] == 1, 10.0), fast_bench.lines
    assert fast_bench.logged("node 3: its configuration was changed (6132h:1: expected 3, found 2)")
    assert fast_bench.run(lambda: fast_bench.logged("node 3 has another scaling than at the start"))
    fast_bench.sensor.store.set_number(0x6132, 1, 3)
    assert fast_bench.run(lambda: fast_bench.snapshot.configured[3] == 1, 15.0), fast_bench.lines


def test_a_pdo_parameter_is_written_again(fast_bench: MasterBench) -> None:
    """Transmission type, switched off, mapping, COB-ID, one after the other."""
    changes = (0x1800, 2, 10), (0x1800, 1, 0xC000_0181), (0x1A00, 1, 0x60E4_0120), (0x1801, 1, 0x4000_0285)
    for n, change in enumerate(changes, start=1):
        fast_bench.drives[0].store.set_number(*change)
        assert fast_bench.run(lambda n=n: fast_bench.snapshot.doubts[1] == n), (change, fast_bench.lines)  # type: ignore[misc]
        assert fast_bench.run(lambda n=n: fast_bench.snapshot.configured[1] == n), (change, fast_bench.lines)  # type: ignore[misc]
        assert fast_bench.drives[0].parameters.tpdos()[0] == drive_tpdo1(1)
        assert fast_bench.run(lambda: fast_bench.drives[0].state == 5)
        assert not fast_bench.service.care.changed


def test_a_gear_ratio_by_other_numbers_is_the_same(fast_bench: MasterBench) -> None:
    """The objects changed and not what they mean: the node is booted, and used again."""
    for subindex in (1, 2):
        fast_bench.drives[0].store.set_number(
            0x6091, subindex, 2 * fast_bench.drives[0].store.number(0x6091, subindex)
        )
    assert fast_bench.run(lambda: fast_bench.snapshot.configured[1] == 1, 15.0), fast_bench.lines
    fast_bench.pause(ROUND_S)
    assert fast_bench.snapshot.doubts[1] == 1, "the values of its last boot count"


def test_another_mode_is_reported_and_the_node_is_used(fast_bench: MasterBench) -> None:
    fast_bench.pause(ROUND_S)
    fast_bench.drives[1].store.set_number(0x6061, 0, 10)
    assert fast_bench.run(
        lambda: fast_bench.logged("node 2: its mode of operation (6061h) is 10 now, 0 before"), 10.0
    )
    assert not any(fast_bench.snapshot.doubts)
    assert not fast_bench.own(EMCY)


def test_the_readings_fit_the_bus() -> None:
    """Both frames of each reading, at worst, beside the fullest configuration."""
    load = configured_load((1, 2), {3: (1, 2)}, temperatures=(1, 2)).worst
    readings = 2 * worst_case_bits(8) / node_care._CHECK_S / 1_000_000
    print(f"readings: {readings:.2%}, with the fullest bus: {load + readings:.2%}")
    assert readings < 0.003
    assert load + readings < LIMIT


def test_how_long_a_round_takes(fast_bench: MasterBench) -> None:
    """docs/bus.md states it: all objects of a drive, and a signature in each fourth reading, a third of all readings."""
    watched = {node: len(report["watched"]) for node, report in fast_bench.report["nodes"].items()}
    round_s = {node: 3 * 0.1 * (count + 1) * 4 / 3 for node, count in watched.items()}
    print(json.dumps({"objects": watched, "round_s": round_s}))
    assert max(round_s.values()) < 12.5
