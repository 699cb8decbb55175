"""Runs in the bench kernel under systemd: installs jtqd, starts it as a service and does to it what happens to services.

    systemd_driver.py ROOT WHEEL WHEELS STEP...

Standard library only. Prints one JSON line for each step: {"step", "seconds": {...}, "seen": {...}}; a step that does not
come out as it should ends it with a traceback, after the journal's lines.
"""

import json
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
import urllib.request
from contextlib import suppress
from pathlib import Path

UNIT, BUS = "jtqd@vcan0", "vcan0"
CONFIG = Path("/etc/jtqd/vcan0.yaml")
LOGS = Path("/var/log/jtqd")
GOOD = {0, 2, 3, 6}
"""Statuses of joints with inputs: off, valid, degraded, standstill."""
PERIOD_US = 5_000
"""Long enough that a minute of guest time is not a minute of work."""
BENCH = """
[Unit]
BindsTo=sys-subsystem-net-devices-vcan0.device
After=sys-subsystem-net-devices-vcan0.device can-up@vcan0.service
Wants=can-up@vcan0.service
[Service]
ExecStart=/opt/jtqd/bin/jtq sim --bus vcan0 --seed 1
Restart=always
RestartSec=200ms
[Install]
WantedBy=sys-subsystem-net-devices-vcan0.device
"""


def run(*command, check=True, timeout=180):
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    if check and done.returncode != 0:
        raise AssertionError(f"{' '.join(command)}: status {done.returncode}\n{done.stdout}{done.stderr}")
    return done


def show(name):
    return run("systemctl", "show", UNIT, "-p", name, "--value").stdout.strip()


def main_pid():
    return int(show("MainPID"))


