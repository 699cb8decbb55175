"""`start`: from exec of `jtqd --bus sim` to its first estimate on the bus, and the memory of all its processes."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from jtqd.daemon.core.estimate_pdo import LAYOUT
from jtqd.daemon.shared.runtime_dir import instance_name
from jtqd.drivers.bus_socket import exact
from jtqd.drivers.frame_socket import BusError, FrameSocket, open_frame_socket
from jtqd.estimator.status import PUBLISHED
from tests.benchmarks.contender import ROOT
from tests.benchmarks.measure import mark, table
from tests.processes import family

START_LIMIT_S, MEMORY_LIMIT_MB = 2.0, 120.0
_ESTIMATE_ID = 0x1A0
_TIMEOUT_S = 30.0
_SETTLE_S = 1.0


def run(directory: Path, *, duration_s: float = 4.0) -> dict[str, Any]:
    """Start the daemon once, its files in `directory`. Raises RuntimeError when it does not come up."""
    environment = {key: value for key, value in os.environ.items() if key != "RUNTIME_DIRECTORY"}
    environment |= {"XDG_RUNTIME_DIR": str(directory), "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}"}
    command = [
        sys.executable,
        "-P",
        "-m",
        "jtqd.daemon.jtqd",
        "--bus",
        "sim",
        "--duration",
        f"{duration_s:g}",
    ]
    command += ["--record", str(directory / "log")]
    path = directory / f"jtqd-{os.getuid()}-{instance_name('sim')}" / "bus"
    started = time.monotonic()
    with open(directory / "jtqd.err", "w+", encoding="utf-8") as errors:
        daemon = subprocess.Popen(
            command, env=environment, cwd=directory, stdout=subprocess.PIPE, stderr=errors
        )
        try:
            bus_s, first_s, estimate_s = _first_estimates(daemon, path, started)
            time.sleep(_SETTLE_S)
            memory = {pid: _memory(pid) for pid in family(daemon.pid)}
        except RuntimeError as error:
            errors.seek(0)
            raise RuntimeError(f"{error}: {errors.read().strip()[-400:]}") from None
        finally:
            with contextlib.suppress(subprocess.TimeoutExpired):
                daemon.wait(duration_s + 10.0)
            daemon.kill()
            daemon.wait()
    processes = [each for each in memory.values() if each is not None]
    return {
        "bus_s": bus_s,
        "first_pdo_s": first_s,
        "first_estimate_s": estimate_s,
        "exit_status": daemon.returncode,
        "processes": processes,
        "rss_mb": sum(each["rss_mb"] for each in processes),
        "pss_mb": sum(each["pss_mb"] for each in processes),
        "torch": any(each["torch"] for each in processes),
    }


def _first_estimates(
    daemon: subprocess.Popen[bytes], path: Path, started: float
) -> tuple[float, float, float]:
    """Seconds from the start to the bus, to the first estimate PDO, and to the first with a torque for both joints."""
    socket = _listen(daemon, path, started)
    bus_s = time.monotonic() - started
    first_s = None
    try:
        while time.monotonic() < started + _TIMEOUT_S:
            if not socket.wait(0.1):
                _alive(daemon)
            for n in range(socket.receive()):
                first_s = first_s or time.monotonic() - started
                status = LAYOUT.unpack_from(socket.frames, 16 * n + 8)[4]
                if status & 0x0F in PUBLISHED and status >> 4 in PUBLISHED:
                    return bus_s, first_s, time.monotonic() - started
    except BusError as error:
        raise RuntimeError(f"bus lost: {error}") from None
    finally:
        socket.close()
    raise RuntimeError(f"no estimate with a torque within {_TIMEOUT_S:g} s")


def _listen(daemon: subprocess.Popen[bytes], path: Path, started: float) -> FrameSocket:
    while time.monotonic() < started + _TIMEOUT_S:
        _alive(daemon)
        try:
            return open_frame_socket(f"unix:{path}", [exact(_ESTIMATE_ID)])
        except BusError:
            time.sleep(0.002)
    raise RuntimeError(f"no bus at {path} within {_TIMEOUT_S:g} s")


def _alive(daemon: subprocess.Popen[bytes]) -> None:
    if daemon.poll() is not None:
        raise RuntimeError(f"jtqd ended with exit status {daemon.returncode}")


def _memory(pid: int) -> dict[str, Any] | None:
    """Resident and proportional size, and whether torch is mapped; None when the process has ended."""
    try:
        rollup = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="utf-8")
        maps = Path(f"/proc/{pid}/maps").read_text(encoding="utf-8")
        arguments = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    except OSError:
        return None
    sizes = {}
    for line in rollup.splitlines()[1:]:
        name, _, rest = line.partition(":")
        sizes[name] = int(rest.split()[0]) / 1024.0
    module = arguments[arguments.index(b"-m") + 1] if b"-m" in arguments else arguments[0]
    return {"name": module.decode(), "rss_mb": sizes["Rss"], "pss_mb": sizes["Pss"], "torch": "torch" in maps}


def text(result: dict[str, Any]) -> str:
    rows = [[each["name"], f"{each['rss_mb']:.1f}", f"{each['pss_mb']:.1f}"] for each in result["processes"]]
    rows.append(["together", f"{result['rss_mb']:.1f}", f"{result['pss_mb']:.1f}"])
    return "\n".join(
        [
            "Start of `jtqd --bus sim` and its memory",
            "",
            table(["process", "RSS MB", "PSS MB"], rows),
            "",
            f"bus after                       {result['bus_s']:6.2f} s",
            f"first estimate PDO after        {result['first_pdo_s']:6.2f} s",
            f"first estimate with torque      {result['first_estimate_s']:6.2f} s   "
            + mark(result["first_estimate_s"], START_LIMIT_S),
            f"resident memory, proportional   {result['pss_mb']:6.1f} MB",
            f"resident memory, plain sum      {result['rss_mb']:6.1f} MB  "
            + mark(result["rss_mb"], MEMORY_LIMIT_MB),
            f"torch loaded                    {'yes: over' if result['torch'] else 'no: PASS'}",
        ]
    )
