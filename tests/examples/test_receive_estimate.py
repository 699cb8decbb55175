"""The example receivers decode what the daemon encodes: in Python over the unix bus, in C from frames."""

import math
import shutil
import struct
import subprocess
import threading

import can
import pytest

from examples import receive_estimate
from jtqd.daemon.core import estimate_pdo
from jtqd.drivers.can_unix import UnixBus
from jtqd.drivers.frame import pack
from jtqd.drivers.hub import Hub
from jtqd.estimator import status
from tests.paths import ROOT

# -7.75 Nm, sigma 0.2 Nm, valid; joint 2 stale; SYNC counter 42
FRAME = bytes.fromhex("f9fc 0080 04 ff 42 2a")


def encoded(one, two, sequence):
    return estimate_pdo.encode(estimate_pdo.field(*one), estimate_pdo.field(*two), sequence)


def test_a_frame_by_hand():
    one, two, sequence = receive_estimate.decode(FRAME)
    assert one == (pytest.approx(-7.75), pytest.approx(0.2), "valid")
    assert two == (None, None, "stale")
    assert sequence == 42


def test_what_the_daemon_encodes_is_decoded():
    for code, name in status.NAMES.items():
        one, two, sequence = receive_estimate.decode(encoded((3.21, 0.11, code), (-9.0, math.inf, 2), 240))
        published = code in status.PUBLISHED
        assert one == (
            pytest.approx(3.21) if published else None,
            pytest.approx(0.15) if published else None,
            name,
        )
        assert two == (None, None, "invalid")
        assert sequence == 240
    with pytest.raises(struct.error):
        receive_estimate.decode(FRAME[:7])


def test_it_prints_what_comes_over_a_unix_bus(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(can.interfaces.BACKENDS, "jtq_unix", ("jtqd.drivers.can_unix", "UnixBus"))
    path = str(tmp_path / "bus")
    hub, stop = Hub(path), threading.Event()

    def serve():
        while not stop.is_set():
            hub.run_once(0.01)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        with UnixBus(path) as sender:
            ended = threading.Event()

            def send():
                while not ended.wait(0.01):
                    sender.send(can.Message(arbitration_id=0x1A1, data=FRAME, is_extended_id=False))
                    sender.send(can.Message(arbitration_id=0x1A0, data=FRAME, is_extended_id=False))

            worker = threading.Thread(target=send)
            worker.start()
            try:
                assert (
                    receive_estimate.main(["--bus", f"unix:{path}", "--count", "2", "--timeout", "20"]) == 0
                )
            finally:
                ended.set()
                worker.join()
    finally:
        stop.set()
        thread.join()
        hub.close()
    lines = capsys.readouterr().out.splitlines()
    assert lines == [" 42  1:     -7.75 Nm +-  0.20  valid        2:    no torque +-     ?  stale"] * 2


def test_no_bus_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(can.interfaces.BACKENDS, "jtq_unix", ("jtqd.drivers.can_unix", "UnixBus"))
    assert receive_estimate.main(["--bus", f"unix:{tmp_path}/none"]) == 1
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_receiver_in_c(tmp_path):
    program = tmp_path / "receive_estimate"
    source = ROOT / "examples" / "receive_estimate.c"
    subprocess.run(["cc", "-Wall", "-Wextra", "-Werror", "-O2", "-o", program, source], check=True)
    frames = [pack(0x1A0, FRAME), pack(0x1A1, FRAME), pack(0x1A0, encoded((1.5, 20.0, 6), (0.0, 0.0, 3), 1))]
    done = subprocess.run([program, "-"], input=b"".join(frames), capture_output=True, check=True)
    assert done.stdout.decode().splitlines() == [
        " 42  1: -7.75 Nm +- 0.20, valid  2: no torque, stale",
        "  1  1: 1.50 Nm +- ?, standstill  2: 0.00 Nm +- 0.00, degraded",
    ]
    assert subprocess.run([program, "none0"], capture_output=True, check=False).returncode == 2
