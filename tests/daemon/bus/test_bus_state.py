"""State of the CAN controller from error messages (linux/can/error.h)."""

import random

import pytest

from jtqd.daemon.bus.errors import ACTIVE, BUS_OFF, DOWN, PASSIVE, WARNING, BusChange, BusState


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
