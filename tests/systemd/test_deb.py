"""The Debian package: what is in it, and its life under systemd in the bench kernel."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import jtqd
from jtqd.sim_can.bench_kernel import guest
from tests.paths import ROOT
from tests.systemd.systemd_wheels import make_wheels
from tests.systemd.test_systemd_boot import PYTHON, needs

SCRIPT = ROOT / "tools" / "deb.py"
DRIVER = Path(__file__).with_name("deb_driver.py")


def text_of(name: str) -> str:
    found = re.search(rf'^{name} = """(.*?)"""', SCRIPT.read_text(), re.MULTILINE | re.DOTALL)
    assert found is not None
    return found[1]


@pytest.mark.parametrize("name", ["POSTINST", "PRERM", "POSTRM"])
def test_maintainer_scripts_are_shell(name: str) -> None:
    done = subprocess.run(["sh", "-n"], input=text_of(name), text=True, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert text_of(name).startswith("#!/bin/sh\nset -e\n")


def test_every_file_of_the_package_is_there() -> None:
    for here in re.findall(r'^    "([^"]+)": "(?:lib|usr)/', SCRIPT.read_text(), re.MULTILINE):
        assert (ROOT / here).is_file(), here


@pytest.mark.campaign
@pytest.mark.boots
@pytest.mark.skipif(shutil.which("dpkg-deb") is None, reason="NOT TESTED: no dpkg-deb")
def test_installed_started_upgraded_removed_and_purged(tmp_path: Path) -> None:
    reason = needs()
    if reason is not None:
        pytest.skip(f"NOT TESTED: {reason}")
    wheels = tmp_path / "wheels"
    own = make_wheels(wheels)
    quick = {**os.environ, "DPKG_DEB_COMPRESSOR_TYPE": "none"}
    command = [sys.executable, SCRIPT, "--wheels", wheels, "--source", own, "--out", tmp_path]
    made = subprocess.run([*map(str, command)], env=quick, check=True, capture_output=True, text=True)
    deb = Path(made.stdout.strip())
    assert deb.name.startswith(f"jtqd_{jtqd.__version__}_")
    tree, newer = tmp_path / "tree", tmp_path / "newer.deb"
    subprocess.run(["dpkg-deb", "-R", deb, tree], check=True)
    assert (tree / "opt/jtqd/bin/python").resolve().name.startswith("python3")
    places = subprocess.run(
        ["grep", "-rIl", str(tmp_path), tree], capture_output=True, text=True, check=False
    ).stdout
    assert places == "", "no path of the build is left"
    control = tree / "DEBIAN" / "control"
    control.write_text(re.sub(r"(?m)^Version: .*$", r"\g<0>+1", control.read_text()))
    subprocess.run(["dpkg-deb", "--root-owner-group", "--build", tree, newer], env=quick, check=True)
    shutil.rmtree(tree)
    with guest.Guest(
        [str(PYTHON), str(DRIVER), str(deb), str(newer)], systemd=True, time_travel=True, vcans=["vcan0"]
    ) as one:
        result = one.wait(1500.0)
    assert result.returncode == 0, result.stdout + result.stderr
    steps = [json.loads(line)["step"] for line in result.stdout.splitlines()]
    assert steps == ["install", "start", "upgrade", "remove", "purge"]
