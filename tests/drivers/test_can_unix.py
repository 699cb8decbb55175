"""The python-can interface `jtq_unix`, used the way python-can, canopen and can.logger use it."""

import asyncio
import importlib.metadata
import os
import signal
import subprocess
import sys
import threading
import time
import tomllib

import can
import can.interfaces
import can.util
import canopen
import pytest

from jtqd.drivers.frame import CAN_ERR_FLAG, pack
from jtqd.drivers.hub import Hub
from tests.paths import ROOT

pytestmark = pytest.mark.native

NAME = "jtq_unix"


@pytest.fixture(autouse=True)
def _registered(monkeypatch):
    """As the entry point does it; a checkout that is not installed has none."""
    monkeypatch.setitem(can.interfaces.BACKENDS, NAME, ("jtqd.drivers.can_unix", "UnixBus"))
    monkeypatch.setattr(can.util, "VALID_INTERFACES", frozenset(can.interfaces.BACKENDS))


@pytest.fixture
def path(tmp_path):
    """A bus whose hub runs in a thread."""
    path = str(tmp_path / "bus")
    hub = Hub(path)
    stop = threading.Event()

    def serve():
        while not stop.is_set():
            hub.run_once(0.01)

    thread = threading.Thread(target=serve)
    thread.start()
    yield path
    stop.set()
    thread.join()
    hub.close()


def open_bus(path, **options):
    return can.Bus(interface=NAME, channel=path, **options)


def joined(*buses):
    """Return once every bus is served: each has seen a frame of another."""
    for each in buses:
        for other in buses:
            if other is not each:
                other.send(can.Message(arbitration_id=0x7FF, is_extended_id=False))
        while each.recv(0.05) is not None:
            pass
    for each in buses:
        while each.recv(0.02) is not None:
            pass


def test_every_kind_of_message_survives(path):
    with open_bus(path) as a, open_bus(path) as b:
        joined(a, b)
        sent = [
            can.Message(arbitration_id=0x181, data=bytes(range(8)), is_extended_id=False),
            can.Message(arbitration_id=0x000, data=b"", is_extended_id=False),
            can.Message(arbitration_id=0x1ABCDEF0, data=b"\x01\x02", is_extended_id=True),
            can.Message(arbitration_id=0x123, is_remote_frame=True, dlc=4, is_extended_id=False),
            can.Message(arbitration_id=0x040, is_error_frame=True, data=bytes(8), is_extended_id=False),
        ]
        before = time.time()
        for message in sent:
            a.send(message)
        got = [b.recv(1.0) for _ in sent]
        for message, back in zip(sent, got, strict=True):
            assert back is not None
            assert back.equals(message, timestamp_delta=None, check_channel=False, check_direction=False)
            assert before - 0.001 <= back.timestamp <= time.time() + 0.001
            assert back.is_rx
            assert back.channel == path
        assert b.recv(0.01) is None
        assert a.recv(0.01) is None
        assert str(b) == f"unix bus {path}"


def test_own_messages_on_request_only_and_marked_as_sent(path):
    with open_bus(path, receive_own_messages=True) as a, open_bus(f"unix:{path}") as b:
        joined(a, b)
        a.send(can.Message(arbitration_id=0x181, data=b"\x01", is_extended_id=False))
        echo = a.recv(1.0)
        assert echo is not None
        assert not echo.is_rx
        assert echo.data == b"\x01"
        assert b.recv(1.0).is_rx


def test_filters_run_in_the_kernel(path):
    filters = [
        {"can_id": 0x180, "can_mask": 0x780, "extended": False},
        {"can_id": 0x12345678, "can_mask": 0x1FFFFFFF, "extended": True},
    ]
    with open_bus(path) as a, open_bus(path, can_filters=filters) as b:
        joined(a, b)
        a.send(can.Message(arbitration_id=0x280, is_extended_id=False))
        a.send(can.Message(arbitration_id=0x182, is_extended_id=True))
        a.send(can.Message(arbitration_id=0x182, is_extended_id=False))
        a.send(can.Message(arbitration_id=0x12345678, is_extended_id=True))
        assert b.recv(1.0).arbitration_id == 0x182
        assert b.recv(1.0).arbitration_id == 0x12345678
        message, filtered = b._recv_internal(0.0)
        assert message is None
        assert filtered
        b.set_filters([{"can_id": 0x280, "can_mask": 0x7FF}])  # without `extended`: both formats
        a.send(can.Message(arbitration_id=0x182, is_extended_id=False))
        a.send(can.Message(arbitration_id=0x280, is_extended_id=False))
        a.send(can.Message(arbitration_id=0x280, is_extended_id=True))
        assert [b.recv(1.0).is_extended_id for _ in range(2)] == [False, True]
        b.set_filters(None)
        a.send(can.Message(arbitration_id=0x7, is_extended_id=False))
        assert b.recv(1.0).arbitration_id == 0x7


def test_messages_that_are_no_classic_frame_are_refused(path):
    with open_bus(path) as bus:
        for message in [
            can.Message(arbitration_id=0x800, is_extended_id=False),
            can.Message(arbitration_id=1 << 29, is_extended_id=True),
            can.Message(arbitration_id=1, dlc=9, is_extended_id=False),
            can.Message(arbitration_id=1, dlc=3, data=b"\x01", is_extended_id=False),
            can.Message(arbitration_id=1, is_fd=True, data=bytes(12), is_extended_id=False),
        ]:
            with pytest.raises(ValueError, match=r"arbitration_id|dlc|FD"):
                bus.send(message)


