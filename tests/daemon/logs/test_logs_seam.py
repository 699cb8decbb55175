"""After a crash of the recorder a chunk may be in two parts of a run: whoever reads both gets every message once."""

import json
import shutil

import numpy as np
import pytest
from numpy.lib.recfunctions import repack_fields

from jtqd.daemon.logs.can_frames import iter_frames
from jtqd.daemon.logs.errors import LogError
from jtqd.daemon.logs.export_command import main as export
from jtqd.daemon.logs.reader import iter_messages, read_topic
from jtqd.daemon.replay.command import main as replay
from jtqd.daemon.replay.session import Wishes
from jtqd.daemon.replay.session import replay as replayed
from tests.daemon.recording.recorder_bench import record_of as cycle_record
from tests.daemon.recording.recorder_bench import session_on
from tests.daemon.replay.replay_helpers import cut, cycles
from tests.paths import GOLDEN

LOG = GOLDEN / "fused.mcap"
NAME = "jtqd-can0-20261121T173111Z-{:04d}.mcap"
TOPICS = ("/joint/1/state", "/joint/2/state", "/can/frames", "/diagnostics", "/events")


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """A run in three parts: 100 cycles are in the first two, one is in the last two; what has no cycle is in all."""
    directory = tmp_path_factory.mktemp("parts")
    first = cycles(LOG)[0]
    for n, (begin, end) in enumerate(((0, 700), (600, 1001), (1000, 1 << 30)), start=1):
        cut(LOG, directory / NAME.format(n), lambda c, b=begin, e=end: b <= c - first < e)
    return directory


@pytest.mark.parametrize("topic", TOPICS)
def test_every_message_comes_once(parts, topic):
    whole = packed(read_topic(LOG, topic))
    assert packed(read_topic(parts, topic)) == whole
    pieces = [each.records for each in iter_messages(parts, topic)]
    assert b"".join(map(packed, pieces)) == whole


def packed(records):
    if records.dtype.hasobject:  # texts of changing length: their times
        records = records["header"]["stamp"]
    return repack_fields(records, recurse=True).tobytes()


def test_frames_and_tables(parts, tmp_path):
    frames = [sum(len(each.ids) for each in iter_frames(path, "/can/frames")) for path in (LOG, parts)]
    assert frames[0] == frames[1] > 1000
    tables = []
    for path in (LOG, parts):
        out = tmp_path / f"{path.name}.csv"
        assert export(["csv", str(path), "--out", str(out), "--all-cycles"]) == 0
        tables.append(out.read_bytes())
    assert tables[0] == tables[1]


def test_what_only_looks_alike_is_kept(parts, tmp_path):
    """Another byte in a message of the same cycle and time: nobody knows which one is right."""
    shutil.copytree(parts, tmp_path, dirs_exist_ok=True)
    cycle = cycles(LOG)[0] + 650
    second = tmp_path / NAME.format(2)

    def spoil(topic, at, data):
        return data[:-9] + bytes((data[-9] ^ 1,)) + data[-8:] if at == cycle and "/1/" in topic else data

    cut(parts / NAME.format(2), second, payload=spoil)
    found = read_topic(tmp_path, "/joint/1/state")["cycle"]
    assert len(found) == len(read_topic(LOG, "/joint/1/state")) + 1
    assert np.count_nonzero(found == cycle) == 2
    with pytest.raises(LogError, match="given twice"):
        replayed([tmp_path], Wishes())


def test_replay_of_a_directory(parts, capsys):
    assert replay([str(parts), "--exact", "--json"]) == 0
    (run,) = json.loads(capsys.readouterr().out)["runs"]
    assert (len(run["logs"]), run["cycles"], run["lost_cycles"]) == (3, len(cycles(LOG)), 0)
    assert replay([str(LOG), "--exact", "--json"]) == 0
    (alone,) = json.loads(capsys.readouterr().out)["runs"]
    assert run["identity"] == alone["identity"]
    assert run["joints"] == alone["joints"]


def test_a_recorder_that_did_not_report_its_last_chunks(tmp_path):
    """By the recorder's own code: what was written and not settled is written again, in other chunks."""
    for part, numbers in ((1, range(2600)), (2, range(1300, 4000))):
        directory = tmp_path / str(part)
        directory.mkdir()
        session = session_on(directory, run="20250102T030405Z")
        for n in numbers:
            session.recording.add(cycle_record(n))
        session.finish()
        (written,) = (directory / "logs").glob("*.mcap")
        (tmp_path / "both").mkdir(exist_ok=True)
        written.rename(tmp_path / "both" / f"test-20250102T030405Z-{part:04d}.mcap")
    assert read_topic(tmp_path / "both", "/joint/2/state")["cycle"].tolist() == list(range(4000))
