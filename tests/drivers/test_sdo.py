"""SDO protocol: transfers, waiting times and the queue of a node, as frames; the server's side is the real one."""

import itertools
import struct
import time
from collections.abc import Callable

import pytest

from jtqd.drivers.boot_node import BootError, NodeObjects
from jtqd.drivers.frame import FRAME, pack
from jtqd.drivers.object_dictionary import SdoServer
from jtqd.drivers.sdo import (
    LENGTH_MISMATCH,
    MAX_BYTES,
    NO_SUBINDEX,
    OUT_OF_MEMORY,
    TOGGLE_NOT_ALTERNATED,
    Exchange,
    SdoAbort,
    SdoClient,
    SdoQueue,
    SdoTimeout,
    Transfer,
    TransferError,
    describe_abort,
)
from tests.drivers.canopen_nodes import drive_store


def frame(text: str) -> bytes:
    return bytes.fromhex(text)


def talk(transfer: Transfer, server: SdoServer) -> list[str]:
    """Both sides until the end; the frames as text."""
    transcript = []
    for _ in range(2000):
        reply = server.handle(transfer.request)
        assert reply is not None
        transcript += [transfer.request.hex(" "), reply.hex(" ")]
        assert transfer.answer(reply)
        if transfer.done:
            return transcript
    raise AssertionError("endless")


def test_every_abort_code_of_cia_301_has_words():
    """CiA 301, 7.2.4.3.17, table 22: all 31 of them; another one shows its number."""
    codes = (
        0x05030000,
        0x05040000,
        0x05040001,
        0x05040002,
        0x05040003,
        0x05040004,
        0x05040005,
        0x06010000,
        0x06010001,
        0x06010002,
        0x06020000,
        0x06040041,
        0x06040042,
        0x06040043,
        0x06040047,
        0x06060000,
        0x06070010,
        0x06070012,
        0x06070013,
        0x06090011,
        0x06090030,
        0x06090031,
        0x06090032,
        0x06090036,
        0x060A0023,
        0x08000000,
        0x08000020,
        0x08000021,
        0x08000022,
        0x08000023,
        0x08000024,
    )
    words = [describe_abort(code) for code in codes]
    assert len({text.partition(" (0")[0] for text in words}) == len(codes) == 31
    assert not any(text.startswith("abort ") for text in words)
    assert describe_abort(0x0609_0031) == "value too high (06090031h)"
    assert describe_abort(0x0BAD_0000) == "abort (0BAD0000h)"


def test_expedited_both_ways():
    server = SdoServer(drive_store(1))
    read = Transfer(0x1000, 0)
    assert talk(read, server) == [
        "40 00 10 00 00 00 00 00",  # initiate upload, 1000h:0
        "43 00 10 00 92 01 02 00",  # expedited, 4 bytes: servo drive 00020192h
    ]
    assert read.value == frame("92 01 02 00")
    write = Transfer(0x1017, 0, frame("64 00"))
    assert talk(write, server) == [
        "2b 17 10 00 64 00 00 00",  # initiate download, expedited, 2 bytes of 4 used: 100 ms
        "60 17 10 00 00 00 00 00",  # taken
    ]
    assert server.store.number(0x1017) == 100


def test_segmented_upload_of_a_name():
    store = drive_store(1)
    store.set_text(0x1008, 0, "joint drive")  # 11 bytes: two segments
    read = Transfer(0x1008, 0)
    assert talk(read, SdoServer(store)) == [
        "40 08 10 00 00 00 00 00",
        "41 08 10 00 0b 00 00 00",  # segmented, size 11
        "60 00 00 00 00 00 00 00",  # segment, toggle 0
        "00 6a 6f 69 6e 74 20 64",  # 7 bytes, more follow
        "70 00 00 00 00 00 00 00",  # toggle 1
        "17 72 69 76 65 00 00 00",  # last: toggle 1, 3 bytes unused, c = 1
    ]
    assert read.value == b"joint drive"


def test_segmented_download():
    """Frames only: none of our objects is a writable text."""
    write = Transfer(0x2000, 1, b"ABCDEFGHI")
    assert write.request == frame("21 00 20 01 09 00 00 00")  # initiate, size 9
    assert write.answer(frame("60 00 20 01 00 00 00 00"))
    assert write.request == frame("00 41 42 43 44 45 46 47")  # toggle 0, 7 bytes
    assert write.answer(frame("20 00 00 00 00 00 00 00"))
    assert write.request == frame("1b 48 49 00 00 00 00 00")  # toggle 1, 5 bytes unused, last
    assert not write.done
    assert write.answer(frame("30 00 00 00 00 00 00 00"))
    assert write.done


def test_a_segmented_download_whose_toggle_does_not_alternate_is_broken():
    write = Transfer(0x2000, 1, b"ABCDEFGHI")
    write.answer(frame("60 00 20 01 00 00 00 00"))
    with pytest.raises(TransferError) as caught:
        write.answer(frame("30 00 00 00 00 00 00 00"))  # toggle 1 where 0 is due
    assert caught.value.code == TOGGLE_NOT_ALTERNATED


