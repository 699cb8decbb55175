"""The recorder process as it is: what is in the file; what it does when stopped, killed, or out of disk."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader

from jtqd.daemon.recording.recorder import RecorderRequest, RequestError
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.cycle_record import COUNT_WORD
from tests.daemon.recording.recorder_bench import (
    DEFINITIONS,
    ROOT,
    START_NS,
    RecorderProcess,
    joint_values,
    messages_of,
    put,
    record_of,
)

pytestmark = pytest.mark.native

EVENT = DEFINITIONS["jtqd_msgs/msg/Event"].constants


@pytest.fixture
def recorder(tmp_path):
    """Starts recorders and leaves none behind."""
    started = []

    def start(wait_for_file=True, **arguments):
        started.append(RecorderProcess(tmp_path, **arguments))
        started[-1].wait_until_ready()
        if wait_for_file:
            started[-1].wait_for_file()
        return started[-1]

    yield start
    for process in started:
        process.kill()


def events(found, kind):
    return [event for _, event in found["/events"] if event["kind"] == EVENT[kind]]


def test_round_trip(recorder):
    """Every field of 1234 cycles comes back under its name and its time."""
    process = recorder()
    for n in range(1234):
        put(process.ring, record_of(n))
    status, summary, errors = process.end()
    assert (status, errors) == (0, "")
    path = process.files()[0]
    assert [path] == process.files("test-2*Z-0001.mcap")
    expected = {"path": str(path), "cycles": 1234, "written": 1234, "lost": 0, "bytes": path.stat().st_size}
    assert expected.items() <= summary.items()
    found = messages_of(path)
    for number in (1, 2):
        topic = found[f"/joint/{number}/state"]
        assert len(topic) == 1234
        for n, (time_ns, message) in enumerate(topic):
            assert time_ns == START_NS + n * 1_000_000
            assert message["cycle"] == n
            assert tuple(message[name] for name in cr.JointRecord._fields) == joint_values(n, number)
    for n, (_, message) in enumerate(found["/can/frames"]):
        assert (message["cycle"], message["frame_count"], message["work_ns"]) == (n, 2, 50_000)
        assert [frame["id"] for frame in message["frames"]] == [0x080, 0x181] + [0] * 14
        assert message["frames"][1]["data"] == list(range(8))
        assert message["stamps_ns"][:2] == [START_NS + n * 1_000_000 + 1, START_NS + n * 1_000_000 + 2]
    assert len(found["/can/frames"]) == 1234
    overview = [time_ns for time_ns, _ in found["/joint_states"]]
    assert overview == [START_NS + n * 1_000_000 for n in range(0, 1234, 20)], "not 50 Hz"
    kinds = [event["kind"] for _, event in found["/events"]]
    assert kinds == [EVENT["RECORDER_STARTED"], EVENT["RECORDER_STOPPED"]]
    assert [message["level"] for _, message in found["/log"]] == [20, 20]


def test_file_as_a_whole(recorder, tmp_path):
    """Attachments before all, chunks of half a second, statistics and metadata that agree with the content."""
    (tmp_path / "joint1.yaml").write_bytes(b"name: elbow\n")
    attachments = [
        {"name": "provenance.json", "media_type": "application/json", "text": '{"a": 1}'},
        {"name": "joint1.yaml", "media_type": "application/yaml", "path": str(tmp_path / "joint1.yaml")},
        {"name": "gone.eds", "path": str(tmp_path / "gone.eds")},
    ]
    process = recorder(attachments=attachments, gear_ratios=[50.0, None])
    for n in range(3000):
        put(process.ring, record_of(n))
    status, summary, errors = process.end()
    assert status == 0
    assert errors == f"recorder: attachment gone.eds: No such file or directory: {tmp_path}/gone.eds\n"
    with open(summary["path"], "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        kept = {item.name: (item.media_type, item.data) for item in reader.iter_attachments()}
        whole = reader.get_summary()
    assert kept == {
        "provenance.json": ("application/json", b'{"a": 1}'),
        "joint1.yaml": ("application/yaml", b"name: elbow\n"),
    }
    chunks = whole.chunk_indexes
    assert max(item.offset for item in whole.attachment_indexes) < chunks[0].chunk_start_offset
    joint_1 = {channel.topic: number for number, channel in whole.channels.items()}["/joint/1/state"]
    own = [chunk for chunk in chunks if joint_1 in chunk.message_index_offsets]
    assert all(list(chunk.message_index_offsets) == [joint_1] for chunk in own), "chunks of one topic"
    spans = [(chunk.message_end_time - chunk.message_start_time) * 1e-9 for chunk in own]
    assert len(chunks) == 4 * len(own) == 24  # joint 1, joint 2, frames, the rest
    assert spans[:-1] == [pytest.approx(0.5, abs=2e-3)] * 5
    assert {chunk.compression for chunk in chunks} == {"zstd"}
    numbers = whole.statistics.channel_message_counts
    counts = {whole.channels[number].topic: n for number, n in numbers.items()}
    assert (counts["/joint/1/state"], counts["/joint/2/state"], counts["/can/frames"]) == (3000, 3000, 3000)
    assert whole.statistics.message_count == sum(counts.values())
    assert {channel.message_encoding for channel in whole.channels.values()} == {"cdr"}
    velocity = messages_of(summary["path"])["/joint_states"][0][1]["velocity"]
    assert velocity[0] == pytest.approx(joint_values(0, 1)[2] / 50.0)


@pytest.mark.measures
def test_stopped_recorder_loses_and_counts(recorder):
    """SIGSTOP for longer than the ring: what is missing in the file is in the account and the events."""
    process = recorder(slots=256)
    process.paced(0, 300, 2000)
    process.process.send_signal(signal.SIGSTOP)
    process.paced(300, 1000, 4000)
    process.process.send_signal(signal.SIGCONT)
    process.paced(1300, 400, 2000)
    status, summary, _ = process.end()
    assert status == 3
    assert summary["written"] + summary["lost"] == summary["cycles"] == process.ring.words[COUNT_WORD] == 1700
    assert 700 <= summary["lost"] <= 1000
    found = messages_of(summary["path"])
    cycles = [message["cycle"] for _, message in found["/joint/1/state"]]
    assert cycles == sorted(set(cycles))
    assert len(cycles) == summary["written"]
    assert cycles[-1] == 1699
    assert sum(event["count"] for event in events(found, "RECORDS_LOST")) == summary["lost"]


def test_recorder_that_comes_late_counts_what_it_never_saw(recorder):
    process = recorder(slots=256, prepare=lambda ring: [put(ring, record_of(n)) for n in range(1000)])
    status, summary, _ = process.end()
    assert status == 3
    assert (summary["cycles"], summary["written"], summary["lost"]) == (1000, 255, 745)


def test_ends_with_its_parent(tmp_path):
    """The parent is killed: the recorder reads on to the end of the loop and ends its file."""
    process = RecorderProcess(tmp_path)  # makes ring and request; this one is not the subject
    process.wait_for_file()
    process.end()
    shutil.rmtree(process.output)
    code = f"import subprocess, time; subprocess.Popen({process.process.args!r}); time.sleep(60)"
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT)
    process.wait_for_file()
    for n in range(100):
        put(process.ring, record_of(n))
    parent.kill()
    parent.wait()
    for n in range(100, 200):
        put(process.ring, record_of(n))
    process.wait_for(lambda: process.files("*.mcap"))
    assert len(messages_of(process.files("*.mcap")[0])["/joint/1/state"]) == 200


def test_interrupt_from_the_terminal_does_not_end_it(recorder):
    process = recorder()
    process.process.send_signal(signal.SIGINT)
    process.paced(0, 300, 1000)
    assert process.process.poll() is None
    _, summary, _ = process.end()
    assert summary["written"] == 300


def test_loop_that_ends_after_the_order(recorder):
    """SIGTERM reaches everybody at once: the loop's last cycles are still recorded."""
    process = recorder()
    process.paced(0, 200, 1000)
    process.process.terminate()
    process.paced(200, 300, 1000)
    status, summary, _ = process.result()
    assert (status, summary["written"]) == (0, 500)


