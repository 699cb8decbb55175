"""Deadlines and lengths of PDOs: 8250h, 8210h, 8220h."""

from jtqd.daemon.loop.input_pdos import LENGTH_S, TIMEOUT_CYCLES, PdoEvent, PdoWatch, WatchedPdo
from jtqd.daemon.shared.snapshot import InputView

PDO = WatchedPdo(0x181, 1, "181h drive 1 TPDO1", 1)
SENSOR = WatchedPdo(0x183, 3, "183h sensor 3 channel 1", 0)
SEEN = InputView(*(0,) * 12)


def test_8250h_per_pdo_comes_after_the_deadline_and_goes_with_the_next_valid_one() -> None:
    watch = PdoWatch([PDO, SENSOR])

    def events(missed: int, row: int) -> list[PdoEvent]:
        seen = SEEN._replace(missed=missed, in_a_row=row)
        return watch.events([seen, SEEN], (), 0.0)

    assert events(19, 19) == []
    assert events(25, 25) == [PdoEvent(0x8250, PDO, True)]
    assert events(200, 200) == []
    assert events(200, 0) == [PdoEvent(0x8250, PDO, False)]
    assert events(200 + TIMEOUT_CYCLES, 0) == [PdoEvent(0x8250, PDO, True), PdoEvent(0x8250, PDO, False)], (
        "a loss that was over before anybody looked is told too"
    )


def test_8250h_of_a_loss_that_two_readings_share() -> None:
    watch = PdoWatch([PDO])
    watch.events([SEEN], (), 0.0)
    assert watch.events([SEEN._replace(missed=15, in_a_row=15)], (), 0.05) == []
    both = [PdoEvent(0x8250, PDO, True), PdoEvent(0x8250, PDO, False)]
    assert watch.events([SEEN._replace(missed=15 + TIMEOUT_CYCLES - 15, in_a_row=0)], (), 0.1) == both
    assert watch.events([SEEN._replace(missed=TIMEOUT_CYCLES, in_a_row=0)], (), 0.15) == []
    assert watch.events([SEEN._replace(missed=TIMEOUT_CYCLES + 5, in_a_row=0)], (), 0.2) == [], "another loss"


def test_8250h_of_a_loss_that_is_over_while_a_short_one_goes_on() -> None:
    watch = PdoWatch([PDO])
    watch.events([SEEN], (), 0.0)
    both = [PdoEvent(0x8250, PDO, True), PdoEvent(0x8250, PDO, False)]
    assert watch.events([SEEN._replace(missed=TIMEOUT_CYCLES + 3, in_a_row=3)], (), 0.05) == both
    assert watch.events([SEEN._replace(missed=TIMEOUT_CYCLES + 19, in_a_row=19)], (), 0.1) == [], "not yet"


def test_a_pdo_of_an_absent_optional_node_is_not_missed() -> None:
    watch = PdoWatch([PDO, SENSOR])
    gone = SEEN._replace(missed=500, in_a_row=500)
    assert watch.events([SEEN, gone], {3}, 0.0) == []
    assert watch.events([SEEN, gone], (), 0.0) == [PdoEvent(0x8250, SENSOR, True)]


def test_8210h_and_8220h_last_as_long_as_wrong_lengths_come() -> None:
    watch = PdoWatch([PDO])
    watch.events([SEEN], (), 0.0)
    short, both = SEEN._replace(short=1), SEEN._replace(short=1, long=3)
    assert watch.events([short], (), 1.0) == [PdoEvent(0x8210, PDO, True)]
    assert watch.events([both], (), 1.5) == [PdoEvent(0x8220, PDO, True)]
    assert watch.events([both], (), 1.0 + LENGTH_S) == [PdoEvent(0x8210, PDO, False)]
    assert watch.events([both], (), 1.5 + LENGTH_S) == [PdoEvent(0x8220, PDO, False)]
