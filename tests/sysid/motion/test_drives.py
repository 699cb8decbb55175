"""Drives from the commanding side: controlwords, set-up and release by SDO, with emulated and with wrong devices."""

import pytest

from jtqd.drivers.boot_node import BootError
from jtqd.drivers.drive import DriveProfile, State, state_of
from jtqd.drivers.sdo import NO_OBJECT, NO_SUBINDEX, SdoAbort
from jtqd.drivers.sensor import SensorProfile
from jtqd.sim_can import devices as cia402
from jtqd.sysid.motion.drives import (
    CST,
    CSV,
    DISABLE_VOLTAGE,
    POWERED,
    QUICK_STOP_WORD,
    enabling_word,
    sensor_units,
)
from tests.sysid.motion.lock_step import BenchAccess, LockStep


@pytest.fixture
def lock():
    return LockStep()


def test_states_of_all_statuswords():
    assert [*map(state_of, cia402.STATUSWORDS), State.UNKNOWN] == list(State)
    for word in range(0x10000):
        state = state_of(word)
        assert state is state_of(word & 0x6F), "other bits do not change the state"
        if word & 0x6F == 0x27:
            assert state is State.OPERATION_ENABLED


@pytest.mark.parametrize("number", [cia402.SWITCH_ON_DISABLED, cia402.READY, cia402.SWITCHED_ON])
def test_controlwords_lead_a_drive_to_operation_enabled(number):
    machine = cia402.StateMachine()
    machine.state = number
    words = []
    while state_of(machine.statusword) is not State.OPERATION_ENABLED:
        word = enabling_word(state_of(machine.statusword))
        assert word is not None
        words.append(word)
        machine.controlword(word)
    assert words == [0x06, 0x07, 0x0F][number - cia402.SWITCH_ON_DISABLED :]
    machine.controlword(QUICK_STOP_WORD)
    assert state_of(machine.statusword) is State.QUICK_STOP
    machine.controlword(DISABLE_VOLTAGE)
    assert state_of(machine.statusword) is State.SWITCH_ON_DISABLED


def test_no_controlword_leads_out_of_a_fault_and_an_unknown_state_counts_as_powered():
    stuck = (State.FAULT, State.FAULT_REACTION, State.QUICK_STOP, State.NOT_READY, State.UNKNOWN)
    assert [enabling_word(state) for state in stuck] == [None] * 5
    assert state_of(0x7FFF) is State.UNKNOWN
    assert State.UNKNOWN in POWERED
    assert not {State.FAULT, State.SWITCH_ON_DISABLED, State.READY} & POWERED


class Bent:
    """An access whose answers to some objects are replaced: a number (4 bytes) or an abort code as SdoAbort."""

    def __init__(self, access: BenchAccess, answers: dict[tuple[int, int], int | SdoAbort]) -> None:
        self.access, self.answers = access, answers

    def read(self, index: int, subindex: int) -> bytes:
        answer = self.answers.get((index, subindex))
        if isinstance(answer, SdoAbort):
            raise answer
        return self.access.read(index, subindex) if answer is None else answer.to_bytes(4, "little")

    def write(self, index: int, subindex: int, data: bytes) -> None:
        answer = self.answers.get((index, subindex))
        if isinstance(answer, SdoAbort):
            raise answer
        self.access.write(index, subindex, data)


def configure(
    lock: LockStep, answers: dict[tuple[int, int], int | SdoAbort], *, temperature: bool = True
) -> None:
    lock.drive(Bent(lock.access(1), answers), DriveProfile(1)).set_up(CSV, 300, temperature=temperature)


def test_a_drive_is_configured_and_its_units_read(lock):
    access = lock.access(2)
    access.write(0x6071, 0, b"\x10\x00")
    access.write(0x60FF, 0, b"\x10\x00\x00\x00")
    units = lock.drive(access, DriveProfile(2)).set_up(CST, 300, temperature=True)
    store = lock.bench.drives[1].store
    assert (store.number(0x6071), store.number(0x60FF)) == (0, 0), "targets of zero before the mode"
    assert store.number(0x1016, 2) == 0x0021_012C, "node 21h, 300 ms"
    assert (store.number(0x60C2, 1), store.number(0x60C2, 2)) == (2, -3)
    assert store.number(0x1802, 1) == 0x4000_0382, "TPDO3 is on, although jtqd's boot had switched it off"
    assert lock.bench.drives[1]._mode == CST
    assert (units.node, units.mode, units.gear_ratio, units.heartbeat_ms) == (2, CST, 100.0, 100)
    assert units.current_units(1.0) == 125, "1/1000 of 8 A"
    assert units.current_units(-9.0) == -1125
    assert units.velocity_units(1.0) == 1043038, "100 turns of 65536 counts in 2 pi seconds"


def test_the_units_of_the_sensor(lock):
    units = sensor_units(lock.access(3), SensorProfile(3))
    assert (units.node, units.heartbeat_ms) == (3, 100)
    assert units.nm_per_unit == pytest.approx((0.001,))