def test_a_refusal_is_the_servers():
    with pytest.raises(SdoAbort, match="object does not exist"):
        Transfer(0x5000, 0).answer(frame("80 00 50 00 00 00 02 06"))


@pytest.mark.parametrize(
    "reply",
    [
        "43 18 10 01 a1 07 00 00",  # the late answer to 1018h:1
        "43 00 10 01 00 00 00 00",  # another sub-index
        "60 00 10 00 00 00 00 00",  # the answer to a download of the same object
        "80 18 10 01 00 00 04 05",  # an abort of the earlier request
        "00 01 02 03 04 05 06 07",  # a segment without a transfer
        "43 00 10 00",  # too short to be one
    ],
)
def test_answers_to_something_else_are_ignored(reply):
    exchange = Exchange(0x1000, 0, None, now=0.0, timeout_s=0.5)
    assert exchange.on_reply(frame(reply), 0.01) == []
    assert not exchange.ended
    exchange.on_reply(frame("43 00 10 00 92 01 02 00"), 0.02)
    assert exchange.value == frame("92 01 02 00")
    assert exchange.ignored == 1


def test_a_toggle_error_ends_the_transfer_and_it_is_repeated():
    exchange = Exchange(0x1008, 0, None, now=0.0, timeout_s=0.5)
    assert exchange.on_reply(frame("41 08 10 00 0b 00 00 00"), 0.01) == [frame("60 00 00 00 00 00 00 00")]
    out = exchange.on_reply(frame("10 6a 6f 69 6e 74 20 64"), 0.02)  # toggle 1 where 0 is due
    assert out == [
        frame("80 08 10 00 00 00 03 05"),  # abort 05030000h
        frame("40 08 10 00 00 00 00 00"),  # and the request again
    ]
    assert int.from_bytes(out[0][4:], "little") == TOGGLE_NOT_ALTERNATED
    assert exchange.repeats == 1


def test_nothing_is_repeated_inside_a_segmented_transfer():
    """A slow device takes its time for each segment; a request sent twice would be answered twice."""
    exchange = Exchange(0x1008, 0, None, now=0.0, timeout_s=2.0, answer_s=0.1)
    assert exchange.tick(0.11) == [
        exchange.request
    ]  # the first request may be repeated: it restarts the transfer
    segment = [frame("60 00 00 00 00 00 00 00")]
    assert exchange.on_reply(frame("41 08 10 00 0b 00 00 00"), 0.5) == segment
    assert exchange.tick(2.4) == [], "nor is the transfer given up: each answer may take the timeout"
    assert exchange.on_reply(frame("00 6a 6f 69 6e 74 20 64"), 2.4) == [frame("70 00 00 00 00 00 00 00")]
    exchange.on_reply(frame("17 72 69 76 65 00 00 00"), 4.3)
    assert exchange.value == b"joint drive"


def test_a_node_that_falls_silent_between_two_segments_is_given_up():
    exchange = Exchange(0x1008, 0, None, now=0.0, timeout_s=0.5, answer_s=0.1)
    exchange.on_reply(frame("41 08 10 00 0b 00 00 00"), 0.1)
    assert exchange.tick(0.59) == []
    assert exchange.tick(0.61) == [frame("80 08 10 00 00 00 04 05")]
    assert exchange.timed_out


def test_a_size_that_is_not_kept_and_one_that_is_too_large():
    transfer = Transfer(0x1008, 0)
    transfer.answer(frame("41 08 10 00 09 00 00 00"))  # 9 bytes announced
    with pytest.raises(TransferError) as caught:
        transfer.answer(frame("01 41 42 43 44 45 46 47"))  # the last segment holds 7
    assert caught.value.code == LENGTH_MISMATCH
    with pytest.raises(TransferError) as caught:
        Transfer(0x1008, 0).answer(frame("41 08 10 00") + (MAX_BYTES + 1).to_bytes(4, "little"))
    assert caught.value.code == OUT_OF_MEMORY
    endless = Transfer(0x1008, 0)
    endless.answer(frame("40 08 10 00 00 00 00 00"))  # segmented, size not announced

    def send_for_ever() -> None:
        for n in itertools.count():
            endless.answer(bytes([0x10 * (n % 2)]) + bytes(7))

    with pytest.raises(TransferError):
        send_for_ever()


