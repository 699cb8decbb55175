"""Blocking SDO client: over a frame socket with a real server behind it, and its BootErrors."""

import struct
import time
from collections.abc import Callable

import pytest

from jtqd.drivers.boot_error import BootError
from jtqd.drivers.frame import FRAME, pack
from jtqd.drivers.sdo import NO_SUBINDEX, SdoAbort
from jtqd.drivers.sdo_client import NodeObjects, SdoClient, SdoTimeout
from jtqd.drivers.sdo_server import SdoServer
from tests.drivers.canopen_nodes import drive_store


class FakeSocket:
    """A frame socket with one node behind it; `answers` may change or drop the reply to request number n."""

    def __init__(self, answer: Callable[[int, bytes], list[tuple[int, bytes]]] | None = None) -> None:
        self.store = drive_store(5)
        self.server = SdoServer(self.store)
        self.frames = bytearray(16 * 32)
        self.requests: list[bytes] = []
        self.waiting: list[bytes] = []
        self.answer = answer or (lambda n, reply: [(0x585, reply)])

    def send(self, frame16: bytes) -> bool:
        can_id, length, data = FRAME.unpack(frame16)
        assert (can_id, length) == (0x605, 8)
        self.requests.append(data)
        reply = self.server.handle(data)
        if reply is not None:
            self.waiting += [pack(*each) for each in self.answer(len(self.requests), reply)]
        return True

    def wait(self, timeout_s: float | None) -> bool:
        return bool(self.waiting)

    def receive(self) -> int:
        count = len(self.waiting)
        self.frames[: 16 * count] = b"".join(self.waiting)
        self.waiting = []
        return count


def client(socket: FakeSocket, timeout_s: float = 0.5) -> SdoClient:
    return SdoClient(socket, 5, timeout_s, answer_s=0.1)


def test_transcripts() -> None:
    socket = FakeSocket()
    sdo = client(socket)
    assert sdo.read(0x1000, 0) == (0x0002_0192).to_bytes(4, "little")
    assert sdo.read(0x60C2, 1) == b"\x01"
    sdo.write(0x6040, 0, b"\x06\x00")
    sdo.write(0x60FF, 0, struct.pack("<i", -5))
    assert [request.hex() for request in socket.requests] == [
        "4000100000000000",
        "40c2600100000000",
        "2b40600006000000",
        "23ff6000fbffffff",
    ]
    assert socket.store.number(0x60FF) == -5


def test_a_refusal_is_an_abort_and_a_long_object_comes_in_segments() -> None:
    socket = FakeSocket()
    sdo = client(socket)
    with pytest.raises(SdoAbort) as refused:
        sdo.write(0x6041, 0, b"\0\0")
    assert refused.value.code == 0x0601_0002
    assert sdo.read(0x1008, 0) == b"emulated joint drive"


def test_a_lost_answer_is_asked_for_again_and_answers_to_others_are_ignored() -> None:
    """The first reply is lost; the second comes behind one of another node, a short one and one to another object."""
    others = [
        (0x586, bytes.fromhex("43 00 10 00 FF FF FF FF")),
        (0x585, b"\x43\x00\x10"),
        (0x585, b"\x43\x18\x10\x01\x99\x00\x00\x00"),
    ]
    socket = FakeSocket(lambda n, reply: [] if n == 1 else [*others, (0x585, reply)])
    assert client(socket).read(0x1000, 0) == (0x0002_0192).to_bytes(4, "little")
    assert len(socket.requests) == 2


def test_a_late_answer_to_an_earlier_request_is_not_taken() -> None:
    """The node's answer to a read that was given up comes before the next read of the same object."""
    socket = FakeSocket()
    socket.waiting.append(pack(0x585, bytes.fromhex("43 00 10 00 FF FF FF FF")))
    assert client(socket).read(0x1000, 0) == (0x0002_0192).to_bytes(4, "little")


def test_a_silent_node_is_given_up_in_time_and_told() -> None:
    socket = FakeSocket(lambda n, reply: [])
    began = time.monotonic()
    with pytest.raises(SdoTimeout, match=r"no answer within 0\.25 s"):
        client(socket, 0.25).read(0x1000, 0)
    assert 0.15 < time.monotonic() - began < 0.5
    assert [request.hex() for request in socket.requests] == [
        "4000100000000000",
        "4000100000000000",
        "8000100000000405",  # abort 05040000h: timed out
    ]


