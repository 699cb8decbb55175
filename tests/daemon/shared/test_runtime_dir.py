"""The directory of shared memory: one holder at a time, gone when its holder is done with it."""

import fcntl
import os
import threading
from pathlib import Path

import pytest

from jtqd.daemon.shared.runtime_dir import claim, instance_name, remove, write_whole


@pytest.fixture(autouse=True)
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("RUNTIME_DIRECTORY", f"{tmp_path}:/somewhere/else")
    return tmp_path


def test_a_claimed_directory_is_private_and_refused_to_others_by_name(root):
    directory, held = claim("vcan0")
    assert directory == root / f"jtqd-{os.getuid()}-vcan0"
    assert directory.stat().st_mode & 0o777 == 0o750
    with pytest.raises(BlockingIOError, match=f"process {os.getpid()} is already running there"):
        claim("vcan0")
    other, also_held = claim("vcan1")
    assert other != directory
    os.close(held)
    assert claim("vcan0")[0] == directory, "its end gives it free"
    os.close(also_held)


def test_removed_with_all_its_files(root):
    directory, held = claim("vcan0")
    (directory / "ring").write_bytes(b"x")
    remove(directory)
    assert list(root.iterdir()) == []
    os.close(held)


def test_a_refused_claim_leaves_the_holders_files(root):
    directory, held = claim("vcan0")
    (directory / "ring").write_bytes(b"x")
    with pytest.raises(BlockingIOError):
        claim("vcan0")
    assert (directory / "ring").exists()
    os.close(held)


def test_a_directory_that_is_removed_while_another_process_opens_it_is_made_again(root, monkeypatch):
    """Lock of a file that has no name any more: two processes would each believe to be alone."""
    directory, held = claim("vcan0")
    real_open = os.open

    def open_then_lose(path, *arguments, **options):
        descriptor = real_open(path, *arguments, **options)
        if str(path).endswith("/lock"):
            monkeypatch.setattr(os, "open", real_open)
            remove(directory)
            os.close(held)
        return descriptor

    monkeypatch.setattr(os, "open", open_then_lose)
    again, mine = claim("vcan0")
    assert again == directory
    with pytest.raises(BlockingIOError):
        claim("vcan0")
    os.close(mine)


def test_many_that_claim_and_remove_at_once_never_hold_it_together(root):
    inside, worst, done, failed = [], [], [], []

    def work():
        for _ in range(200):
            try:
                directory, held = claim("vcan0")
            except BlockingIOError:
                continue
            inside.append(1)
            worst.append(len(inside))
            inside.pop()
            remove(directory)
            os.close(held)
            done.append(1)

    def guarded():
        try:
            work()
        except Exception as error:
            failed.append(error)

    threads = [threading.Thread(target=guarded) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    assert max(worst) == 1
    assert len(done) >= 4


def test_a_place_where_nothing_can_be_made_is_reported(monkeypatch):
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/proc/nowhere")
    with pytest.raises(FileNotFoundError, match="/proc/nowhere"):
        claim("vcan0")


def test_names_are_fit_for_files_and_do_not_collide():
    assert instance_name("vcan0") == "vcan0"
    assert instance_name("unix:/tmp/a") != instance_name("unix:/tmp-a")
    assert "/" not in instance_name("unix:/tmp/a")


def test_what_a_killed_daemon_left_is_taken_away_by_the_next_one(root):
    """Of whatever bus; what a running daemon holds, and what is not ours, stays."""
    left, held = claim("unix:/tmp/bench")
    (left / "ring").write_bytes(b"x")
    os.close(held)  # as the kernel does when a process is killed
    running, also_held = claim("vcan1")
    other = root / f"jtqd-{os.getuid()}-something"
    other.mkdir()
    (other / "file").touch()
    directory, third = claim("vcan2")
    assert not left.exists()
    assert {each.name for each in root.iterdir()} == {running.name, directory.name, other.name}
    os.close(also_held)
    os.close(third)


def test_who_comes_while_left_overs_are_taken_away_waits_a_moment(root):
    """The lock is held by a process that only sweeps; the name in it is that of one that is gone."""
    directory = root / f"jtqd-{os.getuid()}-vcan0"
    directory.mkdir()
    lock = directory / "lock"
    lock.write_text("999999999\n")
    descriptor = os.open(lock, os.O_RDWR)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    timer = threading.Timer(0.1, os.close, [descriptor])
    timer.start()
    found, held = claim("vcan0")
    timer.join()
    assert found == directory
    os.close(held)


def test_a_file_is_replaced_at_once_and_nothing_is_left(tmp_path: Path) -> None:
    path = tmp_path / "out" / "metrics.prom"
    path.parent.mkdir()
    write_whole(path, "old\n")
    with open(path) as reader:
        write_whole(path, "new\n", 0o644)
        assert reader.read() == "old\n", "who has it open keeps the old one whole"
    assert (path.read_text(), path.stat().st_mode & 0o777) == ("new\n", 0o644)
    assert list(path.parent.iterdir()) == [path]
    with pytest.raises(OSError, match="No such file"):
        write_whole(tmp_path / "gone" / "metrics.prom", "new\n")
