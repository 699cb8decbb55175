"""What the supervisor sees of the bus, as a small JSON file in the runtime directory: for `jtq status` and people.

`bus.json`, replaced as a whole twice a second:
    {"state": "error active", "counts": {2205h by name}, "foreign_nmt": 0,
     "nodes": {"1": {"heartbeat": "heard", "emcy": 2, "last_emcy": "EMCY 2310h (...)", "absent": false, "sdo": {...}}},
     "errors": [{"code": "8250h", "name": "RPDO timeout", "detail": "181h"}], "error_register": 17}
"""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daemon.master.bus_state import STATE_NAMES
from drivers.emcy import describe, name_of

if TYPE_CHECKING:
    from daemon.master.bus_service import BusService

FILE = "bus.json"
_HEARTBEATS = ("not watched", "awaited", "heard", "lost")


class BusReport:
    """Writes the file into `directory`; what cannot be written is left out, as nothing depends on it."""

    def __init__(self, directory: Path) -> None:
        self._path = directory / FILE
        self._new = directory / (FILE + ".new")
        self._last = ""

    def write(self, service: BusService) -> None:
        """Replace the file when something has changed."""
        text = json.dumps(content(service))
        if text == self._last:
            return
        with suppress(OSError):
            self._new.write_text(text, encoding="utf-8")
            self._new.chmod(0o640)
            self._new.replace(self._path)
            self._last = text


def content(service: BusService) -> dict[str, Any]:
    """The same as plain data."""
    nodes = {}
    for node, state in service.heartbeats.states().items():
        last = service.emergencies.last(node)
        nodes[str(node)] = {
            "heartbeat": _HEARTBEATS[state],
            "emcy": service.emergencies.count_of(node),
            "last_emcy": None if last is None else describe(last),
            "absent": node in service.care.absent,
            "sdo": service.care.sdo_counts(node),
        }
    errors = [
        {"code": f"{code:04X}h", "name": name_of(code), "detail": f"{detail:03X}h"}
        for code, detail in service.errors.all_present()
    ]
    return {
        "state": STATE_NAMES[service.bus.state],
        "counts": {name: value for name, value in service.bus.counts.items() if name != "state"},
        "foreign_nmt": service.foreign_nmt,
        "malformed_heartbeats": service.heartbeats.malformed,
        "nodes": nodes,
        "errors": errors,
        "error_register": service.errors.register,
    }
