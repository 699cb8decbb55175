"""Judge jtqd itself on the measured runs: played on a CAN bus, estimated at 1 kHz, scored from what it published.

    python -m sysid.measured_bus --bus unix:PATH --out DIR [--json]
    python -m sim_can.bench_kernel run --time-travel --out DIR -- python -m sysid.measured_bus --bus vcan0 --out DIR

For both runs, before and after fitting friction on the other run: the run is played by `jtq sim --play` as the
PDOs of two drives and a sensor, jtqd runs against it and records, and the log is compared with the sensor
that came over the bus (filtered like the estimate) and with the estimate made offline from the file.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from daemon.logs.reader import LogError
from estimator.checked import ConfigError
from estimator.run import RunTableError
from models.files import shipped
from sim_can.run_files import ColumnMap, RunError, read_run
from sysid.figure_parts import draw_each_joint
from sysid.measured import JOINTS, RUNS
from sysid.measured_bus_score import BusRun, Played, as_mapping, configured, score_log

AFTER_END_S = 0.3  # jtqd goes on for so long without inputs: what it then says is part of the result
_READY = "bench ready"
_PLAY_PRIORITY = 70
_START_S = 60.0
_END_S = 120.0


class PlayError(RuntimeError):
    """The play or jtqd failed; one line with what it said."""


def config_file(run: str, after: bool) -> Path:
    """Configuration of jtqd for a played run: joint files as shipped, or fitted on the other run."""
    other = RUNS[1 - RUNS.index(run)]
    return shipped(
        f"kinova_gen3/jtqd_after.fitted_on_{other}.yaml" if after else "kinova_gen3/jtqd_before.yaml"
    )


@contextmanager
def playing(bus: str, run: Path, said: Path) -> Iterator[subprocess.Popen[bytes]]:
    """`jtq sim --play` on the bus, ready; ended with the context. Its log goes to `said`. Raises PlayError."""
    joints = ",".join(str(number) for number in JOINTS)
    command = [sys.executable, "-m", "sim_can", "--bus", bus, "--play", str(run), "--joints", joints]
    read_end, write_end = os.pipe()
    with said.open("wb") as log, os.fdopen(read_end, "rb") as pipe:
        process = subprocess.Popen(command, stderr=write_end, stdin=subprocess.DEVNULL)
        os.close(write_end)
        try:
            for line in pipe:
                log.write(line)
                if line.startswith(_READY.encode()):
                    break
            else:
                raise PlayError(
                    f"the play ended with exit status {process.wait(_START_S)}: {_tail(said, log)}"
                )
            _prefer(process.pid)
            yield process
        finally:
            if process.poll() is None:
                process.terminate()
            process.wait(_START_S)
            log.write(pipe.read())


def _prefer(pid: int) -> None:
    """A drive answers SYNC whatever else this machine does: real-time priority below jtqd's loop, where allowed."""
    try:
        os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(_PLAY_PRIORITY))
    except PermissionError:
        print("measured: the play has no real-time priority (not permitted)", file=sys.stderr, flush=True)


def _tail(said: Path, log: Any) -> str:
    log.flush()
    return (said.read_text(errors="replace").strip().splitlines() or ["it said nothing"])[-1]


def record(bus: str, run: Path, config: Path, length_s: float, out: Path) -> tuple[Path, dict[str, Any]]:
    """Play a run, run jtqd against it, return the log and jtqd's summary. Raises PlayError.

    jtqd outlives the run by AFTER_END_S, and the play must then have ended by itself with exit status 0.
    """
    out.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "daemon.jtqd", "--bus", bus, "--config", str(config)]
    command += ["--record", str(out), "--duration", f"{length_s + AFTER_END_S:.3f}", "--json"]
    with playing(bus, run, out / "play.log") as play:
        try:
            done = subprocess.run(
                command,
                capture_output=True,
                text=True,
                stdin=subprocess.DEVNULL,
                timeout=length_s + _END_S,
                check=False,
            )
            status = play.wait(_START_S) if done.returncode in (0, 3) else 0
        except subprocess.TimeoutExpired as error:
            raise PlayError(f"did not end in {error.timeout:.0f} s: {error.cmd}") from None
    (out / "jtqd.log").write_text(done.stderr)
    if done.returncode not in (0, 3):  # 3: done, with cycles missing in the log
        said = (done.stderr or done.stdout).strip().splitlines() or ["it said nothing"]
        raise PlayError(f"jtqd ended with exit status {done.returncode}, see {out / 'jtqd.log'}: {said[-1]}")
    if status:
        raise PlayError(f"the play ended with exit status {status}, see {out / 'play.log'}")
    summary = json.loads(done.stdout)
    path = (summary.get("recording") or {}).get("path")
    if not path:
        raise PlayError(f"jtqd recorded nothing: {summary.get('recording')}")
    return Path(path), summary


