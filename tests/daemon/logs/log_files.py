"""Logs of several writers with known content, readers to judge them by, ways to damage them: for tests of daemon/logs."""

import io
import random
import struct

import can
from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer

from jtqd.daemon.logs.can_io import McapCanWriter
from jtqd.daemon.recording.mcap_file import NamedData
from tests.daemon.logs.campaign_log import Cycle, Joint, write_log

ATTACHMENTS = [
    NamedData("configuration.yaml", "application/yaml", b"a: 1\n" * 50),
    NamedData("bus.dbc", "text/plain", b'VERSION ""\n\nBU_: jtqd\n\nBO_ 128 SYNC: 1 jtqd\n' + b"\n" * 160),
]


def cycles(count, seed=1):
    """Noise in every quantity; two frames a cycle."""
    source = random.Random(seed)
    for n in range(count):
        joints = tuple(Joint(*(source.gauss(0, 1) for _ in range(5))) for _ in range(2))
        frames = [(0x181, struct.pack("<ii", n, -n)), (0x281, struct.pack("<ihH", n, 3, 0x1237))]
        yield Cycle(100 + n, 7_000_000_000 + n * 1_000_000, joints, frames)


def ours(path, count=120, chunk_ns=20_000_000, seed=1, *, together=False):
    """A log by the recorder's own code, with attachments; `together`: all topics in one chunk, as before 0.2."""
    write_log(path, cycles(count, seed), together=together, attachments=ATTACHMENTS, chunk_ns=chunk_ns)
    return path.read_bytes()


def foreign(compression="zstd", *, chunked=True, count=400, finish=True, indexed=True):
    """A log by the mcap library: three topics of changing length, an attachment and metadata."""
    buffer = io.BytesIO()
    kind = {"": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}[compression]
    indexes = IndexType.ALL if indexed else IndexType.NONE
    writer = Writer(buffer, chunk_size=4096, compression=kind, use_chunking=chunked, index_types=indexes)
    writer.start("x", "lib")
    schema = writer.register_schema("a/B", "ros2msg", b"int64 a\nstring b\n")
    channels = [writer.register_channel(f"/t{n}", "cdr", schema) for n in range(3)]
    writer.add_attachment(1, 1, "att", "text/plain", b"hello" * 20)
    writer.add_metadata("meta", {"k": "v"})
    source = random.Random(3)
    for n in range(count):
        text = b"x" * source.randrange(40) + b"\0"
        data = b"\0\1\0\0" + struct.pack("<qI", source.getrandbits(60), len(text)) + text
        writer.add_message(channels[n % 3], 1_000_000 * n, data, 1_000_000 * n, n)
    if finish:
        writer.finish()
    return buffer.getvalue()


def logger(path, count=400):
    """A log of python-can's logger (`McapCanWriter`): a chunk for each half second of frames."""
    with McapCanWriter(path) as writer:
        for n in range(count):
            writer.on_message_received(
                can.Message(timestamp=0.02 * n, arbitration_id=n, data=bytes([n % 256]))
            )
    return path.read_bytes()


def by_index(data):
    """(messages the library's seeking reader gets, its error)."""
    count = 0
    try:
        for _ in make_reader(io.BytesIO(data), validate_crcs=True).iter_messages(log_time_order=False):
            count += 1
    except Exception as error:
        return count, error
    return count, None


def in_order(data):
    """(messages of known channels that the library gets going through the file, its error)."""
    count, known = 0, set()
    try:
        for record in StreamReader(io.BytesIO(data), validate_crcs=True, record_size_limit=1 << 28).records:
            if isinstance(record, Channel):
                known.add(record.id)
            elif isinstance(record, Message):
                count += record.channel_id in known
    except Exception as error:
        return count, error
    return count, None


def record_starts(data):
    """Offsets of the records of a whole file, and of the magic behind them."""
    at, found = 8, []
    while at < len(data) - 8:
        found.append(at)
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    return [*found, at]
