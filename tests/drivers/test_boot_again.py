"""Boot of drives that still watch the heartbeat of a jtqd that ended a moment ago."""

import uuid

import can

from jtqd.drivers.boot import boot
from jtqd.drivers.boot_request import parse_request
from tests.drivers.canopen_nodes import Responder, TestNode, drive_store


class WatchingDrive(TestNode):
    """The watch (1016h) runs out right after NMT start: the drive leaves operational (1029h), once."""

    def __init__(self) -> None:
        super().__init__(drive_store(1))
        self.starts = 0

    def frames(self, can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        out = super().frames(can_id, data)
        if can_id == 0 and data[0] == 1:
            self.starts += 1
            if self.starts == 1:
                self.state = 0x7F
        return out


def test_a_drive_that_leaves_operational_once_is_started_again() -> None:
    drive, channel = WatchingDrive(), uuid.uuid4().hex
    request = parse_request({"bus": "virtual", "heartbeat_ms": 30, "nodes": [{"node": 1, "kind": "drive"}]})
    with Responder(can.Bus(interface="virtual", channel=channel), [drive]):
        boot(request, can.Bus(interface="virtual", channel=channel))
    assert (drive.state, drive.starts) == (5, 2)
    # It watches its master all the same: one that dies stops it.
    assert drive.store.number(0x1016, 1) == 0x20 << 16 | 500
