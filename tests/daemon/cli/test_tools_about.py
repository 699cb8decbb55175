"""What a daemon says of itself, how it is found, and who may look."""

import json
import os
import shutil
import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import pytest

from jtqd.daemon.cli.reading import Watch, find_daemons, on_bus
from jtqd.daemon.config import load_config
from jtqd.daemon.shared.notices import Notices
from jtqd.daemon.shared.runtime_dir import AboutError, read_about, start_ticks, write_about
from jtqd.daemon.supervisor.description import about
from tests.daemon.cli.status_daemon import described, running


def test_the_description_comes_back_as_it_was_written(tmp_path: Path) -> None:
    content = described("vcan0", tmp_path)
    write_about(tmp_path, content)
    assert read_about(tmp_path / "about.json") == content
    assert (tmp_path / "about.json").stat().st_mode & 0o777 == 0o640
    assert content.running()
    assert content.joints[0].inputs == ("181h drive 1 TPDO1", "281h drive 1 TPDO2")
    assert content.joints[1].sensor == "183h sensor 3 channel 1"
    assert content.nodes == {1: "drive of joint 1", 2: "drive of joint 2", 3: "torque sensor"}


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"schema": "jtqd.about/9"}', '{"schema": "jtqd.about/1", "joints": 1}']
)
def test_other_descriptions_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "about.json").write_text(text)
    with pytest.raises(AboutError):
        read_about(tmp_path / "about.json")
    with pytest.raises(AboutError):
        read_about(tmp_path / "none")


def test_the_start_of_a_process_tells_it_from_another_with_its_number() -> None:
    ticks = start_ticks(os.getpid())
    assert ticks is not None
    process = subprocess.Popen(["sleep", "5"])
    later = start_ticks(process.pid)
    assert later is not None
    assert later >= ticks
    process.kill()
    time.sleep(0.1)
    assert start_ticks(process.pid) is None, "a zombie runs no more"
    process.wait()


def test_a_bus_is_found_by_its_name_or_its_instance(tmp_path: Path) -> None:
    directory = tmp_path / "jtqd-0-sim"
    directory.mkdir()
    write_about(
        directory, about(load_config(None), bus="unix:/run/x/bus", instance="sim", log_directory=None)
    )
    found = find_daemons([tmp_path, tmp_path / "none"])
    assert on_bus(found, "sim") == on_bus(found, "unix:/run/x/bus") == found.daemons[0]
    assert on_bus(found, "can0") is None
    content = json.loads((directory / "about.json").read_text())
    for change in (
        {"started_ticks": content["started_ticks"] + 1},
        {"pid": 2**22 + 1},
    ):  # another process has its number
        (directory / "about.json").write_text(json.dumps(content | change))
        found = find_daemons([tmp_path])
        assert (found.daemons, found.closed, found.left_over) == ((), (), (directory,))


@pytest.mark.skipif(os.geteuid() != 0, reason="becomes another user, which only root can")
@pytest.mark.parametrize(
    ("groups", "seen"), [([0], (1, 0, True)), ([], (0, 1, False))], ids=["member", "stranger"]
)
def test_the_group_may_look_and_nobody_else(
    groups: list[int], seen: tuple[int, int, bool], tmp_path: Path
) -> None:
    """In the directory that jtqd claims itself, as a user who is, or is not, in the group of the daemon (root's)."""
    root = Path(tempfile.mkdtemp(dir="/dev/shm"))
    try:
        root.chmod(0o755)
        daemon = running(root)
        daemon.directory.chmod(0o750)  # as tests/daemon/shared/test_runtime_dir.py holds it
        Notices(daemon.directory / "notices")
        readable, writable = os.pipe()
        child = os.fork()
        if not child:
            try:
                os.setgroups(groups)
                os.setgid(65534)
                os.setuid(65534)
                found = find_daemons([root])
                looked = [Watch(each).read().state == "running" for each in found.daemons]
                with suppress(OSError):
                    os.open(daemon.directory / "snapshot", os.O_RDWR)
                    looked = [False]
                os.write(
                    writable, json.dumps([len(found.daemons), len(found.closed), looked == [True]]).encode()
                )
            finally:
                os._exit(0)
        os.close(writable)
        with os.fdopen(readable) as file:
            assert tuple(json.load(file)) == seen
        os.waitpid(child, 0)
    finally:
        shutil.rmtree(root)
