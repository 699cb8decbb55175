"""The fault cases of docs/testing.md: played on one running jtqd, and the list is whole."""

import ast
import os
from dataclasses import replace

import pytest

from tests.paths import ROOT
from tests.slow.faults.cases import CASES, ELSEWHERE, LEFT_OUT, NOT_COVERED, Case, with_library
from tests.slow.faults.injections import Fault
from tests.slow.faults.on_bus import line, play
from tests.slow.faults.rig import Watcher
from tests.slow.heard_bus import healthy, heard_of

SHORT = [case for case in CASES if not case.long]
LONG = [case for case in CASES if case.long]
ALIKE = {"9b", "14e", "16b", "16d", "16f", "25b", "25d"}
"""Of a fault of which another part is played in the gate: the same for longer, twice or at another node."""
GATE = [case for case in SHORT if case.key not in ALIKE]


REMOVED = [
    replace(case, fault=Fault) for case in SHORT if case.key in ("3", "14a", "19", "25b", "35", "38b", "16a")
]
"""Nothing is injected: most of these expect that nothing happens, so that only the proof can tell."""


def _play(cases: list, *, library: bool = False) -> list:
    bus = os.environ.get("JTQD_CAN_INTERFACE", "vcan0")
    outcomes = play(cases, bus, lambda outcome: print(line(outcome)), library=library)
    assert len(outcomes) == len(cases)
    return outcomes


@pytest.mark.socketcan
@pytest.mark.skipif(not os.environ.get("JTQD_BENCH_TIME_TRAVEL"), reason="needs exact time")
def test_a_short_case_of_each_fault_with_its_status_emcy_counter_and_times() -> None:
    assert {case.number for case in GATE} == {case.number for case in SHORT}
    assert [each.case.key for each in _play(GATE) if each.wrong] == []


@pytest.mark.socketcan
@pytest.mark.campaign
@pytest.mark.skipif(not os.environ.get("JTQD_BENCH_TIME_TRAVEL"), reason="needs exact time")
def test_the_other_cases() -> None:
    assert [
        each.case.key for each in _play([*LONG, *(each for each in SHORT if each not in GATE)]) if each.wrong
    ] == []


@pytest.mark.socketcan
@pytest.mark.campaign
@pytest.mark.skipif(not os.environ.get("JTQD_BENCH_TIME_TRAVEL"), reason="needs exact time")
def test_a_case_without_its_fault_is_found_out() -> None:
    for each in _play(REMOVED):
        assert any(text.startswith("not injected") for text in each.wrong), each.case.key


@pytest.mark.socketcan
@pytest.mark.skipif(not os.environ.get("JTQD_BENCH_TIME_TRAVEL"), reason="needs exact time")
def test_some_cases_with_nodes_that_share_no_code_with_ours() -> None:
    some = [case for case in with_library(CASES) if case.key in ("1", "16c", "21a", "23", "24b")]
    assert len(some) == 5
    assert [each.case.key for each in _play(some, library=True) if each.wrong] == []


@pytest.mark.socketcan
@pytest.mark.campaign
@pytest.mark.skipif(not os.environ.get("JTQD_BENCH_TIME_TRAVEL"), reason="needs exact time")
def test_every_case_with_nodes_that_share_no_code_with_ours() -> None:
    assert [each.case.key for each in _play(with_library(CASES), library=True) if each.wrong] == []


def test_what_is_left_out_with_those_nodes_is_a_case() -> None:
    assert {case.key for case in CASES} - {case.key for case in with_library(CASES)} == set(LEFT_OUT)


def test_the_list_is_whole() -> None:
    """Each of the 45 cases is played here, shown by a test that exists, or said not to be covered."""
    played = {case.number for case in CASES}
    named = {each.number for each in ELSEWHERE}
    assert played | named | set(NOT_COVERED) == set(range(1, 46))
    assert not set(NOT_COVERED) & (played | named)
    assert len({case.key for case in CASES}) == len(CASES)


def test_every_case_proves_that_it_took_place() -> None:
    assert [case.key for case in CASES if case.proof is None and case.during is None] == []


HEALTHY = heard_of(healthy(1500))


@pytest.mark.parametrize(
    "case", [case for case in CASES if case.proof is not None], ids=lambda case: case.key
)
def test_no_case_is_proved_by_a_bus_on_which_nothing_happens(case: Case) -> None:
    assert case.proof is not None
    assert not case.proof(HEALTHY).ok
    assert not case.proof(heard_of([])).ok


@pytest.mark.parametrize("where", sorted({each for row in ELSEWHERE for each in row.tests}))
def test_what_the_list_refers_to_is_there(where: str) -> None:
    path, _, name = where.partition("::")
    functions = {
        each.name
        for each in ast.walk(ast.parse((ROOT / path).read_text()))
        if isinstance(each, ast.FunctionDef)
    }
    assert name in functions


def _estimate(torque: int, status: int, sequence: int) -> bytes:
    return torque.to_bytes(2, "little", signed=True) * 2 + b"\x01\x01" + bytes([status * 0x11, sequence])


@pytest.mark.parametrize(
    ("data", "delivered", "word"),
    [
        (_estimate(100, 2, 6), (True, True), "sequence"),
        (_estimate(100, 4, 7), (True, True), "torque"),
        (_estimate(100, 2, 7), (True, False), "withheld"),
        (_estimate(100, 2, 7)[:7], (True, True), "7 bytes"),
    ],
)
def test_the_watcher_sees_each_breach(data: bytes, delivered: tuple[bool, bool], word: str) -> None:
    watcher = Watcher()
    watcher.sync(7)
    watcher.delivered((True, True))
    watcher.estimate(_estimate(100, 2, 7), 1)
    assert watcher.broken == []
    watcher.sync(7)
    watcher.delivered(delivered)
    watcher.estimate(data, 2)
    assert any(word in each for each in watcher.broken), watcher.broken


def test_the_watcher_sees_two_estimates_for_one_sync() -> None:
    watcher = Watcher()
    watcher.sync(7)
    watcher.delivered((True, True))
    watcher.estimate(_estimate(100, 2, 7), 1)
    watcher.estimate(_estimate(100, 2, 7), 2)
    assert watcher.broken == ["two estimates for SYNC 7"]
