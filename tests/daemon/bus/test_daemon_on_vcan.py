"""The whole daemon on vcan: nodes and masters in a run, error messages of the controller, an interface that goes down."""

from __future__ import annotations

import json
import math
import os
import subprocess
import time
from collections.abc import Iterator
from typing import Any

import canopen
import pytest

from jtqd.daemon.logs import read_attachments
from jtqd.daemon.shared.events import NoticesReader
from tests.daemon.bus.master_daemon import INTERFACE, STALE, Daemon, LateSensor, a_daemon, frame
from tests.paths import JTQD_EDS

pytestmark = pytest.mark.socketcan


@pytest.fixture(scope="module")
def running() -> Iterator[Daemon]:
    with a_daemon() as daemon:
        yield daemon


@pytest.fixture
def daemon(running: Daemon) -> Daemon:
    running.begin()
    return running


@pytest.fixture
def node(daemon: Daemon) -> Iterator[Any]:
    """jtqd as another master sees it: canopen's RemoteNode with the data sheet."""
    network = canopen.Network()
    network.connect(interface="socketcan", channel=daemon.bus)
    remote = network.add_node(0x20, str(JTQD_EDS))
    remote.sdo.RESPONSE_TIMEOUT = 2.0
    yield remote
    network.disconnect()


def test_any_master_reads_every_object_of_the_data_sheet(node: Any) -> None:
    read = {}
    for index, described in node.object_dictionary.items():
        if index < 0x1000:
            continue  # dummies
        for sub in described.subindices if hasattr(described, "subindices") else (None,):
            entry = node.sdo[index] if sub is None else node.sdo[index][sub]
            read[index, sub or 0] = entry.raw
    assert len(read) > 120
    assert read[0x1000, 0] == 0
    assert read[0x1005, 0] == 0x4000_0080, "producer of SYNC 080h"
    assert (read[0x1006, 0], read[0x1019, 0]) == (1000, 0)
    assert read[0x1008, 0] == "jtqd"
    assert read[0x1014, 0] == 0x0A0
    assert read[0x1015, 0] == 100, "10 ms"
    assert [read[0x1016, sub] for sub in (1, 2, 3)] == [node << 16 | 300 for node in (1, 2, 3)]
    assert (read[0x1200, 1], read[0x1200, 2]) == (0x620, 0x5A0)
    assert (read[0x1800, 1], read[0x1800, 2]) == (0x4000_01A0, 1)
    assert read[0x1A00, 0] == 6
    assert [read[0x2206, sub] for sub in (1, 2, 3)] == [0x01_01_02_05, 0x02_01_02_05, 0x03_01_02_05]
    assert read[0x2200, 1] > 0, "cycles"
    assert (read[0x2205, 1], read[0x2205, 6]) == (0, 0)
    assert (read[0x1020, 1], read[0x1020, 2]) == tuple(
        int(read[0x2204, 0][8 * n : 8 * n + 8], 16) for n in range(2)
    )
    for index, sub in ((0x2200, 1), (0x1016, 1), (0x1017, None)):
        entry = node.sdo[index] if sub is None else node.sdo[index][sub]
        with pytest.raises(canopen.SdoAbortedError):
            entry.raw = 0


def test_lengths_are_reported_per_pdo_and_never_applied(daemon: Daemon, node: Any) -> None:
    """5 bytes under 282h, and 8 under 183h, which has 5."""
    node.sdo[0x1003][0].raw = 0
    daemon.send(0x282, bytes(5))
    assert daemon.until(lambda: bool(daemon.emcys))
    #                                code reg ended COB-ID joint 2
    assert daemon.emcys[0] == frame("1082 11 0000 8202 02")
    daemon.send(0x183, bytes(8))
    assert daemon.until(lambda: len(daemon.emcys) >= 4)
    assert daemon.emcys[1] == frame("2082 11 0000 8301 00")
    assert {each[3:] for each in daemon.emcys[2:4]} == {frame("1082 8202 02"), frame("2082 8301 00")}
    assert [each[2] for each in daemon.emcys[2:4]] == [0x00, 0x00] or daemon.emcys[2][2] == 0x11
    assert [node.sdo[0x1003][sub].raw for sub in (0, 1, 2)] == [2, 0x0183_8220, 0x0282_8210]
    assert daemon.well() or daemon.until(daemon.well)
    inputs = daemon.reader.read().inputs
    assert (inputs[3].short, inputs[4].long) == (1, 1)
    assert "281h" not in daemon.log_text()
    node.sdo[0x1003][0].raw = 0
    assert node.sdo[0x1003][0].raw == 0


