"""jtqd's own EMCY: what comes and goes, register, history, inhibit time."""

import pytest

from jtqd.daemon.bus.errors import OwnErrors
from jtqd.drivers.object_dictionary import ObjectStore
from tests.drivers.canopen_nodes import EDS


def frame(text: str) -> bytes:
    return bytes.fromhex(text)


@pytest.fixture
def errors() -> OwnErrors:
    store = ObjectStore(EDS / "jtqd.eds", 0x20)
    store.set_number(0x1015, 0, 100)  # 10 ms
    return OwnErrors(store)


def test_an_error_comes_and_goes_as_bytes(errors: OwnErrors) -> None:
    assert errors.come(0x8250, 0x181, joints=1)
    assert not errors.come(0x8250, 0x181, joints=1), "known already"
    #                              code  reg ended detail joints
    assert errors.tick(0.0) == frame("5082 11 0000 8101 01")
    assert errors.tick(0.0) is None
    assert errors.gone(0x8250, 0x181)
    assert errors.tick(0.02) == frame("0000 00 5082 8101 01")
    assert errors.tick(1.0) is None


def test_each_pdo_has_its_own_error_and_the_register_stays_until_the_last_has_gone(errors: OwnErrors) -> None:
    store = errors._store
    for cob_id in (0x181, 0x282):
        errors.come(0x8250, cob_id)
    told = [errors.tick(0.0), errors.tick(0.005), errors.tick(0.02)]
    assert told == [frame("5082 11 0000 8101 00"), None, frame("5082 11 0000 8202 00")], (
        "10 ms between two (1015h)"
    )
    errors.gone(0x8250, 0x181)
    assert errors.tick(0.04) == frame("0000 11 5082 8101 00"), "no error of 181h any more, but there is one"
    assert store.number(0x1001) == 0x11
    errors.gone(0x8250, 0x282)
    assert errors.tick(0.06) == frame("0000 00 5082 8202 00")
    assert store.number(0x1001) == 0


def test_history_1003h_newest_first_bounded_and_clearable(errors: OwnErrors) -> None:
    store = errors._store
    for detail in range(1, 11):
        errors.come(0x8130, detail)
        errors.gone(0x8130, detail)
    assert store.number(0x1003) == 8
    assert [store.number(0x1003, sub) for sub in (1, 2, 8)] == [0x000A_8130, 0x0009_8130, 0x0003_8130]
    store.write(0x1003, 0, b"\0")
    assert store.number(0x1003) == 0
    assert store.number(0x1003, 1) == 0
    assert errors.tick(0.0) is None, "what had gone before it could be told is not told"


def test_what_flaps_within_the_inhibit_time_is_not_told_twice(errors: OwnErrors) -> None:
    errors.come(0x8130, 1)
    assert errors.tick(0.0) is not None
    for _ in range(50):
        errors.gone(0x8130, 1)
        errors.come(0x8130, 1)
    assert errors.tick(1.0) is None
    assert errors.all_present() == [(0x8130, 1)]


def test_a_recovery_is_told_once_and_is_no_lasting_error(errors: OwnErrors) -> None:
    errors.happened(0x8140)
    assert errors._store.number(0x1001) == 0
    assert errors.tick(0.0) == frame("4081 01 0000 0000 00")
    assert errors.tick(1.0) is None
    assert errors._store.number(0x1003, 1) == 0x8140


def test_many_errors_wait_in_bounded_memory(errors: OwnErrors) -> None:
    for detail in range(5000):
        errors.come(0x8210, detail)
        errors.gone(0x8210, detail - 30)
    assert len(errors._queue) <= 64
