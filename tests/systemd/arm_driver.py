"""Runs in the bench kernel under systemd: an arm of seven joints, four instances of the unit, one for each interface.

    arm_driver.py ROOT ENVIRONMENT

Standard library only. Installs all four at once, starts them with the configurations of examples/arm, asks each for its
status, stops one, then the others. Prints one JSON line; what does not come out as it should ends it with a traceback.
"""

import json
import re
import subprocess
import sys
import time
from pathlib import Path

JOINTS = {"vcan0": 2, "vcan1": 2, "vcan2": 2, "vcan3": 1}
PERIOD_US = 20_000
"""Long enough that four daemons and four benches are little work on a shared machine."""
WITH_INPUTS = {"valid", "degraded", "standstill"}
BENCH = """
[Service]
ExecStart=/opt/jtqd/bin/jtq sim --bus %i --drives {joints} --seed {seed}
"""


def run(*command, check=True, timeout=180):
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    if check and done.returncode != 0:
        raise AssertionError(f"{' '.join(command)}: status {done.returncode}\n{done.stdout}{done.stderr}")
    return done


def show(bus, name):
    return run("systemctl", "show", f"jtqd@{bus}", "-p", name, "--value").stdout.strip()


def install(root, environment):
    Path("/opt/jtqd").mkdir(parents=True)
    run("mount", "--bind", environment, "/opt/jtqd")
    interfaces = [word for bus in JOINTS for word in ("--interface", bus)]
    run("/bin/sh", f"{root}/systemd/install.sh", "--prepared", *interfaces)
    for number, (bus, joints) in enumerate(JOINTS.items()):
        text = Path(root, f"examples/arm/can{number}.yaml").read_text()
        text = text.replace("../../models/", "").replace("budget_mb: 20000", "reserve_mb: 1, budget_mb: 1000")
        text += f"sync: {{period_us: {PERIOD_US}}}\ninputs: {{wait_us: 8000, deadline_us: 17000}}\n"
        Path(f"/etc/jtqd/{bus}.yaml").write_text(text)
        unit = BENCH.replace("%i", bus).format(joints=joints, seed=number + 1)
        Path(f"/run/systemd/system/bench-{bus}.service").write_text(unit)
    run("systemctl", "daemon-reload")


def status(bus):
    """What `jtq status --json` says of one instance; None while it has none."""
    done = run("/opt/jtqd/bin/jtq", "status", "--bus", bus, "--json", check=False)
    return json.loads(done.stdout) if done.returncode == 0 else None


def shown(bus):
    """States of the joints in the line of `systemctl status`: "joint 1: valid, joint 2: valid"."""
    return re.findall(r"joint \d+: (\w+)", show(bus, "StatusText"))


def estimating(bus, seconds=60):
    """Wait until every joint of the instance has its inputs; return their states."""
    began = time.monotonic()
    while time.monotonic() - began < seconds:
        states = shown(bus)
        if len(states) == JOINTS[bus] and set(states) <= WITH_INPUTS:
            return states
        time.sleep(0.5)  # each look is a process
    raise AssertionError(
        f"{bus}: no estimate of {JOINTS[bus]} joints in {seconds} s: {show(bus, 'StatusText')}"
    )


def main(root, environment):
    install(root, environment)
    benches, units = [f"bench-{bus}" for bus in JOINTS], [f"jtqd@{bus}" for bus in JOINTS]
    run("systemctl", "start", *(f"can-up@{bus}" for bus in JOINTS), *benches)
    began = time.monotonic()
    run("systemctl", "start", *units)  # Type=notify: returns when all four are ready
    ready = time.monotonic() - began
    states = {bus: estimating(bus) for bus in JOINTS}
    asked = {bus: [each["status"] for each in status(bus)["joints"]] for bus in JOINTS}
    # One that is stopped takes none with it.
    run("systemctl", "stop", "jtqd@vcan2")
    rest = {bus: estimating(bus) for bus in JOINTS if bus != "vcan2"}
    gone = status("vcan2")
    directories = sorted(path.name for path in Path("/run/jtqd").iterdir())
    pids = {show(bus, "MainPID") for bus in JOINTS}
    run("systemctl", "stop", *units)
    logs = {bus: len(list(Path("/var/log/jtqd").glob(f"jtqd-{bus}-*.mcap"))) for bus in JOINTS}
    results = {bus: show(bus, "Result") for bus in JOINTS}
    print(
        json.dumps(
            {
                "ready_s": ready,
                "states": states,
                "asked": asked,
                "processes": len(pids - {"0"}),
                "rest": rest,
                "gone": gone,
                "directories": directories,
                "logs": logs,
                "results": results,
            }
        ),
        flush=True,
    )
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(*sys.argv[1:]))
    except BaseException:
        print(
            run("journalctl", "-u", "jtqd@*", "-u", "bench-*", "--no-pager", "-n", "80", check=False).stdout,
            file=sys.stderr,
        )
        raise
