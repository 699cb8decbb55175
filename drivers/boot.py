"""Boot of the bus as a short-lived process: `python -m jtqd.drivers.boot < request.json > report.json`.

canopen and its threads live here and end here, so that nothing shares the loop's interpreter.
The request is that of `jtqd.drivers.boot_request`. The report is
    {"ok": true, "duration_s", "nodes": {"1": {...}}, "absent": {"3": error}}               exit status 0
    {"ok": false, "error": {"node", "object", "expected", "found", "letter", "message"}}    exit status 1
Boot is run again with a shorter list of nodes for a node that has come back.

jtqd's heartbeat begins with its boot-up message: a drive that watches it (1016h) would miss it before it is started.
At the first boot this process sends it, also after its report, until its standard input is closed: the loop has taken over.
"""

from __future__ import annotations

import json
import select
import sys
import threading
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import can
import canopen

from jtqd.drivers import nmt
from jtqd.drivers.boot_error import BootError
from jtqd.drivers.boot_procedure import BootedNode, NodeBoot, reset_during_boot
from jtqd.drivers.boot_request import BootRequest, RequestError, node_report, parse_request
from jtqd.drivers.devices import Profile
from jtqd.drivers.emcy import EMCY_BASE, HISTORY_INDEX, Emergency, name_of, parse, register_text
from jtqd.drivers.network import close, network_on, open_can
from jtqd.drivers.object_dictionary import entries_to_json, read_eds
from jtqd.drivers.sdo import RESPONSE_ID, Key, SdoAbort
from jtqd.drivers.sdo_client import NetworkChannel, SdoClient, SdoTimeout

_BOOT_UP_AGAIN_S = 0.05
"""After a reset: some devices send their boot-up message twice."""
_ATTEMPTS = 3
"""At the configuration of a node that sends its boot-up message again meanwhile."""
_REPORT_S = 0.25
"""For each object in which a node that failed says why."""
_LONGEST_HOLD_S = 60.0
"""After its report this process sends heartbeats for so long at most."""
SYNC_LISTEN_S = 0.12  # a little more than the longest period that jtqd itself may have
_SILENCES = 2.6
"""Of a node's longest silence: two repetitions of a request, and half of it again."""


@dataclass(frozen=True)
class BootReport:
    """A boot that went well: `nodes` are operational and configured, `absent` are optional ones and why they are not."""

    nodes: dict[int, BootedNode]
    duration_s: float
    absent: dict[int, BootError]

    def as_json(self) -> dict[str, object]:
        """Return the report for JSON."""
        nodes = {str(number): node_report(node) for number, node in self.nodes.items()}
        absent = {str(number): error.report() for number, error in self.absent.items()}
        return {"ok": True, "duration_s": round(self.duration_s, 4), "nodes": nodes, "absent": absent}


def boot(
    request: BootRequest,
    bus: can.BusABC | None = None,
    *,
    hold: Callable[[BootReport], None] = lambda _report: None,
) -> BootReport:
    """Boot all nodes of the request, in its order.

    Args:
        request: what to boot.
        bus: for tests.
        hold: takes the report; until it returns, jtqd's heartbeat is sent.

    Raises:
        BootError: a node, or the bus, cannot be used.
    """
    started = time.monotonic()
    network, errors = network_on(_open_bus(request) if bus is None else bus)
    beat = MasterHeartbeat(network, request)
    try:
        network.connect()
        nodes, absent = _boot_nodes(network, request, beat)
        report = BootReport(nodes, time.monotonic() - started, absent)
        hold(report)
    except BootError as error:
        if errors.last is not None:
            raise _bus_error(request.bus, errors.last) from error
        raise
    except (can.CanError, OSError) as error:
        raise _bus_error(request.bus, error) from error
    finally:
        beat.stop()
        close(network)
    return report