def loops(exclude=()):
    """Process-IDs of loop processes."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            command = process.joinpath("cmdline").read_bytes().split(b"\0")
            if b"jtqd.daemon.loop.process" in command and int(process.name) not in exclude:
                found.append(int(process.name))
    return found


class Watch:
    """What is on the bus: SYNC, estimate, NMT."""

    def __init__(self):
        self.socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        filters = [(0x080, 0x7FF), (0x1A0, 0x7FF), (0x000, 0x7FF)]
        packed = b"".join(struct.pack("=II", *each) for each in filters)
        self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, packed)
        self.socket.bind((BUS,))

    def next(self, timeout):
        """(identifier, data) or None."""
        self.socket.settimeout(max(timeout, 0.001))
        try:
            can_id, length, data = struct.unpack("=IB3x8s", self.socket.recv(16))
        except TimeoutError:
            return None
        except OSError:  # the interface went down
            time.sleep(0.05)
            return None
        return can_id & 0x7FF, data[:length]

    def empty(self):
        while self.next(0.001) is not None:
            pass

    def close(self):
        self.socket.close()


def estimates(seconds, wanted=GOOD, count=20):
    """Time until `count` estimates in a row have these statuses [s]."""
    began, row, last = time.monotonic(), 0, None
    watch = Watch()
    try:
        while time.monotonic() - began < seconds:
            frame = watch.next(0.2)
            if frame is None or frame[0] != 0x1A0:
                continue
            last = (frame[1][6] & 0x0F, frame[1][6] >> 4)
            row = row + 1 if set(last) <= wanted else 0
            if row >= count:
                return time.monotonic() - began
    finally:
        watch.close()
    raise AssertionError(f"no {count} estimates with status {wanted} in {seconds} s; the last had {last}")


def until(condition, seconds, what):
    began = time.monotonic()
    while time.monotonic() - began < seconds:
        if condition():
            return time.monotonic() - began
        time.sleep(0.3)  # each look takes processes
    raise AssertionError(f"not within {seconds} s: {what}")


def active():
    return show("ActiveState") == "active"


def journal(lines=400):
    run("journalctl", "--sync", check=False)
    return run("journalctl", "-u", UNIT, "-o", "short-monotonic", "--no-pager", "-n", str(lines)).stdout


def restarts():
    return int(show("NRestarts"))


# Steps -------------------------------------------------------------------------------------------------------------------


def install(root, wheel, wheels):
    began = time.monotonic()
    script = f"{root}/systemd/install.sh"
    if wheel == "prepared":  # an environment that was made outside, where that is quicker
        Path("/opt/jtqd").mkdir(parents=True)
        run("mount", "--bind", wheels, "/opt/jtqd")
        arguments = ("--prepared", "--interface", BUS)
    else:
        arguments = (
            "--source",
            wheel,
            "--wheels",
            wheels,
            "--python",
            "/usr/bin/python3",
            "--interface",
            BUS,
        )
    reported = run("/bin/sh", script, *arguments).stdout
    seconds = time.monotonic() - began
    assert "jtqd 0." in reported, reported
    text = CONFIG.read_text()
    assert "period_us: 1000" in text
    text = text.replace("period_us: 1000", f"period_us: {PERIOD_US}")
    text = re.sub(r"(?m)^inputs:\n(  .*\n)+", "inputs: {wait_us: 2000, deadline_us: 4250}\n", text)
    text = re.sub(r"(?m)^recording:.*$", "recording: {ring_cycles: 4096, reserve_mb: 1}", text)
    CONFIG.write_text(text + "metrics: {file: metrics.prom}\n")
    Path("/run/systemd/system/bench.service").write_text(BENCH)
    run("systemctl", "daemon-reload")
    run("systemctl", "start", "can-up@vcan0")
    queue = Path(f"/sys/class/net/{BUS}/tx_queue_len").read_text().strip()
    assert queue == "1000", queue
    score = run("systemd-analyze", "security", UNIT, "--no-pager").stdout.splitlines()[-1]
    exposure = float(re.search(r"([0-9.]+) [A-Z]+", score).group(1))
    assert exposure <= 2.0, score
    return {"install": seconds}, {"exposure": exposure}


def start():
    run("systemctl", "start", "bench")
    began = time.monotonic()
    run("systemctl", "start", UNIT)  # Type=notify: returns when READY=1 has come
    ready = time.monotonic() - began
    assert active()
    estimates(30)
    # For the device to start them: only what is enabled comes back with it.
    run("systemctl", "enable", UNIT, "can-up@vcan0", "bench")
    policy = {}
    for pid in loops():
        policy[pid] = (os.sched_getscheduler(pid), os.sched_getparam(pid).sched_priority)
    assert list(policy.values()) == [(os.SCHED_FIFO, 80)], policy
    reported = journal()
    assert "not granted" not in reported, reported
    status = show("StatusText")
    assert "joint 1: " in status, status
    reply = control("ping")
    assert reply["ok"], reply
    assert reply["ready"], reply
    directory = runtime_directory()
    metrics = (directory / "metrics.prom").read_text()
    assert 'jtqd_cycles_total{bus="vcan0"}' in metrics, metrics
    assert oct((directory / "control").stat().st_mode & 0o777) == "0o600"
    nobody = control("ping", user="nobody", check=False)
    assert not nobody["ok"], nobody
    priorities = run("journalctl", "-u", UNIT, "-o", "json", "--no-pager").stdout.splitlines()
    levels = {json.loads(line).get("PRIORITY") for line in priorities}
    return {"to READY=1": ready}, {"status": status, "journal priorities": sorted(filter(None, levels))}


def runtime_directory():
    return next(Path("/run/jtqd/vcan0").glob("jtqd-*-vcan0"))


def control(verb, user=None, check=True):
    prefix = ("setpriv", "--reuid", user, "--regid", "nogroup", "--clear-groups") if user else ()
    done = run(*prefix, "/opt/jtqd/bin/jtq", "control", verb, "--bus", BUS, "--json", check=False)
    if check and done.returncode != 0:
        raise AssertionError(done.stdout + done.stderr)
    return json.loads(done.stdout)


def stopped_loop():
    """SIGSTOP: nobody feeds the watchdog."""
    before = restarts()
    (loop,) = loops()
    began = time.monotonic()
    os.kill(loop, signal.SIGSTOP)
    noticed = until(lambda: not active(), 15, "the watchdog notices a loop that stands still")
    until(lambda: restarts() == before + 1 and active(), 60, "a restart by the watchdog")
    ready = time.monotonic() - began
    estimates(30)
    assert "Watchdog timeout" in journal()
    assert loop not in loops()
    return {"noticed": noticed, "ready again": ready, "estimate again": time.monotonic() - began}, {}


def stopped_supervisor():
    """SIGSTOP: the loop goes on, and feeds no watchdog for a supervisor that does not turn."""
    before, pid, began = restarts(), main_pid(), time.monotonic()
    os.kill(pid, signal.SIGSTOP)
    noticed = until(lambda: not active(), 20, "the watchdog notices a supervisor that stands still")
    until(lambda: restarts() == before + 1 and active(), 60, "a restart by the watchdog")
    ready = time.monotonic() - began
    estimates(30)
    assert main_pid() != pid
    assert len(loops()) == 1, loops()
    return {"noticed": noticed, "ready again": ready}, {}


def wrong_configuration():
    """Of a unit that is stopped: exit status 2 and one line, and no restart, until somebody has put it right."""
    good, before = CONFIG.read_text(), restarts()
    CONFIG.write_text(good.replace("node_id: 32", "node_id: 300"))
    try:
        done = run("systemctl", "start", UNIT, check=False)
        assert done.returncode != 0
        time.sleep(3.0)  # six times RestartSec
        seen = {name: show(name) for name in ("ActiveState", "ExecMainStatus", "Result")}
        assert seen == {"ActiveState": "failed", "ExecMainStatus": "2", "Result": "exit-code"}, seen
        assert restarts() in (0, before), "a restart would fail again, twice a second"
        assert not loops()
        line = re.findall(r"jtqd: (.*node_id.*)", journal(40))[-1]
        assert "300" in line, line
        assert "Traceback" not in journal(40)
    finally:
        CONFIG.write_text(good)
    run("systemctl", "start", UNIT)
    estimates(30)
    run("systemctl", "stop", UNIT)
    return {}, {**seen, "reported": line}


def guest(root, configuration):
    """Beside a master of the canopen library that comes later and pauses: neither start nor watchdog waits for its SYNC."""
    good = CONFIG.read_text()
    CONFIG.write_text(Path(configuration).read_text().replace(f"{root}/models/", ""))
    python = ("/opt/jtqd/bin/python", f"{root}/tests/daemon/bus/library_master.py", "socketcan", BUS)
    master = subprocess.Popen(python, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def order(line):
        print(line, file=master.stdin, flush=True)
        assert master.stdout.readline().strip() in ("ready", line.split()[0])

    try:
        assert master.stdout.readline() == "ready\n"
        began = time.monotonic()
        run("systemctl", "start", UNIT)
        ready = time.monotonic() - began
        pid = main_pid()
        watch = Watch()
        watch.empty()
        time.sleep(6.0)  # three times WatchdogSec
        assert watch.next(0.1) is None, "a guest sends neither SYNC nor NMT, and no estimate without SYNC"
        watch.close()
        assert (active(), main_pid()) == (True, pid), journal()
        order(f"period {PERIOD_US * 1e-6}")
        order("boot")
        first = estimates(60, GOOD | {3})
        order("pause 6")
        again = estimates(60, GOOD | {3})
        assert (active(), main_pid()) == (True, pid), journal()
        run("systemctl", "stop", UNIT)
        assert show("Result") == "success", show("Result")
    finally:
        master.kill()
        CONFIG.write_text(good)
    return {"to READY=1 without a master": ready, "from boot": first, "after a pause": again}, {}


def page(root):
    """The page of a service: with the shipped unit's sandbox one line and no page, with the drop-in of the docs a page."""
    text = Path(f"{root}/docs/deployment.md").read_text()
    [dropped] = re.findall(r"^    (\[Service\]\n(?:    .*\n)+)", text, re.MULTILINE)
    lines = [line.strip() for line in dropped.splitlines()]
    folder = Path("/run/systemd/system/jtqd@.service.d")
    folder.mkdir()
    only = [line for line in lines if not line.startswith(("Restrict", "IPAddress", "SocketBind"))]
    seen = {}
    for name, content in (("sandbox of the unit", only), ("drop-in", lines)):
        (folder / "live.conf").write_text("\n".join(content) + "\n")
        run("systemctl", "daemon-reload")
        run("systemctl", "restart", UNIT)
        estimates(30)
        if name == "drop-in":
            until(lambda: "http" in journal(40), 20, "a line about the page")
        else:
            until(lambda: "live view" in journal(60), 20, "a line about what is forbidden")
            seen[name] = re.findall(r"jtqd.*: (.*live view.*)", journal(60))[-1]
            assert "Traceback" not in journal(60)
    with urllib.request.urlopen("http://127.0.0.1:8765/", timeout=20) as answer:
        assert b"uPlot" in answer.read()
    score = run("systemd-analyze", "security", UNIT, "--no-pager").stdout.splitlines()[-1]
    seen["exposure"] = float(re.search(r"([0-9.]+) [A-Z]+", score).group(1))
    assert seen["exposure"] <= 2.0, score
    (folder / "live.conf").unlink()
    folder.rmdir()
    run("systemctl", "daemon-reload")
    run("systemctl", "stop", UNIT)
    return {}, seen


