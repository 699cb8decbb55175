"""Words of messages: number and noun agree."""

from __future__ import annotations

from jtqd.estimator.checked import counted


def test_one_thing_has_no_plural() -> None:
    assert [counted(n, "group") for n in (0, 1, 2)] == ["0 groups", "1 group", "2 groups"]
    assert counted(0, "velocity", "velocities") == "0 velocities"
