"""CiA 402 from both ends: what the commander reads and commands against the emulated drive's state machine."""

import pytest

from jtqd.drivers.drive import State, state_of
from jtqd.sim_can import drive_node as cia402
from jtqd.sysid.motion.drives import (
    DISABLE_VOLTAGE,
    FAULT_RESET,
    FAULTED,
    POWERED,
    QUICK_STOP_WORD,
    describe,
    enabling_word,
)


def test_the_drives_statuswords_are_read_as_the_states_they_are() -> None:
    for number, word in enumerate(cia402.STATUSWORDS):
        assert state_of(word).value == cia402.NAMES[number]


def test_bits_that_do_not_tell_the_state_change_nothing_and_the_table_is_the_function() -> None:
    told = 0x6F
    for word in range(0x10000):
        state = state_of(word)
        assert state_of(word) is state
        assert state_of(word & told) is state
        if not word & 0x40 and word & 0x0F == 0x07 and word & 0x20:
            assert state is State.OPERATION_ENABLED


@pytest.mark.parametrize("number", [cia402.SWITCH_ON_DISABLED, cia402.READY, cia402.SWITCHED_ON])
def test_the_words_lead_an_emulated_drive_to_operation_enabled_and_no_further_word_is_needed(
    number: int,
) -> None:
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


@pytest.mark.parametrize(
    "state", [State.FAULT, State.FAULT_REACTION, State.QUICK_STOP, State.NOT_READY, State.UNKNOWN]
)
def test_no_word_leads_out_of_a_fault_or_a_quick_stop(state: State) -> None:
    assert enabling_word(state) is None


def test_what_is_not_known_counts_as_powered() -> None:
    assert State.UNKNOWN in POWERED
    assert state_of(0x7FFF) is State.UNKNOWN
    assert not {State.FAULT, State.SWITCH_ON_DISABLED, State.READY} & POWERED
    assert {State.FAULT, State.FAULT_REACTION} == FAULTED
    machine = cia402.StateMachine()
    machine.fault()
    assert machine.controlword(FAULT_RESET)
    assert describe(0x0218) == "fault (statusword 0218h)"