def test_limit_on_the_length_of_a_file(recorder):
    """A file that must not grow any more is as good as a full disk; another one may: the parts hold all of it."""
    limit = 100_000

    def small_files():
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    process = recorder(before=small_files, chunk_s=0.1)
    for n in range(3000):
        put(process.ring, record_of(n))
    status, summary, errors = process.end()
    assert (summary["written"], summary["lost"]) == (3000, 0)
    assert errors.count("recording fails: File too large") >= 1
    assert len(summary["paths"]) > 1
    assert all(Path(path).stat().st_size <= limit for path in summary["paths"])
    # Those for whose summary there was no room keep their name; the repair at the next start gives them one.
    assert status == (3 if any(path.endswith(".active") for path in summary["paths"]) else 0)


def test_directory_that_cannot_be_made(recorder, tmp_path):
    (tmp_path / "file").write_text("")
    process = recorder(output=tmp_path / "file" / "logs", wait_for_file=False)
    process.paced(0, 100, 1000)
    status, summary, errors = process.end()
    assert status == 3
    assert errors == (
        f"recorder: cannot record to {tmp_path}/file/logs: Not a directory; "
        "cycles are counted as lost until it continues\n"
    )
    assert (summary["path"], summary["cycles"], summary["written"], summary["lost"]) == (None, 100, 0, 100)