def test_a_second_sync_producer_makes_all_inputs_stale_and_is_8150h(daemon: Daemon) -> None:
    assert (
        daemon.until(
            lambda: daemon.statuses[-50:].count((STALE, STALE)) >= 45, do=lambda: daemon.send(0x080, b"\x07")
        )
        or daemon.reader.read().counters["foreign_sync"] > 0
    )
    assert daemon.until(lambda: frame("5081 11 0000 8000 03") in daemon.emcys)
    assert "another SYNC producer" in daemon.log_text()
    assert daemon.until(
        lambda: any(each[:2] == b"\0\0" and each[3:7] == frame("5081 8000") for each in daemon.emcys)
    )
    assert daemon.until(daemon.well), "it has gone, and estimates are back"


def test_frames_of_others_with_own_cob_ids_are_8150h_and_own_echoes_are_none(daemon: Daemon) -> None:
    """Estimate PDOs, heartbeat, EMCY and SDO answer; before them thousands of own frames have come back as echoes."""
    before = daemon.reader.read().counters
    assert before["cob_id_conflicts"] == 0
    own = (0x1A0, 0x2A0, 0x3A0, 0x720, 0x0A0, 0x5A0)
    for cob_id in own:
        daemon.send(cob_id, b"\x05" if cob_id == 0x720 else bytes(8))
        identifier = cob_id.to_bytes(2, "little")
        assert daemon.until(
            lambda identifier=identifier: frame("5081 11 0000") + identifier + b"\0" in daemon.emcys
        ), hex(cob_id)
        assert f"COB-ID {cob_id:03X}h: another node sends with this COB-ID of jtqd" in daemon.log_text()
    assert daemon.until(
        lambda: (
            {each[5:7] for each in daemon.emcys if each[:2] == b"\0\0"}
            == {cob_id.to_bytes(2, "little") for cob_id in own}
        )
    )
    after = daemon.reader.read().counters
    assert after["cob_id_conflicts"] - before["cob_id_conflicts"] == 4
    assert after["unknown_frames"] == before["unknown_frames"]


def test_a_node_that_stops_is_8250h_for_each_of_its_pdos(daemon: Daemon) -> None:
    """NMT stop by another master: reported, its PDOs time out, and it is configured and started again."""
    daemon.send(0x000, b"\x02\x02")
    assert daemon.until(lambda: len(daemon.emcys) >= 4)
    come = [each for each in daemon.emcys if each[:2] == frame("5082")]
    assert {each[5:] for each in come} == {frame("8201 02"), frame("8202 02")}
    gone = [each for each in daemon.emcys if each[:2] == b"\0\0"]
    assert {each[3:] for each in gone} == {frame("5082 8201 02"), frame("5082 8202 02")}
    assert "NMT command 'stop' to node 2 from another master" in daemon.log_text()
    assert daemon.until(daemon.well)
    assert (STALE, STALE) not in daemon.statuses[-50:]


def test_a_node_reset_in_the_middle_of_a_run_is_configured_before_it_is_believed(daemon: Daemon) -> None:
    """Reset communication: its mapping is the device's default again (TPDO1 the statusword, TPDO2 other positions)."""
    before = daemon.reader.read().counters["published"]
    daemon.send(0x000, b"\x82\x01")
    assert daemon.until(lambda: any(each[0] == STALE for each in daemon.statuses))
    assert daemon.until(daemon.well, 20.0), daemon.log_text()
    first = next(n for n, each in enumerate(daemon.statuses) if each[0] == STALE)
    assert daemon.statuses[first : first + 50].count((STALE, STALE)) < 25, "joint 2 goes on"
    assert daemon.process.poll() is None
    assert daemon.reader.read().counters["published"] > before
    assert "node 1 returned and is configured again" in daemon.log_text()
    (notices,) = (daemon.directory / "run").glob("*/notices")
    texts = [each.text for each in NoticesReader(notices).read()[0]]
    assert "node 1 returned and is configured again" in texts, "for the log"


# The interface


def ip(*arguments: str) -> None:
    subprocess.run(["ip", "link", *arguments], check=True)


def inject(text: str) -> None:
    """An error message of a driver, as candump prints it."""
    subprocess.run(["cansend", INTERFACE, text], check=True)


