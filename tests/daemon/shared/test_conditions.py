"""The set of conditions: few lines however much happens, the file, and the catalogue."""

import re
from itertools import pairwise

import pytest

from jtqd.daemon.shared.conditions import (
    CATALOGUE,
    Conditions,
    ConditionsFile,
    Subject,
    read_conditions,
    worst,
)
from jtqd.drivers import emcy
from tests.paths import ROOT

JOINT = Subject("joint 1", 1, 1)
PAGE = ROOT / "docs" / "deployment.md"
KNOWN_CODES = {
    value for name, value in vars(emcy).items() if name.isupper() and isinstance(value, int) and value > 0xFF
}
FIRST = ((1.125, "lost: asked at 1.125"), (1.625, "back after 0.5 s"))
STEP = 1.0 / 16.0  # exact in binary; two of them are longer than what counts as a flicker


def lines_of(*spans: tuple[float, float], until: float) -> list[tuple[float, str]]:
    """What is logged, and when, of something that is lost from .. to; the cause is the time it is asked for."""
    conditions, lines = Conditions(), []
    for n in range(round(until / STEP) + 1):
        now = n * STEP
        lost = any(start <= now < end for start, end in spans)
        # Only the text at the begin counts here.
        begun = conditions.is_present("stale_input", "joint 1")
        text = conditions.present()[0].text.removeprefix("inputs lost: ") if begun else f"asked at {now}"
        conditions.update("stale_input", JOINT, lost, now, text)
        lines += [(now, line.text) for line in conditions.lines(now)]
    return [(now, line.removeprefix("joint 1: inputs ")) for now, line in lines]


@pytest.mark.parametrize(
    ("spans", "expected"),
    [
        pytest.param([], [], id="nothing"),
        pytest.param(
            [(1.0, 3.25)], [(1.125, "lost: asked at 1.125"), (3.375, "back after 2.2 s")], id="one line each"
        ),
        pytest.param([(1.0 + 0.25 * n, 1.125 + 0.25 * n) for n in range(20)], [], id="flickers"),
        pytest.param(
            [(1.0, 2.0), (2.0625, 3.0)],
            [(1.125, "lost: asked at 1.125"), (3.125, "back after 2.0 s")],
            id="a flicker of the end",
        ),
        pytest.param(
            [(1.0, 1.5), (2.0, 2.5)],
            [*FIRST, (6.125, "back after 0.5 s (inputs lost: asked at 2.125)")],
            id="too soon for a line: with its end and cause",
        ),
        pytest.param(
            [(1.0, 1.5), (2.0, 9.0)],
            [*FIRST, (6.125, "lost: asked at 2.125"), (9.125, "back after 7.0 s")],
            id="too soon, and lasts: as soon as allowed",
        ),
        pytest.param(
            [(1.0, 1.5), (2.0, 2.5), (3.0, 3.5), (7.0, 7.5)],
            [
                *FIRST,
                (6.125, "back after 1.0 s, 2 times (inputs lost: asked at 3.125)"),
                (11.125, "back after 0.5 s (inputs lost: asked at 7.125)"),
            ],
            id="two losses are two and the next line waits for its time",
        ),
    ],
)
def test_lines_of_a_loss(spans: list[tuple[float, float]], expected: list[tuple[float, str]]) -> None:
    assert lines_of(*spans, until=20) == expected


def test_a_flapping_contact_is_two_lines_in_five_seconds_and_each_loss_is_counted() -> None:
    lines = lines_of(*((1.0 + 0.5 * n, 1.25 + 0.5 * n) for n in range(40)), until=30)
    assert lines[:2] == [(1.125, "lost: asked at 1.125"), (1.375, "back after 0.2 s")]
    assert all(later - earlier >= 5.0 for earlier, later in pairwise(at for at, _ in lines[::2]))
    assert len(lines) <= 2 * 5
    ends = [line for _, line in lines if line.startswith("back")]
    assert sum(int(line.split(", ")[1].split()[0]) if "times" in line else 1 for line in ends) == 40


def test_what_waits_for_the_operator_is_repeated_while_it_lasts():
    conditions, lines = Conditions(), []
    for second in range(200):
        conditions.update("fault_latched", JOINT, True, float(second), "position jump")
        conditions.update("stale_input", JOINT, True, float(second), "gone")
        lines += [(second, line.text) for line in conditions.lines(float(second))]
    latched = [at for at, text in lines if "latched" in text]
    assert latched == [0, 60, 120, 180]
    assert len([text for _, text in lines if "inputs lost" in text]) == 1