def test_reader_of_the_summary_has_gone(recorder):
    process = recorder()
    process.process.stdout.close()
    process.paced(0, 50, 1000)
    process.process.terminate()
    errors = process.process.stderr.read()
    assert (process.process.wait(10), errors) == (0, "")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "cannot be read as JSON"),
        ("[]", "expected a mapping"),
        ('{"directory": "/tmp"}', "key 'ring'"),
        ('{"ring": "a", "directory": "b", "chunks": 1}', "unknown key 'chunks'"),
        ('{"ring": "a", "directory": "b", "chunk_s": 0}', "chunk_s"),
        ('{"ring": "a", "directory": "b", "chunk_s": "x"}', "TypeError"),
        ('{"ring": "a", "directory": "b", "prefix": "../x"}', "prefix"),
        ('{"ring": "a", "directory": "b", "run": "today"}', "run"),
        ('{"ring": "a", "directory": "b", "budget_mb": -1}', "budget_mb"),
        ('{"ring": "a", "directory": "b", "flight_recorder_s": "x"}', "TypeError"),
        ('{"ring": "a", "directory": "b", "gear_ratios": [1]}', "gear_ratios"),
        ('{"ring": "a", "directory": "b", "gear_ratios": [1, 0]}', "gear_ratios"),
        ('{"ring": "a", "directory": "b", "attachments": [{"name": "x"}]}', "attachment"),
    ],
)
def test_wrong_request(tmp_path, content, said):
    path = tmp_path / "request.json"
    path.write_text(content)
    with pytest.raises(RequestError, match=r"request\.json") as caught:
        RecorderRequest.from_file(path)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_exit_status_of_wrong_use(tmp_path):
    def run(*arguments):
        command = [sys.executable, "-m", "jtqd.daemon.recording.recorder", *arguments]
        result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert result.stderr.count("\n") == 1
        assert result.stdout == ""
        return result.returncode

    path = tmp_path / "request.json"
    path.write_text(json.dumps({"ring": str(tmp_path / "none"), "directory": str(tmp_path), "wait_s": 0.1}))
    assert run() == 2
    assert run(str(tmp_path / "missing.json")) == 2
    assert run(str(path)) == 1


def test_stays_small(recorder):
    """No library is loaded, of the estimator what a log keeps and what opens files; 3 s of recording fit into 25 MB."""
    unwanted = {"numpy", "onnxruntime", "canopen", "can", "yaml", "msgspec", "jtqd.drivers.drive"}
    code = (
        f"import sys, jtqd.daemon.recording.recorder; print(*{unwanted!r} & set(sys.modules), "
        "*sorted(each for each in sys.modules if each.startswith('jtqd.estimator.')))"
    )
    found = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert found.stdout.split() == [
        f"jtqd.estimator.{name}" for name in ("errors", "files", "status", "text")
    ]
    process = recorder()
    process.paced(0, 3000, 2000)
    status = Path(f"/proc/{process.process.pid}/status").read_text()
    assert int(status.split("VmHWM:")[1].split()[0]) < 25_000  # kB
    assert os.getpriority(os.PRIO_PROCESS, process.process.pid) == min(
        19, os.getpriority(os.PRIO_PROCESS, 0) + 5
    )
    assert process.end()[0] == 0
