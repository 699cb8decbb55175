"""Results of checks: exit status, report; numbers for people."""

import json

import pytest

from jtqd.daemon.cli.checks import (
    FAIL,
    GOOD,
    SKIP,
    WARN,
    CheckResult,
    report,
    worst,
)
from jtqd.estimator.text import duration, number, percent, size

NAN = float("nan")


def test_the_result_is_the_worst_level() -> None:
    items = {level: CheckResult("x", level, "") for level in (GOOD, WARN, FAIL, SKIP)}
    assert worst([items[GOOD], items[SKIP]]) == GOOD
    assert worst([items[GOOD], items[WARN]]) == WARN
    assert worst([items[WARN], items[FAIL]]) == FAIL


def test_the_report_is_a_table_or_json(capsys: pytest.CaptureFixture[str]) -> None:
    results = [
        CheckResult("one", GOOD, "fine"),
        CheckResult("two", WARN, "first", "do this"),
        CheckResult("three", WARN, "second", "do this"),
    ]
    assert report(results, None) == 3
    lines = capsys.readouterr().out.splitlines()
    assert [line.split() for line in lines[:3]] == [
        ["GOOD", "one", "fine"],
        ["WARN", "two", "first"],
        ["WARN", "three", "second"],
    ]
    assert lines[3].strip() == "> do this", "one hint for both"
    assert lines[4] == "WARN: 1 good, 2 warnings, 0 failures"
    assert report(results[:1], "jtq.x/1", bus="can0") == 0
    assert json.loads(capsys.readouterr().out) == {
        "schema": "jtq.x/1",
        "result": "GOOD",
        "bus": "can0",
        "items": [{"item": "one", "level": "GOOD", "text": "fine", "hint": ""}],
    }


def test_numbers_for_people() -> None:
    assert [duration(each) for each in (0.0451, 2.34, 59.94, 59.96, 751.2, 11_100.0, 187_300.0, NAN)] == [
        *("45 ms", "2.3 s", "59.9 s", "1 min 00 s", "12 min 31 s", "3 h 05 min", "2 d 04 h", "-"),
    ]
    assert [size(each) for each in (0, 999, 1000, 123_456, 1_230_000_000, None)] == [
        *("0 B", "999 B", "1 kB", "123 kB", "1.23 GB", "-"),
    ]
    assert (number(-1.005), number(NAN), percent(0.8476), percent(NAN)) == ("-1.00", "-", "84.8 %", "-")