@pytest.mark.parametrize(
    ("replies", "words"),
    [
        ([], ""),
        (["4b 00 10 00 92 01"], "an answer of 6 bytes, expected 8"),
        (["4f"], "an answer of 1 byte, expected 8"),
        (["80 00 10 00"], "an answer of 4 bytes, expected 8"),
        (["43 18 10 01 a1 07 00 00"], "an answer 43 18 10 01 a1 07 00 00"),
        (["41 00 10 00 09 00 00 00", "11 00 00 00 00 00 00 00"], "an answer: toggle bit not alternated (05030000h)"),
        (["41 00 10 00 ff ff ff 00"], "an answer: out of memory (05040005h)"),
    ],
)  # fmt: skip
def test_an_answer_that_is_refused_is_no_silence(replies, words):
    """Told with the object that had no answer, and in the boot as well."""
    sent = []

    class Served:
        def __init__(self):
            self.frames, self._ready = bytearray(), []

        def send(self, packed):
            sent.append(packed)
            self._ready = [frame(each) for each in replies] if len(sent) == 1 else []
            return True

        def wait(self, timeout_s):
            time.sleep(0 if self._ready else min(timeout_s, 0.01))
            return bool(self._ready)

        def receive(self):
            ready, self._ready = self._ready, []
            self.frames = bytearray().join(
                FRAME.pack(0x585, len(each), each.ljust(8, b"\0")[:8]) for each in ready
            )
            return len(ready)

    client = SdoClient(Served(), 5, 0.1, 0.05)
    with pytest.raises(SdoTimeout) as caught:
        client.read(0x1000, 0)
    assert str(caught.value) == "no answer within 0.1 s" + (f"; refused {words}" if words else "")
    error = NodeObjects(Answers({(0x1000, 0): caught.value}), 5)
    with pytest.raises(BootError) as boot:
        error.number((0x1000, 0), 4)
    assert str(boot.value) == "node 5: no answer to SDO 1000h:0 within 0.1 s" + (
        words and f"; refused {words}"
    )
    assert boot.value.found == (words or "none")


def test_silence_is_asked_again_and_then_given_up():
    exchange = Exchange(0x1000, 0, None, now=0.0, timeout_s=0.3, answer_s=0.1)
    request = [exchange.request]
    assert exchange.tick(0.05) == []
    assert exchange.tick(0.11) == request
    assert exchange.tick(0.22) == request
    assert exchange.tick(0.32) == [frame("80 00 10 00 00 00 04 05")]  # abort 05040000h: timed out
    assert exchange.timed_out
    assert exchange.on_reply(frame("43 00 10 00 92 01 02 00"), 0.4) == []  # too late
    assert exchange.value is None


# The queue --------------------------------------------------------------------------------------------------


def results_of(queue, *requests):
    """Queue uploads; return the list that takes their (value, refusal)."""
    results = []
    for key, timeout_s in requests:
        assert queue.read(key, lambda value, refusal: results.append((value, refusal)), timeout_s)
    return results


def test_requests_to_one_node_go_one_after_the_other_and_each_gets_its_own_answer():
    queue = SdoQueue()
    results = results_of(queue, ((0x1018, 1), 0.5), ((0x1018, 2), 0.5))
    assert queue.tick(0.0) == [frame("40 18 10 01 00 00 00 00")]
    assert queue.tick(0.01) == [], "the second waits"
    assert queue.on_reply(frame("43 18 10 02 02 04 00 00"), 0.02) == [], "an answer to what was not asked yet"
    assert queue.on_reply(frame("43 18 10 01 a1 07 00 00"), 0.03) == [frame("40 18 10 02 00 00 00 00")]
    queue.on_reply(frame("43 18 10 02 02 04 00 00"), 0.04)
    assert results == [(frame("a1 07 00 00"), None), (frame("02 04 00 00"), None)]
    assert (queue.ignored, queue.busy) == (1, False)


def test_a_request_that_is_never_answered_keeps_the_next_one_waiting_and_no_longer():
    queue = SdoQueue(answer_s=0.1)
    results = results_of(queue, ((0x1000, 0), 0.2), ((0x1017, 0), 0.5))
    sent = [each for step in range(60) for each in queue.tick(0.01 * step)]
    assert sent[0] == sent[1] == frame("40 00 10 00 00 00 00 00")
    assert results == [(None, None)]
    late = queue.on_reply(frame("43 00 10 00 92 01 02 00"), 0.31)  # of the one that was given up
    assert late == []
    queue.on_reply(frame("4b 17 10 00 64 00 00 00"), 0.32)
    assert results[1] == (frame("64 00"), None)
    assert (queue.timeouts, queue.ignored, queue.repeats >= 1) == (1, 1, True)


def test_a_flood_of_answers_fills_nothing_and_the_right_one_is_found():
    queue = SdoQueue()
    results = results_of(queue, ((0x1000, 0), 0.5))
    queue.tick(0.0)
    for _ in range(10_000):
        assert queue.on_reply(frame("43 18 10 01 a1 07 00 00"), 0.01) == []
    queue.on_reply(frame("43 00 10 00 92 01 02 00"), 0.02)
    assert results == [(frame("92 01 02 00"), None)]
    assert queue.ignored == 10_000


def test_the_queue_is_bounded_and_can_be_cleared():
    queue = SdoQueue(limit=4)
    taken = [queue.read((0x1000, 0), lambda _value, _refusal: None) for _ in range(6)]
    assert taken == [True] * 4 + [False] * 2
    queue.clear()
    assert not queue.busy
    assert queue.tick(0.0) == []


def test_a_refusal_is_reported():
    queue = SdoQueue()
    results = results_of(queue, ((0x5000, 0), 0.5))
    (request,) = queue.tick(0.0)
    queue.on_reply(SdoServer(drive_store(1)).handle(request), 0.01)
    assert results == [(None, 0x0602_0000)]
    assert queue.refusals == 1


# The client that waits


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


def test_a_silent_node_is_given_up_in_time_and_aborted() -> None:
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
