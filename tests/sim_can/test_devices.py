"""Drives: CiA 402 against the standard's tables, written out a second time; targets, quick stop, faults, heartbeat."""

import math

import pytest

from jtqd.sim_can.devices import (
    FAULT,
    FAULT_REACTION,
    NOT_READY,
    OPERATION_ENABLED,
    QUICK_STOP,
    READY,
    STATUSWORDS,
    SWITCH_ON_DISABLED,
    SWITCHED_ON,
    StateMachine,
)
from jtqd.sim_can.source import OFF, VELOCITY
from tests.sim_can.bench_player import enabled, mapped_player, quiet

SHUTDOWN, SWITCH_ON, ENABLE, DISABLE_VOLTAGE, QUICK, RESET = 0x06, 0x07, 0x0F, 0x00, 0x02, 0x80

# CiA 402-2: mask and value of the statusword by state
STATUS = {
    NOT_READY: (0x4F, 0x00),
    SWITCH_ON_DISABLED: (0x4F, 0x40),
    READY: (0x6F, 0x21),
    SWITCHED_ON: (0x6F, 0x23),
    OPERATION_ENABLED: (0x6F, 0x27),
    QUICK_STOP: (0x6F, 0x07),
    FAULT_REACTION: (0x4F, 0x0F),
    FAULT: (0x4F, 0x08),
}

# state -> command -> next state; commands not listed change nothing
TABLE = {
    SWITCH_ON_DISABLED: {SHUTDOWN: READY},
    READY: {
        SWITCH_ON: SWITCHED_ON,
        ENABLE: OPERATION_ENABLED,
        DISABLE_VOLTAGE: SWITCH_ON_DISABLED,
        QUICK: SWITCH_ON_DISABLED,
    },
    SWITCHED_ON: {
        SHUTDOWN: READY,
        ENABLE: OPERATION_ENABLED,
        DISABLE_VOLTAGE: SWITCH_ON_DISABLED,
        QUICK: SWITCH_ON_DISABLED,
    },
    OPERATION_ENABLED: {
        SHUTDOWN: READY,
        SWITCH_ON: SWITCHED_ON,
        DISABLE_VOLTAGE: SWITCH_ON_DISABLED,
        QUICK: QUICK_STOP,
    },
    QUICK_STOP: {DISABLE_VOLTAGE: SWITCH_ON_DISABLED},
    FAULT_REACTION: {},
    FAULT: {RESET: SWITCH_ON_DISABLED},
}


def command_of(word):
    """The command a controlword means, decided bit by bit as the standard's table reads."""
    if word & 0x80:
        return None
    if not word & 0x02:
        return DISABLE_VOLTAGE
    if not word & 0x04:
        return QUICK
    if not word & 0x01:
        return SHUTDOWN
    return ENABLE if word & 0x08 else SWITCH_ON


def machine_in(state):
    machine = StateMachine()
    machine.state = state
    return machine


@pytest.mark.parametrize("state", list(TABLE))
def test_every_controlword_in_every_state(state):
    for word in range(0x10000):
        machine = machine_in(state)
        machine.controlword(word)
        if state == FAULT:
            expected = SWITCH_ON_DISABLED if word & 0x80 else FAULT
        else:
            expected = TABLE[state].get(command_of(word), state)
        assert machine.state == expected, f"{word:04X}h"


@pytest.mark.parametrize("state", list(STATUS))
def test_statusword_masks(state):
    """Exactly one state matches its statusword."""
    matching = [s for s, (mask, value) in STATUS.items() if STATUSWORDS[state] & mask == value]
    assert matching == [state]
    assert machine_in(state).statusword == STATUSWORDS[state]


def test_usual_way_to_operation_enabled():
    machine = StateMachine()
    words = []
    for command in (SHUTDOWN, SWITCH_ON, ENABLE):
        machine.controlword(command)
        words.append(machine.statusword & 0x6F)
    assert words == [0x21, 0x23, 0x27]
    assert machine.powered


def test_fault_needs_a_rising_edge_of_the_reset_bit():
    machine = machine_in(OPERATION_ENABLED)
    machine.controlword(0x8F)  # bit 7 is set already when the fault comes
    machine.fault()
    assert machine.state == FAULT_REACTION
    assert machine.powered
    assert not machine.controlword(0x80)
    machine.stopped()
    assert machine.state == FAULT
    assert not machine.powered
    assert not machine.controlword(0x80)  # no edge
    assert machine.state == FAULT
    assert not machine.controlword(0x0F)
    assert machine.controlword(0x80)
    assert machine.state == SWITCH_ON_DISABLED


