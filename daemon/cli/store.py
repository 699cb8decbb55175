"""`jtq control store`: let one device keep its parameters (CiA 301, 1010h:1), on a bus without a master."""

from __future__ import annotations

import json
import sys
from typing import Final

from jtqd.daemon.cli.confirm import NotConfirmed, confirm
from jtqd.drivers.frame_socket import BusError
from jtqd.drivers.sdo import SdoAbort
from jtqd.drivers.sdo_client import SdoTimeout
from jtqd.drivers.survey import BusSurvey

VERB: Final = "store"
_STORE: Final = (0x1010, 1)
_SAVE: Final = b"save"
_ON_COMMAND: Final = 1
"""Bit of 1010h:1: the device saves on command."""
_PATIENCE_S: Final = 10.0
"""A device may write its flash memory for seconds before it answers; the write is not repeated meanwhile."""


def store(bus: str, node: int, *, yes: bool, as_json: bool) -> int:
    """Ask, write, print; returns the exit status."""
    try:
        reader = BusSurvey(bus)
        try:
            _store(reader, bus, node, yes)
        finally:
            reader.close()
    except NotConfirmed as error:
        return _failed(str(error), as_json, 2)
    except (BusError, ValueError) as error:
        return _failed(str(error), as_json, 1)
    print(
        json.dumps({"ok": True, "node": node})
        if as_json
        else f"node {node} on {bus} has stored its parameters"
    )
    return 0


def _failed(text: str, as_json: bool, status: int) -> int:
    if as_json:
        print(json.dumps({"ok": False, "error": text}))
    print(f"jtq control: {VERB}: {text}", file=sys.stderr)
    return status


def _store(reader: BusSurvey, bus: str, node: int, yes: bool) -> None:
    """Raises NotConfirmed, BusError, ValueError: the reason in one line."""
    try:
        does = int.from_bytes(reader.access(node).read(*_STORE)[:4], "little")
    except SdoTimeout:
        raise ValueError(f"node {node} does not answer on {bus}") from None
    except SdoAbort as error:
        raise ValueError(f"node {node}: 1010h:1 store parameters: {error}") from None
    if not does & _ON_COMMAND:
        raise ValueError(f"node {node}: 1010h:1 is 0x{does:08X}: it does not save on command")
    confirm(f"node {node} on {bus}: store all its parameters as they are now (1010h:1)", yes)
    try:
        reader.access(node, _PATIENCE_S).write(*_STORE, _SAVE)
    except SdoTimeout:
        raise ValueError(
            f"node {node}: 1010h:1: no answer within {_PATIENCE_S:g} s: it may have stored or not"
        ) from None
    except SdoAbort as error:
        raise ValueError(f"node {node}: 1010h:1: {error}") from None
