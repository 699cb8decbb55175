"""Runs in the bench kernel under systemd: the Debian package is installed, started, upgraded, removed and purged.

    deb_driver.py DEB NEWER_DEB

Prints one JSON line for each step; a step that does not come out as it should ends it with a traceback.
"""

import json
import re
import sys
import time
from pathlib import Path

from systemd_driver import (
    BENCH,
    BUS,
    PERIOD_US,
    UNIT,
    active,
    estimates,
    journal,
    loops,
    main_pid,
    run,
    until,
)

ETC = Path("/etc/jtqd")
TRACES = (
    "/opt/jtqd",
    "/usr/bin/jtq",
    "/usr/bin/jtqd",
    "/lib/systemd/system/jtqd@.service",
    "/lib/systemd/system/can-up@.service",
    "/usr/lib/sysusers.d/jtqd.conf",
    "/usr/lib/tmpfiles.d/jtqd.conf",
    "/usr/lib/sysctl.d/60-jtqd.conf",
    "/usr/share/doc/jtqd",
)
AFTER_PURGE = ("/etc/jtqd", "/var/log/jtqd", "/run/jtqd")
EDITED = "BITRATE=500000\n"


def there(paths):
    return [path for path in paths if Path(path).exists() or Path(path).is_symlink()]


def dpkg(*arguments):
    # the guest's packages are the host's: dependencies are judged by dpkg as it finds them
    return run("dpkg", "--force-confold", *arguments, timeout=1200)


def installed(deb):
    dpkg("-i", deb)
    reported = run("/usr/bin/jtqd", "--version").stdout
    assert reported.startswith("jtqd "), reported
    assert there(TRACES) == list(TRACES)
    assert run("id", "jtqd").returncode == 0
    assert Path("/var/log/jtqd").owner() == "jtqd"
    (ETC / "can0.link").write_text(EDITED)  # an operator


def started():
    text = (ETC / "bench.yaml").read_text().replace("period_us: 1000", f"period_us: {PERIOD_US}")
    text = re.sub(r"(?m)^inputs:\n(  .*\n)+", "inputs: {wait_us: 2000, deadline_us: 4250}\n", text)
    (ETC / f"{BUS}.yaml").write_text(text)
    (ETC / f"{BUS}.link").write_text("BITRATE=none\n")
    Path("/run/systemd/system/bench.service").write_text(BENCH)
    run("systemctl", "daemon-reload")
    run("systemctl", "start", "bench")
    run("systemctl", "enable", "--now", UNIT)
    assert active()
    estimates(30)
    reported = journal()
    assert "not granted" not in reported, reported


def upgraded(deb):
    before = main_pid()
    dpkg("-i", deb)
    until(active, 60, "it runs again")
    assert main_pid() != before, "the new version runs"
    estimates(60)
    assert (ETC / "can0.link").read_text() == EDITED, "what an operator edited stays"


def removed():
    dpkg("-r", "jtqd")
    run("systemctl", "stop", "bench", check=False)
    assert not active()
    assert not loops()
    assert there(TRACES) == []
    assert not list(Path("/etc/systemd/system").glob("*.wants/jtqd@*"))
    assert (ETC / "can0.link").read_text() == EDITED


def purged():
    dpkg("--purge", "jtqd")
    assert there((*TRACES, *AFTER_PURGE)) == []
    assert run("id", "jtqd", check=False).returncode != 0


def main():
    deb, newer = sys.argv[1:]
    for step, work in (
        ("install", lambda: installed(deb)),
        ("start", started),
        ("upgrade", lambda: upgraded(newer)),
        ("remove", removed),
        ("purge", purged),
    ):
        began = time.monotonic()
        work()
        print(json.dumps({"step": step, "seconds": round(time.monotonic() - began, 2)}), flush=True)


if __name__ == "__main__":
    main()
