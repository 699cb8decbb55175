"""State of the controller, EMCY of the nodes, and jtqd's own EMCY with register, history and inhibit time."""

import random
import tracemalloc

import pytest

from jtqd.daemon.bus.own_node import OwnErrors
from jtqd.daemon.bus.service import ACTIVE, BUS_OFF, DOWN, PASSIVE, WARNING, BusChange, BusState, EmcyLog
from jtqd.daemon.shared.events import RateLimit
from jtqd.drivers.emcy import Emergency, describe, name_of, parse
from jtqd.drivers.object_dictionary import ObjectStore
from tests.drivers.canopen_nodes import EDS


def frame(text: str) -> bytes:
    return bytes.fromhex(text)


ERR = 0x2000_0000


@pytest.mark.parametrize(
    ("can_id", "data", "change", "counted"),
    [
        (ERR | 0x004, "00 08 000000000000", (ACTIVE, WARNING), {"warnings": 1}),  # CRTL, TX warning
        (ERR | 0x004, "00 04 000000000000", (ACTIVE, WARNING), {"warnings": 1}),  # CRTL, RX warning
        (
            ERR | 0x204,
            "00 20 00000000 80 03",
            (ACTIVE, PASSIVE),
            {"passives": 1, "tx_errors": 128, "rx_errors": 3},
        ),
        (ERR | 0x040, "00", (ACTIVE, BUS_OFF), {"bus_offs": 1}),
        (ERR | 0x020, "", None, {"no_acknowledge": 1}),
        (ERR | 0x002, "1a", None, {"arbitration_lost": 1}),
        (ERR | 0x088, "00 00 80 19", None, {"protocol_errors": 1}),
        (ERR | 0x004, "00 01", None, {"overruns": 1}),  # RX overflow
        (ERR | 0x001, "", None, {"tx_timeouts": 1}),
        (ERR | 0x010, "", None, {"transceiver": 1}),
        (ERR | 0x004, "", None, {}),
    ],
)
def test_error_messages(can_id: int, data: str, change: tuple | None, counted: dict[str, int]) -> None:
    bus = BusState()
    assert bus.error_frame(can_id, frame(data)) == (None if change is None else BusChange(*change))
    found = {name: value for name, value in bus.counts.items() if value and name != "state"}
    assert found == counted


def test_bus_off_ends_with_a_restart_or_with_the_first_frame_heard() -> None:
    bus = BusState()
    bus.error_frame(ERR | 0x040, b"")
    assert bus.error_frame(ERR | 0x040, b"") is None
    assert bus.error_frame(ERR | 0x100, b"") == BusChange(BUS_OFF, ACTIVE)
    bus.error_frame(ERR | 0x040, b"")
    assert bus.alive() == BusChange(BUS_OFF, ACTIVE)
    assert bus.alive() is None
    assert (bus.counts["bus_offs"], bus.counts["restarts"]) == (2, 1)


def test_the_way_to_error_passive_and_back() -> None:
    bus, states = BusState(), []
    for bits in (0x08, 0x20, 0x08, 0x40):
        bus.error_frame(ERR | 0x004, bytes([0, bits]))
        states.append(bus.state)
    assert states == [WARNING, PASSIVE, WARNING, ACTIVE]
    bus.error_frame(ERR | 0x004, bytes([0, 0x20]))
    assert bus.alive() is None, "an error passive controller hears all the same"


def test_down_and_up() -> None:
    bus = BusState()
    assert bus.down() == BusChange(ACTIVE, DOWN)
    assert bus.down() is None
    assert bus.alive() == BusChange(DOWN, ACTIVE)
    assert bus.counts["downs"] == 1


def test_random_error_frames_raise_nothing() -> None:
    rng, bus = random.Random(3), BusState()
    for _ in range(20_000):
        bus.error_frame(ERR | rng.getrandbits(29), rng.randbytes(rng.randrange(9)))
    assert 0 <= bus.state <= 4


def test_codes_have_names_and_groups() -> None:
    assert name_of(0x8130) == "life guard or heartbeat"
    assert name_of(0x2311) == "current, device output side"
    assert name_of(0x3F00) == "voltage"
    assert name_of(0xFFFF) == "device specific"
    assert name_of(0xA000) == "unknown group"
    assert describe(parse(frame("1023 03 0000000000"))) == (
        "EMCY 2310h (continuous overcurrent), register 03h (generic, current)"
    )


@pytest.mark.parametrize("length", range(9))
def test_a_short_message_is_read_as_far_as_it_goes(length: int) -> None:
    whole = frame("1023 03 0102030405")
    seen = EmcyLog([1])
    line = seen.receive(1, whole[:length], 0.0)
    assert line is not None
    assert seen.last(1) == Emergency(
        int.from_bytes(whole[: min(length, 2)], "little"),
        3 if length >= 3 else 0,
        whole[3:length].ljust(5, b"\0"),
        length,
    )
    assert (f"a frame of {length} bytes" in line) == (length < 8 and length >= 1) or "no error" in line


def test_a_storm_is_a_few_lines_and_bounded_memory() -> None:
    """5 kHz for 20 s of two nodes, codes at random; seed 7."""
    rng, seen, lines = random.Random(7), EmcyLog([1, 2]), []
    tracemalloc.start()
    for n in range(100_000):
        data = rng.randbytes(rng.randrange(9))
        line = seen.receive(1 + n % 2, data, n / 5000.0)
        if line is not None:
            lines.append(line)
        if n == 20_000:
            before = tracemalloc.get_traced_memory()[0] - sum(map(len, lines))
    grown = tracemalloc.get_traced_memory()[0] - sum(map(len, lines)) - before
    tracemalloc.stop()
    assert seen.count_of(1) == seen.count_of(2) == 50_000
    assert len(lines) <= 2 * 6 * 5
    assert grown < 20_000
    assert any("more before" in line for line in lines[-6:])
    assert seen.receive(99, b"", 0.0) is None, "not of the configuration"


