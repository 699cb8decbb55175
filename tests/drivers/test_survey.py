"""What a device tells of itself: a node in memory, its EDS, and nodes on a bus."""

import threading
import time
from dataclasses import replace

import pytest

from jtqd.drivers import survey as survey_module
from jtqd.drivers.frame import pack
from jtqd.drivers.frame_socket import open_frame_socket
from jtqd.drivers.hub import Hub
from jtqd.drivers.object_dictionary import EdsError, ObjectStore, SdoServer, read_eds
from jtqd.drivers.sdo import GENERAL_ERROR, REQUEST_ID, RESPONSE_ID, SdoAbort, SdoTimeout
from jtqd.drivers.survey import DRIVE, SENSOR, BusSurvey, SurveyError, Tpdo, survey, survey_of_eds, tpdos
from tests.paths import ROOT

EDS = ROOT / "drivers" / "eds"
DRIVE_EDS, SENSOR_EDS = EDS / "drive.eds", EDS / "torque_sensor.eds"


def without(*keys, eds=DRIVE_EDS, node=5):
    return ObjectStore(
        [each for each in read_eds(eds, node).entries if (each.index, each.subindex) not in keys], node
    )


def test_a_drive_that_has_all():
    store = without()
    store.set_number(0x6075, 0, 8000)
    store.set_number(0x6091, 1, 101)
    store.set_text(0x1008, 0, "drive\x1b[31m")
    found = survey(store, 5)
    assert (found.node, found.profile, found.source) == (5, DRIVE, "the bus")
    assert found.title == "drive[31m", "nothing that a terminal obeys"
    assert (found.number((0x6075, 0)), found.number((0x6091, 1))) == (8000, 101)
    assert not found.missing


def test_what_is_missing_or_zero_is_no_value():
    store = without((0x60E4, 1), (0x6090, 1), (0x6090, 2), (0x1008, 0))
    store.set_number(0x6091, 1, 0)
    found = survey(store, 5)
    assert found.missing == {(0x60E4, 1), (0x6090, 1), (0x6090, 2)}
    assert found.number((0x6091, 1)) is None
    assert not found.scales_by((0x6091, 1))
    assert found.title == "drive"


def test_tpdos_as_they_are():
    store = without()
    store.set_number(0x1800, 1, 0x8000_0185)
    store.set_number(0x1800, 2, 1)
    store.set_number(0x1A00, 0, 2)
    store.set_number(0x1A00, 1, 0x6064_0020)
    store.set_number(0x1A00, 2, 0x60E4_0120)
    one = tpdos(store)[0]
    assert one == Tpdo(1, 0x185, (0x6064_0020, 0x60E4_0120), on=False)
    assert one.objects == ("6064h:0/32", "60E4h:1/32")
    assert len(tpdos(store)) == 3, "the fourth is not there"


def test_bit_7_of_a_mapped_length_is_a_note_and_no_length(tmp_path):
    """On the bus and in an EDS."""
    store = without()
    for sub, word in ((0, 2), (1, 0x6064_00A0), (2, 0x60E4_01A0)):
        store.set_number(0x1A00, sub, word)
    found = tpdos(store)
    assert found[0].words == (0x6064_0020, 0x60E4_0120)
    assert found[0].note == "TPDO1: taken as 6064h:0/32, 60E4h:1/32, without bit 7 of a length"
    assert [each.note for each in found[1:]] == ["", ""]
    text = DRIVE_EDS.read_text()
    assert text.count("=0x60640020\n") == 1
    (tmp_path / "maker.eds").write_text(text.replace("=0x60640020\n", "=0x606400A0\n"))
    eds, usual = survey_of_eds(tmp_path / "maker.eds", 5), survey_of_eds(DRIVE_EDS, 5)
    assert [each.words for each in eds.tpdos] == [each.words for each in usual.tpdos]
    assert eds.notes == ["node 5: TPDO2: taken as 6064h:0/32, 606Ch:0/32, without bit 7 of a length"]


def test_an_answer_of_another_length_is_no_missing_node(bus, monkeypatch):
    path, _ = bus
    monkeypatch.setattr(survey_module, "ANSWER_S", 0.05)
    monkeypatch.setattr(
        survey_module, "survey", lambda *_: (_ for _ in ()).throw(SdoTimeout(0.1, "an answer of 6 bytes"))
    )
    reader = BusSurvey(path)
    with pytest.raises(SurveyError, match=r"^node 5: no answer within 0\.1 s; refused an answer of 6 bytes$"):
        reader.read(5)
    reader.close()


def test_a_sensor():
    found = survey(without(eds=SENSOR_EDS, node=3), 3)
    assert found.profile == SENSOR
    assert not found.missing


def test_a_node_that_does_not_answer():
    class Silent:
        def read(self, index, subindex):
            raise SdoTimeout(0.5)

    with pytest.raises(SdoTimeout):
        survey(Silent(), 5)