def test_fault_without_power_needs_no_reaction():
    for state in (SWITCH_ON_DISABLED, READY, SWITCHED_ON):
        machine = machine_in(state)
        machine.fault()
        assert machine.state == FAULT


def test_fault_while_in_fault_stays():
    machine = machine_in(FAULT)
    machine.fault()
    assert machine.state == FAULT


def test_quick_stop_ends_in_switch_on_disabled():
    machine = machine_in(OPERATION_ENABLED)
    machine.controlword(QUICK)
    assert machine.statusword & 0x6F == 0x07
    machine.controlword(ENABLE)  # not left by "enable operation": quick stop option code 2
    assert machine.state == QUICK_STOP
    machine.stopped()
    assert machine.state == SWITCH_ON_DISABLED


@pytest.fixture
def mapped():
    return mapped_player()


def test_velocity_mode_target_is_in_increments_per_second_motor_side(mapped):
    enabled(mapped)
    mapped.put(1, 0x60FF, 0, -65536 * 10, 4)
    drive, mode, target = mapped.source.commands[-1]
    assert (drive, mode) == (0, VELOCITY)
    assert target == pytest.approx(-20 * math.pi)
    assert mapped.read(1, 0x6061) == 9
    mapped.put(1, 0x6040, 0, 0x10F, 2)  # halt
    assert mapped.source.commands[-1] == (0, VELOCITY, 0.0)


def test_quick_stop_brakes_then_switches_off(mapped):
    enabled(mapped)
    mapped.source.drives[0].motor_velocity_rad_s = 50.0
    mapped.put(1, 0x6040, 0, 0x02, 2)
    assert mapped.status() == 0x07
    assert mapped.source.commands[-1] == (0, VELOCITY, 0.0)
    mapped.sync()
    assert mapped.status() == 0x07  # still turning
    mapped.source.drives[0].motor_velocity_rad_s = 0.5
    mapped.sync()
    assert mapped.status() == 0x40
    assert mapped.source.commands[-1] == (0, OFF, 0.0)


def test_overcurrent_is_a_latched_fault_with_emcy(mapped):
    enabled(mapped)
    mapped.source.drives[0].current_a = -12.5
    texts = mapped.sync()
    assert texts[0] == "081#1023030000000000"  # 2310h, register: generic + current
    assert mapped.status() & 0x4F == 0x08
    assert mapped.read(1, 0x603F) == 0x2310
    assert mapped.source.commands[-1] == (0, OFF, 0.0)
    mapped.source.drives[0].current_a = 0.0
    mapped.put(1, 0x6040, 0, 0x0F, 2)
    assert mapped.status() & 0x4F == 0x08
    assert mapped.put(1, 0x6040, 0, 0x80, 2) == ["081#0000000000000000"]
    assert mapped.status() == 0x40
    assert mapped.read(1, 0x603F) == 0


def test_lost_master_heartbeat_stops_a_commanded_drive(mapped):
    """1016h: node 20h, 200 ms. Watched from the first heartbeat on; EMCY 8130h, fault, pre-operational (1029h
    = 0).
    """
    quiet(mapped).put(1, 0x1016, 1, 0x0020_00C8, 4)
    enabled(mapped)
    mapped.now = 0
    assert mapped.tick(1000) == []  # no heartbeat seen yet
    mapped.send(0x720, b"\x05")
    mapped.send(0x721, b"\x05", after_ms=100)  # another node
    mapped.send(0x720, b"\x05\x05", after_ms=50)  # not a heartbeat
    assert mapped.tick(1199) == []
    mapped.source.drives[0].motor_velocity_rad_s = 50.0
    assert mapped.tick(1200) == ["081#3081110000000000"]
    assert mapped.read(1, 0x6041) & 0x4F == 0x0F  # fault reaction: braking
    assert mapped.source.commands[-1] == (0, VELOCITY, 0.0)
    assert mapped.bench.drives[0].state == 0x7F
    mapped.source.drives[0].motor_velocity_rad_s = 0.0
    mapped.sync()
    assert mapped.read(1, 0x6041) & 0x4F == 0x08
    assert mapped.tick(5000) == []  # told once
    assert mapped.send(0x720, b"\x05") == ["081#0000000000000000"]
    assert mapped.read(1, 0x6041) & 0x4F == 0x08  # the fault stays until it is reset


def test_heartbeats_in_time_are_no_error(mapped):
    quiet(mapped).put(1, 0x1016, 1, 0x0020_00C8, 4)
    for k in range(1, 30):
        assert mapped.tick(100 * k) == []
        assert mapped.send(0x720, b"\x05") == []