def evaluate(bus: str, out: Path) -> list[BusRun]:
    """All runs, before and after, both joints. Logs stay in `out`."""
    columns = ColumnMap.load(shipped("kinova_gen3/columns.yaml"))
    results: list[BusRun] = []
    for run in RUNS:
        path = shipped(f"kinova_gen3/{run}.csv.gz")
        table = read_run(path, columns).table
        length_s = float(table.time_s[-1] - table.time_s[0])
        for after in (False, True):
            name = "after" if after else "before"
            print(f"measured: playing {run} on {bus}, {name} the fit", file=sys.stderr, flush=True)
            config = config_file(run, after)
            log, _ = record(bus, path, config, length_s, out / f"{run}.{name}")
            joints, settings = configured(config)
            results += [
                score_log(log, index, Played(number, run, name, table, joint, settings))
                for index, (number, joint) in enumerate(zip(JOINTS, joints, strict=True))
            ]
    return results


def table_lines(results: list[BusRun]) -> list[str]:
    """One line per joint, run and configuration."""
    lines = [
        f"{'joint':>5}  {'run':<20}{'config':<8}{'rows':>6}{'missed':>8}{'incomplete':>12}{'scored':>8}"
        f"{'on the bus':>18}{'offline':>10}{'bus-offline':>13}{'replay':>10}  after the end"
    ]
    lines.extend(
        f"{r.joint:>5}  {r.run:<20}{r.config:<8}{r.rows:>6}{r.missed:>8}{r.incomplete:>12}{r.scored:>8}"
        f"{r.rmse_nm:9.3f} ({100.0 * r.rmse_nm / r.rated_nm:4.1f} %){r.offline_rmse_nm:10.3f}"
        f"{r.offline_difference_nm:13.3f}{r.replay_difference_nm:10.1g}"
        f"  {'stale, no torque' if r.silent_after_end else 'NOT SILENT'}"
        for r in results
    )
    return lines


def main(arguments: list[str] | None = None) -> int:
    """Command line; results on stdout, log on stderr. Exit status 0 done, 1 failure, 2 usage."""
    parser = argparse.ArgumentParser(
        prog="jtq measured --bus",
        description="Play the Kinova Gen3 runs on a CAN bus, run jtqd against them and score what it published.",
        epilog="example: jtq measured --bus vcan0 --out /tmp/measured   (exact time: docs/measured_runs.md)",
    )
    parser.add_argument("--bus", help="vcan0 or unix:PATH (default: a unix bus of its own)")
    parser.add_argument("--out", type=Path, required=True, help="folder for the figures and jtqd's logs")
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    options = parser.parse_args(arguments)
    return run(options.bus, options.out, options.json)


def run(bus: str | None, out: Path, as_json: bool) -> int:
    """Play, score, draw and print; None is a unix bus of its own. Returns the exit status."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="jtqd-") as folder:
            results = evaluate(bus or f"unix:{folder}/bus", out)
        draw_each_joint(JOINTS, results, out / "measured_bus_joint{}.png", _draw_joint)
    except (RunError, RunTableError, ConfigError, LogError, PlayError, OSError) as error:
        print(f"measured: {error}", file=sys.stderr)
        return 1
    if as_json:
        print(
            json.dumps({"schema": "jtq.measured_bus/1", "runs": [as_mapping(r) for r in results]}, indent=1)
        )
    else:
        print("RMSE of the published estimate against the arm's torque sensor; differences in Nm")
        print("\n".join(table_lines(results)))
    return 0


def _draw_joint() -> Callable[[Sequence[BusRun], Path], None]:
    from sysid.measured_bus_figures import draw_joint

    return draw_joint


if __name__ == "__main__":
    sys.exit(main())