class Wayward:
    """A drive that is silent about some objects, and refuses others."""

    def __init__(self, silent=(), refused=()):
        self._store, self._silent, self._refused = without(), silent, refused

    def read(self, index, subindex):
        if (index, subindex) in self._silent:
            raise SdoTimeout(1.56)
        if (index, subindex) in self._refused:
            raise SdoAbort(GENERAL_ERROR)
        return self._store.read(index, subindex)


def test_silence_is_not_taken_for_an_object_that_is_not_there():
    """A drive that is slow once would be one without a second encoder."""
    with pytest.raises(SurveyError, match=r"^60E4h:1: no answer within 1\.56 s$"):
        survey(Wayward(silent=[(0x60E4, 1)]), 5)
    with pytest.raises(SurveyError, match=r"^1A00h:0: no answer"):
        tpdos(Wayward(silent=[(0x1A00, 0)]))
    assert survey(Wayward(silent=[(0x1008, 0)]), 5).title == "drive", "its name is cosmetic"
    assert survey(Wayward(refused=[(0x60E4, 1)]), 5).missing == {(0x60E4, 1)}


def test_a_device_that_refuses_its_type_has_no_profile():
    found = survey(Wayward(refused=[(0x1000, 0)]), 5)
    assert (found.profile, found.title) == (0, "emulated joint drive")


def test_a_29_bit_identifier_is_read_as_it_is():
    store = without()
    store.set_number(0x1800, 1, 0x2123_4185)
    assert tpdos(store)[0].cob_id == 0x0123_4185


def test_an_eds_has_defaults_and_what_can_be_mapped(tmp_path):
    text = DRIVE_EDS.read_text()
    start = text.index("[60E4sub1]")
    end = text.index("[", start + 1)
    (tmp_path / "vendor.eds").write_text(
        text[:start] + text[start:end].replace("PDOMapping=1", "PDOMapping=0") + text[end:]
    )
    found = survey_of_eds(tmp_path / "vendor.eds", 7)
    assert found.unmappable == {(0x60E4, 1)}
    assert (found.node, found.source) == (7, "defaults of vendor.eds")
    assert found.numbers[0x1018, 1] == 0x7A1
    zero = replace(found, numbers={**found.numbers, (0x608F, 1): 0})
    assert zero.number((0x608F, 1)) is None
    assert zero.scales_by((0x608F, 1)), "the device itself will"


def test_no_eds(tmp_path):
    (tmp_path / "bad.eds").write_text("not an EDS")
    for path in (tmp_path / "bad.eds", tmp_path / "none.eds"):
        with pytest.raises(EdsError):
            survey_of_eds(path, 1)


@pytest.fixture
def bus(tmp_path):
    """A unix bus with nodes 5 and 127 as SDO servers; with `syncs` there is a SYNC every 10 ms."""
    path = f"unix:{tmp_path}/bus"
    hub, stop, syncs = Hub(str(tmp_path / "bus")), threading.Event(), threading.Event()
    servers = {node: SdoServer(ObjectStore(DRIVE_EDS, node)) for node in (5, 8, 127)}
    late = []
    """Answers of node 8: 0.22 s after the request, so that each request is sent twice."""

    def serve_hub():
        while not stop.is_set():
            hub.run_once(0.01)

    def serve_nodes():
        socket = open_frame_socket(path, None)
        while not stop.is_set():
            socket.wait(0.01)
            for at in range(socket.receive()):
                can_id = int.from_bytes(socket.frames[16 * at : 16 * at + 4], "little")
                data = bytes(socket.frames[16 * at + 8 : 16 * at + 16])
                server = servers.get(can_id - REQUEST_ID)
                if server is not None:
                    answer = server.handle(data)
                    if answer is not None and can_id == REQUEST_ID + 8:
                        late.append((time.monotonic() + 0.22, pack(RESPONSE_ID + 8, answer)))
                    elif answer is not None:
                        socket.send(pack(RESPONSE_ID + can_id - REQUEST_ID, answer))
            while late and late[0][0] <= time.monotonic():
                socket.send(late.pop(0)[1])
            if syncs.is_set():
                socket.send(pack(0x080, b""))
        socket.close()

    threads = [threading.Thread(target=each) for each in (serve_hub, serve_nodes)]
    for thread in threads:
        thread.start()
    yield path, syncs
    stop.set()
    for thread in threads:
        thread.join()
    hub.close()


def test_nodes_are_found_on_a_bus_and_read(bus, monkeypatch):
    path, _ = bus
    monkeypatch.setattr(survey_module, "ANSWER_S", 0.2)
    monkeypatch.setattr(survey_module, "_PRESENT_S", 0.35)
    reader = BusSurvey(path)
    try:
        assert reader.nodes() == [5, 8, 127]
        assert reader.nodes([5, 6]) == [5]
        found = reader.read(127)
        assert found is not None
        assert found.profile == DRIVE
        assert reader.read(6) is None
        slow = reader.numbers(8, [(0x6091, 1), (0x6041, 7)])
        assert slow == {(0x6091, 1): 100}, "one is not there"
    finally:
        reader.close()


def test_a_bus_in_service_is_left_alone(bus):
    path, syncs = bus
    syncs.set()
    with pytest.raises(ValueError, match="a master is running"):
        BusSurvey(path)