def killed(which):
    before = restarts()
    pids = loops()
    began = time.monotonic()
    os.kill(main_pid() if which == "supervisor" else pids[0], signal.SIGKILL)
    until(lambda: restarts() == before + 1 and active(), 60, "a restart")
    ready = time.monotonic() - began
    estimates(30)
    assert len(loops()) == 1, loops()
    assert loops() != pids
    return {"ready again": ready, "estimate again": time.monotonic() - began}, {}


def link_down():
    pid, before = main_pid(), restarts()
    run("ip", "link", "set", BUS, "down")
    time.sleep(2.0)
    assert active()
    run("ip", "link", "set", BUS, "up")
    began = time.monotonic()
    estimates(60)
    assert (main_pid(), restarts()) == (pid, before), "it has stayed"
    return {"estimate again": time.monotonic() - began}, {}


def link_removed():
    began = time.monotonic()
    run("ip", "link", "delete", BUS)
    gone = until(lambda: show("ActiveState") in ("inactive", "failed"), 30, "it ends with its interface")
    until(lambda: not loops(), 10, "no process is left")
    seen = show("ActiveState")
    time.sleep(1.0)
    began = time.monotonic()
    run("ip", "link", "add", "dev", BUS, "type", "vcan")  # the set-up is can-up's
    until(active, 90, "it starts with its interface")
    ready = time.monotonic() - began
    estimates(30)
    return {"ended": gone, "ready again": ready, "estimate again": time.monotonic() - began}, {"state": seen}