def test_error_messages_of_the_controller(daemon: Daemon) -> None:
    """CRTL with CNT: TX passive, 136 and 0 errors; then active again; then bus-off."""
    inject("20000204#0020000000008800")
    assert daemon.until(lambda: frame("2081 11 0000 0000 00") in daemon.emcys)
    assert "bus: error passive, previously error active (TEC 136, REC 0)" in daemon.log_text()
    inject("20000004#0040000000000000")
    assert daemon.until(lambda: frame("0000 00 2081 0000 00") in daemon.emcys)
    began = time.monotonic()
    inject("20000040#0000000000000000")
    assert daemon.until(lambda: frame("4081 01 0000 0000 00") in daemon.emcys)
    print(f"bus-off: EMCY 8140h after {time.monotonic() - began:.3f} s")
    assert "bus: bus-off" in daemon.log_text()
    assert daemon.until(lambda: daemon.report()["counts"]["bus_offs"] == 1)
    assert daemon.well() or daemon.until(daemon.well)


def test_an_interface_that_is_down_for_a_second(daemon: Daemon) -> None:
    """ENETDOWN comes once; the same sockets work again after `up`. The drives have left operational: booted again."""
    ip("set", INTERFACE, "down")
    assert daemon.until(lambda: "bus: interface down" in daemon.log_text())
    time.sleep(1.0)
    daemon.reopen()
    ip("set", INTERFACE, "up")
    began = time.monotonic()
    assert daemon.until(daemon.well, 20.0), daemon.log_text()
    print(f"back {time.monotonic() - began:.2f} s after the interface was up")
    assert daemon.until(lambda: "bus: error active after" in daemon.log_text()), daemon.log_text()
    assert daemon.process.poll() is None
    assert daemon.until(lambda: daemon.report()["state"] == "error active")
    assert daemon.report()["counts"]["downs"] == 1


@pytest.mark.skipif(not os.environ.get("JTQD_IN_BENCH_KERNEL"), reason="removes the interface")
def test_an_interface_that_is_removed_ends_the_daemon_with_one_line(daemon: Daemon) -> None:
    """ENODEV: the socket is useless for good. systemd starts jtqd again when the interface is back (BindsTo)."""
    before = len(daemon.log_text().splitlines())
    try:
        ip("del", INTERFACE)
        assert daemon.process.wait(20) == 1
        daemon.bench.wait(20)
    finally:
        ip("add", "dev", INTERFACE, "type", "vcan")
        ip("set", INTERFACE, "txqueuelen", "1000", "up")
    lines = daemon.log_text().splitlines()[before:]
    assert "Traceback" not in daemon.log_text()
    assert not [line for line in lines if "jtqd" not in line]
    summary = daemon.out.read_text()
    assert f"{INTERFACE}: bus lost" in summary + daemon.log_text(), summary
    with a_daemon() as again:
        assert again.process.poll() is None, "made again, it works again"


def test_a_sensor_that_appears_in_service_is_configured_and_used() -> None:
    """Absent at the start: jtqd reports it and estimates without a reference; then its torque is there, scaled.

    The log then goes on in a part with its scaling.
    """
    with a_daemon(record="logs", sensor={"node": 5, "channels": 1}) as daemon:
        sensor = LateSensor(daemon.bus)
        try:
            assert "node 5: no answer to SDO 1000h:0" in daemon.log_text()
            view = daemon.reader.read()
            assert all(math.isnan(joint.sensor_nm) for joint in view.joints)
            assert view.counters["complete"] == view.counters["cycles"], "the loop does not wait for it"
            assert view.counters["stale_inputs"] == 0, "nor misses it"
            sensor.start()
            torque = pytest.approx(4.321)
            assert daemon.until(lambda: daemon.reader.read().joints[0].sensor_nm == torque, 20.0), (
                daemon.log_text()
            )
            assert "node 5 appeared and is configured" in daemon.log_text()
            assert daemon.until(daemon.well)
            logs = daemon.directory / "logs"
            assert daemon.until(lambda: len(list(logs.iterdir())) == 2)
            before, after = (
                json.loads(read_attachments(path)["provenance.json"])["nodes"]
                for path in sorted(logs.iterdir())
            )
            assert "5" not in before
            assert after["5"]["scaling"] == {"nm_per_unit": {"1": pytest.approx(0.001)}}
        finally:
            sensor.ended = True
            sensor.join(5)
