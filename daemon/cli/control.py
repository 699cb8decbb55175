"""`jtq control`: send an order to a running jtqd, over the socket that only its own user and root may open."""

from __future__ import annotations

import argparse
import json
import socket
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

from jtqd.daemon.cli.running import NoDaemonError, choose_daemon
from jtqd.daemon.supervisor.control import FILE, REPLY_BYTES, VERBS
from jtqd.drivers.bus_socket import reachable
from jtqd.estimator.command_line import command_parser
from jtqd.estimator.decoder import parse_json
from jtqd.estimator.files import peer_user, trusted_users
from jtqd.estimator.text import NOTHING

_TIMEOUT_S = 10.0
_EXAMPLES = """examples:
  jtq control ping                     check that the daemon and its supervisor answer
  jtq control reset                    release latched faults
  jtq control save --json              write the flight recording now

exit status: 0 done, 1 refused or no daemon (reason on standard error), 2 usage"""
_DONE = {
    "ping": "jtqd on {bus} answers, process {pid}, cycle {cycle}",
    "reset": "jtqd on {bus} has released its latched faults: {released}",
    "save": "jtqd on {bus} writes the flight recording",
}


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq control`."""
    result = command_parser(
        "jtq control", "Send an order to a running jtqd. Only its own user and root are permitted.", _EXAMPLES
    )
    result.add_argument("verb", choices=VERBS, help="order")
    result.add_argument("--bus", help="daemon on this bus (default: the only running one)")
    result.add_argument("--json", action="store_true", help="print the reply as JSON")
    return result


def main(argv: list[str]) -> int:
    """Send the order and print the reply; returns the exit status."""
    arguments = parser().parse_args(argv)
    bus = ""
    try:
        daemon = choose_daemon(arguments.bus)
        bus = daemon.about.bus
        reply = ask(daemon.directory / FILE, {"verb": arguments.verb}, _TIMEOUT_S)
    except (FileNotFoundError, ConnectionRefusedError):
        reply = {"ok": False, "error": "jtqd accepts no orders now: it is starting or ending"}
    except TimeoutError:
        reply = {"ok": False, "error": "jtqd did not answer in time"}
    except (NoDaemonError, OSError, ValueError) as error:
        reply = {"ok": False, "error": getattr(error, "strerror", None) or str(error)}
    if arguments.json:
        print(json.dumps(reply))
    elif reply["ok"]:
        print(_DONE[arguments.verb].format_map(defaultdict(lambda: NOTHING, {"bus": bus} | reply)))
    if not reply["ok"]:
        print(f"jtq control: {arguments.verb}: {reply.get('error', NOTHING)}", file=sys.stderr)
    return 0 if reply["ok"] else 1


def ask(path: Path, request: dict[str, Any], timeout_s: float) -> dict[str, Any]:
    """Send one request, wait for the reply. Raises OSError (no daemon, not allowed, no answer), ValueError."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sock:
        sock.settimeout(timeout_s)
        with reachable(path) as address:
            sock.connect(address)
        if (user := peer_user(sock)) not in trusted_users():
            raise ConnectionError(f"{path}: found that user {user} answers there, expected the daemon's")
        sock.send(json.dumps(request).encode())
        data = sock.recv(REPLY_BYTES)
    if not data:
        raise ConnectionError(f"{path}: jtqd closed the connection without a reply")
    reply = parse_json(data)
    if not isinstance(reply, dict) or not isinstance(reply.get("ok"), bool):
        raise ValueError(f"{path}: found a reply without 'ok', expected a JSON object with it")
    return reply


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