def full_disk():
    pid = main_pid()
    filler = LOGS / "filler"
    room = shutil.disk_usage(LOGS).free
    with suppress(OSError), open(filler, "wb") as file:
        for _ in range(room // 65536 + 2):
            file.write(bytes(65536))
            file.flush()
    reported = journal()
    matter = re.compile(r".*(?:recording pauses|MB are free|No space left).*")

    def about_the_disk():
        return [line for line in journal().splitlines() if line not in reported and matter.match(line)]

    noticed = until(about_the_disk, 60, "a line about the disk")
    line = about_the_disk()[-1].partition(": ")[2]
    estimates(20)
    assert main_pid() == pid
    filler.unlink()
    sizes = {path: path.stat().st_size for path in LOGS.glob("*.mcap*")}

    def grows():
        return any(path.stat().st_size > sizes.get(path, 0) for path in LOGS.glob("*.mcap.active"))

    again = until(grows, 60, "the log goes on")
    return {"noticed": noticed, "log goes on": again}, {
        "reported": line,
        "files": len(list(LOGS.glob("*.mcap*"))),
    }


def changed_file():
    joint = Path("/etc/jtqd/trained/joint1.yaml")
    pid, (loop,) = main_pid(), loops()
    text = joint.read_text()
    joint.write_text(
        re.sub(r"(?m)^(rotor_inertia_kgm2: )(\S+)", lambda m: m[1] + repr(1.01 * float(m[2])), text)
    )
    assert run("systemctl", "reload", UNIT, check=False).returncode != 0  # there is no ExecReload=
    os.kill(pid, signal.SIGHUP)
    until(lambda: "SIGHUP ignored" in journal(40), 60, "a line about SIGHUP")
    estimates(20)
    assert (main_pid(), loops()) == (pid, [loop])
    began = time.monotonic()
    run("systemctl", "restart", UNIT)
    ready = time.monotonic() - began
    estimates(20)
    assert main_pid() != pid
    assert os.sched_getscheduler(loops()[0]) == os.SCHED_FIFO
    joint.write_text(text)
    return {"restart": ready}, {}


def stop():
    watch = Watch()
    watch.empty()
    asked, began = time.time(), time.monotonic()
    process = subprocess.Popen(("systemctl", "stop", UNIT))
    frames = []
    while process.poll() is None:
        frame = watch.next(0.1)
        if frame is not None:
            frames.append(frame)
    seconds = time.monotonic() - began
    while (frame := watch.next(0.2)) is not None:
        frames.append(frame)
    watch.close()
    assert show("Result") == "success", show("Result")
    own = [data for can_id, data in frames if can_id == 0x1A0]
    assert own[-1][:4] == struct.pack("<hh", -32768, -32768), own[-1]
    assert own[-1][6] == 0, own[-1]
    last_sync = max(n for n, frame in enumerate(frames) if frame[0] == 0x080)
    orders = [data for can_id, data in frames[last_sync:] if can_id == 0x000]
    assert sorted(orders) == [bytes((0x80, node)) for node in (1, 2, 3)], orders
    # Of earlier runs that were killed, some may still wait for their repair; those written to since belong to this run.
    left = [path for path in LOGS.glob("*.active") if path.stat().st_mtime >= asked]
    assert not left, left
    newest = max(LOGS.glob("*.mcap"), key=lambda path: path.stat().st_mtime)
    assert newest.read_bytes()[-8:] == b"\x89MCAP0\r\n"
    assert not Path("/run/jtqd/vcan0").exists()
    return {"stop": seconds}, {"log": newest.name}


def uninstall(root):
    for place in ("/opt/jtqd", "/var/log/jtqd"):  # what was mounted there for the test
        run("umount", place, check=False)
    run("/bin/sh", f"{root}/systemd/install.sh", "--uninstall", "--purge")
    left = [
        path
        for path in ("/opt/jtqd", "/etc/jtqd", "/var/log/jtqd")
        if Path(path).is_dir() and os.listdir(path)
    ]
    assert not left, left
    assert run("systemctl", "cat", UNIT, check=False).returncode != 0
    assert run("id", "jtqd", check=False).returncode != 0
    return {}, {}


STEPS = {
    "start": start,
    "stopped loop": stopped_loop,
    "stopped supervisor": stopped_supervisor,
    "wrong configuration": wrong_configuration,
    "killed supervisor": lambda: killed("supervisor"),
    "killed loop": lambda: killed("loop"),
    "link down and up": link_down,
    "link removed and made again": link_removed,
    "full disk": full_disk,
    "changed file": changed_file,
    "stop": stop,
}


def main(root, wheel, wheels, *steps):
    known = STEPS | {
        "uninstall": lambda: uninstall(root),
        "guest": lambda: guest(root, Path(wheels).parent / "guest.yaml"),
        "page": lambda: page(root),
    }
    chosen = {"install": lambda: install(root, wheel, wheels)} | {name: known[name] for name in steps}
    if "full disk" in steps:
        # Small, so that it fills quickly.
        LOGS.mkdir(parents=True, exist_ok=True)
        run("mount", "-t", "tmpfs", "-o", "size=24m,mode=0750", "tmpfs", str(LOGS))
    for name, step in chosen.items():
        began = time.monotonic()
        try:
            seconds, seen = step()
        except BaseException:
            print(journal(), file=sys.stderr)
            print(
                run("systemctl", "status", UNIT, "bench", "--no-pager", check=False).stdout, file=sys.stderr
            )
            raise
        took = time.monotonic() - began
        print(json.dumps({"step": name, "took": took, "seconds": seconds, "seen": seen}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