def test_no_hub_and_end_of_the_hub_are_python_can_errors(tmp_path):
    path = str(tmp_path / "bus")
    with pytest.raises(can.CanInitializationError, match="no bus at unix:"):
        open_bus(path)
    with pytest.raises(can.CanInitializationError, match="FD"):
        open_bus(path, fd=True)
    hub = Hub(path)
    bus = open_bus(path, ignore_rx_error_frames=True)
    hub.run_once(0)
    port = hub.attach(lambda _frame, _stamp: None)
    port.send(pack(CAN_ERR_FLAG | 0x40, bytes(8)))
    assert bus.recv(0.0) is None
    hub.close()
    with pytest.raises(can.CanOperationError, match="lost"):
        bus.recv(0.1)
    with pytest.raises(can.CanOperationError, match="lost"):
        bus.send(can.Message(arbitration_id=1))
    bus.shutdown()


def test_full_buffer_is_an_error_after_the_timeout(tmp_path):
    hub = Hub(str(tmp_path / "bus"))
    bus = open_bus(str(tmp_path / "bus"))
    hub.run_once(0)
    message = can.Message(arbitration_id=1, is_extended_id=False)

    def fill():
        for _ in range(5000):  # the hub does not run
            bus.send(message)

    with pytest.raises(can.CanOperationError, match="Transmit buffer full"):
        fill()
    start = time.monotonic()
    with pytest.raises(can.CanOperationError, match="Transmit buffer full"):
        bus.send(message, timeout=0.05)
    assert time.monotonic() - start >= 0.05
    bus.shutdown()
    hub.close()


def test_asyncio_notifier_sees_every_message_of_a_burst(path):
    """It takes one message per readiness of fileno(): none may hide in a buffer of ours."""

    async def collect():
        got = []
        with open_bus(path) as a, open_bus(path) as b:
            joined(a, b)
            notifier = can.Notifier(b, [got.append], loop=asyncio.get_running_loop())
            for i in range(50):
                a.send(can.Message(arbitration_id=i, is_extended_id=False))
            for _ in range(200):
                if len(got) == 50:
                    break
                await asyncio.sleep(0.01)
            notifier.stop()
        return got

    assert [message.arbitration_id for message in asyncio.run(collect())] == list(range(50))


def test_canopen_master_reads_a_node(path):
    """SDO, heartbeat and NMT of canopen over the unix bus, Notifier threads included."""
    dictionary = canopen.ObjectDictionary()
    variable = canopen.objectdictionary.ODVariable("Device type", 0x1000)
    variable.data_type = canopen.objectdictionary.UNSIGNED32
    variable.default = 0x00020192
    dictionary.add_object(variable)
    master, device = canopen.Network(), canopen.Network()
    device.connect(interface=NAME, channel=path)
    master.connect(interface=NAME, channel=path)
    try:
        device.create_node(5, dictionary)
        node = master.add_node(5, dictionary)
        node.sdo.RESPONSE_TIMEOUT = 2.0
        assert node.sdo[0x1000].raw == 0x00020192
        device[5].nmt.send_command(0x01)
        device[5].nmt.start_heartbeat(20)
        assert node.nmt.wait_for_heartbeat(2.0) == "OPERATIONAL"
    finally:
        master.disconnect()
        device.disconnect()


def entry_point_installed():
    points = importlib.metadata.entry_points(group="can.interface")
    return [point for point in points if point.name == NAME]


@pytest.mark.skipif(not entry_point_installed(), reason="the package is not installed here")
def test_entry_point_names_the_class():
    (point,) = set(entry_point_installed())
    assert point.value == "jtqd.drivers.can_unix:UnixBus"
    assert issubclass(point.load(), can.BusABC)


def installed_metadata(directory):
    """What an installation would put on the path: the entry points of pyproject.toml, nothing else."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    metadata = directory / "jtqd_entry_points-0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: jtqd_entry_points\nVersion: 0\n")
    points = project["entry-points"]["can.interface"]
    lines = [f"{name} = {target}\n" for name, target in points.items()]
    (metadata / "entry_points.txt").write_text("".join(["[can.interface]\n", *lines]))
    return str(directory)


def end_by_ctrl_c(process):
    """Its output. python-can swallows a KeyboardInterrupt that hits it at the wrong moment, so it may take a second one."""
    for _ in range(10):
        process.send_signal(signal.SIGINT)
        try:
            return process.communicate(timeout=2)[0].decode()
        except subprocess.TimeoutExpired:
            continue
    process.kill()
    return process.communicate()[0].decode()


def test_can_logger_as_a_program(path, tmp_path):
    log = tmp_path / "frames.log"
    search = "" if entry_point_installed() else installed_metadata(tmp_path)
    with open_bus(path) as bus:
        process = subprocess.Popen(
            [sys.executable, "-m", "can.logger", "-i", NAME, "-c", path, "-f", str(log)],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": search},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        end = time.monotonic() + 20.0
        text = ""
        while "181#0102030405060708" not in text and time.monotonic() < end and process.poll() is None:
            bus.send(
                can.Message(arbitration_id=0x181, data=bytes([1, 2, 3, 4, 5, 6, 7, 8]), is_extended_id=False)
            )
            time.sleep(0.05)
            text = log.read_text() if log.exists() else ""
        output = end_by_ctrl_c(process)
        text = log.read_text() if log.exists() else ""
    assert "181#0102030405060708" in text, output
    assert path in text
