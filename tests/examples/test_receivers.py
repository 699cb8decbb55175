"""The example receivers decode what the daemon encodes, and use none that is withheld, old, repeated or of another cycle.

The headers in C and C++ are driven by transcripts; the program in C runs beside jtqd, whose estimates get lost on the way.
"""

import math
import os
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import can
import pytest
import yaml

from examples.receivers import receive_estimate
from jtqd.daemon.core import estimate_pdo
from jtqd.drivers.can_unix import UnixBus
from jtqd.drivers.hub import Hub
from jtqd.estimator import status
from tests.paths import ROOT
from tests.processes import family
from tests.shipped_bench import shipped_bench

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


def pushed(sequence, one=status.CONTACT_NONE, two=status.CONTACT_NONE, rate=640.0, push=2.9):
    """A contact PDO; a push of joint 1 along its positive direction is one of joint 2 against its own."""
    return estimate_pdo.encode_contact(
        estimate_pdo.contact_field(rate, push, one), estimate_pdo.contact_field(-rate, -push, two), sequence
    )


def test_contacts_that_the_daemon_encodes_are_decoded():
    assert receive_estimate.decode_contact(pushed(17, status.CONTACT_PRESENT, status.CONTACT_PRESENT)) == (
        (640.0, "positive"),
        (-640.0, "negative"),
        17,
    )
    data = pushed(1, status.CONTACT_OFF, status.CONTACT_UNKNOWN, rate=math.nan)
    assert receive_estimate.decode_contact(data)[:2] == ((None, "off"), (None, "unknown"))
    assert estimate_pdo.CODE_NAMES == receive_estimate.CONTACT
    with pytest.raises(struct.error):
        receive_estimate.decode_contact(FRAME)


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
                    touch = pushed(42, status.CONTACT_PRESENT)
                    sender.send(can.Message(arbitration_id=0x3A0, data=touch, is_extended_id=False))

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
    said = [line for line in lines if "contact" in line]
    assert said == [" 42  contact 1: positive at 640 Nm/s  2: none at -640 Nm/s"], "once, until it changes"
    assert [line for line in lines if "contact" not in line] == [
        " 42  1:     -7.75 Nm +-  0.20  valid        2:    no torque +-     ?  stale"
    ] * 2


def test_no_bus_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(can.interfaces.BACKENDS, "jtq_unix", ("jtqd.drivers.can_unix", "UnixBus"))
    assert receive_estimate.main(["--bus", f"unix:{tmp_path}/none"]) == 1
    assert capsys.readouterr().err.count("\n") == 1


COMPILERS = {
    "c": ("cc", ["-std=c99", "-Wpedantic", "-x", "c"]),
    "c++": ("c++", ["-std=c++17", "-Wpedantic", "-x", "c++"]),
}
STRICT = ["-Wall", "-Wextra", "-Werror", "-O2"]
RECEIVERS = ROOT / "examples" / "receivers"
MS = 1_000_000


@pytest.fixture(scope="module", params=list(COMPILERS))
def transcript(request, tmp_path_factory):
    """`transcript(*lines)`: what the header answers, line by line."""
    compiler, language = COMPILERS[request.param]
    if shutil.which(compiler) is None:
        pytest.skip(f"NOT TESTED: no {compiler}")
    program = tmp_path_factory.mktemp("transcript") / "program"
    source = ROOT / "tests" / "examples" / "estimate_transcript.c"
    subprocess.run([compiler, *STRICT, *language, f"-I{RECEIVERS}", "-o", program, source], check=True)

    def play(*lines):
        done = subprocess.run(
            [program], input="\n".join(lines), capture_output=True, check=True, text=True, timeout=10
        )
        return done.stdout.splitlines()

    return play


def take(cob_id, stamp_ms, data):
    return f"take {cob_id:x} {round(stamp_ms * MS)} {len(data)} {data.hex()}"


def valid(sequence, torque=1.0):
    return encoded((torque, 0.1, status.VALID), (torque, 0.1, status.VALID), sequence)


def test_the_header_decodes_what_the_daemon_encodes(transcript):
    for code, name in status.NAMES.items():
        lines = transcript(
            take(0x1A0, 1, encoded((-3.21, 0.11, code), (327.67, 20.0, status.STANDSTILL), 7)),
            take(0x2A0, 1, encoded((0.0, 0.0, 3), (-327.67, 12.7, 3), 7)),
            *(f"read {joint} {1 * MS}" for joint in (1, 2, 3, 4, 5)),
        )
        assert lines[:2] == ["1", "2"]
        if code in status.PUBLISHED:
            assert lines[2:-5] == [f"usable {name} -3.2100 0.1500 0"]
        else:
            assert lines[2:-5] == [f"none {name} nan inf 0", "  withheld"]
        assert lines[-5:] == [
            "usable standstill 327.6700 inf 0",
            "usable degraded 0.0000 0.0000 0",
            "usable degraded -327.6700 12.7000 0",
            "none off nan inf 0",
            "  never received",
        ]