def test_a_flood_of_foreign_answers_does_not_keep_it_waiting() -> None:
    """A node whose SDO server floods: 1018h:1 is answered without a question, faster than it is read."""

    class Flooded(FakeSocket):
        silent = False

        def receive(self) -> int:
            if self.silent:
                self.waiting.clear()
            self.waiting[:0] = [pack(0x585, bytes.fromhex("43 18 10 01 a1 07 00 00"))] * 20
            return super().receive()

        def wait(self, timeout_s: float | None) -> bool:
            return True

    socket = Flooded()
    sdo = client(socket)
    for _ in range(20):
        assert sdo.read(0x1000, 0) == bytes.fromhex("92 01 02 00")
        sdo.write(0x1017, 0, bytes.fromhex("64 00"))
    socket.silent = True
    began = time.monotonic()
    with pytest.raises(SdoTimeout):
        sdo.read(0x1000, 0)
    assert time.monotonic() - began < 2.0


# Numbers with names --------------------------------------------------------------------------------------


class Answers:
    """A node in memory: the answer to each read, an exception to be raised, or nothing for an object it does not have."""

    def __init__(self, answers: dict[tuple[int, int], bytes | Exception]) -> None:
        self.answers = answers
        self.written: list[tuple[int, int, bytes]] = []

    def _check(self, index: int, subindex: int) -> bytes:
        answer = self.answers.get((index, subindex), SdoAbort(NO_SUBINDEX))
        if isinstance(answer, Exception):
            raise answer
        return answer

    def read(self, index: int, subindex: int) -> bytes:
        return self._check(index, subindex)

    def write(self, index: int, subindex: int, data: bytes) -> None:
        self._check(index, subindex)
        self.written.append((index, subindex, data))


def test_numbers_are_read_and_kept_and_bytes_are_not() -> None:
    node = NodeObjects(Answers({(0x1017, 0): b"\x64\x00", (0x1008, 0): b"drive"}), 7)
    assert node.number((0x1017, 0), 2) == 100
    assert node.read((0x1008, 0)) == b"drive"
    assert node.read((0x1009, 0)) is None
    assert node.optional_number((0x1019, 0), 1) is None
    assert node.values == {(0x1017, 0): 100}


def test_a_negative_number_is_written_and_read_back() -> None:
    access = Answers({(0x60C2, 2): b"\xfd"})
    NodeObjects(access, 7).put((0x60C2, 2), -3, 1, "interpolation time index")
    assert access.written == [(0x60C2, 2, b"\xfd")]


@pytest.mark.parametrize(
    ("answer", "line"),
    [
        (SdoTimeout(0.5), "node 7: no answer to SDO 1017h:0 within 0.5 s (status J)"),
        (SdoAbort(0x0609_0030), "node 7: 1017h:0: write of 0x0064 refused: value out of range (06090030h) (status J)"),
        (b"\x63\x00", "node 7: 1017h:0 producer heartbeat time read back: expected 0x0064, found 0x0063 (status J)"),
    ],
)  # fmt: skip
def test_what_cannot_be_written_is_one_line_with_node_and_object(
    answer: bytes | Exception, line: str
) -> None:
    with pytest.raises(BootError) as caught:
        NodeObjects(Answers({(0x1017, 0): answer}), 7).put((0x1017, 0), 100, 2, "producer heartbeat time")
    assert str(caught.value) == line
    assert (caught.value.node, caught.value.object, caught.value.letter) == (7, "1017h:0", "J")


def test_what_must_be_there_is_refused_with_the_letter_of_its_step() -> None:
    node = NodeObjects(Answers({(0x1000, 0): SdoTimeout(0.2)}), 7)
    with pytest.raises(BootError, match=r"node 7: no answer to SDO 1000h:0 within 0\.2 s \(status B\)"):
        node.number((0x1000, 0), 4, letter="B")
    with pytest.raises(
        BootError, match=r"node 7: 6075h:0: read refused: sub-index does not exist \(06090011h\)$"
    ):
        node.number((0x6075, 0), 4)