def _boot_nodes(
    network: canopen.Network, request: BootRequest, beat: MasterHeartbeat
) -> tuple[dict[int, BootedNode], dict[int, BootError]]:
    """Return the nodes that are operational, and why optional ones are not."""
    heartbeats, emergencies = Heartbeats(), Emergencies()
    foreign = ForeignMaster(network, request)
    for profile in request.profiles:
        network.subscribe(nmt.HEARTBEAT_BASE + profile.node_id, heartbeats.on_heartbeat)
        network.subscribe(EMCY_BASE + profile.node_id, emergencies.on_message)
    # Before anything is sent: a second daemon must not disturb the one that runs.
    foreign.require_none()
    foreign.announce()
    beat.begin()
    wait_s = max(3 * request.settings.heartbeat_ms, 100) * 1e-3
    booted: dict[int, BootedNode] = {}
    absent: dict[int, BootError] = {}

    def attempt(node: int, step: Callable[[], None]) -> None:
        """Do one step; an optional node that fails is absent from then on."""
        try:
            step()
        except BootError as error:
            why = error if error.letter == "B" else error.explained(_own_words(network, node, emergencies))
            if node not in request.optional or error.node != node:
                raise why from error
            absent[node] = why
            booted.pop(node, None)

    def configure(profile: Profile) -> None:
        booted[profile.node_id] = _configure(network, request, profile, heartbeats, ran=running)

    running = {
        profile.node_id
        for profile in request.profiles
        if heartbeats.wait(profile.node_id, None, 0.0) == nmt.OPERATIONAL
    }
    if request.reset:
        _reset(network, request, heartbeats)

    for profile in request.profiles:
        attempt(profile.node_id, partial(configure, profile))
    for node in list(booted):
        attempt(node, partial(_require_heartbeat, heartbeats, node, wait_s))
    foreign.require_none()
    for node in booted:
        network.send_message(0, [nmt.START, node])
    for node in list(booted):
        attempt(node, partial(_require_operational, network, heartbeats, node, wait_s))
    return booted, absent


def _reset(network: canopen.Network, request: BootRequest, heartbeats: Heartbeats) -> None:
    """Reset the communication of all nodes: errors of an earlier master's end, and what it had written, are gone.

    A node that sends no boot-up message within the time for its first answer may be absent: its first request will tell.
    """
    nodes = [profile.node_id for profile in request.profiles]
    for node in nodes:
        heartbeats.forget(node)
        network.send_message(0, [nmt.RESET_COMMUNICATION, node])
    began = time.monotonic()
    for node in nodes:
        heartbeats.wait_restarted(node, began + request.timeout_s(node) - time.monotonic())
    time.sleep(_BOOT_UP_AGAIN_S)


def _configure(
    network: canopen.Network,
    request: BootRequest,
    profile: Profile,
    heartbeats: Heartbeats,
    *,
    ran: Collection[int],
) -> BootedNode:
    """Identify and configure one node, which stays pre-operational; `ran`: nodes that were operational before."""
    node = profile.node_id
    notes = []
    if node in ran and request.check_foreign_sync:
        notes.append("it was already operational (status L): stopped and configured again")
    answer_s = request.answer_s(node)
    sdo = SdoClient(NetworkChannel(network, node), request.timeout_s(node), answer_s)
    for attempt in range(1, _ATTEMPTS + 1):
        # A running node would refuse to be re-mapped, and a stopped one does not answer SDO.
        network.send_message(0, [nmt.ENTER_PRE_OPERATIONAL, node])
        procedure = NodeBoot(sdo, profile, request.settings)
        device_type = procedure.check_device_type()
        sdo.wait_longer(_SILENCES * answer_s)
        heartbeats.forget(node)  # a boot-up message up to its first answer is its own start
        booted = procedure.run(device_type)
        if not (request.reset and heartbeats.restarted(node) and attempt < _ATTEMPTS):
            break
        again = "it sent its boot-up message again during its configuration: configured once more"
        notes.append(again)
    return replace(booted, notes=(*notes, *booted.notes), boot_ups=heartbeats.boot_ups(node))


def _own_words(network: canopen.Network, node: int, emergencies: Emergencies) -> str:
    """Return what a node that failed says about itself: 1001h, 1003h and its last EMCY; "" when all is well with it."""
    last = emergencies.last(node)  # before the questions, which may be refused as well
    sdo = SdoClient(NetworkChannel(network, node), _REPORT_S, _REPORT_S)

    def number(key: Key) -> int | None:
        try:
            return int.from_bytes(sdo.read(*key)[:4], "little")
        except (SdoAbort, SdoTimeout):
            return None

    register = number((0x1001, 0))
    history = number((HISTORY_INDEX, 1)) if register is not None and number((HISTORY_INDEX, 0)) else None
    said = []
    if register:
        said.append(f"1001h is {register:02X}h ({register_text(register)})")
    if history:
        said.append(f"1003h:1 is {history & 0xFFFF:04X}h ({name_of(history & 0xFFFF)})")
    if last is not None:
        said.append(f"its last EMCY is {last.code:04X}h ({name_of(last.code)})")
    return ", ".join(said)


