"""Boot of the bus as a short-lived process: `python -m drivers.boot < request.json > report.json`.

canopen and its threads live here and end here, so that nothing shares the loop's interpreter.
The request is that of `drivers.boot_request`. The report is
    {"ok": true, "duration_s", "nodes": {"1": {...}}}                                       exit status 0
    {"ok": false, "error": {"node", "object", "expected", "found", "letter", "message"}}    exit status 1
Boot is run again with a shorter list of nodes for a node that has come back.
"""

from __future__ import annotations

import json
import logging
import sys
import threading
import time
from dataclasses import dataclass

import can
import canopen

from drivers.boot_error import BootError
from drivers.boot_procedure import BootedNode, NodeBoot, reset_during_boot
from drivers.boot_request import BootRequest, RequestError, node_report, parse_request
from drivers.frame import CAN_RTR_FLAG, CAN_SFF_MASK
from drivers.object_dictionary import entries_to_json, read_eds
from drivers.sdo_client import NodeSdo

NMT_START, NMT_PRE_OPERATIONAL = 0x01, 0x80
STATE_BOOT_UP, STATE_STOPPED, STATE_OPERATIONAL, STATE_PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
SYNC_LISTEN_S = 0.12  # a little more than the longest period that jtqd itself may have
NOTIFIER_S = 0.01  # canopen's default of 1 s is what closing the network would wait for
_UNIX = "unix:"
_STATE_NAMES = {STATE_BOOT_UP: "boot-up", STATE_STOPPED: "stopped", STATE_PRE_OPERATIONAL: "pre-operational"}


@dataclass(frozen=True)
class BootReport:
    """All nodes operational, as configured."""

    nodes: dict[int, BootedNode]
    duration_s: float

    def as_json(self) -> dict[str, object]:
        """The report of a boot that went well."""
        nodes = {str(number): node_report(node) for number, node in self.nodes.items()}
        return {"ok": True, "duration_s": round(self.duration_s, 4), "nodes": nodes}


class _Heartbeats:
    """Newest NMT state of each node, from the notifier's thread."""

    def __init__(self) -> None:
        self._news = threading.Condition()
        self._state: dict[int, int] = {}
        self._restarted: set[int] = set()

    def on_heartbeat(self, can_id: int, data: bytes, _timestamp: float) -> None:
        """canopen callback; a frame that is not one byte is no heartbeat."""
        if len(data) != 1:
            return
        with self._news:
            self._state[can_id - 0x700] = data[0] & 0x7F
            if data[0] == STATE_BOOT_UP:
                self._restarted.add(can_id - 0x700)
            self._news.notify_all()

    def forget(self, node: int) -> None:
        """What was heard so far does not count."""
        with self._news:
            self._state.pop(node, None)
            self._restarted.discard(node)

    def restarted(self, node: int) -> bool:
        """A boot-up message came since `forget`."""
        with self._news:
            return node in self._restarted

    def wait(self, node: int, wanted: int | None, timeout_s: float) -> int | None:
        """Newest state once it is `wanted` (None: any), or what it is after `timeout_s`."""

        def arrived() -> bool:
            state = self._state.get(node)
            return state is not None and (wanted is None or state == wanted)

        with self._news:
            self._news.wait_for(arrived, timeout_s)
            return self._state.get(node)


class _BusErrors(can.Listener):  # type: ignore[misc]
    """Keeps canopen's receiving thread from dying with a traceback, and the reason for the message."""

    def __init__(self) -> None:
        self.last: Exception | None = None

    def on_message_received(self, msg: can.Message) -> None:
        """Nothing: canopen's own listener does it."""

    def on_error(self, exc: Exception) -> None:
        """Keep the reason; a failing recv returns at once, so wait a little."""
        self.last = exc
        time.sleep(NOTIFIER_S)


def boot(request: BootRequest, bus: can.BusABC | None = None) -> BootReport:
    """Boot all nodes of the request, in its order; `bus` is for tests. Raises BootError."""
    started = time.monotonic()
    network = canopen.Network()
    network.bus = open_bus(request) if bus is None else bus
    network.NOTIFIER_CYCLE = NOTIFIER_S
    errors = _BusErrors()
    network.listeners.append(errors)
    try:
        network.connect()
        nodes = _boot_nodes(network, request)
    except BootError as error:
        if errors.last is not None:
            raise _bus_error(request.bus, errors.last) from error
        raise
    except (can.CanError, OSError) as error:
        raise _bus_error(request.bus, error) from error
    finally:
        _close(network)
    return BootReport(nodes, time.monotonic() - started)