def test_a_latched_fault_has_a_rate_limit_of_its_own():
    """Else the lines of a cable that comes and goes would use it up, and the latched fault would stay untold."""
    conditions = Conditions()
    classes = {}
    for second in range(3):
        conditions.update("fault_latched", JOINT, True, float(second), "position jump")
        conditions.update("stale_input", JOINT, True, float(second), "gone")
        conditions.update("joint_fault", JOINT, True, float(second), "position jump")
        conditions.update("bus_passive", Subject("bus"), True, float(second), "error active")
        classes |= {line.definition.name: line.rate_class for line in conditions.lines(float(second))}
    assert classes["stale_input"] == JOINT.name
    assert classes["fault_latched"] not in {each for name, each in classes.items() if name != "fault_latched"}
    assert classes["bus_passive"] == ""


def test_the_catalogue_is_complete_and_consistent():
    for definition in CATALOGUE.values():
        if definition.emcy is not None:
            assert not definition.hold_s, "an EMCY is sent at once"
            assert definition.emcy.code in KNOWN_CODES
        assert definition.text.count("{}") <= 1
        assert definition.ended or not definition.logged or definition.name == "node_changed"


def test_a_condition_that_supersedes_another_has_the_only_line() -> None:
    conditions, bus = Conditions(), Subject("bus")

    def lines(name: str, now_s: float, previous: str = "", *, superseded: bool = False) -> list[str]:
        conditions.update(name, bus, bool(previous), now_s, previous, superseded=superseded)
        return [line.text for line in conditions.lines(now_s)]

    assert lines("bus_passive", 1.0, "error active") == ["bus: error passive, previously error active"]
    assert lines("bus_passive", 2.0, superseded=True) == []
    assert lines("bus_off", 2.0, "error passive") == ["bus: bus-off, previously error passive"]
    assert lines("bus_off", 3.5) == ["bus: error active after 1.5 s"]
    assert lines("bus_warning", 4.0, superseded=True) == [], "that was not present"
    assert lines("bus_down", 4.0, "error active", superseded=True) == [
        "bus: interface down, previously error active"
    ]
    assert lines("bus_down", 5.0) == ["bus: error active after 1.0 s"]


def test_history_counts_and_adds_up():
    conditions = Conditions()
    for begin, end in ((1.0, 2.0), (3.0, 3.5)):
        conditions.update("foreign_sync", JOINT, True, begin)
        conditions.update("foreign_sync", JOINT, False, end)
    conditions.update("foreign_sync", JOINT, True, 4.0)
    (found,) = conditions.history(4.25)
    assert found == ("foreign_sync", "joint 1", 3, 1.75, 1.0)


def test_listeners_hear_each_change_once_and_in_order():
    conditions, heard = Conditions(), []
    conditions.subscribe(lambda change: heard.append((change.definition.name, change.present)))
    for present in (False, True, True, False, False):
        conditions.update("pdo_timeout", JOINT, present, 0.0, "20")
    assert heard == [("pdo_timeout", True), ("pdo_timeout", False)]


def test_the_file_shows_what_is_present_the_worst_first(tmp_path):
    conditions, file = Conditions(), ConditionsFile(tmp_path)
    assert read_conditions(tmp_path) == []
    conditions.update("late_loop", JOINT, True, 1.0)
    conditions.update("joint_fault", JOINT, True, 2.0, "the motor position jumped (motor_jump)")
    file.write(conditions.present())
    found = read_conditions(tmp_path)
    assert found == conditions.present()
    assert [(each.name, each.since_ns) for each in found] == [
        ("joint_fault", 2_000_000_000),
        ("late_loop", 1_000_000_000),
    ]
    assert worst(found, "joint 1") == found[0]
    assert worst(found, "joint 2") is None
    (tmp_path / "conditions.json").write_text('{"schema": "jtqd.conditions/1", "conditions": [{}]}')
    assert read_conditions(tmp_path) == []


def test_every_condition_and_its_emcy_is_in_the_table_of_the_docs():
    rows = re.findall(r"^\| (`\w+`(?:, `\w+`)*) \| [^|]* \|([^|]*)\|$", PAGE.read_text(), re.MULTILINE)
    shown = {name: codes for names, codes in rows for name in re.findall(r"\w+", names)}
    assert set(CATALOGUE) <= set(shown)
    for each in CATALOGUE.values():
        assert each.emcy is None or f"{each.emcy.code:04X}h" in shown[each.name], each.name