def _require_heartbeat(heartbeats: Heartbeats, node: int, wait_s: float) -> None:
    """Start error control: the node must be heard before it is started."""
    if heartbeats.wait(node, None, wait_s) is None:
        detail = f"no heartbeat {nmt.HEARTBEAT_BASE + node:03X}h within {wait_s:g} s"
        raise BootError(node, "1017h:0", expected="heartbeat", found="none", letter="K", detail=detail)
    if heartbeats.restarted(node):
        raise reset_during_boot(node)


def _require_operational(network: canopen.Network, heartbeats: Heartbeats, node: int, wait_s: float) -> None:
    """Wait until the node is operational, if need be after a second start.

    A drive may still watch the heartbeat of a jtqd that ended a moment ago: not every device begins anew when 1016h is
    written. When that runs out it leaves operational (1029h), rightly, as it had no master; but it does so once.
    """
    state = heartbeats.wait(node, nmt.OPERATIONAL, wait_s)
    if state == nmt.PRE_OPERATIONAL and not heartbeats.restarted(node):
        network.send_message(0, [nmt.START, node])
        state = heartbeats.wait(node, nmt.OPERATIONAL, wait_s)
    if heartbeats.restarted(node):
        raise reset_during_boot(node)
    if state != nmt.OPERATIONAL:
        found = nmt.STATES.get(state, f"state {state}") if state is not None else "no heartbeat"
        detail = f"NMT start: expected operational within {wait_s:g} s, found {found}"
        raise BootError(node, "NMT state", expected="operational", found=found, detail=detail)


def _open_bus(request: BootRequest) -> can.BusABC:
    """Open a bus that receives the nodes' answers and heartbeats, SYNC and our own node-ID. Raises BootError."""
    bases = RESPONSE_ID, nmt.HEARTBEAT_BASE, EMCY_BASE
    identifiers = [base + profile.node_id for profile in request.profiles for base in bases]
    if request.check_foreign_sync:
        identifiers += [request.settings.sync_cob_id, nmt.HEARTBEAT_BASE + request.settings.master_node]
    try:
        return open_can(request.bus, identifiers)
    except (can.CanError, OSError) as error:
        raise _bus_error(request.bus, error) from error


def _bus_error(bus: str, error: Exception) -> BootError:
    return BootError(None, bus, expected="a bus", found=str(error), detail=f"bus {bus}: {error}")


