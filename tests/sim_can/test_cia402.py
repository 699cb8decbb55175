"""CiA 402 state machine against the standard's tables, written out here a second time."""

import pytest

from jtqd.sim_can.drive_node import (
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