@pytest.mark.parametrize(
    ("answers", "line"),
    [
        ({(0x1000, 0): 0x194}, "node 1: 1000h:0 device type: expected profile 402"),
        ({(0x6076, 0): 0}, "node 1: 6076h:0 motor rated torque in mNm: expected 1.., found 0"),
        ({(0x6075, 0): 0}, "node 1: 6075h:0 motor rated current in mA: expected 1..1000000, found 0"),
        ({(0x1017, 0): 0}, "node 1: 1017h:0 producer heartbeat time in ms: expected 1.., found 0"),
        ({(0x1400, 1): 0x8000_0201}, "node 1: 1400h:1 COB-ID of RPDO: expected 201h, found 0x80000201"),
        ({(0x1600, 2): 0x60FF_0020}, "node 1: 1600h:1 mapping of RPDO: expected 60400010 60710010, found 60400010 60FF0020"),
        ({(0x1601, 0): 0}, "node 1: 1601h:1 mapping of RPDO: expected 60FF0020, found nothing"),
        ({(0x6061, 0): 8}, "node 1: 6061h:0 mode of operation display: expected 9, found 8"),
        ({(0x6060, 0): SdoAbort(0x0609_0030)}, "node 1: 6060h:0: write of 0x09 refused: value out of range (06090030h)"),
        ({(0x60C2, 1): 1}, "node 1: 60C2h:1 interpolation time period value read back: expected 0x02, found 0x01"),
        ({(0x1802, 1): SdoAbort(NO_OBJECT)}, "node 1: no TPDO3 with a temperature of 16 bits (1A02h:1): "),
        ({(0x1A02, 0): 0}, "node 1: no TPDO3 with a temperature of 16 bits (1A02h:1): "),
        ({(0x1A02, 1): 0x3001_0020}, "node 1: no TPDO3 with a temperature of 16 bits (1A02h:1): "),
        ({(0x1802, 1): 0x4000_0384}, "node 1: 1802h:1 COB-ID of TPDO3: expected 381h, found 0x40000384"),
        ({(0x1016, 2): SdoAbort(NO_SUBINDEX)}, "node 1: 1016h:2: write of 0x0021012C refused: sub-index does not exist"),
    ],
)  # fmt: skip
def test_a_drive_that_cannot_be_used_is_refused_in_one_line(lock, answers, line):
    with pytest.raises(BootError) as refused:
        configure(lock, answers)
    assert str(refused.value).startswith(line)
    assert "\n" not in str(refused.value)


def test_a_drive_without_temperature_may_be_used_when_none_is_limited(lock):
    configure(lock, {(0x1802, 1): SdoAbort(NO_OBJECT)}, temperature=False)


def test_a_fault_is_reset_and_returned(lock):
    machine = lock.bench.drives[0].machine
    drive = lock.drive(lock.access(1), DriveProfile(1))
    assert drive.reset_fault() is None
    machine.fault()
    lock.bench.drives[0]._error_code = 0x2310
    assert drive.reset_fault() == "fault 2310h"
    assert machine.state == cia402.SWITCH_ON_DISABLED


def test_a_fault_that_stays_is_refused(lock):
    lock.bench.drives[0].machine.fault()
    with pytest.raises(BootError, match=r"node 1: fault 2310h cannot be reset: fault \(statusword 0218h\)"):
        lock.drive(
            Bent(lock.access(1), {(0x6041, 0): 0x0218, (0x603F, 0): 0x2310}), DriveProfile(1)
        ).reset_fault()


def test_a_drive_that_runs_is_braked_before_its_power_goes(lock):
    """Enabled at 1 rad/s: quick stop first, and it stands when the power is off."""
    access = lock.access(1)
    drive = lock.drive(access, DriveProfile(1))
    drive.set_up(CSV, 300, temperature=False)
    access.write(0x60FF, 0, (1043038).to_bytes(4, "little"))
    for word in (6, 7, 15):
        access.write(0x6040, 0, word.to_bytes(2, "little"))
    for _ in range(300):
        lock.now += 1_000_000
        lock.to_bench(0x080, b"\x01")
    assert lock.velocities[0] == pytest.approx(1.0, abs=0.1)
    words = []
    write = access.write
    access.write = lambda i, s, d: (words.append(d) if i == 0x6040 else None, write(i, s, d))[1]  # type: ignore[method-assign,func-returns-value]
    drive.switch_off()
    assert words == [b"\x02\x00", b"\x00\x00"]
    assert lock.states[0] == cia402.SWITCH_ON_DISABLED
    assert abs(lock.velocities[0]) < 0.02
    drive.quick_stop()
    assert len(words) == 2, "a drive that is off is not commanded"


def test_a_drive_that_stays_powered_is_refused(lock):
    with pytest.raises(
        BootError, match=r"node 1: 6041h:0: expected disabled, found operation enabled \(statusword 1237h\)"
    ):
        lock.drive(Bent(lock.access(1), {(0x6041, 0): 0x1237}), DriveProfile(1)).switch_off()


def test_after_the_motion_the_watch_ends_and_the_targets_are_zero(lock):
    access = lock.access(2)
    drive = lock.drive(access, DriveProfile(2))
    drive.set_up(CST, 300, temperature=False)
    lock.to_bench(0x721, b"\x05")
    access.write(0x6071, 0, b"\x10\x00")
    drive.release()
    store = lock.bench.drives[1].store
    assert (store.number(0x1016, 2), store.number(0x6071), store.number(0x60FF)) == (0, 0, 0)
    lock.sleep(1.0)
    assert lock.bench.drives[1].machine.state == cia402.SWITCH_ON_DISABLED, "no fault by a missing heartbeat"