class Heartbeats:
    """Newest NMT state of each node, from the notifier's thread."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._state: dict[int, int] = {}
        self._restarted: set[int] = set()
        self._boot_ups: dict[int, int] = {}

    def on_heartbeat(self, can_id: int, data: bytes, _timestamp: float) -> None:
        """Take a heartbeat (canopen's callback); a frame that is not one byte is none."""
        if len(data) != 1:
            return
        with self._changed:
            self._state[can_id - nmt.HEARTBEAT_BASE] = data[0] & 0x7F
            if data[0] == nmt.BOOT_UP:
                node = can_id - nmt.HEARTBEAT_BASE
                self._restarted.add(node)
                self._boot_ups[node] = self._boot_ups.get(node, 0) + 1
            self._changed.notify_all()

    def forget(self, node: int) -> None:
        """Discard what was heard so far."""
        with self._changed:
            self._state.pop(node, None)
            self._restarted.discard(node)

    def boot_ups(self, node: int) -> int:
        """Return the number of boot-up messages of a node."""
        with self._changed:
            return self._boot_ups.get(node, 0)

    def wait_restarted(self, node: int, timeout_s: float) -> bool:
        """Wait for a boot-up message since `forget`."""
        with self._changed:
            return self._changed.wait_for(lambda: node in self._restarted, max(timeout_s, 0.0))

    def restarted(self, node: int) -> bool:
        """Return whether a boot-up message came since `forget`."""
        with self._changed:
            return node in self._restarted

    def wait(self, node: int, wanted: int | None, timeout_s: float) -> int | None:
        """Return the newest state once it is `wanted` (None: any), or what it is after `timeout_s`."""

        def arrived() -> bool:
            state = self._state.get(node)
            return state is not None and (wanted is None or state == wanted)

        with self._changed:
            self._changed.wait_for(arrived, timeout_s)
            return self._state.get(node)


class Emergencies:
    """Last EMCY message of each node, from the notifier's thread."""

    def __init__(self) -> None:
        self._last: dict[int, Emergency] = {}

    def on_message(self, can_id: int, data: bytes, _timestamp: float) -> None:
        """Take a message (canopen's callback)."""
        self._last[can_id - EMCY_BASE] = parse(bytes(data))

    def last(self, node: int) -> Emergency | None:
        """Return the last message of a node that reports an error, or None."""
        found = self._last.get(node)
        return found if found is not None and found.code else None


class MasterHeartbeat:
    """jtqd's heartbeat, from its boot-up message until the loop sends it; not for a boot in service, beside the loop."""

    def __init__(self, network: canopen.Network, request: BootRequest) -> None:
        self._network, self._request = network, request
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def begin(self) -> None:
        """Send it from now on."""
        if self._request.check_foreign_sync:
            self._thread = threading.Thread(target=self._run, daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """End it."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        settings = self._request.settings
        cob_id, state = nmt.HEARTBEAT_BASE + settings.master_node, [nmt.PRE_OPERATIONAL]
        while True:
            try:
                self._network.send_message(cob_id, state)
            except (can.CanError, OSError):
                return  # the boot itself meets the same error
            if self._ended.wait(settings.heartbeat_ms * 1e-3):
                return


class ForeignMaster:
    """Watch for another SYNC producer, or another node with jtqd's own node-ID: the boot then refuses the bus."""

    def __init__(self, network: canopen.Network, request: BootRequest) -> None:
        self._network, self._request = network, request
        self._since = time.monotonic()
        self._syncs = self._own_ids = 0
        if request.check_foreign_sync:
            network.subscribe(request.settings.sync_cob_id, self._on_sync)
            network.subscribe(nmt.HEARTBEAT_BASE + request.settings.master_node, self._on_own_id)

    def _on_sync(self, *_: object) -> None:
        self._syncs += 1

    def _on_own_id(self, *_: object) -> None:
        self._own_ids += 1

    def announce(self) -> None:
        """Send jtqd's own boot-up message: another one that is booting too hears it, and neither goes on."""
        if self._request.check_foreign_sync:
            self._network.send_message(nmt.HEARTBEAT_BASE + self._request.settings.master_node, [nmt.BOOT_UP])

    def require_none(self) -> None:
        """Wait until it has listened long enough. Raises BootError when somebody else is there."""
        if not self._request.check_foreign_sync:
            return
        time.sleep(max(0.0, self._since + SYNC_LISTEN_S - time.monotonic()))
        if self._syncs:
            # it would make every input's cycle ambiguous
            where = f"COB-ID {self._request.settings.sync_cob_id:03X}h"
            detail = f"another SYNC producer is on the bus ({where}, {self._syncs} frames during boot)"
            raise BootError(None, where, expected="no SYNC", found=f"{self._syncs} frames", detail=detail)
        if self._own_ids:
            node = self._request.settings.master_node
            where = f"COB-ID {nmt.HEARTBEAT_BASE + node:03X}h"
            detail = (
                f"another node {node:02X}h, jtqd's own node-ID, is on the bus (heartbeat or boot-up {where})"
            )
            raise BootError(None, where, expected="no such node", found="heartbeat", detail=detail)


def main() -> int:
    """Read a request from stdin, boot, print the report; return the exit status. Never a traceback."""
    try:
        request = parse_request(_read_request())
        boot(request, hold=partial(_report_and_hold, request))
        return 0
    except BootError as error:
        report = {"ok": False, "error": error.report()}
    except (RequestError, json.JSONDecodeError) as error:
        wrong = BootError(None, "request", detail=f"boot request: {error}")
        report = {"ok": False, "error": wrong.report()}
    except KeyboardInterrupt:
        report = {"ok": False, "error": BootError(None, "boot", detail="boot interrupted").report()}
    except Exception as error:
        broken = BootError(None, "boot", detail=f"boot failed: {type(error).__name__}: {error}")
        report = {"ok": False, "error": broken.report()}
    print(json.dumps(report))
    return 1


def _read_request() -> object:
    """Return the JSON value on standard input, which need not end with it. Raises json.JSONDecodeError."""
    text = ""
    for line in sys.stdin:
        text += line
        with suppress(json.JSONDecodeError):
            return json.loads(text)
    return json.loads(text)


def _report_and_hold(request: BootRequest, booted: BootReport) -> None:
    """Print the report; wait until standard input is closed."""
    report = booted.as_json()
    if request.own_eds is not None:
        entries = read_eds(request.own_eds, request.settings.master_node)
        report["own_entries"] = entries_to_json(entries)
    print(json.dumps(report), flush=True)
    deadline = time.monotonic() + _LONGEST_HOLD_S
    while (left := deadline - time.monotonic()) > 0.0:
        if select.select([sys.stdin], [], [], left)[0] and not sys.stdin.readline():
            return


if __name__ == "__main__":
    sys.exit(main())
