"""The bus itself: error messages of the controller, an interface that goes down, one that is removed, a late sensor."""

from __future__ import annotations

import json
import math
import os
import subprocess
import time
from collections.abc import Iterator

import pytest

from jtqd.daemon.logs import read_attachments
from tests.daemon.bus.master_daemon import INTERFACE, Daemon, LateSensor, a_daemon, frame

pytestmark = pytest.mark.socketcan


def ip(*arguments: str) -> None:
    subprocess.run(["ip", "link", *arguments], check=True)


@pytest.fixture(scope="module")
def running() -> Iterator[Daemon]:
    with a_daemon() as daemon:
        yield daemon


@pytest.fixture
def daemon(running: Daemon) -> Daemon:
    running.begin()
    return running


def inject(text: str) -> None:
    """An error message of a driver, as candump prints it."""
    subprocess.run(["cansend", INTERFACE, text], check=True)


def test_error_messages_of_the_controller(daemon: Daemon) -> None:
    """CRTL with CNT: TX passive, 136 and 0 errors; then active again; then bus-off."""
    inject("20000204#0020000000008800")
    assert daemon.until(lambda: frame("2081 11 0000 0000 00") in daemon.emcys)
    assert "bus: error passive, previously error active (TEC 136, REC 0)" in daemon.said()
    inject("20000004#0040000000000000")
    assert daemon.until(lambda: frame("0000 00 2081 0000 00") in daemon.emcys)
    began = time.monotonic()
    inject("20000040#0000000000000000")
    assert daemon.until(lambda: frame("4081 01 0000 0000 00") in daemon.emcys)
    print(f"bus-off: EMCY 8140h after {time.monotonic() - began:.3f} s")
    assert "bus: bus-off" in daemon.said()
    assert daemon.until(lambda: daemon.report()["counts"]["bus_offs"] == 1)
    assert daemon.well() or daemon.until(daemon.well)


def test_an_interface_that_is_down_for_a_second(daemon: Daemon) -> None:
    """ENETDOWN comes once; the same sockets work again after `up`. The drives have left operational: booted again."""
    ip("set", INTERFACE, "down")
    assert daemon.until(lambda: "bus: interface down" in daemon.said())
    time.sleep(1.0)
    daemon.reopen()
    ip("set", INTERFACE, "up")
    began = time.monotonic()
    assert daemon.until(daemon.well, 20.0), daemon.said()
    print(f"back {time.monotonic() - began:.2f} s after the interface was up")
    assert daemon.until(lambda: "bus: error active after" in daemon.said()), daemon.said()
    assert daemon.process.poll() is None
    assert daemon.until(lambda: daemon.report()["state"] == "error active")
    assert daemon.report()["counts"]["downs"] == 1


@pytest.mark.skipif(not os.environ.get("JTQD_IN_BENCH_KERNEL"), reason="removes the interface")
def test_an_interface_that_is_removed_ends_the_daemon_with_one_line(daemon: Daemon) -> None:
    """ENODEV: the socket is useless for good. systemd starts jtqd anew when the interface is back (BindsTo)."""
    before = len(daemon.said().splitlines())
    try:
        ip("del", INTERFACE)
        assert daemon.process.wait(20) == 1
        daemon.bench.wait(20)
    finally:
        ip("add", "dev", INTERFACE, "type", "vcan")
        ip("set", INTERFACE, "txqueuelen", "1000", "up")
    lines = daemon.said().splitlines()[before:]
    assert "Traceback" not in daemon.said()
    assert not [line for line in lines if "jtqd" not in line]
    summary = daemon.out.read_text()
    assert f"{INTERFACE}: bus lost" in summary + daemon.said(), summary
    with a_daemon() as again:
        assert again.process.poll() is None, "made again, it works again"


def test_a_sensor_that_appears_in_service_is_configured_and_used() -> None:
    """Absent at the start: jtqd says so and estimates without a reference; then its torque is there, scaled.

    The log then goes on in a part that says how it is scaled.
    """
    with a_daemon(record="logs", sensor={"node": 5, "channels": 1}) as daemon:
        sensor = LateSensor(daemon.bus)
        try:
            assert "node 5: no answer to SDO 1000h:0" in daemon.said()
            view = daemon.reader.read()
            assert all(math.isnan(joint.sensor_nm) for joint in view.joints)
            assert view.counters["complete"] == view.counters["cycles"], "nobody waits for it"
            assert view.counters["stale_inputs"] == 0, "nor misses it"
            sensor.start()
            torque = pytest.approx(4.321)
            assert daemon.until(lambda: daemon.reader.read().joints[0].sensor_nm == torque, 20.0), (
                daemon.said()
            )
            assert "node 5 appeared and is configured" in daemon.said()
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
