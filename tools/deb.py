"""Build the Debian package: `make deb`, or python tools/deb.py --wheels DIR for a machine without network.

The package holds a virtual environment at /opt/jtqd with all that jtqd needs (no extra), the units, users, directories and
kernel settings of systemd/, and configuration files in /etc/jtqd that dpkg treats as conffiles: what an operator has
edited stays. It is made for the Debian, the architecture and the /usr/bin/python3 that it is built on, with dpkg-deb alone.

Exit status: 0 done, 1 failure.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PREFIX = Path("opt/jtqd")
PYTHON = Path("/usr/bin/python3")
"""Debian's own: what a service may see, and what the package depends on."""
FILES = {
    "systemd/jtqd@.service": "lib/systemd/system/jtqd@.service",
    "systemd/can-up@.service": "lib/systemd/system/can-up@.service",
    "systemd/jtqd.sysusers.conf": "usr/lib/sysusers.d/jtqd.conf",
    "systemd/jtqd.tmpfiles.conf": "usr/lib/tmpfiles.d/jtqd.conf",
    "systemd/jtqd.sysctl.conf": "usr/lib/sysctl.d/60-jtqd.conf",
    "LICENSE": "usr/share/doc/jtqd/copyright",
    "CHANGELOG.md": "usr/share/doc/jtqd/CHANGELOG.md",
    "README.md": "usr/share/doc/jtqd/README.md",
}
"""Source -> place in the package. Paths below /lib: Debian 12 is not usr-merged in its packages."""
LINK = "BITRATE=1000000\nRESTART_MS=100\nTXQUEUELEN=1000\nOPTIONS=\n"
POSTINST = """#!/bin/sh
set -e
if [ "$1" = configure ]; then
    systemd-sysusers jtqd.conf
    systemd-tmpfiles --create jtqd.conf || true
    sysctl -q -e -p /usr/lib/sysctl.d/60-jtqd.conf || true
    if [ -d /run/systemd/system ]; then
        systemctl daemon-reload
        # an upgrade: what runs, runs the new version
        [ -z "$2" ] || systemctl try-restart 'jtqd@*.service'
    fi
fi
"""
PRERM = """#!/bin/sh
set -e
if [ "$1" = remove ] && [ -d /run/systemd/system ]; then
    systemctl stop 'jtqd@*.service' 'can-up@*.service' || true
    for unit in jtqd can-up; do
        for link in /etc/systemd/system/*.wants/"$unit"@*.service; do [ ! -L "$link" ] || rm -f "$link"; done
    done
fi
"""
POSTRM = """#!/bin/sh
set -e
case $1 in
remove | purge) rm -rf /opt/jtqd ;; # byte code that was made since
esac
if [ "$1" = purge ]; then
    rm -rf /etc/jtqd /var/log/jtqd /run/jtqd
    ! id jtqd >/dev/null 2>&1 || userdel jtqd
    ! getent group jtqd >/dev/null || groupdel jtqd
fi
[ ! -d /run/systemd/system ] || systemctl daemon-reload
"""


def run(*command: str | Path) -> str:
    """Run a command; its output. Raises CalledProcessError."""
    return subprocess.run([*map(str, command)], check=True, stdout=subprocess.PIPE, text=True).stdout


def version() -> str:
    """Version of the source tree."""
    text = (ROOT / "src" / "jtqd" / "__init__.py").read_text(encoding="utf-8")
    found = re.search(r'^__version__ = "([^"]+)"', text, re.MULTILINE)
    assert found is not None
    return found[1]


def commit_time() -> str:
    """Time of the commit that is built, in Unix seconds: $SOURCE_DATE_EPOCH (reproducible-builds.org), else git's."""
    given = os.environ.get("SOURCE_DATE_EPOCH")
    return given or run("git", "-C", ROOT, "log", "-1", "--format=%ct").strip()


def environment(tree: Path, source: Path, wheels: Path | None) -> None:
    """Make the virtual environment in the tree, as if it lay at /opt/jtqd: no path of the build is left in it."""
    target = tree / PREFIX
    run(PYTHON, "-m", "venv", "--without-pip", target)
    site = next((target / "lib").glob("python3*")) / "site-packages"
    offline: list[str | Path] = [] if wheels is None else ["--no-index", "--find-links", wheels]
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-compile")
    run(*pip, *offline, "--target", site, source)
    shutil.rmtree(site / "bin", ignore_errors=True)
    for record in site.glob("*.dist-info/RECORD"):
        record.with_name("direct_url.json").unlink(missing_ok=True)  # it names the wheel's place
        lines = record.read_text().splitlines()
        gone = ("../../bin/", f"{record.parent.name}/direct_url.json")
        record.write_text("\n".join([*(line for line in lines if not line.startswith(gone)), ""]))
    for command, module in (("jtqd", "jtqd.daemon.jtqd"), ("jtq", "jtqd.daemon.jtq")):
        script = target / "bin" / command
        script.write_text(
            f"#!/{PREFIX}/bin/python\nimport sys\nfrom {module} import main\nsys.exit(main())\n"
        )
        script.chmod(0o755)
        link = tree / "usr/bin" / command
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(f"/{PREFIX}/bin/{command}")
    for activate in (target / "bin").glob("[Aa]ctivate*"):
        activate.unlink()  # they name the place of the build
    config = target / "pyvenv.cfg"
    config.write_text(re.sub(r"(?m)^command = .*\n", "", config.read_text()))
    touch(tree)  # byte code holds the time of its source
    # A process of its own: byte code differs with what the compiling interpreter has loaded.
    compiled = ("-m", "compileall", "-qq", "-s", tree, "-p", "/", "--invalidation-mode", "timestamp")
    subprocess.run([PYTHON, "-I", *compiled, site], check=False)  # it fails at templates that packages ship