def test_lines_are_limited_by_kind_and_together() -> None:
    limit = RateLimit(quiet_s=5.0, burst=3)
    assert [limit.admit(kind, 0.0) for kind in ("a", "a", "b", "c", "d")] == [0, None, 1, 0, None]
    assert limit.admit("a", 5.0) == 1
    assert limit.admit("a", 9.9) is None


@pytest.fixture
def errors() -> OwnErrors:
    store = ObjectStore(EDS / "jtqd.eds", 0x20)
    store.set_number(0x1015, 0, 100)  # 10 ms
    return OwnErrors(store)


def test_an_error_comes_and_goes_as_bytes(errors: OwnErrors) -> None:
    assert errors.report(0x8250, 0x181, joints=1)
    assert not errors.report(0x8250, 0x181, joints=1), "known already"
    #                              code  reg ended detail joints
    assert errors.tick(0.0) == frame("5082 11 0000 8101 01")
    assert errors.tick(0.0) is None
    assert errors.reset(0x8250, 0x181)
    assert errors.tick(0.02) == frame("0000 00 5082 8101 01")
    assert errors.tick(1.0) is None


def test_each_pdo_has_its_own_error_and_the_register_stays_until_the_last_has_gone(errors: OwnErrors) -> None:
    store = errors._store
    for cob_id in (0x181, 0x282):
        errors.report(0x8250, cob_id)
    reported = [errors.tick(0.0), errors.tick(0.005), errors.tick(0.02)]
    assert reported == [frame("5082 11 0000 8101 00"), None, frame("5082 11 0000 8202 00")], (
        "10 ms between two (1015h)"
    )
    errors.reset(0x8250, 0x181)
    assert errors.tick(0.04) == frame("0000 11 5082 8101 00"), "no error of 181h any more, but there is one"
    assert store.number(0x1001) == 0x11
    errors.reset(0x8250, 0x282)
    assert errors.tick(0.06) == frame("0000 00 5082 8202 00")
    assert store.number(0x1001) == 0


def test_history_1003h_newest_first_bounded_and_clearable(errors: OwnErrors) -> None:
    store = errors._store
    for detail in range(1, 11):
        errors.report(0x8130, detail)
        errors.reset(0x8130, detail)
    assert store.number(0x1003) == 8
    assert [store.number(0x1003, sub) for sub in (1, 2, 8)] == [0x000A_8130, 0x0009_8130, 0x0003_8130]
    store.write(0x1003, 0, b"\0")
    assert store.number(0x1003) == 0
    assert store.number(0x1003, 1) == 0
    assert errors.tick(0.0) is None, "an error that had ended before its message is not reported"


def test_what_flaps_within_the_inhibit_time_is_reported_once(errors: OwnErrors) -> None:
    errors.report(0x8130, 1)
    assert errors.tick(0.0) is not None
    for _ in range(50):
        errors.reset(0x8130, 1)
        errors.report(0x8130, 1)
    assert errors.tick(1.0) is None
    assert errors.present == [(0x8130, 1)]


def test_a_recovery_is_reported_once_and_is_no_lasting_error(errors: OwnErrors) -> None:
    errors.report_once(0x8140)
    assert errors._store.number(0x1001) == 0
    assert errors.tick(0.0) == frame("4081 01 0000 0000 00")
    assert errors.tick(1.0) is None
    assert errors._store.number(0x1003, 1) == 0x8140


def test_many_errors_wait_in_bounded_memory(errors: OwnErrors) -> None:
    for detail in range(5000):
        errors.report(0x8210, detail)
        errors.reset(0x8210, detail - 30)
    assert len(errors._queue) <= 64


def test_waiting_messages_are_bounded_although_all_errors_are_present(errors: OwnErrors) -> None:
    for detail in range(5000):
        errors.report(0x8210, detail)
    assert len(errors._queue) == 64
    assert len(errors.present) == 5000


def test_an_error_that_occurs_again_is_reported_when_the_inhibit_time_is_over(errors: OwnErrors) -> None:
    reported = []
    for n in range(2):
        errors.report(0x8130, 1)
        reported.append(errors.tick(0.5 * n))
        errors.reset(0x8130, 1)
        reported.append(errors.tick(0.5 * n + 0.25))
    assert [message is not None and message[:2].hex() for message in reported] == [
        "3081",
        "0000",
        "3081",
        "0000",
    ]
    errors.report(0x8130, 1)
    errors.report(0x8130, 2)
    assert errors.tick(2.0) is not None
    assert errors.tick(2.0 + 100 * 1e-4) is not None, "1015h is over"


def test_error_counters_stay_until_a_message_brings_others() -> None:
    bus = BusState()
    bus.error_frame(ERR | 0x204, bytes.fromhex("0020000000008003"))
    bus.error_frame(ERR | 0x080, bytes(8))  # a bus error alone: no counters, one protocol error
    assert (bus.counts["tx_errors"], bus.counts["rx_errors"], bus.counts["protocol_errors"]) == (128, 3, 1)


def test_another_register_is_another_message() -> None:
    seen = EmcyLog([1])
    assert seen.receive(1, bytes.fromhex("1023030000000000"), 0.0) is not None
    assert seen.receive(1, bytes.fromhex("1023010000000000"), 0.1) is not None
    assert seen.receive(1, bytes.fromhex("1023010000000000"), 0.2) is None
