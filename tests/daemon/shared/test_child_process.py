"""Waiting for child processes: what they said is read, and nobody spins on one that has closed its output."""

import time

import pytest

from jtqd.daemon.shared.processes import Child, ChildError, ChildSilence


def child(statement: str) -> Child:
    """A process that runs one Python statement; `timeit` is a module that does that."""
    return Child("timeit", ["-n", "1", "-r", "1", statement], name="the child")


def test_last_words_of_a_child_that_has_ended() -> None:
    one = child("print('{}', flush=True); import os; os._exit(3)")
    one.process.wait(30)
    assert one.answer(30.0) == {}
    with pytest.raises(ChildError, match="the child ended with exit status 3"):
        one.answer(30.0)


def test_silence_is_not_the_end() -> None:
    one = child("import time; time.sleep(60)")
    with pytest.raises(ChildSilence, match=r"the child did not answer within 0\.1 s"):
        one.answer(0.1)
    assert one.alive()
    assert len(one.outputs) == 1
    one.end()


def test_a_closed_output_is_not_spun_on() -> None:
    one = child("import os, time; os.close(1); time.sleep(1); os._exit(0)")
    used, begun = time.process_time(), time.monotonic()
    with pytest.raises(ChildError, match="the child ended with exit status 0"):
        one.answer(30.0)
    assert one.outputs == []
    assert time.monotonic() - begun > 0.9
    assert time.process_time() - used < 0.1  # spinning, it would be all of the second