def touch(tree: Path) -> None:
    """Give every file, folder and link of the tree the time of the commit."""
    time = int(commit_time())
    for path in (tree, *tree.rglob("*")):
        os.utime(path, (time, time), follow_symlinks=False)


def interpreter() -> tuple[str, str]:
    """Version of the interpreter of the environment, and the first that is too new for its compiled modules."""
    major, minor = map(int, run(PYTHON, "-c", "import sys; print(*sys.version_info[:2])").split())
    if (major, minor) != sys.version_info[:2]:
        raise SystemExit(
            f"deb.py: run it with {PYTHON} or its version, not with Python {sys.version.split()[0]}"
        )
    return f"{major}.{minor}", f"{major}.{minor + 1}"


def build(out: Path, wheels: Path | None, source: Path, name: str) -> Path:
    """Build the package of version `name` into `out`; its path."""
    lowest, beyond = interpreter()
    architecture = run("dpkg", "--print-architecture").strip()
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        (tree / "DEBIAN").mkdir(parents=True)
        tree.chmod(0o755)
        environment(tree, source, wheels)
        for here, there in FILES.items():
            (tree / there).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / here, tree / there)
        etc = tree / "etc/jtqd"
        etc.mkdir(parents=True)
        (etc / "can0.link").write_text(LINK)
        shutil.copyfile(ROOT / "models/bench.yaml", etc / "bench.yaml")
        shutil.copytree(
            ROOT / "models/trained", etc / "trained", ignore=shutil.ignore_patterns("__pycache__")
        )
        conffiles = sorted(f"/{path.relative_to(tree)}" for path in etc.rglob("*") if path.is_file())
        files = (path for path in tree.rglob("*") if path.is_file() and not path.is_symlink())
        size = sum(path.stat().st_size for path in files) // 1024
        control = (
            f"Package: jtqd\nVersion: {name}\nArchitecture: {architecture}\nSection: science\nPriority: optional\n"
            "Maintainer: jtqd developers <jtqd@localhost>\n"
            f"Installed-Size: {size}\n"
            f"Depends: python3 (>= {lowest}), python3 (<< {beyond}), iproute2, procps, systemd, passwd\n"
            "Description: joint torque estimator daemon for harmonic-drive joints on CANopen\n"
            " CANopen master, torque observer and network at 1 kHz; no torque sensor needed.\n"
            " Everything it needs of Python lies in /opt/jtqd.\n"
        )
        (tree / "DEBIAN/control").write_text(control)
        (tree / "DEBIAN/conffiles").write_text("\n".join([*conffiles, ""]))
        for script, text in (("postinst", POSTINST), ("prerm", PRERM), ("postrm", POSTRM)):
            (tree / "DEBIAN" / script).write_text(text)
            (tree / "DEBIAN" / script).chmod(0o755)
        for path in tree.rglob("*"):
            if not path.is_symlink():
                path.chmod(0o755 if path.is_dir() or path.stat().st_mode & 0o100 else 0o644)
        touch(tree)
        os.environ["SOURCE_DATE_EPOCH"] = commit_time()  # dpkg-deb gives it to the archive's own members
        out.mkdir(parents=True, exist_ok=True)
        made = out / f"jtqd_{name}_{architecture}.deb"
        run("dpkg-deb", "--root-owner-group", "--build", tree, made)
    return made


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python tools/deb.py", description="Build the Debian package of jtqd."
    )
    parser.add_argument(
        "--out", type=Path, default=ROOT / "dist", help="directory for the package (default dist)"
    )
    parser.add_argument("--wheels", type=Path, help="take every Python package from this directory")
    parser.add_argument("--source", type=Path, default=ROOT, help="this source tree, or a wheel of it")
    parser.add_argument("--version", default=version(), help=argparse.SUPPRESS)
    options = parser.parse_args()
    try:
        print(build(options.out, options.wheels, options.source, options.version))
    except (subprocess.CalledProcessError, OSError) as error:
        print(f"deb.py: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
