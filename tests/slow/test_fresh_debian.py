"""A stranger's Debian: made by debootstrap, given what README names and nothing else, used as a user without rights.

Needs root, debootstrap, the Debian mirror and PyPI; 4 minutes of a processor per suite. What is mounted lies in a mount
namespace of its own, and ends with the command that needs it.
"""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.paths import ROOT

USER = "stranger"
PREPARE = """
set -e
mount -t proc proc "$0/proc"
mount --rbind /dev "$0/dev"
mount -t tmpfs tmpfs "$0/dev/shm"
mount -t sysfs sysfs "$0/sys"
exec chroot "$0" /usr/bin/env -i "$@"
"""


def lacking() -> str | None:
    """Why this cannot be tried here, or None."""
    if os.geteuid() != 0:
        return "only root can make a Debian"
    return next((f"no {name}" for name in ("debootstrap", "unshare", "git") if not shutil.which(name)), None)


def packages() -> list[str]:
    found = re.search(
        r"^ {4}sudo apt-get install ([\w. -]+)$", (ROOT / "README.md").read_text(), re.MULTILINE
    )
    assert found is not None
    return found[1].split()


def inside(root: Path, command: str, user: str = "root", timeout_s: float = 1500.0) -> str:
    """Run a shell command in the Debian; what it printed. Raises AssertionError when it fails."""
    home = "/root" if user == "root" else f"/home/{user}"
    certificates = ["PIP_CERT=/etc/host-certificates.pem"] if "PIP_CERT" in os.environ else []
    environment = [f"HOME={home}", "LANG=C.UTF-8", "PATH=/usr/sbin:/usr/bin:/sbin:/bin", *certificates]
    rights = [] if user == "root" else ["setpriv", f"--reuid={user}", f"--regid={user}", "--init-groups"]
    done = subprocess.run(
        [
            *("unshare", "--mount", "--pid", "--fork", "--kill-child", "--propagation", "private"),
            *("sh", "-c", PREPARE, str(root), *environment, *rights, "sh", "-c", f"cd {home} && {command}"),
        ],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    assert done.returncode == 0, f"{command}: {done.returncode}\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}"
    return done.stdout


def test_readme_names_what_make_asks_for() -> None:
    wanted = set(re.findall(r"\b(?:gcc|libc6-dev|python3-\w+)(?![\w.])", (ROOT / ".ci" / "venv").read_text()))
    assert wanted <= set(packages())
    assert {"git", "make"} <= set(packages())


@pytest.mark.campaign
@pytest.mark.parametrize("suite", ["bookworm", "trixie"])
def test_demo_and_debian_package_on_a_fresh_debian(suite: str, tmp_path: Path) -> None:
    reason = lacking()
    if reason is not None:
        print(f"\nFRESH DEBIAN NOT TESTED: {reason}")
        pytest.skip(f"NOT TESTED: {reason}")
    root = tmp_path / "debian"
    made = subprocess.run(
        ["debootstrap", "--variant=minbase", suite, root], capture_output=True, text=True, check=False
    )
    assert made.returncode == 0, made.stdout[-2000:] + made.stderr
    shutil.copyfile("/etc/resolv.conf", root / "etc/resolv.conf")
    if "PIP_CERT" in os.environ:
        shutil.copyfile(os.environ["PIP_CERT"], root / "etc/host-certificates.pem")
    subprocess.run(
        ["git", "clone", "--quiet", "--bare", "--no-hardlinks", ROOT, root / "srv/jtqd.git"], check=True
    )
    shutil.chown(root / "srv", "root")
    inside(root, f"useradd --create-home {USER} && chown -R {USER} /srv/jtqd.git")
    install = "DEBIAN_FRONTEND=noninteractive apt-get -q install -y --no-install-recommends"
    inside(root, f"apt-get -q update && {install} {' '.join(packages())}")

    inside(root, "git clone --quiet /srv/jtqd.git jtqd", USER)
    said = inside(root, "cd jtqd && make demo", USER)
    assert "RMSE joint 2" in said
    assert re.search(r"^log +logs/jtqd-sim-.*\.mcap$", said, re.MULTILINE)

    inside(root, "cd jtqd && DPKG_DEB_COMPRESSOR_TYPE=none make deb", USER)
    inside(root, f"{install} /home/{USER}/jtqd/dist/jtqd_*.deb")
    inside(root, f"rm -r /home/{USER}/jtqd")
    assert inside(root, "jtq --version", USER).startswith("jtq")
    assert "RMSE joint 2" in inside(root, "jtqd --bus sim --duration 5", USER)
    inside(root, "apt-get -q purge -y jtqd")
    left = [
        path for path in ("opt/jtqd", "usr/bin/jtqd", "etc/jtqd", "var/log/jtqd") if (root / path).exists()
    ]
    assert left == []