def test_a_torque_beside_a_status_that_has_none_is_not_used(transcript):
    for code in set(range(16)) - set(status.PUBLISHED):
        data = bytearray(valid(1))
        data[6] = code | code << 4
        assert transcript(take(0x1A0, 1, bytes(data)), f"read 1 {MS}")[-1] == "  withheld"


def test_the_age_is_that_of_the_inputs_and_has_a_limit(transcript):
    lines = transcript(
        take(0x080, 10.0, bytes([41])),
        take(0x080, 11.0, bytes([42])),
        take(0x1A0, 11.8, valid(42)),
        f"read 1 {12 * MS}",
        take(0x080, 12.0, bytes([43])),
        f"read 1 {12 * MS + 1}",
        f"read 1 {16 * MS}",
        f"read 1 {16 * MS + 1}",
        f"read 1 {11 * MS + 799_999}",
    )
    assert lines[3] == "usable valid 1.0000 0.1000 1000000"
    assert lines[5] == "usable valid 1.0000 0.1000 1000001"
    assert lines[6].startswith("usable")
    assert lines[7:9] == ["none valid nan 0.1000 5000001", "  too old"]
    assert lines[10] == "  clock"


def test_an_estimate_of_another_cycle_is_not_used(transcript):
    """Its SYNC counter is two behind, though its PDO is young; across the end of the counter, too."""
    for first in (100, 238, 239, 240):
        sync = [first + step - (240 if first + step > 240 else 0) for step in range(3)]
        ahead = [take(0x080, step, bytes([value])) for step, value in enumerate(sync)]
        assert transcript(*ahead[:2], take(0x1A0, 2.0, valid(first)), f"read 1 {2 * MS}")[-1].startswith(
            "usable"
        )
        assert transcript(*ahead, take(0x1A0, 2.0, valid(first)), f"read 1 {2 * MS}")[-1] == "  behind SYNC"


def test_without_a_counter_in_sync_the_age_counts_from_arrival(transcript):
    lines = transcript(take(0x080, 1.0, b""), take(0x1A0, 1.8, valid(9)), f"read 1 {2 * MS}")
    assert lines[-1] == "usable valid 1.0000 0.1000 200000"


def test_a_repeated_pdo_is_no_new_estimate_but_its_bad_news_are_heard(transcript):
    again = [take(0x1A0, stamp, valid(5)) for stamp in (1, 4, 7)]
    assert transcript(*again, f"read 1 {7 * MS}", "counters")[-2:] == [
        "  too old",
        "received 1 lost 0 repeated 2 malformed 0",
    ]
    off = encoded((0.0, 0.0, status.OFF), (1.0, 0.1, status.VALID), 5)
    lines = transcript(take(0x1A0, 1, valid(5)), take(0x1A0, 2, off), f"read 1 {2 * MS}", f"read 2 {2 * MS}")
    assert lines[-3:-1] == ["none off nan inf 1000000", "  withheld"]
    assert lines[-1].startswith("usable")


def test_lost_and_malformed_pdos_are_counted(transcript):
    frames = [take(0x1A0, n, valid(counter)) for n, counter in enumerate((238, 239, 2, 3, 7))]
    frames += [
        take(0x1A0, 9, valid(8)[:7]),
        take(0x1A0, 9, valid(0)),
        take(0x1A0, 9, valid(241)),
        take(0x8000_01A0, 9, valid(8)),  # a 29-bit frame
        take(0x1A1, 9, valid(8)),
    ]
    # 240 and 1; then 4, 5 and 6
    assert transcript(*frames, "counters")[-6:] == ["0"] * 5 + ["received 5 lost 5 repeated 0 malformed 3"]


def test_the_header_tells_contacts(transcript):
    lines = transcript(
        f"touched 1 {MS}",
        take(0x080, 1.0, bytes([7])),
        take(0x3A0, 1.8, pushed(7, status.CONTACT_PRESENT, status.CONTACT_PRESENT)),
        take(0x4A0, 1.8, pushed(7, status.CONTACT_NONE, status.CONTACT_UNKNOWN, rate=-9e9)),
        *(f"touched {joint} {2 * MS}" for joint in (1, 2, 3, 4, 5)),
        "counters",
    )
    assert lines == [
        "unknown nan 0",
        *("0", "3", "4"),
        *("positive 640 1000000", "negative -640 1000000", "none -4064 1000000", "unknown 4064 1000000"),
        "unknown nan 0",
        "received 0 lost 0 repeated 0 malformed 0",
    ]


