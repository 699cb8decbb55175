"""Object dictionary entries of the bench's nodes from their EDS files, read in a child process.

canopen's EDS parser takes 20 MB, which the bench would keep for good. A child (`python -m jtqd.sim_can.eds_entries`) reads
the files and prints the entries as JSON while this process loads everything else.
"""

import json
import subprocess
import sys
from pathlib import Path

from jtqd.drivers import eds
from jtqd.drivers.object_dictionary import Entry, entries_from_json, entries_to_json, read_eds

FOLDER = Path(eds.__file__).parent
FILES = {1: "drive.eds", 2: "drive.eds", 3: "torque_sensor.eds"}
_CHILD_S = 20.0
_cache: dict[int, list[Entry]] = {}


def entries_of(node: int) -> list[Entry]:
    """Return the entries of node 1, 2 or 3: those a child has read, else read here and kept."""
    if node not in _cache:
        _cache[node] = read_eds(FOLDER / FILES[node], node)
    return _cache[node]


class EdsChild:
    """Child process that reads the EDS files; start it early, `take` its result before the nodes are made."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "jtqd.sim_can.eds_entries"],
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
        if self._process.returncode == 0:
            for node, rows in json.loads(output).items():
                _cache[int(node)] = entries_from_json(rows)

    def stop(self) -> None:
        """End the child without its result."""
        self._process.kill()
        self._process.communicate()


def main() -> int:
    """Print the entries of all nodes as one JSON object."""
    print(json.dumps({node: entries_to_json(entries_of(node)) for node in FILES}))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
