"""Deadlines and lengths of PDOs: 8250h, 8210h, 8220h."""

from jtqd.daemon.shared.conditions import Subject
from jtqd.daemon.shared.snapshot import InputView
from jtqd.daemon.supervisor.health import LENGTH_S, TIMEOUT_CYCLES, PdoChange, PdoWatch

PDO = Subject("181h drive 1 TPDO1", 0x181, 1, node=1)
SENSOR = Subject("183h sensor 3 channel 1", 0x183, node=3)
SEEN = InputView(*(0,) * 12)


def test_8250h_per_pdo_comes_after_the_deadline_and_goes_with_the_next_valid_one() -> None:
    watch = PdoWatch([PDO, SENSOR])

    def events(missed: int, row: int) -> list[PdoChange]:
        seen = SEEN._replace(missed=missed, in_a_row=row)
        return watch.changes([seen, SEEN], (), 0.0)

    assert events(19, 19) == []
    assert events(25, 25) == [PdoChange(0x8250, PDO, True)]
    assert events(200, 200) == []
    assert events(200, 0) == [PdoChange(0x8250, PDO, False)]
    assert events(200 + TIMEOUT_CYCLES, 0) == [PdoChange(0x8250, PDO, True), PdoChange(0x8250, PDO, False)], (
        "a loss that was over before anybody looked is told too"
    )


def test_8250h_of_a_loss_that_two_readings_share() -> None:
    watch = PdoWatch([PDO])
    watch.changes([SEEN], (), 0.0)
    assert watch.changes([SEEN._replace(missed=15, in_a_row=15)], (), 0.05) == []
    both = [PdoChange(0x8250, PDO, True), PdoChange(0x8250, PDO, False)]
    assert watch.changes([SEEN._replace(missed=15 + TIMEOUT_CYCLES - 15, in_a_row=0)], (), 0.1) == both
    assert watch.changes([SEEN._replace(missed=TIMEOUT_CYCLES, in_a_row=0)], (), 0.15) == []
    assert watch.changes([SEEN._replace(missed=TIMEOUT_CYCLES + 5, in_a_row=0)], (), 0.2) == [], (
        "another loss"
    )


def test_8250h_of_a_loss_that_is_over_while_a_short_one_goes_on() -> None:
    watch = PdoWatch([PDO])
    watch.changes([SEEN], (), 0.0)
    both = [PdoChange(0x8250, PDO, True), PdoChange(0x8250, PDO, False)]
    assert watch.changes([SEEN._replace(missed=TIMEOUT_CYCLES + 3, in_a_row=3)], (), 0.05) == both
    assert watch.changes([SEEN._replace(missed=TIMEOUT_CYCLES + 19, in_a_row=19)], (), 0.1) == [], "not yet"


def test_a_pdo_of_an_absent_optional_node_is_not_missed() -> None:
    watch = PdoWatch([PDO, SENSOR])
    gone = SEEN._replace(missed=500, in_a_row=500)
    assert watch.changes([SEEN, gone], {3}, 0.0) == []
    assert watch.changes([SEEN, gone], (), 0.0) == [PdoChange(0x8250, SENSOR, True)]


def test_8210h_and_8220h_last_as_long_as_wrong_lengths_come() -> None:
    watch = PdoWatch([PDO])
    watch.changes([SEEN], (), 0.0)
    short, both = SEEN._replace(short=1), SEEN._replace(short=1, long=3)
    assert watch.changes([short], (), 1.0) == [PdoChange(0x8210, PDO, True)]
    assert watch.changes([both], (), 1.5) == [PdoChange(0x8220, PDO, True)]
    assert watch.changes([both], (), 1.0 + LENGTH_S) == [PdoChange(0x8210, PDO, False)]
    assert watch.changes([both], (), 1.5 + LENGTH_S) == [PdoChange(0x8220, PDO, False)]