def test_no_contact_is_believed_of_a_young_pdo_of_the_last_two_syncs_only(transcript):
    none = take(0x3A0, 1.8, pushed(7))
    sync = [take(0x080, n, bytes([7 + n - 1])) for n in (1, 2, 3)]
    assert transcript(sync[0], none, sync[1], f"touched 1 {2 * MS}")[-1].startswith("none ")
    assert transcript(sync[0], none, *sync[1:], f"touched 1 {3 * MS}")[-1].startswith("unknown nan")
    assert transcript(none, f"touched 1 {7 * MS}")[-1] == "unknown nan 5200000", "too old"
    assert transcript(none, f"touched 1 {MS}")[-1].startswith("unknown nan"), "the clock was set back"
    later = bytearray(pushed(7))
    later[2] = 0x2F
    assert transcript(take(0x3A0, 1.8, bytes(later)), f"touched 1 {2 * MS}")[-1].startswith("unknown 640")


def test_a_repeated_contact_is_heard_and_malformed_ones_are_not(transcript):
    again = pushed(7, status.CONTACT_PRESENT)
    lines = transcript(take(0x3A0, 1.8, pushed(7)), take(0x3A0, 1.9, again), f"touched 1 {2 * MS}")
    assert lines[1:] == ["0", "positive 640 200000"]
    bad = [take(0x3A0, 1.8, each) for each in (again[:3], pushed(0), pushed(241), bytes(8))]
    assert transcript(*bad, f"touched 1 {2 * MS}", "counters")[4:] == [
        "unknown nan 0",
        "received 0 lost 0 repeated 0 malformed 4",
    ]


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    if shutil.which("cc") is None:
        pytest.skip("NOT TESTED: no cc")
    path = tmp_path_factory.mktemp("receiver") / "receive_estimate"
    source = RECEIVERS / "receive_estimate.c"
    subprocess.run(["cc", "-std=c99", "-Wpedantic", *STRICT, "-o", path, source], check=True)
    return path


def test_a_wrong_command_line_and_no_bus(program, tmp_path):
    for arguments in (
        [],
        ["--joint", "1"],
        ["vcan0", "--joint"],
        ["vcan0", "--joint", "5"],
        ["vcan0", "--max-age-ms", "x"],
        ["vcan0", "--on-contact", "run"],
    ):
        done = subprocess.run([program, *arguments], capture_output=True, text=True, check=False, timeout=10)
        assert done.returncode == 2
        assert done.stderr.startswith("usage:")
    for bus in ("none0", f"unix:{tmp_path}/none", "unix:" + "x" * 200):
        done = subprocess.run([program, bus], capture_output=True, text=True, check=False, timeout=10)
        assert done.returncode == 1
        assert done.stderr.count("\n") == 1


def until(lines, text, count=1):
    """Read lines of the receiver until `count` of them begin with `text`; return all that were read."""
    read = []
    for line in lines:
        read.append(line.rstrip())
        count -= line.startswith(text)
        if count == 0:
            return read
    raise AssertionError(f"no {text!r}: {read}")


INTERFACE = os.environ.get("JTQD_CAN_INTERFACE", "vcan0")