def _boot_nodes(network: canopen.Network, request: BootRequest) -> dict[int, BootedNode]:
    heartbeats = _Heartbeats()
    syncs: list[float] = []
    listening_since = time.monotonic()
    if request.check_foreign_sync:
        network.subscribe(request.settings.sync_cob_id, lambda _id, _data, stamp: syncs.append(stamp))
    # Before anything is sent: a second daemon must not disturb the one that runs.
    _require_no_sync(request, syncs, listening_since)
    booted = {}
    for profile in request.profiles:
        node = profile.node_id
        network.subscribe(0x700 + node, heartbeats.on_heartbeat)
        # A running node would refuse to be re-mapped, and a stopped one does not answer SDO.
        network.send_message(0, [NMT_PRE_OPERATIONAL, node])
        procedure = NodeBoot(NodeSdo(network, node, request.answer_timeout_s), profile, request.settings)
        device_type = procedure.check_device_type()
        heartbeats.forget(node)  # a boot-up message up to its first answer is its own start
        booted[node] = procedure.run(device_type)
    wait_s = max(3 * request.settings.heartbeat_ms, 100) * 1e-3
    for node in booted:
        _require_heartbeat(heartbeats, node, wait_s)
    _require_no_sync(request, syncs, listening_since)
    for node in booted:
        network.send_message(0, [NMT_START, node])
    for node in booted:
        _require_operational(network, heartbeats, node, wait_s)
    return booted


def _require_heartbeat(heartbeats: _Heartbeats, node: int, wait_s: float) -> None:
    """Start of error control: the node is heard before it is started."""
    if heartbeats.wait(node, None, wait_s) is None:
        detail = f"no heartbeat {0x700 + node:03X}h within {wait_s:g} s"
        raise BootError(node, "1017h:0", expected="heartbeat", found="none", letter="K", detail=detail)
    if heartbeats.restarted(node):
        raise reset_during_boot(node)


def _require_operational(network: canopen.Network, heartbeats: _Heartbeats, node: int, wait_s: float) -> None:
    """The node says operational, if need be after a second start.

    A drive may still watch the heartbeat of a jtqd that ended a moment ago: not every device begins anew when 1016h is
    written. When that runs out it leaves operational (1029h), rightly, as it had no master; but it does so once.
    """
    state = heartbeats.wait(node, STATE_OPERATIONAL, wait_s)
    if state == STATE_PRE_OPERATIONAL and not heartbeats.restarted(node):
        network.send_message(0, [NMT_START, node])
        state = heartbeats.wait(node, STATE_OPERATIONAL, wait_s)
    if heartbeats.restarted(node):
        raise reset_during_boot(node)
    if state != STATE_OPERATIONAL:
        found = _STATE_NAMES.get(state, f"state {state}") if state is not None else "no heartbeat"
        detail = f"NMT start: expected operational within {wait_s:g} s, found {found}"
        raise BootError(node, "NMT state", expected="operational", found=found, detail=detail)


def _require_no_sync(request: BootRequest, syncs: list[float], since: float) -> None:
    """A second SYNC producer would make every input's cycle ambiguous."""
    if not request.check_foreign_sync:
        return
    time.sleep(max(0.0, since + SYNC_LISTEN_S - time.monotonic()))
    if syncs:
        where = f"COB-ID {request.settings.sync_cob_id:03X}h"
        detail = f"another SYNC producer is on the bus ({where}, {len(syncs)} frames during boot)"
        raise BootError(None, where, expected="no SYNC", found=f"{len(syncs)} frames", detail=detail)


def open_bus(request: BootRequest) -> can.BusABC:
    """A bus that receives the answers of the nodes and SYNC, and nothing else. Raises BootError."""
    identifiers = [base + profile.node_id for profile in request.profiles for base in (0x580, 0x700)]
    if request.check_foreign_sync:
        identifiers.append(request.settings.sync_cob_id)
    # "extended": False puts CAN_EFF_FLAG into the mask: canopen takes 29-bit frames for 11-bit ones
    mask = CAN_SFF_MASK | CAN_RTR_FLAG
    filters = [{"can_id": cob_id, "can_mask": mask, "extended": False} for cob_id in identifiers]
    try:
        if request.bus.startswith(_UNIX):
            from drivers.python_can_unix import UnixBus

            return UnixBus(channel=request.bus.removeprefix(_UNIX), can_filters=filters)
        return can.Bus(interface="socketcan", channel=request.bus, can_filters=filters)
    except (can.CanError, OSError) as error:
        raise _bus_error(request.bus, error) from error


def _bus_error(bus: str, error: Exception) -> BootError:
    return BootError(None, bus, expected="a bus", found=str(error), detail=f"bus {bus}: {error}")


def _close(network: canopen.Network) -> None:
    try:
        network.disconnect()
    except Exception as error:
        # disconnect() re-raises what the receiving thread met; that has been reported already
        logging.getLogger(__name__).debug("closing the network: %s", error)


def main() -> int:
    """Request on stdin, report on stdout, exit status 0 or 1; never a traceback."""
    logging.getLogger("canopen").setLevel(logging.CRITICAL)  # what it logs as error is in the report
    logging.getLogger("can").setLevel(logging.CRITICAL)
    try:
        request = parse_request(json.load(sys.stdin))
        report = boot(request).as_json()
        if request.own_eds is not None:
            entries = read_eds(request.own_eds, request.settings.master_node)
            report["own_entries"] = entries_to_json(entries)
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
    return 0 if report["ok"] else 1


if __name__ == "__main__":
    sys.exit(main())
