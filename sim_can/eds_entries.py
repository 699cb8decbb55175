"""Object dictionary entries of the bench's nodes from their EDS files.

canopen's EDS parser takes 20 MB, which the bench would keep for good. A child (`python -m jtqd.sim_can.eds_entries DRIVES`)
reads the files and prints the entries as JSON while this process loads everything else.
"""

import json
import subprocess
import sys
from pathlib import Path

from jtqd.drivers import object_dictionary
from jtqd.drivers.object_dictionary import Entry, entries_from_json, entries_to_json, read_eds

FOLDER = Path(object_dictionary.__file__).parent / "eds"
DRIVE, SENSOR = "drive.eds", "torque_sensor.eds"
_CHILD_S = 20.0
_cache: dict[tuple[int, str], list[Entry]] = {}


def sensor_node(drives: int) -> int:
    """Return the node-ID of the sensor of a bench with so many drives, whose node-IDs are 1, 2, ..."""
    return 3 if drives <= 2 else 5


def files_of(drives: int) -> dict[int, str]:
    """Return the EDS file of each node of a bench."""
    return dict.fromkeys(range(1, drives + 1), DRIVE) | {sensor_node(drives): SENSOR}


def entries_of(node: int, file: str) -> list[Entry]:
    """Return the entries of a node: those a child has read, else read here and kept."""
    if (node, file) not in _cache:
        _cache[node, file] = list(read_eds(FOLDER / file, node).entries)
    return _cache[node, file]


class EdsChild:
    """Child process that reads the EDS files; start it early, `take` its result before the nodes are made."""

    def __init__(self, drives: int = 2) -> None:
        self._files = files_of(drives)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "jtqd.sim_can.eds_entries", str(drives)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )

    def take(self) -> None:
        """Give the child's entries to `entries_of`; if the child failed they are read in this process."""
        try:
            output, _ = self._process.communicate(timeout=_CHILD_S)
        except subprocess.TimeoutExpired:
            self.stop()
            return
        try:
            found = json.loads(output) if self._process.returncode == 0 else {}
        except ValueError:  # a child that was stopped in its output has lost a part of it
            return
        for node, rows in found.items():
            _cache[int(node), self._files[int(node)]] = entries_from_json(rows)

    def stop(self) -> None:
        """End the child without its result."""
        self._process.kill()
        self._process.communicate()


def main() -> int:
    """Print the entries of all nodes of a bench with `sys.argv[1]` drives as one JSON object."""
    files = files_of(int(sys.argv[1]))
    print(json.dumps({node: entries_to_json(entries_of(node, file)) for node, file in files.items()}))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