@pytest.mark.socketcan
def test_beside_jtqd_withheld_late_and_lost_estimates(program, tmp_path: Path) -> None:
    """Valid; the bench stops: withheld; it goes on: used again; jtqd stops in mid-motion: too old, then STOP for good."""
    environment = {**os.environ, "RUNTIME_DIRECTORY": str(tmp_path)}
    sides = []

    def start(*command: object) -> "subprocess.Popen[str]":
        side = subprocess.Popen(
            [*map(str, command)], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        sides.append(side)
        return side

    try:
        bench = start(sys.executable, "-m", "jtqd.sim_can", "--bus", INTERFACE)
        assert "ready" in bench.stderr.readline()
        receiver = start(program, INTERFACE, "--stop-after-ms", "500", "--joint", "2", "--seconds", "60")
        daemon = start(
            sys.executable,
            "-m",
            "jtqd.daemon.jtqd",
            "--bus",
            INTERFACE,
            "--record",
            "none",
            "--duration",
            "60",
            "--config",
            with_contacts(tmp_path),
        )
        first = until(receiver.stdout, "USE")
        assert first[0] == "HOLD  never received, status off"

        time.sleep(0.3)
        os.kill(bench.pid, signal.SIGSTOP)
        time.sleep(0.05)
        os.kill(bench.pid, signal.SIGCONT)
        assert until(receiver.stdout, "HOLD")[-1] == "HOLD  withheld, status stale"
        assert until(receiver.stdout, "USE")[-1].startswith("USE   ")

        time.sleep(0.3)
        for process in family(daemon.pid):
            os.kill(process, signal.SIGSTOP)  # nothing is said any more: as after a crash
        assert until(receiver.stdout, "STOP")[-1].startswith("STOP  too old, status ")
        out = receiver.stdout.read()  # not communicate(): a line may wait in the buffer of the lines before
        assert receiver.wait(30) == 3
        assert " repeated 0, malformed 0;" in out
        assert int(out.rpartition(" ")[2]) > 300, "contact PDOs, with section contact"
    finally:
        for side in sides:
            for process in reversed(family(side.pid)) if side.poll() is None else ():
                os.kill(process, signal.SIGKILL)
            side.communicate(timeout=30)


def with_contacts(directory: Path) -> Path:
    """Write the shipped configuration with section contact; return its path."""
    path = directory / "contact.yaml"
    path.write_text(yaml.safe_dump(shipped_bench() | {"contact": {"opposed": True}}))
    return path


def test_estimates_that_are_lost_on_the_way(program, tmp_path):
    """A sender drops estimates: one now and then costs nothing; so many that the age is too large are HOLD, not STOP."""
    path = str(tmp_path / "bus")
    hub, stop = Hub(path), threading.Event()

    def serve():
        while not stop.is_set():
            hub.run_once(0.01)

    thread = threading.Thread(target=serve)
    thread.start()
    receiver = None
    try:
        with UnixBus(path) as sender:
            receiver = subprocess.Popen(
                [program, f"unix:{path}", "--max-age-ms", "250", "--stop-after-ms", "20000"],
                stdout=subprocess.PIPE,
                text=True,
            )
            assert until(receiver.stdout, "HOLD") == ["HOLD  never received, status off"]

            def send(counters, lost=()):
                for counter in counters:
                    for cob_id, data in ((0x080, bytes([counter])), (0x1A0, valid(counter))):
                        if cob_id == 0x080 or counter not in lost:
                            sender.send(
                                can.Message(arbitration_id=cob_id, data=data, is_extended_id=False), timeout=1
                            )
                    time.sleep(0.002)

            send(range(1, 101), lost={10, 50, 51})
            assert until(receiver.stdout, "USE")[-1].startswith("USE   valid 1.00 Nm +- 0.10, age ")
            time.sleep(0.5)
            held = until(receiver.stdout, "HOLD  too old")
            send(range(101, 111))
            until(receiver.stdout, "USE", 1)
            receiver.terminate()
            rest = receiver.stdout.read()
            assert receiver.wait(10) == 0
    finally:
        if receiver is not None and receiver.poll() is None:
            receiver.kill()
            receiver.wait()
        stop.set()
        thread.join()
        hub.close()
    assert "STOP" not in rest + "".join(held)
    assert rest.splitlines()[-1].startswith("received 107, lost 3, repeated 0, malformed 0; usable in ")
    assert rest.endswith("; contact PDOs 0\n")


def test_the_program_stops_on_a_contact_and_uses_nothing_before_it_knows_of_none(program, tmp_path):
    path = str(tmp_path / "bus")
    hub, stop = Hub(path), threading.Event()

    def serve():
        while not stop.is_set():
            hub.run_once(0.01)

    thread = threading.Thread(target=serve)
    thread.start()
    receiver = None
    try:
        with UnixBus(path) as sender:
            receiver = subprocess.Popen(
                [
                    program,
                    f"unix:{path}",
                    "--on-contact",
                    "stop",
                    "--max-age-ms",
                    "2000",
                    "--stop-after-ms",
                    "9000",
                ],
                stdout=subprocess.PIPE,
                text=True,
            )
            assert until(receiver.stdout, "HOLD") == ["HOLD  never received, status off"]

            def send(counter, cob_id, data):
                for each, content in ((0x080, bytes([counter])), (cob_id, data)):
                    sender.send(
                        can.Message(arbitration_id=each, data=content, is_extended_id=False), timeout=1
                    )

            send(1, 0x1A0, valid(1))
            time.sleep(0.2)
            send(1, 0x3A0, pushed(1))
            assert until(receiver.stdout, "USE")[-1].startswith("USE   valid 1.00 Nm"), (
                "not while nobody knows"
            )
            send(2, 0x3A0, pushed(2, status.CONTACT_PRESENT))
            assert until(receiver.stdout, "STOP")[-1].startswith(
                "STOP  contact positive, torque rate 640 Nm/s, age "
            )
            assert receiver.wait(10) == 3
    finally:
        if receiver is not None and receiver.poll() is None:
            receiver.kill()
            receiver.wait()
        stop.set()
        thread.join()
        hub.close()
