"""The final summary: why there was no torque, stolen time, real time that was not kept, what became of the log."""

from __future__ import annotations

from typing import Any

import pytest

from jtqd.daemon.supervisor.display import Summary
from tests.daemon.supervisor.watch_views import view

US = (1.0, 2.0, 3.0)


def lines(begin: str, counters: dict[str, int] | None = None, **fields: Any) -> list[str]:
    """Lines of the summary's text that begin so."""
    cycle = (counters or {}).get("cycles", 9)
    made = Summary(view(cycle, **{"cycles": cycle} | (counters or {})), US, US, **fields)
    return [line for line in made.text().splitlines() if line.startswith(begin)]


@pytest.mark.parametrize(
    ("counters", "expected"),
    [
        ({}, []),
        ({"sync_gaps": 1, "boot_ups": 1}, []),
        (
            {"fault_motor_jump": 2, "latches": 1, "overruns": 3},
            ["no torque     overruns 3, motor jump 2, latches 1"],
        ),
    ],
)
def test_why_there_was_no_torque(counters: dict[str, int], expected: list[str]) -> None:
    assert lines("no torque", counters) == expected


@pytest.mark.parametrize(
    ("stolen_s", "expected"), [(0.0, []), (0.318, ["processors    0.32 s stolen by the hypervisor"])]
)
def test_stolen_time_where_there_was_any(stolen_s: float, expected: list[str]) -> None:
    assert lines("processors", stolen_s=stolen_s) == expected
    assert Summary(view(1), US, US, stolen_s=stolen_s).content()["stolen_s"] == round(stolen_s, 2)


@pytest.mark.parametrize(
    ("cycles", "missed", "refused", "expected"),
    [
        (0, 0, (), ""),
        (950, 50, (), ""),
        (900, 100, (), "not kept: 10 % of the slots missed; jtq doctor looks at the machine"),
        (4054, 15936, ("SCHED_FIFO",), "not kept: 80 % of the slots missed (jtqd was not granted all that"),
    ],
)
def test_real_time_that_was_not_kept(
    cycles: int, missed: int, refused: tuple[str, ...], expected: str
) -> None:
    found = lines("real time", {"cycles": cycles, "missed": missed}, refused=refused)
    assert [line.removeprefix("real time     ")[: len(expected)] for line in found] == [expected] * bool(
        expected
    )


@pytest.mark.parametrize(
    ("recording", "line", "status"),
    [
        (None, "none", 0),
        ({"path": "a.mcap", "paths": ["a.mcap"]}, "a.mcap", 0),
        ({"path": "b.mcap", "paths": ["a", "b"], "lost": 1}, "b.mcap (the last of 2 parts), 1 cycle lost", 3),
        ({"path": None, "flight_recordings": 0}, "none: no trigger", 0),
        ({"path": None, "error": "disk full", "lost": 7}, "none: disk full, 7 cycles lost", 3),
    ],
)
def test_what_became_of_the_log(recording: dict[str, Any] | None, line: str, status: int) -> None:
    assert lines("log ", recording=recording) == [f"log           {line}"]
    assert Summary(view(1), US, US, recording=recording).exit_status == status
